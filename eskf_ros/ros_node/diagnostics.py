"""The node's diagnostics: the status, what it waits for, faults, and what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.rows import SENSORS as ROWS_OF_SENSORS
from eskf_ros.filter.state.enums import STREAM_NAMES, Phase, Status, Stream, Verdict
from eskf_ros.filter.state.error_state import SOURCES
from eskf_ros.filter.state.time import SECOND
from eskf_ros.filter.tight.signal import name_of
from eskf_ros.gnss.signals import BEIDOU_3, Gnss
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.inputs.table import Input
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay import words
from eskf_ros.ros_node.clocks import StampMonitor, clock_complaints
from eskf_ros.ros_node.error_counter import Trouble
from eskf_ros.ros_node.extrinsics import Extrinsics
from eskf_ros.ros_node.messages import key_values
from eskf_ros.ros_node.publishers import Outputs
from eskf_ros.ros_node.subscriptions import AidInput

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
TRANSIENT_LOCAL, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE

SILENCE = 3.0
"""s; a topic without a message for longer is called silent."""

FEWEST_TO_SOLVE = 4
"""Satellites, at least, that determine a position by themselves."""

GROUP_NAMES = {**{int(gnss): gnss.name.lower() for gnss in Gnss}, BEIDOU_3: "beidou-3", int(Gnss.BEIDOU): "beidou-2"}
"""Names of the groups of `gnss.signals.time_group`."""

PHASE_LABELS = {
    Stream.GNSS_POSITION: "fixes",
    Stream.GNSS_VELOCITY: "velocities",
    Stream.PSEUDORANGE: "position by pseudoranges",
}
"""Names of streams whose phase is reported; other streams have their own name."""

SENSORS = (
    *((row.stream, 0) for row in ROWS_OF_SENSORS),
    *((stream, source) for stream in (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY) for source in range(SOURCES)),
)
"""Streams and sources (which receiver) whose phase is reported after their first measurement."""


@dataclass(frozen=True)
class Snapshot:
    """What the node reports of itself once a second."""

    graph: Node
    """The node, which knows who publishes and subscribes to what."""
    now: int
    """Time of the node's clock (ns)."""
    navigator: Navigator
    parameters: Parameters
    imu_monitor: StampMonitor
    aid_inputs: Sequence[AidInput]
    inputs: Sequence[tuple[Any, Input | None]]
    """Subscriptions, and the inputs that they are."""
    output_publishers: Sequence[Any]
    outputs: Outputs
    range_intake: RangeIntake | None
    position_stream: Stream
    """The stream that gives the position: fixes or pseudoranges."""
    latest_positions: Mapping[Verdict, int]
    """Verdicts of the last fixes or pseudoranges."""
    verdicts: Mapping[tuple[int, Verdict], int]
    """Final verdicts by stream since the start."""
    trouble: Trouble
    extrinsics: Extrinsics
    resets: int
    callbacks: int
    """Callbacks of the IMU since the last report."""
    callback_time: float
    """s; time spent in them."""
    longest_callback: float
    """s; the longest of them."""

    @property
    def monitors(self) -> list[StampMonitor]:
        """The stamp monitors of the inputs, that of the IMU first."""
        return [self.imu_monitor, *(monitor for source in self.aid_inputs for monitor in source.monitors)]


def status_report(seen: Snapshot, stamp: Time) -> DiagnosticArray:
    """Return one status: OK if the state is GOOD without faults, ERROR if nothing is published any more."""
    now = seen.now
    row = seen.navigator.odometry[0]
    status = Status(int(row["status"]))
    is_silent = status > Status.WAITING_IMU and bool(missing(seen, [seen.imu_monitor], now))
    if is_silent and status != Status.FAULT:
        # Nothing is published without the IMU, however good the estimate was.
        status = Status.WAITING_IMU
    of_ranges = [] if seen.range_intake is None else seen.range_intake.recent_complaints
    problems = [*seen.navigator.complaints, *of_ranges, *clock_complaints(seen.monitors, now)]
    problems += [*mismatches(seen), *second_publishers(seen), *seen.trouble.problems()]
    waiting = waiting_for(seen, status, row, now)
    level = DiagnosticStatus.OK if status == Status.GOOD and not problems else DiagnosticStatus.WARN
    if status == Status.FAULT or is_silent:
        level = DiagnosticStatus.ERROR
    report = DiagnosticArray()
    report.header.stamp = stamp
    report.status.append(
        DiagnosticStatus(
            level=level,
            name=f"{seen.graph.get_fully_qualified_name()}: navigation",
            hardware_id="eskf_ros",
            message="; ".join([status.name, *waiting, *problems]),
            values=key_values({**figures(seen, row), **ranges(seen), **counters(seen), **topics(seen, now)}),
        )
    )
    return report


def waiting_for(seen: Snapshot, status: Status, row: np.void, now: int) -> list[str]:
    """Return what keeps the status from the next one."""
    wanted_input = "gnss_fix" if seen.range_intake is None else "ranges"
    fixes = next(source for source in seen.aid_inputs if source.kind.name == wanted_input).monitors
    is_tight = seen.position_stream == Stream.PSEUDORANGE
    if status in (Status.WAITING_IMU, Status.LEVELLING):
        return missing(seen, [seen.imu_monitor], now) or ["standing still or driving steadily for a moment"]
    if status == Status.FAULT:
        return ["a reset: call the service ~/reset"]
    if status == Status.DEGRADED:
        return [f"{'ranges' if is_tight else 'fixes'} that agree with the estimate: see eskf/aids"]
    if status in (Status.WAITING_FIX, Status.COASTING):
        unaccepted = (
            "ranges come, but too few were accepted lately" if is_tight else "fixes come, but none was accepted lately"
        )
        return missing(seen, fixes, now) or held_by_few(seen, row) or [f"{unaccepted}{latest_verdicts(seen)}"]
    if status == Status.WAITING_HEADING:
        way = "speeding up, braking or turning tells the heading, a constant velocity does not"
        return missing(seen, fixes, now) or [way]
    if status == Status.ALIGNING:
        std, wanted = math.degrees(math.sqrt(row["pose_covariance"][5, 5])), seen.parameters.alignment
        wanted_std = wanted.good_heading_std_deg
        return [f"a heading to {wanted_std:g} deg, which is known to {std:.1f} deg: drive, speed up, brake, turn"]
    return []


def held_by_few(seen: Snapshot, row: np.void) -> list[str]:
    """Return a sentence if fewer satellites are fused than a position of their own needs."""
    epoch = seen.navigator.latest_epoch
    fused = epoch[np.isin(epoch["verdict"], (Verdict.FUSED, Verdict.WEIGHED_DOWN))]
    count = len({name_of(source).split()[0] for source in fused["source"].tolist()})
    if not 0 < count < FEWEST_TO_SOLVE or row["stamp"] - fused["stamp"][0] > SILENCE * SECOND:
        return []
    return [
        "1 satellite is fused: it and the IMU hold the position"
        if count == 1
        else f"{count} satellites are fused: they and the IMU hold the position"
    ]


def latest_verdicts(seen: Snapshot) -> str:
    """Return the verdicts of the fixes, or of the pseudoranges, of the last report that has some."""
    counts = seen.latest_positions
    told = ", ".join(f"{count} {verdict.name.lower()}" for verdict, count in sorted(counts.items()))
    return f" (the last: {told}): see eskf/aids" if told else ": see eskf/aids"


def missing(seen: Snapshot, monitors: Sequence[StampMonitor], now: int) -> list[str]:
    """Return a sentence if no message comes on a topic from any of the senders watched on it, with who could send."""
    silences = [silence for monitor in monitors if not math.isnan(silence := monitor.timing(now).silence)]
    if silences and min(silences) <= SILENCE:
        return []
    topic = monitors[0].topic
    publishers = seen.graph.count_publishers(topic)
    since = f"no message for {min(silences):.0f} s" if silences else "no message"
    return [f"{since} on {topic}; {publishers} publisher{'' if publishers == 1 else 's'}{elsewhere(seen, topic)}"]


def elsewhere(seen: Snapshot, topic: str) -> str:
    """Return other topics with messages of the type of an input, if nobody publishes on its own topic."""
    if seen.graph.count_publishers(topic):
        return ""
    kind = next(type_name(subscription.msg_type) for subscription, _ in seen.inputs if subscription.topic_name == topic)
    own = {subscription.topic_name for subscription, _ in seen.inputs}
    others = [
        name
        for name, types in seen.graph.get_topic_names_and_types()
        if kind in types and name not in own and seen.graph.count_publishers(name)
    ]
    return f" ({kind} is published on {', '.join(others[:3])})" if others else ""


def mismatches(seen: Snapshot) -> list[str]:
    """Return publishers and subscribers that cannot exchange messages with this node: type or quality of service."""
    found = []
    for subscription, kind in seen.inputs:
        wanted, expected = subscription.qos_profile, type_name(subscription.msg_type)
        for other in seen.graph.get_publishers_info_by_topic(subscription.topic_name):
            reason = ""
            if other.topic_type != expected:
                reason = f"sends {other.topic_type}, {expected} is expected"
                if kind is not None and other.topic_type in kind.types:
                    reason += f" unless topics.{kind.name}_type says otherwise"
            elif wanted.reliability == RELIABLE and other.qos_profile.reliability == BEST_EFFORT:
                reason = "is best effort, this node was told to ask for reliable (qos_overrides)"
            elif wanted.durability == TRANSIENT_LOCAL and other.qos_profile.durability == VOLATILE:
                reason = "is volatile, this node was told to ask for transient local (qos_overrides)"
            if reason:
                found.append(f"the publisher {node_name(other)} of {subscription.topic_name} {reason}")
    for publisher in seen.output_publishers:
        offered = publisher.qos_profile
        for other in seen.graph.get_subscriptions_info_by_topic(publisher.topic_name):
            reason = ""
            if other.qos_profile.reliability == RELIABLE and offered.reliability == BEST_EFFORT:
                reason = "asks for reliable, but is offered best effort (qos_overrides)"
            elif other.qos_profile.durability == TRANSIENT_LOCAL and offered.durability == VOLATILE:
                reason = "asks for transient local, but is offered volatile"
            if reason:
                found.append(f"the subscriber {node_name(other)} of {publisher.topic_name} {reason}")
    return found


def type_name(kind: Any) -> str:
    """Return the name of a message class, such as sensor_msgs/msg/Imu."""
    package, subfolder = kind.__module__.split(".")[:2]
    return f"{package}/{subfolder}/{kind.__name__}"


def node_name(endpoint: TopicEndpointInfo) -> str:
    """Return the name of the node at one end of a topic."""
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


def second_publishers(seen: Snapshot) -> list[str]:
    """Return a sentence if another node publishes the same transforms."""
    output = seen.outputs.transforms
    if output is None or not output.watch.strangers:
        return []
    own = seen.graph.get_fully_qualified_name()
    names = sorted({node_name(end) for end in seen.graph.get_publishers_info_by_topic("/tf")} - {own})
    return [
        f"the transform {', '.join(output.watch.strangers)} is published by another node too (publishers of /tf: "
        f"{', '.join(names) or own}): stop one of them, or set output.tf to map_to_odom or none"
    ]


def figures(seen: Snapshot, row: np.void) -> dict[str, object]:
    """Return uncertainty, biases, and counts of what was published."""
    return {
        **words.figures(row),
        "odometries published": seen.outputs.published,
        "restarts": seen.navigator.restarts,
        "position resets": seen.navigator.position_resets,
        "takeovers by the humble lane": seen.navigator.takeovers,
        "doubt about the IMU": f"{seen.navigator.doubt:.2f}",
        **phases(seen),
        "resets": seen.resets,
        "datum": seen.navigator.datum,
        "window needed (s)": seen.navigator.window_needed,
        "history (kB)": seen.navigator.held_bytes // 1024,
        "callback (ms)": f"{1e3 * seen.callback_time / max(1, seen.callbacks):.3f}",
        "longest callback (ms)": f"{1e3 * seen.longest_callback:.2f}",
        **{f"place of the {sensor}": seen.extrinsics.source_of(sensor) for sensor in seen.extrinsics.sensors},
    }


def phases(seen: Snapshot) -> dict[str, object]:
    """Return the phase of the streams of the first receiver, and of the other streams that had a measurement."""
    usual: tuple[Stream, ...] = (Stream.PSEUDORANGE,)
    if seen.position_stream != Stream.PSEUDORANGE:
        usual = (Stream.GNSS_POSITION, Stream.GNSS_VELOCITY)
    found = {(stream, 0): seen.navigator.phase(stream) for stream in usual}
    for stream, source in SENSORS:
        phase = seen.navigator.phase(stream, source)
        if phase != Phase.WAITING:
            found[stream, source] = phase
    return {
        PHASE_LABELS.get(stream, stream.name.lower().replace("_", " ")) + " of the second receiver" * source: phase.name
        for (stream, source), phase in found.items()
    }


def ranges(seen: Snapshot) -> dict[str, object]:
    """Return the receiver clock, and the counts of signals by status."""
    navigator, intake = seen.navigator, seen.range_intake
    if intake is None:
        return {}
    found: dict[str, object] = {"epochs of ranges": intake.epochs, "point solutions": intake.solved}
    found.update({f"signals {status.name.lower()}": n for status, n in sorted(navigator.range_statuses.items())})
    if seen.position_stream != Stream.PSEUDORANGE:
        return found
    if navigator.clock is not None:
        bias, drift = navigator.clock
        found.update({"clock bias (m)": f"{bias:.2f}", "clock drift (m/s)": f"{drift:.3f}"})
    for group, offset in navigator.inter_system_offsets.items():
        found[f"clock offset of {GROUP_NAMES[group]} (m)"] = f"{offset:.2f}"
    return {**found, "clock jumps (ms)": navigator.clock_jumps, "range faults": navigator.range_faults}


def counters(seen: Snapshot) -> dict[str, object]:
    """Return the counts of measurements by stream and final verdict, of IMU samples and of errors by kind."""
    found: dict[str, object] = {
        f"{STREAM_NAMES[stream]} {verdict.name.lower()}": count for (stream, verdict), count in seen.verdicts.items()
    }
    found.update({f"trouble: {kind}": count for kind, count in seen.trouble.counts.items()})
    found.update({f"imu {name}": count for name, count in seen.navigator.imu_counts.items()})
    found.update({f"note {number}": note for number, note in enumerate(seen.navigator.notes, 1)})
    found["clock steps"] = len(seen.navigator.clock_steps)
    return found


def topics(seen: Snapshot, now: int) -> dict[str, object]:
    """Return rate and delay of each input that had a message."""
    found: dict[str, object] = {}
    for monitor in seen.monitors:
        timing = monitor.timing(now)
        if not math.isnan(timing.silence):
            found[f"{monitor.label} rate (Hz)"] = f"{timing.rate:.1f}"
            found[f"{monitor.label} delay (s)"] = f"{timing.delay:.3f} +- {timing.spread:.3f}"
    return found
