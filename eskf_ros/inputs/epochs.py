"""Intake of `gnss/ranges` and `gnss/ephemerides`: from messages to the navigator, the same for node and replay."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.time import SECOND
from eskf_ros.gnss.cloud import CloudError, Epoch, read_epoch, write_epoch
from eskf_ros.gnss.dated_ephemerides import DatedEphemerides
from eskf_ros.gnss.ephemeris import EPHEMERIS, Ephemerides, Fault, check
from eskf_ros.gnss.ephemeris_cloud import read_ephemerides
from eskf_ros.gnss.measurements import Masks, measured_epoch
from eskf_ros.gnss.point_solution import PointSettings, PointSolution, SolutionStatus, solve
from eskf_ros.gnss.range_files import read_navigation_files
from eskf_ros.gnss.range_model import NO_KLOBUCHAR
from eskf_ros.gnss.ranges import (
    CODE_VALID,
    DOPPLER_VALID,
    SATELLITE_KNOWN,
    Status,
    allocate_ranges,
    locate,
    one_per_satellite,
    status_counts,
)
from eskf_ros.gnss.signals import Gnss
from eskf_ros.gnss.time import Instant
from eskf_ros.parameters.tree import Parameters

HORIZON = math.radians(-90.0)
"""rad; no elevation mask here, because only the filter knows where the receiver is."""

DEFAULT_KLOBUCHAR = np.array(
    [0.1118e-07, -0.7451e-08, -0.5961e-07, 0.1192e-06, 0.1167e06, -0.2294e06, -0.1311e06, 0.1049e07]
)
"""Klobuchar parameters broadcast on 1 January 2004, a year of moderate solar activity: a stand-in where none came (as
in RTKLIB). Zeros would leave the whole delay, metres that differ from satellite to satellite.
"""

KLOBUCHAR_SOURCES = {Gnss.GPS, Gnss.QZSS}
"""Constellations whose ionosphere parameters belong to the same model: those of GPS are used, those of QZSS where they
are missing.

The parameters of BeiDou belong to another model: geographic latitudes, a layer at 375 km, a period with an upper limit
(BDS-SIS-ICD-B1I 3.0, section 5.2.4).
"""

COVARIANCE_KNOWN = 3
STATUS_FIX = 0

REMEDIES = {
    Status.NO_EPHEMERIS: "set ranges.rinex_nav_files, or record topics.ephemerides",
    Status.STALE: "the ephemerides are of another time: set ranges.rinex_nav_files to files of the day",
    Status.WRONG_WEEK: "the week of the time tags or of the ephemerides is wrong",
    Status.UNHEALTHY: "the satellites say that they are not to be used",
    Status.UNKNOWN_SIGNAL: "the numbers gnss_id and sig_id are those of u-blox",
    Status.BAD_VALUE: "pseudoranges are in m, Doppler in Hz",
    Status.LOW_CN0: "ranges.cn0_mask leaves them out",
    Status.OTHER_BAND: "pseudoranges are used of the upper band only (L1, E1, B1, G1)",
}
"""What to do about signals that cannot be used, by the reason."""

BLAMED_SHARE = 0.5
"""Share of the signals that must be unusable for one reason before the reason is reported."""

RECENT = 60
"""Messages by which present faults are judged: a minute of a slow receiver."""

PLACE_INTERVAL = 10 * SECOND
"""ns; in each such period of the stamps the place for the Earth's magnetic field is updated during `PLACE_SHARE`."""

PLACE_SHARE = 3 * SECOND // 2
"""ns; time from the beginning of each period during which point solutions update the place."""

NORMAL = (Status.USABLE, Status.OTHER_SIGNAL)
"""Statuses that are no fault."""

FAULTS = {
    Fault.NON_FINITE: "a parameter of orbit or clock is missing or not finite",
    Fault.BAD_VALUE: "a parameter of orbit or clock is none that a satellite can have",
}
"""What is wrong with an ephemeris, in words."""


Key = TypeVar("Key")


def place_of(solution: PointSolution) -> tuple[float, float, float] | None:
    """Return latitude and longitude (deg) and altitude (m) of a point solution; None if it was not solved."""
    if solution.status != SolutionStatus.SOLVED:
        return None
    latitude, longitude, altitude = solution.geodetic
    return math.degrees(latitude), math.degrees(longitude), altitude


class RangeIntake:
    """Turns point clouds into epochs of signals and gives them to a navigator.

    Attributes:
        epochs: epochs that were read.
        solved: epochs of which a point solution was made.
        refused: messages and parts of them that could not be used, by reason.
        notes: what was left out of the files of ``ranges.rinex_nav_files``.
        wants_solution: make a point solution of every epoch, in mode tight, too.
        watch: called with the stamp (ns) and the signals (MEASURED_SIGNAL or RANGE) of each epoch, if given.
    """

    def __init__(self, navigator: Navigator, parameters: Parameters) -> None:
        """Prepare the intake; read the files of ``ranges.rinex_nav_files``. Raises RinexError if one cannot be read."""
        self._navigator = navigator
        self.configure(parameters)
        files = read_navigation_files([Path(name) for name in parameters.ranges.rinex_nav_files.split(":") if name])
        window = round(parameters.history.window * SECOND)
        self._ephemerides = DatedEphemerides(files.records, files.klobuchar.get(Gnss.GPS, NO_KLOBUCHAR), window)
        stand_in = files.klobuchar.get(Gnss.QZSS, DEFAULT_KLOBUCHAR)
        self._ionosphere_stand_in = DatedEphemerides(np.zeros(0, EPHEMERIS), stand_in, window)
        self._knows_ionosphere = bool(KLOBUCHAR_SOURCES & files.klobuchar.keys())
        self.notes = [
            f"{complaints.path}: {reason} ({count})"
            for complaints in files.complaints
            for reason, count in complaints.counts.items()
        ]
        faults = faults_of(files.records)
        self.notes += [f"ranges.rinex_nav_files: {fault} ({count})" for fault, count in faults.items()]
        self.epochs = 0
        self.solved = 0
        self.refused: Counter[str] = Counter()
        self._recently_refused: deque[Counter[str]] = deque(maxlen=RECENT)
        self._recent_statuses: deque[Counter[Status]] = deque(maxlen=RECENT)
        self.wants_solution = False
        self.watch: Callable[[int, NDArray[Any]], None] | None = None

    def configure(self, parameters: Parameters) -> None:
        """Use other masks and offsets from now on: those that can change while the node runs."""
        ranges = parameters.ranges
        self._solves = parameters.mode == "loose" and ranges.use_point_solution
        self._masks = Masks(HORIZON, ranges.cn0_mask)
        self._point_settings = PointSettings(
            elevation_mask=math.radians(ranges.elevation_mask_deg), cn0_mask=ranges.cn0_mask
        )
        self._time_offset = round(ranges.time_offset * SECOND)

    def take_ephemerides(self, stamp: int, points: NDArray[Any], arrival: int = 0) -> None:
        """Add the points of a message of `gnss/ephemerides`; `DatedEphemerides` decides which ranges they serve."""
        try:
            read = read_ephemerides(points)
        except CloudError as error:
            self._note_message({f"ephemerides: {error}": 1})
            return
        refused = read.refused + faults_of(read.records)
        self._note_message({f"ephemerides: {reason}": count for reason, count in refused.items()})
        if len(read.broadcasts):
            stamp += self._time_offset
            self._ephemerides.add(stamp, read.records, read.klobuchar.get(Gnss.GPS))
            if Gnss.QZSS in read.klobuchar:
                self._ionosphere_stand_in.add(stamp, np.zeros(0, EPHEMERIS), read.klobuchar[Gnss.QZSS])
            self._knows_ionosphere = self._knows_ionosphere or bool(KLOBUCHAR_SOURCES & read.klobuchar.keys())

    def take_ranges(self, stamp: int, points: NDArray[Any], arrival: int = 0) -> PointSolution | None:
        """Give the points of a message of `gnss/ranges` to the navigator; return the point solution if one was made.

        ``stamp`` and ``arrival`` in ns.
        """
        try:
            epoch = read_epoch(points)
        except CloudError as error:
            self._note_message({f"ranges: {error}": 1})
            return None
        if math.isnan(epoch.seconds):
            self._note_message({"ranges: no time tag in the epoch": 1})
            return None
        left_out = {"ranges: signals beyond the first 200 of an epoch": epoch.left_out}
        self._note_message(left_out if epoch.left_out else {})
        self.epochs += 1
        ephemerides, klobuchar = self._serving(stamp + self._time_offset, (epoch.week, epoch.seconds))
        if self._solves:
            solution = self._solution(epoch, ephemerides, klobuchar)
            if self.watch is not None:
                self.watch(stamp, epoch.ranges)
            statuses = status_counts(epoch.ranges)
            self._recent_statuses.append(statuses)
            self._navigator.range_statuses.update(statuses)
            self._push_solution(stamp, solution, arrival)
            return solution
        instant = (epoch.week, epoch.seconds)
        signals = measured_epoch(epoch.ranges, *instant, ephemerides, masks=self._masks)
        if self.watch is not None:
            self.watch(stamp, signals)
        self._recent_statuses.append(status_counts(signals))
        wants_place = self._navigator.needs_field and stamp % PLACE_INTERVAL < PLACE_SHARE
        if not (self.wants_solution or wants_place):
            self._navigator.push_ranges(stamp, instant, signals, klobuchar, arrival)
            return None
        solution = self._solution(epoch, ephemerides, klobuchar)
        place = place_of(solution) if wants_place else None
        self._navigator.push_ranges(stamp, instant, signals, klobuchar, arrival, place)
        return solution if self.wants_solution else None

    def _serving(self, stamp: int, instant: Instant) -> tuple[Ephemerides, NDArray[np.float64]]:
        """Return ephemerides and parameters of the ionosphere for an epoch with this stamp (ns) and GPS time."""
        ephemerides, klobuchar = self._ephemerides.at(stamp, instant)
        _, stand_in = self._ionosphere_stand_in.at(stamp)
        return ephemerides, stand_in if np.isnan(klobuchar).any() else klobuchar

    def _solution(self, epoch: Epoch, ephemerides: Ephemerides, klobuchar: NDArray[np.float64]) -> PointSolution:
        """Solve the epoch alone, as a receiver would, from no prior position: the order of epochs has no influence."""
        locate(epoch.ranges, epoch.week, epoch.seconds, ephemerides)
        ranges = one_per_satellite(epoch.ranges, self._masks.cn0)
        solution = solve(ranges, epoch.week, epoch.seconds, klobuchar, self._point_settings)
        if solution.status == SolutionStatus.SOLVED:
            self.solved += 1
        return solution

    def _push_solution(self, stamp: int, solution: PointSolution, arrival: int) -> None:
        """Give position and velocity of a point solution to the navigator."""
        place = place_of(solution)
        if place is not None:
            self._navigator.push_gnss_position(
                stamp,
                *place,
                solution.covariance_enu.ravel(),
                COVARIANCE_KNOWN,
                STATUS_FIX,
                arrival,
                from_ranges=True,
            )
        if solution.velocity_status == SolutionStatus.SOLVED:
            covariance = solution.velocity_covariance_enu.ravel()
            velocity = solution.velocity_enu.tolist()
            self._navigator.push_gnss_velocity(stamp, velocity, covariance, arrival, from_ranges=True)

    def _note_message(self, refused: Mapping[str, int]) -> None:
        """Count what could not be used of a message of either topic, by reason."""
        self.refused.update(refused)
        self._recently_refused.append(Counter(refused))

    @property
    def complaints(self) -> list[str]:
        """One sentence for each fault of the messages from the first to the last, with what to do."""
        refused = [f"{count} times: {reason}" for reason, count in self.refused.items()]
        return [*self.notes, *refused, *self._ionosphere_complaints(), *blamed(self._navigator.range_statuses)]

    @property
    def recent_complaints(self) -> list[str]:
        """One sentence for each present fault of the messages, judged by the last `RECENT` of them."""
        messages = len(self._recently_refused)
        refused = [
            f"{reason} ({count} in the last {messages} messages of ranges and ephemerides)"
            for reason, count in added(self._recently_refused).items()
        ]
        return [*refused, *self._ionosphere_complaints(), *blamed(added(self._recent_statuses), "the last ")]

    def _ionosphere_complaints(self) -> list[str]:
        if not self.epochs or self._knows_ionosphere:
            return []
        return ["no parameters of the ionosphere came with the ephemerides: those of a middling day stand in for them"]


def blamed(statuses: Mapping[Status, int], which: str = "") -> list[str]:
    """Return one sentence for each reason why most signals cannot be used, with what to do.

    ``which``: words before the number of signals.
    """
    total = sum(statuses.values()) - statuses.get(Status.OTHER_SIGNAL, 0)
    found = []
    for status, count in statuses.items():
        if status not in NORMAL and count > BLAMED_SHARE * total:
            remedy = f": {REMEDIES[status]}" if status in REMEDIES else ""
            found.append(f"{count} of {which}{total} signals cannot be used ({status.name.lower()}){remedy}")
    return found


def added(counts: Iterable[Counter[Key]]) -> Counter[Key]:
    """Return the sum of counters."""
    total: Counter[Key] = Counter()
    for one in counts:
        total.update(one)
    return total


def faults_of(records: NDArray[np.void]) -> Counter[str]:
    """Count the ephemerides (EPHEMERIS) that place no satellite, by what is wrong with them."""
    return Counter(FAULTS[Fault(fault)] for fault in check(records).tolist() if fault != Fault.NONE)


def compile_ranges(parameters: Parameters) -> None:
    """Compile all that a `RangeIntake` calls, or load it from the cache, by an epoch of five satellites."""
    parameters = replace(parameters, ranges=replace(parameters.ranges, rinex_nav_files=""))
    trial = RangeIntake(Navigator(parameters), parameters)
    trial.wants_solution = True
    antenna = np.array([6.378e6, 0.0, 0.0])
    ranges = allocate_ranges(5)
    ranges["sv_id"], ranges["signal"] = np.arange(1, 6), 0
    ranges["satellite"] = antenna + 2e7 * np.array([(1, 0, 0), (1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1)])
    ranges["pseudorange"] = np.linalg.norm(ranges["satellite"] - antenna, axis=1)
    for name in ("satellite_velocity", "satellite_clock", "satellite_clock_drift", "doppler"):
        ranges[name] = 0.0
    ranges["flags"] = CODE_VALID | DOPPLER_VALID | SATELLITE_KNOWN
    trial.take_ranges(1_000_000_000, write_epoch(ranges, 2200, 0.0, satellites=True))
