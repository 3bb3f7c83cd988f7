"""The navigator: push sensor samples, get the state. The algorithm is `loop.advance`.

Over 400 lines: one class takes everything in; what can be read of it is in `readout.py`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial

import numpy as np

from eskf_ros.filter.alignment.first_fix import reset_pose
from eskf_ros.filter.alignment.heading_search import forget_search
from eskf_ros.filter.alignment.warm_start import Memory
from eskf_ros.filter.history.admission import ABSENT, VARIANCES, admit
from eskf_ros.filter.history.arguments import FloatArray, StampArray, copied, nine, vectors, whole_stamp, whole_stamps
from eskf_ros.filter.history.buffers import IMU_BATCH, Buffers
from eskf_ros.filter.history.clock_steps import ClockSteps, Sample
from eskf_ros.filter.history.records import AID, RECORD
from eskf_ros.filter.history.timeline import (
    insert_imu,
    offer_aid,
    raise_barrier,
    take_final,
)
from eskf_ros.filter.inertial.navigation_frame import heading_of, reset_datum, set_datum
from eskf_ros.filter.integrity.traffic import Traffic
from eskf_ros.filter.layout import STATE, WORK, blank_state
from eskf_ros.filter.loop import advance
from eskf_ros.filter.measurements import heading, mag
from eskf_ros.filter.measurements.gnss_position import NO_ALTITUDE, UNKNOWN_ALTITUDE_VARIANCE
from eskf_ros.filter.measurements.heading import UNKNOWN_ANGLE_VARIANCE
from eskf_ros.filter.output.forward_log import Log, allocate_log, grown, log_end, take_log
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.output.local_odometry import LOCAL, note_jump
from eskf_ros.filter.readout import Readout
from eskf_ros.filter.rows import ROWS
from eskf_ros.filter.settings import intakes_from, recall, settings_from
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.filter.tight.intake import offer_signals
from eskf_ros.geodesy.earth import ecef_to_geodetic
from eskf_ros.geodesy.magnetic_model import FieldUnknown, field_at
from eskf_ros.geodesy.rotation import to_matrix
from eskf_ros.gnss.range_model import NO_KLOBUCHAR
from eskf_ros.gnss.ranges import Status as RangeStatus
from eskf_ros.gnss.ranges import status_counts
from eskf_ros.gnss.time import SECONDS_PER_WEEK, Instant
from eskf_ros.parameters.tree import Parameters

HIGHEST_ALTITUDE = 1e5
"""m; no receiver on a robot reports more."""

NULL_ISLAND = 5e-8
"""deg; a fix within 5 mm of latitude and longitude zero was never filled in: that place is in the sea."""

ORIENTATION_SHARE = SECOND // 10
"""ns; the IMU's own orientation is used in this part of each second: at least one sample, from 10 Hz on."""

DIAGONAL = np.eye(3).ravel()

MEASURED_AXES = {
    row.stream: range(3 if row.is_vector else len(row.columns) - bool(row.optional_column)) for row in ROWS
}
"""Axes that a message of a stream is expected to measure."""


NO_FIELD = (0.0, 0.0, 0.0, 0.0)

HORIZONTAL = np.array([1, 1, 0, 1, 1, 0, 0, 0, 0], bool)
"""The elements of a covariance (9,) that belong to the horizontal plane."""

NO_STAND_IN = (0.0, 0.0, 0.0)
"""No stand-in: the covariance of a message is its own."""


class Navigator(Readout):
    """Error-state Kalman filter over a timeline: the same for the node and for the replay.

    Stamps are int64 nanoseconds on the IMU's clock. A push sorts a message into the timeline; the next `push_imu` or
    `update`, or a push that finds the buffers full, runs the filter. `output.global_odometry` describes the fields of
    rows (ODOMETRY), `history.records` those of records (RECORD).
    """

    def __init__(self, parameters: Parameters, output_rate: float = 0.0, keeps_log: bool = False) -> None:
        """Prepare a filter; ``output_rate`` (Hz) of the rows that `push_imu` returns, 0 for every IMU sample.

        ``keeps_log``: keep the log of the forward pass for a smoother, who has to call `take_log` now and then.
        """
        self._output_rate = output_rate
        self._keeps_log = keeps_log
        self._buffers = Buffers(STATE, ODOMETRY)
        self._work = allocate(WORK)
        self._offered = allocate(AID)
        self._memory: tuple[Memory, float] | None = None
        self.configure(parameters)
        self.reset()

    def configure(self, parameters: Parameters) -> None:
        """Use other parameters from now on; they also apply to messages of the window that are applied again."""
        self.parameters = parameters
        self._settings = settings_from(parameters, self._output_rate)
        self._settings["keeps_log"] = self._keeps_log
        self._constraint_count = int(self._settings["constrains"].sum())
        self._intakes = intakes_from(parameters)
        self.needs_field = parameters.mag.use or parameters.alignment.imu_orientation == "magnetic_north"
        if self._memory is not None:
            recall(*self._memory, parameters, self._settings[0])

    def reset(self) -> None:
        """Forget everything: the estimate, the memory of an earlier run, and the datum unless it is a parameter.

        Records that were not taken are lost.
        """
        self._memory = None
        self._settings["has_memory"] = 0
        self._blank = blank_state()
        if self.parameters.datum:
            latitude, longitude, altitude = self.parameters.datum
            set_datum(self._blank[0], math.radians(latitude), math.radians(longitude), altitude)
        self._states = self._blank.copy()
        self._buffers.restart(round(self.parameters.history.window * SECOND))
        self._local = allocate(LOCAL)
        self._refused: list[np.ndarray] = []
        self._traffic = Traffic()
        self._log = allocate_log(int(self._settings["error_capacity"][0]) if self._keeps_log else 0, 0, 0)
        self._taken_log: list[Log] = []
        self._clock = ClockSteps()
        self.range_statuses: Counter[RangeStatus] = Counter()
        """Number of signals by status: usable, or why they never entered the timeline."""

    def warm_start(self, memory: Memory, age: float) -> None:
        """Offer the memory of an earlier run, ``age`` seconds old; to be called before the first sample."""
        self._memory = memory, age
        recall(memory, age, self.parameters, self._settings[0])

    def set_datum_here(self) -> bool:
        """Make the present position of the IMU the origin of the map; False while the position is unknown.

        This is a barrier: what came before is final, and nothing older is accepted afterwards.
        """
        self._release_held()
        self._advance()
        state = self._states[0]
        if not state["position_known"]:
            return False
        ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ state["position_map"]
        latitude, longitude, altitude = ecef_to_geodetic(*ecef)
        self.set_datum(math.degrees(latitude), math.degrees(longitude), altitude)
        return True

    def set_datum(self, latitude_deg: float, longitude_deg: float, altitude: float) -> None:
        """Make a geodetic position (deg, deg, m) the origin of the map, wherever the robot is. This is a barrier."""
        self._release_held()
        self._advance()
        state, settings = self._states[0], self._settings[0]
        position, heading = tuple(state["position_map"]), heading_of(state, settings)
        datum = math.radians(latitude_deg), math.radians(longitude_deg), float(altitude)
        if state["position_known"]:
            reset_datum(state, *datum, settings)
            forget_search(state)
            note_jump(state, position, heading, settings)
        else:
            set_datum(state, *datum)
        self._raise_barrier()

    def set_pose(
        self, position_map: Sequence[float], position_covariance: FloatArray, heading: float, heading_std: float
    ) -> bool:
        """Set base_link to a position in map (m, covariance (3, 3) m2) and a heading (rad); roll and pitch stay.

        ``heading`` is counter-clockwise from x of map, ``heading_std`` its standard deviation (rad). Returns False
        while level or datum are unknown. This is a barrier.
        """
        self._release_held()
        self._advance()
        state, settings = self._states[0], self._settings[0]
        if not (state["level_known"] and state["frame"]["datum_known"]):
            return False
        before, heading_before = tuple(state["position_map"]), heading_of(state, settings)
        covariance = np.ascontiguousarray(position_covariance, np.float64)
        reset_pose(
            state, tuple(float(v) for v in position_map), covariance, float(heading), float(heading_std), settings
        )
        note_jump(state, before, heading_before, settings)
        self._raise_barrier()
        return True

    def push_imu(
        self,
        stamps: StampArray,
        specific_force: FloatArray,
        angular_rate: FloatArray,
        arrivals: StampArray | None = None,
    ) -> np.ndarray:
        """Take IMU samples, shapes (n,), (n, 3) m/s2, (n, 3) rad/s in IMU axes, and run the filter up to the newest.

        Returns the ODOMETRY rows of the newly processed samples on the output grid, as they would have been published.
        ``arrivals`` (n,): when they came (ns), on a clock that nobody sets; they tell a clock that was set forward from
        a silent IMU (`history.clock_steps`). Samples that seem to come from a clock that was set are held until some
        more have come.

        Raises:
            TypeError: the stamps are not integers: seconds as floats cannot hold nanoseconds.
            ValueError: an array has another shape.
        """
        stamps = whole_stamps(stamps)
        specific_force = vectors("specific_force", specific_force, len(stamps))
        angular_rate = vectors("angular_rate", angular_rate, len(stamps))
        arrivals = None if arrivals is None else whole_stamps(arrivals)
        if not self._local["started"][0] or self._clock.is_plain(stamps, arrivals):
            return self._given_out(self._push_samples(stamps, specific_force, angular_rate, arrivals))
        parts = []
        for k in range(len(stamps)):
            sample = Sample(
                int(stamps[k]), specific_force[k], angular_rate[k], 0 if arrivals is None else int(arrivals[k])
            )
            steps = len(self._clock.steps)
            false, taken = self._clock.take(sample, self._kept_samples)
            self._buffers.timeline["imu_offered"] += len(false)
            self._buffers.timeline["imu_bad_stamp"] += len(false)
            if len(self._clock.steps) == steps:
                # Without a step they are in time as they were when they came, before a newer sample.
                self._offer_held_aids()
            parts.append(self._push_held(taken))
        return np.concatenate([np.zeros(0, ODOMETRY), *parts])

    def _push_held(self, samples: Sequence[Sample]) -> np.ndarray:
        """Give samples that are not, or no longer, held to the timeline, and the measurements that waited with them."""
        if not samples:
            return np.zeros(0, ODOMETRY)
        arrivals = np.array([sample.arrival for sample in samples], np.int64)
        rows = self._push_samples(
            np.array([sample.stamp for sample in samples], np.int64),
            np.array([sample.force for sample in samples]),
            np.array([sample.rate for sample in samples]),
            arrivals if arrivals.all() else None,
        )
        self._offer_held_aids()
        return self._given_out(rows)

    def _offer_held_aids(self) -> None:
        """Give the measurements that waited with samples to the timeline, if no sample is held any more."""
        if not self._clock.held:
            waiting, self._clock.held_aids = self._clock.held_aids, []
            for offer in waiting:
                offer()

    def _release_held(self) -> None:
        """Give all samples that are held to the timeline: something has to be final now."""
        self._push_held(self._clock.release())

    def _kept_samples(self) -> np.ndarray:
        return self._buffers.imu[: int(self._buffers.timeline["imu_count"][0])]

    def _given_out(self, rows: np.ndarray) -> np.ndarray:
        """Return rows or records with the stamps of the clock of then."""
        if self._clock.steps and len(rows):
            rows["stamp"] = self._clock.stamps_of(rows["stamp"])
        return rows

    def _push_samples(
        self, stamps: StampArray, specific_force: FloatArray, angular_rate: FloatArray, arrivals: StampArray | None
    ) -> np.ndarray:
        """Sort IMU samples into the timeline, with the shift of the clock, and run the filter; return new rows."""
        parts = []
        first = 0
        times = stamps + self._clock.shift
        imu = self.parameters.imu
        if any(imu.accel_scale) or any(imu.gyro_scale):
            specific_force = specific_force / (1.0 + np.array(imu.accel_scale))
            angular_rate = angular_rate / (1.0 + np.array(imu.gyro_scale))
        while first < len(times):
            self._make_room()
            batch = min(first + IMU_BATCH, len(times))
            first = insert_imu(
                self._buffers.imu,
                self._buffers.aids,
                self._buffers.timeline,
                self._local,
                self._settings,
                times[:batch],
                specific_force,
                angular_rate,
                first,
            )
            parts.append(self._advance())
        if len(stamps):
            delay, arrival = (0, 0) if arrivals is None else (int((arrivals - stamps).min()), int(arrivals[-1]))
            self._clock.note(int(self._buffers.timeline["frontier"][0]), len(stamps), delay, arrival)
        return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0, ODOMETRY), *parts])

    def update(self) -> np.ndarray:
        """Apply what was pushed, late messages included; return rows as `push_imu` does."""
        return self._given_out(self._advance())

    def _advance(self) -> np.ndarray:
        """Run the filter over what waits; return the new rows, with times of the timeline."""
        count = advance(
            self._states,
            self._buffers.imu,
            self._buffers.aids,
            self._buffers.checkpoints,
            self._buffers.timeline,
            self._blank,
            self._settings,
            self._work,
            self._local,
            self._buffers.rows,
            self._log,
        )
        return copied(self._buffers.rows, count)

    def push_gnss_position(
        self,
        stamp: int,
        latitude_deg: float,
        longitude_deg: float,
        altitude: float,
        covariance: Sequence[float] | FloatArray,
        covariance_type: int,
        status: int,
        arrival: int = 0,
        frame_id: str = "",
        from_ranges: bool = False,
    ) -> None:
        """Take a position of the antenna: degrees, ellipsoidal metres, nine numbers East-North-Up (m2, row-major).

        ``covariance_type`` and ``status`` as in NavSatFix. An unknown or all-zero covariance is replaced by
        ``gnss.status_std_horizontal`` and ``_vertical``. An altitude that is NaN is not known: the fix is used
        horizontally, and the height stays with the IMU and the barometer. ``frame_id`` tells which antenna it is.
        ``from_ranges``: it was solved here from the ranges of the first receiver (``ranges.use_point_solution``).
        ``arrival`` (ns) goes to the record.

        Raises:
            TypeError: the stamp is not an integer.
            ValueError: the covariance has another shape.
        """
        gnss = self.parameters.gnss
        stand_in = NO_STAND_IN
        matrix = nine(covariance)
        if covariance_type == 0 or not matrix.any():
            level = min(max(status, 0), 2)
            horizontal, vertical = gnss.status_std_horizontal[level] ** 2, gnss.status_std_vertical[level] ** 2
            stand_in = (horizontal, horizontal, vertical)
        has_altitude = not math.isnan(altitude)
        if not has_altitude:
            altitude = 0.0
            matrix = np.where(HORIZONTAL, matrix, 0.0)
            matrix[8] = UNKNOWN_ALTITUDE_VARIANCE
            if stand_in is not NO_STAND_IN:
                stand_in = (stand_in[0], stand_in[1], UNKNOWN_ALTITUDE_VARIANCE)
        values = (math.radians(latitude_deg), math.radians(longitude_deg), float(altitude))
        door = self._admit(Stream.GNSS_POSITION, values, matrix, stand_in)
        self._offered[0]["payload"][NO_ALTITUDE] = not has_altitude
        if door == Verdict.WAITING:
            if status < 0:
                door = Verdict.NO_FIX
            elif abs(latitude_deg) < NULL_ISLAND and abs(longitude_deg) < NULL_ISLAND:
                door = Verdict.UNFILLED
            elif abs(latitude_deg) > 90.0 or abs(longitude_deg) > 360.0 or abs(altitude) > HIGHEST_ALTITUDE:
                door = Verdict.BAD_VALUE
            else:
                self._traffic.without_altitude += not has_altitude
            if door == Verdict.WAITING and self.needs_field:
                field = self._field_at(latitude_deg, longitude_deg, altitude, stamp)
                self._offered[0]["payload"][mag.FIELD : mag.FIELD + 4] = field
        self._push_gnss(Stream.GNSS_POSITION, stamp, arrival, frame_id, from_ranges, door)

    def push_gnss_velocity(
        self,
        stamp: int,
        velocity_enu: Sequence[float],
        covariance: Sequence[float] | FloatArray,
        arrival: int = 0,
        frame_id: str = "",
        from_ranges: bool = False,
    ) -> None:
        """Take a velocity of the antenna relative to the Earth: East-North-Up m/s, nine numbers m2/s2 (row-major).

        An all-zero or absent covariance (first number negative) becomes ``gnss.unknown_velocity_std``. ``frame_id`` and
        ``from_ranges``, and what is raised, as in `push_gnss_position`.
        """
        door = self._take(Stream.GNSS_VELOCITY, velocity_enu, covariance)
        self._push_gnss(Stream.GNSS_VELOCITY, stamp, arrival, frame_id, from_ranges, door)

    def push(
        self,
        stream: Stream,
        stamp: int,
        values: Sequence[float],
        covariance: Sequence[float] | FloatArray,
        arrival: int = 0,
    ) -> None:
        """Take a measurement of any other sensor: three values with their covariance (nine numbers, row-major).

        The file of the measurement in `measurements` describes the values and their units. An all-zero covariance is
        replaced by the stand-in of the parameters; an axis with a negative variance was not measured. What is raised as
        in `push_gnss_position`.
        """
        door = self._take(stream, values, covariance)
        self._push_aid(stream, stamp + round(self._intakes[stream].time_offset * SECOND), arrival, 0, door)

    def push_ranges(
        self,
        stamp: int,
        instant: Instant,
        signals: np.ndarray,
        klobuchar: FloatArray = NO_KLOBUCHAR,
        arrival: int = 0,
        place: tuple[float, float, float] | None = None,
    ) -> None:
        """Take the signals (MEASURED_SIGNAL, `gnss.measurements.measured_epoch`) of one epoch of the first receiver.

        ``stamp``: the instant of the measurement on the IMU's clock (ns); ``instant``: the same in GPS time, to a
        minute; ``klobuchar``: eight parameters of the ionosphere. The signals must not depend on the estimated
        position, so that the result does not depend on the time of arrival. ``place``: where the epoch alone puts the
        antenna (deg, deg, m), accurate enough for the Earth's magnetic field (`needs_field`); it may be given with some
        epochs only.

        Raises:
            TypeError: the stamp is not an integer.
        """
        if self._clock.held:
            self._clock.held_aids.append(partial(self.push_ranges, stamp, instant, signals, klobuchar, arrival, place))
            return
        field = NO_FIELD if place is None or not self.needs_field else self._field_at(*place, stamp)
        self.range_statuses.update(status_counts(signals))
        is_tight, ranges = self.parameters.mode == "tight", self.parameters.ranges
        code_door = Verdict.WAITING if is_tight and ranges.use else Verdict.DISABLED
        rate_door = Verdict.WAITING if is_tight and ranges.use_doppler else Verdict.DISABLED
        stamp = self._clock.time_of(Stream.PSEUDORANGE, whole_stamp(stamp) + round(ranges.time_offset * SECOND))
        self._make_room(2 * len(signals))
        refused = np.zeros(2 * len(signals), RECORD)
        count = offer_signals(
            self._buffers.aids,
            self._buffers.timeline,
            self._offered,
            signals,
            stamp,
            arrival,
            instant[0] * SECONDS_PER_WEEK + instant[1],
            klobuchar,
            np.array(field),
            int(code_door),
            int(rate_door),
            refused,
        )
        for stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE):
            self._traffic.offered[stream] += 1
            verdicts = refused["verdict"][:count][refused["stream"][:count] == stream]
            if len(verdicts):
                self._traffic.note_refused(stream, stamp, int(self._buffers.timeline["frontier"][0]))
            if early := int(np.count_nonzero(verdicts == Verdict.BEFORE_ALIGNMENT)):
                self._traffic.early[stream] += early
        if count:
            self._refused.append(refused[:count])

    def push_imu_orientation(self, stamps: StampArray, orientation: FloatArray, covariance: FloatArray) -> None:
        """Take the IMU's own orientation of samples of `push_imu`: (n, 4) x y z w and (n, 9) rad2, as in REP-145.

        Nothing happens unless ``alignment.imu_orientation`` asks for it. Then the samples at the beginning of each
        second are used: a choice by stamp does not depend on the order of arrival.
        """
        alignment = self.parameters.alignment
        if alignment.imu_orientation == "unused":
            return
        forward_imu = self._settings["imu_to_base"][0, 0]
        for i in np.flatnonzero((covariance[:, 0] != ABSENT) & (covariance[:, 8] <= UNKNOWN_ANGLE_VARIANCE)):
            stamp = int(stamps[i])
            if stamp % SECOND >= ORIENTATION_SHARE:
                continue
            x, y, z, w = (float(value) for value in orientation[i])
            yaw = math.nan
            if abs(x * x + y * y + z * z + w * w - 1.0) < 0.1:
                forward = np.array(to_matrix((w, x, y, z))) @ forward_imu
                yaw = math.atan2(forward[1], forward[0])
            std = math.radians(alignment.imu_orientation_std_deg)
            given = np.diag([covariance[i, 8], ABSENT, ABSENT]).ravel()
            door = admit(self._offered, (yaw, 0.0, 0.0), given, NO_STAND_IN, 1.0, (std, std, std), True)
            self._push_aid(Stream.HEADING, stamp, stamp, heading.IMU_ORIENTATION, door)

    def take_records(self) -> np.ndarray:
        """Return the records (RECORD) that became final since the last call: in the total order, the late ones last."""
        return self._given_out(self._take_records(False))

    def take_log(self, everything: bool = False) -> list[Log]:
        """Return what became final of the log of the forward pass since the last call, in parts in their order.

        ``everything``: up to the newest IMU sample, after `finish`; nothing can be pushed afterwards.
        """
        if everything:
            log_end(self._states[0], self._log, self._settings[0])
        self._drain_log(everything)
        taken, self._taken_log = self._taken_log, []
        return taken

    def _drain_log(self, everything: bool) -> None:
        """Move what is final from the buffers of the log to what will be taken."""
        if self._keeps_log:
            buffers = self._buffers
            self._taken_log.append(take_log(self._log, self._states, buffers.checkpoints, buffers.timeline, everything))

    def take_live(self) -> np.ndarray:
        """Return the records of what was judged since the last call, as they stand: a late message may change them."""
        judged = self._buffers.aids[: int(self._states["aid_next"][0])]
        new = np.flatnonzero((judged["told"] == 0) & (judged["verdict"] != Verdict.INACTIVE))
        judged["told"] = 1
        return self._given_out(np.array([tuple(judged[name][i] for name in RECORD.names or ()) for i in new], RECORD))

    def finish(self) -> np.ndarray:
        """End the data: return all remaining records; the verdict WAITING means that no IMU sample came for them."""
        self._release_held()
        self._advance()
        return self._given_out(self._take_records(True))

    def _take(self, stream: Stream, values: Sequence[float], covariance: Sequence[float] | FloatArray) -> int:
        """Fill the payload on offer, with a stand-in for a missing covariance; return its admission verdict."""
        intake = self._intakes[stream]
        matrix = nine(covariance)
        is_absent = not matrix.any() or (matrix[0] < 0.0 and not intake.may_lack_axes)
        if intake.largest_variance < math.inf:
            matrix = np.where((matrix > intake.largest_variance) & (DIAGONAL == 1.0), ABSENT, matrix)
        x, y, z = intake.unknown_std
        stand_in = (x * x, y * y, z * z) if is_absent else NO_STAND_IN
        return self._admit(stream, (float(values[0]), float(values[1]), float(values[2])), matrix, stand_in)

    def _admit(
        self,
        stream: Stream,
        values: tuple[float, float, float],
        covariance: FloatArray,
        stand_in: tuple[float, float, float],
    ) -> int:
        """Fill the payload on offer; return the verdict of its admission."""
        intake = self._intakes[stream]
        scale, floor, lacks = intake.covariance_scale, intake.std_floor, intake.may_lack_axes
        door = admit(self._offered, values, covariance, stand_in, scale, floor, lacks)
        if not intake.is_used:
            return Verdict.DISABLED
        if door != Verdict.WAITING:
            return int(door)
        if max(map(abs, values)) > intake.largest or values[0] < intake.lowest:
            return Verdict.BAD_VALUE
        if stand_in is not NO_STAND_IN:
            self._traffic.stand_ins += 1
        for axis in MEASURED_AXES[stream] if lacks else ():
            if self._offered[0]["payload"][VARIANCES[axis]] == ABSENT:
                self._traffic.lacking[stream, axis] += 1
        return Verdict.WAITING

    def _field_at(
        self, latitude_deg: float, longitude_deg: float, altitude: float, stamp: int
    ) -> tuple[float, float, float, float]:
        """Return the Earth's magnetic field at a fix as `mag.note_field` wants it; it depends on the fix alone."""
        declination = math.radians(self.parameters.mag.declination_deg)
        try:
            found, inclination, strength = field_at(latitude_deg, longitude_deg, altitude, stamp)
        except FieldUnknown as problem:
            if math.isnan(declination):
                self._traffic.field_problem = str(problem)
                return NO_FIELD
            found, inclination, strength = declination, 0.0, 0.0
        if math.isnan(declination):
            declination = found
        return 1.0, declination, inclination, strength

    def _push_gnss(self, stream: Stream, stamp: int, arrival: int, frame_id: str, from_ranges: bool, door: int) -> None:
        """Sort the record on offer into the timeline, as a message of the receiver with this frame."""
        second, ranges = self.parameters.second_gnss, self.parameters.ranges
        is_second = second.frame_id != "" and frame_id == second.frame_id and not from_ranges
        receiver = ranges if from_ranges else second if is_second else self.parameters.gnss
        uses_ranges = self.parameters.mode == "tight" or ranges.use_point_solution
        if uses_ranges and not is_second and not from_ranges:
            # The receiver solved this fix from the same ranges: both together would count twice.
            door = Verdict.DISABLED
        stamp = whole_stamp(stamp) + round(receiver.time_offset * SECOND)
        if stream == Stream.GNSS_VELOCITY and not from_ranges:
            stamp += round(self.parameters.gnss.velocity_time_offset * SECOND)
        self._push_aid(stream, stamp, arrival, int(is_second), door)

    def _push_aid(self, stream: Stream, stamp: int, arrival: int, source: int, door: int) -> None:
        """Sort the record on offer into the timeline."""
        stamp = whole_stamp(stamp)
        if self._clock.held:
            self._clock.held_aids.append(
                partial(self._push_offer, self._offered.copy(), stream, stamp, arrival, source, door)
            )
        else:
            self._push_offer(self._offered, stream, stamp, arrival, source, door)

    def _push_offer(
        self, offered: np.ndarray, stream: Stream, stamp: int, arrival: int, source: int, door: int
    ) -> None:
        """Sort a record whose payload is filled into the timeline."""
        stamp = self._clock.time_of((stream, source), stamp)
        self._traffic.offered[stream] += 1
        if door != Verdict.WAITING:
            self._traffic.shut_doors[stream, Verdict(door)] += 1
        self._make_room()
        refused = offer_aid(
            self._buffers.aids, self._buffers.timeline, offered, stamp, arrival, int(stream), source, int(door)
        )
        if refused:
            self._refuse(stream, stamp, arrival, source, Verdict(refused))

    def _refuse(self, stream: Stream, stamp: int, arrival: int, source: int, verdict: Verdict) -> None:
        """Record a measurement that never enters the timeline."""
        if verdict == Verdict.BEFORE_ALIGNMENT:
            self._traffic.early[stream] += 1
        self._traffic.note_refused(stream, stamp, int(self._buffers.timeline["frontier"][0]))
        record = (stamp, arrival, stream, source, verdict, 0, math.nan, (math.nan,) * 3)
        self._refused.append(np.array([record], RECORD))

    def _raise_barrier(self) -> None:
        """Make everything so far final: see `timeline.raise_barrier`."""
        if self._buffers.timeline["frontier"][0] != NEVER:
            records = self._take_records(True)
            self._refused.append(records)
            self._drain_log(True)
        raise_barrier(self._states, self._blank, self._buffers.timeline)

    def _take_records(self, everything: bool) -> np.ndarray:
        records = allocate(
            RECORD, max(1, int(self._buffers.timeline["aid_count"][0] - self._buffers.timeline["recorded"][0]))
        )
        count = take_final(self._states, self._buffers.aids, self._buffers.timeline, records, everything)
        refused, self._refused = self._refused, []
        self._traffic.note_final(records[:count])
        return np.concatenate([np.array(records[:count], RECORD), *refused])

    def _forget(self) -> None:
        """Process what waits, and drop what no accepted message can change any more."""
        self._advance()
        self._drain_log(False)
        self._buffers.forget(self._states)

    def _make_room(self, aids: int = 1) -> None:
        """Make room in the buffers for one batch of IMU samples with its checkpoints, and ``aids`` measurements."""
        if not self._buffers.have_room(aids, self._constraint_count):
            self._forget()
            self._buffers.grow(aids, self._constraint_count)
        if self._keeps_log:
            # A node has a measurement or an IMU sample of its own, a point an IMU sample.
            samples = len(self._buffers.imu)
            self._log = grown(self._log, samples + len(self._buffers.aids) + 1, samples)
