"""details.npz: what a report shows of a replay beyond the other result files, in numpy arrays of bounded size.

An hour at 200 Hz takes a few megabytes; all stamps are ns. Arrays (`numpy.load`):

- `states` STATE_CHANGE: status and quality from each change on; `biases` BIAS, one row per second.
- `errors`: fields of `truth.COMPARED`, in each tenth of a second the epoch with the largest horizontal error.
- `fixes` FIX_POINT: all fixes of the recording, the withheld ones too, in `map`.
- `imu` IMU_SECOND; `frequency` (k,) Hz and `density` (k, 6): root of the mean power spectral density of the readings,
  m/s2/sqrt(Hz) and rad/s/sqrt(Hz), x y z of accelerometer and gyro.
- `signals` SIGNAL: satellites as the receiver saw them, at most once per second.
- `gates` (streams, 4): largest NIS accepted by `Stream` and degrees of freedom. `told_density` (2,): noise densities of
  accelerometer and gyro in the parameters. `first_stamp`: the zero of `--outage`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.bags import Batch
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.settings import settings_from
from eskf_ros.filter.state.time import SECOND
from eskf_ros.filter.tight.signal import name_of, source_of
from eskf_ros.geodesy.earth import geodetic_to_ecef
from eskf_ros.geodesy.map_frame import MapFrame
from eskf_ros.inputs.table import FIX, time_offset_of
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.topics import TopicNames

ERROR_INTERVAL = SECOND // 10
SEGMENT = 512
"""Samples of one segment of the spectrum (Welch 1967): 2.6 s at 200 Hz, 0.4 Hz between two frequencies."""

STATE_CHANGE = np.dtype([("stamp", "i8"), ("status", "i4"), ("quality", "i4")])
BIAS = np.dtype(
    [
        ("stamp", "i8"),
        ("accel_bias", "f4", (3,)),
        ("accel_bias_std", "f4", (3,)),
        ("gyro_bias", "f4", (3,)),
        ("gyro_bias_std", "f4", (3,)),
    ]
)
"""Biases in IMU axes (m/s2, rad/s) with their standard deviations."""
FIX_POINT = np.dtype([("stamp", "i8"), ("position_map", "f8", (3,))])
"""The antenna by its receiver; the stamp is that of aids.csv (with the time offset)."""
IMU_SECOND = np.dtype(
    [
        ("stamp", "i8"),
        ("count", "i4"),
        ("longest_interval", "f4"),
        ("latency", "f4"),
        ("force_std", "f4"),
        ("rate_std", "f4"),
        ("largest_force", "f4"),
        ("largest_rate", "f4"),
        ("held", "i4"),
    ]
)
"""The IMU samples of one second of stamps: intervals and latency (recorded minus stamp, the largest) in s; standard
deviations of the readings over the second (root of the sum over the axes) and the largest magnitude on an axis, m/s2
and rad/s; `held`: samples with an axis at the largest or smallest value of the second for the third time in a row, as
clipped ones are.
"""
SIGNAL = np.dtype([("stamp", "i8"), ("name", "S8"), ("cn0", "f4"), ("azimuth_deg", "f4"), ("elevation_deg", "f4")])
"""A signal with its RINEX name, C/N0 (dB-Hz) and the direction of its satellite."""


class Details:
    """Collects what goes into details.npz, batch by batch."""

    def __init__(self, topics: TopicNames, parameters: Parameters) -> None:
        self._imu_topic = topics.imu
        self._parameters = parameters
        self._fix_topics = {
            topic: round(time_offset_of(kind, parameters) * SECOND)
            for kind, topic in topics.inputs.items()
            if kind.type == FIX
        }
        self._states: list[NDArray[Any]] = []
        self._biases: list[NDArray[Any]] = []
        self._last = np.array([-1, -1, -1])
        self._fixes: list[NDArray[np.float64]] = []
        self._fix_stamps: list[NDArray[np.int64]] = []
        self._signals: list[tuple[int, NDArray[Any]]] = []
        self._imu = ImuSeconds()

    def add_batch(self, batch: Mapping[str, Batch]) -> None:
        """Look at the messages of a batch before they are offered."""
        if self._imu_topic in batch:
            imu = batch[self._imu_topic]
            readings = np.concatenate([imu.messages["linear_acceleration"], imu.messages["angular_velocity"]], axis=1)
            self._imu.add(imu.messages["stamp"], imu.log_time, readings)
        for topic, offset in self._fix_topics.items():
            if topic in batch:
                messages = batch[topic].messages
                messages = messages[messages["status"] >= 0]
                self._fix_stamps.append(messages["stamp"] + offset)
                self._fixes.append(np.stack([messages[name] for name in ("latitude", "longitude", "altitude")], axis=1))

    def add_rows(self, rows: NDArray[Any]) -> None:
        """Take ODOMETRY rows (n,)."""
        if not len(rows):
            return
        table = np.stack([rows["status"], rows["quality"], rows["stamp"] // SECOND], axis=1)
        changed = np.diff(table, axis=0, prepend=self._last[None]) != 0
        self._last = table[-1]
        self._states.append(_picked(rows[changed[:, :2].any(axis=1)], STATE_CHANGE))
        self._biases.append(_picked(rows[changed[:, 2]], BIAS))

    def watch_signals(self, stamp: int, signals: NDArray[Any]) -> None:
        """Take the signals of an epoch (MEASURED_SIGNAL or RANGE) if the last were of another second."""
        if not self._signals or stamp // SECOND != self._signals[-1][0] // SECOND:
            self._signals.append((stamp, signals[np.isfinite(signals["satellite"]).all(axis=1)].copy()))

    def save(
        self, path: Path, navigator: Navigator, first_stamp: int | None, compared: NDArray[Any] | None = None
    ) -> None:
        """Write the file; ``compared``: COMPARED rows where there is truth."""
        settings = settings_from(self._parameters)
        map_frame = MapFrame(navigator.datum) if navigator.datum is not None else None
        frequency, density = self._imu.spectrum()
        arrays = {
            "states": np.concatenate([np.zeros(0, STATE_CHANGE), *self._states]),
            "biases": np.concatenate([np.zeros(0, BIAS), *self._biases]),
            "fixes": self._fix_points(map_frame),
            "imu": self._imu.seconds(),
            "frequency": frequency,
            "density": density,
            "signals": self._signal_rows(map_frame),
            "gates": settings["gate"][0],
            "told_density": np.array(
                [self._parameters.imu.accel_noise_density, self._parameters.imu.gyro_noise_density]
            ),
            "first_stamp": np.int64(first_stamp or 0),
        }
        if compared is not None:
            arrays["errors"] = _worst_of_each(compared, ERROR_INTERVAL)
        np.savez_compressed(path, allow_pickle=False, **arrays)

    def _fix_points(self, map_frame: MapFrame | None) -> NDArray[Any]:
        if map_frame is None or not self._fixes:
            return np.zeros(0, FIX_POINT)
        geodetic, stamps = np.concatenate(self._fixes), np.concatenate(self._fix_stamps)
        fine = np.isfinite(geodetic).all(axis=1)
        points = np.zeros(int(fine.sum()), FIX_POINT)
        points["stamp"] = stamps[fine]
        places = np.column_stack([np.radians(geodetic[fine, :2]), geodetic[fine, 2]]).tolist()
        ecef = [geodetic_to_ecef(latitude, longitude, altitude) for latitude, longitude, altitude in places]
        points["position_map"] = (
            np.array(ecef).reshape(-1, 3) - map_frame.origin_ecef
        ) @ map_frame.rotation_map_to_ecef
        return points

    def _signal_rows(self, map_frame: MapFrame | None) -> NDArray[Any]:
        """Return SIGNAL rows; seen from the datum, which over some kilometres is the same direction to a hundredth deg.

        The satellites are 20 000 km away: ten kilometres turn the sight by 0.03 deg.
        """
        if map_frame is None or not self._signals:
            return np.zeros(0, SIGNAL)
        stamps = np.repeat([stamp for stamp, _ in self._signals], [len(signals) for _, signals in self._signals])
        names = ("gnss_id", "sv_id", "signal", "cn0", "satellite")
        gnss, satellite, signal, cn0, place = (
            np.concatenate([signals[name] for _, signals in self._signals]) for name in names
        )
        sight = (place - map_frame.origin_ecef) @ map_frame.rotation_map_to_ecef
        rows = np.zeros(len(stamps), SIGNAL)
        rows["stamp"], rows["cn0"] = stamps, cn0
        rows["name"] = [
            name_of(source_of(*numbers)) for numbers in zip(gnss.tolist(), satellite.tolist(), signal.tolist())
        ]
        rows["azimuth_deg"] = np.degrees(np.arctan2(sight[:, 0], sight[:, 1])) % 360.0
        rows["elevation_deg"] = np.degrees(np.arctan2(sight[:, 2], np.hypot(sight[:, 0], sight[:, 1])))
        # A satellite whose orbit is not known stands at the centre of the Earth.
        return rows[rows["elevation_deg"] > -10.0]


class ImuSeconds:
    """Statistics of the IMU by the second, and the mean spectrum of its readings."""

    def __init__(self) -> None:
        self._stamps = np.zeros(0, np.int64)
        self._log = np.zeros(0, np.int64)
        self._readings = np.zeros((0, 6))
        self._rest = (np.zeros(0, np.int64), np.zeros((0, 6)))
        self._done: list[NDArray[Any]] = []
        self._power = np.zeros((SEGMENT // 2 + 1, 6))
        self._segments = 0
        self._rates = 0.0
        self._before = -1

    def add(self, stamps: NDArray[np.int64], log: NDArray[np.int64], readings: NDArray[np.float64]) -> None:
        """Take samples: stamps and times of recording (n,) ns, readings (n, 6)."""
        self._add_segments(stamps, readings)
        self._stamps = np.concatenate([self._stamps, stamps])
        self._log = np.concatenate([self._log, log])
        self._readings = np.concatenate([self._readings, readings])
        borders = np.flatnonzero(np.diff(self._stamps // SECOND)) + 1
        if len(borders):
            self._close(np.concatenate([[0], borders[:-1]]), int(borders[-1]))

    def seconds(self) -> NDArray[Any]:
        """Return IMU_SECOND rows; no samples can be added afterwards."""
        if len(self._stamps):
            self._close(np.array([0]), len(self._stamps))
        return np.concatenate([np.zeros(0, IMU_SECOND), *self._done])

    def spectrum(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return frequencies (k,) and densities (k, 6); empty without an undisturbed segment."""
        if not self._segments:
            return np.zeros(0), np.zeros((0, 6))
        rate = self._rates / self._segments
        return np.fft.rfftfreq(SEGMENT, 1.0 / rate)[1:], np.sqrt(self._power[1:] / self._segments)

    def _close(self, starts: NDArray[np.intp], end: int) -> None:
        stamps, readings = self._stamps[:end], self._readings[:end]
        intervals = np.diff(stamps, prepend=stamps[0] if self._before < 0 else self._before)
        rows = np.zeros(len(starts), IMU_SECOND)
        rows["stamp"] = stamps[starts]
        counts = np.diff(np.append(starts, end))
        rows["count"] = counts
        rows["longest_interval"] = np.maximum.reduceat(intervals, starts) * 1e-9
        rows["latency"] = np.maximum.reduceat(self._log[:end] - stamps, starts) * 1e-9
        mean = np.add.reduceat(readings, starts) / counts[:, None]
        variance = np.add.reduceat((readings - np.repeat(mean, counts, axis=0)) ** 2, starts) / counts[:, None]
        rows["force_std"], rows["rate_std"] = np.sqrt(variance[:, :3].sum(axis=1)), np.sqrt(variance[:, 3:].sum(axis=1))
        largest = np.maximum.reduceat(np.abs(readings), starts)
        rows["largest_force"], rows["largest_rate"] = largest[:, :3].max(axis=1), largest[:, 3:].max(axis=1)
        bounds = [np.repeat(bound.reduceat(readings, starts), counts, axis=0) for bound in (np.minimum, np.maximum)]
        held = np.zeros(readings.shape, bool)
        held[2:] = (readings[2:] == readings[1:-1]) & (readings[2:] == readings[:-2])
        held &= (readings == bounds[0]) | (readings == bounds[1])
        rows["held"] = np.add.reduceat(held.any(axis=1).astype(np.int64), starts)
        self._done.append(rows)
        self._before = int(stamps[-1])
        self._stamps, self._log, self._readings = self._stamps[end:], self._log[end:], self._readings[end:]

    def _add_segments(self, stamps: NDArray[np.int64], readings: NDArray[np.float64]) -> None:
        """Add the power of whole segments; one with a hole or with stamps that go back is left out."""
        stamps, readings = np.concatenate([self._rest[0], stamps]), np.concatenate([self._rest[1], readings])
        count = len(stamps) // SEGMENT
        self._rest = stamps[count * SEGMENT :].copy(), readings[count * SEGMENT :].copy()
        times = stamps[: count * SEGMENT].reshape(count, SEGMENT)
        parts = readings[: count * SEGMENT].reshape(count, SEGMENT, 6)
        span = times[:, -1] - times[:, 0]
        longest = np.diff(times, axis=1).max(axis=1, initial=0)
        fine = (span > 0) & (longest * (SEGMENT - 1) < 3 * span) & np.isfinite(parts).all(axis=(1, 2))
        if not fine.any():
            return
        parts, rates = parts[fine], (SEGMENT - 1) / (span[fine] * 1e-9)
        window = np.hanning(SEGMENT)
        amplitude = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * window[:, None], axis=1)
        power = 2.0 * np.abs(amplitude) ** 2 / (rates[:, None, None] * (window**2).sum())
        self._power += power.sum(axis=0)
        self._segments += len(parts)
        self._rates += float(rates.sum())


def _picked(rows: NDArray[Any], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the fields of `kind` of the rows."""
    picked = np.zeros(len(rows), kind)
    for name in kind.names or ():
        picked[name] = rows[name]
    return picked


def _worst_of_each(compared: NDArray[Any], interval: int) -> NDArray[Any]:
    """Return the COMPARED row with the largest horizontal error of each interval (ns)."""
    if not len(compared):
        return compared
    starts = np.flatnonzero(np.diff(compared["stamp"] // interval, prepend=-1))
    counts = np.diff(np.append(starts, len(compared)))
    worst = np.repeat(np.maximum.reduceat(compared["horizontal"], starts), counts)
    group = np.repeat(np.arange(len(starts)), counts)
    found = np.flatnonzero(compared["horizontal"] >= worst)
    return compared[found[np.unique(group[found], return_index=True)[1]]]
