"""Panels of the measurements: innovations with their gates, NIS against chi-square, for each kind of measurement."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Range1d
from numpy.typing import NDArray

from eskf_ros.filter.state.enums import STREAM_NAMES
from eskf_ros.report.plots import AXIS_COLORS, BLACK, GREEN, GREY, PURPLE, RED, SKY, Panel, Plots, Section, plain
from eskf_ros.report.read import Result
from eskf_ros.report.thinning import strongest

CHI_SQUARE_95 = (math.nan, 3.841458820694124, 5.991464547107979, 7.814727903251179)
"""95 % quantile of chi-square by degrees of freedom."""
USED = (b"fused", b"weighed_down", b"takeover", b"reset")
AXES = {
    "gnss_position": (("east", "north", "up"), "m"),
    "gnss_velocity": (("east", "north", "up"), "m/s"),
    "wheel": (("speed", "yaw rate", ""), "m/s, rad/s"),
    "heading": (("yaw", "pitch", ""), "rad"),
    "mag": (("heading", "", ""), "rad"),
    "baro": (("height", "", ""), "m"),
    "pseudorange": (("range", "", ""), "m"),
    "range_rate": (("range rate", "", ""), "m/s"),
    "body_velocity": (("x", "y", "z"), "m/s"),
    "zupt": (("x", "y", "z"), "m/s"),
    "zaru": (("x", "y", "z"), "rad/s"),
    "nhc": (("sideways", "upwards", ""), "m/s"),
}
"""Names and unit of the innovations of each kind."""
POINTS = 500
"""Intervals of which the extreme points are drawn."""
FEWEST_FOR_HISTOGRAM = 30


def measurement_section(result: Result, plots: Plots) -> Section:
    """Return innovations, NIS and its distribution for each kind of measurement that was tested."""
    text = (
        "<p>An innovation is what a measurement says minus what the filter expected. The gate is the length that would "
        "just have been refused in the direction of the innovation. NIS is the squared innovation weighted with its "
        "covariance: its histogram should follow the curve of chi-square. To the right of it: covariances too small, "
        "or something systematic. To the left: too cautious.</p>"
    )
    section = Section("measurements", "Measurements: innovations, gates, NIS", text)
    for name in result.summary["aids"]:
        rows = result.aids[(result.aids["aid"] == name.encode()) & np.isfinite(result.aids["nis"])]
        rows = rows[rows["dof"] > 0]
        if not len(rows):
            continue
        gate = _gate(result, name, rows)
        section.panels.append(Panel(_innovations(name, rows, gate, plots)))
        section.panels.append(Panel(_nis(name, rows, gate, plots)))
        if len(rows) >= FEWEST_FOR_HISTOGRAM:
            section.panels.append(_histogram(name, rows))
    return section


def _gate(result: Result, name: str, rows: NDArray[Any]) -> NDArray[np.float64]:
    """Return the largest NIS that was accepted, for each row; NaN if the result does not tell."""
    gates = result.details.get("gates")
    if gates is None:
        return np.full(len(rows), math.nan)
    return np.asarray(gates[STREAM_NAMES.index(name)][rows["dof"]], float)


def _innovations(name: str, rows: NDArray[Any], gate: NDArray[np.float64], plots: Plots) -> Any:
    axes, unit = AXES[name]
    plot = plots.over_time(f"{name}: innovations", unit)
    length = np.linalg.norm(np.nan_to_num(rows["innovation"]), axis=1)
    refused = ~np.isin(rows["verdict"], USED)
    chosen = np.union1d(strongest(length, POINTS), np.flatnonzero(refused)[strongest(length[refused], POINTS)])
    with np.errstate(divide="ignore", invalid="ignore"):
        # e' S^-1 e is the NIS: along e the gate lies at sqrt(gate / NIS) times its length.
        bound = (length * np.sqrt(gate / rows["nis"]))[chosen]
    # A length of metres per second and radians per second together means nothing.
    has_length = "," not in unit or rows["dof"].max() == 1
    for sign, label in ((1.0, "gate"), (-1.0, "")) if has_length else ():
        plots.points(plot, rows["stamp"][chosen], sign * bound, GREY, label, marker="dash", size=5, line_alpha=0.6)
    for axis in range(int(rows["dof"].max())):
        values = rows["innovation"][chosen, axis]
        plots.points(plot, rows["stamp"][chosen], values, AXIS_COLORS[axis], axes[axis], size=3, line_alpha=0.0)
    # The gate is kilometres wide at the start, and must not press the innovations flat.
    usual = np.nanmedian(bound) if np.isfinite(bound).any() else 0.0
    half = max(1.15 * float(length[chosen].max()), 1.3 * float(usual), 1e-9)
    plot.y_range = Range1d(-half, half)
    shown = chosen[refused[chosen]]
    if len(shown):
        worst = np.argmax(np.abs(np.nan_to_num(rows["innovation"][shown])), axis=1)
        values = rows["innovation"][shown, worst]
        plots.points(plot, rows["stamp"][shown], values, RED, "refused", marker="x", size=7)
    return plot


def _nis(name: str, rows: NDArray[Any], gate: NDArray[np.float64], plots: Plots) -> Any:
    plot = plots.over_time(f"{name}: NIS by verdict", "", y_axis_type="log")
    nis, verdict = np.maximum(rows["nis"], 1e-3), rows["verdict"]
    groups = (
        ("fused", verdict == b"fused", GREEN, "circle", 3),
        ("weighed down", verdict == b"weighed_down", SKY, "circle", 5),
        ("reset", np.isin(verdict, (b"reset", b"takeover")), PURPLE, "star", 9),
        ("refused", ~np.isin(verdict, USED), RED, "x", 7),
    )
    for label, mask, color, marker, size in groups:
        group = np.flatnonzero(mask)
        if len(group):
            chosen = group[strongest(nis[group], POINTS)]
            plots.points(plot, rows["stamp"][chosen], nis[chosen], color, label, marker=marker, size=size)
    ends = rows["stamp"][[0, -1]]
    dof = int(np.bincount(rows["dof"]).argmax())
    plots.curve(plot, ends, np.full(2, CHI_SQUARE_95[dof]), GREY, "95 %", line_dash="dashed")
    if np.isfinite(gate[0]):
        plots.curve(plot, ends, np.full(2, float(gate[rows["dof"] == dof][0])), BLACK, "gate")
    return plot


def _histogram(name: str, rows: NDArray[Any]) -> Panel:
    dof = int(np.bincount(rows["dof"]).argmax())
    nis = rows["nis"][rows["dof"] == dof]
    inside = float(np.mean(nis <= CHI_SQUARE_95[dof]))
    plot = plain(f"{name}: NIS and chi-square", "NIS", "share per unit")
    edges = np.linspace(0.0, 16.0, 49)
    counts, _ = np.histogram(nis, edges)
    density = counts / (len(nis) * (edges[1] - edges[0]))
    source = ColumnDataSource({"left": edges[:-1], "right": edges[1:], "top": density})
    plot.quad("left", "right", "top", 0, source=source, fill_color=SKY, line_color="#ffffff", legend_label="measured")
    values = np.linspace(0.02 if dof > 1 else 0.15, 16.0, 200)
    plot.line(values, chi_square_density(values, dof), line_color=RED, line_width=2, legend_label="chi-square")
    return Panel(plot, f"Mean NIS {nis.mean():.2f} (ideal {dof}); {inside:.1%} in 95 %.")


def chi_square_density(values: NDArray[np.float64], dof: int) -> NDArray[np.float64]:
    """Return the density of chi-square with `dof` degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001, 1.4.17)."""
    half = 0.5 * dof
    return values ** (half - 1.0) * np.exp(-0.5 * values) / (2.0**half * math.gamma(half))
