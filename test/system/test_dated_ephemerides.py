"""Which ephemerides an epoch of ranges may use does not depend on the order in which they and the epochs arrive."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.gnss.cloud import write_epoch
from eskf_ros.gnss.dated_ephemerides import LARGEST_LEAD, DatedEphemerides
from eskf_ros.gnss.ephemeris import EPHEMERIS, Broadcast
from eskf_ros.gnss.ephemeris_cloud import write_ephemerides
from eskf_ros.gnss.ranges import CODE_VALID, Status, allocate_ranges, locate
from eskf_ros.gnss.time import normalized
from eskf_ros.inputs.epochs import RangeIntake
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.range_receiver import RangeMeasurements, RangeReceiver
from eskf_ros.simulate.scenario import Recording, simulate
from support.gnss_sky import KLOBUCHAR, all_constellations
from support.gnss_sky import SECONDS as GPS_SECONDS
from support.gnss_sky import WEEK as GPS_WEEK

SECOND = 1_000_000_000
WINDOW = 2 * SECOND
START = 1_000 * SECOND
RECORDS = all_constellations().records
NONE = np.zeros(0, EPHEMERIS)


def ionosphere(number: int) -> NDArray[np.float64]:
    return np.full(8, float(number))


timed = st.tuples(st.integers(0, 12 * SECOND), st.integers(0, WINDOW))
"""Seconds from the start, and how long a message is on its way."""


@given(messages=st.lists(timed, max_size=8), epochs=st.lists(timed, min_size=1, max_size=12))
def test_an_epoch_finds_what_came_a_window_before_it(
    messages: list[tuple[int, int]], epochs: list[tuple[int, int]]
) -> None:
    """Message k brings the k-th satellite: so each epoch tells which messages it found."""
    kept = DatedEphemerides(RECORDS[:1], KLOBUCHAR, WINDOW)
    events = [(stamp + way, 0, stamp, k + 1) for k, (stamp, way) in enumerate(messages)]
    events += [(stamp + way, 1, stamp, 0) for stamp, way in epochs]
    for _, is_epoch, stamp, number in sorted(events):
        if not is_epoch:
            kept.add(START + stamp, RECORDS[number : number + 1], ionosphere(number))
            continue
        found, klobuchar = kept.at(START + stamp)
        old = [(sent, k + 1) for k, (sent, _) in enumerate(messages) if sent <= stamp - WINDOW]
        assert found.records.tobytes() == RECORDS[sorted([0, *(number for _, number in old)])].tobytes()
        if old:
            last = max(sent for sent, _ in old)
            assert klobuchar[0] in {number for sent, number in old if sent == last}
        else:
            assert klobuchar.tolist() == KLOBUCHAR.tolist()


def test_what_is_settled_stays_and_is_not_kept_twice() -> None:
    kept = DatedEphemerides(NONE, KLOBUCHAR, WINDOW)
    for k in range(50):
        kept.add(START + k * SECOND, RECORDS[k : k + 1], None)
        found, klobuchar = kept.at(START + k * SECOND)
        assert len(found) == max(0, k - 1)
        assert klobuchar.tolist() == KLOBUCHAR.tolist()
        assert len(kept._messages) <= 5


def test_what_is_sent_again_is_not_kept() -> None:
    kept = DatedEphemerides(RECORDS[:1], KLOBUCHAR, WINDOW)
    for k in range(11):
        kept.add(START + k * SECOND, RECORDS[:3], None)
        found, _ = kept.at(START + k * SECOND)
    assert len(found) == 3
    assert len(kept._messages) == 0
    # Parameters of the ionosphere are in force again when they are sent again.
    for k, number in enumerate((1, 2, 1)):
        kept.add(START + (20 + k) * SECOND, RECORDS[:3], ionosphere(number))
    assert kept.at(START + 40 * SECOND)[1][0] == 1.0


def issue(number: int, half: int) -> np.void:
    """The ephemeris of a satellite for the given half hour of the day."""
    record = RECORDS[number].copy()
    for name in ("toe", "toc", "toe_own"):
        record[name] += 1800.0 * half
    record["issue"] = half
    return record


@settings(max_examples=30)
@given(st.integers(0, 2**32))
def test_what_has_ended_is_forgotten_unnoticed(seed: int) -> None:
    """Each epoch of a day locates its signals as without forgetting, late by anything within the window."""
    rng = np.random.default_rng(seed)
    forgetful, faithful = (DatedEphemerides(RECORDS[:2], KLOBUCHAR, WINDOW) for _ in range(2))
    ranges = allocate_ranges(4)
    ranges["sv_id"], ranges["signal"] = RECORDS["sv_id"][:4], 0
    ranges["pseudorange"], ranges["flags"] = 2.2e7, CODE_VALID
    events = []
    for half in range(48):
        stamp = START + 1800 * half * SECOND
        # The third satellite sends no more after a while, the fourth does all day.
        if half < 12:
            events.append((stamp + int(rng.integers(WINDOW)), stamp, issue(2, half), 0.0))
        events.append((stamp + int(rng.integers(WINDOW)), stamp, issue(3, half), 0.0))
        for _ in range(3):
            later = int(rng.integers(1800))
            stamp = START + (1800 * half + later) * SECOND
            events.append((stamp + int(rng.integers(WINDOW)), stamp, None, 1800.0 * half + later))
    for _, stamp, record, since in sorted(events, key=lambda event: event[0]):
        if record is not None:
            for kept in (forgetful, faithful):
                kept.add(stamp, np.array([record], EPHEMERIS), None)
            continue
        instant = normalized(GPS_WEEK, GPS_SECONDS + since)
        epochs = [ranges.copy(), ranges.copy()]
        for epoch, ephemerides in zip(epochs, (forgetful.at(stamp, instant)[0], faithful.at(stamp)[0])):
            locate(epoch, *instant, ephemerides)
        assert epochs[0].tobytes() == epochs[1].tobytes()
        assert len(forgetful.at(stamp, instant)[0]) < 20
    assert len(faithful.at(stamp)[0]) > 55


def test_one_wrong_time_tag_forgets_nothing() -> None:
    kept = DatedEphemerides(NONE, KLOBUCHAR, WINDOW)
    kept.add(0, np.array([issue(0, 0), issue(0, 1)], EPHEMERIS), None)
    for k, week in enumerate((GPS_WEEK, GPS_WEEK, GPS_WEEK + 1024, GPS_WEEK, 0, GPS_WEEK)):
        assert len(kept.at(START + k * SECOND, (week, GPS_SECONDS + k))[0]) == 2
    # Two in a row do, but for the last of each satellite.
    for k in (6, 7):
        kept.at(START + k * SECOND, (GPS_WEEK + 1024, GPS_SECONDS + k))
    assert len(kept.at(START + 8 * SECOND, (GPS_WEEK, GPS_SECONDS + 8))[0]) == 1


@pytest.mark.parametrize("stamp", [0, START + LARGEST_LEAD + 1, 3 * START])
def test_without_a_credible_stamp_it_serves_at_once(stamp: int) -> None:
    kept = DatedEphemerides(NONE, KLOBUCHAR, WINDOW)
    kept.add(stamp, RECORDS[:1], None)
    assert len(kept.at(START)[0]) == 1


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate("drive", 6, start=12.0, stop=24.0, imu_rate=50.0, ranges=RangeReceiver())


@pytest.mark.parametrize("mode", ["tight", "loose"])
def test_the_final_state_is_the_same_for_any_arrival(recording: Recording, mode: str) -> None:
    """Ephemerides come while the robot drives, epochs and they are late by anything within the window."""
    measured = recording.ranges
    assert measured is not None
    parts = [list(measured.broadcasts[k::6]) for k in range(6)]
    begin = int(recording.imu_stamp[0])
    messages = [(begin + k * SECOND, part) for k, part in enumerate(parts)]
    finals = [final_state(recording, measured, messages, mode, seed) for seed in (None, 1, 2)]
    assert finals[0][2][Status.USABLE] > 200
    assert finals[0][2][Status.NO_EPHEMERIS] > 50
    for state, records, statuses in finals[1:]:
        assert state == finals[0][0]
        assert records == finals[0][1]
        assert statuses == finals[0][2]


def final_state(
    recording: Recording,
    measured: RangeMeasurements,
    messages: list[tuple[int, list[Broadcast]]],
    mode: str,
    seed: int | None,
) -> tuple[bytes, bytes, dict[Status, int]]:
    """State and records of a drive whose messages are late by what the seed draws, None: not at all."""
    navigator = Navigator(from_mapping({**recording.parameters(), "mode": mode, "ranges.use_point_solution": True}))
    intake = RangeIntake(navigator, navigator.parameters)
    rng = np.random.default_rng(seed)

    def late() -> int:
        return 0 if seed is None else int(rng.integers(0, WINDOW))

    offers = [(stamp + late(), 0, k) for k, (stamp, _) in enumerate(messages)]
    offers += [(int(stamp) + late(), 1, k) for k, stamp in enumerate(measured.stamp)]
    done = 0
    for time, is_epoch, k in sorted(offers):
        upto = int(np.searchsorted(recording.imu_stamp, time, "right"))
        part = slice(done, upto)
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        done = upto
        if is_epoch:
            week, seconds = int(measured.week[k]), float(measured.seconds[k])
            intake.take_ranges(int(measured.stamp[k]), write_epoch(measured.epoch(k), week, seconds, False))
        else:
            intake.take_ephemerides(messages[k][0], write_ephemerides(messages[k][1], measured.klobuchar))
    rest = slice(done, None)
    navigator.push_imu(recording.imu_stamp[rest], recording.specific_force[rest], recording.angular_rate[rest])
    records = navigator.finish()
    state = navigator.state[0]
    held = [state[name].tobytes() for name in ("position_map", "velocity_map", "attitude", "optional", "covariance")]
    order = np.lexsort([records["source"], records["stream"], records["stamp"]])
    told = [records[name][order].tobytes() for name in ("stamp", "stream", "source", "verdict", "nis")]
    return b"".join(held), b"".join(told), dict(navigator.range_statuses)
