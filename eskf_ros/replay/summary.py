"""summary.json: the results of a replay in numbers that are not rounded.

Stamps are integer ns, lengths m, times s; an unknown value is null.

- `duration_s`: from the first to the newest IMU stamp, steps of the clock taken out; `imu_count`: samples offered;
  `imu`: counts of what became of them. `restarts`: restarts of the alignment; `position_resets`: how often fixes won
  over the filter.
- `aids.{name}`: `offered` measurements by their final verdict: `fused` (weighed_down and reset, too), `late`
  (outside_history), `rejected` (all other verdicts but waiting, which is for those newer than the last IMU sample); all
  of them in `verdicts`. `withheld` measurements were not offered (--outage, --mode ins-only); null for parts of epochs
  of ranges, which are counted as epochs in `ranges`. `nis_mean` and `nis_in_95` are over all measurements that were
  tested, the gated ones included.
- `..._in_95`, `in_95`: share of the values not above the 95 % quantile of chi-square (ideal 0.95; above it the filter
  is cautious).
- `quality`: share of the rows with a known position that are `usable` for navigation, and by `Quality`.
- `final`: the state at the newest IMU sample, `position` and `velocity` of base_link in map, `lla` deg deg m, `rpy_deg`
  about the local vertical, yaw 0 = east; biases in IMU axes.
- `error`: absolute errors at the truth epochs from the first known position on, heading from the first known heading
  on; of the antenna if the truth is a NavSatFix. `nees`: e' P^-1 e, 3 degrees of freedom, so its ideal mean is 3.
- `smoothed` (with --smooth): the same `error`, `nees` and errors in `outages[]` of the smoothed trajectory; `nodes`:
  stamps at which measurements changed the estimate; `breaks`: starts, resets and takeovers of the filter, over which
  nothing is smoothed.
- `ranges`: `epochs` read and epochs `withheld`, `signals` by `gnss.ranges.Status`, `clock_jumps_ms`: milliseconds by
  which the receiver clock jumped, `outvoted_states`: how often most satellites contradicted the state, whose variance
  was then inflated.
- `outages[]`: `distance` is the length of the estimated path; the errors are those at the last truth epoch within,
  and `horizontal_max` the largest within.
- `timing`: `write` is the work of a parallel thread, `wait` the part of it that was waited for.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.filter.integrity.traffic import late_remedy
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import IS_USABLE, STREAM_NAMES, Quality, Status, Stream, Verdict
from eskf_ros.geodesy.map_frame import MapFrame, east_north_up_to_ecef, to_geodetic
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.inputs.table import Input
from eskf_ros.parameters.tree import Parameters
from eskf_ros.replay.feed import Feed
from eskf_ros.replay.topics import TopicNames
from eskf_ros.replay.truth import rotation_matrices

CHI_SQUARE_95 = np.array([math.nan, 3.841458820694124, 5.991464547107979, 7.814727903251179])
"""95 % quantile of chi-square by degrees of freedom."""
MADE_OF_RANGES = (Stream.PSEUDORANGE, Stream.RANGE_RATE, Stream.GNSS_POSITION, Stream.GNSS_VELOCITY)
"""Streams of an epoch of ranges: its signals or, in mode loose, its point solution."""
OUTAGE_ERRORS = ("horizontal", "vertical", "heading_deg")


class Summary:
    """Collects rows and final records of one replay; `feed` counts what was withheld and offered.

    `outages` are (start, length) in s from the first IMU stamp.
    """

    def __init__(self, feed: Feed, outages: tuple[tuple[float, float], ...]) -> None:
        self._feed = feed
        self._outages = outages
        self._distances = [0.0] * len(outages)
        self._last_position = np.zeros((0, 3))
        self._rows = 0
        self._qualities = np.zeros(len(Quality), np.int64)
        self._verdicts = np.zeros((len(STREAM_NAMES), len(Verdict)), np.int64)
        self._nis_count = np.zeros(len(STREAM_NAMES), np.int64)
        self._nis_inside = np.zeros(len(STREAM_NAMES), np.int64)
        self._nis_sum = np.zeros(len(STREAM_NAMES))

    def add(self, rows: NDArray[Any], records: NDArray[Any]) -> None:
        """Take ODOMETRY rows (n,) with known positions and increasing stamps, and final RECORD rows (m,)."""
        self._rows += len(rows)
        self._qualities += np.bincount(rows["quality"], minlength=len(Quality))
        positions = np.concatenate([self._last_position, rows["position_map"]])
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        seconds = self._seconds(rows["stamp"][len(rows) - len(steps) :])
        self._last_position = positions[-1:]
        for number, (start, length) in enumerate(self._outages):
            self._distances[number] += float(steps[(seconds > start) & (seconds <= start + length)].sum())

        np.add.at(self._verdicts, (records["stream"], records["verdict"]), 1)
        tested = records[np.isfinite(records["nis"])]
        np.add.at(self._nis_count, tested["stream"], 1)
        np.add.at(self._nis_inside, tested["stream"], tested["nis"] <= CHI_SQUARE_95[tested["dof"]])
        np.add.at(self._nis_sum, tested["stream"], tested["nis"])

    def _seconds(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray((stamps - (self._feed.first_stamp or 0)) * 1e-9, np.float64)

    def result(self, navigator: Navigator, wall_s: float) -> dict[str, Any]:
        """Return the part of the summary that every replay has."""
        final = navigator.odometry[0]
        set_by = sum(step.size for step in navigator.clock_steps)
        duration = 0.0
        if self._feed.first_stamp is not None:
            duration = (int(final["stamp"]) - set_by - self._feed.first_stamp) * 1e-9
        return {
            "duration_s": duration,
            "imu_count": self._feed.imu_count,
            "imu": navigator.imu_counts,
            "restarts": navigator.restarts,
            "position_resets": navigator.position_resets,
            "takeovers": navigator.takeovers,
            "wall_s": wall_s,
            "realtime_factor": duration / wall_s,
            "datum": None if navigator.datum is None else list(navigator.datum),
            "aids": {STREAM_NAMES[stream]: self._aid(stream) for stream in self._aids()},
            "quality": self._quality(),
            "final": final_result(final, navigator.datum),
        }

    def _quality(self) -> dict[str, float]:
        """Return the share of the rows by quality, and of those that are usable."""
        shares = self._qualities / max(1, self._rows)
        found = {quality.name.lower(): float(shares[quality]) for quality in Quality if shares[quality] > 0.0}
        return {"usable": float(shares[list(IS_USABLE)].sum()), **found}

    def _aids(self) -> list[Stream]:
        """Return the streams of the inputs in the recording, and of the constraints that were ever active."""
        inputs = {kind.stream for kind in self._feed.withheld}
        return [stream for stream in Stream if stream in inputs or self._verdicts[stream].any()]

    def _withheld(self, stream: Stream) -> int | None:
        """Return how many measurements were withheld; None for epochs of ranges, whose signals are not counted."""
        inputs = [kind for kind in self._feed.withheld if stream in streams_of(kind)]
        if any(kind.name == "ranges" for kind in inputs):
            return None
        return sum(self._feed.withheld[kind] for kind in inputs)

    def _aid(self, stream: Stream) -> dict[str, Any]:
        verdicts, tested = self._verdicts[stream], int(self._nis_count[stream])
        return {
            **counted(verdicts),
            "withheld": self._withheld(stream),
            "nis_mean": float(self._nis_sum[stream] / tested) if tested else None,
            "nis_in_95": float(self._nis_inside[stream] / tested) if tested else None,
            "verdicts": named(verdicts),
        }

    def outages(self, compared: NDArray[Any] | None) -> list[dict[str, Any]]:
        """Return for each outage the length of the estimated path and, with truth, the errors at its last epoch."""
        errors = [{}] * len(self._outages) if compared is None else self.outage_errors(compared)
        return [
            {"start": start, "length": length, "distance": distance, **error}
            for (start, length), distance, error in zip(self._outages, self._distances, errors, strict=True)
        ]

    def outage_errors(self, compared: NDArray[Any]) -> list[dict[str, Any]]:
        """Return for each outage the errors at the last truth epoch within, and the largest horizontal one."""
        seconds = self._seconds(compared["stamp"])
        results = []
        for start, length in self._outages:
            inside = compared[(seconds >= start) & (seconds <= start + length)]
            last = inside[-1] if len(inside) else None
            result: dict[str, Any] = {name: None if last is None else _number(last[name]) for name in OUTAGE_ERRORS}
            result["horizontal_max"] = None if last is None else float(inside["horizontal"].max())
            result["compared_stamp"] = None if last is None else int(last["stamp"])
            results.append(result)
        return results

    def warnings(self, navigator: Navigator, topics: TopicNames, parameters: Parameters) -> list[str]:
        """Return the warnings for the user, one line each."""
        lines = navigator.complaints + navigator.notes
        if navigator.restarts:
            lines.append(
                f"the alignment started again {navigator.restarts} times: the IMU was silent for seconds, or fix after "
                "fix contradicted the filter (IMU noise parameters too small, wrong mounting, lever arm or time offset)"
            )
        late = {
            name: int(self._verdicts[list(streams_of(kind)), Verdict.OUTSIDE_HISTORY].sum())
            for kind, name in topics.inputs.items()
        }
        late[topics.imu] = navigator.imu_counts["late"]
        if any(late.values()):
            counts = ", ".join(f"{count} of {name}" for name, count in late.items() if count)
            window = parameters.history.window
            remedy = late_remedy(navigator.window_needed)
            lines.append(f"measurements too late for history.window = {window:g} s: {counts}; {remedy}")
        if not self._rows:
            verdicts = ", ".join(
                f"{count} {name}" for name, count in named(self._verdicts[Stream.GNSS_POSITION]).items()
            )
            fixes = topics.of(Stream.GNSS_POSITION)
            if fixes:
                lines.append(f"no position was found; what became of the fixes of {fixes}: {verdicts or 'none came'}")
            else:
                verdicts = ", ".join(f"{n} {name}" for name, n in named(self._verdicts[Stream.PSEUDORANGE]).items())
                lines.append(f"no position was found; what became of the pseudoranges: {verdicts or 'none came'}")
        return lines


def truth_result(topic: str, offered: int, compared: NDArray[Any]) -> dict[str, Any]:
    """Return `truth`, `error` and `nees` of COMPARED rows (n,) out of `offered` truth epochs."""
    return {
        "truth": {
            "topic": topic,
            "epochs": offered,
            "compared": len(compared),
            "heading_compared": int(np.isfinite(compared["heading_deg"]).sum()),
        },
        **accuracy(compared),
    }


def accuracy(compared: NDArray[Any]) -> dict[str, Any]:
    """Return `error` and `nees` of COMPARED rows (n,)."""
    nees = {"position": compared["nees_position"], "attitude": compared["nees_attitude"]}
    return {
        "error": {name: _error(compared[name]) for name in ("horizontal", "vertical", "speed", "heading_deg")},
        "nees": {name: _consistency(values) for name, values in nees.items()},
    }


def streams_of(kind: Input) -> tuple[Stream, ...]:
    """Return the streams of the records that an input leads to; none for ephemerides."""
    if not kind.is_timed:
        return ()
    return MADE_OF_RANGES if kind.name == "ranges" else (kind.stream,)


def ranges_result(navigator: Navigator, intake: RangeIntake, feed: Feed) -> dict[str, Any]:
    """Return `ranges`: counts of epochs and signals before the filter, and faults of the receiver clock in it."""
    state = navigator.state[0]
    return {
        "ranges": {
            "epochs": intake.epochs,
            "withheld": sum(count for kind, count in feed.withheld.items() if kind.name == "ranges"),
            "point_solutions": intake.solved,
            "signals": {status.name.lower(): count for status, count in sorted(navigator.range_statuses.items())},
            "clock_jumps_ms": int(state["tight"]["clock_jumps"]),
            "outvoted_states": int(state["tight"]["range_faults"]),
        }
    }


def _error(values: NDArray[np.float64]) -> dict[str, float] | None:
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    half, most = np.percentile(values, [50.0, 95.0])
    rms = math.sqrt(float(np.mean(values**2)))
    return {"rms": rms, "p50": float(half), "p95": float(most), "max": float(values.max())}


def _consistency(values: NDArray[np.float64]) -> dict[str, float] | None:
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    return {"mean": float(values.mean()), "in_95": float(np.mean(values <= CHI_SQUARE_95[3]))}


FUSING = (Verdict.FUSED, Verdict.WEIGHED_DOWN, Verdict.TAKEOVER, Verdict.RESET)
"""Verdicts of measurements from which the estimate has learned."""


def counted(verdicts: NDArray[np.int64]) -> dict[str, int]:
    """Return the numbers of offered, fused, rejected and late measurements from counts by `Verdict`.

    `fused` are those of the verdicts `FUSING`; `rejected` all others but waiting, and outside_history, which is `late`.
    """
    offered, waiting = int(verdicts.sum()), int(verdicts[Verdict.WAITING])
    fused = int(sum(verdicts[verdict] for verdict in FUSING))
    late = int(verdicts[Verdict.OUTSIDE_HISTORY])
    return {"offered": offered, "fused": fused, "rejected": offered - fused - late - waiting, "late": late}


def named(verdicts: NDArray[np.int64]) -> dict[str, int]:
    """Return the counts by `Verdict` that are not zero, by name."""
    return {verdict.name.lower(): int(verdicts[verdict]) for verdict in Verdict if verdicts[verdict]}


def final_result(row: NDArray[Any], datum: tuple[float, float, float] | None) -> dict[str, Any]:
    """Return the values of the last ODOMETRY row, None if unknown; roll, pitch, yaw are about the local vertical."""
    known = bool(row["position_known"]) and datum is not None
    result: dict[str, Any] = {
        "stamp": int(row["stamp"]),
        "status": Status(int(row["status"])).name,
        "usable": int(row["quality"]) in IS_USABLE,
        "lla": None,
        "position": None,
        "velocity": None,
        "rpy_deg": None,
        "accel_bias": _numbers(row["accel_bias"]),
        "gyro_bias": _numbers(row["gyro_bias"]),
    }
    if known and datum is not None:
        map_frame = MapFrame(datum)
        geodetic = to_geodetic(map_frame.to_ecef(row["position_map"].reshape(1, 3)))
        rotation = east_north_up_to_ecef(geodetic)[0].T @ map_frame.rotation_map_to_ecef
        rotation = rotation @ rotation_matrices(row["attitude_body_to_map"].reshape(1, 4))[0]
        roll_pitch_yaw = (
            math.atan2(rotation[2, 1], rotation[2, 2]),
            math.asin(max(-1.0, min(1.0, -rotation[2, 0]))),
            math.atan2(rotation[1, 0], rotation[0, 0]),
        )
        latitude, longitude, altitude = geodetic[0].tolist()
        result |= {
            "lla": [math.degrees(latitude), math.degrees(longitude), altitude],
            "position": _numbers(row["position_map"]),
            "velocity": _numbers(row["velocity_map"]),
            "rpy_deg": [math.degrees(angle) for angle in roll_pitch_yaw],
        }
    return result


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _numbers(values: NDArray[np.float64]) -> list[float]:
    return [float(value) for value in values]
