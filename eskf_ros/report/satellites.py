"""Panels of the satellites, where the result was made of their signals."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from eskf_ros.report.plots import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Panel,
    Plots,
    Section,
    add_hover,
    plain,
)
from eskf_ros.report.read import Result
from eskf_ros.report.thinning import extremes, strongest

CONSTELLATIONS = {
    "G": ("GPS", BLUE),
    "R": ("GLONASS", RED),
    "E": ("Galileo", ORANGE),
    "C": ("BeiDou", GREEN),
    "J": ("QZSS", PURPLE),
    "S": ("SBAS", SKY),
    "I": ("NavIC", BLACK),
}
"""Name and colour by the RINEX letter."""
SIGNAL_POINTS = 120
"""Intervals of which the extremes of one signal are drawn."""

LONGEST_LINE = 10.0
"""s; the points of a signal are joined over this time."""


def satellite_section(result: Result, plots: Plots) -> Section | None:
    """Return sky, C/N0, number of satellites and residuals; None without signals."""
    signals = result.table("signals")
    ranges = result.aids[np.isin(result.aids["aid"], (b"pseudorange", b"range_rate"))]
    if not len(signals):
        return None
    section = Section("satellites", "Satellites")
    section.panels.append(Panel(_sky(signals, plots), "North is up, the horizon outside. Size: C/N0."))
    plot = plots.over_time("C/N0 by signal", "dB-Hz", 300)
    for name, rows, label, color in _by_signal(signals["name"]):
        chosen = rows[extremes([signals["cn0"][rows].astype(float)], SIGNAL_POINTS)]
        _line(plot, plots, signals["stamp"][chosen] * 1e-9, signals["cn0"][chosen], color, label, name)
    section.panels.append(Panel(plot))
    plot = plots.over_time("Satellites", "", 300)
    epochs, counts = np.unique(signals["stamp"], return_counts=True)
    plots.curve(plot, epochs * 1e-9, counts, GREY, "signals received")
    codes = ranges[ranges["aid"] == b"pseudorange"]
    if len(codes):
        used, place = np.unique(codes["stamp"], return_inverse=True)
        counts = np.bincount(place, np.isin(codes["verdict"], (b"fused", b"weighed_down")))
        plots.curve(plot, used, counts, BLUE, "pseudoranges used")
        plots.curve(plot, used[[0, -1]], np.full(2, 4.0), RED, "four", line_dash="dashed")
    section.panels.append(Panel(plot, "Below four satellites a receiver alone has no position; the filter goes on."))
    for aid, title, unit in (
        ("pseudorange", "Residuals of the pseudoranges", "m"),
        ("range_rate", "Residuals of the range rates", "m/s"),
    ):
        rows = ranges[(ranges["aid"] == aid.encode()) & np.isfinite(ranges["innovation"][:, 0])]
        if len(rows):
            section.panels.append(Panel(_residuals(rows, title, unit, plots), wide=True))
    return section


def _by_signal(names: NDArray[np.bytes_]) -> list[tuple[str, NDArray[np.intp], str, str]]:
    """Return name, rows, constellation and colour of each signal."""
    found = []
    for name in np.unique(names):
        text = name.decode("ascii")
        label, color = CONSTELLATIONS.get(text[:1], ("other", GREY))
        found.append((text, np.flatnonzero(names == name), label, color))
    return sorted(found, key=lambda one: one[2])


def _line(plot: Any, plots: Plots, stamps: Any, values: Any, color: str, label: str, name: str) -> None:
    # A line does not go on through a time without signals.
    holes = np.flatnonzero(np.diff(stamps) > LONGEST_LINE) + 1
    stamps, values = np.insert(stamps, holes, stamps[holes]), np.insert(values, holes, np.nan)
    data = {"t": plots.seconds(stamps), "y": values.astype(np.float32), "name": [name] * len(values)}
    drawn = plot.line("t", "y", source=ColumnDataSource(data), line_color=color, line_alpha=0.7, legend_label=label)
    add_hover(plot, [drawn], [("", "@name"), ("t", "@t{0.0} s"), ("value", "@y{0.0}")])


def _sky(signals: NDArray[Any], plots: Plots) -> Any:
    plot = plain("Sky", "", "", 300, match_aspect=True)
    plot.axis.visible = False
    plot.grid.visible = False
    for elevation in (0, 30, 60):
        ring = (90 - elevation) / 90
        plot.ellipse(0, 0, 2 * ring, 2 * ring, fill_color=None, line_color="#c4cad1")
        plot.text([0.01], [ring - 0.07], [f"{elevation}°"], text_font_size="10px", text_color="#7b8794")
    for letter, angle in (("N", 90), ("E", 0), ("S", 270), ("W", 180)):
        x, y = 1.07 * np.cos(np.radians(angle)), 1.07 * np.sin(np.radians(angle))
        plot.text([x], [y], [letter], text_align="center", text_baseline="middle", text_font_size="11px")
    satellites = np.array([name[:3] for name in signals["name"].tolist()])
    for name, rows, label, color in _by_signal(satellites):
        rows = rows[:: max(1, len(rows) // 60)]
        radius = np.maximum(90.0 - signals["elevation_deg"][rows], 0.0) / 90.0
        azimuth = np.radians(signals["azimuth_deg"][rows])
        cn0 = np.nan_to_num(signals["cn0"][rows], nan=35.0)
        data = {
            "x": (radius * np.sin(azimuth)).astype(np.float32),
            "y": (radius * np.cos(azimuth)).astype(np.float32),
            "size": np.clip(0.45 * (cn0 - 20.0), 3.0, 14.0).astype(np.float32),
            "cn0": cn0,
            "name": [name] * len(rows),
        }
        source = ColumnDataSource(data)
        drawn = plot.scatter(
            "x", "y", size="size", source=source, fill_color=color, fill_alpha=0.5, line_color=None, legend_label=label
        )
        add_hover(plot, [drawn], [("", "@name"), ("C/N0", "@cn0{0.0}")])
        end = {"x": data["x"][-1:], "y": data["y"][-1:], "name": [name]}
        plot.text("x", "y", "name", source=ColumnDataSource(end), text_font_size="10px", x_offset=6, y_offset=-4)
    return plot


def _residuals(rows: NDArray[Any], title: str, unit: str, plots: Plots) -> Any:
    plot = plots.over_time(title, unit, 260)
    refused = ~np.isin(rows["verdict"], (b"fused", b"weighed_down"))
    values = rows["innovation"][:, 0]
    for name, group, label, color in _by_signal(rows["source"]):
        chosen = group[strongest(np.abs(values[group]), SIGNAL_POINTS)]
        data = {
            "t": plots.seconds(rows["stamp"][chosen]),
            "y": values[chosen].astype(np.float32),
            "name": [name] * len(chosen),
        }
        drawn = plot.scatter(
            "t", "y", source=ColumnDataSource(data), size=3, color=color, alpha=0.6, legend_label=label
        )
        add_hover(plot, [drawn], [("", "@name"), ("t", "@t{0.0} s"), ("residual", "@y{0.00}")])
    bad = np.flatnonzero(refused)
    if len(bad):
        chosen = bad[strongest(np.abs(values[bad]), 400)]
        plots.points(plot, rows["stamp"][chosen], values[chosen], BLACK, "refused", marker="x", size=7)
    return plot
