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
only) or datetime64. Rows need not be sorted. A table that cannot be used, or a stamp whose unit is unclear, raises
ValueError; a single bad row is left out and counted in the warnings.

Over 400 lines: two thirds are the documentation of columns, units and errors.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.history.clock_steps import TRANSITION
from eskf_ros.filter.history.records import RECORD
from eskf_ros.filter.history.timeline import EARLY_AIDS, JUMP_CONFIRMATIONS, LARGEST_JUMP
from eskf_ros.filter.measurements.row import UNMEASURED
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.rows import ROWS
from eskf_ros.filter.state.enums import CONSTRAINTS, STREAM_NAMES, Stream, Verdict
from eskf_ros.filter.state.time import SECOND
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.summary import final_result
from eskf_ros.smooth.smoother import Smoother
from eskf_ros.tables.columns import Array, Stamps, Table, in_order
from eskf_ros.tables.eras import eras_of
from eskf_ros.tables.feeding import WIDTH, push_row
from eskf_ros.tables.results import aid_summary, bias_table, innovation_table, trajectory_table

__all__ = ["Filter", "Result", "Smoothed", "run"]

ParametersLike = str | PathLike[str] | Parameters | Mapping[str, object] | None

LARGEST_CHUNK = 1024
"""IMU samples given to the navigator at once, at most."""


DROPS = {
    Verdict.OUTSIDE_HISTORY: "older than the window history.window behind the IMU, or in a gap of the IMU",
    Verdict.DUPLICATE: "a second one with the same stamp",
    Verdict.BAD_STAMP: "a stamp that is not positive, or far ahead of the IMU",
    Verdict.NON_FINITE: "numbers that are not finite",
    Verdict.BAD_COVARIANCE: "a covariance that is not positive definite",
    Verdict.BAD_VALUE: "values that cannot be true",
    Verdict.UNFILLED: "latitude and longitude are zero: nobody filled them in",
    Verdict.REPEATED: "the coordinates of the fix before, bit for bit",
    Verdict.NO_FIX: "the receiver had no fix",
    Verdict.BEFORE_ALIGNMENT: "before the level or the position were known, or too many before the first IMU sample",
    Verdict.DISABLED: "switched off by the parameters",
    Verdict.WAITING: "newer than the newest IMU sample",
}
"""Why a measurement was not used, by verdict."""

IMU_DROPS = {
    "duplicate": "a second one with the same stamp",
    "late": "older than the window history.window",
    "bad_value": "not finite, or larger than a strapdown IMU can read",
    "bad_stamp": "a stamp that is not positive, or far from the others",
}
"""Why an IMU sample was not used, by the counter of the navigator."""


_KINDS = {row.name: row for row in ROWS if row.columns}
"""Rows of the measurements that can be pushed, by name."""


@dataclass(frozen=True)
class Result:
    """Results of the filter. Tables are DataFrames if pandas is installed, else structured arrays.

    In a DataFrame a vector is a column for each element (``position_x``), in an array a field of shape (3,).

    Attributes:
        trajectory: base_link at the samples of the output grid, each estimated from stamps up to its own. ``stamp`` ns,
            ``status``, ``usable`` (for navigation) with its reason ``quality``, ``position_known``, ``heading_known``,
            ``latitude_deg``, ``longitude_deg``, ``altitude`` m over the ellipsoid, ``position`` m and ``velocity`` m/s
            in map (East-North-Up at the datum), ``attitude`` (w x y z, base_link to map), ``position_std`` m,
            ``rotation_std`` rad. NaN while the position is unknown.
        innovations: one row for each measurement: ``aid``, ``stamp`` ns, ``verdict``, ``dof``, ``nis``, ``innovation``
            (3 numbers, NaN beyond ``dof``), the constraints zupt, zaru and nhc included.
        biases: ``stamp``, ``accel_bias`` m/s2, ``gyro_bias`` rad/s, ``accel_bias_std``, ``gyro_bias_std`` in IMU axes.
        warnings: faults and facts worth knowing, one sentence each; what was dropped, with counts and reasons.
        summary: ``imu`` counts, ``aids`` by name (``offered``, ``fused``, ``rejected``, ``late``, ``waiting``,
            ``nis_mean``, ``nis_in_95``, ``verdicts``), ``datum``, ``restarts``, ``position_resets``, ``takeovers``,
            ``final`` state.
        odometry: the rows of the trajectory as the filter gives them (``filter.output.global_odometry.ODOMETRY``), with
            covariances.

    `smooth` gives the best trajectory afterwards.
    """

    trajectory: Any
    innovations: Any
    biases: Any
    warnings: list[str]
    summary: dict[str, Any]
    odometry: NDArray[Any]
    _smoother: Callable[[], tuple[Smoother, tuple[float, float, float] | None]] | None = None

    def smooth(self) -> Smoothed:
        """Return the smoothed trajectory: each moment from the measurements before and after it.

        A result of `run` runs the filter once more for it.

        Raises:
            ValueError: the `Filter` was made without ``smooth=True``, so that it has kept no log.
        """
        if self._smoother is None:
            raise ValueError("the filter kept no log to smooth: make it with Filter(..., smooth=True)")
        smoother, datum = self._smoother()
        rows = np.frombuffer(b"".join(part.tobytes() for part in smoother.rows()), ODOMETRY)
        return Smoothed(trajectory_table(rows, datum), bias_table(rows), rows, smoother.breaks)


@dataclass(frozen=True)
class Smoothed:
    """The smoothed trajectory; ``trajectory``, ``biases`` and ``odometry`` as in `Result`, where the position is known.

    ``breaks``: starts, resets and takeovers of the filter, over which nothing is smoothed. Status and quality are those
    of the filter; there is no pose in odom.
    """

    trajectory: Any
    biases: Any
    odometry: NDArray[Any]
    breaks: int


class Filter:
    """The filter for tables that come in pieces: push in any order, then `update`.

    The result is the same, bit for bit, in whatever order the tables between two updates are pushed. A clock that was
    set back is recognised within one table, or between two updates.
    """

    def __init__(self, parameters: ParametersLike = None, output_rate: float = 0.0, smooth: bool = False) -> None:
        """Prepare a filter.

        ``parameters``: a ROS parameter file, `Parameters`, or a mapping with the names of the file, nested or dotted;
        None: the defaults. ``output_rate`` (Hz) of the trajectory; 0: every IMU sample. ``smooth``: keep what
        `Result.smooth` needs, in a temporary file.

        Raises:
            ParameterError: the parameters cannot be used.
            ValueError: the rate is negative or not finite.
            TypeError: the parameters have another type.
        """
        if not (math.isfinite(output_rate) and output_rate >= 0.0):
            raise ValueError(f"output_rate is {output_rate!r}: give Hz from 0 on, 0 for every IMU sample")
        self._parameters = _parameters(parameters)
        self._navigator = Navigator(self._parameters, output_rate, keeps_log=smooth)
        self._smoother = Smoother(self._navigator) if smooth else None
        self._imu_parts: list[tuple[Stamps, Array]] = []
        self._aid_parts: dict[str, list[tuple[Stamps, Array]]] = {name: [] for name in _KINDS}
        self._spans: dict[str, tuple[int, int]] = {}
        self._newest: int | None = None
        self._rows: list[NDArray[Any]] = []
        self._records: list[NDArray[Any]] = []
        self._unused: dict[str, list[str]] = {}

    @property
    def state(self) -> np.void:
        """The estimate at the newest IMU sample that was processed, with its covariance (`filter.layout.STATE`)."""
        state: np.void = self._navigator.state[0]
        return state

    def push_imu(self, imu: Any) -> None:
        """Take IMU samples; columns as in the module docstring. Raises ValueError for a table that cannot be used."""
        table = Table("imu", imu)
        stamps = table.stamps()
        values = np.column_stack(
            [table.vector("specific_force", len(stamps)), table.vector("angular_rate", len(stamps))]
        )
        self._note("imu", table, stamps)
        self._imu_parts.append((stamps, values))

    def push(self, name: str, table: Any) -> None:
        """Take measurements; ``name`` and columns as in the module docstring, errors as in `push_imu`."""
        if name not in _KINDS:
            raise ValueError(f"{name}: no such measurement; there are {', '.join(_KINDS)}")
        self._push(name, table)

    def push_gnss_position(self, gnss_position: Any) -> None:
        """Take positions of the GNSS antenna."""
        self.push("gnss_position", gnss_position)

    def push_gnss_velocity(self, gnss_velocity: Any) -> None:
        """Take velocities of the GNSS antenna."""
        self.push("gnss_velocity", gnss_velocity)

    def push_wheel(self, wheel: Any) -> None:
        """Take wheel odometry."""
        self.push("wheel", wheel)

    def push_body_velocity(self, body_velocity: Any) -> None:
        """Take velocities in the axes of the vehicle."""
        self.push("body_velocity", body_velocity)

    def push_heading(self, heading: Any) -> None:
        """Take headings of a baseline."""
        self.push("heading", heading)

    def push_mag(self, mag: Any) -> None:
        """Take magnetic fields."""
        self.push("mag", mag)

    def push_baro(self, baro: Any) -> None:
        """Take air pressures."""
        self.push("baro", baro)

    def update(self) -> NDArray[Any]:
        """Process what was pushed, in the order of stamps, up to the newest IMU sample; newer measurements wait.

        Returns the new ODOMETRY rows (`filter.output.global_odometry`), one for each new IMU sample on the output grid.
        """
        eras = eras_of(self._imu_parts, self._aid_parts)
        self._imu_parts = []
        rows: list[NDArray[Any]] = []
        for number, (imu_parts, self._aid_parts) in enumerate(eras):
            rows += self._update_era(imu_parts, is_last=number + 1 == len(eras), is_set=number > 0)
        # Joined as bytes: numpy copies structured arrays field by field, which takes ten times as long.
        new = np.frombuffer(b"".join(part.tobytes() for part in rows), ODOMETRY)
        self._rows.append(new)
        return new

    def _update_era(self, imu_parts: list[tuple[Stamps, Array]], is_last: bool, is_set: bool) -> list[NDArray[Any]]:
        """Process what one clock has stamped; return the new rows. ``is_set``: the clock was set back before."""
        stamps, imu = in_order(imu_parts, 6)
        if is_set:
            self._newest = int(stamps[0]) - 1
        aids = self._take_aids(int(stamps[-1]) if len(stamps) else None, is_last)
        rows: list[NDArray[Any]] = []
        given = first = 0
        while first < len(stamps):
            previous = int(stamps[first - 1]) if first else self._newest
            # The IMU must confirm a jump first: the measurements would be refused, or taken for those of the old clock.
            is_jump = previous is not None and int(stamps[first]) - previous > LARGEST_JUMP
            is_jump = is_jump or (is_set and int(stamps[first] - stamps[0]) < 2 * TRANSITION)
            end = _end_of_chunk(stamps, first, is_jump)
            until = given
            while until < len(aids) and aids[until][0] <= stamps[end - 1]:
                until += 1
            chunk = (
                stamps[first:end],
                np.ascontiguousarray(imu[first:end, :3]),
                np.ascontiguousarray(imu[first:end, 3:]),
            )
            if is_jump:
                rows.append(self._navigator.push_imu(*chunk))
            self._give(aids[given:until], previous is None)
            rows.append(self._navigator.update() if is_jump else self._navigator.push_imu(*chunk))
            self._records.append(self._navigator.take_records())
            if self._smoother is not None:
                self._smoother.collect()
            given, first = until, end
        self._give(aids[given:], False)
        rows.append(self._navigator.update())
        if len(stamps):
            self._newest = max(int(stamps[-1]), self._newest or 0)
        return rows

    def result(self) -> Result:
        """Process what was pushed and return all results so far; more may be pushed afterwards."""
        self.update()
        navigator = self._navigator
        waiting = [
            np.array([(stamp, stamp, _KINDS[name].stream, 0, Verdict.WAITING, 0, math.nan, (math.nan,) * 3)], RECORD)
            for name, parts in self._aid_parts.items()
            for stamps, _ in parts
            for stamp in stamps.tolist()
        ]
        # Only a copy is finished: the filter itself can go on.
        finished = copy.deepcopy(navigator)
        last = finished.finish()
        records = np.concatenate([np.zeros(0, RECORD), *self._records, last, *waiting])
        records = records[np.lexsort((records["source"], records["stream"], records["stamp"]))]
        rows = np.frombuffer(b"".join(part.tobytes() for part in self._rows), ODOMETRY)
        summary = {
            "imu": navigator.imu_counts,
            "aids": {
                STREAM_NAMES[stream]: aid_summary(records[records["stream"] == stream])
                for stream in Stream
                if (records["stream"] == stream).any()
            },
            "datum": None if navigator.datum is None else list(navigator.datum),
            "restarts": navigator.restarts,
            "position_resets": navigator.position_resets,
            "takeovers": navigator.takeovers,
            "final": final_result(navigator.odometry[0], navigator.datum),
        }
        return Result(
            trajectory_table(rows, navigator.datum),
            innovation_table(records),
            bias_table(rows),
            [*navigator.complaints, *navigator.notes, *self._drops(summary)],
            summary,
            rows,
            None if self._smoother is None else partial(_smoothed, self._smoother.copied_for(finished), finished),
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
        """Return the time offset (ns) that the parameters add to the stamps of an input."""
        if name == "imu":
            return 0
        group = "gnss" if name in ("gnss_position", "gnss_velocity") else name
        offset: float = getattr(self._parameters, group).time_offset
        if name == "gnss_velocity":
            return round(offset * SECOND) + round(self._parameters.gnss.velocity_time_offset * SECOND)
        return round(offset * SECOND)

    def _note(self, name: str, table: Table, stamps: Stamps) -> None:
        """Remember the unused columns of a table and the span of its stamps, for warnings and errors."""
        unused = self._unused.setdefault(name, [])
        unused += [column for column in table.unused() if column not in unused]
        if len(stamps):
            first, last = self._spans.get(name, (int(stamps[0]), int(stamps[0])))
            self._spans[name] = min(first, int(stamps.min())), max(last, int(stamps.max()))

    def _push(self, name: str, source: Any) -> None:
        """Keep a table of measurements as stamps (n,) and rows (n, 14): values, covariance, its type, status."""
        kind, table = _KINDS[name], Table(name, source)
        stamps = table.stamps()
        count = len(stamps)
        rows = np.zeros((count, WIDTH))
        missing = kind.optional_column if kind.optional_column and not table.has(kind.optional_column) else ""
        if kind.is_vector:
            rows[:, :3] = table.vector(kind.columns[0], count)
        else:
            for place, column in enumerate(kind.columns):
                if column != missing:
                    rows[:, place] = table.scalar(column, count)
        axes = ("x", "y", "z") if kind.is_vector or name == "gnss_position" else kind.columns
        axes = tuple(axis for axis in axes if axis != missing)
        covariance = table.covariance(axes, count, kind.has_one_unit)
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

    def _take_aids(self, newest: int | None, is_last: bool) -> list[tuple[int, str, int, Array]]:
        """Take the measurements not newer than the IMU: (stamp on its clock, input, own stamp, row), sorted.

        No IMU sample comes any more for those of a clock that is not the last: they are taken all.
        """
        limit = max((stamp for stamp in (newest, self._newest) if stamp is not None), default=None)
        taken: list[tuple[int, str, int, Array]] = []
        for name, parts in self._aid_parts.items():
            stamps, rows = in_order(parts, WIDTH)
            offset = self._offset(name)
            count = 0 if limit is None else int(np.searchsorted(stamps, limit - offset, "right"))
            count = count if is_last else len(stamps)
            taken += [(stamp + offset, name, stamp, row) for stamp, row in zip(stamps[:count].tolist(), rows[:count])]
            self._aid_parts[name] = [(stamps[count:], rows[count:])]
        taken.sort(key=lambda item: item[0])
        return taken

    def _give(self, aids: list[tuple[int, str, int, Array]], is_first: bool) -> None:
        """Push measurements to the navigator; before the first IMU sample only the newest `EARLY_AIDS`."""
        dropped = max(0, len(aids) - EARLY_AIDS) if is_first else 0
        for _, name, stamp, _ in aids[:dropped]:
            record = (stamp, stamp, _KINDS[name].stream, 0, Verdict.BEFORE_ALIGNMENT, 0, math.nan, (math.nan,) * 3)
            self._records.append(np.array([record], RECORD))
        for _, name, stamp, row in aids[dropped:]:
            push_row(self._navigator, name, stamp, row, stamp)

    def _drops(self, summary: dict[str, Any]) -> list[str]:
        """Return one sentence for each input and reason for which rows of it were not used."""
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
    **others: Any,
) -> Result:
    """Run the filter over whole recordings: tables as in the module docstring, None for missing ones.

    ``parameters`` and ``output_rate`` (Hz) as in `Filter`. ``others``: tables of measurements that you added, by name
    (``docs/add_a_measurement.md``).

    Raises:
        ValueError: a table cannot be used, or has no time in common with the IMU; the message says what to do.
        ParameterError: the parameters cannot be used.
        TypeError: the parameters have another type.
    """
    tables = {
        "gnss_position": gnss_position,
        "gnss_velocity": gnss_velocity,
        "wheel": wheel,
        "body_velocity": body_velocity,
        "heading": heading,
        "mag": mag,
        "baro": baro,
        **others,
    }
    result = _run(imu, tables, parameters, output_rate, False)
    return replace(result, _smoother=partial(_run_again, imu, tables, parameters, output_rate))


def _run(imu: Any, tables: Mapping[str, Any], parameters: ParametersLike, output_rate: float, smooth: bool) -> Result:
    runner = Filter(parameters, output_rate, smooth)
    runner.push_imu(imu)
    for name, table in tables.items():
        if table is not None:
            runner.push(name, table)
    runner._refuse_apart()
    return runner.result()


def _run_again(
    imu: Any, tables: Mapping[str, Any], parameters: ParametersLike, output_rate: float
) -> tuple[Smoother, tuple[float, float, float] | None]:
    """Return the smoother of the same run, and its datum."""
    again = _run(imu, tables, parameters, output_rate, True)._smoother
    assert again is not None
    return again()


def _smoothed(smoother: Smoother, finished: Navigator) -> tuple[Smoother, tuple[float, float, float] | None]:
    """Return a smoother that has smoothed up to the end of ``finished``, and the datum."""
    smoother.smooth()
    return smoother, finished.datum


def _end_of_chunk(stamps: Stamps, first: int, is_jump: bool) -> int:
    """Return the end of the IMU samples to be pushed at once: within a second, or enough to confirm a jump."""
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
