"""The navigator: push a sensor sample, get the state. ``advance`` is the whole algorithm."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.filter.aiding import gnss_position, gnss_velocity, nhc, wheel, zaru, zupt
from eskf_ros.filter.alignment import (
    heading_of,
    move_datum,
    note_position,
    note_velocity,
    place,
    recall_heading,
    restart,
    search_heading,
    set_datum,
    start_position,
    watch_stillness,
)
from eskf_ros.filter.door import admit
from eskf_ros.filter.layout import (
    AID,
    CONSTRAINTS,
    IMU,
    LOCAL,
    NEVER,
    ODOMETRY,
    RECORD,
    STATE,
    TIMELINE,
    WORK,
    Status,
    Stream,
    Verdict,
    allocate,
    blank_state,
)
from eskf_ros.filter.local import carry, measure_step, note_jump
from eskf_ros.filter.monitors import complaints
from eskf_ros.filter.optional import join
from eskf_ros.filter.output import status_of, write_odometry
from eskf_ros.filter.recovery import is_near_gate, judge_filter, update_weighed_down, watch_solution
from eskf_ros.filter.settings import intakes_from, settings_from
from eskf_ros.filter.stillness import add_to_block, note_evidence, watch_wheels
from eskf_ros.filter.strapdown import SECOND, propagate
from eskf_ros.filter.timeline import (
    CHECKPOINT_SPACING,
    doubled,
    forget,
    insert_aid,
    insert_imu,
    is_duplicate,
    raise_barrier,
    rewind,
    save_checkpoint,
    take_final,
)
from eskf_ros.filter.update import update
from eskf_ros.filter.warm_start import Memory, recall
from eskf_ros.parameters import Parameters
from eskf_ros.rotation import to_matrix

FloatArray = npt.NDArray[np.float64]
StampArray = npt.NDArray[np.int64]

GNSS_POSITION = int(Stream.GNSS_POSITION)
GNSS_VELOCITY = int(Stream.GNSS_VELOCITY)
WHEEL = int(Stream.WHEEL)
ZUPT = int(Stream.ZUPT)
ZARU = int(Stream.ZARU)
NHC = int(Stream.NHC)
OPEN_DOOR = int(Verdict.WAITING)
FIRST_CONSTRAINT = int(min(CONSTRAINTS))
FUSED = int(Verdict.FUSED)
DUPLICATE = int(Verdict.DUPLICATE)
BEFORE_ALIGNMENT = int(Verdict.BEFORE_ALIGNMENT)
INACTIVE = int(Verdict.INACTIVE)

LONGEST_GAP = 5 * SECOND
"""The IMU was silent for longer (ns): nothing is left of attitude and velocity, start again."""

IMU_BATCH = 1024

HIGHEST_ALTITUDE = 1e5
"""What no receiver on a robot reports (m)."""

NO_STAND_IN = (0.0, 0.0, 0.0)
"""The covariance of a message is its own."""


@njit
def advance(states, imu, aids, checkpoints, timeline, blank, settings_, work_, locals_, rows):
    """Run the filter over all that waits, in the total order; return how many rows were written.

    One row for every IMU sample that is new and first on the output grid.
    """
    t, settings, work, local = timeline[0], settings_[0], work_[0], locals_[0]
    rewind(states, checkpoints, t, blank)
    state = states[0]
    row_count = 0
    while state.imu_next < t.imu_count:
        sample = imu[state.imu_next]

        while state.aid_next < t.aid_count and aids[state.aid_next].stamp < sample.stamp:
            predict(state, aids[state.aid_next].stamp, sample, settings, work)
            fuse(state, aids, state.aid_next, settings, work)
            state.aid_next += 1

        previous_stamp = state.imu_stamp
        predict(state, sample.stamp, sample, settings, work)
        take_sample(state, sample)
        measure_step(state, settings)
        watch_stillness(state, settings)
        add_to_block(state, settings)
        save_checkpoint(states, checkpoints, t)

        is_new = sample.stamp > t.published and state.level_known == 1
        if is_new:
            carry(local, state, settings)

        while state.aid_next < t.aid_count and aids[state.aid_next].stamp == sample.stamp:
            fuse(state, aids, state.aid_next, settings, work)
            state.aid_next += 1

        if is_new and is_on_grid(previous_stamp, sample.stamp, settings.output_interval):
            write_odometry(state, local, settings, rows[row_count])
            row_count += 1
        t.published = max(t.published, sample.stamp)
    return row_count


@njit
def predict(state, stamp, sample, settings, work):
    """Bring the state to ``stamp``, at or before the IMU sample that comes next."""
    if state.level_known == 0:
        return
    if sample.stamp - state.imu_stamp > LONGEST_GAP:
        restart(state)
        return
    propagate(state, stamp, sample, settings, work)


@njit
def take_sample(state, sample):
    """Make an IMU sample the newest reading of the state."""
    if state.imu_stamp != NEVER:
        state.imu_interval = (sample.stamp - state.imu_stamp) * 1e-9
    state.imu_stamp = sample.stamp
    state.stamp = sample.stamp
    state.imu_next += 1
    for i in range(3):
        state.earlier_force[i] = state.imu_force[i]
        state.earlier_rate[i] = state.imu_rate[i]
        state.imu_force[i] = sample.specific_force[i]
        state.imu_rate[i] = sample.angular_rate[i]
        state.specific_force[i] = sample.specific_force[i]
        state.angular_rate[i] = sample.angular_rate[i]


@njit
def fuse(state, aids, i, settings, work):
    """Offer one measurement to the state and leave the verdict in its record."""
    aid = aids[i]
    aid.verdict = aid.door
    aid.nis = np.nan
    aid.dof = 0
    for k in range(3):
        aid.innovation[k] = np.nan
    if aid.door != OPEN_DOOR:
        return
    if is_duplicate(aids, i):
        aid.verdict = DUPLICATE
        return
    if aid.stream == GNSS_POSITION:
        note_position(state, aid, settings)
    elif aid.stream == GNSS_VELOCITY:
        note_velocity(state, aid, settings)
    note_evidence(state, aid, settings)
    if not is_aligned_for(state, aid.stream):
        aid.verdict = BEFORE_ALIGNMENT if aid.stream < FIRST_CONSTRAINT else INACTIVE
        return
    position = (state.position_map[0], state.position_map[1], state.position_map[2])
    heading = heading_of(state, settings)
    if state.position_known == 0 and aid.stream == GNSS_POSITION:
        start_position(state, aid.payload)
        recall_heading(state, aid.payload, settings)
    join(state, settings.reach[aid.stream], settings)
    if aid.stream == GNSS_POSITION:
        watch_solution(state, aid, settings)
    size = linearize(state, aid, settings, work)
    if size == 0:
        aid.verdict = INACTIVE
        return
    gate = settings.gate[aid.stream, size]
    for k in range(size):
        aid.innovation[k] = work.innovation[k]
    aid.dof = size
    aid.verdict, aid.nis = update(state, size, gate, work)
    if aid.stream == GNSS_POSITION and is_near_gate(aid.verdict, aid.nis, gate):
        linearize(state, aid, settings, work)
        aid.verdict = update_weighed_down(state, size, aid.nis / gate, work)
    if aid.verdict == FUSED and state.heading_known == 0:
        search_heading(state, aid, gate, settings, work)
    if aid.stream == GNSS_POSITION:
        judge_filter(state, aid.verdict)
    elif aid.stream == WHEEL:
        watch_wheels(state, aid)
    note_jump(state, position, heading, settings)


@njit
def is_aligned_for(state, stream):
    """Say whether the start-up is far enough for a measurement of a stream."""
    if state.level_known == 0:
        return False
    if stream == GNSS_POSITION:
        return True
    if stream == GNSS_VELOCITY:
        return state.position_known == 1
    return state.position_known == 1 and state.heading_known == 1


@njit
def linearize(state, aid, settings, work):
    """Write innovation, Jacobian and noise of one measurement to ``work``; return its size. The list of aids.

    Size 0: the measurement says nothing in this state.
    """
    if aid.stream == GNSS_POSITION:
        return gnss_position.linearize(state, aid.payload, aid.source, settings, work)
    if aid.stream == WHEEL:
        return wheel.linearize(state, aid.payload, settings, work)
    if aid.stream == ZUPT:
        return zupt.linearize(state, settings, work)
    if aid.stream == ZARU:
        return zaru.linearize(state, settings, work)
    if aid.stream == NHC:
        return nhc.linearize(state, settings, work)
    return gnss_velocity.linearize(state, aid.payload, aid.source, settings, work)


@njit
def is_on_grid(previous_stamp, stamp, interval):
    """Say whether a multiple of ``interval`` (0: everything) lies in (previous_stamp, stamp]."""
    return interval == 0 or previous_stamp == NEVER or stamp // interval != previous_stamp // interval


class Navigator:
    """Error-state Kalman filter over a timeline: the same for the node and for the replay.

    Stamps are int64 nanoseconds on the IMU's clock. Pushes only sort a message into the timeline; the next
    ``push_imu`` or ``update`` does the work. See ``layout`` for the fields of rows (ODOMETRY) and records (RECORD).
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
        self._intakes = intakes_from(parameters)
        if self._memory is not None:
            recall(*self._memory, parameters, self._settings[0])

    def reset(self) -> None:
        """Forget everything, the datum too unless it is a parameter; records that were not taken are lost."""
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
        self._stamp_difference: dict[Stream, float] = {}
        self._stand_ins = 0

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
        ecef = state["origin_ecef"] + state["map_to_ecef"] @ state["position_map"]
        latitude, longitude, altitude = ecef_to_geodetic(*ecef)
        self.set_datum(math.degrees(latitude), math.degrees(longitude), altitude)
        return True

    def set_datum(self, latitude_deg: float, longitude_deg: float, altitude: float) -> None:
        """Make a place on the ellipsoid the origin of the map, wherever the robot is. A barrier."""
        self.update()
        state, settings = self._states[0], self._settings[0]
        position, heading = tuple(state["position_map"]), heading_of(state, settings)
        self._refused.insert(0, self._take_records(True))
        datum = math.radians(latitude_deg), math.radians(longitude_deg), float(altitude)
        if state["position_known"]:
            move_datum(state, *datum, settings)
            note_jump(state, position, heading, settings)
        else:
            set_datum(state, *datum)
        raise_barrier(self._states, self._blank, self._timeline)

    def set_pose(
        self, position_map: Sequence[float], position_covariance: FloatArray, heading: float, heading_std: float
    ) -> bool:
        """Put base_link to a position in map (m, covariance (3, 3) m2) with a heading (rad); roll and pitch stay.

        False while level or datum are unknown. A barrier.
        """
        self.update()
        state, settings = self._states[0], self._settings[0]
        if not (state["level_known"] and state["datum_known"]):
            return False
        before, heading_before = tuple(state["position_map"]), heading_of(state, settings)
        self._refused.insert(0, self._take_records(True))
        covariance = np.ascontiguousarray(position_covariance, np.float64)
        place(state, tuple(float(v) for v in position_map), covariance, float(heading), float(heading_std), settings)
        note_jump(state, before, heading_before, settings)
        raise_barrier(self._states, self._blank, self._timeline)
        return True

    def push_imu(self, stamps: StampArray, specific_force: FloatArray, angular_rate: FloatArray) -> np.ndarray:
        """Take IMU samples, shapes (n,), (n, 3) m/s2, (n, 3) rad/s in IMU axes, and run the filter up to the newest.

        Returns the ODOMETRY rows of the newly processed samples on the output grid, as they would have been published.
        """
        stamps = np.ascontiguousarray(stamps, np.int64)
        specific_force = np.ascontiguousarray(specific_force, np.float64)
        angular_rate = np.ascontiguousarray(angular_rate, np.float64)
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
    ) -> None:
        """Take a position of the antenna: degrees, ellipsoidal metres, nine numbers East-North-Up (m2, row-major).

        ``covariance_type`` and ``status`` as in NavSatFix. An unknown or all-zero covariance takes the table
        ``gnss.status_std_horizontal`` and ``_vertical``. ``frame_id`` tells which antenna it is.
        """
        gnss = self.parameters.gnss
        stand_in = NO_STAND_IN
        matrix = np.ascontiguousarray(covariance, np.float64)
        if covariance_type == 0 or not matrix.any():
            level = min(max(status, 0), 2)
            horizontal, vertical = gnss.status_std_horizontal[level] ** 2, gnss.status_std_vertical[level] ** 2
            stand_in = (horizontal, horizontal, vertical)
        values = (math.radians(latitude_deg), math.radians(longitude_deg), float(altitude))
        aid = self._admit(Stream.GNSS_POSITION, values, matrix, stand_in)
        if aid["door"] == Verdict.WAITING and status < 0:
            aid["door"] = Verdict.NO_FIX
        elif aid["door"] == Verdict.WAITING and (
            abs(latitude_deg) > 90.0 or abs(longitude_deg) > 360.0 or abs(altitude) > HIGHEST_ALTITUDE
        ):
            aid["door"] = Verdict.BAD_VALUE
        self._push_gnss(Stream.GNSS_POSITION, stamp, arrival, frame_id)

    def push_gnss_velocity(
        self,
        stamp: int,
        velocity_enu: Sequence[float],
        covariance: Sequence[float] | FloatArray,
        arrival: int = 0,
        frame_id: str = "",
    ) -> None:
        """Take a velocity of the antenna relative to the Earth: East-North-Up m/s, nine numbers m2/s2 (row-major).

        An all-zero or absent covariance (first number negative) becomes ``gnss.unknown_velocity_std``. ``frame_id``
        tells which antenna it is.
        """
        self._take(Stream.GNSS_VELOCITY, velocity_enu, covariance)
        self._push_gnss(Stream.GNSS_VELOCITY, stamp, arrival, frame_id)

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
        self._take(stream, values, covariance)
        self._push_aid(stream, stamp + round(self._intakes[stream].time_offset * SECOND), arrival)

    def take_records(self) -> np.ndarray:
        """Return the records (RECORD) that became final since the last call: in the total order, the too late last."""
        return self._take_records(False)

    def take_live(self) -> np.ndarray:
        """Return the records of what was judged since the last call, as they stand: a later message may change them."""
        judged = self._aids[: int(self._states["aid_next"][0])]
        new = np.flatnonzero((judged["told"] == 0) & (judged["verdict"] != INACTIVE))
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
        ecef = state["origin_ecef"] + state["map_to_ecef"] @ row["position_map"]
        latitude, longitude, altitude = ecef_to_geodetic(*ecef)
        forward_map = np.array(to_matrix(tuple(row["attitude_body_to_map"])))[:, 0]
        east, north, _ = np.array(east_north_up_to_ecef(latitude, longitude)).T @ state["map_to_ecef"] @ forward_map
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
        if not state["datum_known"]:
            return None
        latitude, longitude, altitude = (float(value) for value in state["datum"])
        return math.degrees(latitude), math.degrees(longitude), altitude

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
    def complaints(self) -> list[str]:
        """What is wrong with whole streams, one sentence each with what to do; empty when nothing is."""
        found = complaints(self._states[0])
        if self._stand_ins:
            found.append(
                f"{self._stand_ins} messages came without a covariance (unknown type or all zero): "
                "gnss.status_std_horizontal, gnss.status_std_vertical and the unknown_..._std of the parameters stand "
                "in for it"
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
    def held_bytes(self) -> int:
        """Memory of the history buffers: grows with window and rates, not with time."""
        return sum(buffer.nbytes for buffer in (self._imu, self._aids, self._checkpoints, self._rows))

    def _take(self, stream: Stream, values: Sequence[float], covariance: Sequence[float] | FloatArray) -> None:
        """Fill the record that is on offer, with the stand-in where no covariance came; judge its payload."""
        intake = self._intakes[stream]
        matrix = np.ascontiguousarray(covariance, np.float64)
        is_absent = not matrix.any() or (matrix[0] < 0.0 and not intake.may_lack_axes)
        x, y, z = intake.unknown_std
        stand_in = (x * x, y * y, z * z) if is_absent else NO_STAND_IN
        self._admit(stream, (float(values[0]), float(values[1]), float(values[2])), matrix, stand_in)

    def _admit(
        self,
        stream: Stream,
        values: tuple[float, float, float],
        covariance: FloatArray,
        stand_in: tuple[float, float, float],
    ) -> np.ndarray:
        """Fill the record that is on offer, and judge its payload."""
        intake = self._intakes[stream]
        scale, floor, lacks = intake.covariance_scale, intake.std_floor, intake.may_lack_axes
        admit(self._offered, values, covariance, stand_in, scale, floor, lacks)
        aid = self._offered[0]
        if not intake.is_used:
            aid["door"] = Verdict.DISABLED
        elif aid["door"] == Verdict.WAITING and max(map(abs, values)) > intake.largest:
            aid["door"] = Verdict.BAD_VALUE
        if aid["door"] == Verdict.WAITING and stand_in is not NO_STAND_IN:
            self._stand_ins += 1
        return aid

    def _push_gnss(self, stream: Stream, stamp: int, arrival: int, frame_id: str) -> None:
        """Sort the record that is on offer into the timeline, as one of the receiver with this frame."""
        second = self.parameters.second_gnss
        is_second = second.frame_id != "" and frame_id == second.frame_id
        offset = second.time_offset if is_second else self.parameters.gnss.time_offset
        self._push_aid(stream, stamp + round(offset * SECOND), arrival, int(is_second))

    def _push_aid(self, stream: Stream, stamp: int, arrival: int, source: int = 0) -> None:
        """Sort the record that is on offer into the timeline."""
        self._offered_count[stream] += 1
        aid = self._offered[0]
        aid["source"] = source
        aid["stamp"], aid["arrival"], aid["stream"], aid["verdict"] = stamp, arrival, stream, aid["door"]
        self._make_room()
        refused = insert_aid(self._aids, self._timeline, self._offered)
        if refused:
            self._refuse(stream, stamp, arrival, source, Verdict(refused))

    def _refuse(self, stream: Stream, stamp: int, arrival: int, source: int, verdict: Verdict) -> None:
        """Record a measurement that never enters the timeline."""
        frontier = int(self._timeline["frontier"][0])
        if frontier != NEVER:
            self._refused_count[stream] += 1
            self._stamp_difference[stream] = (stamp - frontier) / SECOND
        record = (stamp, arrival, stream, source, verdict, 0, math.nan, (math.nan,) * 3)
        self._refused.append(np.array([record], RECORD))

    def _take_records(self, everything: bool) -> np.ndarray:
        records = allocate(RECORD, max(1, int(self._timeline["aid_count"][0] - self._timeline["recorded"][0])))
        count = take_final(self._aids, self._timeline, records, everything)
        refused, self._refused = self._refused, []
        return np.concatenate([np.array(records[:count], RECORD), *refused])

    def _forget(self) -> None:
        """Drop what no message in time can reach any more."""
        self.update()
        forget(self._states, self._imu, self._aids, self._checkpoints, self._timeline)

    def _make_room(self) -> None:
        """See that one batch of IMU samples with its checkpoints, and one aid, fit into the buffers."""
        timeline = self._timeline
        checkpoints_needed = IMU_BATCH // CHECKPOINT_SPACING + 2
        # An interval between two samples has room for one grid point of the constraints.
        aids_needed = 2 + IMU_BATCH * int(self._settings["constrains"].sum())
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
    trial.take_records()
    trial.odometry  # noqa: B018 - asked for its side effect
    trial.status  # noqa: B018
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
