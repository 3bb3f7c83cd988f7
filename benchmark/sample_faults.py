"""Faults put into the samples of a simulated drive, for the campaign of `eskf_check` (`check_faults.py`)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.simulate.scenario import Recording
from monte_carlo import NO_SIDE_SLIP

Array = NDArray[np.float64]

BEGIN, END, STOP = 100.0, 140.0, 286.0
"""s; where a fault begins, where one that ends does, and where the drive is cut."""

RATE = 100.0
"""Hz of the IMU."""

IMU_NOISE = ("gyro_noise_density", "accel_noise_density", "gyro_bias_random_walk", "accel_bias_random_walk")
"""Parameters that the told filter knows and the default one does not."""


@dataclass
class Samples:
    """What the filter gets of the IMU: stamps (ns), readings, and which samples; ``seconds`` from the start."""

    stamps: NDArray[np.int64]
    force: Array
    rate: Array
    kept: NDArray[np.bool_]
    seconds: Array

    def during(self, begin: float = BEGIN, end: float = math.inf) -> NDArray[np.bool_]:
        """The samples from ``begin`` to ``end`` (s)."""
        return (self.seconds >= begin) & (self.seconds < end)


Change = Callable[[Samples, np.random.Generator], None]
Exchange = Callable[[Recording, np.random.Generator], Recording]


@dataclass(frozen=True)
class Fault:
    """One kind of fault: what it does to the IMU, to the receiver or to the parameters, and when it ends (s)."""

    name: str
    imu: Change | None = None
    gnss: Exchange | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    end: float = math.inf


def added(force: Sequence[float] = (0.0, 0.0, 0.0), rate: Sequence[float] = (0.0, 0.0, 0.0)) -> Change:
    """A step of the biases (m/s2, rad/s)."""

    def change(samples: Samples, rng: np.random.Generator) -> None:
        during = samples.during()
        samples.force[during] += force
        samples.rate[during] += rate

    return change


def ramp(samples: Samples, rng: np.random.Generator) -> None:
    """The bias of the z gyro grows by 0.5 deg/s in 400 s."""
    samples.rate[:, 2] += math.radians(0.5) / 400.0 * np.maximum(samples.seconds - BEGIN, 0.0)


def scaled(samples: Samples, rng: np.random.Generator) -> None:
    """Gyros and accelerometers read 1.5 % too much."""
    samples.force *= 1.015
    samples.rate *= 1.015


def noisy(samples: Samples, rng: np.random.Generator) -> None:
    """White noise of ten times the usual densities of a consumer IMU on top."""
    samples.rate += 10.0 * 8.7e-5 * math.sqrt(RATE) * rng.normal(size=samples.rate.shape)
    samples.force += 10.0 * 1.0e-3 * math.sqrt(RATE) * rng.normal(size=samples.force.shape)


def clipped(samples: Samples, rng: np.random.Generator) -> None:
    """Rates are clipped at 0.2 rad/s."""
    np.clip(samples.rate, -0.2, 0.2, out=samples.rate)


def shocked(samples: Samples, rng: np.random.Generator) -> None:
    """A shock of 0.1 s of 100 m/s2 and 8 rad/s every 10 s, in random directions."""
    for begin in np.arange(BEGIN, END, 10.0):
        during = samples.during(begin, begin + 0.1)
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        samples.force[during] += 100.0 * direction
        samples.rate[during] += 8.0 * direction


def shaken(samples: Samples, rng: np.random.Generator) -> None:
    """Vibration of 1 m/s2 and 0.05 rad/s at 23 Hz, in every axis with a phase of its own."""
    wave = np.sin(2.0 * math.pi * (23.0 * samples.seconds[:, None] + rng.random(6)))
    during = samples.during()
    samples.force[during] += wave[during, :3]
    samples.rate[during] += 0.05 * wave[during, 3:]


def stuck(samples: Samples, rng: np.random.Generator) -> None:
    """The z gyro repeats one reading for 40 s."""
    during = samples.during(BEGIN, END)
    samples.rate[during, 2] = samples.rate[during, 2][0]


def holes(samples: Samples) -> Iterable[tuple[int, int]]:
    """First sample of, and after, holes of 1.6 s every 10 s from BEGIN to END."""
    for begin in np.arange(BEGIN, END, 10.0):
        yield tuple(np.searchsorted(samples.seconds, (begin, begin + 1.6)).tolist())


def dropped(samples: Samples, rng: np.random.Generator) -> None:
    """Holes without samples."""
    for first, last in holes(samples):
        samples.kept[first:last] = False


def bridged(samples: Samples, rng: np.random.Generator) -> None:
    """Holes that the driver has bridged by straight lines."""
    for first, last in holes(samples):
        share = np.linspace(0.0, 1.0, last - first)[:, None]
        for readings in (samples.force, samples.rate):
            readings[first:last] = (1.0 - share) * readings[first] + share * readings[last]


def repeated(samples: Samples, rng: np.random.Generator) -> None:
    """Holes in which the last sample is repeated."""
    for first, last in holes(samples):
        samples.force[first:last], samples.rate[first:last] = samples.force[first], samples.rate[first]


def jittered(samples: Samples, rng: np.random.Generator) -> None:
    """Stamps scatter by 1 ms, in order."""
    jitter = np.round(1e6 * rng.normal(size=len(samples.stamps))).astype(np.int64)
    samples.stamps[:] = np.maximum.accumulate(samples.stamps + jitter)
    samples.stamps += np.arange(len(samples.stamps))


def in_bursts(samples: Samples, rng: np.random.Generator) -> None:
    """Four samples at a time get the stamp of the last of them, a microsecond apart."""
    group = np.arange(len(samples.stamps)) // 4 * 4 + 3
    group = np.minimum(group, len(samples.stamps) - 1)
    samples.stamps[:] = samples.stamps[group] + 1000 * (np.arange(len(samples.stamps)) % 4 - 3)


def shifted(east: float, every: float, length: float) -> Exchange:
    """Steps of the position to the east (m): ``length`` s of every ``every`` s from BEGIN on."""

    def exchange(recording: Recording, rng: np.random.Generator) -> Recording:
        seconds = (recording.fix_stamp - recording.imu_stamp[0]) * 1e-9 - BEGIN
        bad = (seconds >= 0.0) & (seconds % every < length)
        return moved(recording, np.where(bad, east, 0.0))

    return exchange


def moved(recording: Recording, east: Array) -> Recording:
    """The recording with fixes moved to the east by so much (n,) m."""
    radius = 6.378e6 * math.cos(math.radians(recording.datum[0]))
    return dataclasses.replace(recording, fix_longitude_deg=recording.fix_longitude_deg + np.degrees(east / radius))


def lasting(std: float, time: float) -> Exchange:
    """Errors of the fixes that last: first-order Gauss-Markov (m, s)."""

    def exchange(recording: Recording, rng: np.random.Generator) -> Recording:
        decay = math.exp(-0.2 / time)
        error = np.zeros(len(recording.fix_stamp))
        error[0] = std * rng.normal()
        for k in range(1, len(error)):
            error[k] = decay * error[k - 1] + math.sqrt(1.0 - decay**2) * std * rng.normal()
        return moved(recording, error)

    return exchange


def drawn_away(recording: Recording, rng: np.random.Generator) -> Recording:
    """The position is drawn away by 0.5 m/s for 40 s; the velocity is right."""
    seconds = (recording.fix_stamp - recording.imu_stamp[0]) * 1e-9
    return moved(recording, np.where(seconds < END, 0.5 * np.clip(seconds - BEGIN, 0.0, None), 0.0))


def frozen(recording: Recording, rng: np.random.Generator) -> Recording:
    """The receiver repeats its last position with fresh stamps for 40 s."""
    seconds = (recording.fix_stamp - recording.imu_stamp[0]) * 1e-9
    during = (seconds >= BEGIN) & (seconds < END)
    first = int(np.argmax(during))
    changes = {}
    for name in ("fix_latitude_deg", "fix_longitude_deg", "fix_altitude"):
        values = getattr(recording, name).copy()
        values[during] = values[first]
        changes[name] = values
    return dataclasses.replace(recording, **changes)


def delayed(name: str, seconds: float) -> Exchange:
    """Stamps of ``fix`` or ``velocity`` that are late (s)."""

    def exchange(recording: Recording, rng: np.random.Generator) -> Recording:
        stamps = getattr(recording, f"{name}_stamp") + round(seconds * 1e9)
        arrival = np.maximum(getattr(recording, f"{name}_arrival"), stamps)
        return dataclasses.replace(recording, **{f"{name}_stamp": stamps, f"{name}_arrival": arrival})

    return exchange


FAULTS = (
    Fault("clean"),
    Fault("gyro bias step 1 deg/s", added(rate=(0.0, 0.0, math.radians(1.0)))),
    Fault("accelerometer bias step 0.3 m/s2", added(force=(0.3, 0.0, 0.0))),
    Fault("gyro bias ramp 0.5 deg/s in 400 s", ramp),
    Fault("scale 1.5 %", scaled),
    Fault("ten times the noise", noisy),
    Fault("rates clipped at 0.2 rad/s", clipped),
    Fault("shocks of 100 m/s2, 8 rad/s", shocked, end=END),
    Fault("vibration 1 m/s2, 0.05 rad/s", shaken),
    Fault("one gyro stuck for 40 s", stuck, end=END),
    Fault("holes of 1.6 s, dropped", dropped, end=END),
    Fault("holes of 1.6 s, bridged by lines", bridged, end=END),
    Fault("holes of 1.6 s, last sample repeated", repeated, end=END),
    Fault("stamps jittered by 1 ms", jittered),
    Fault("stamps in bursts of four", in_bursts),
    Fault("IMU yaw 5 deg off", parameters={"imu.mount_rpy_deg": (0.0, 0.0, 5.0)}),
    Fault("IMU yaw 90 deg off", parameters={"imu.mount_rpy_deg": (0.0, 0.0, 90.0)}),
    Fault("lever arm 1.5 m off", parameters={"gnss.lever_arm": (1.5, 0.0, 0.0)}),
    Fault("heading given 120 deg wrong", parameters={"alignment.initial_heading_deg": 120.0}),
    Fault("positions stamped 0.25 s late", gnss=delayed("fix", 0.25)),
    Fault("velocities stamped 0.13 s late", gnss=delayed("velocity", 0.13)),
    Fault("lasting errors 1.5 m, 60 s", gnss=lasting(1.5, 60.0)),
    Fault("steps of 15 m, 20 s every minute", gnss=shifted(15.0, 60.0, 20.0)),
    Fault("position drawn away by 0.5 m/s", gnss=drawn_away, end=END),
    Fault("frozen coordinates for 40 s", gnss=frozen, end=END),
)
"""A part of the closed list of faults; parameters are added to those of the recording (mounting angles, lever arm)."""


def parameters_of(fault: Fault, recording: Recording, is_told: bool) -> dict[str, Any]:
    """Parameters of the recording, changed by the fault; without the noise of the IMU where it is not told."""
    parameters = {**recording.parameters(), **NO_SIDE_SLIP}
    if not is_told:
        parameters = {name: value for name, value in parameters.items() if name.removeprefix("imu.") not in IMU_NOISE}
    for name, value in fault.parameters.items():
        if isinstance(value, tuple):
            before = parameters.get(name, (0.0, 0.0, 0.0))
            value = tuple(float(a) + b for a, b in zip(before, value))
        parameters[name] = value
    return parameters
