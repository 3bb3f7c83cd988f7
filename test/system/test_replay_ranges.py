"""eskf_replay on ranges: out of the recording, out of RINEX files beside it, and what is said when they are missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eskf_ros.bags import BagWriter, open_bag
from eskf_ros.filter.state.enums import Stream
from eskf_ros.replay.main import main
from eskf_ros.simulate.main import main as simulate_main
from eskf_ros.simulate.range_receiver import RangeReceiver
from eskf_ros.simulate.scenario import simulate
from support.gnss_observation_text import observation_text

CHECKOUT = Path(__file__).resolve().parents[2]
CONFIG = CHECKOUT / "config" / "tunnel_drive.yaml"
SKY = CHECKOUT / "bags" / "sky.nav"
PART = {"start": 12.0, "stop": 72.0}
TIGHT = ("--mode", "tight")
FIX_FRAME = "gps"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of a drive with ranges and ephemerides, the same without, and its ranges as a RINEX file."""
    folder = tmp_path_factory.mktemp("ranges")
    part = [f"--set={name}={value:g}" for name, value in PART.items()]
    for name, sensor in (("ranges", ["--sensor", "ranges"]), ("plain", [])):
        command = ["drive", "--seed", "4", *part, *sensor, "--quiet", "--out", str(folder / f"{name}.mcap")]
        assert simulate_main(command) == 0
    measured = simulate("drive", 4, **PART, ranges=RangeReceiver()).ranges
    assert measured is not None
    epochs = [
        (int(week), float(second), measured.epoch(k))
        for k, (week, second) in enumerate(zip(measured.week, measured.seconds))
    ]
    (folder / "rover.obs").write_text(observation_text(epochs, (4.2e6, 8.5e5, 4.7e6)), encoding="ascii")
    return folder


def replay(bag: Path, *options: str, config: Path = CONFIG) -> dict[str, Any]:
    command = [str(bag), "--config", str(config), "--truth", "truth", "--out", str(bag.parent / "out"), "--quiet"]
    assert main([*command, *options]) == 0
    result: dict[str, Any] = json.loads((bag.parent / "out" / f"{bag.stem}_eskf" / "summary.json").read_text())
    return result


def with_parameters(folder: Path, *lines: str) -> Path:
    config = folder / "changed.yaml"
    config.write_text(CONFIG.read_text() + "".join(f"    {line}\n" for line in lines), encoding="utf-8")
    return config


def refusal(capsys: pytest.CaptureFixture[str], command: Sequence[str]) -> str:
    assert main([*command, "--quiet"]) == 2
    return capsys.readouterr().err


def test_tight_from_the_recording(folder: Path) -> None:
    """No fix is used, the ephemerides come from the recording, and the result is that of good ranges."""
    result = replay(folder / "ranges.mcap", *TIGHT)
    assert result["mode"] == "tight"
    assert set(result["aids"]) == {"pseudorange", "range_rate"}
    for aid in result["aids"].values():
        assert aid["fused"] > 0.85 * aid["offered"] > 1000
    assert result["ranges"]["epochs"] > 200
    assert result["ranges"]["signals"]["usable"] == result["aids"]["pseudorange"]["offered"]
    assert result["final"]["status"] == "GOOD"
    # What models leave of atmosphere and orbits changes in half an hour: it stays.
    assert result["error"]["horizontal"]["p50"] < 2.5
    assert result["error"]["speed"]["p50"] < 0.1
    assert 0.3 < result["nees"]["position"]["mean"] < 8.0
    assert result["warnings"] == []
    unmodelled = with_parameters(folder, "ranges:", "  correlation_time: 0.0")
    assert replay(folder / "ranges.mcap", *TIGHT, config=unmodelled)["nees"]["position"]["mean"] > 12.0


def test_the_mode_is_a_parameter_too(folder: Path) -> None:
    config = with_parameters(folder, "mode: tight")
    assert replay(folder / "ranges.mcap", config=config)["final"] == replay(folder / "ranges.mcap", *TIGHT)["final"]
    loose = replay(folder / "ranges.mcap", "--mode", "loose", config=config)
    assert set(loose["aids"]) == {"gnss_position", "gnss_velocity"}
    assert "ranges" not in loose


def test_order_of_log_and_of_stamps_end_in_the_same_state(folder: Path) -> None:
    by_log, by_stamp = (replay(folder / "ranges.mcap", *TIGHT, "--order", order) for order in ("log", "stamp"))
    assert by_log["final"] == by_stamp["final"]
    assert by_log["aids"] == by_stamp["aids"]


@pytest.mark.parametrize("ahead", [0.0, 0.7])
def test_rinex_files_beside_the_recording(folder: Path, ahead: float) -> None:
    """The same drive, to the millimetres that the file rounds away and the 0.1 ms of its time tags."""
    files = ["--ranges", str(folder / "rover.obs"), "--nav", str(SKY)]
    config = with_parameters(folder, "ranges:", f"  time_offset: {ahead}")
    beside = replay(folder / "plain.mcap", *files, "--clock-offset", str(-ahead), config=config)
    recorded = replay(folder / "ranges.mcap", *TIGHT)
    assert beside["mode"] == "tight"
    assert beside["ranges"]["epochs"] == recorded["ranges"]["epochs"]
    np.testing.assert_allclose(beside["final"]["position"], recorded["final"]["position"], atol=0.02)
    np.testing.assert_allclose(beside["final"]["velocity"], recorded["final"]["velocity"], atol=0.005)


def test_an_outage_withholds_the_ranges(folder: Path) -> None:
    """Counted in epochs, beside the epochs that were read; the signals in them nobody has looked at."""
    whole = replay(folder / "ranges.mcap", *TIGHT)
    assert whole["ranges"]["withheld"] == 0
    result = replay(folder / "ranges.mcap", *TIGHT, "--outage", "40:10")
    assert result["ranges"]["withheld"] == pytest.approx(50, abs=2)
    assert result["ranges"]["epochs"] + result["ranges"]["withheld"] == whole["ranges"]["epochs"]
    assert [aid["withheld"] for aid in result["aids"].values()] == [None, None]
    assert 0.1 < result["outages"][0]["horizontal"] < 30.0
    ins_only = replay(folder / "ranges.mcap", "--mode", "ins-only", config=with_parameters(folder, "mode: tight"))
    assert ins_only["ranges"]["withheld"] > 100


@pytest.mark.parametrize("solves", [False, True])
def test_late_ranges_are_counted_under_their_topic(folder: Path, solves: bool) -> None:
    """All that is made of them, and nothing of it for the ephemerides, which share their stream."""
    changes = ["history:", "  window: 0.05", "ranges:", f"  use_point_solution: {str(solves).lower()}"]
    mode = "loose" if solves else "tight"
    result = replay(folder / "ranges.mcap", "--mode", mode, config=with_parameters(folder, *changes))
    names = ("gnss_position", "gnss_velocity") if solves else ("pseudorange", "range_rate")
    late = [result["aids"][name]["late"] for name in names]
    assert min(late) > 100
    (warning,) = (line for line in result["warnings"] if "too late" in line)
    assert f"measurements too late for history.window = 0.05 s: {sum(late)} of gnss/ranges; " in warning


def test_loose_on_our_own_point_solution(folder: Path) -> None:
    """In place of the receiver's fixes, which are not even read."""
    config = with_parameters(folder, "ranges:", "  use_point_solution: true")
    result = replay(folder / "ranges.mcap", config=config)
    assert result["mode"] == "loose"
    assert set(result["aids"]) >= {"gnss_position", "gnss_velocity"}
    assert result["ranges"]["point_solutions"] == result["aids"]["gnss_position"]["offered"] > 200
    assert result["aids"]["gnss_position"]["fused"] > 200
    assert result["error"]["horizontal"]["p50"] < 3.0
    files = ["--ranges", str(folder / "rover.obs"), "--nav", str(SKY)]
    assert replay(folder / "plain.mcap", *files, config=config)["mode"] == "loose"


@pytest.mark.parametrize("solves", [False, True])
def test_beside_ranges_the_fixes_of_a_second_receiver_are_used_and_those_of_the_first_refused(
    folder: Path, solves: bool
) -> None:
    """The fixes of the recording have one frame: whose they are says the parameter."""
    point_solution = ("ranges:", f"  use_point_solution: {str(solves).lower()}")
    options = () if solves else TIGHT

    def result(frame: str) -> dict[str, Any]:
        second = ("second_gnss:", f"  frame_id: '{frame}'", "  lever_arm: [0.8, -0.2, 1.4]")
        return replay(folder / "ranges.mcap", *options, config=with_parameters(folder, *point_solution, *second))

    alone, firsts, seconds = result(""), result("rear"), result(FIX_FRAME)
    assert firsts["final"] == alone["final"]
    own = alone["aids"].get("gnss_position", {"offered": 0, "fused": 0})
    for name in ("gnss_position", "gnss_velocity"):
        refused, used = firsts["aids"][name], seconds["aids"][name]
        assert refused["fused"] == own["fused"]
        assert refused["verdicts"]["disabled"] == refused["offered"] - own["offered"] > 200
        assert "disabled" not in used["verdicts"]
        assert used["fused"] > own["fused"] + 200
    assert firsts["aids"].get("pseudorange") == alone["aids"].get("pseudorange")


def test_missing_ephemerides_are_named_with_the_remedy(folder: Path) -> None:
    bare = folder / "bare.mcap"
    with open_bag([folder / "ranges.mcap"]) as reader, BagWriter(bare) as writer:
        types = {topic: info.type for topic, info in reader.topics.items() if topic != "gnss/ephemerides"}
        handles = {topic: writer.add_topic(topic, kind) for topic, kind in types.items()}
        for batch in reader.batches(types):
            for topic, part in batch.items():
                writer.write(handles[topic], part.log_time, part.messages, part.strings)
    result = replay(bare, *TIGHT)
    assert any("no_ephemeris" in line and "ranges.rinex_nav_files" in line for line in result["warnings"])
    assert any("no position was found" in line for line in result["warnings"])
    with_file = replay(bare, *TIGHT, "--nav", str(SKY))
    assert with_file["final"]["status"] == "GOOD"
    assert with_file["warnings"] == []


def test_missing_parameters_of_the_ionosphere_are_named(folder: Path) -> None:
    bare = folder / "no_ionosphere.nav"
    lines = SKY.read_text(encoding="ascii").splitlines(keepends=True)
    bare.write_text("".join(line for line in lines if "IONOSPHERIC" not in line), encoding="ascii")
    result = replay(folder / "plain.mcap", "--ranges", str(folder / "rover.obs"), "--nav", str(bare))
    assert any("ionosphere" in line for line in result["warnings"])
    assert result["error"]["horizontal"]["p50"] < 5.0


def test_what_does_not_fit_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = str(folder / "plain.mcap")
    text = refusal(capsys, [plain, *TIGHT])
    assert "no topic gnss/ranges" in text
    assert "--ranges FILE.obs" in text
    obs = ["--ranges", str(folder / "rover.obs")]
    assert "mode tight" in refusal(capsys, [plain, "--mode", "loose", *obs])
    assert "missing.nav" in refusal(capsys, [plain, *obs, "--nav", str(folder / "missing.nav")])
    assert "not of the time of the recording" in refusal(
        capsys, [plain, *obs, "--nav", str(SKY), "--clock-offset", "9999"]
    )
    assert "not observation data" in refusal(capsys, [plain, "--ranges", str(SKY), "--nav", str(SKY)])


def test_every_signal_has_its_row(folder: Path) -> None:
    replay(folder / "ranges.mcap", *TIGHT)
    lines = (folder / "out" / "ranges_eskf" / "aids.csv").read_text().splitlines()[1:]
    names = [line.split(",")[2] for line in lines]
    assert names.count(Stream.PSEUDORANGE.name.lower()) == names.count(Stream.RANGE_RATE.name.lower()) > 1000
    sources = {line.split(",")[-1] for line in lines}
    assert {source[0] for source in sources} == set("GEC")
    assert {source[3:] for source in sources if source[0] == "G"} == {" 1C"}


@pytest.mark.parametrize("mode", ["tight", "loose"])
def test_a_magnetometer_beside_ranges_is_fused(tmp_path: Path, mode: str) -> None:
    """Where no fix tells the Earth's magnetic field, the epochs of the ranges do."""
    bag = tmp_path / "mag.mcap"
    sensors = ("--sensor", "ranges", "--sensor", "magnetometer")
    part = ("--set", "start=12", "--set", "stop=32", "--set", "imu_rate=50")
    assert simulate_main(["drive", "--seed", "4", *part, *sensors, "--quiet", "--out", str(bag)]) == 0
    lines = ("ranges.use_point_solution: true", "mag.use: true", "mag.declination_deg: 4.0", "mag.error_std_deg: 10.0")
    result = replay(bag, "--mode", mode, config=with_parameters(tmp_path, *lines))
    # The rest comes before level, position and field are known.
    assert result["aids"]["mag"]["fused"] > 0.5 * result["aids"]["mag"]["offered"] > 100
    assert result["final"]["status"] == "GOOD"
