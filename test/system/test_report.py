"""eskf_report: the verdict and the figures are those of the replay, extremes stay, and the page works in a browser."""

from __future__ import annotations

import http.server
import json
import queue
import re
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eskf_ros.replay.main import main as replay
from eskf_ros.report.main import main as report
from eskf_ros.report.thinning import extremes, strongest

pytest.importorskip("bokeh", reason="the report is drawn by bokeh, which is not installed")

from eskf_ros.report.compare import horizontal_error
from eskf_ros.report.measurements import chi_square_density
from eskf_ros.report.read import Result, read_aids, read_result
from eskf_ros.report.state import outages
from eskf_ros.report.track_map import fix_verdicts
from eskf_ros.report.verdict import BAD, CAUTION, GOOD, verdict_of

CHECKOUT = Path(__file__).resolve().parents[2]
BAG = CHECKOUT / "bags" / "tunnel_drive.mcap"
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
TUNNEL = 45.0
BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), "")
LARGEST_PAGE = 6e6

PROBE = """
<script>
const found = {errors: [], empty: [], panels: 0};
window.addEventListener('error', event => found.errors.push(String(event.message)));
for (const name of ['error', 'warn']) console[name] = (...words) => found.errors.push(words.join(' '));
function look() {
  const page = window.Bokeh && Bokeh.documents[0];
  if (!page || !page.is_idle) { setTimeout(look, 200); return; }
  for (const holder of document.querySelectorAll('[data-root-id]')) {
    const plot = page.get_model_by_id(holder.dataset.rootId);
    found.panels += 1;
    const points = plot.renderers.map(one => one.data_source.get_length() || 0);
    if (!points.length || Math.max(...points) === 0 || holder.firstElementChild.getBoundingClientRect().height < 50)
      found.empty.push(plot.title.text);
  }
  // Zoom is common to all plots, a click on a name hides its curve, the time moves the mark and the cursors in sight.
  const plots = [...document.querySelectorAll('[data-root-id]')].map(h => page.get_model_by_id(h.dataset.rootId));
  const timed = plots.filter(plot => plot.x_range.name === 'time');
  timed[0].x_range.start = 50;
  found.zoomed = timed.every(plot => plot.x_range.start === 50);
  found.legends = plots.flatMap(plot => plot.above).filter(one => one.click_policy).map(one => one.click_policy);
  const marker = page.get_model_by_name('marker'), now = document.getElementById('now');
  let before = null, tries = 0;
  function check() {
    tries += 1;
    if (before === null && now.textContent) { before = marker.data.x[0]; window.eskfReport.goTo(100); }
    if (!now.textContent.startsWith('100.0 s') && tries < 100) { setTimeout(check, 100); return; }
    const spans = timed.flatMap(plot => plot.center).filter(one => one.name === 'cursor');
    found.moved = Math.abs(marker.data.x[0] - before);
    found.timed = timed.length;
    found.cursors = spans.filter(one => one.location === 100).length;
    found.text = now.textContent;
    fetch('http://127.0.0.1:PORT/', {method: 'POST', mode: 'no-cors', body: JSON.stringify(found)});
  }
  check();
}
look();
</script>
"""
"""Looks at the page from inside and sends what it finds to the test: no driver of the browser is needed."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    options = ["--config", str(CONFIG), "--truth", "truth", "--out", str(out), "--quiet", "--report"]
    assert replay([str(BAG), *options, "--outage", "60:15"]) == 0
    return out / "tunnel_drive_eskf"


@pytest.fixture(scope="module")
def result(folder: Path) -> Result:
    found = read_result(folder)
    assert isinstance(found, Result)
    return found


def test_the_replay_writes_one_page_that_needs_nothing_else(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert len(text) < LARGEST_PAGE
    assert not re.search(r"<(script|link|img|iframe)[^>]*\s(src|href)\s*=\s*[\"']?(https?:|//)", text)
    assert not re.search(r"@import|url\(\s*[\"']?(https?:|//)", text[text.index("</head>") :])
    assert text.index("class='verdict") < text.index("data-root-id")


def test_errors_lie_in_the_band_that_the_page_draws(result: Result) -> None:
    """The signed errors have the size that the summary says, and a share in 3 sigma as the NEES promises."""
    errors = result.table("errors")
    horizontal = np.hypot(errors["error_enu"][:, 0], errors["error_enu"][:, 1])
    np.testing.assert_allclose(horizontal, errors["horizontal"], rtol=1e-9)
    assert horizontal.max() == pytest.approx(result.summary["error"]["horizontal"]["max"])
    inside = np.abs(errors["error_enu"]) < 3.0 * errors["std_enu"]
    assert inside.mean() > 0.97
    fine = np.isfinite(errors["attitude_error_deg"][:, 2])
    largest = np.abs(errors["attitude_error_deg"][fine, 2]).max()
    assert largest == pytest.approx(result.summary["error"]["heading_deg"]["max"], rel=0.02)


def test_outages_are_the_withheld_one_and_the_tunnel_with_the_errors_they_ended_in(result: Result) -> None:
    found = [outage for outage in outages(result) if outage.length > 5.0]
    assert len(found) == 2
    for outage, length in zip(found, (15.0, TUNNEL)):
        assert outage.length == pytest.approx(length, abs=2.0)
        assert outage.error < 3.0 * outage.sigma
        assert outage.jump == pytest.approx(outage.error, abs=3.0)
    assert found[1].distance > 500.0


def test_fixes_on_the_map_lie_at_the_antenna_and_have_their_verdicts(result: Result) -> None:
    verdicts, fixes = fix_verdicts(result), result.table("fixes")
    counts = dict(zip(*np.unique(verdicts, return_counts=True)))
    aid = result.summary["aids"]["gnss_position"]
    assert counts.pop("withheld") == aid["withheld"]
    assert counts == aid["verdicts"]
    used = verdicts == "fused"
    here = [np.interp(fixes["stamp"][used] * 1e-9, result.stamp, result.position[:, axis]) for axis in range(3)]
    apart = np.linalg.norm(fixes["position_map"][used] - np.stack(here, axis=1), axis=1)
    assert np.median(apart) < 3.0


def test_the_imu_by_the_second(result: Result) -> None:
    imu = result.table("imu")
    assert imu["count"].sum() == result.summary["imu_count"]
    assert imu["longest_interval"].max() == pytest.approx(0.005, abs=1e-4)
    assert not imu["held"].any()
    # Above the motion the floor of the spectrum is the noise that the simulator puts in, told in config/.
    quiet = result.details["density"][result.details["frequency"] > 20.0]
    assert quiet[:, 3:].mean() == pytest.approx(5.0e-5, rel=0.5)
    assert quiet[:, :3].mean() == pytest.approx(6.0e-4, rel=0.5)


def test_aids_are_read_as_they_were_written(folder: Path, result: Result) -> None:
    rows = read_aids(folder / "aids.csv")
    for name, aid in result.summary["aids"].items():
        chosen = rows[rows["aid"] == name.encode()]
        assert len(chosen) == aid["offered"]
        assert np.nanmean(chosen["nis"]) == pytest.approx(aid["nis_mean"])


def test_verdict_in_words(result: Result) -> None:
    summary = json.loads(json.dumps(result.summary))
    good = verdict_of(summary, outages(result))
    assert good.level == GOOD
    assert "Good" in good.headline
    assert any("2 outages, the longest of 4" in finding.text for finding in good.findings)
    warned = verdict_of({**summary, "warnings": ["the gyro is in deg/s: REP-103 wants rad/s"]})
    assert (warned.level, warned.findings[0].text) == (CAUTION, "The gyro is in deg/s.")
    assert warned.findings[0].remedy == "REP-103 wants rad/s."
    lost = {**summary, "final": {**summary["final"], "position": None, "status": "WAITING_FIX"}}
    assert verdict_of(lost).level == BAD
    summary["nees"]["position"] = {"mean": 30.0, "in_95": 0.2}
    assert "claims too much" in verdict_of(summary).findings[0].text


def test_a_trajectory_of_another_program_stands_beside_truth(folder: Path, result: Result, tmp_path: Path) -> None:
    """Three metres put on the track are found as three metres from it, and as that much error."""
    lines = np.loadtxt(folder / "trajectory.tum")
    lines[:, 1] += 3.0
    np.savetxt(tmp_path / "other.tum", lines, fmt="%.9f")
    other = read_result(tmp_path / "other.tum")
    errors = result.table("errors")
    expected = np.hypot(errors["error_enu"][:, 0] + 3.0, errors["error_enu"][:, 1])
    np.testing.assert_allclose(horizontal_error(other, result), expected, atol=1e-3)
    page = tmp_path / "both.html"
    assert report([str(folder), str(tmp_path / "other.tum"), "--out", str(page)]) == 0
    assert "<td>other</td><td>trajectory</td><td>–</td><td>3.00</td><td>3.00</td>" in page.read_text(encoding="utf-8")


def test_a_smoothed_trajectory_in_the_folder_is_shown(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "tunnel_drive_eskf"
    shutil.copytree(folder, copy)
    shutil.copy(copy / "trajectory.tum", copy / "trajectory_smoothed.tum")
    assert report([str(copy)]) == 0
    assert "<td>smoothed</td>" in (copy / "report.html").read_text(encoding="utf-8")


def test_without_a_position_the_page_says_so(tmp_path: Path) -> None:
    options = ["--config", str(CONFIG), "--out", str(tmp_path), "--quiet", "--report", "--outage", "0:1000"]
    assert replay([str(BAG), *options]) == 0
    text = (tmp_path / "tunnel_drive_eskf" / "report.html").read_text(encoding="utf-8")
    assert "Do not navigate by this result yet." in text
    assert "No position was found." in text
    assert "There is no track" in text


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "not.tum").write_text("no numbers\n")
    for path in (tmp_path / "none", tmp_path, tmp_path / "not.tum"):
        assert report([str(path), "--out", str(tmp_path / "page.html")]) == 2
        error = capsys.readouterr().err
        assert error.startswith("eskf_report: error: ")
        assert error.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def test_thinned_curves_keep_first_last_and_extremes() -> None:
    random = np.random.default_rng(4)
    values = random.normal(size=100_003)
    values[777] = np.nan
    rows = extremes([values], 100)
    assert len(rows) < 400
    assert (rows[0], rows[-1]) == (0, len(values) - 1)
    for part in np.array_split(np.arange(100_000), 10):
        inside = rows[(rows >= part[0]) & (rows <= part[-1])]
        assert np.nanmax(values[inside]) == np.nanmax(values[part])
        assert np.nanmin(values[inside]) == np.nanmin(values[part])
    assert np.nanargmax(values) in strongest(values, 50)


def test_chi_square_density_has_the_moments_of_chi_square() -> None:
    values = np.linspace(1e-4, 80.0, 800_001)
    for dof in (2, 3):
        density = chi_square_density(values, dof)
        assert density.sum() * 1e-4 == pytest.approx(1.0, abs=2e-3)
        assert (values * density).sum() * 1e-4 == pytest.approx(dof, abs=2e-3)


@pytest.fixture(scope="module")
def seen(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a browser finds in the page."""
    if not BROWSER:
        pytest.skip("there is no chromium to open the page with")
    place, received = tmp_path_factory.mktemp("browser"), queue.Queue[bytes]()

    class Receiver(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            received.put(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()

    with http.server.HTTPServer(("127.0.0.1", 0), Receiver) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        probe = PROBE.replace("PORT", str(server.server_port))
        text = (folder / "report.html").read_text(encoding="utf-8")
        (place / "page.html").write_text(text.replace("<body>\n<header>", f"<body>\n{probe}<header>"), encoding="utf-8")
        command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
        command += [f"--user-data-dir={place / 'profile'}", "--window-size=1400,1600", f"file://{place}/page.html"]
        silent = subprocess.DEVNULL
        with subprocess.Popen(command, stdout=silent, stderr=silent) as browser:
            try:
                return json.loads(received.get(timeout=180.0))  # type: ignore[no-any-return]
            finally:
                browser.terminate()
                server.shutdown()


def test_the_browser_finds_no_errors_and_no_empty_panel(seen: dict[str, Any]) -> None:
    assert seen["errors"] == []
    assert seen["empty"] == []
    assert seen["panels"] > 30


def test_zoom_legends_and_the_common_cursor_work(seen: dict[str, Any]) -> None:
    assert seen["zoomed"]
    assert set(seen["legends"]) == {"hide"}
    assert seen["moved"] > 100.0
    assert 1 <= seen["cursors"] < seen["timed"]  # only those in sight are drawn
    assert seen["text"].startswith("100.0 s")
