"""The ROS node: turns messages into calls of the `Navigator`, and its rows into messages. No navigation here.

Over 400 lines: a ROS node is one class; what does not need its handles is in the files beside it.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from eskf_ros.bags.messages import UNCARRIED
from eskf_ros.compiled import sentence_on_compiling, while_compiling
from eskf_ros.filter.navigator import ORIENTATION_SHARE, Navigator
from eskf_ros.filter.state.enums import STREAM_NAMES, Status, Stream, Verdict
from eskf_ros.filter.state.time import SECOND
from eskf_ros.gnss.rinex import RinexError
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.inputs.table import Input, uses_ranges
from eskf_ros.parameters.schema import ParameterError
from eskf_ros.parameters.tree import Parameters
from eskf_ros.ros_node import robot_localization, transforms
from eskf_ros.ros_node.cdr import ImuReader, ImuSample, imu_from_message
from eskf_ros.ros_node.clocks import Stamp, StampMonitor
from eskf_ros.ros_node.declare import LiveParameters, declare, unused_overrides
from eskf_ros.ros_node.diagnostics import Snapshot, status_report
from eskf_ros.ros_node.error_counter import Trouble
from eskf_ros.ros_node.extrinsics import IMU, Extrinsics, place_of
from eskf_ros.ros_node.memory import WarmStart
from eskf_ros.ros_node.messages import bias_message, fix_message, quality_message, record_statuses, solution_message
from eskf_ros.ros_node.publishers import OUTPUT_QOS, OVERRIDING, Outputs
from eskf_ros.ros_node.set_pose import set_pose
from eskf_ros.ros_node.subscriptions import AidInput, open_inputs
from eskf_ros.ros_node.warm_up import compile_node
from eskf_ros.smooth.fixed_lag import FixedLag

INPUT_DEPTH = 1000
"""IMU messages that may wait while the computer is busy elsewhere: a second of a fast IMU."""

REPORT_PERIOD = 1.0
"""s; time from one report to the next."""

WATCH_EVERY = 10
"""Reports from one check for a second publisher of our transforms to the next."""


class EskfNode(Node):
    """Subscribes to IMU and other sensors; publishes odometry for every IMU sample, diagnostics once a second.

    A message that cannot be used is counted and named in the diagnostics; it never ends the node.
    """

    def __init__(self, context: Context | None = None, profile: str = "") -> None:
        """Open all that the node needs; ``profile`` names the one whose parameters are below those that are given.

        Over 60 lines: everything that a node opens, in the order that ROS needs.
        """
        super().__init__("eskf_node", context=context)
        self.parameters = declare(self, profile=profile)
        lag = self.parameters.smoother.lag
        self.navigator = Navigator(self.parameters, keeps_log=lag > 0.0)
        self.fixed_lag = FixedLag(self.navigator, lag) if lag > 0.0 else None
        self.trouble = Trouble(self.get_logger().error)
        self.verdicts: dict[tuple[int, Verdict], int] = {}
        self.resets = 0
        is_tight = self.parameters.mode == "tight"
        self.position_stream = Stream.PSEUDORANGE if is_tight else Stream.GNSS_POSITION
        self.latest_positions: dict[Verdict, int] = {}
        self._noted: set[str] = set()
        self.callbacks, self.callback_time, self.longest_callback = 0, 0.0, 0.0
        self._restarts = 0
        self.extrinsics = Extrinsics(self.parameters)
        self._frames_met: set[tuple[str, str]] = set()
        self._imu_frames_met: set[bytes] = set()
        self._imu_frame = ""
        self._first_stamp = 0
        self._last_quality = -1
        self._clock_steps = 0
        self._is_judging = False
        self._is_simulated = bool(self.get_parameter("use_sim_time").value)
        self._reports = 0
        self._warm_start = WarmStart(self.parameters.warm_start, self.get_logger())
        self._compile()
        self._live = LiveParameters(self, self.parameters, self._configure)

        self.outputs = Outputs(self, self.parameters, self.trouble.note)
        self._filtered = self._publisher(NavSatFix, "gps/filtered")
        self._bias = self._publisher(TwistWithCovarianceStamped, "imu/bias")
        self._aids = self._publisher(DiagnosticArray, "eskf/aids")
        self._quality = self._publisher(DiagnosticStatus, "eskf/quality")
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics")
        self.output_publishers: tuple[Any, ...] = (
            *self.outputs.publishers,
            self._filtered,
            self._bias,
            self._aids,
            self._quality,
            self._diagnostics,
        )

        self._imu_reader = ImuReader()
        topics = self.parameters.topics
        self.imu_monitor = StampMonitor(self.resolve_topic_name(topics.imu), self.parameters.history.window)
        self.aid_inputs = open_inputs(self.parameters, self.resolve_topic_name)
        self.range_intake = self._open_ranges()
        self.inputs: list[tuple[Any, Input | None]] = []
        self._subscribe(Imu, topics.imu, input_qos(INPUT_DEPTH), self._on_imu, "imu")
        for source in self.aid_inputs:
            callback = partial(self._on_aid, source, source.kind.push_of(self.navigator, self.range_intake))
            quality = input_qos(source.kind.depth)
            self._subscribe(source.message_class, source.name, quality, callback, source.kind.name, source.kind)
        # A command must not get lost, unlike one of many samples; the tools that send it are reliable.
        self._subscribe(
            PoseWithCovarianceStamped, topics.initial_pose, QoSProfile(depth=1), self._on_initial_pose, "initial_pose"
        )
        self._transform_input: Any = None
        self._open_transform_inputs()
        self.create_service(Trigger, "~/reset", self._served(self._on_reset))
        self.create_service(Trigger, "~/set_datum_here", self._served(self._on_set_datum_here))
        if robot_localization.services is not None:
            robot_localization.RobotLocalizationServices(self, self.navigator, self.parameters.frames.map)
        # Not on the clock of the node: reports also come before a simulation has begun.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(REPORT_PERIOD, self._contained(self._report, "report"), clock=steady)
        for name in unused_overrides(self):
            self.get_logger().warn(f"parameter {name} belongs to nothing here and has no effect")
        # All objects so far stay: collecting garbage among them would take longer than an IMU interval.
        gc.collect()
        gc.freeze()
        self.get_logger().info("ready: listening to " + ", ".join(monitor.label for monitor in self.monitors))

    @property
    def monitors(self) -> list[StampMonitor]:
        """The stamp monitors of the inputs, that of the IMU first."""
        return [self.imu_monitor, *(monitor for source in self.aid_inputs for monitor in source.monitors)]

    def close(self) -> None:
        """Publish the last report and write the warm start file; called while the publishers still work."""
        self._contained(self._report, "report")()
        self._contained(partial(self._warm_start.write, self.navigator), "warm_start.file")()

    def _compile(self) -> None:
        """Compile every kernel before the first message comes, or load it from the cache."""
        log = self.get_logger().info
        log("starting the estimator; the first start after an installation compiles it, which takes a minute")
        with while_compiling(sentence_on_compiling(log)):
            compile_node(self.parameters, uses_ranges(self.parameters))

    def _publisher(self, kind: Any, topic: str) -> Any:
        return self.create_publisher(kind, topic, OUTPUT_QOS, qos_overriding_options=OVERRIDING)

    def _subscribe(
        self,
        message_class: Any,
        topic: str,
        quality: QoSProfile,
        callback: Callable[..., None],
        name: str,
        kind: Input | None = None,
    ) -> None:
        # All messages come serialised: an unreadable one fails in our callback, not in the executor.
        contained = self._contained(callback, name)
        subscription = self.create_subscription(
            message_class, topic, contained, quality, raw=True, qos_overriding_options=OVERRIDING
        )
        self.inputs.append((subscription, kind))

    def _contained(self, callback: Callable[..., None], name: str) -> Callable[..., None]:
        """Return the callback such that no error ends the node: errors are counted by name and logged."""

        def contain(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self.trouble.note(f"{name}: {type(error).__name__}: {error}")

        return contain

    def _served(self, callback: Callable[[], tuple[bool, str]]) -> Callable[..., Trigger.Response]:
        """Return a handler that answers a Trigger with the result of a callback, or with its error."""

        def serve(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = callback()
            except Exception as error:
                response.success, response.message = False, f"{type(error).__name__}: {error}"
            return response

        return serve

    def _configure(self, parameters: Parameters) -> None:
        self.parameters = self.extrinsics.completed(parameters)
        self.navigator.configure(self.parameters)
        if self.range_intake is not None:
            self.range_intake.configure(self.parameters)
        for source in self.aid_inputs:
            source.configure(self.parameters)

    def now(self) -> int:
        """Time of the node's clock (ns)."""
        # Reading the node's clock costs more than the filter; without simulated time it is the system clock.
        return int(self.get_clock().now().nanoseconds) if self._is_simulated else time.time_ns()

    def steady(self) -> int:
        """Time of a clock that nobody sets (ns)."""
        return time.monotonic_ns()

    def _reset(self, why: str) -> None:
        self.get_logger().warn(f"{why}: the estimator starts again")
        self.navigator.reset()
        if self.fixed_lag is not None:
            self.fixed_lag.forget()
        self.resets += 1
        self._first_stamp = 0
        for source in self.aid_inputs:
            for monitor in source.monitors:
                monitor.restart()

    def _on_imu(self, data: bytes) -> None:
        started = time.perf_counter()
        sample: ImuSample | None = self._imu_reader.read(data)
        if sample is None:
            sample = imu_from_message(deserialize_message(data, Imu))
        stamp, specific_force, angular_rate, frame = sample
        judgement = self.imu_monitor.note(stamp, self.now())
        if self._imu_reader.is_uncarried:
            self.trouble.note(f"{self.imu_monitor.topic}: messages {UNCARRIED}")
        if judgement == Stamp.STARTED_AGAIN and (self._is_simulated or self._is_at_start(stamp)):
            self._reset(f"the stamps of {self.imu_monitor.topic} went back to their beginning")
        elif judgement == Stamp.WENT_AHEAD:
            self.get_logger().warn(f"the stamps of {self.imu_monitor.topic} went ahead of this computer's clock")
        if frame not in self._imu_frames_met:
            self._imu_frame = frame.decode(errors="replace")
            self._meet_frame(self._imu_frames_met, frame, IMU, self._imu_frame)
        if judgement == Stamp.ZERO:
            return
        self._first_stamp = self._first_stamp or stamp
        if self._warm_start.is_waiting:
            self._warm_start.offer(self.navigator, stamp)
        if self.parameters.alignment.imu_orientation != "unused" and stamp % SECOND < ORIENTATION_SHARE:
            self._push_orientation(stamp, deserialize_message(data, Imu))
        # With simulated time, stamps need not pass as a steady clock does.
        arrivals = None if self._is_simulated else np.array([self.steady()])
        rows = self.navigator.push_imu(
            np.array([stamp]), np.array([specific_force]), np.array([angular_rate]), arrivals
        )
        for index in range(len(rows)):
            self.outputs.publish(rows, index)
        if len(rows) and rows[-1]["quality"] != self._last_quality:
            self._publish_quality()
        if self._is_judging:
            self._tell_verdicts()
        took = time.perf_counter() - started
        self.callbacks += 1
        self.callback_time += took
        if took > self.longest_callback:
            self.longest_callback = took

    def _is_at_start(self, stamp: int) -> bool:
        """Say whether an IMU stamp is one of the first second: a recording that loops, not a clock that was set."""
        return abs(stamp - self._first_stamp) <= SECOND

    def _open_ranges(self) -> RangeIntake | None:
        """Prepare the intake of ranges, if ranges are used. Raises ParameterError for unreadable RINEX files."""
        if not uses_ranges(self.parameters):
            return None
        self._solutions = self._publisher(NavSatFix, "gnss/point_solution")
        self.output_publishers = (*self.output_publishers, self._solutions)
        try:
            intake = RangeIntake(self.navigator, self.parameters)
        except RinexError as error:
            raise ParameterError("ranges.rinex_nav_files", [str(error)]) from error
        for note in intake.notes:
            self.get_logger().warn(note)
        return intake

    def _push_orientation(self, stamp: int, message: Imu) -> None:
        q = message.orientation
        covariance = np.reshape(message.orientation_covariance, (1, 9))
        self.navigator.push_imu_orientation(np.array([stamp]), np.array([[q.x, q.y, q.z, q.w]]), covariance)

    def _on_aid(self, source: AidInput, push: Callable[..., Any], data: bytes) -> None:
        arrival = self.now()
        batch = source.read(data, arrival)
        if source.is_uncarried:
            self.trouble.note(f"{source.name}: messages {UNCARRIED}")
        frame = batch.strings[int(batch.messages["frame_id"][0])]
        receiver = source.receiver(frame)
        if (source.kind.name, frame) not in self._frames_met:
            place = place_of(source.kind.name, receiver)
            self._meet_frame(self._frames_met, (source.kind.name, frame), place, frame)
        stamp = int(batch.messages["stamp"][0])
        if source.kind.is_timed:
            moved = stamp and stamp + source.offset(receiver)
            if source.monitors[receiver].note(moved, arrival) == Stamp.ZERO:
                return
        for arguments in source.arguments(batch):
            solution = push(*arguments)
            if solution is not None:
                self._solutions.publish(solution_message(solution, stamp, frame))
            self._is_judging = True

    def _tell_verdicts(self) -> None:
        """Publish the verdicts of the measurements up to the newest sample; later messages may still change them.

        A new subscriber gets the verdicts of the whole history window.
        """
        if self._aids.get_subscription_count():
            records = self.navigator.take_live()
            if len(records):
                self._aids.publish(record_statuses(records, self.get_clock().now().to_msg()))
        self._is_judging = self.navigator.waiting > 0

    def _report(self) -> None:
        """Publish final verdicts, biases, filtered fix and diagnostics; called once a second."""
        self._is_simulated = bool(self.get_parameter("use_sim_time").value)
        records = self.navigator.take_records()
        self._count(records)
        stamp = self.get_clock().now().to_msg()
        refused = records[records["verdict"] == Verdict.OUTSIDE_HISTORY]
        for stream in np.unique(refused["stream"]).tolist():
            window = self.parameters.history.window
            self.trouble.note(f"{STREAM_NAMES[stream]}: a message came too late for history.window = {window:g} s")
        if len(refused):
            self._aids.publish(record_statuses(refused, stamp))
        row, datum = self.navigator.odometry[0], self.navigator.datum
        if row["status"] == Status.FAULT:
            self.trouble.note("the estimate or its covariance is broken: call the service ~/reset")
        else:
            self._bias.publish(bias_message(row, self._imu_frame))
            if row["position_known"] and datum is not None:
                self._filtered.publish(fix_message(row, datum, self.parameters.frames.base_link))
        for note in self.navigator.notes:
            # Counts grow; each kind of note is logged once.
            kind = "".join(character for character in note if not character.isdigit())
            if kind not in self._noted:
                self._noted.add(kind)
                self.get_logger().warn(note)
        if len(self.navigator.clock_steps) > self._clock_steps:
            self.get_logger().warn(self.navigator.clock_complaints[0])
        self._clock_steps = len(self.navigator.clock_steps)
        if self.navigator.restarts > self._restarts:
            self.get_logger().warn("the alignment began again: the IMU was silent, or fix after fix was rejected")
        self._restarts = self.navigator.restarts
        self._publish_quality()
        if self.fixed_lag is not None:
            self.outputs.publish_smoothed(self.fixed_lag.update())
        self._diagnostics.publish(status_report(self._snapshot(), stamp))
        if self.range_intake is not None:
            self.range_intake.wants_solution = self._solutions.get_subscription_count() > 0
        self.callbacks, self.callback_time, self.longest_callback = 0, 0.0, 0.0
        self._watch_transforms()
        self._reports += 1

    def _publish_quality(self) -> None:
        """Publish whether the estimate may be used for navigation: once a second, and when it changes."""
        row = self.navigator.odometry[0]
        self._last_quality = int(row["quality"])
        silence = self.imu_monitor.timing(self.now()).silence
        self._quality.publish(quality_message(row, self.get_fully_qualified_name(), silence))

    def _snapshot(self) -> Snapshot:
        """Return what the diagnostics report."""
        return Snapshot(
            graph=self,
            now=self.now(),
            navigator=self.navigator,
            parameters=self.parameters,
            imu_monitor=self.imu_monitor,
            aid_inputs=self.aid_inputs,
            inputs=self.inputs,
            output_publishers=self.output_publishers,
            outputs=self.outputs,
            range_intake=self.range_intake,
            position_stream=self.position_stream,
            latest_positions=self.latest_positions,
            verdicts=self.verdicts,
            trouble=self.trouble,
            extrinsics=self.extrinsics,
            resets=self.resets,
            callbacks=self.callbacks,
            callback_time=self.callback_time,
            longest_callback=self.longest_callback,
        )

    def _count(self, records: np.ndarray) -> None:
        """Count final verdicts by stream, and separately those of the last fixes or pseudoranges."""
        positions: dict[Verdict, int] = {}
        for stream, verdict in zip(records["stream"].tolist(), map(Verdict, records["verdict"].tolist())):
            self.verdicts[stream, verdict] = self.verdicts.get((stream, verdict), 0) + 1
            if stream == self.position_stream:
                positions[verdict] = positions.get(verdict, 0) + 1
        self.latest_positions = positions or self.latest_positions

    def _on_reset(self) -> tuple[bool, str]:
        self._reset("reset was asked for")
        return True, "the estimator starts again"

    def _on_set_datum_here(self) -> tuple[bool, str]:
        if self.navigator.set_datum_here():
            return True, "the map begins at the present position"
        return False, "the position is not known yet"

    def _on_initial_pose(self, data: bytes) -> None:
        message = deserialize_message(data, PoseWithCovarianceStamped)
        frame, expected = message.header.frame_id, self.parameters.frames.map
        if frame != expected:
            why = f"its frame is {frame!r}, not {expected!r}"
        else:
            why = set_pose(self.navigator, message.pose)
        if why:
            self.trouble.note(f"{self.parameters.topics.initial_pose}: not used: {why}")
        else:
            self.get_logger().info(f"{self.parameters.topics.initial_pose}: the estimate was put there")

    def _open_transform_inputs(self) -> None:
        """Subscribe to static transforms for the places of the sensors, and to another node's odom -> base_link."""
        if transforms.TFMessage is None:
            return
        if self.parameters.frames.extrinsics == "auto":
            latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            callback = self._contained(self._on_static_transforms, "/tf_static")
            self.create_subscription(transforms.TFMessage, "/tf_static", callback, latched)
        if self.parameters.output.tf == "map_to_odom":
            self._listen_to_transforms()

    def _listen_to_transforms(self) -> None:
        assert self.outputs.transforms is not None
        self._transform_input = self.create_subscription(
            transforms.TFMessage, "/tf", self._contained(self.outputs.transforms.receive, "/tf"), INPUT_DEPTH
        )

    def _watch_transforms(self) -> None:
        """Check from time to time, for one report period, who else publishes our transforms: always costs too much."""
        output = self.outputs.transforms
        if output is None:
            return
        listens_always = self.parameters.output.tf == "map_to_odom"
        phase = self._reports % WATCH_EVERY
        if phase == 1 and self.count_publishers("/tf") > 1:
            output.watch.begin()
            if not listens_always:
                self._listen_to_transforms()
        elif phase == 2:
            output.watch.end()
            if self._transform_input is not None and not listens_always:
                self.destroy_subscription(self._transform_input)
                self._transform_input = None

    def _on_static_transforms(self, message: Any) -> None:
        for transform in message.transforms:
            self.extrinsics.note_transform(transform)
        self._complete_extrinsics(is_late=True)

    def _meet_frame(self, met: set[Any], key: object, place: str, frame: str) -> None:
        """Record a frame name that an input has not used before."""
        if len(met) > 100:
            return
        met.add(key)
        if place:
            is_first = self.extrinsics.note_frame(place, frame)
            self._complete_extrinsics(is_late=not is_first)

    def _complete_extrinsics(self, is_late: bool) -> None:
        """Use the places that can be found now; reset if earlier messages were used with other places."""
        found = self.extrinsics.find()
        for line in found:
            self.get_logger().info(line)
        if found:
            self._configure(self._live.current)
            if is_late and self.navigator.status > Status.LEVELLING:
                self._reset("the place of a sensor has become known")


def input_qos(depth: int) -> QoSProfile:
    """Return the quality of service of an input: best effort matches every publisher, reliable ones, too."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
