"""Several recordings together: what each has found is added as information.

A pass returns mean x and covariance P of the constants, which began at 0 with P0. What the recording itself says is
the information P^-1 - P0^-1 and its vector P^-1 x. Information of independent recordings adds (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, section 3.5); the one prior of all is added once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eskf_ros.calibration.recording import Pass

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Combined:
    """Corrections (n,) of the constants from all recordings, their covariance (n, n), and how well these agree.

    ``spread`` (n,): root mean square of what each recording alone differs, in its own standard deviations; 1 for one
    recording alone.
    """

    correction: Array
    covariance: Array
    spread: Array


def combine(passes: Sequence[Pass], moved: Array, prior_std: Array) -> Combined:
    """Return what the recordings say together.

    ``moved`` (n,): by how much the constants have been moved from their prior mean so far, and ``prior_std`` (n,) the
    standard deviation of this prior.
    """
    information = np.diag(1.0 / prior_std**2)
    vector = -information @ moved
    alone = []
    for one in passes:
        inverse = inverted(one.covariance)
        information = information + inverse - np.diag(1.0 / one.prior_std**2)
        vector = vector + inverse @ one.correction
        alone.append((one.correction, np.sqrt(np.diag(one.covariance)), one.prior_std))
    covariance = inverted(0.5 * (information + information.T))
    correction = covariance @ vector
    return Combined(correction, covariance, spread_of(alone, correction))


def inverted(matrix: Array) -> Array:
    """Return the inverse of a covariance whose variances differ by many orders of magnitude."""
    scale = np.sqrt(np.abs(np.diag(matrix)))
    inverse: Array = np.linalg.inv(matrix / np.outer(scale, scale)) / np.outer(scale, scale)
    return 0.5 * (inverse + inverse.T)


def spread_of(alone: Sequence[tuple[Array, Array, Array]], correction: Array) -> Array:
    """Return how far the recordings are from what they say together, in standard deviations; only those that know."""
    squares, counts = np.zeros(len(correction)), np.zeros(len(correction))
    for found, std, prior_std in alone:
        knows = std < 0.5 * prior_std
        squares += np.where(knows, ((found - correction) / std) ** 2, 0.0)
        counts += knows
    return np.sqrt(np.where(counts > 1, squares / np.maximum(counts - 1, 1), 1.0))
