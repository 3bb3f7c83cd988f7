"""Figures of one look: a common time axis, zoom that all share, points thinned so that extremes stay."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    CustomJS,
    HoverTool,
    Legend,
    PanTool,
    Range1d,
    ResetTool,
    SaveTool,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure
from numpy.typing import NDArray

from eskf_ros.report.thinning import extremes

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, YELLOW, BLACK, GREY = "#56B4E9", "#CC79A7", "#F0E442", "#000000", "#8A8F98"
"""The colours of Okabe and Ito (2008), told apart with every colour blindness; grey for what is not used."""
AXIS_COLORS = (BLUE, ORANGE, GREEN)
SEQUENCE = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY, BLACK, YELLOW)
INK, GRID = "#1f2933", "#e4e7eb"
INTERVALS = 600
"""A curve keeps the extremes of this many intervals: about two to a point of a wide screen."""
LEGEND_WIDTH, LEGEND_GLYPH = 48, 6
"""Letters in a row of a legend; letters as wide as the sign before a name."""
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif"


@dataclass
class Panel:
    """A figure with a sentence on how to read it; `wide`: over the whole width."""

    figure: Any
    caption: str = ""
    wide: bool = False


@dataclass
class Section:
    """Part of the page: panels and a piece of HTML before them."""

    name: str
    title: str
    html: str = ""
    panels: list[Panel] = field(default_factory=list)


class Plots:
    """Makes the figures over time of one page; `zero`: stamp (s) of its zero, `length`: s."""

    def __init__(self, zero: float, length: float) -> None:
        self.zero = zero
        self.time_range = Range1d(-0.01 * length, 1.01 * length, name="time")

    def over_time(self, title: str, unit: str, height: int = 230, **options: Any) -> Any:
        """Return an empty figure over the common time axis; `unit` stands at the vertical axis."""
        plot = figure(
            title=title,
            height=height,
            sizing_mode="stretch_width",
            x_range=self.time_range,
            tools=[
                BoxZoomTool(dimensions="width"),
                PanTool(),
                WheelZoomTool(dimensions="width"),
                ResetTool(),
                SaveTool(),
            ],
            active_scroll=None,
            y_axis_label=unit,
            **options,
        )
        style(plot)
        plot.xaxis.axis_label = "s"
        cursor = Span(dimension="height", line_color=INK, line_width=1, visible=False, name="cursor")
        plot.add_layout(cursor)
        plot.js_on_event("mousemove", CustomJS(code="window.eskfReport && window.eskfReport.goTo(cb_obj.x)"))
        return plot

    def seconds(self, stamps: NDArray[Any]) -> NDArray[np.float32]:
        """Return stamps (s) as seconds of the page."""
        return (stamps - self.zero).astype(np.float32)

    def curve(
        self,
        plot: Any,
        stamps: NDArray[Any],
        values: NDArray[Any],
        color: str,
        label: str = "",
        band: NDArray[Any] | None = None,
        around_zero: bool = False,
        **options: Any,
    ) -> None:
        """Draw values (n,) at stamps (s); `band` (n,): half width of a band around them, or around zero."""
        values = np.asarray(values, np.float64)
        fine = np.isfinite(values)
        stamps, values = stamps[fine], values[fine]
        if not len(values):
            return
        columns = [values]
        if band is not None:
            band = np.asarray(band, np.float64)[fine]
            columns.append(band)
        rows = extremes(columns, INTERVALS)
        data = {"t": self.seconds(stamps[rows]), "y": values[rows].astype(np.float32)}
        if band is not None:
            middle = 0.0 if around_zero else values[rows]
            data["low"], data["high"] = (
                (middle - band[rows]).astype(np.float32),
                (middle + band[rows]).astype(np.float32),
            )
        source = ColumnDataSource(data)
        if band is not None:
            plot.varea("t", "low", "high", source=source, fill_color=color, fill_alpha=0.18)
        named = {"legend_label": label} if label else {}
        line = plot.line("t", "y", source=source, line_color=color, line_width=1.5, **named, **options)
        add_hover(plot, [line], [("t", "@t{0.00} s"), (label or "value", "@y{0.0000}")])

    def points(
        self, plot: Any, stamps: NDArray[Any], values: NDArray[Any], color: str, label: str, **look: Any
    ) -> None:
        """Draw points (n,) without a choice: thin them before."""
        if not len(values):
            return
        source = ColumnDataSource({"t": self.seconds(stamps), "y": np.asarray(values).astype(np.float32)})
        look = {"size": 4, "marker": "circle", "fill_color": color, "line_color": color, **look}
        named = {"legend_label": label} if label else {}
        drawn = plot.scatter("t", "y", source=source, **named, **look)
        add_hover(plot, [drawn], [("t", "@t{0.00} s"), (label or "value", "@y{0.000}")])


def plain(title: str, x_label: str, y_label: str, height: int = 230, **options: Any) -> Any:
    """Return an empty figure with axes of its own."""
    plot = figure(
        title=title,
        height=height,
        sizing_mode="stretch_width",
        tools=[BoxZoomTool(), PanTool(), WheelZoomTool(), ResetTool(), SaveTool()],
        active_scroll=None,
        x_axis_label=x_label,
        y_axis_label=y_label,
        **options,
    )
    style(plot)
    return plot


def style(plot: Any) -> None:
    """Give a figure the look of the page; dragging zooms."""
    plot.toolbar.active_drag = plot.select_one(BoxZoomTool)
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.toolbar_location = "above"
    plot.outline_line_color = None
    plot.background_fill_color = plot.border_fill_color = "#ffffff"
    plot.min_border_right = 12
    plot.title.text_font = FONT
    plot.title.text_font_size = "13px"
    plot.title.text_color = INK
    plot.grid.grid_line_color = GRID
    for axis in plot.axis:
        axis.axis_label_text_font = axis.major_label_text_font = FONT
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = axis.major_label_text_font_size = "11px"
        axis.axis_label_standoff = 4
        axis.axis_line_color = axis.major_tick_line_color = "#9aa5b1"
        axis.minor_tick_line_color = None
        axis.axis_label_text_color = axis.major_label_text_color = "#3e4c59"
    plot.add_layout(
        Legend(
            orientation="horizontal",
            border_line_color=None,
            background_fill_alpha=0.0,
            label_text_font=FONT,
            label_text_font_size="11px",
            label_text_color=INK,
            click_policy="hide",
            padding=0,
            margin=2,
            spacing=8,
            glyph_width=14,
            glyph_height=14,
        ),
        "above",
    )


def wrap_legend(plot: Any) -> None:
    """Put the names of a long legend in columns, as many as a phone is wide."""
    for legend in plot.legend:
        widths = [len(item.label.value) + LEGEND_GLYPH for item in legend.items]
        if sum(widths) > LEGEND_WIDTH:
            legend.ncols = max(1, LEGEND_WIDTH // max(widths))


def add_hover(plot: Any, renderers: list[Any], tooltips: list[tuple[str, str]]) -> None:
    """Show these values beside the pointer over the glyphs."""
    plot.add_tools(HoverTool(renderers=renderers, tooltips=tooltips, mode="mouse", visible=False))
