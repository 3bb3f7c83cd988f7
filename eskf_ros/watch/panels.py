"""The dashboard, drawn with rich."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from eskf_ros.watch.seen import LEVELS, Seen

COLOURS = ("green", "yellow", "red", "red")
"""By level; the words say the same."""

LADDER = ("WAITING_IMU", "LEVELLING", "WAITING_FIX", "WAITING_HEADING", "ALIGNING", "GOOD")
BARS = "▁▂▃▄▅▆▇█"
FIGURES = ("position std (m)", "velocity std (m/s)", "heading std (deg)")
BIASES = ("accelerometer bias (m/s2)", "gyro bias (rad/s)")
COUNTERS = ("restarts", "position resets", "takeovers by the humble lane", "doubt about the IMU", "datum")


def dashboard(seen: Seen, waiting_for: str = "", age: float = 0.0) -> RenderableType:
    """Return the whole screen. ``age``: time since the last report (s); ``waiting_for`` is said before the first."""
    if not seen.reports:
        return Panel(Text(f"waiting for {waiting_for}"), title="eskf_watch", border_style="yellow")
    tables = [_figures(seen), _aids(seen)]
    tables += [_inputs(seen)] if seen.inputs() else []
    return Group(_state(seen, age), Columns(tables, padding=(0, 3)))


def _state(seen: Seen, age: float) -> Panel:
    level = seen.reports[-1].level
    ladder = Text(" › ").join(
        Text(name, style=f"bold {COLOURS[level]}" if name == seen.state else "dim") for name in LADDER
    )
    if seen.state not in LADDER:
        ladder = Text(seen.state, style=f"bold {COLOURS[level]}")
    lines = [ladder]
    if seen.quality is not None:
        usable = seen.quality.values.get("usable", "")
        word = "usable for navigation: " + usable
        lines.append(Text(f"{word} ({seen.quality.message})", style=COLOURS[seen.quality.level]))
    lines += [Text(f"• {sentence}", style=COLOURS[max(1, level)]) for sentence in seen.sentences]
    if age > 3.0:
        lines.append(Text(f"no report for {age:.0f} s", style="bold red"))
    return Panel(Group(*lines), title=f"{seen.node}  {LEVELS[level]}", border_style=COLOURS[level], title_align="left")


def _table(*headings: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column(headings[0], no_wrap=True)
    for heading in headings[1:]:
        table.add_column(heading, justify="right")
    return table


def _figures(seen: Seen) -> Table:
    table = _table("estimate", "now", "last minute")
    for key in FIGURES:
        table.add_row(key, seen.value(key), sparkline(seen.course(key)))
    for key in (*BIASES, *COUNTERS):
        if seen.value(key):
            table.add_row(key, seen.value(key), "")
    return table


def _aids(seen: Seen) -> Table:
    table = _table("sensor", "fused", "1/s", "refused", "1/s", "why")
    for name, counts, rates in seen.aids():
        fused = {verdict for verdict in counts if verdict in ("fused", "weighed_down", "reset")}
        refused = {verdict: count for verdict, count in counts.items() if verdict not in fused}
        why = ", ".join(f"{count} {verdict}" for verdict, count in sorted(refused.items(), key=lambda item: -item[1]))
        lost = sum(rates.get(verdict, 0.0) for verdict in refused)
        table.add_row(
            name,
            str(sum(counts[verdict] for verdict in fused)),
            f"{sum(rates.get(verdict, 0.0) for verdict in fused):.1f}",
            str(sum(refused.values())),
            Text(f"{lost:.1f}", style="yellow" if lost > 0.0 else ""),
            why,
        )
    return table


def _inputs(seen: Seen) -> Table:
    table = _table("input", "Hz", "delay (s)")
    for row in seen.inputs():
        table.add_row(*row)
    return table


def sparkline(values: Sequence[float], width: int = 24) -> str:
    """Return the course of values as bars, the newest on the right; the highest bar is the largest of them."""
    shown = list(values)[-width:]
    largest = max(shown, default=0.0)
    if largest <= 0.0:
        return ""
    return "".join(BARS[min(len(BARS) - 1, int(len(BARS) * value / largest))] for value in shown)
