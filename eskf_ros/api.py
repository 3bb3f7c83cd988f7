"""The filter for arrays in memory: tables of measurements in, trajectory and innovations out.

`run` takes everything at once; `Filter` takes it in pieces. A table is a mapping of arrays, a structured array or a
pandas DataFrame. A vector is one column (n, 3) or three, with ``_x``, ``_y``, ``_z`` after the name. Columns:

- ``imu``: ``specific_force`` (n, 3) m/s2, +g up at rest, and ``angular_rate`` (n, 3) rad/s, both in IMU axes.
- ``gnss_position``: ``latitude_deg``, ``longitude_deg``, ``altitude`` (m over the ellipsoid) of the antenna;
  ``covariance`` m2 in East-North-Up; ``status`` as in NavSatFix (-1: no fix), optional, 0.
- ``gnss_velocity``: ``velocity`` (n, 3) m/s of the antenna, East-North-Up; ``covariance`` m2/s2.
- ``wheel``: ``speed`` m/s, ``yaw_rate`` rad/s (optional); ``covariance`` of the two.
- ``body_velocity``: ``velocity`` (n, 3) m/s in the axes of the sensor; ``covariance`` m2/s2.
- ``heading``: ``yaw`` rad of the baseline, 0 = east, counter-clockwise, ``pitch`` rad, positive down (optional);
  ``covariance`` rad2 of the two.
- ``mag``: ``field`` (n, 3) T in the axes of the magnetometer; ``covariance`` T2.
- ``baro``: ``pressure`` Pa; ``covariance`` Pa2.

``covariance`` of k values is (n, k) variances, (n, k, k) or (n, k k) row by row, and for values of one unit (n,), the
same variance for each. Separate columns of variances have ``_x``, ``_y``, ``_z``, or the names of the values, after
``covariance``. Without it the ``unknown_..._std`` of the parameters stand in. A negative variance: not measured.

``stamp`` (n,), in every table, on one clock: int64 nanoseconds, float64 seconds (since 1970 they are good to 0.24 us
only) or datetime64. Rows need not be sorted. A stamp that cannot be understood is a ValueError, as is any other table
that cannot be used; a single bad row is left out and counted in the warnings.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.history.records import RECORD
from eskf_ros.filter.history.timeline import EARLY_AIDS, JUMP_CONFIRMATIONS, LARGEST_JUMP
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.state.enums import CONSTRAINTS, STREAM_NAMES, Status, Stream, Verdict
from eskf_ros.geodesy.map_frame import MapFrame, to_geodetic
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.summary import CHI_SQUARE_95, counted, final_result, named

__all__ = ["Filter", "Result", "run"]

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
ParametersLike = str | PathLike[str] | Parameters | Mapping[str, object] | None

SECOND = 1_000_000_000
LARGEST_CHUNK = 1024
UNMEASURED = -1.0

SMALLEST_NANOSECONDS = 10**12
"""Integers below are taken for seconds or milliseconds."""
LARGEST_SECONDS = 1e11
"""Floating point numbers above are taken for nanoseconds."""
SHORTEST_STEP = 100_000
"""Integers that usually follow each other more closely (ns) are milliseconds or microseconds."""

DROPS = {
    Verdict.OUTSIDE_HISTORY: "older than the window history.window behind the IMU, or in a gap of the IMU",
    Verdict.DUPLICATE: "a second one with the same stamp",
    Verdict.BAD_STAMP: "a stamp that is not positive, or far ahead of the IMU",
    Verdict.NON_FINITE: "numbers that are not finite",
    Verdict.BAD_COVARIANCE: "a covariance that is not positive definite",
    Verdict.BAD_VALUE: "values that cannot be true",
    Verdict.NO_FIX: "the receiver had no fix",
    Verdict.BEFORE_ALIGNMENT: "before the level or the position were known, or too many before the first IMU sample",
    Verdict.DISABLED: "switched off by the parameters",
    Verdict.WAITING: "newer than the newest IMU sample",
}
IMU_DROPS = {
    "duplicate": "a second one with the same stamp",
    "late": "older than the window history.window",
    "bad_value": "not finite, or larger than a strapdown IMU can read",
    "bad_stamp": "a stamp that is not positive, or far from the others",
}


class _Kind(NamedTuple):
    """An input: its stream; the columns of its values; what of them may be left out; whether they share a unit."""

    stream: Stream
    columns: tuple[str, ...]
    optional: str = ""
    one_unit: bool = True

    @property
    def is_vector(self) -> bool:
        return len(self.columns) == 1 and self.stream != Stream.BARO


_KINDS = {
    "gnss_position": _Kind(Stream.GNSS_POSITION, ("latitude_deg", "longitude_deg", "altitude")),
    "gnss_velocity": _Kind(Stream.GNSS_VELOCITY, ("velocity",)),
    "wheel": _Kind(Stream.WHEEL, ("speed", "yaw_rate"), "yaw_rate", one_unit=False),
    "body_velocity": _Kind(Stream.BODY_VELOCITY, ("velocity",)),
    "heading": _Kind(Stream.HEADING, ("yaw", "pitch"), "pitch"),
    "mag": _Kind(Stream.MAG, ("field",)),
    "baro": _Kind(Stream.BARO, ("pressure",)),
}


@dataclass(frozen=True)
class Result:
    """What the filter found. Tables are DataFrames where pandas is installed, else structured arrays.

    In a DataFrame a vector is a column for each element (``position_x``), in an array a field of shape (3,).

    Attributes:
        trajectory: base_link at the samples of the output grid, each from what has a stamp up to then. ``stamp`` ns,
            ``status``, ``position_known``, ``heading_known``, ``latitude_deg``, ``longitude_deg``, ``altitude`` m over
            the ellipsoid, ``position`` m and ``velocity`` m/s in map (East-North-Up at the datum), ``attitude`` (w x y
            z, base_link to map), ``position_std`` m, ``rotation_std`` rad. NaN while the position is unknown.
        innovations: one row for each measurement: ``aid``, ``stamp`` ns, ``verdict``, ``dof``, ``nis``, ``innovation``
            (3 numbers, NaN where there are less), the constraints zupt, zaru and nhc included.
        biases: ``stamp``, ``accel_bias`` m/s2, ``gyro_bias`` rad/s, ``accel_bias_std``, ``gyro_bias_std`` in IMU axes.
        warnings: what is wrong or worth knowing, one sentence each; what was dropped, with counts and reasons.
        summary: ``imu`` counts, ``aids`` by name (``offered``, ``fused``, ``rejected``, ``late``, ``waiting``,
            ``nis_mean``, ``nis_in_95``, ``verdicts``), ``datum``, ``restarts``, ``position_resets``, ``final`` state.
        odometry: the rows of the trajectory as the filter gives them (``filter.layout.ODOMETRY``), with covariances.
    """

    trajectory: Any
    innovations: Any
    biases: Any
    warnings: list[str]
    summary: dict[str, Any]
    odometry: NDArray[Any]


class Filter:
    """The filter for tables that come in pieces: push in any order, then `update`.

    What is pushed between two updates gives the same bits in whatever order it is pushed.
    """

    def __init__(self, parameters: ParametersLike = None, output_rate: float = 0.0) -> None:
        """Prepare a filter.

        ``parameters``: a ROS parameter file, `Parameters`, or a mapping with the names of the file, nested or dotted;
        None: the defaults. ``output_rate`` (Hz) of the trajectory; 0: every IMU sample.

        Raises:
            ParameterError: the parameters cannot be used.
            ValueError: the rate is not a number from 0 on.
            TypeError: the parameters are something else.
        """
        if not (math.isfinite(output_rate) and output_rate >= 0.0):
            raise ValueError(f"output_rate is {output_rate!r}: give Hz from 0 on, 0 for every IMU sample")
        self._parameters = _parameters(parameters)
        self._navigator = Navigator(self._parameters, output_rate)
        self._imu_parts: list[tuple[Stamps, Array]] = []
        self._aid_parts: dict[str, list[tuple[Stamps, Array]]] = {name: [] for name in _KINDS}
        self._spans: dict[str, tuple[int, int]] = {}
        self._newest: int | None = None
        self._rows: list[NDArray[Any]] = []
        self._records: list[NDArray[Any]] = []
        self._unused: dict[str, list[str]] = {}

    def push_imu(self, imu: Any) -> None:
        """Take IMU samples; columns as in the head of this module. Raises ValueError for a table of another form."""
        table = _Table("imu", imu)
        stamps = table.stamps()
        values = np.column_stack(
            [table.vector("specific_force", len(stamps)), table.vector("angular_rate", len(stamps))]
        )
        self._note("imu", table, stamps)
        self._imu_parts.append((stamps, values))

    def push_gnss_position(self, gnss_position: Any) -> None:
        """Take positions of the GNSS antenna; columns and errors as in `push_imu`."""
        self._push("gnss_position", gnss_position)

    def push_gnss_velocity(self, gnss_velocity: Any) -> None:
        """Take velocities of the GNSS antenna; columns and errors as in `push_imu`."""
        self._push("gnss_velocity", gnss_velocity)

    def push_wheel(self, wheel: Any) -> None:
        """Take wheel odometry; columns and errors as in `push_imu`."""
        self._push("wheel", wheel)

    def push_body_velocity(self, body_velocity: Any) -> None:
        """Take velocities in the axes of the vehicle; columns and errors as in `push_imu`."""
        self._push("body_velocity", body_velocity)

    def push_heading(self, heading: Any) -> None:
        """Take headings of a baseline; columns and errors as in `push_imu`."""
        self._push("heading", heading)

    def push_mag(self, mag: Any) -> None:
        """Take magnetic fields; columns and errors as in `push_imu`."""
        self._push("mag", mag)

    def push_baro(self, baro: Any) -> None:
        """Take air pressures; columns and errors as in `push_imu`."""
        self._push("baro", baro)

    def update(self) -> NDArray[Any]:
        """Process what was pushed, in the order of stamps, up to the newest IMU sample; newer measurements wait.

        Returns the new ODOMETRY rows (`filter.layout`), one for each new IMU sample on the output grid.
        """
        stamps, imu = _sorted(self._imu_parts, 6)
        self._imu_parts = []
        aids = self._take_aids(int(stamps[-1]) if len(stamps) else None)
        rows: list[NDArray[Any]] = []
        given = first = 0
        while first < len(stamps):
            previous = int(stamps[first - 1]) if first else self._newest
            is_jump = previous is not None and int(stamps[first]) - previous > LARGEST_JUMP
            end = _end_of_chunk(stamps, first, is_jump)
            until = given
            while until < len(aids) and aids[until][0] <= stamps[end - 1]:
                until += 1
            chunk = (
                stamps[first:end],
                np.ascontiguousarray(imu[first:end, :3]),
                np.ascontiguousarray(imu[first:end, 3:]),
            )
            # After a jump the IMU has to be believed first: the measurements would be far ahead of it.
            if is_jump:
                rows.append(self._navigator.push_imu(*chunk))
            self._give(aids[given:until], previous is None)
            rows.append(self._navigator.update() if is_jump else self._navigator.push_imu(*chunk))
            self._records.append(self._navigator.take_records())
            given, first = until, end
        self._give(aids[given:], False)
        rows.append(self._navigator.update())
        if len(stamps):
            self._newest = max(int(stamps[-1]), self._newest or 0)
        # As bytes: numpy copies structured arrays field by field and takes ten times as long.
        new = np.frombuffer(b"".join(part.tobytes() for part in rows), ODOMETRY)
        self._rows.append(new)
        return new

    def result(self) -> Result:
        """Process what was pushed and return all that is known so far; more may be pushed afterwards."""
        self.update()
        navigator = self._navigator
        waiting = [
            np.array([(stamp, stamp, _KINDS[name].stream, 0, Verdict.WAITING, 0, math.nan, (math.nan,) * 3)], RECORD)
            for name, parts in self._aid_parts.items()
            for stamps, _ in parts
            for stamp in stamps.tolist()
        ]
        # A copy ends here; the filter itself goes on.
        last = copy.deepcopy(navigator).finish()
        records = np.concatenate([np.zeros(0, RECORD), *self._records, last, *waiting])
        records = records[np.lexsort((records["source"], records["stream"], records["stamp"]))]
        rows = np.frombuffer(b"".join(part.tobytes() for part in self._rows), ODOMETRY)
        summary = {
            "imu": navigator.imu_counts,
            "aids": {
                STREAM_NAMES[stream]: _aid_summary(records[records["stream"] == stream])
                for stream in Stream
                if (records["stream"] == stream).any()
            },
            "datum": None if navigator.datum is None else list(navigator.datum),
            "restarts": navigator.restarts,
            "position_resets": navigator.position_resets,
            "final": final_result(navigator.odometry[0], navigator.datum),
        }
        return Result(
            _trajectory(rows, navigator.datum),
            _innovations(records),
            _table(
                {name: rows[name] for name in ("stamp", "accel_bias", "gyro_bias", "accel_bias_std", "gyro_bias_std")}
            ),
            [*navigator.complaints, *navigator.notes, *self._drops(summary)],
            summary,
            rows,
        )

    def _refuse_apart(self) -> None:
        """Raise ValueError for an input whose stamps, with its time offset, have no time in common with the IMU's."""
        if "imu" not in self._spans:
            return
        first, last = self._spans["imu"]
        for name, (start, end) in self._spans.items():
            offset = self._offset(name)
            if start + offset > last or end + offset < first:
                raise ValueError(
                    f"{name}: stamp goes from {start} to {end} ns and that of imu from {first} to {last} ns, which "
                    "have no time in common: give all stamps on one clock, or take out this input"
                )

    def _offset(self, name: str) -> int:
        """What the parameters add to the stamps of an input (ns)."""
        if name == "imu":
            return 0
        group = "gnss" if name in ("gnss_position", "gnss_velocity") else name
        return round(getattr(self._parameters, group).time_offset * SECOND)

    def _note(self, name: str, table: _Table, stamps: Stamps) -> None:
        """Keep what is said of a table later."""
        unused = self._unused.setdefault(name, [])
        unused += [column for column in table.unused() if column not in unused]
        if len(stamps):
            first, last = self._spans.get(name, (int(stamps[0]), int(stamps[0])))
            self._spans[name] = min(first, int(stamps.min())), max(last, int(stamps.max()))

    def _push(self, name: str, source: Any) -> None:
        """Keep a table of measurements as stamps (n,) and rows (n, 14): values, covariance, its type, status."""
        kind, table = _KINDS[name], _Table(name, source)
        stamps = table.stamps()
        count = len(stamps)
        rows = np.zeros((count, 14))
        missing = kind.optional if kind.optional and not table.has(kind.optional) else ""
        if kind.is_vector:
            rows[:, :3] = table.vector(kind.columns[0], count)
        else:
            for place, column in enumerate(kind.columns):
                if column != missing:
                    rows[:, place] = table.scalar(column, count)
        axes = ("x", "y", "z") if kind.is_vector or name == "gnss_position" else kind.columns
        axes = tuple(axis for axis in axes if axis != missing)
        covariance = table.covariance(axes, count, kind.one_unit)
        if covariance is None and missing:
            raise ValueError(f"{name}: the column covariance is missing: without {missing} it has to be given")
        if covariance is not None:
            size = len(axes)
            matrix = np.zeros((count, 3, 3))
            matrix[:, :size, :size] = covariance
            given = matrix.any(axis=(1, 2))
            for axis in range(size, 3):
                matrix[given, axis, axis] = UNMEASURED
            rows[:, 3:12] = matrix.reshape(-1, 9)
            rows[:, 12] = 2.0
        if name == "gnss_position" and table.has("status"):
            rows[:, 13] = table.scalar("status", count)
            if not np.isfinite(rows[:, 13]).all():
                raise ValueError(f"{name}: the column status has values that are not finite: give -1 where is no fix")
        self._note(name, table, stamps)
        self._aid_parts[name].append((stamps, rows))

    def _take_aids(self, newest: int | None) -> list[tuple[int, str, int, Array]]:
        """Take what is not newer than the IMU: instant on its clock, input, stamp, row; in this order."""
        limit = max((stamp for stamp in (newest, self._newest) if stamp is not None), default=None)
        taken: list[tuple[int, str, int, Array]] = []
        for name, parts in self._aid_parts.items():
            stamps, rows = _sorted(parts, 14)
            offset = self._offset(name)
            count = 0 if limit is None else int(np.searchsorted(stamps, limit - offset, "right"))
            taken += [(stamp + offset, name, stamp, row) for stamp, row in zip(stamps[:count].tolist(), rows[:count])]
            self._aid_parts[name] = [(stamps[count:], rows[count:])]
        taken.sort(key=lambda item: item[0])
        return taken

    def _give(self, aids: list[tuple[int, str, int, Array]], is_first: bool) -> None:
        """Offer measurements to the navigator; before the first IMU sample the newest ones it has room for."""
        dropped = max(0, len(aids) - EARLY_AIDS) if is_first else 0
        for _, name, stamp, _ in aids[:dropped]:
            record = (stamp, stamp, _KINDS[name].stream, 0, Verdict.BEFORE_ALIGNMENT, 0, math.nan, (math.nan,) * 3)
            self._records.append(np.array([record], RECORD))
        for _, name, stamp, row in aids[dropped:]:
            if name == "gnss_position":
                position = float(row[0]), float(row[1]), float(row[2])
                self._navigator.push_gnss_position(stamp, *position, row[3:12], int(row[12]), int(row[13]), stamp)
            elif name == "gnss_velocity":
                self._navigator.push_gnss_velocity(stamp, row[:3].tolist(), row[3:12], stamp)
            else:
                self._navigator.push(_KINDS[name].stream, stamp, row[:3].tolist(), row[3:12], stamp)

    def _drops(self, summary: dict[str, Any]) -> list[str]:
        """One sentence for each input and reason for which rows of it were not used."""
        lines = []
        for name, reason in IMU_DROPS.items():
            if count := summary["imu"][name]:
                lines.append(f"imu: {count} of {summary['imu']['offered']} samples dropped, {name}: {reason}")
        constraints = {STREAM_NAMES[stream] for stream in CONSTRAINTS}
        for name, aid in summary["aids"].items():
            for verdict, reason in DROPS.items():
                why = verdict.name.lower()
                if name not in constraints and (count := aid["verdicts"].get(why)):
                    lines.append(f"{name}: {count} of {aid['offered']} dropped, {why}: {reason}")
        for name, columns in self._unused.items():
            if columns:
                lines.append(f"{name}: these columns are not known and were not used: {', '.join(columns)}")
        return lines


def run(
    imu: Any,
    gnss_position: Any = None,
    gnss_velocity: Any = None,
    wheel: Any = None,
    body_velocity: Any = None,
    heading: Any = None,
    mag: Any = None,
    baro: Any = None,
    parameters: ParametersLike = None,
    output_rate: float = 0.0,
) -> Result:
    """Run the filter over whole recordings: tables as in the head of this module, None for what there is not.

    ``parameters`` and ``output_rate`` (Hz) as in `Filter`.

    Raises:
        ValueError: a table cannot be used, or has no time in common with the IMU; the message says what to do.
        ParameterError: the parameters cannot be used.
        TypeError: the parameters are of no type that is taken.
    """
    tables = {
        "gnss_position": gnss_position,
        "gnss_velocity": gnss_velocity,
        "wheel": wheel,
        "body_velocity": body_velocity,
        "heading": heading,
        "mag": mag,
        "baro": baro,
    }
    runner = Filter(parameters, output_rate)
    runner.push_imu(imu)
    for name, table in tables.items():
        if table is not None:
            getattr(runner, f"push_{name}")(table)
    runner._refuse_apart()
    return runner.result()


class _Table:
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
        """The columns that nobody has asked for."""
        return [column for column in self._names if column not in self._used]

    def stamps(self) -> Stamps:
        """The stamps as int64 ns (n,)."""
        self._require("stamp")
        self._used.add("stamp")
        found = np.asarray(self._source["stamp"])
        if found.ndim != 1:
            raise ValueError(f"{self._name}: the column stamp has the shape {found.shape}: give one stamp a row, (n,)")
        if not len(found):
            if self._name == "imu":
                raise ValueError("imu: the column stamp is empty: give at least one sample")
            return np.zeros(0, np.int64)
        return _nanoseconds(self._name, found)

    def scalar(self, column: str, count: int) -> Array:
        """A column (n,)."""
        return self._numbers(column, count, ((),))

    def vector(self, column: str, count: int) -> Array:
        """A vector (n, 3), of one column or of three."""
        parts = [f"{column}_{axis}" for axis in "xyz"]
        if not self.has(column) and any(self.has(part) for part in parts):
            return np.column_stack([self.scalar(part, count) for part in parts])
        return self._numbers(column, count, ((3,),))

    def covariance(self, axes: tuple[str, ...], count: int, one_unit: bool) -> Array | None:
        """Covariances (n, k, k) of k axes; None when there is no such column."""
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
        """A column as float64, its rows in one of the shapes."""
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


def _nanoseconds(name: str, stamps: NDArray[Any]) -> Stamps:
    """Stamps (n,) as int64 ns; raises ValueError where it is not certain what they are."""

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


def _sorted(parts: Iterable[tuple[Stamps, Array]], width: int) -> tuple[Stamps, Array]:
    """All parts as one, by stamp and then by content: in whatever order they came."""
    parts = list(parts)
    stamps = np.concatenate([np.zeros(0, np.int64), *(part for part, _ in parts)])
    rows = np.concatenate([np.zeros((0, width)), *(part for _, part in parts)])
    order = np.lexsort((*rows.T[::-1], stamps))
    return stamps[order], rows[order]


def _end_of_chunk(stamps: Stamps, first: int, is_jump: bool) -> int:
    """Where the IMU samples to be pushed at once end: within a second, or as many as make a jump believed."""
    end = int(np.searchsorted(stamps, stamps[first] + SECOND))
    if is_jump:
        end = min(end, first + 2 * JUMP_CONFIRMATIONS)
        end = max(end, min(len(stamps), first + JUMP_CONFIRMATIONS + 1))
    return min(end, first + LARGEST_CHUNK)


def _parameters(given: ParametersLike) -> Parameters:
    if given is None:
        return Parameters()
    if isinstance(given, Parameters):
        return given
    if isinstance(given, Mapping):
        return from_mapping(given)
    if isinstance(given, str | PathLike):
        return load(Path(given))
    raise TypeError(f"parameters are a {type(given).__name__}: give a path, Parameters, a mapping or None")


def _aid_summary(records: NDArray[Any]) -> dict[str, Any]:
    """Counts and consistency of the records (n,) of one stream."""
    counts = np.bincount(records["verdict"], minlength=len(Verdict))
    tested = records[np.isfinite(records["nis"])]
    inside = tested["nis"] <= CHI_SQUARE_95[tested["dof"]]
    return {
        **counted(counts),
        "waiting": int(counts[Verdict.WAITING]),
        "nis_mean": float(tested["nis"].mean()) if len(tested) else None,
        "nis_in_95": float(inside.mean()) if len(tested) else None,
        "verdicts": named(counts),
    }


def _trajectory(rows: NDArray[Any], datum: tuple[float, float, float] | None) -> Any:
    known = rows["position_known"]
    geodetic = np.full((len(rows), 3), math.nan)
    if datum is not None and known.any():
        geodetic[known] = to_geodetic(MapFrame(datum).to_ecef(np.ascontiguousarray(rows["position_map"][known])))
    stds = np.sqrt(np.diagonal(rows["pose_covariance"], axis1=1, axis2=2))
    hidden = ~known[:, None]
    names = np.array([Status(value).name for value in range(max(Status) + 1)])
    return _table(
        {
            "stamp": rows["stamp"],
            "status": names[rows["status"]],
            "position_known": known,
            "heading_known": rows["heading_known"],
            "latitude_deg": np.degrees(geodetic[:, 0]),
            "longitude_deg": np.degrees(geodetic[:, 1]),
            "altitude": geodetic[:, 2],
            "position": np.where(hidden, math.nan, rows["position_map"]),
            "velocity": np.where(hidden, math.nan, rows["velocity_map"]),
            "attitude": rows["attitude_body_to_map"],
            "position_std": np.where(hidden, math.nan, stds[:, :3]),
            "rotation_std": stds[:, 3:],
        }
    )


def _innovations(records: NDArray[Any]) -> Any:
    return _table(
        {
            "aid": np.array(STREAM_NAMES)[records["stream"]],
            "stamp": records["stamp"],
            "verdict": np.array([verdict.name.lower() for verdict in sorted(Verdict)])[records["verdict"]],
            "dof": records["dof"],
            "nis": records["nis"],
            "innovation": records["innovation"],
        }
    )


def _table(columns: dict[str, NDArray[Any]]) -> Any:
    """A DataFrame with a column for each element of a vector; without pandas a structured array."""
    try:
        import pandas  # type: ignore[import-untyped,import-not-found,unused-ignore]
    except ImportError:
        kinds = [(name, values.dtype, values.shape[1:]) for name, values in columns.items()]
        table = np.zeros(len(next(iter(columns.values()))), np.dtype(kinds))
        for name, values in columns.items():
            table[name] = values
        return table
    flat: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        if values.ndim == 1:
            flat[name] = values
        else:
            axes = "wxyz" if values.shape[1] == 4 else "xyz"
            flat |= {f"{name}_{axis}": values[:, place] for place, axis in enumerate(axes)}
    return pandas.DataFrame(flat)
