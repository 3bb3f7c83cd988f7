"""Memory of the kernels: numpy records with named fields, the same code compiled and plain."""

from __future__ import annotations

import numpy as np

from eskf_ros.compiled import COMPILED


def allocate(dtype: np.dtype, count: int | tuple[int, ...] = 1) -> np.ndarray:
    """Return ``count`` zeroed records, or an array of that shape; attributes work in compiled and in plain code."""
    memory = np.zeros(count, dtype)
    # Compiled code reads attributes of any record; plain code only of a recarray, which numba is slow to pass.
    return memory if COMPILED else memory.view(np.recarray)
