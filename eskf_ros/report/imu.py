"""Panels of the IMU: rate and holes, vibration and its spectrum, clipping."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from numpy.typing import NDArray

from eskf_ros.report.plots import AXIS_COLORS, BLACK, BLUE, ORANGE, RED, Panel, Plots, Section, add_hover, plain
from eskf_ros.report.read import Result

SPREAD = "Standard deviation within each second: vibration, and motion with it."


def imu_section(result: Result, plots: Plots) -> Section | None:
    """Return the panels; None for a result without details."""
    imu = result.table("imu")
    if not len(imu):
        return None
    section = Section("imu", "IMU")
    stamps = imu["stamp"] * 1e-9
    whole = slice(1, -1) if len(imu) > 4 else slice(None)
    plot = plots.over_time("Samples per second", "Hz")
    plots.curve(plot, stamps[whole], imu["count"][whole], BLUE, "samples in a second")
    section.panels.append(Panel(plot))
    plot = plots.over_time("Longest interval in each second", "ms", y_axis_type="log")
    plots.curve(plot, stamps, np.maximum(1e3 * imu["longest_interval"], 1e-3), ORANGE, "longest interval")
    section.panels.append(Panel(plot, "A peak is a hole: samples that were lost, or a driver that was late."))
    plot = plots.over_time("Vibration: spread of the force", "m/s2", y_axis_type="log")
    plots.curve(plot, stamps, np.maximum(imu["force_std"], 1e-5), BLUE, "specific force")
    section.panels.append(Panel(plot, SPREAD))
    plot = plots.over_time("Vibration: spread of the rate", "rad/s", y_axis_type="log")
    plots.curve(plot, stamps, np.maximum(imu["rate_std"], 1e-6), BLUE, "angular rate")
    section.panels.append(Panel(plot, SPREAD))
    frequency, density = result.details["frequency"], result.details["density"]
    if len(frequency):
        told = result.details["told_density"]
        for first, name, unit, wanted in (
            (0, "accelerometer", "m/s2/sqrt(Hz)", told[0]),
            (3, "gyro", "rad/s/sqrt(Hz)", told[1]),
        ):
            plot = _spectrum(f"Spectrum, {name}", unit, frequency, density[:, first : first + 3], float(wanted))
            section.panels.append(
                Panel(plot, "A peak is a vibration; the dashed line is the noise the filter is told.")
            )
    for name, unit, title in (
        ("largest_force", "m/s2", "Largest accelerometer reading"),
        ("largest_rate", "rad/s", "Largest gyro reading"),
    ):
        plot = plots.over_time(title, unit)
        plots.curve(plot, stamps, imu[name], BLUE, "largest of each second")
        clipped = imu["held"] > 0
        if clipped.any():
            plots.points(
                plot, stamps[clipped], imu[name][clipped], RED, "an axis held at its limit", marker="x", size=7
            )
        section.panels.append(Panel(plot, "Clipping: the curve stays at a ceiling, and samples are held there."))
    return section


def _spectrum(title: str, unit: str, frequency: NDArray[np.float64], density: NDArray[np.float64], told: float) -> Any:
    plot = plain(title, "Hz", unit, x_axis_type="log", y_axis_type="log")
    for axis, name in enumerate("xyz"):
        data = {"f": frequency.astype(np.float32), "y": np.maximum(density[:, axis], 1e-9).astype(np.float32)}
        source = ColumnDataSource(data)
        line = plot.line("f", "y", source=source, line_color=AXIS_COLORS[axis], line_width=1.3, legend_label=name)
        add_hover(plot, [line], [("", "@f{0.0} Hz"), (name, "@y{0.00000}")])
    ends = [float(frequency[0]), float(frequency[-1])]
    plot.line(ends, [told, told], line_color=BLACK, line_dash="dashed", legend_label="told to the filter")
    return plot
