"""Panels of latency and timing: when measurements came after their stamps, and where the replay spent its time."""

from __future__ import annotations

from html import escape

import numpy as np

from eskf_ros.report.plots import BLACK, SEQUENCE, Panel, Plots, Section
from eskf_ros.report.read import Result
from eskf_ros.report.thinning import strongest

CONSTRAINTS = (b"zupt", b"zaru", b"nhc")


def timing_section(result: Result, plots: Plots) -> Section:
    """Return latencies over time, with a table of them and of the stages of the replay."""
    plot = plots.over_time("Latency: recorded minus stamp", "ms")
    lines = []
    names = [name for name in result.summary["aids"] if name.encode() not in CONSTRAINTS]
    for name, color in zip(names, SEQUENCE):
        rows = result.aids[result.aids["aid"] == name.encode()]
        delay = 1e3 * (rows["arrival"] - rows["stamp"])
        if not len(rows) or not (rows["arrival"] > 0).any():
            continue
        chosen = strongest(delay, 400)
        plots.points(plot, rows["stamp"][chosen], delay[chosen], color, name, size=3, line_alpha=0.0)
        lines.append((name, *np.percentile(delay, [50.0, 95.0]), delay.max()))
    imu = result.table("imu")
    if len(imu):
        delay = 1e3 * imu["latency"]
        plots.curve(plot, imu["stamp"] * 1e-9, delay, BLACK, "imu, largest of a second")
        lines.append(("imu (largest of a second)", *np.percentile(delay, [50.0, 95.0]), delay.max()))
    head = "<tr><th>ms</th><th>median</th><th>95 %</th><th>largest</th></tr>"
    body = "".join(
        f"<tr><td>{escape(str(name))}</td>{''.join(f'<td>{value:.1f}</td>' for value in values)}</tr>"
        for name, *values in lines
    )
    summary = result.summary
    stages = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in summary["timing"].items())
    text = (
        f"<div class='scroll'><table>{head}{body}</table></div><p>Replayed {summary['duration_s']:.1f} s in "
        f"{summary['wall_s']:.2f} s, {summary['realtime_factor']:.0f} times real time ({escape(stages)}).</p>"
    )
    panels = [Panel(plot, "The stamp of a measurement contains its time offset.", wide=True)] if lines else []
    return Section("timing", "Latency and timing", text, panels)
