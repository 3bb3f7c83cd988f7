"""Readout of a filter: the estimate, its status, counts and warnings. Nothing here changes the filter."""

from __future__ import annotations

import math

import numpy as np

from eskf_ros.filter.alignment.warm_start import Memory
from eskf_ros.filter.history.arguments import copied
from eskf_ros.filter.history.buffers import Buffers
from eskf_ros.filter.history.clock_steps import ClockSteps, Step
from eskf_ros.filter.history.records import RECORD
from eskf_ros.filter.integrity.heading_monitor import is_heading_contradicted
from eskf_ros.filter.integrity.motion_monitor import lag_of_receiver
from eskf_ros.filter.integrity.motion_report import motion_complaints, travel_complaints
from eskf_ros.filter.integrity.receiver_report import aid_complaints, aid_notes
from eskf_ros.filter.integrity.recovery import phase_of
from eskf_ros.filter.integrity.repeated_fixes import repeat_complaints
from eskf_ros.filter.integrity.report import gap_complaints, imu_faults, other_complaints
from eskf_ros.filter.integrity.sample_report import axis_complaints, noise_complaints, sample_complaints
from eskf_ros.filter.integrity.traffic import Traffic, imu_complaints
from eskf_ros.filter.layout import STATE
from eskf_ros.filter.output.global_odometry import ODOMETRY, write_odometry
from eskf_ros.filter.output.status import quality_of, status_of
from eskf_ros.filter.state.enums import Phase, Quality, Status, Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, INTER_SYSTEM
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER, SECOND
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.geodesy.rotation import to_matrix
from eskf_ros.parameters.tree import Parameters


class Readout:
    """The readable side of a `Navigator`, which owns the data."""

    parameters: Parameters
    _states: np.ndarray
    _settings: np.ndarray
    _local: np.ndarray
    _buffers: Buffers
    _traffic: Traffic
    _clock: ClockSteps

    @property
    def odometry(self) -> np.ndarray:
        """One ODOMETRY row of the state at the newest IMU sample (array of length one)."""
        row = allocate(ODOMETRY)
        write_odometry(self._states[0], self._local[0], self._settings[0], row[0])
        row["stamp"] = self._clock.stamps_of(row["stamp"])
        return copied(row, 1)

    @property
    def state(self) -> np.ndarray:
        """A copy of the whole state (STATE, array of length one), in times of the timeline (`history.clock_steps`)."""
        return np.array(self._states[:1], STATE)

    def stamps_of(self, times: np.ndarray) -> np.ndarray:
        """Return the stamps (ns) that times (n,) of the timeline had on the clock of then (`history.clock_steps`)."""
        return self._clock.stamps_of(times)

    @property
    def status(self) -> Status:
        """The `Status` at the newest IMU sample."""
        return Status(status_of(self._states[0], self._settings[0]))

    @property
    def quality(self) -> Quality:
        """The `Quality` at the newest IMU sample: whether the estimate may be used for navigation."""
        state, settings = self._states[0], self._settings[0]
        return Quality(quality_of(state, status_of(state, settings), settings))

    @property
    def memory(self) -> Memory | None:
        """What the next run needs for a warm start (`warm_start`); None while position or heading are unknown."""
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
        """Bias (m) and drift (m/s) of the receiver clock; None until ranges have determined both."""
        state, place = self._states[0], int(self._settings["clock_at"][0])
        if place >= state["error_size"] or not state["tight"]["clock_known"].all():
            return None
        bias, drift = state["optional"][place - ERROR_SIZE : place - ERROR_SIZE + 2].tolist()
        return bias, drift

    @property
    def inter_system_offsets(self) -> dict[int, float]:
        """Offset of the ranges of a constellation (`gnss.signals.time_group`) from those of GPS (m).

        Constellations without a signal are absent.
        """
        state, first = self._states[0], int(self._settings["inter_system_at"][0])
        offsets = state["optional"][first - ERROR_SIZE : max(first, int(state["error_size"])) - ERROR_SIZE].tolist()
        return {group: offset for group, offset in zip(INTER_SYSTEM, offsets) if offset}

    @property
    def latest_epoch(self) -> np.ndarray:
        """Records of the pseudoranges of the newest epoch that was judged, as they stand; none after a long silence."""
        judged = self._buffers.aids[: int(self._states["aid_next"][0])]
        codes = judged[judged["stream"] == Stream.PSEUDORANGE]
        newest = codes[codes["stamp"] == codes["stamp"].max(initial=NEVER)]
        records = np.array([tuple(row[name] for name in RECORD.names or ()) for row in newest], RECORD)
        records["stamp"] = self._clock.stamps_of(records["stamp"])
        return records

    @property
    def clock_jumps(self) -> int:
        """Milliseconds by which the receiver clock has jumped, the jumps of either sign added up."""
        return int(self._states["tight"]["clock_jumps"][0])

    @property
    def range_faults(self) -> int:
        """How often most satellites contradicted the estimate, whose variance was then inflated."""
        return int(self._states["tight"]["range_faults"][0])

    @property
    def imu_counts(self) -> dict[str, int]:
        """IMU samples offered, and refused or replaced by reason."""
        names = ("offered", "duplicate", "late", "bad_value", "bad_stamp")
        return {name: int(self._buffers.timeline[f"imu_{name}"][0]) for name in names}

    @property
    def clock_steps(self) -> list[Step]:
        """When the clock of the IMU's stamps was set, and by how much."""
        return list(self._clock.steps)

    @property
    def clock_complaints(self) -> list[str]:
        """A sentence on these steps, with what to do; empty without steps."""
        return self._clock.complaints()

    @property
    def waiting(self) -> int:
        """Number of measurements that wait for IMU samples of their time."""
        return int(self._buffers.timeline["aid_count"][0] - self._states["aid_next"][0])

    @property
    def window_needed(self) -> float:
        """The history window (s) that would have accepted every message so far; 0 if none was too late."""
        return float(self._buffers.timeline["furthest_late"][0]) / SECOND

    @property
    def restarts(self) -> int:
        """Number of restarts of the alignment: after a long silence of the IMU, or many rejected fixes in a row."""
        return int(self._states["restarts"][0])

    @property
    def doubt(self) -> float:
        """How much the noise of the IMU is widened at present: 0 as told, 1 as for the humble lane."""
        return float(self._states["doubt"][0])

    @property
    def takeovers(self) -> int:
        """How often the filter has continued from the humble lane, which predicted the receivers better."""
        return int(self._states["trust"]["takeovers"][0])

    @property
    def position_resets(self) -> int:
        """How often rejected fixes that agree with each other won over the filter: position and velocity were reset."""
        return int(self._states["recovery"]["resets"][0])

    def phase(self, stream: Stream, source: int = 0) -> Phase:
        """Return whether the filter uses a stream at present; ``source``: which receiver."""
        return Phase(phase_of(self._states[0], int(stream), source))

    @property
    def complaints(self) -> list[str]:
        """One sentence for each fault of a stream, with what to do; empty without faults."""
        state, settings = self._states[0], self._settings[0]
        clocks = self._clock.complaints() + self._traffic.complaints()
        clocks += imu_complaints(self.imu_counts, self.window_needed)
        inertial = imu_faults(state) + motion_complaints(state)
        samples = sample_complaints(state) + gap_complaints(state)
        travel, is_fault = travel_complaints(state, settings, self.parameters.imu.mount_rpy_deg)
        found = inertial + other_complaints(state) + repeat_complaints(state) + samples
        found += noise_complaints(state, settings) + (travel if is_fault else [])
        # A wrong heading makes the fixes look faulty: warnings about the receivers would mislead.
        if not is_heading_contradicted(state):
            # Clocks that may be apart are told after some more turns, and would explain much.
            is_explained = bool(clocks or inertial or axis_complaints(state)) or lag_of_receiver(state) != 0.0
            found += aid_complaints(state, settings, is_explained, bool(samples or travel))
        return found + clocks

    @property
    def notes(self) -> list[str]:
        """One sentence for each fact worth knowing of the streams though nothing is wrong."""
        state, settings = self._states[0], self._settings[0]
        travel, is_fault = travel_complaints(state, settings, self.parameters.imu.mount_rpy_deg)
        # Without altitudes fixes change by less than their three axes claim; with wrong axes the path is wrong.
        of_errors = [] if self._traffic.without_altitude or motion_complaints(state) else aid_notes(state)
        return self._traffic.notes() + of_errors + ([] if is_fault else travel)

    @property
    def held_bytes(self) -> int:
        """Memory of the history buffers (bytes): grows with window and rates, not with time."""
        return self._buffers.held_bytes
