"""`eskf_watch` of a running node: a small node that listens to its diagnostics."""

from __future__ import annotations

import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rich.console import Console
from rich.live import Live

from eskf_ros.watch.panels import dashboard
from eskf_ros.watch.recording import report_of
from eskf_ros.watch.seen import DIAGNOSTICS, QUALITY, Seen

REDRAWN = 0.25
"""s; time from one drawing to the next."""


def listen(name: str, once: bool) -> int:
    """Show a node, the one of this name or the first that reports, until Ctrl-C; ``once``: its next report only."""
    rclpy.init()
    node = rclpy.create_node("eskf_watch")
    seen, heard = Seen(name), [time.monotonic()]

    def note(status: DiagnosticStatus) -> None:
        seen.note(report_of(status, time.time()))
        heard[0] = time.monotonic()

    # Best effort fits every publisher.
    quality_of_service = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)

    def note_all(message: DiagnosticArray) -> None:
        was_known = bool(seen.reports)
        for status in message.status:
            note(status)
        if seen.reports and not was_known:
            # In the namespace of the node, which its first report tells.
            topic = f"{seen.node.rpartition('/')[0]}/{QUALITY}"
            node.create_subscription(DiagnosticStatus, topic, note, quality_of_service)

    node.create_subscription(DiagnosticArray, DIAGNOSTICS, note_all, quality_of_service)
    waiting_for = f"{DIAGNOSTICS} of {name or 'a node'}"
    console = Console()
    try:
        if once:
            while not (seen.reports and seen.quality):
                rclpy.spin_once(node, timeout_sec=REDRAWN)
            console.print(dashboard(seen, waiting_for))
            return 0
        with Live(dashboard(seen, waiting_for), console=console, auto_refresh=False) as screen:
            while rclpy.ok():
                rclpy.spin_once(node, timeout_sec=REDRAWN)
                screen.update(dashboard(seen, waiting_for, time.monotonic() - heard[0]), refresh=True)
        return 0
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
