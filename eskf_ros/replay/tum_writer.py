"""Compiled writing of TUM trajectories: Python's own formatting would take a tenth of the time of a replay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from eskf_ros.compiled import njit

LINE_BYTES = 256
"""Upper limit of the length of a line: its stamp, and seven numbers of at most 19 digits."""
TUM_DECIMALS = np.array([6, 6, 6, 9, 9, 9, 9])
"""Decimals of x y z (m) and qx qy qz qw."""


def tum_text(stamps: NDArray[np.int64], numbers: NDArray[np.float64]) -> bytes:
    """Return lines of a TUM trajectory: `t x y z qx qy qz qw`, t in seconds with all nine decimals of the stamp.

    `stamps` (n,) are ns and not negative, `numbers` (n, 7) finite.
    """
    text = np.empty(len(stamps) * LINE_BYTES, np.uint8)
    return text[: _tum(text, stamps, numbers, TUM_DECIMALS)].tobytes()


@njit
def _tum(text, stamps, numbers, decimals):  # type: ignore[no-untyped-def]
    place = 0
    for i in range(len(stamps)):
        place = _put_fixed(text, place, stamps[i], 9)
        for k in range(numbers.shape[1]):
            text[place] = 32
            place += 1
            number = numbers[i, k]
            if number < 0.0:
                text[place] = 45
                place += 1
            scaled = np.int64(abs(number) * 10.0 ** decimals[k] + 0.5)
            place = _put_fixed(text, place, scaled, decimals[k])
        text[place] = 10
        place += 1
    return place


@njit
def _put_fixed(text, place, scaled, decimals):  # type: ignore[no-untyped-def]
    """Write the integer `scaled` >= 0 with a point before its last `decimals` digits; return the index behind it."""
    count = 0
    rest = scaled
    while rest > 0 or count <= decimals:
        rest //= 10
        count += 1
    point = place + count - decimals
    for at in range(place + count, place - 1, -1):
        if at == point:
            text[at] = 46
        else:
            text[at] = 48 + scaled % 10
            scaled //= 10
    return place + count + 1
