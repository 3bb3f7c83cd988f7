"""The page: verdict, figures, tables and panels put together in one HTML file."""

from __future__ import annotations

from html import escape
from typing import Any

from bokeh.document import Document
from bokeh.embed import components
from bokeh.resources import Resources

from eskf_ros.report.compare import compare_section
from eskf_ros.report.imu import imu_section
from eskf_ros.report.measurements import measurement_section
from eskf_ros.report.motion import error_section, motion_section
from eskf_ros.report.plots import Plots, Section, wrap_legend
from eskf_ros.report.read import ReportError, Result, Track, in_map_of
from eskf_ros.report.satellites import satellite_section
from eskf_ros.report.state import outages, state_section
from eskf_ros.report.template import PAGE, SCRIPT, STYLE
from eskf_ros.report.timing import timing_section
from eskf_ros.report.track_map import track_map
from eskf_ros.report.verdict import BAD, CAUTION, GOOD, Finding, Verdict, verdict_of

SIGNS = {GOOD: "✓", CAUTION: "!", BAD: "✗"}


def page(tracks: list[Result | Track]) -> str:
    """Return the HTML of the report on the first result, with the others beside it. Raises ReportError."""
    main = tracks[0]
    if not isinstance(main, Result):
        raise ReportError(f"{main.name}: the first result has to be the folder of a replay, files come after it")
    others = [in_map_of(track, main) for track in tracks[1:]]
    others += [main.smoothed] if main.smoothed is not None else []
    _name_apart(main, others)
    figures: dict[str, Any] = {}
    sections: list[Section] = []
    verdict = verdict_of(main.summary, outages(main))
    if len(main.stamp):
        zero = float(main.stamp[0])
        plots = Plots(zero, max(float(main.stamp[-1]) - zero, 1.0))
        figures["map"] = track_map(main, others, plots)
        made = (
            compare_section(main, others, plots),
            error_section(main, plots),
            motion_section(main, plots),
            state_section(main, plots),
            measurement_section(main, plots),
            satellite_section(main, plots),
            imu_section(main, plots),
            timing_section(main, plots),
        )
        sections = [section for section in made if section is not None]
    figures |= {
        f"{section.name}_{number}": panel.figure for section in sections for number, panel in enumerate(section.panels)
    }
    for figure in figures.values():
        wrap_legend(figure)
    script, divs = _embedded(figures) if figures else ("", {})
    resources = Resources(mode="inline", components=["bokeh"])
    return PAGE.format(
        title=escape(f"{main.name}: navigation report"),
        style=STYLE,
        bokeh=resources.render_js() if figures else "",
        heading=_heading(main),
        verdict=_verdict(verdict),
        findings=f"<ul class='findings'>{''.join(map(_finding, verdict.findings))}</ul>",
        tiles=_tiles(main),
        aids=_aids(main.summary),
        notes=_notes(main),
        navigation="".join(f"<a href='#{section.name}'>{escape(section.title)}</a>" for section in sections),
        map=_map(divs["map"]) if figures else "<p>There is no track: no position was found.</p>",
        sections="".join(_section(section, divs) for section in sections),
        figures=script,
        script=SCRIPT,
    )


def _embedded(figures: dict[str, Any]) -> tuple[str, dict[str, str]]:
    """Return the script and the places of the figures.

    They share ranges and cursor. Added to a document one by one, each would search all of them again: half the time of
    a report.
    """
    document = Document()
    with document.models.freeze():
        for figure in figures.values():
            document.add_root(figure)
    script, divs = components(figures)
    return script, divs


def _name_apart(main: Result, others: list[Track]) -> None:
    """Give results of the same name that of the folder around them, too."""
    names = [track.name for track in (main, *others)]
    for track in (main, *others):
        if isinstance(track, Result) and names.count(track.name) > 1:
            track.name = f"{track.folder.resolve().parent.name}/{track.name}"


def _heading(main: Result) -> str:
    summary = main.summary
    facts = [f"{_duration(summary['duration_s'])} of recording", f"mode {summary['mode']}"]
    if summary["duration_s"] > 0.0:
        facts.append(f"IMU {summary['imu_count'] / summary['duration_s']:.0f} Hz")
    facts.append(f"at the end {summary['final']['status']}")
    return f"<h1>{escape(main.name)}</h1><p>{escape(' · '.join(facts))}</p>"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def _verdict(verdict: Verdict) -> str:
    return (
        f"<div class='verdict {verdict.level}'><span class='sign'>{SIGNS[verdict.level]}</span>"
        f"<strong>{escape(verdict.headline)}</strong></div>"
    )


def _finding(finding: Finding) -> str:
    remedy = f" <em>{escape(finding.remedy)}</em>" if finding.remedy else ""
    sign = f"<span class='sign'>{SIGNS[finding.level]}</span>"
    return f"<li class='{finding.level}'>{sign}<span>{escape(finding.text)}{remedy}</span></li>"


def _tiles(main: Result) -> str:
    """Return the key figures."""
    summary = main.summary
    tiles = [("usable for navigation", f"{summary['quality']['usable']:.0%}")]
    errors = summary.get("error") or {}
    if errors.get("horizontal"):
        tiles.append(("horizontal error, rms", f"{errors['horizontal']['rms']:.2f} m"))
        tiles.append(("horizontal error, 95 %", f"{errors['horizontal']['p95']:.2f} m"))
    if errors.get("heading_deg"):
        tiles.append(("heading error, rms", f"{errors['heading_deg']['rms']:.2f}°"))
    if len(main.stamp):
        east, north = main.position_std[-1, :2]
        tiles.append(("horizontal sigma at the end", f"{(east**2 + north**2) ** 0.5:.2f} m"))
    found = outages(main)
    if found:
        tiles.append(("longest outage", f"{max(outage.length for outage in found):.0f} s"))
    return "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in tiles)


def _aids(summary: dict[str, Any]) -> str:
    """Return the table of measurements."""
    heads = ("measurement", "offered", "fused", "refused", "late", "withheld", "mean NIS", "in 95 %", "why refused")
    fine = ("fused", "weighed_down", "reset", "takeover", "outside_history", "waiting")
    lines = []
    for name, aid in summary["aids"].items():
        why = _reasons({reason: count for reason, count in aid["verdicts"].items() if reason not in fine})
        cells = [name, *(_number(aid[key], "d") for key in ("offered", "fused", "rejected", "late", "withheld"))]
        cells += [_number(aid["nis_mean"], ".2f"), _number(aid["nis_in_95"], ".1%"), why]
        lines.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    imu = summary["imu"]
    refused = {why: count for why, count in imu.items() if why not in ("offered", "late") and count}
    used = imu["offered"] - imu["late"] - sum(refused.values())
    cells = ["imu", str(imu["offered"]), str(used), str(sum(refused.values())), str(imu["late"]), "–", "–", "–"]
    cells.append(_reasons(refused))
    lines.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    return f"<div class='scroll'><table><tr>{head}</tr>{''.join(lines)}</table></div>"


def _reasons(counts: dict[str, int]) -> str:
    """Return counts of reasons, with spaces at which a narrow column can be broken."""
    return ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in counts.items())


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _notes(main: Result) -> str:
    """Return what the page cannot show, and why."""
    notes = []
    if not main.details:
        notes.append("This result is of an older eskf_replay, without details.npz: replay again for all panels.")
    if main.details and not len(main.table("errors")):
        notes.append("No truth was given (--truth TOPIC): there are no errors to show.")
    if main.details and not len(main.table("signals")):
        notes.append("Satellites are shown where the result is made of ranges (--mode tight).")
    return "".join(f"<p class='note'>{escape(note)}</p>" for note in notes)


def _map(div: str) -> str:
    return (
        f"<div class='plot'>{div}</div><div class='player'><button id='play' aria-label='play'>▶</button>"
        "<input id='time' type='range' min='0' max='1000' value='0' aria-label='time'><output id='now'></output></div>"
    )


def _section(section: Section, divs: dict[str, str]) -> str:
    panels = "".join(
        f"<figure class='{'wide' if panel.wide else ''}'>{divs[f'{section.name}_{number}']}"
        f"{f'<figcaption>{escape(panel.caption)}</figcaption>' if panel.caption else ''}</figure>"
        for number, panel in enumerate(section.panels)
    )
    return (
        f"<section id='{section.name}'><h2>{escape(section.title)}</h2>{section.html}"
        f"<div class='panels'>{panels}</div></section>"
    )
