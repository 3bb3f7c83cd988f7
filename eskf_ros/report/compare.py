"""Several results side by side: how far they are apart, and from truth."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import NDArray

from eskf_ros.report.plots import BLUE, SEQUENCE, Panel, Plots, Section
from eskf_ros.report.read import Result, Track

LARGEST_GAP = 1.0
"""s; positions are not interpolated over a longer hole."""


def compare_section(main: Result, others: list[Track], plots: Plots) -> Section | None:
    """Return distances, errors and sigmas of all; None without others. `others` are in the map frame of `main`."""
    if not others:
        return None
    everything: list[Track] = [main, *others]
    apart = plots.over_time(f"Horizontal distance to {main.name}", "m", y_axis_type="log")
    errors = plots.over_time("Horizontal error against truth", "m", y_axis_type="log")
    sigmas = plots.over_time("Horizontal sigma as claimed", "m", y_axis_type="log")
    truth = main.table("errors")
    lines, without = [], []
    for track, color in zip(everything, (BLUE, *SEQUENCE[1:])):
        difference, common = difference_from(track, main)
        if not common.any():
            without.append(track.name)
        distance = np.hypot(difference[:, 0], difference[:, 1])
        if track is not main:
            plots.curve(apart, main.stamp, np.maximum(distance, 1e-4), color, track.name)
        error = np.full(len(truth), np.nan)
        if len(truth):
            error = horizontal_error(track, main)
            plots.curve(errors, truth["stamp"] * 1e-9, np.maximum(error, 1e-4), color, track.name)
        if isinstance(track, Result):
            sigma = np.sqrt(track.position_covariance[:, 0] + track.position_covariance[:, 2])
            plots.curve(sigmas, track.stamp, np.maximum(sigma, 1e-4), color, track.name)
        lines.append(_line(track, main, distance[common], error[np.isfinite(error)]))
    heads = ("result", "mode", "usable", "distance: rms, m", "largest, m", "error: rms, m", "95 %, m", "largest, m")
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    text = (
        "<p>All in the map frame of the first. A TUM file is taken to be base_link in that frame, on the clock of the "
        f"recording.</p><div class='scroll'><table><tr>{head}</tr>{''.join(lines)}</table></div>"
    )
    if without:
        text += f"<p class='bad'>No time in common with {escape(main.name)}: {escape(', '.join(without))}.</p>"
    panels = [Panel(apart)] if len(without) < len(others) else []
    panels += [Panel(errors)] if len(truth) else []
    return Section("compare", "Results side by side", text, [*panels, Panel(sigmas)])


def difference_from(track: Track, main: Result) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return position of the track minus that of `main` (n, 3), at the stamps of `main`, and where both are known."""
    return _at(track, main.stamp, main.position)


def horizontal_error(track: Track, main: Result) -> NDArray[np.float64]:
    """Return the horizontal error (n,) at the truth epochs of `main`: its own error plus the distance to it.

    So it is right, too, where the truth is the antenna.
    """
    errors = main.table("errors")
    stamps = errors["stamp"] * 1e-9
    own = np.stack([np.interp(stamps, main.stamp, main.position[:, axis]) for axis in range(3)], axis=1)
    difference, common = _at(track, stamps, own)
    error = difference[:, :2] + errors["error_enu"][:, :2]
    found = np.hypot(error[:, 0], error[:, 1])
    found[~common] = np.nan
    return found


def _at(
    track: Track, stamps: NDArray[np.float64], positions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the interpolated track minus positions (n, 3) at stamps (n,) s, and where it is known."""
    place = np.clip(np.searchsorted(track.stamp, stamps), 1, max(len(track.stamp) - 1, 1))
    if len(track.stamp) < 2:
        return np.full(positions.shape, np.nan), np.zeros(len(stamps), bool)
    gap = track.stamp[place] - track.stamp[place - 1]
    inside = (stamps >= track.stamp[0] - 1e-6) & (stamps <= track.stamp[-1] + 1e-6) & (gap <= LARGEST_GAP)
    there = np.stack([np.interp(stamps, track.stamp, track.position[:, axis]) for axis in range(3)], axis=1)
    difference = there - positions
    difference[~inside] = np.nan
    return difference, inside


def _line(track: Track, main: Result, distance: NDArray[np.float64], error: NDArray[np.float64]) -> str:
    summary = track.summary if isinstance(track, Result) else {}
    cells = [escape(track.name), escape(summary.get("mode", "trajectory"))]
    cells.append(f"{summary['quality']['usable']:.0%}" if summary else "–")
    is_main = track is main or not len(distance)
    cells += ["–", "–"] if is_main else [f"{np.sqrt(np.mean(distance**2)):.2f}", f"{distance.max():.2f}"]
    if len(error):
        cells += [f"{np.sqrt(np.mean(error**2)):.2f}", f"{np.percentile(error, 95.0):.2f}", f"{error.max():.2f}"]
    else:
        cells += ["–"] * 3
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
