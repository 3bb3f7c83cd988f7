"""A simulated GNSS receiver that gives what it measures: pseudorange, Doppler and C/N0 of each satellite's signal.

The ranges follow the model of `eskf_ros.gnss.range_model`, plus what a model leaves: the rest of the ionosphere and the
troposphere, orbits and clocks of the satellites, the offsets between constellations, all of which change slowly, and
noise by elevation and C/N0 as `eskf_ros.gnss.weighting` has it. The receiver's clock runs with a drift that wanders.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from eskf_ros.gnss import time as gnss_time
from eskf_ros.gnss.ephemeris import EPHEMERIS, Broadcast, Ephemerides
from eskf_ros.gnss.range_files import read_navigation_files
from eskf_ros.gnss.range_model import NO_KLOBUCHAR
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, allocate_ranges, locate
from eskf_ros.gnss.signals import GNSS_COUNT, LETTERS, SIGNALS, SPEED_OF_LIGHT, Gnss, time_group
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING
from eskf_ros.simulate import constellation
from eskf_ros.simulate.episodes import Episode, received
from eskf_ros.simulate.gnss import GNSS_PHASE
from eskf_ros.simulate.motion import Vector
from eskf_ros.simulate.range_episodes import RangeEpisode, SkyView
from eskf_ros.simulate.sampling import (
    START_STAMP,
    Interval,
    Section,
    Stamps,
    arrivals,
    check_rate,
    generators,
    nanoseconds,
)
from eskf_ros.simulate.sky import IDEAL_RANGE, ideal_ranges, model_deviations

Array = NDArray[np.float64]

_SYSTEMS = "".join(letter for letter in LETTERS if letter != "S")
MILLISECOND = 1e-3 * SPEED_OF_LIGHT
ATMOSPHERE_TIME = 3600.0
ORBIT_TIME = 1800.0
"""Correlation times (s) of what the atmosphere's models and the broadcast orbits and clocks leave."""
LOWEST_CN0 = 18.0
"""Weaker signals (dB-Hz) are not tracked."""


@dataclass(frozen=True)
class RangeReceiver:
    """A receiver of ranges, at the antenna of the first GNSS receiver.

    ``rate`` in Hz, ``latency``: shortest and longest seconds from an epoch to its arrival. ``systems``: letters of
    RINEX, of whose satellites the first signal is tracked above ``elevation_mask_deg``. ``nav``: a RINEX navigation
    file that covers the time of the scenario; none takes the sky of `eskf_ros.simulate.constellation`.
    ``clock_offset``: seconds by which the stamps are ahead of UTC, to have the sky of another day. With
    ``satellites`` the messages bring the states of the satellites, and no ephemerides are needed; with ``stds`` they
    bring standard deviations.

    ``noise_scale``: noise of code and Doppler, as a multiple of what `eskf_ros.gnss.weighting` says.
    ``ionosphere_error``: what the model leaves of the ionosphere, as a share of it; ``troposphere_error`` m at the
    zenith; ``orbit_std`` m for each satellite; ``offset_std`` m for each constellation but the first. All standard
    deviations.

    ``clock_bias`` s and ``clock_drift`` m/s at the start, ``clock_drift_noise`` (m/s/sqrt(s)) and ``clock_noise``
    (m/sqrt(s)): random walks of drift and bias; 0.3 is a common crystal, 0.1 a good one, 0.01 an oven. With
    ``clock_jumps`` the clock is set back by whole milliseconds when it is half of one off.
    """

    rate: float = 5.0
    latency: Interval = (0.08, 0.2)
    systems: str = "GEC"
    elevation_mask_deg: float = 5.0
    nav: str = ""
    clock_offset: float = 0.0
    satellites: bool = False
    stds: bool = False
    noise_scale: float = 1.0
    ionosphere_error: float = 0.3
    troposphere_error: float = 0.05
    orbit_std: float = 0.5
    offset_std: float = 3.0
    clock_bias: float = 1e-4
    clock_drift: float = 60.0
    clock_drift_noise: float = 0.3
    clock_noise: float = 0.05
    clock_jumps: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError for a rate or systems that are none."""
        check_rate("rate of the ranges", self.rate)
        if not self.systems or set(self.systems) - set(_SYSTEMS):
            raise ValueError(f"systems are letters out of {_SYSTEMS}, not '{self.systems}'")

    def measure(
        self, section: Section, lever_arm: Vector, episodes: Sequence[Episode], seed: np.random.SeedSequence
    ) -> RangeMeasurements:
        """Return the measurements in ``section`` with the antenna at ``lever_arm`` (m, base_link).

        Over 60 lines: one epoch, satellite by satellite, with every error in the order in which it arises.
        """
        clock_stream, noise, cn0_noise, atmosphere, orbits, offsets, happenings, delays = generators(seed, 8)
        geometry = _geometry(section, lever_arm, self.rate, self.systems, self.nav, self.clock_offset)
        ideal, satellites, stamp = geometry.ideal, geometry.satellites, geometry.stamp
        shape, interval = ideal.shape, 1.0 / self.rate
        elapsed = section.elapsed(stamp)

        bias, drift = self._clock(len(stamp), interval, clock_stream)
        groups = np.array([time_group(int(gnss), int(sv_id)) for gnss, sv_id, _ in satellites])
        system_offset = self.offset_std * offsets.standard_normal(GNSS_COUNT)
        system_offset[groups[0]] = 0.0
        visible = ideal["elevation"] > math.radians(self.elevation_mask_deg)
        sine = np.where(visible, np.sin(ideal["elevation"]), 1.0)
        sky = SkyView(
            elapsed=elapsed,
            heading=geometry.heading,
            elevation=ideal["elevation"],
            azimuth=ideal["azimuth"],
            tracked=visible.copy(),
            reflected=np.zeros(shape, np.bool_),
            code_error=np.zeros(shape),
            range_rate_error=np.zeros(shape),
            cn0=30.0 + 20.0 * sine + 1.5 * cn0_noise.standard_normal(shape[1]) + 0.7 * cn0_noise.standard_normal(shape),
            clock_step=np.zeros(len(stamp)),
        )
        for episode in episodes:
            if isinstance(episode, RangeEpisode):
                episode.apply(sky, happenings)
        sky.tracked &= sky.cn0 >= LOWEST_CN0

        bias += SPEED_OF_LIGHT * sky.clock_step
        if self.clock_jumps:
            bias -= MILLISECOND * np.rint(bias / MILLISECOND)
        delay = 1.0 + self.ionosphere_error * (
            0.8 * _slow(atmosphere, (shape[0], 1), interval, ATMOSPHERE_TIME)
            + 0.6 * _slow(atmosphere, shape, interval, ATMOSPHERE_TIME)
        )
        wet = self.troposphere_error * _slow(atmosphere, (shape[0], 1), interval, ATMOSPHERE_TIME)
        code_std, rate_std = np.zeros(shape), np.zeros(shape)
        model_deviations(DEFAULT_WEIGHTING, satellites, np.arcsin(sine), sky.cn0, code_std, rate_std)
        pseudorange = ideal["pseudorange"] + bias[:, None] + system_offset[groups] + sky.code_error
        pseudorange += delay * ideal["ionosphere"] + ideal["troposphere"] + wet * ideal["wet_mapping"]
        pseudorange += self.orbit_std * _slow(orbits, shape, interval, ORBIT_TIME)
        pseudorange += self.noise_scale * code_std * noise.standard_normal(shape)
        range_rate = ideal["range_rate"] + drift[:, None] + sky.range_rate_error
        range_rate += self.noise_scale * rate_std * noise.standard_normal(shape)

        arrival = arrivals(stamp, self.latency, delays)
        kept = received(episodes, (1,), elapsed)
        epoch, satellite = np.nonzero(sky.tracked[kept])
        ranges = allocate_ranges(len(epoch))
        ranges["gnss_id"], ranges["sv_id"], ranges["signal"] = satellites[satellite].T
        ranges["flags"] = CODE_VALID | DOPPLER_VALID
        ranges["carrier_hz"] = ideal["carrier_hz"][kept][epoch, satellite]
        ranges["pseudorange"] = pseudorange[kept][epoch, satellite]
        ranges["doppler"] = -range_rate[kept][epoch, satellite] * ranges["carrier_hz"] / SPEED_OF_LIGHT
        ranges["cn0"] = sky.cn0[kept][epoch, satellite]
        if self.stds:
            ranges["pseudorange_std"] = code_std[kept][epoch, satellite]
            ranges["doppler_std"] = rate_std[kept][epoch, satellite] * ranges["carrier_hz"] / SPEED_OF_LIGHT
        # The time tag is what the receiver's clock shows.
        tags = [
            gnss_time.normalized(week, second + ahead / SPEED_OF_LIGHT)
            for week, second, ahead in zip(geometry.week[kept].tolist(), geometry.seconds[kept].tolist(), bias[kept])
        ]
        measurements = RangeMeasurements(
            sensor=self,
            stamp=stamp[kept],
            arrival=arrival[kept],
            week=np.array([tag[0] for tag in tags], np.int64),
            seconds=np.array([tag[1] for tag in tags]),
            first=np.searchsorted(epoch, np.arange(np.count_nonzero(kept) + 1)),
            ranges=ranges,
            reflected=sky.reflected[kept][epoch, satellite],
            clock_bias=bias[kept],
            clock_drift=drift[kept],
            system_offset=system_offset,
            ephemerides_stamp=START_STAMP + nanoseconds(np.array([section.start])),
            broadcasts=geometry.broadcasts,
            klobuchar=geometry.klobuchar,
        )
        if self.satellites:
            for k, (week, second) in enumerate(tags):
                locate(measurements.epoch(k), week, second, geometry.ephemerides)
        return measurements

    def _clock(self, count: int, interval: float, stream: np.random.Generator) -> tuple[Array, Array]:
        """Return bias (m) and drift (m/s) at ``count`` epochs: two random walks, integrated exactly.

        Brown and Hwang, Introduction to Random Signals and Applied Kalman Filtering, 4th ed., section 9.3.
        """
        q_bias, q_drift = self.clock_noise**2, self.clock_drift_noise**2
        covariance = np.array(
            [
                [q_bias * interval + q_drift * interval**3 / 3.0, q_drift * interval**2 / 2.0],
                [q_drift * interval**2 / 2.0, q_drift * interval],
            ]
        )
        # A singular covariance (a perfect clock) has a root too, but no Cholesky factor.
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        steps = stream.standard_normal((count, 2)) @ root.T
        steps[:1] = 0.0
        drift = self.clock_drift + np.cumsum(steps[:, 1])
        growth = np.concatenate([[0.0], drift[:-1] * interval])
        return SPEED_OF_LIGHT * self.clock_bias + np.cumsum(growth + steps[:, 0]), drift


@dataclass(frozen=True)
class RangeMeasurements:
    """What a receiver of ranges measured, one row per message, and what is true.

    ``stamp``, ``arrival`` int64 ns; ``week``, ``seconds``: time tag by the receiver's clock. The signals of message k
    are ``ranges[first[k]:first[k + 1]]`` (RANGE); ``reflected``: those that came by a reflection only. ``clock_bias`` m
    and ``clock_drift`` m/s (n,) of the receiver; ``system_offset`` (8,) m by `signals.time_group`. ``broadcasts`` and
    ``klobuchar``: the navigation messages of all satellites, sent at ``ephemerides_stamp`` (1,).
    """

    sensor: RangeReceiver
    stamp: Stamps
    arrival: Stamps
    week: NDArray[np.int64]
    seconds: Array
    first: NDArray[np.int64]
    ranges: NDArray[np.void]
    reflected: NDArray[np.bool_]
    clock_bias: Array
    clock_drift: Array
    system_offset: Array
    ephemerides_stamp: Stamps
    broadcasts: Sequence[Broadcast]
    klobuchar: Mapping[Gnss, Array]

    def epoch(self, k: int) -> NDArray[np.void]:
        """Return the signals (RANGE, a view) of message k."""
        return self.ranges[self.first[k] : self.first[k + 1]]


@dataclass(frozen=True)
class _Geometry:
    """What all seeds share: where the satellites are."""

    stamp: Stamps
    week: NDArray[np.int64]
    seconds: Array
    heading: Array
    satellites: NDArray[np.int64]
    ideal: NDArray[np.void]
    broadcasts: Sequence[Broadcast]
    klobuchar: Mapping[Gnss, Array]
    ephemerides: Ephemerides


@lru_cache(maxsize=4)
def _geometry(
    section: Section, lever_arm: Vector, rate: float, systems: str, nav: str, clock_offset: float
) -> _Geometry:
    """Raise ValueError (RinexError) for a file that cannot be read, and when it covers nothing of the section."""
    stamp = section.stamps(rate, GNSS_PHASE)
    if not len(stamp):
        raise ValueError(f"at {rate:g} Hz there is no epoch of ranges from {section.start:g} s to {section.stop:g} s")
    instants = [gnss_time.from_unix(one) for one in (stamp - round(clock_offset * 1e9)).tolist()]
    if nav:
        files = read_navigation_files([Path(nav)])
        broadcasts: Sequence[Broadcast] = files.serving(instants[0], instants[-1])
        klobuchar: Mapping[Gnss, Array] = files.klobuchar
    else:
        broadcasts, klobuchar = constellation.messages(), constellation.KLOBUCHAR
    wanted = {LETTERS[letter] for letter in systems}
    broadcasts = [broadcast for broadcast in broadcasts if broadcast.gnss in wanted]
    ephemerides = Ephemerides(np.array([broadcast.record() for broadcast in broadcasts], EPHEMERIS))
    first_signal = {signal.gnss: index for index, signal in reversed(list(enumerate(SIGNALS)))}
    names = sorted({(broadcast.gnss, broadcast.sv_id) for broadcast in broadcasts})
    satellites = np.array([(gnss, sv_id, first_signal[gnss]) for gnss, sv_id in names], np.int64).reshape(-1, 3)
    weeks = np.array([week for week, _ in instants], np.int64)
    seconds = np.array([second for _, second in instants])
    motion = section.motion(stamp)
    positions = section.frame.to_ecef(motion.position_of(lever_arm))
    velocities = motion.velocity_of(lever_arm) @ section.frame.rotation_map_to_ecef.T
    ideal = np.zeros((len(stamp), len(satellites)), IDEAL_RANGE)
    parameters = klobuchar.get(Gnss.GPS, NO_KLOBUCHAR)
    ideal_ranges(
        weeks, seconds, positions, velocities, ephemerides.records, ephemerides.first, satellites, parameters, ideal
    )
    if not np.isfinite(ideal["elevation"]).any():
        raise ValueError(f"{nav}: no ephemeris of {systems} for the time of the scenario, GPS week {weeks[0]}")
    forward = motion.rotation_body_to_map[:, :, 0]
    heading = np.arctan2(forward[:, 0], forward[:, 1])
    return _Geometry(stamp, weeks, seconds, heading, satellites, ideal, broadcasts, klobuchar, ephemerides)


def _slow(stream: np.random.Generator, shape: tuple[int, ...], interval: float, correlation_time: float) -> Array:
    """Return first-order Gauss-Markov processes of unit variance along the first axis, stationary from the start."""
    white = stream.standard_normal(shape)
    remains = math.exp(-interval / correlation_time)
    white[1:] *= math.sqrt(1.0 - remains * remains)
    filtered: Array = lfilter([1.0], [1.0, -remains], white, axis=0)
    return filtered
