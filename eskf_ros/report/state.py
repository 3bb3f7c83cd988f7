"""The state ladder, and the outages with what they ended in."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from eskf_ros.filter.state.enums import IS_USABLE, QUALITY_REASONS, Quality, Status
from eskf_ros.report.plots import BLACK, BLUE, GREEN, ORANGE, PURPLE, RED, SKY, YELLOW, Panel, Plots, Section, add_hover
from eskf_ros.report.read import Result

COLORS = {
    Status.LEVELLING: SKY,
    Status.WAITING_FIX: YELLOW,
    Status.WAITING_HEADING: ORANGE,
    Status.ALIGNING: BLUE,
    Status.GOOD: GREEN,
    Status.COASTING: PURPLE,
    Status.DEGRADED: RED,
    Status.FAULT: BLACK,
}


@dataclass(frozen=True)
class Outage:
    """A time without an accepted position: start and length (s of the page), way (m), and what it ended in.

    `sigma`: horizontal standard deviation at the end, m; `error`: against truth, m; `jump`: innovation of the first
    accepted position, m. NaN if unknown.
    """

    start: float
    length: float
    distance: float
    sigma: float
    error: float
    jump: float


def state_section(result: Result, plots: Plots) -> Section | None:
    """Return ladder and outages; None for a result without details."""
    states = result.table("states")
    if not len(states) or not len(result.stamp):
        return None
    starts = states["stamp"] * 1e-9
    ends = np.append(starts[1:], max(result.stamp[-1], starts[-1]))
    return Section(
        "state", "State and outages", _table(outages(result)), [Panel(_ladder(states, starts, ends, plots), wide=True)]
    )


def _ladder(states: NDArray[Any], starts: NDArray[Any], ends: NDArray[Any], plots: Plots) -> Any:
    names = [status.name for status in sorted(COLORS) if (states["status"] == status).any()]
    rungs = [*names, "usable"]
    plot = plots.over_time("State, and usable for navigation or not", "", 70 + 26 * len(rungs), y_range=rungs)
    plot.yaxis.axis_label = None
    rows: dict[str, list[Any]] = {name: [] for name in ("left", "right", "y", "color", "why")}
    for number, state in enumerate(states):
        status, quality = Status(int(state["status"])), Quality(int(state["quality"]))
        bars = [(status.name, COLORS.get(status, BLACK), status.name)] if status.name in names else []
        color = GREEN if quality in IS_USABLE else RED
        bars.append(("usable", color, f"{'yes' if quality in IS_USABLE else 'no'}: {QUALITY_REASONS[quality]}"))
        for y, paint, why in bars:
            values = (starts[number] - plots.zero, ends[number] - plots.zero, y, paint, why)
            for name, value in zip(rows, values):
                rows[name].append(value)
    source = ColumnDataSource(rows)
    bars = plot.hbar("y", 0.7, "right", left="left", source=source, fill_color="color", line_color=None)
    add_hover(plot, [bars], [("", "@why"), ("from", "@left{0.0} s"), ("to", "@right{0.0} s")])
    plot.legend.visible = False
    return plot


def outages(result: Result) -> list[Outage]:
    """Return the times of COASTING, as the state tells them."""
    states = result.table("states")
    if not len(states) or not len(result.stamp):
        return []
    stamps = states["stamp"] * 1e-9
    coasting = states["status"] == Status.COASTING
    borders = np.flatnonzero(np.diff(np.concatenate([[0], coasting.astype(int), [0]])))
    fixes = result.aids[np.isin(result.aids["aid"], (b"gnss_position", b"pseudorange"))]
    fixes = fixes[np.isin(fixes["verdict"], (b"fused", b"weighed_down", b"reset", b"takeover"))]
    errors = result.table("errors")
    zero = result.stamp[0]
    found = []
    for first, behind in borders.reshape(-1, 2).tolist():
        start = float(stamps[first])
        end = float(stamps[behind]) if behind < len(stamps) else float(result.stamp[-1])
        last = max(int(np.searchsorted(result.stamp, end)) - 1, 0)
        inside = slice(int(np.searchsorted(result.stamp, start)), last + 1)
        steps = np.linalg.norm(np.diff(result.position[inside], axis=0), axis=1)
        place = int(np.searchsorted(errors["stamp"] * 1e-9, end)) - 1 if len(errors) else -1
        after = fixes[np.abs(fixes["stamp"] - end) < 1.0]
        east, north = result.position_std[last, :2]
        found.append(
            Outage(
                start - zero,
                end - start,
                float(steps.sum()),
                float(np.hypot(east, north)),
                float(errors["horizontal"][place]) if place >= 0 else np.nan,
                float(np.linalg.norm(np.nan_to_num(after["innovation"][0]))) if len(after) else np.nan,
            )
        )
    return found


def _table(found: list[Outage]) -> str:
    if not found:
        return "<p>No outage: positions were accepted all the time.</p>"
    heads = ("from, s", "length, s", "driven, m", "sigma at the end, m", "error at the end, m", "first innovation, m")
    lines = []
    for outage in sorted(found, key=lambda one: -one.length)[:20]:
        values = (outage.start, outage.length, outage.distance, outage.sigma, outage.error, outage.jump)
        cells = "".join(f"<td>{'–' if np.isnan(value) else format(value, '.1f')}</td>" for value in values)
        lines.append(f"<tr>{cells}</tr>")
    more = f"<p>The 20 longest of {len(found)}.</p>" if len(found) > 20 else ""
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    body = "".join(lines)
    return (
        "<p>Times without an accepted position (COASTING), and what they ended in. The error should stay below two to "
        f"three sigma.</p><div class='scroll'><table><tr>{head}</tr>{body}</table></div>{more}"
    )
