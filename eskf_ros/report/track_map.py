"""The map: track, truth, fixes by their verdict, and ellipses that swell where no fix holds the estimate."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BoxZoomTool, ColumnDataSource, CustomJS, PanTool, ResetTool, SaveTool, WheelZoomTool
from bokeh.plotting import figure
from numpy.typing import NDArray

from eskf_ros.filter.state.enums import Status
from eskf_ros.report.plots import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SEQUENCE, SKY, Plots, add_hover, style
from eskf_ros.report.read import Result, Track
from eskf_ros.report.state import COLORS, outages
from eskf_ros.report.thinning import extremes

LOOKS = {
    "fused": ("fused", GREEN, "circle"),
    "weighed_down": ("weighed down", SKY, "circle"),
    "takeover": ("reset", PURPLE, "star"),
    "reset": ("reset", PURPLE, "star"),
    "gate": ("rejected", RED, "x"),
    "contradicted": ("rejected", RED, "x"),
    "withheld": ("withheld", ORANGE, "circle_cross"),
}
"""Label, colour and marker of a verdict; all others are `OTHER`."""
OTHER = ("not used", GREY, "square")
SAME_FIX = 1e-3
"""s; a fix and its record have the same stamp, but for the digits of a float."""
FARTHEST = 5.0
"""Fixes farther from the middle than this many extents of the track are left out: nobody has filled them in."""
ELLIPSES = 60
COASTING_COLOR = COLORS[Status.COASTING]


def track_map(result: Result, others: list[Track], plots: Plots) -> Any:
    """Return the figure."""
    plot = figure(
        title="Track in map",
        match_aspect=True,
        sizing_mode="stretch_both",
        min_height=320,
        tools=[BoxZoomTool(match_aspect=True), PanTool(), WheelZoomTool(zoom_on_axis=False), ResetTool(), SaveTool()],
        active_scroll=None,
        x_axis_label="east, m",
        y_axis_label="north, m",
        name="map",
    )
    style(plot)
    _draw_fixes(plot, result, plots)
    _draw_ellipses(plot, result)
    for track, color in zip(others, SEQUENCE[1:]):
        _draw_line(plot, track.position, color, track.name, line_width=1.5, line_dash="dashed")
    errors = result.table("errors")
    if len(errors):
        _draw_line(plot, errors["truth_map"], BLACK, "truth", line_width=1.2, line_dash=[6, 3])
    source = ColumnDataSource(_track_columns(result, plots), name="track")
    line = plot.line("x", "y", source=source, line_color=BLUE, line_width=2.2, legend_label="estimate")
    add_hover(
        plot,
        [line],
        [("t", "@t{0.0} s"), ("sigma", "@sigma{0.00} m"), ("speed", "@speed{0.0} m/s"), ("up", "@z{0.0} m")],
    )
    _draw_coasting(plot, result)
    marker = ColumnDataSource({"x": [float(source.data["x"][0])], "y": [float(source.data["y"][0])]}, name="marker")
    plot.scatter("x", "y", source=marker, size=14, fill_color=ORANGE, line_color=BLACK, line_width=1.5, name="here")
    code = "window.eskfReport && window.eskfReport.goToPlace(cb_obj.x, cb_obj.y)"
    plot.js_on_event("mousemove", CustomJS(code=code))
    return plot


def _track_columns(result: Result, plots: Plots) -> dict[str, NDArray[np.float32]]:
    """Return what the map, and the line of text beside its slider, show."""
    sigma = np.sqrt(result.position_covariance[:, 0] + result.position_covariance[:, 2])
    east, north, up = result.position.T
    rows = extremes([east, north, sigma], 1000)
    speed = np.linalg.norm(result.velocity[rows], axis=1)
    columns = {"x": east[rows], "y": north[rows], "z": up[rows], "sigma": sigma[rows], "speed": speed}
    found = {name: values.astype(np.float32) for name, values in columns.items()}
    return {"t": plots.seconds(result.stamp[rows]), **found}


def _draw_line(plot: Any, positions: NDArray[Any], color: str, label: str, **look: Any) -> None:
    rows = extremes([positions[:, 0], positions[:, 1]], 1000)
    source = ColumnDataSource({"x": positions[rows, 0].astype(np.float32), "y": positions[rows, 1].astype(np.float32)})
    plot.line("x", "y", source=source, line_color=color, legend_label=label, **look)


def _draw_coasting(plot: Any, result: Result) -> None:
    """Draw the parts of the track without an accepted position in the colour that COASTING has in the ladder."""
    for outage in outages(result):
        begin = result.stamp[0] + outage.start
        inside = (result.stamp >= begin) & (result.stamp <= begin + outage.length)
        if inside.any():
            _draw_line(plot, result.position[inside], COASTING_COLOR, "coasting", line_width=3.5)


def _draw_ellipses(plot: Any, result: Result) -> None:
    """Draw 3-sigma ellipses at equal steps of time, and where sigma is largest."""
    covariance = result.position_covariance
    rows = extremes([covariance[:, 0] + covariance[:, 2]], ELLIPSES)
    east, mixed, north = covariance[rows].T
    middle, half = 0.5 * (east + north), np.hypot(0.5 * (east - north), mixed)
    data = {
        "x": result.position[rows, 0],
        "y": result.position[rows, 1],
        "width": 6.0 * np.sqrt(middle + half),
        "height": 6.0 * np.sqrt(np.maximum(middle - half, 0.0)),
        "angle": 0.5 * np.arctan2(2.0 * mixed, east - north),
    }
    # Those of the alignment would cover the page, and hide all else.
    extent = max(float(np.ptp(result.position[:, :2], axis=0).max()), 1.0)
    fine = data["width"] < 2.0 * extent
    source = ColumnDataSource({name: values[fine].astype(np.float32) for name, values in data.items()})
    plot.ellipse(
        "x",
        "y",
        "width",
        "height",
        "angle",
        source=source,
        fill_color=BLUE,
        fill_alpha=0.10,
        line_color=BLUE,
        line_alpha=0.35,
        legend_label="3 sigma",
    )


def fix_verdicts(result: Result) -> NDArray[np.str_]:
    """Return the verdict of each row of `fixes`; `withheld` for one that was never offered."""
    fixes = result.table("fixes")
    records = result.aids[result.aids["aid"] == b"gnss_position"]
    records = records[np.argsort(records["stamp"], kind="stable")]
    found = np.full(len(fixes), "withheld", "U20")
    if len(records):
        stamps = fixes["stamp"] * 1e-9
        after = np.clip(np.searchsorted(records["stamp"], stamps), 0, len(records) - 1)
        for place in (np.maximum(after - 1, 0), after):
            same = np.abs(records["stamp"][place] - stamps) < SAME_FIX
            found[same] = np.char.decode(records["verdict"][place[same]], "ascii")
    return found


def _draw_fixes(plot: Any, result: Result, plots: Plots) -> None:
    fixes = result.table("fixes")
    if not len(fixes):
        return
    places = fixes["position_map"]
    extent = max(float(np.ptp(result.position[:, :2], axis=0).max()), 100.0)
    near = np.abs(places[:, :2] - result.position[:, :2].mean(axis=0)).max(axis=1) < FARTHEST * extent
    verdicts = fix_verdicts(result)
    looks = np.array([LOOKS.get(verdict, OTHER)[0] for verdict in verdicts.tolist()])
    for label, color, marker in dict.fromkeys([*LOOKS.values(), OTHER]):
        chosen = np.flatnonzero(near & (looks == label))
        if not len(chosen):
            continue
        east, north = places[chosen, 0], places[chosen, 1]
        kept = chosen[np.union1d(extremes([east], 400), extremes([north], 400))]
        source = ColumnDataSource(
            {
                "x": places[kept, 0].astype(np.float32),
                "y": places[kept, 1].astype(np.float32),
                "t": plots.seconds(fixes["stamp"][kept] * 1e-9),
                "verdict": verdicts[kept],
            }
        )
        big = label != "fused"
        drawn = plot.scatter(
            "x",
            "y",
            source=source,
            marker=marker,
            size=8 if big else 3,
            fill_color=color,
            fill_alpha=0.25 if big else 0.6,
            line_color=color,
            line_alpha=0.9 if big else 0.0,
            legend_label=f"fix {label}",
        )
        add_hover(plot, [drawn], [("fix at", "@t{0.00} s"), ("verdict", "@verdict")])
