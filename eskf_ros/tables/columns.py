"""Tables of measurements: mappings of arrays, structured arrays or DataFrames, read column by column and checked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.state.time import SECOND

Array = NDArray[np.float64]

Stamps = NDArray[np.int64]

SMALLEST_NANOSECONDS = 10**12
"""Smaller integers are taken for seconds or milliseconds."""

LARGEST_SECONDS = 1e11
"""Larger floating point numbers are taken for nanoseconds."""

SHORTEST_STEP = 100_000
"""ns; integers whose median step is shorter are taken for milliseconds or microseconds."""


class Table:
    """A table of one input, read column by column."""

    def __init__(self, name: str, source: Any) -> None:
        self._name = name
        self._source = source
        if isinstance(source, Mapping):
            self._names = [str(column) for column in source]
        elif isinstance(source, np.ndarray) and source.dtype.names:
            self._names = list(source.dtype.names)
        elif hasattr(source, "columns"):
            self._names = [str(column) for column in source.columns]
        else:
            raise ValueError(
                f"{name}: a {type(source).__name__} is no table: give a mapping of arrays, a structured array or a "
                "DataFrame"
            )
        self._used: set[str] = set()

    def has(self, column: str) -> bool:
        return column in self._names

    def unused(self) -> list[str]:
        """Return the columns that have not been read."""
        return [column for column in self._names if column not in self._used]

    def stamps(self) -> Stamps:
        """Return the stamps as int64 ns (n,). Raises ValueError if they are missing or ambiguous."""
        self._require("stamp")
        self._used.add("stamp")
        found = np.asarray(self._source["stamp"])
        if found.ndim != 1:
            raise ValueError(f"{self._name}: the column stamp has the shape {found.shape}: give one stamp a row, (n,)")
        if not len(found):
            if self._name == "imu":
                raise ValueError("imu: the column stamp is empty: give at least one sample")
            return np.zeros(0, np.int64)
        return nanoseconds(self._name, found)

    def scalar(self, column: str, count: int) -> Array:
        """Return a column as float64 (n,). Raises ValueError for another shape or type."""
        return self._numbers(column, count, ((),))

    def vector(self, column: str, count: int) -> Array:
        """Return a vector as float64 (n, 3), from one column or three. Raises ValueError for another shape or type."""
        parts = [f"{column}_{axis}" for axis in "xyz"]
        if not self.has(column) and any(self.has(part) for part in parts):
            return np.column_stack([self.scalar(part, count) for part in parts])
        return self._numbers(column, count, ((3,),))

    def covariance(self, axes: tuple[str, ...], count: int, one_unit: bool) -> Array | None:
        """Return covariances (n, k, k) of k axes; None without such a column. Raises ValueError for another shape.

        ``one_unit``: a single variance may stand for all axes.
        """
        size = len(axes)
        parts = [f"covariance_{axis}" for axis in axes]
        if not self.has("covariance"):
            if not any(self.has(part) for part in parts):
                return None
            found = np.column_stack([self.scalar(part, count) for part in parts])
        else:
            shapes: tuple[tuple[int, ...], ...] = ((size,), (size, size), (size * size,))
            found = self._numbers("covariance", count, (((),) if one_unit or size == 1 else ()) + shapes)
        if found.ndim == 3:
            return found
        if found.ndim == 2 and found.shape[1] == size * size and size > 1:
            return found.reshape(count, size, size)
        variances = np.repeat(found[:, None], size, axis=1) if found.ndim == 1 else found
        return np.asarray(variances[:, :, None] * np.eye(size), np.float64)

    def _require(self, column: str) -> None:
        if not self.has(column):
            raise ValueError(
                f"{self._name}: the column {column} is missing; there are: {', '.join(self._names) or 'none'}"
            )

    def _numbers(self, column: str, count: int, shapes: tuple[tuple[int, ...], ...]) -> Array:
        """Return a column as float64 whose rows have one of the shapes."""
        self._require(column)
        self._used.add(column)
        found = np.asarray(self._source[column])
        if found.dtype.kind not in "iuf":
            raise ValueError(f"{self._name}: the column {column} is of type {found.dtype}: give numbers (float64)")
        if found.shape not in [(count, *shape) for shape in shapes]:
            wanted = " or ".join(str((count, *shape)) for shape in shapes)
            raise ValueError(
                f"{self._name}: the column {column} has the shape {found.shape}: {count} stamps need {wanted}"
            )
        return np.ascontiguousarray(found, np.float64)


def nanoseconds(name: str, stamps: NDArray[Any]) -> Stamps:
    """Return stamps (n,) as int64 ns; raises ValueError if their unit is not certain."""

    def refuse(row: int, why: str) -> ValueError:
        return ValueError(f"{name}: the column stamp holds {stamps[row]} in row {row}, {why}")

    if stamps.dtype.kind == "M":
        if np.isnat(stamps).any():
            raise refuse(int(np.argmax(np.isnat(stamps))), "which is no time: take such rows out")
        return np.ascontiguousarray(stamps.astype("datetime64[ns]").astype(np.int64))
    if stamps.dtype.kind in "iu":
        largest = int(np.argmax(stamps))
        if int(stamps[largest]) < SMALLEST_NANOSECONDS:
            raise refuse(
                largest,
                "an integer too small for nanoseconds: multiply seconds by 10**9 and milliseconds by 10**6, or give "
                "seconds as float64",
            )
        if int(stamps[largest]) > np.iinfo(np.int64).max:
            raise refuse(largest, "too large for int64 nanoseconds")
        found = np.ascontiguousarray(stamps, np.int64)
        steps = np.diff(np.unique(found))
        if len(steps) and np.median(steps) < SHORTEST_STEP:
            raise refuse(
                largest,
                f"and the stamps are {int(np.median(steps))} apart, too close for nanoseconds: multiply milliseconds "
                "by 10**6 and microseconds by 10**3",
            )
        return found
    if stamps.dtype == np.float64:
        if not np.isfinite(stamps).all():
            raise refuse(int(np.argmin(np.isfinite(stamps))), "which is no time: take such rows out")
        largest = int(np.argmax(np.abs(stamps)))
        if abs(stamps[largest]) > LARGEST_SECONDS:
            raise refuse(largest, "a float too large for seconds: give nanoseconds as int64, or divide to get seconds")
        whole = np.floor(stamps)
        return np.asarray(whole.astype(np.int64) * SECOND + np.rint((stamps - whole) * 1e9).astype(np.int64), np.int64)
    raise refuse(
        0,
        f"of type {stamps.dtype}: give int64 nanoseconds, float64 seconds or datetime64 (in UTC, without a time zone)",
    )


def in_order(parts: Iterable[tuple[Stamps, Array]], width: int) -> tuple[Stamps, Array]:
    """Return all parts joined, sorted by stamp and then by content, independent of the order in which they came."""
    parts = list(parts)
    stamps = np.concatenate([np.zeros(0, np.int64), *(part for part, _ in parts)])
    rows = np.concatenate([np.zeros((0, width)), *(part for _, part in parts)])
    order = np.lexsort((*rows.T[::-1], stamps))
    return stamps[order], rows[order]
