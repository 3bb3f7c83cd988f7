"""Arguments and results of the navigator: stamps, vectors and covariances checked for type and shape."""

from __future__ import annotations

import operator
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

StampArray = npt.NDArray[np.int64]


def copied(records: np.ndarray, count: int) -> np.ndarray:
    """Return the first ``count`` records in memory of their own: through bytes, because numpy copies field by field."""
    return np.frombuffer(bytearray(records[:count].tobytes()), records.dtype)


def whole_stamp(stamp: int) -> int:
    """Return a stamp as an int; raises TypeError for one that is not an integer."""
    try:
        return operator.index(stamp)
    except TypeError:
        raise TypeError(
            f"the stamp {stamp!r} is not an integer: stamps are int64 nanoseconds; for seconds: round(seconds * 1e9)"
        ) from None


def whole_stamps(stamps: StampArray) -> StampArray:
    """Return stamps (n,) as int64; raises TypeError if they are not integers, ValueError for another shape."""
    found = np.asarray(stamps)
    if found.ndim != 1:
        raise ValueError(f"stamps have the shape {found.shape}; one row of n is needed: (n,)")
    if found.dtype != np.int64 and len(found) and not np.issubdtype(found.dtype, np.integer):
        raise TypeError(
            f"stamps are of type {found.dtype}: they must be int64 nanoseconds; for seconds: "
            "np.round(seconds * 1e9).astype(np.int64)"
        )
    return np.ascontiguousarray(found, np.int64)


def vectors(name: str, values: FloatArray, count: int) -> FloatArray:
    """Return the vectors of ``count`` stamps as float64 (n, 3); raises ValueError for another shape."""
    found = np.ascontiguousarray(values, np.float64)
    if found.shape != (count, 3):
        raise ValueError(f"{name} has the shape {found.shape}; {count} stamps need ({count}, 3)")
    return found


def nine(covariance: Sequence[float] | FloatArray) -> FloatArray:
    """Return a covariance, (9,) row-major or (3, 3), as (9,); raises ValueError for another size."""
    found = np.ascontiguousarray(covariance, np.float64)
    if found.shape not in ((9,), (3, 3)):
        raise ValueError(f"a covariance has the shape {found.shape}; nine numbers row by row or (3, 3) are needed")
    return found.reshape(9)
