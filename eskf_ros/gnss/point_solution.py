"""Position, velocity and clock of one epoch from its ranges alone: robust weighted least squares with fault exclusion.

Unknowns: position, receiver clock, and the offset of each further constellation to the first (time scales, and delays
in the receiver); velocity and clock drift from Doppler. Gauss-Newton with Huber's weights against many moderate errors,
then data snooping against gross errors, both on residuals in units of their standard deviation.

Over 400 lines: the solver with its outlier tests, and the settings and results that it is called with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy.earth import SEMI_MAJOR_AXIS, east_north_up_to_ecef, ecef_to_geodetic
from eskf_ros.gnss.range_model import NO_KLOBUCHAR, PREDICTION, predict
from eskf_ros.gnss.ranges import CODE_VALID, DEFAULT_CN0_MASK, DOPPLER_VALID, Status
from eskf_ros.gnss.signals import GNSS_COUNT, Gnss, time_group
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING, Weighting

Array = NDArray[np.float64]


class SolutionStatus(IntEnum):
    """Outcome of the solution of an epoch."""

    SOLVED = 0
    TOO_FEW = 1
    POOR_GEOMETRY = 2
    NOT_CONVERGED = 3
    IMPLAUSIBLE = 4


class PointSettings(NamedTuple):
    """Options of `solve`.

    ``elevation_mask`` rad, ``cn0_mask`` dB-Hz (unknown C/N0 passes). ``huber``: residual in standard deviations above
    which the weight decreases. ``exclusion``: residual in its own standard deviations above which a range is a fault.
    ``system_offset_std``, ``glonass_offset_std``: prior standard deviation of the offset between constellations, m.
    ``poorest_std``: largest formal standard deviation of a position, m, that is accepted.
    """

    elevation_mask: float = math.radians(10.0)
    cn0_mask: float = DEFAULT_CN0_MASK
    huber: float = 1.5
    exclusion: float = 4.0
    system_offset_std: float = 10.0
    glonass_offset_std: float = 30.0
    poorest_std: float = 500.0
    weighting: Weighting = DEFAULT_WEIGHTING


DEFAULT_SETTINGS = PointSettings()

FEWEST = 4
"""Ranges, at least, of a solution."""

LOWEST_ALTITUDE = -10e3
"""m; a position below is implausible."""

HIGHEST_ALTITUDE = 100e3
"""m; a position above is implausible."""

_ITERATIONS = 12
# A step below this share of the standard deviation is the last: Huber's weights may need many more to converge.
_NEGLIGIBLE = 0.01
# While steps are longer than this, elevations mean nothing: no mask.
_NEAR = 1e4
# Redundancy from which on the scale of the residuals can be distinguished from faults among them.
_REDUNDANCY_FOR_SCALE = 5
_TESTABLE = 1e-3
_FEWEST_HOLDING = 0.2


@dataclass
class PointSolution:
    """Solution of one epoch; unsolved parts are NaN.

    - ``position_ecef`` m, ``velocity_ecef`` m/s: with covariances (3, 3).
    - ``clock_bias`` (m, receiver minus the time of ``reference``), ``clock_drift`` (m/s): with standard deviations.
    - ``system_offset`` (8,): offset (m) of the ranges of a `signals.time_group` from those of ``reference`` (NaN
      without ranges).
    - ``variance_factor``: factor of the formal covariances, above 1 where residuals are larger than modelled.
    - ``ranges``: the given ones with their final status; ``predictions`` (PREDICTION): theirs, NaN for unusable ones.
    - ``used``, ``velocity_used``: number of ranges in the position and in the velocity.
    """

    status: SolutionStatus
    velocity_status: SolutionStatus
    position_ecef: Array
    covariance_ecef: Array
    velocity_ecef: Array
    velocity_covariance_ecef: Array
    clock_bias: float
    clock_bias_std: float
    clock_drift: float
    clock_drift_std: float
    reference: int
    system_offset: Array
    variance_factor: float
    used: int
    velocity_used: int
    ranges: NDArray[np.void]
    predictions: NDArray[np.void]

    @property
    def geodetic(self) -> tuple[float, float, float]:
        """Latitude, longitude (rad) and ellipsoidal altitude (m)."""
        latitude, longitude, altitude = ecef_to_geodetic(*(float(value) for value in self.position_ecef))
        return latitude, longitude, altitude

    @property
    def enu_to_ecef(self) -> Array:
        """Rotation (3, 3) from East-North-Up at the position to ECEF."""
        latitude, longitude, _ = self.geodetic
        return np.array(east_north_up_to_ecef(latitude, longitude))

    @property
    def covariance_enu(self) -> Array:
        """Covariance of the position in East-North-Up (m2)."""
        return self.enu_to_ecef.T @ self.covariance_ecef @ self.enu_to_ecef

    @property
    def velocity_enu(self) -> Array:
        """Velocity in East-North-Up (m/s)."""
        return self.enu_to_ecef.T @ self.velocity_ecef

    @property
    def velocity_covariance_enu(self) -> Array:
        """Covariance of the velocity in East-North-Up (m2/s2)."""
        return self.enu_to_ecef.T @ self.velocity_covariance_ecef @ self.enu_to_ecef


def solve(
    ranges: NDArray[np.void],
    week: int,
    seconds: float,
    klobuchar: NDArray[np.float64] | None = None,
    settings: PointSettings = DEFAULT_SETTINGS,
    initial: NDArray[np.float64] | None = None,
) -> PointSolution:
    """Return position, velocity and clock from located ranges (RANGE) of one epoch, one per satellite.

    Code and Doppler of a satellite may be two ranges, each with the flag of its own measurement, as `one_per_satellite`
    leaves them; those without code serve the velocity alone.

    ``week``, ``seconds``: GPS time of the epoch, to a minute. ``klobuchar``: eight parameters, None if unknown: then
    the ionosphere stays in the ranges that are not corrected for it, and in their standard deviation. ``initial``: ECEF
    (m) to start from; not needed. Bad ranges raise nothing: they have a status, and so has the solution.
    """
    solution = _blank(ranges)
    usable = (ranges["status"] == Status.USABLE) & (ranges["flags"] & (CODE_VALID | DOPPLER_VALID) != 0)
    if np.count_nonzero(usable & (ranges["flags"] & CODE_VALID != 0)) < FEWEST:
        return solution
    ionosphere = NO_KLOBUCHAR if klobuchar is None else np.asarray(klobuchar, np.float64)
    epoch = _Epoch(ranges[usable], solution.predictions[usable], week, seconds, ionosphere, settings)
    # Absurd numbers end in a status, not in a warning of numpy.
    with np.errstate(all="ignore"):
        _solve_position(epoch, initial, solution)
        if solution.status == SolutionStatus.SOLVED:
            _solve_velocity(epoch, solution)
    solution.ranges[usable], solution.predictions[usable] = epoch.ranges, epoch.predictions
    return solution


class _Epoch(NamedTuple):
    """The usable ranges of one epoch and how to treat them."""

    ranges: NDArray[np.void]
    predictions: NDArray[np.void]
    week: int
    seconds: float
    ionosphere: Array
    settings: PointSettings

    def predict(self, position: Array, velocity: Array) -> None:
        """Fill the predictions for an antenna at ``position`` (ECEF, m) with ``velocity`` (m/s)."""
        predict(
            self.ranges,
            tuple(position.tolist()),
            tuple(velocity.tolist()),
            self.week,
            self.seconds,
            self.ionosphere,
            self.settings.weighting,
            self.predictions,
        )


def _blank(ranges: NDArray[np.void]) -> PointSolution:
    nothing = math.nan
    predictions = np.zeros(len(ranges), PREDICTION)
    for name in PREDICTION.names or ():
        predictions[name] = nothing
    return PointSolution(
        status=SolutionStatus.TOO_FEW,
        velocity_status=SolutionStatus.TOO_FEW,
        position_ecef=np.full(3, nothing),
        covariance_ecef=np.full((3, 3), nothing),
        velocity_ecef=np.full(3, nothing),
        velocity_covariance_ecef=np.full((3, 3), nothing),
        clock_bias=nothing,
        clock_bias_std=nothing,
        clock_drift=nothing,
        clock_drift_std=nothing,
        reference=int(Gnss.GPS),
        system_offset=np.full(GNSS_COUNT, nothing),
        variance_factor=nothing,
        used=0,
        velocity_used=0,
        ranges=ranges.copy(),
        predictions=predictions,
    )


def _solve_position(epoch: _Epoch, initial: Array | None, solution: PointSolution) -> None:
    """Solve position and clock; write them and the status of each range to ``solution``.

    Over 60 lines: one iteration with its outlier tests, whose parts share ten arrays.
    """
    ranges, predictions, settings = epoch.ranges, epoch.predictions, epoch.settings
    groups = np.array([time_group(*satellite) for satellite in ranges[["gnss_id", "sv_id"]].tolist()])
    coded = ranges["flags"] & CODE_VALID != 0
    # In the order of `Gnss`, which begins with GPS.
    reference, *others = np.unique(groups[coded]).tolist()
    prior_std = np.full(4 + len(others), math.inf)
    for column, group in enumerate(others, start=4):
        prior_std[column] = settings.glonass_offset_std if group == Gnss.GLONASS else settings.system_offset_std
    unknowns = np.zeros(4 + len(others))
    unknowns[:3] = _below(ranges["satellite"][coded]) if initial is None else initial

    weights = np.ones(len(ranges))
    faulty = np.zeros(len(ranges), np.bool_)
    low = weak = faulty
    adjusted = None
    near = False
    # Each fault that is excluded takes a few more steps.
    for _ in range(2 * _ITERATIONS + 2 * len(ranges)):
        epoch.predict(unknowns[:3], np.zeros(3))
        if near:
            low = predictions["elevation"] < settings.elevation_mask
            weak = ranges["cn0"] < settings.cn0_mask
        rows = coded & ~(faulty | low | weak)
        if np.count_nonzero(rows) < FEWEST:
            solution.status = SolutionStatus.TOO_FEW
            return
        design = np.zeros((len(ranges), len(unknowns)))
        design[:, :3] = -predictions["line_of_sight"]
        design[:, 3] = 1.0
        for column, group in enumerate(others, start=4):
            design[groups == group, column] = 1.0
        residual = predictions["code_residual"] - design[:, 3:] @ unknowns[3:]
        huber = settings.huber if near else math.inf
        adjusted = _adjust(
            design[rows], residual[rows], predictions["code_std"][rows], weights[rows], unknowns, prior_std, huber
        )
        if adjusted is None or not np.isfinite(adjusted.step).all():
            solution.status = SolutionStatus.POOR_GEOMETRY
            return
        unknowns = unknowns + adjusted.step
        weights[rows] = adjusted.weights
        length = float(np.linalg.norm(adjusted.step[:3]))
        if near and length < adjusted.negligible_step:
            fault = _fault(adjusted, settings)
            if fault is None:
                break
            faulty[np.flatnonzero(rows)[fault]] = True
        near = near or length < _NEAR
    else:
        solution.status = SolutionStatus.NOT_CONVERGED
        return
    for left_out, status in ((low, Status.LOW_ELEVATION), (weak, Status.LOW_CN0), (faulty, Status.OUTLIER)):
        ranges["status"][left_out] = status
    covariance = adjusted.covariance * adjusted.variance_factor
    altitude = ecef_to_geodetic(*unknowns[:3].tolist())[2]
    if not math.sqrt(np.trace(covariance[:3, :3])) < settings.poorest_std:
        solution.status = SolutionStatus.POOR_GEOMETRY
        return
    if not LOWEST_ALTITUDE < altitude < HIGHEST_ALTITUDE:
        solution.status = SolutionStatus.IMPLAUSIBLE
        return
    solution.status = SolutionStatus.SOLVED
    solution.position_ecef = unknowns[:3]
    solution.covariance_ecef = covariance[:3, :3]
    solution.clock_bias = float(unknowns[3])
    solution.clock_bias_std = math.sqrt(covariance[3, 3])
    solution.reference = reference
    solution.system_offset[[reference, *others]] = 0.0, *unknowns[4:]
    solution.variance_factor = adjusted.variance_factor
    solution.used = int(np.count_nonzero(rows))


def _below(satellites: Array) -> Array:
    """Return the point (m, ECEF) of the Earth's surface below the mean position of the satellites (n, 3)."""
    middle = satellites.mean(axis=0)
    return np.asarray(middle * (SEMI_MAJOR_AXIS / np.linalg.norm(middle)))


class _Adjustment(NamedTuple):
    """A linear least-squares solution: step, its covariance, and the residuals after it."""

    step: Array
    covariance: Array
    weights: Array
    """Huber's weights."""
    normalized: Array
    """Residuals in units of the standard deviation of the measurement."""
    freedom: Array
    """Share of each measurement's error that appears in its residual (redundancy number), 0 to 1."""
    redundancy: int
    scale: float
    """`_scale` of the residuals."""
    variance_factor: float

    @property
    def negligible_step(self) -> float:
        """Length of a step of the first three unknowns below which the iteration ends."""
        return _NEGLIGIBLE * math.sqrt(np.trace(self.covariance[:3, :3]))


def _adjust(
    design: Array, residual: Array, std: Array, weights: Array, unknowns: Array, prior_std: Array, huber: float
) -> _Adjustment | None:
    """Solve design @ step = residual with standard deviations ``std`` and Huber's weights; None if it is singular.

    ``weights``: initial ones. ``prior_std``: prior standard deviations of the ``unknowns`` about zero (inf for none).
    ``huber``: residual in standard deviations above which the weight decreases. Iteratively reweighted least squares
    (Huber, Robust Statistics, section 7.8): the sum that it minimises is convex, so neither the start nor an outlier of
    any size leads it astray.
    """
    whitened, observed = design / std[:, None], residual / std
    prior = np.diag(1.0 / prior_std**2)
    redundancy = len(residual) - len(unknowns) + int(np.count_nonzero(prior))
    pull = -prior @ unknowns
    for _ in range(_ITERATIONS):
        try:
            covariance = np.linalg.inv(whitened.T @ (weights[:, None] * whitened) + prior)
        except np.linalg.LinAlgError:
            return None
        step = covariance @ (whitened.T @ (weights * observed) + pull)
        normalized = observed - whitened @ step
        previous = weights
        weights = np.minimum(1.0, huber / np.maximum(np.abs(normalized), 1e-12))
        if np.abs(weights - previous).max() < 1e-3:
            break
    leverage = np.einsum("ij,jk,ik->i", whitened, covariance, whitened) * weights
    after = unknowns + step
    square_sum = float(weights @ normalized**2 + after @ prior @ after)
    # A range whose weight follows its residual no longer holds the solution in place: only the others count.
    holding = max(_FEWEST_HOLDING, float(np.mean(weights == 1.0)))
    factor = max(1.0, square_sum / redundancy / holding) if redundancy > 0 else 1.0
    scale = _scale(normalized, redundancy)
    return _Adjustment(step, covariance, weights, normalized, 1.0 - leverage, redundancy, scale, factor)


def _scale(normalized: Array, redundancy: int) -> float:
    """Return the factor (at least 1) by which residuals exceed their standard deviations.

    It follows from their median, on which faults in a third of them have little influence. With little redundancy one
    fault and large errors throughout look the same: 1.
    """
    if redundancy < _REDUNDANCY_FOR_SCALE:
        return 1.0
    return max(1.0, 1.4826 * float(np.median(np.abs(normalized))) * math.sqrt(len(normalized) / redundancy))


def _fault(adjusted: _Adjustment, settings: PointSettings) -> int | None:
    """Return the index of the measurement that is most clearly a fault; None if there is none.

    Baarda's data snooping (A testing procedure for use in geodetic networks, 1968): each residual in units of its own
    standard deviation, here times `_scale`, so that an epoch with large errors throughout is not stripped to the ranges
    that happen to agree; the variance factor covers such errors.
    """
    testable = adjusted.freedom > _TESTABLE
    if adjusted.redundancy < 2 or not testable.any():
        return None
    tested = np.zeros(len(testable))
    tested[testable] = np.abs(adjusted.normalized[testable]) / np.sqrt(adjusted.freedom[testable])
    worst = int(np.argmax(tested))
    return worst if tested[worst] > settings.exclusion * adjusted.scale else None


def _solve_velocity(epoch: _Epoch, solution: PointSolution) -> None:
    """Solve velocity and clock drift at the solved position; write them to ``solution``."""
    ranges, predictions, settings = epoch.ranges, epoch.predictions, epoch.settings
    # A reflected code is no reason to distrust the Doppler.
    rows = np.isin(ranges["status"], (Status.USABLE, Status.OUTLIER)) & (ranges["flags"] & DOPPLER_VALID != 0)
    unknowns, unbounded = np.zeros(4), np.full(4, math.inf)
    weights = np.ones(len(ranges))
    for _ in range(_ITERATIONS + 2 * len(ranges)):
        epoch.predict(solution.position_ecef, unknowns[:3])
        rows &= np.isfinite(predictions["doppler_residual"])
        if np.count_nonzero(rows) < FEWEST:
            return
        design = np.concatenate([-predictions["line_of_sight"][rows], np.ones((np.count_nonzero(rows), 1))], axis=1)
        residual = predictions["doppler_residual"][rows] - unknowns[3]
        std = predictions["doppler_std"][rows]
        adjusted = _adjust(design, residual, std, weights[rows], unknowns, unbounded, settings.huber)
        if adjusted is None or not np.isfinite(adjusted.step).all():
            solution.velocity_status = SolutionStatus.POOR_GEOMETRY
            return
        unknowns = unknowns + adjusted.step
        weights[rows] = adjusted.weights
        if np.linalg.norm(adjusted.step[:3]) < adjusted.negligible_step:
            fault = _fault(adjusted, settings)
            if fault is None:
                break
            rows[np.flatnonzero(rows)[fault]] = False
    else:
        solution.velocity_status = SolutionStatus.NOT_CONVERGED
        return
    covariance = adjusted.covariance * adjusted.variance_factor
    solution.velocity_status = SolutionStatus.SOLVED
    solution.velocity_ecef = unknowns[:3]
    solution.velocity_covariance_ecef = covariance[:3, :3]
    solution.clock_drift = float(unknowns[3])
    solution.clock_drift_std = math.sqrt(covariance[3, 3])
    solution.velocity_used = int(np.count_nonzero(rows))
