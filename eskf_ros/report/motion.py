"""Panels of the estimate: position, velocity, attitude, biases, and their errors against truth."""

from __future__ import annotations

import numpy as np

from eskf_ros.report.plots import AXIS_COLORS, BLUE, GREY, ORANGE, PURPLE, RED, Panel, Plots, Section
from eskf_ros.report.read import Result

CHI_SQUARE_95 = 7.814727903251179
"""95 % quantile of chi-square with three degrees of freedom."""
BAND = "Bands are 3 sigma."


def motion_section(result: Result, plots: Plots) -> Section:
    """Return the estimate with its 3-sigma bands."""
    section = Section("motion", "Position, velocity, attitude, biases", f"<p>{BAND}</p>")
    stamps = result.stamp

    def three(title: str, unit: str, values, stds, names, factor: float = 1.0, times=stamps) -> None:  # type: ignore[no-untyped-def]
        plot = plots.over_time(title, unit)
        for axis, name in enumerate(names):
            plots.curve(
                plot, times, factor * values[:, axis], AXIS_COLORS[axis], name, band=3.0 * factor * stds[:, axis]
            )
        section.panels.append(Panel(plot))

    three("Position in map", "m", result.position, result.position_std, ("east", "north", "up"))
    plot = plots.over_time("Standard deviation of the position", "m", y_axis_type="log")
    for axis, name in enumerate(("east", "north", "up")):
        plots.curve(plot, stamps, np.maximum(result.position_std[:, axis], 1e-4), AXIS_COLORS[axis], name)
    section.panels.append(Panel(plot))
    three("Velocity in map", "m/s", result.velocity, result.velocity_std, ("east", "north", "up"))
    three("Roll and pitch", "deg", result.angles_deg, result.angles_std_deg, ("roll", "pitch"))
    plot = plots.over_time("Yaw (0 east, 90 north)", "deg")
    # More than all around is no more than unknown.
    band = np.minimum(3.0 * result.angles_std_deg[:, 2], 180.0)
    plots.curve(plot, stamps, result.angles_deg[:, 2], BLUE, "yaw", band=band)
    section.panels.append(Panel(plot))
    plot = plots.over_time("Standard deviation of the attitude", "deg", y_axis_type="log")
    for axis, name in enumerate(("about east", "about north", "about up")):
        plots.curve(plot, stamps, np.maximum(result.angles_std_deg[:, axis], 1e-4), AXIS_COLORS[axis], name)
    section.panels.append(Panel(plot))
    biases = result.table("biases")
    if len(biases):
        times, axes = biases["stamp"] * 1e-9, ("x", "y", "z")
        std = biases["accel_bias_std"]
        three("Accelerometer bias, IMU axes", "mm/s2", biases["accel_bias"], std, axes, 1e3, times)
        degrees = float(np.degrees(1.0))
        three("Gyro bias, IMU axes", "deg/s", biases["gyro_bias"], biases["gyro_bias_std"], axes, degrees, times)
    return section


def error_section(result: Result, plots: Plots) -> Section | None:
    """Return the errors against truth within the band that the filter claims; None without truth."""
    errors = result.table("errors")
    if not len(errors):
        return None
    text = (
        "<p>Estimate minus truth. The grey band is 3 sigma as the filter claims it: 99.7 % of the curve should lie in "
        "it. An error that leaves it for long is one that the filter does not know of.</p>"
    )
    section = Section("errors", "Errors against truth", text)
    times = errors["stamp"] * 1e-9
    for axis, name in enumerate(("east", "north", "up")):
        plot = plots.over_time(f"Position error, {name}", "m")
        band = 3.0 * errors["std_enu"][:, axis]
        plots.curve(plot, times, np.zeros(len(times)), GREY, band=band, around_zero=True, line_alpha=0.0)
        plots.curve(plot, times, errors["error_enu"][:, axis], AXIS_COLORS[axis], f"error {name}")
        section.panels.append(Panel(plot))
    if np.isfinite(errors["attitude_error_deg"]).any():
        for axis, name in enumerate(("about east", "about north", "about up (heading)")):
            plot = plots.over_time(f"Attitude error, {name}", "deg")
            fine = np.isfinite(errors["attitude_error_deg"][:, axis])
            band = 3.0 * errors["attitude_std_deg"][fine, axis]
            plots.curve(plot, times[fine], np.zeros(fine.sum()), GREY, band=band, around_zero=True, line_alpha=0.0)
            plots.curve(plot, times, errors["attitude_error_deg"][:, axis], AXIS_COLORS[axis], f"error {name}")
            section.panels.append(Panel(plot))
    if np.isfinite(errors["speed"]).any():
        plot = plots.over_time("Error of the speed", "m/s")
        plots.curve(plot, times, errors["speed"], PURPLE, "speed")
        section.panels.append(Panel(plot))
    plot = plots.over_time("NEES (ideal mean 3)", "", y_axis_type="log")
    for name, color in (("position", BLUE), ("attitude", ORANGE)):
        plots.curve(plot, times, np.maximum(errors[f"nees_{name}"], 1e-2), color, name)
    plots.curve(plot, times[[0, -1]], np.full(2, CHI_SQUARE_95), RED, "95 % of chi-square", line_dash="dashed")
    section.panels.append(
        Panel(plot, "The error weighted with its covariance. Above the red line in more than 5 %: too sure.")
    )
    return section
