"""Calling the compiled kernels one by one: records, errors as vectors, many IMU samples at once."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.compiled import njit
from eskf_ros.filter import predict
from eskf_ros.filter.history.records import IMU
from eskf_ros.filter.inertial.navigation_frame import set_datum
from eskf_ros.filter.layout import STATE, WORK, blank_state
from eskf_ros.filter.loop import take_sample
from eskf_ros.filter.settings import settings_from
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER
from eskf_ros.parameters.mapping import from_mapping

Array = NDArray[np.float64]

POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
ACCEL_BIAS, GYRO_BIAS = slice(9, 12), slice(12, 15)


def make_settings(**parameters: Any) -> Any:
    """Return the SETTINGS record of parameters given as ``group__name=value``."""
    named = {key.replace("__", "."): value for key, value in parameters.items()}
    return settings_from(from_mapping(named))[0]


def make_work() -> Any:
    return allocate(WORK)[0]


def to_rotation(quaternion: Any) -> Rotation:
    """Return the scipy rotation of a quaternion w x y z."""
    w, x, y, z = quaternion
    return Rotation.from_quat([x, y, z, w])


def to_quaternion(rotation: Rotation) -> Array:
    """Return w x y z."""
    return np.asarray(rotation.as_quat()[[3, 0, 1, 2]])


def make_state(
    position: Any = (0.0, 0.0, 0.0),
    velocity: Any = (0.0, 0.0, 0.0),
    attitude: Rotation | None = None,
    datum: tuple[float, float, float] | None = (48.137, 11.575, 565.0),
) -> Any:
    """Return the record of a running filter: everything known, biases zero, covariance zero."""
    state = blank_state()[0]
    if datum is not None:
        set_datum(state, math.radians(datum[0]), math.radians(datum[1]), datum[2])
    state["position_map"] = position
    state["velocity_map"] = velocity
    if attitude is not None:
        state["attitude"] = to_quaternion(attitude)
    for name in ("level_known", "position_known", "heading_known"):
        state[name] = 1
    state["stamp"] = state["imu"]["stamp"] = 0
    state["imu"]["interval"] = 0.01
    return state


def random_state(seed: int, far: float = 3000.0) -> Any:
    """Return a running filter somewhere on the Earth within ``far`` m of its datum, any attitude, with biases."""
    rng = np.random.default_rng(seed)
    state = make_state(
        far * rng.uniform(-1.0, 1.0, 3) * (1.0, 1.0, 0.1),
        rng.normal(0.0, 15.0, 3),
        Rotation.random(random_state=seed),
        (math.degrees(math.asin(rng.uniform(-1.0, 1.0))), rng.uniform(-180.0, 180.0), rng.uniform(-100.0, 5000.0)),
    )
    state["accel_bias"] = rng.normal(0.0, 0.2, 3)
    state["gyro_bias"] = rng.normal(0.0, 0.02, 3)
    state["specific_force"] = rng.normal(0.0, 5.0, 3) + to_rotation(state["attitude"]).inv().apply([0.0, 0.0, 9.8])
    state["angular_rate"] = rng.normal(0.0, 1.0, 3)
    return state


def core(state: Any) -> Array:
    """Return the covariance of the 15 errors every robot has, as a view."""
    return state["covariance"][:15, :15]  # type: ignore[no-any-return]


def copy_of(state: Any) -> Any:
    """Return a record of its own with the same contents."""
    copy = allocate(STATE)
    copy[0] = state
    return copy[0]


def with_error(state: Any, error: Any) -> Any:
    """Return the state that is true when ``state`` is in error by the 15 numbers: q_true = dq(theta) q, else sums."""
    error = np.asarray(error, dtype=np.float64)
    true = copy_of(state)
    for name, block in (
        ("position_map", POSITION),
        ("velocity_map", VELOCITY),
        ("accel_bias", ACCEL_BIAS),
        ("gyro_bias", GYRO_BIAS),
    ):
        true[name] = state[name] + error[block]
    true["attitude"] = to_quaternion(Rotation.from_rotvec(error[ATTITUDE]) * to_rotation(state["attitude"]))
    return true


def error_of(state: Any, true: Any) -> Array:
    """Return the 15 numbers by which ``state`` is in error; the inverse of ``with_error``."""
    turn = to_rotation(true["attitude"]) * to_rotation(state["attitude"]).inv()
    return np.concatenate(
        [
            true["position_map"] - state["position_map"],
            true["velocity_map"] - state["velocity_map"],
            turn.as_rotvec(),
            true["accel_bias"] - state["accel_bias"],
            true["gyro_bias"] - state["gyro_bias"],
        ]
    )


def random_covariance(seed: int, stds: Any) -> Array:
    """Return a symmetric positive definite matrix with strong correlations and about these standard deviations."""
    rng = np.random.default_rng(seed)
    size = len(stds)
    factor = rng.normal(size=(size, size + 2))
    factor /= np.linalg.norm(factor, axis=1)[:, None]
    scaled = np.asarray(stds)[:, None] * factor
    covariance = scaled @ scaled.T
    return np.asarray(0.5 * (covariance + covariance.T))


USUAL_STDS = np.repeat([2.0, 0.3, 0.02, 0.1, 0.003], 3)
"""Standard deviations of a filter at work: m, m/s, rad, m/s2, rad/s."""


def conditioned_eigenvalues(covariance: Array) -> Array:
    """Return the eigenvalues of the correlation matrix: positive definite whatever the units."""
    std = np.sqrt(np.diag(covariance))
    return np.asarray(np.linalg.eigvalsh(covariance / np.outer(std, std)))


def tuples(vector: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in vector)


def run_samples(
    state: Any, stamps: Any, force: Any, rate: Any, settings: Any, work: Any, cuts: NDArray[np.int64] | None = None
) -> None:
    """Propagate ``state``, which stands at the first sample, through all the others, cut at the stamps ``cuts``."""
    samples = allocate(IMU, len(stamps))
    samples["stamp"], samples["specific_force"], samples["angular_rate"] = stamps, force, rate
    _run_samples(state, samples, np.zeros(0, np.int64) if cuts is None else cuts, settings, work)


@njit
def _run_samples(state, samples, cuts, settings, work):
    state.imu.stamp = NEVER
    state.imu.interval = 1e9
    take_sample(state, samples[0], samples[0].stamp)
    cut = 0
    for k in range(1, len(samples)):
        sample = samples[k]
        while cut < len(cuts) and cuts[cut] < sample.stamp:
            if cuts[cut] > state.stamp:
                predict.propagate(state, cuts[cut], sample, sample.stamp, settings, work)
            cut += 1
        predict.propagate(state, sample.stamp, sample, sample.stamp, settings, work)
        take_sample(state, sample, sample.stamp)
