"""Messages as they come: unfilled, repeated, stamped alike, too rare. What is not used is refused with a reason."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Quality, Status, Stream, Verdict
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate
from eskf_ros.tables.feeding import push_row
from monte_carlo import NO_SIDE_SLIP, feed, messages_of, state_error

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def drive() -> Recording:
    return simulate("drive", seed=5, imu_rate=50.0, gnss_rate=5.0, stop=150.0)


def run(recording: Recording, **changes: Any) -> tuple[Navigator, NDArray[np.float64], NDArray[Any]]:
    """Run a recording; return the navigator, (seconds, horizontal error, NEES of the position) twice a second, records.

    Changes are parameters, as ``group__name``.
    """
    given = {name.replace("__", "."): value for name, value in changes.items()}
    navigator = Navigator(from_mapping({**recording.parameters(), **NO_SIDE_SLIP, **given}))
    stops = np.arange(25, len(recording.imu_stamp), 25) - 1
    rows, records = [], []
    for i, state in feed(recording, navigator, stops):
        truth = int(np.searchsorted(recording.truth_stamp, recording.imu_stamp[i]))
        error = state_error(recording, i, truth, state)
        nees = error[:3] @ np.linalg.solve(state["covariance"][:3, :3] + 1e-12 * np.eye(3), error[:3])
        seconds = (recording.imu_stamp[i] - recording.imu_stamp[0]) * 1e-9
        rows.append((seconds, np.hypot(error[0], error[1]), nees, navigator.quality))
        records.append(navigator.take_records())
    records.append(navigator.finish())
    return navigator, np.array(rows), np.concatenate(records)


def seconds_of(recording: Recording) -> NDArray[np.float64]:
    return np.asarray((recording.fix_stamp - recording.imu_stamp[0]) * 1e-9)


def with_fixes(recording: Recording, source: NDArray[np.intp], with_velocity: bool) -> Recording:
    """The recording with fix i replaced by the coordinates of fix ``source[i]``."""
    names = ["fix_latitude_deg", "fix_longitude_deg", "fix_altitude"]
    changes = {name: getattr(recording, name)[source] for name in names}
    if with_velocity:
        changes["velocity_enu"] = recording.velocity_enu[source]
    else:
        changes["velocity_stamp"] = recording.velocity_stamp[:0]
    return dataclasses.replace(recording, **changes)


def verdicts(records: NDArray[Any], stream: Stream) -> dict[Verdict, int]:
    chosen = records["verdict"][records["stream"] == stream]
    return {Verdict(value): int(count) for value, count in zip(*np.unique(chosen, return_counts=True))}


def test_a_clean_drive_repeats_nothing(drive: Recording) -> None:
    navigator, _, records = run(drive)
    assert Verdict.REPEATED not in verdicts(records, Stream.GNSS_POSITION)
    assert navigator.complaints == []
    assert navigator.notes == []


@pytest.mark.parametrize("seconds", [5.0, 15.0])
def test_fixes_that_nobody_filled_in_are_not_used(drive: Recording, seconds: float) -> None:
    unfilled = seconds_of(drive) < seconds
    changes = {
        name: np.where(unfilled, 0.0, getattr(drive, name))
        for name in ("fix_latitude_deg", "fix_longitude_deg", "fix_altitude")
    }
    navigator, _, records = run(dataclasses.replace(drive, **changes), datum=[])
    assert verdicts(records, Stream.GNSS_POSITION)[Verdict.UNFILLED] == np.count_nonzero(unfilled)
    assert navigator.status == Status.GOOD
    assert navigator.datum is not None
    assert navigator.datum[0] == pytest.approx(drive.datum[0], abs=0.1)
    assert any("were refused as unfilled" in note for note in navigator.notes)


@pytest.mark.parametrize("with_velocity", [False, True])
def test_a_frozen_receiver_moves_nothing(drive: Recording, with_velocity: bool) -> None:
    """The coordinates stay the same to the last bit for 30 s, with fresh stamps, while the car drives."""
    seconds = seconds_of(drive)
    during = (seconds >= 60.0) & (seconds < 90.0)
    source = np.arange(len(seconds))
    source[during] = np.flatnonzero(during)[0] - 1
    frozen = with_fixes(drive, source, with_velocity)
    navigator, rows, records = run(frozen)
    silent = dataclasses.replace(drive)
    kept = ~during
    names = [name for name in vars(drive) if name.startswith("fix_")]
    changes = {name: getattr(drive, name)[kept] for name in names}
    if with_velocity:
        changes |= {name: getattr(drive, name)[kept] for name in vars(drive) if name.startswith("velocity_")}
    else:
        changes["velocity_stamp"] = drive.velocity_stamp[:0]
    _, silent_rows, _ = run(dataclasses.replace(silent, **changes))
    positions = records[records["stream"] == Stream.GNSS_POSITION]
    frozen_ones = np.isin(positions["stamp"], drive.fix_stamp[during])
    assert (positions["verdict"][frozen_ones] == Verdict.REPEATED).all()
    # It is an outage, no more: as good as the same drive without these fixes.
    assert rows[:, 1].max() < 1.2 * silent_rows[:, 1].max() + 0.1
    assert any("repeated its coordinates bit for bit for 3" in text for text in navigator.complaints)
    at_the_end = (rows[:, 0] > 85.0) & (rows[:, 0] < 90.0)
    assert (rows[at_the_end, 3] == Quality.COASTED_TOO_LONG).all()
    assert (rows[rows[:, 0] > 100.0, 3] == Quality.GOOD).all()


def test_a_fix_a_second_sent_five_times_is_worth_one(drive: Recording) -> None:
    source = np.arange(len(drive.fix_stamp)) // 5 * 5
    navigator, rows, _ = run(with_fixes(drive, source, False))
    once = dataclasses.replace(
        drive,
        **{name: getattr(drive, name)[::5] for name in vars(drive) if name.startswith("fix_")},
        velocity_stamp=drive.velocity_stamp[:0],
    )
    _, once_rows, _ = run(once)
    late = rows[:, 0] > 60.0
    assert rows[late, 2].mean() < 1.1 * once_rows[late, 2].mean() + 0.1
    assert any("sends each fix of the receiver several times" in text for text in navigator.complaints)
    assert (rows[late, 3] == Quality.GOOD).all()


def test_repeats_are_judged_in_the_order_of_stamps(drive: Recording) -> None:
    """The order of arrival leaves no trace."""
    source = np.arange(len(drive.fix_stamp)) // 5 * 5
    repeated = with_fixes(drive, source, True)
    states = []
    for order in (lambda aids: aids, lambda aids: aids[::-1]):
        navigator = Navigator(from_mapping(drive.parameters()))
        aids = messages_of(repeated)
        for begin in range(0, 3000, 50):
            part = slice(begin, begin + 50)
            limit = drive.imu_stamp[min(begin + 49, len(drive.imu_stamp) - 1)]
            navigator.push_imu(drive.imu_stamp[part], drive.specific_force[part], drive.angular_rate[part])
            now = [aid for aid in aids if drive.imu_stamp[begin] <= aid[2] <= limit]
            for arrival, name, stamp, row in order(now):
                push_row(navigator, name, stamp, row, arrival)
        navigator.update()
        states.append(navigator.state)
    assert states[0]["repeats"].tobytes() == states[1]["repeats"].tobytes()
    assert states[0]["covariance"].tobytes() == states[1]["covariance"].tobytes()


def test_quantised_coordinates_of_a_parked_robot_cost_nothing() -> None:
    """Coordinates of a receiver with a centimetre's noise, rounded to 1e-7 deg and 1 cm, repeat by chance."""
    still = simulate("drive", seed=5, imu_rate=50.0, gnss_rate=5.0, stop=9.0)
    stamps = still.imu_stamp[0] + 20_000_000 * np.arange(3000)
    rng = np.random.default_rng(1)
    results = {}
    for is_rounded in (False, True):
        navigator = Navigator(from_mapping({**still.parameters(), "datum": [48.0, 11.0, 500.0]}))
        rng = np.random.default_rng(1)
        for begin in range(0, 3000, 10):
            part = slice(begin, begin + 10)
            force = np.tile([0.0, 0.0, 9.8087], (10, 1)) + 0.01 * rng.normal(size=(10, 3))
            navigator.push_imu(stamps[part], force, 3e-4 * rng.normal(size=(10, 3)))
            north, east, up = 0.01 * rng.normal(size=3)
            place = 48.0 + north / 111e3, 11.0 + east / 74e3, 500.0 + up
            if is_rounded:
                place = round(place[0], 7), round(place[1], 7), round(place[2], 2)
            navigator.push_gnss_position(int(stamps[begin + 9]), *place, np.diag([1e-4, 1e-4, 4e-4]).ravel(), 2, 0)
        records = navigator.finish()
        results[is_rounded] = navigator, np.count_nonzero(records["verdict"] == Verdict.REPEATED)
    assert results[False][1] == 0
    assert results[True][1] > 2
    rounded, exact = results[True][0], results[False][0]
    assert rounded.complaints == exact.complaints == []
    assert rounded.status == exact.status
    ratio = np.trace(rounded.state[0]["covariance"][:3, :3]) / np.trace(exact.state[0]["covariance"][:3, :3])
    assert ratio < 1.1


def test_stamps_cut_to_whole_seconds_are_named(drive: Recording) -> None:
    cut = dataclasses.replace(
        drive, fix_stamp=drive.fix_stamp // SECOND * SECOND, velocity_stamp=drive.velocity_stamp[:0]
    )
    navigator, _, records = run(cut)
    dropped = verdicts(records, Stream.GNSS_POSITION)[Verdict.DUPLICATE]
    assert dropped == pytest.approx(0.8 * len(drive.fix_stamp), rel=0.01)
    said = f"{dropped} of {sum(verdicts(records, Stream.GNSS_POSITION).values())} messages of gnss_position"
    assert [c for c in navigator.complaints if said in c]
    assert any("cut to whole seconds" in c for c in navigator.complaints)


def test_imu_pairs_with_one_stamp_are_named(drive: Recording) -> None:
    paired = dataclasses.replace(drive, imu_stamp=drive.imu_stamp[np.arange(len(drive.imu_stamp)) // 2 * 2])
    navigator = Navigator(from_mapping(drive.parameters()))
    navigator.push_imu(paired.imu_stamp, paired.specific_force, paired.angular_rate)
    half = len(drive.imu_stamp) // 2
    assert any(f"{half} of {2 * half} IMU samples have the stamp of another one" in c for c in navigator.complaints)


@pytest.mark.parametrize(
    ("ahead", "said"), [(4294.967296, "2^32 microseconds"), (4294967.296, "2^32 milliseconds"), (50.0, "time_offset")]
)
def test_the_offset_that_is_advised_is_accepted_and_helps(drive: Recording, ahead: float, said: str) -> None:
    moved = dataclasses.replace(
        drive, fix_stamp=drive.fix_stamp + round(ahead * SECOND), velocity_stamp=drive.velocity_stamp[:0]
    )
    navigator, _, _ = run(moved)
    advice = next(c for c in navigator.complaints if "ahead of the IMU's" in c)
    assert said in advice
    offset = -ahead
    if "to -" in advice:
        offset = float(advice.rsplit(" to ", 1)[1])
    followed, rows, _ = run(moved, gnss__time_offset=offset)
    assert followed.status == Status.GOOD
    assert rows[rows[:, 0] > 60.0, 1].max() < 3.0


def slow(recording: Recording, rate: float, jitter: float) -> Recording:
    """The IMU at a low rate: one sample in many, stamped with a jitter (s)."""
    step = round(50.0 / rate)
    stamps = recording.imu_stamp[::step].copy()
    stamps += np.round(1e9 * jitter * np.random.default_rng(0).uniform(-1.0, 1.0, len(stamps))).astype(np.int64)
    return dataclasses.replace(
        recording,
        imu_stamp=stamps,
        imu_arrival=recording.imu_arrival[::step],
        specific_force=recording.specific_force[::step],
        angular_rate=recording.angular_rate[::step],
    )


@pytest.mark.parametrize(("rate", "jitter"), [(1.0, 0.0), (2.0, 0.05), (5.0, 0.0), (10.0, 0.02)])
def test_an_imu_too_slow_for_the_gap_is_named_with_the_value_that_works(
    drive: Recording, rate: float, jitter: float
) -> None:
    recording = slow(drive, rate, jitter)

    def level(**changes: Any) -> Navigator:
        navigator = Navigator(from_mapping({**drive.parameters(), **changes}))
        navigator.push_imu(recording.imu_stamp, recording.specific_force, recording.angular_rate)
        return navigator

    navigator = level()
    advice = next(c for c in navigator.complaints if "imu.gap" in c)
    wanted = float(advice.split("set imu.gap to ")[1].split(",")[0])
    followed = level(**{"imu.gap": wanted})
    assert followed.status > Status.LEVELLING
    assert not [c for c in followed.complaints if "imu.gap" in c]


def test_an_interrupted_imu_is_not_called_slow(drive: Recording) -> None:
    kept = (np.arange(len(drive.imu_stamp)) // 50) % 5 != 0
    navigator = Navigator(from_mapping(drive.parameters()))
    navigator.push_imu(drive.imu_stamp[kept], drive.specific_force[kept], drive.angular_rate[kept])
    assert not [c for c in navigator.complaints if "imu.gap" in c]


def test_axes_that_are_not_measured_are_said(drive: Recording) -> None:
    navigator = Navigator(from_mapping(drive.parameters()))
    for stamp in drive.imu_stamp[:20].tolist():
        navigator.push(Stream.BODY_VELOCITY, stamp, (1.0, 0.0, 0.0), np.diag([0.01, 0.01, -1.0]).ravel())
    assert [note for note in navigator.notes if "20 of 20 messages of body_velocity do not measure z" in note]


def test_one_altitude_in_four_missing_costs_the_altitude_only(drive: Recording) -> None:
    """A fix without altitude is used horizontally, with the altitude that the others tell."""
    altitude = drive.fix_altitude.copy()
    altitude[::4] = np.nan
    navigator, rows, records = run(dataclasses.replace(drive, fix_altitude=altitude))
    _, clean_rows, clean_records = run(drive)
    counts, clean = verdicts(records, Stream.GNSS_POSITION), verdicts(clean_records, Stream.GNSS_POSITION)
    assert counts[Verdict.FUSED] >= clean[Verdict.FUSED] - 2
    late = rows[:, 0] > 60.0
    assert rows[late, 1].max() < 1.3 * clean_rows[late, 1].max() + 0.1
    assert navigator.status == Status.GOOD


def test_quality_says_no_until_aligned_and_while_coasting_too_long(drive: Recording) -> None:
    seconds = seconds_of(drive)
    kept = (seconds < 80.0) | (seconds > 120.0)
    names = [name for name in vars(drive) if name.startswith(("fix_", "velocity_"))]
    gapped = dataclasses.replace(drive, **{name: getattr(drive, name)[kept] for name in names})
    _, rows, _ = run(gapped, quality__coast_time=15.0)

    def of(begin: float, end: float) -> set[Quality]:
        return {Quality(int(value)) for value in rows[(rows[:, 0] > begin) & (rows[:, 0] < end), 3]}

    assert of(0.0, 5.0) == {Quality.NOT_ALIGNED}
    assert of(60.0, 79.0) == {Quality.GOOD}
    assert of(82.0, 93.0) == {Quality.COASTING}
    assert of(97.0, 119.0) == {Quality.COASTED_TOO_LONG}
