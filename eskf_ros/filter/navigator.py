"""The navigator: push a sensor sample, get the state. ``advance`` is the whole algorithm."""

from __future__ import annotations

import math
import operator
from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from eskf_ros.filter.alignment.first_fix import place
from eskf_ros.filter.alignment.heading_search import forget_search
from eskf_ros.filter.alignment.warm_start import Memory
from eskf_ros.filter.history.admission import ABSENT, admit
from eskf_ros.filter.history.records import AID, IMU, RECORD, TIMELINE
from eskf_ros.filter.history.timeline import (
    CHECKPOINT_SPACING,
    EARLY_AIDS,
    doubled,
    forget,
    insert_imu,
    offer_aid,
    raise_barrier,
    take_final,
)
from eskf_ros.filter.inertial.navigation_frame import heading_of, move_datum, set_datum
from eskf_ros.filter.integrity.fix_tracker import forget_tracks
from eskf_ros.filter.integrity.heading_monitor import complaints, is_heading_contradicted
from eskf_ros.filter.integrity.receiver_monitor import aid_complaints
from eskf_ros.filter.integrity.recovery import phase_of
from eskf_ros.filter.layout import STATE, WORK, blank_state
from eskf_ros.filter.loop import advance
from eskf_ros.filter.measurements import heading, mag
from eskf_ros.filter.measurements.heading import UNKNOWN_ANGLE_VARIANCE
from eskf_ros.filter.output.global_odometry import ODOMETRY, status_of, write_odometry
from eskf_ros.filter.output.local_odometry import LOCAL, note_jump
from eskf_ros.filter.settings import intakes_from, recall, settings_from
from eskf_ros.filter.state.enums import Phase, Status, Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE, INTER_SYSTEM
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.filter.tight.epoch import offer_signals
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.geodesy.magnetic_model import FieldUnknown, field_at
from eskf_ros.geodesy.rotation import to_matrix
from eskf_ros.gnss.measurements import MEASURED_SIGNAL
from eskf_ros.gnss.range_model import NO_KLOBUCHAR
from eskf_ros.gnss.ranges import Status as RangeStatus
from eskf_ros.gnss.ranges import status_counts
from eskf_ros.gnss.time import SECONDS_PER_WEEK, Instant
from eskf_ros.parameters.tree import Parameters

FloatArray = npt.NDArray[np.float64]
StampArray = npt.NDArray[np.int64]


IMU_BATCH = 1024

HIGHEST_ALTITUDE = 1e5
"""What no receiver on a robot reports (m)."""

ORIENTATION_SHARE = SECOND // 10
"""Of each second so much (ns) of what the IMU says of its orientation is used: a sample at least, from 10 Hz on."""

DIAGONAL = np.eye(3).ravel()

DOOR_REMEDIES = {
    Verdict.NON_FINITE: "carry numbers that are not finite: what does the driver write where it knows nothing?",
    Verdict.BAD_COVARIANCE: "have a covariance that is not positive definite: variances must be positive (all zero "
    "stands for unknown), covariances smaller",
    Verdict.BAD_VALUE: "carry values that cannot be true: look at units and fields",
}
"""What is said when most messages of a stream are refused for what they contain."""

FEWEST_REFUSED = 10

NO_FIELD = (0.0, 0.0, 0.0, 0.0)

NO_STAND_IN = (0.0, 0.0, 0.0)
"""The covariance of a message is its own."""


class Navigator:
    """Error-state Kalman filter over a timeline: the same for the node and for the replay.

    Stamps are int64 nanoseconds on the IMU's clock. A push sorts a message into the timeline; the next ``push_imu``
    or ``update``, or a push that finds the buffers full, does the work. See ``layout`` for the fields of rows
    (ODOMETRY) and records (RECORD).
    """

    def __init__(self, parameters: Parameters, output_rate: float = 0.0) -> None:
        """Prepare a filter; ``output_rate`` (Hz) of the rows ``push_imu`` returns, 0 for every IMU sample."""
        self._output_rate = output_rate
        self._imu = allocate(IMU, 4 * IMU_BATCH)
        self._aids = allocate(AID, 256)
        self._checkpoints = allocate(STATE, 256)
        self._work = allocate(WORK)
        self._rows = allocate(ODOMETRY, len(self._imu))
        self._offered = allocate(AID)
        self._memory: tuple[Memory, float] | None = None
        self.configure(parameters)
        self.reset()

    def configure(self, parameters: Parameters) -> None:
        """Use other parameters from now on; history within the window is judged by them when it is applied again."""
        self.parameters = parameters
        self._settings = settings_from(parameters, self._output_rate)
        self._constraint_count = int(self._settings["constrains"].sum())
        self._intakes = intakes_from(parameters)
        self.needs_field = parameters.mag.use or parameters.alignment.imu_orientation == "magnetic_north"
        if self._memory is not None:
            recall(*self._memory, parameters, self._settings[0])

    def reset(self) -> None:
        """Forget everything, the datum too unless it is a parameter, and what an earlier run knew.

        Records that were not taken are lost.
        """
        self._memory = None
        self._settings["has_memory"] = 0
        self._blank = blank_state()
        if self.parameters.datum:
            latitude, longitude, altitude = self.parameters.datum
            set_datum(self._blank[0], math.radians(latitude), math.radians(longitude), altitude)
        self._states = self._blank.copy()
        self._timeline = allocate(TIMELINE)
        for field in ("frontier", "published", "barrier"):
            self._timeline[field] = NEVER
        self._timeline["rewind_to"] = -NEVER
        self._timeline["window"] = round(self.parameters.history.window * SECOND)
        self._local = allocate(LOCAL)
        self._refused: list[np.ndarray] = []
        self._offered_count: Counter[Stream] = Counter()
        self._refused_count: Counter[Stream] = Counter()
        self._shut_doors: Counter[tuple[Stream, Verdict]] = Counter()
        self._stamp_difference: dict[Stream, float] = {}
        self._early: Counter[Stream] = Counter()
        self._stand_ins = 0
        self.range_statuses: Counter[RangeStatus] = Counter()
        """What became of the signals before they entered the timeline: how many are usable, and why others are not."""
        self._field_problem = ""

    def warm_start(self, memory: Memory, age: float) -> None:
        """Offer what an earlier run knew, ``age`` seconds ago; to be called before the first sample."""
        self._memory = memory, age
        recall(memory, age, self.parameters, self._settings[0])

    def set_datum_here(self) -> bool:
        """Make the present position of the IMU the origin of the map; False while the position is unknown.

        A barrier: what came before is final, and nothing older is accepted afterwards.
        """
        self.update()
        state = self._states[0]
        if not state["position_known"]:
            return False
        ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ state["position_map"]
        latitude, longitude, altitude = ecef_to_geodetic(*ecef)
        self.set_datum(math.degrees(latitude), math.degrees(longitude), altitude)
        return True

    def set_datum(self, latitude_deg: float, longitude_deg: float, altitude: float) -> None:
        """Make a place on the ellipsoid the origin of the map, wherever the robot is. A barrier."""
        self.update()
        state, settings = self._states[0], self._settings[0]
        position, heading = tuple(state["position_map"]), heading_of(state, settings)
        datum = math.radians(latitude_deg), math.radians(longitude_deg), float(altitude)
        if state["position_known"]:
            move_datum(state, *datum, settings)
            forget_search(state)
            forget_tracks(state)
            note_jump(state, position, heading, settings)
        else:
            set_datum(state, *datum)
        self._raise_barrier()

    def set_pose(
        self, position_map: Sequence[float], position_covariance: FloatArray, heading: float, heading_std: float
    ) -> bool:
        """Put base_link to a position in map (m, covariance (3, 3) m2) with a heading (rad); roll and pitch stay.

        False while level or datum are unknown. A barrier.
        """
        self.update()
        state, settings = self._states[0], self._settings[0]
        if not (state["level_known"] and state["frame"]["datum_known"]):
            return False
        before, heading_before = tuple(state["position_map"]), heading_of(state, settings)
        covariance = np.ascontiguousarray(position_covariance, np.float64)
        place(state, tuple(float(v) for v in position_map), covariance, float(heading), float(heading_std), settings)
        forget_tracks(state)
        note_jump(state, before, heading_before, settings)
        self._raise_barrier()
        return True

    def push_imu(self, stamps: StampArray, specific_force: FloatArray, angular_rate: FloatArray) -> np.ndarray:
        """Take IMU samples, shapes (n,), (n, 3) m/s2, (n, 3) rad/s in IMU axes, and run the filter up to the newest.

        Returns the ODOMETRY rows of the newly processed samples on the output grid, as they would have been published.

        Raises:
            TypeError: the stamps are not integers: seconds as floats cannot hold nanoseconds.
            ValueError: an array has another shape.
        """
        stamps = _whole_stamps(stamps)
        specific_force = _vectors("specific_force", specific_force, len(stamps))
        angular_rate = _vectors("angular_rate", angular_rate, len(stamps))
        parts = []
        first = 0
        while first < len(stamps):
            self._make_room()
            batch = min(first + IMU_BATCH, len(stamps))
            first = insert_imu(
                self._imu,
                self._aids,
                self._timeline,
                self._local,
                self._settings,
                stamps[:batch],
                specific_force,
                angular_rate,
                first,
            )
            parts.append(self.update())
        return parts[0] if len(parts) == 1 else np.concatenate([np.zeros(0, ODOMETRY), *parts])

    def update(self) -> np.ndarray:
        """Apply what was pushed, late messages included; return rows as ``push_imu`` does."""
        count = advance(
            self._states,
            self._imu,
            self._aids,
            self._checkpoints,
            self._timeline,
            self._blank,
            self._settings,
            self._work,
            self._local,
            self._rows,
        )
        return _copied(self._rows, count)

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

        ``covariance_type`` and ``status`` as in NavSatFix. An unknown or all-zero covariance takes the table
        ``gnss.status_std_horizontal`` and ``_vertical``. ``frame_id`` tells which antenna it is. ``from_ranges``: it
        was solved here from the ranges of the first receiver (``ranges.use_point_solution``).
        """
        gnss = self.parameters.gnss
        stand_in = NO_STAND_IN
        matrix = _nine(covariance)
        if covariance_type == 0 or not matrix.any():
            level = min(max(status, 0), 2)
            horizontal, vertical = gnss.status_std_horizontal[level] ** 2, gnss.status_std_vertical[level] ** 2
            stand_in = (horizontal, horizontal, vertical)
        values = (math.radians(latitude_deg), math.radians(longitude_deg), float(altitude))
        door = self._admit(Stream.GNSS_POSITION, values, matrix, stand_in)
        if door == Verdict.WAITING:
            if status < 0:
                door = Verdict.NO_FIX
            elif abs(latitude_deg) > 90.0 or abs(longitude_deg) > 360.0 or abs(altitude) > HIGHEST_ALTITUDE:
                door = Verdict.BAD_VALUE
            elif self.needs_field:
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
        ``from_ranges`` as in `push_gnss_position`.
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

        What the values are says the file of the aid in ``aiding``. An all-zero covariance takes the stand-in of the
        parameters; an axis with a negative variance was not measured.
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

        ``stamp``: the instant of the measurement on the IMU's clock; ``instant``: the same in GPS time, to a minute;
        ``klobuchar``: eight parameters of the ionosphere. The signals have been measured without a position, so that
        they do not depend on when they come. ``place``: where the epoch alone puts the antenna (deg, deg, m), as good
        as the Earth's magnetic field needs it (``needs_field``): now and then is enough.
        """
        field = NO_FIELD if place is None or not self.needs_field else self._field_at(*place, stamp)
        self.range_statuses.update(status_counts(signals))
        is_tight, ranges = self.parameters.mode == "tight", self.parameters.ranges
        code_door = Verdict.WAITING if is_tight and ranges.use else Verdict.DISABLED
        rate_door = Verdict.WAITING if is_tight and ranges.use_doppler else Verdict.DISABLED
        stamp = _whole_stamp(stamp) + round(ranges.time_offset * SECOND)
        self._make_room(2 * len(signals))
        refused = np.zeros(2 * len(signals), RECORD)
        count = offer_signals(
            self._aids,
            self._timeline,
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
            self._offered_count[stream] += 1
            verdicts = refused["verdict"][:count][refused["stream"][:count] == stream]
            if len(verdicts):
                self._note_refused(stream, stamp)
            if early := int(np.count_nonzero(verdicts == Verdict.BEFORE_ALIGNMENT)):
                self._early[stream] += early
        if count:
            self._refused.append(refused[:count])

    def push_imu_orientation(self, stamps: StampArray, orientation: FloatArray, covariance: FloatArray) -> None:
        """Take what samples of `push_imu` say of the IMU's orientation: (n, 4) x y z w and (n, 9) rad2, as in REP-145.

        Nothing happens unless ``alignment.imu_orientation`` asks for it; then the first few of each second are enough:
        which these are must not depend on the order in which they come.
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
        """Return the records (RECORD) that became final since the last call: in the total order, the too late last."""
        return self._take_records(False)

    def take_live(self) -> np.ndarray:
        """Return the records of what was judged since the last call, as they stand: a later message may change them."""
        judged = self._aids[: int(self._states["aid_next"][0])]
        new = np.flatnonzero((judged["told"] == 0) & (judged["verdict"] != Verdict.INACTIVE))
        judged["told"] = 1
        return np.array([tuple(judged[name][i] for name in RECORD.names or ()) for i in new], RECORD)

    def finish(self) -> np.ndarray:
        """End the data: return all remaining records, those that waited in vain for the IMU as ``waiting``."""
        self.update()
        return self._take_records(True)

    @property
    def odometry(self) -> np.ndarray:
        """One ODOMETRY row of the state at the newest IMU sample (array of length one)."""
        row = allocate(ODOMETRY)
        write_odometry(self._states[0], self._local[0], self._settings[0], row[0])
        return _copied(row, 1)

    @property
    def state(self) -> np.ndarray:
        """A copy of the whole state (STATE, array of length one)."""
        return np.array(self._states, STATE)

    @property
    def status(self) -> Status:
        """The rung of the start-up ladder at the newest IMU sample."""
        return Status(status_of(self._states[0], self._settings[0]))

    @property
    def memory(self) -> Memory | None:
        """What the next start wants to know (see `warm_start`); None while position or heading are unknown."""
        state, row = self._states[0], self.odometry[0]
        if row["status"] not in (Status.ALIGNING, Status.GOOD, Status.COASTING, Status.DEGRADED):
            return None
        ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ row["position_map"]
        latitude, longitude, altitude = ecef_to_geodetic(*ecef)
        forward_map = np.array(to_matrix(tuple(row["attitude_body_to_map"])))[:, 0]
        east, north, _ = (
            np.array(east_north_up_to_ecef(latitude, longitude)).T @ state["frame"]["map_to_ecef"] @ forward_map
        )
        variances = np.diagonal(row["pose_covariance"])
        biases = {
            name: tuple(row[name].tolist()) for name in ("accel_bias", "accel_bias_std", "gyro_bias", "gyro_bias_std")
        }
        return Memory(
            stamp=int(row["stamp"]),
            latitude_deg=math.degrees(latitude),
            longitude_deg=math.degrees(longitude),
            altitude=float(altitude),
            position_std=math.sqrt(max(variances[:3])),
            heading_deg=math.degrees(math.atan2(north, east)),
            heading_std_deg=math.degrees(math.sqrt(variances[5])),
            **biases,
        )

    @property
    def datum(self) -> tuple[float, float, float] | None:
        """Origin of the map frame: latitude and longitude (deg) and altitude (m), None before the first fix."""
        state = self._states[0]
        if not state["frame"]["datum_known"]:
            return None
        latitude, longitude, altitude = (float(value) for value in state["frame"]["datum"])
        return math.degrees(latitude), math.degrees(longitude), altitude

    @property
    def clock(self) -> tuple[float, float] | None:
        """Bias (m) and drift (m/s) of the receiver's clock; None while ranges have not told both."""
        state, place = self._states[0], int(self._settings["clock_at"][0])
        if place >= state["error_size"] or not state["tight"]["clock_known"].all():
            return None
        bias, drift = state["optional"][place - ERROR_SIZE : place - ERROR_SIZE + 2].tolist()
        return bias, drift

    @property
    def inter_system_offsets(self) -> dict[int, float]:
        """By what the ranges of a constellation (`gnss.signals.time_group`) are longer than those of GPS (m).

        Those of which no signal came are not there.
        """
        state, first = self._states[0], int(self._settings["inter_system_at"][0])
        offsets = state["optional"][first - ERROR_SIZE : max(first, int(state["error_size"])) - ERROR_SIZE].tolist()
        return {group: offset for group, offset in zip(INTER_SYSTEM, offsets) if offset}

    @property
    def latest_epoch(self) -> np.ndarray:
        """Records of the pseudoranges of the newest epoch that was judged, as they stand; none after a long silence."""
        judged = self._aids[: int(self._states["aid_next"][0])]
        codes = judged[judged["stream"] == Stream.PSEUDORANGE]
        newest = codes[codes["stamp"] == codes["stamp"].max(initial=NEVER)]
        return np.array([tuple(row[name] for name in RECORD.names or ()) for row in newest], RECORD)

    @property
    def clock_jumps(self) -> int:
        """Milliseconds by which the receiver's clock has jumped, to either side."""
        return int(self._states["tight"]["clock_jumps"][0])

    @property
    def range_faults(self) -> int:
        """How often most satellites contradicted the estimate, which was then given the uncertainty they show."""
        return int(self._states["tight"]["range_faults"][0])

    @property
    def imu_counts(self) -> dict[str, int]:
        """IMU samples offered, and refused or replaced by reason."""
        names = ("offered", "duplicate", "late", "bad_value", "bad_stamp")
        return {name: int(self._timeline[f"imu_{name}"][0]) for name in names}

    @property
    def waiting(self) -> int:
        """How many measurements wait for the IMU samples of their time."""
        return int(self._timeline["aid_count"][0] - self._states["aid_next"][0])

    @property
    def window_needed(self) -> float:
        """The window (s) that would have kept every message so far; 0 when none was too late."""
        return float(self._timeline["furthest_late"][0]) / SECOND

    @property
    def restarts(self) -> int:
        """How often the alignment started again: after a long silence of the IMU, or many rejected fixes in a row."""
        return int(self._states["restarts"][0])

    @property
    def position_resets(self) -> int:
        """How often fixes that agree with each other won over the filter: position and velocity were reset to them."""
        return int(self._states["recovery"]["resets"][0])

    def phase(self, stream: Stream, source: int = 0) -> Phase:
        """Return what an aid is to the filter at the moment; ``source``: which receiver."""
        return Phase(phase_of(self._states[0], int(stream), source))

    @property
    def complaints(self) -> list[str]:
        """What is wrong with whole streams, one sentence each with what to do; empty when nothing is."""
        state = self._states[0]
        found = complaints(state)
        # With a wrong heading the fixes seem to be wrong in many ways, which then mean nothing.
        if not is_heading_contradicted(state):
            found += aid_complaints(state, self._settings[0])
        if self._field_problem:
            found.append(self._field_problem)
        for (stream, verdict), count in self._shut_doors.items():
            offered = self._offered_count[stream]
            if verdict in DOOR_REMEDIES and count >= FEWEST_REFUSED and 2 * count > offered:
                found.append(f"{count} of {offered} messages of {stream.name.lower()} {DOOR_REMEDIES[verdict]}")
        for stream, count in self._early.items():
            found.append(
                f"{count} measurements of {stream.name.lower()} were dropped because more than {EARLY_AIDS} waited for "
                "the first IMU sample: push measurements and IMU samples in the order of their stamps, or "
                "look why the IMU is silent"
            )
        for stream, difference in self._stamp_difference.items():
            if 2 * self._refused_count[stream] > self._offered_count[stream]:
                found.append(
                    f"the stamps of {stream.name.lower()} are {abs(difference):.1f} s "
                    f"{'ahead of' if difference > 0.0 else 'behind'} the IMU's: synchronise the clocks, or set the "
                    "time_offset of the stream"
                )
        return found

    @property
    def notes(self) -> list[str]:
        """What is worth knowing of the streams though nothing is wrong: one sentence each."""
        if not self._stand_ins:
            return []
        return [
            f"{self._stand_ins} messages came without a covariance (unknown type or all zero): "
            "gnss.status_std_horizontal, gnss.status_std_vertical and the unknown_..._std of the parameters stand in "
            "for it"
        ]

    @property
    def held_bytes(self) -> int:
        """Memory of the history buffers: grows with window and rates, not with time."""
        return sum(buffer.nbytes for buffer in (self._imu, self._aids, self._checkpoints, self._rows))

    def _take(self, stream: Stream, values: Sequence[float], covariance: Sequence[float] | FloatArray) -> int:
        """Fill the payload on offer, with the stand-in where no covariance came; return its door."""
        intake = self._intakes[stream]
        matrix = _nine(covariance)
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
        """Fill the payload on offer; return its door."""
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
            self._stand_ins += 1
        return Verdict.WAITING

    def _field_at(
        self, latitude_deg: float, longitude_deg: float, altitude: float, stamp: int
    ) -> tuple[float, float, float, float]:
        """Return the Earth's magnetic field at a fix, a function of the fix alone, as `mag.note_field` wants it."""
        declination = math.radians(self.parameters.mag.declination_deg)
        try:
            found, inclination, strength = field_at(latitude_deg, longitude_deg, altitude, stamp)
        except FieldUnknown as problem:
            if math.isnan(declination):
                self._field_problem = str(problem)
                return NO_FIELD
            found, inclination, strength = declination, 0.0, 0.0
        if math.isnan(declination):
            declination = found
        return 1.0, declination, inclination, strength

    def _push_gnss(self, stream: Stream, stamp: int, arrival: int, frame_id: str, from_ranges: bool, door: int) -> None:
        """Sort the record that is on offer into the timeline, as one of the receiver with this frame."""
        second, ranges = self.parameters.second_gnss, self.parameters.ranges
        is_second = second.frame_id != "" and frame_id == second.frame_id and not from_ranges
        receiver = ranges if from_ranges else second if is_second else self.parameters.gnss
        uses_ranges = self.parameters.mode == "tight" or ranges.use_point_solution
        if uses_ranges and not is_second and not from_ranges:
            # The fix is made of the same ranges: both together would count twice.
            door = Verdict.DISABLED
        self._push_aid(stream, stamp + round(receiver.time_offset * SECOND), arrival, int(is_second), door)

    def _push_aid(self, stream: Stream, stamp: int, arrival: int, source: int, door: int) -> None:
        """Sort the record that is on offer into the timeline."""
        stamp = _whole_stamp(stamp)
        self._offered_count[stream] += 1
        if door != Verdict.WAITING:
            self._shut_doors[stream, Verdict(door)] += 1
        self._make_room()
        refused = offer_aid(self._aids, self._timeline, self._offered, stamp, arrival, int(stream), source, door)
        if refused:
            self._refuse(stream, stamp, arrival, source, Verdict(refused))

    def _refuse(self, stream: Stream, stamp: int, arrival: int, source: int, verdict: Verdict) -> None:
        """Record a measurement that never enters the timeline."""
        if verdict == Verdict.BEFORE_ALIGNMENT:
            self._early[stream] += 1
        self._note_refused(stream, stamp)
        record = (stamp, arrival, stream, source, verdict, 0, math.nan, (math.nan,) * 3)
        self._refused.append(np.array([record], RECORD))

    def _note_refused(self, stream: Stream, stamp: int) -> None:
        frontier = int(self._timeline["frontier"][0])
        if frontier != NEVER:
            self._refused_count[stream] += 1
            self._stamp_difference[stream] = (stamp - frontier) / SECOND

    def _raise_barrier(self) -> None:
        """Make what came so far final: see `timeline.raise_barrier`."""
        if self._timeline["frontier"][0] != NEVER:
            records = self._take_records(True)
            self._refused.append(records)
        raise_barrier(self._states, self._blank, self._timeline)

    def _take_records(self, everything: bool) -> np.ndarray:
        records = allocate(RECORD, max(1, int(self._timeline["aid_count"][0] - self._timeline["recorded"][0])))
        count = take_final(self._aids, self._timeline, records, everything)
        refused, self._refused = self._refused, []
        return np.concatenate([np.array(records[:count], RECORD), *refused])

    def _forget(self) -> None:
        """Drop what no message in time can reach any more."""
        self.update()
        forget(self._states, self._imu, self._aids, self._checkpoints, self._timeline)

    def _make_room(self, aids: int = 1) -> None:
        """See that one batch of IMU samples with its checkpoints, and so many aids, fit into the buffers."""
        timeline = self._timeline
        checkpoints_needed = IMU_BATCH // CHECKPOINT_SPACING + 2
        # An interval between two samples has room for one grid point of the constraints.
        aids_needed = 1 + aids + IMU_BATCH * self._constraint_count
        if (
            len(self._imu) >= timeline["imu_count"][0] + IMU_BATCH
            and len(self._aids) >= timeline["aid_count"][0] + aids_needed
            and len(self._checkpoints) >= timeline["checkpoint_count"][0] + checkpoints_needed
        ):
            return
        self._forget()
        while len(self._imu) < 2 * (timeline["imu_count"][0] + IMU_BATCH):
            self._imu = doubled(self._imu)
            self._rows = doubled(self._rows)
        while len(self._aids) < 2 * (timeline["aid_count"][0] + aids_needed):
            self._aids = doubled(self._aids)
        while len(self._checkpoints) < 2 * (timeline["checkpoint_count"][0] + checkpoints_needed):
            self._checkpoints = doubled(self._checkpoints)


def compile_kernels() -> None:
    """Compile all that a `Navigator` calls, or load it from the cache: nothing of it is left for a callback."""
    trial = Navigator(Parameters())
    stamp, point, unit = SECOND, (0.0, 0.0, 0.0), np.eye(3).ravel()
    trial.push_imu(np.array([stamp]), np.array([[0.0, 0.0, 9.8]]), np.zeros((1, 3)))
    trial.push_gnss_position(stamp, *point, unit, 2, 0)
    trial.push_gnss_velocity(stamp, point, unit)
    trial.push_ranges(stamp, (0, 0.0), np.zeros(1, MEASURED_SIGNAL))
    trial.take_records()
    trial.odometry  # noqa: B018 - asked for its side effect
    trial.status  # noqa: B018
    trial.phase(Stream.GNSS_POSITION)
    trial._forget()
    trial.take_live()
    trial.set_datum(0.0, 0.0, 0.0)
    # Known by decree: these ask for level or position first.
    trial._states["level_known"] = 1
    trial.set_pose(point, np.eye(3), 0.0, 1.0)
    trial.set_datum_here()


def _copied(records: np.ndarray, count: int) -> np.ndarray:
    """Return the first records in memory of their own: through bytes, because numpy copies them field by field."""
    return np.frombuffer(bytearray(records[:count].tobytes()), records.dtype)


def _whole_stamp(stamp: int) -> int:
    """Return a stamp as an int; raises TypeError for one that is not an integer."""
    try:
        return operator.index(stamp)
    except TypeError:
        raise TypeError(
            f"the stamp {stamp!r} is not an integer: stamps are int64 nanoseconds; for seconds: round(seconds * 1e9)"
        ) from None


def _whole_stamps(stamps: StampArray) -> StampArray:
    """Return stamps as int64; raises TypeError for those that are not integers."""
    found = np.asarray(stamps)
    if found.ndim != 1:
        raise ValueError(f"stamps have the shape {found.shape}; one row of n is needed: (n,)")
    if len(found) and not np.issubdtype(found.dtype, np.integer):
        raise TypeError(
            f"stamps are of type {found.dtype}: they must be int64 nanoseconds; for seconds: "
            "np.round(seconds * 1e9).astype(np.int64)"
        )
    return np.ascontiguousarray(found, np.int64)


def _vectors(name: str, values: FloatArray, count: int) -> FloatArray:
    """Return a vector for each of ``count`` stamps as float64 (n, 3); raises ValueError for another shape."""
    found = np.ascontiguousarray(values, np.float64)
    if found.shape != (count, 3):
        raise ValueError(f"{name} has the shape {found.shape}; {count} stamps need ({count}, 3)")
    return found


def _nine(covariance: Sequence[float] | FloatArray) -> FloatArray:
    """Return a covariance, (9,) row-major or (3, 3), as (9,); raises ValueError for another size."""
    found = np.ascontiguousarray(covariance, np.float64)
    if found.shape not in ((9,), (3, 3)):
        raise ValueError(f"a covariance has the shape {found.shape}; nine numbers row by row or (3, 3) are needed")
    return found.reshape(9)
