"""What a receiver on a simulated robot measures of each satellite of an invented sky."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.compiled import njit
from eskf_ros.filter.navigator import Navigator
from eskf_ros.geodesy.earth import east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.gnss.atmosphere import ionosphere_scale, klobuchar, troposphere
from eskf_ros.gnss.geometry import elevation_azimuth, line_of_sight, state_at_reception
from eskf_ros.gnss.measurements import MEASURED_SIGNAL
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, Status
from eskf_ros.gnss.signals import GNSS_COUNT, L1, SIGNAL_BY_CODE, Gnss, time_group
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING, code_std, doppler_std
from eskf_ros.simulate.scenario import Recording
from support.gnss_sky import KLOBUCHAR, SECONDS, WEEK, all_constellations

Array = NDArray[np.float64]

ALL = (Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.GLONASS)
LOWEST_DEG = 10.5
PARAMETERS: dict[str, Any] = {"mode": "tight", "ranges.correlation_time": 0.0}
"""The errors of these ranges are new every time."""


@njit
def _fill(records, signals, place, motion, seconds, klobuchar_parameters):
    """Fill the signals (one for each ephemeris) of an antenna at rest in time, without noise and receiver clock."""
    latitude, longitude, altitude = ecef_to_geodetic(place[0], place[1], place[2])
    local = east_north_up_to_ecef(latitude, longitude)
    for k in range(len(records)):
        row = signals[k]
        position, velocity, _, _, _ = state_at_reception(records[k], WEEK, seconds, place)
        unit, length, rate = line_of_sight(position, velocity, place, motion, False)
        elevation, azimuth = elevation_azimuth(unit, local)
        delay = klobuchar(klobuchar_parameters, seconds, latitude, longitude, elevation, azimuth)
        delay *= ionosphere_scale(L1)
        cn0 = 30.0 + 20.0 * math.sin(elevation)
        row["elevation"], row["azimuth"], row["cn0"] = elevation, azimuth, cn0
        row["pseudorange"] = length + delay + troposphere(WEEK, seconds, latitude, altitude, elevation)
        row["range_rate"] = rate
        for i in range(3):
            row["satellite"][i] = position[i]
            row["satellite_velocity"][i] = velocity[i]
        row["code_std"] = code_std(DEFAULT_WEIGHTING, row["gnss_id"], row["sv_id"], elevation, cn0, delay, 1.0)
        row["range_rate_std"] = doppler_std(DEFAULT_WEIGHTING, cn0)


@dataclass(frozen=True)
class Sky:
    """Signals without noise and clock at the epochs of a recording: (epochs, satellites) of those ever visible."""

    stamp: NDArray[np.int64]
    seconds: Array
    signals: NDArray[np.void]


@lru_cache(maxsize=4)
def _sky(name: str, options: Any, rate: float) -> Sky:
    from eskf_ros.simulate.scenario import simulate

    recording = simulate(name, 0, **{key: getattr(options, key) for key in options.__dataclass_fields__})
    every = round(options.truth_rate / rate)
    chosen = slice(every - 1, None, every)
    stamp = recording.truth_stamp[chosen]
    attitude = Rotation.from_quat(recording.truth_attitude_body_to_map[chosen][:, [1, 2, 3, 0]])
    arm = np.array(options.lever_arm)
    position = recording.truth_position_map[chosen] + attitude.apply(arm)
    velocity = recording.truth_velocity_map[chosen] + attitude.apply(
        np.cross(recording.truth_angular_rate_body[chosen], arm)
    )
    places = recording.frame.to_ecef(position)
    motions = velocity @ recording.frame.rotation_map_to_ecef.T
    ephemerides = all_constellations()
    records = ephemerides.records
    seconds = SECONDS + (stamp - stamp[0]) * 1e-9
    signals = np.zeros((len(stamp), len(records)), MEASURED_SIGNAL)
    signals["gnss_id"], signals["sv_id"] = records["gnss_id"], records["sv_id"]
    for k, (gnss, sv_id) in enumerate(zip(records["gnss_id"].tolist(), records["sv_id"].tolist())):
        code = "2I" if gnss == Gnss.BEIDOU else "1C"
        signals["signal"][:, k] = SIGNAL_BY_CODE[Gnss(gnss), code]
        signals["system"][:, k] = time_group(gnss, sv_id)
    signals["flags"] = CODE_VALID | DOPPLER_VALID
    signals["carrier_hz"], signals["noise_factor"] = L1, 1.0
    for k in range(len(stamp)):
        _fill(records, signals[k], tuple(places[k].tolist()), tuple(motions[k].tolist()), seconds[k], KLOBUCHAR)
    visible = (signals["elevation"] > math.radians(LOWEST_DEG)).any(axis=0)
    return Sky(stamp, seconds, signals[:, visible])


@dataclass
class Ranges:
    """Signals of the epochs of a recording, and the clock they were measured with: bias (m), drift (m/s), offsets."""

    stamp: NDArray[np.int64]
    arrival: NDArray[np.int64]
    seconds: Array
    signals: list[NDArray[np.void]]
    bias: Array
    drift: Array
    offset: Array

    def push(self, navigator: Navigator, k: int, signals: NDArray[np.void] | None = None) -> None:
        """Give one epoch to a navigator, or ``signals`` in place of its own."""
        chosen = self.signals[k] if signals is None else signals
        navigator.push_ranges(
            int(self.stamp[k]), (WEEK, float(self.seconds[k])), chosen, KLOBUCHAR, int(self.arrival[k])
        )


def simulate_ranges(
    recording: Recording,
    seed: int,
    rate: float = 5.0,
    systems: Sequence[Gnss] = ALL,
    drift_noise: float = 0.3,
    bias_noise: float = 0.1,
    latency: float = 0.1,
) -> Ranges:
    """Return what a receiver measures on this recording: errors as the model says, clock and offsets drawn."""
    sky = _sky(recording.name, recording.options, rate)
    rng = np.random.default_rng([seed, 77])
    dt = np.diff(sky.seconds, prepend=sky.seconds[0])
    drift_steps = rng.normal(size=len(dt)) * drift_noise * np.sqrt(dt)
    drift = rng.normal(0.0, 50.0) + np.cumsum(drift_steps)
    # Of a white noise that is integrated twice: the bias moves by the mean of the drift, with a spread of its own.
    mean = drift - 0.5 * drift_steps + rng.normal(size=len(dt)) * drift_noise * np.sqrt(dt / 12.0)
    bias = rng.uniform(-1e5, 1e5) + np.cumsum(mean * dt + rng.normal(size=len(dt)) * bias_noise * np.sqrt(dt))
    offset = rng.normal(0.0, 5.0, GNSS_COUNT)
    offset[Gnss.GPS] = 0.0
    signals = sky.signals[:, np.isin(sky.signals["gnss_id"][0], systems)].copy()
    shape = signals.shape
    signals["pseudorange"] += bias[:, None] + offset[signals["system"]] + rng.normal(size=shape) * signals["code_std"]
    signals["range_rate"] += drift[:, None] + rng.normal(size=shape) * signals["range_rate_std"]
    signals["code_std"] = signals["range_rate_std"] = math.nan
    low = signals["elevation"] < math.radians(LOWEST_DEG)
    signals["status"] = np.where(low, Status.LOW_ELEVATION, Status.USABLE)
    signals["elevation"] = signals["azimuth"] = math.nan
    arrival = sky.stamp + round(latency * 1e9)
    return Ranges(sky.stamp, arrival, sky.seconds, list(signals), bias, drift, offset)


def tight_navigator(recording: Recording, **changes: Any) -> Navigator:
    """Return a navigator in tight mode that knows the sensors of a recording."""
    from eskf_ros.parameters.mapping import from_mapping

    named = {key.replace("__", "."): value for key, value in changes.items()}
    mapping = {**recording.parameters(), "alignment.course_std_deg": 0.1, **PARAMETERS, **named}
    return Navigator(from_mapping(mapping))


def run_tight(recording: Recording, ranges: Ranges, navigator: Navigator, stops: NDArray[np.int64]) -> Any:
    """Feed IMU and ranges by arrival; yield (i, state) right after each of the IMU samples ``stops``."""
    epoch = sample = 0
    for i in stops:
        now = recording.imu_arrival[i]
        while epoch < len(ranges.stamp) and ranges.arrival[epoch] <= now:
            ranges.push(navigator, epoch)
            epoch += 1
        part = slice(sample, i + 1)
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        sample = i + 1
        yield int(i), navigator.state[0]
