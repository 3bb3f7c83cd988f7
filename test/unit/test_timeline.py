"""The timeline: any order of arrival within the window gives the same bits as sorted arrival."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Status, Verdict
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import Recording, simulate

SECOND = 1_000_000_000
WINDOW = 2.0
IMU, POSITION, VELOCITY = range(3)


@dataclass(frozen=True)
class Message:
    """One message: stream, row in the recording, change of its payload (a conflicting double), arrival (ns)."""

    stream: int
    row: int
    change: float
    arrival: int


@pytest.fixture(scope="module")
def recording() -> Recording:
    """The pull-away of the drive: levelling, datum, course alignment and turns all lie inside."""
    return simulate("drive", seed=3, imu_rate=50.0, gnss_rate=4.0, start=12.0, stop=40.0)


def navigator_for(recording: Recording, **extra: object) -> Navigator:
    mapping = {**recording.parameters(), "datum": [], "history.window": WINDOW, **extra}
    return Navigator(from_mapping(mapping))


def stamps_of(recording: Recording, stream: int) -> np.ndarray:
    return (recording.imu_stamp, recording.fix_stamp, recording.velocity_stamp)[stream]


def push(navigator: Navigator, recording: Recording, message: Message) -> None:
    row, change = message.row, message.change
    if message.stream == IMU:
        navigator.push_imu(
            recording.imu_stamp[row : row + 1],
            recording.specific_force[row : row + 1] + change,
            recording.angular_rate[row : row + 1],
        )
    elif message.stream == POSITION:
        navigator.push_gnss_position(
            int(recording.fix_stamp[row]),
            float(recording.fix_latitude_deg[row]),
            float(recording.fix_longitude_deg[row]),
            float(recording.fix_altitude[row]) + change,
            recording.fix_covariance[row],
            2,
            0,
            message.arrival,
        )
    else:
        velocity = recording.velocity_enu[row] + change
        navigator.push_gnss_velocity(
            int(recording.velocity_stamp[row]), velocity, recording.velocity_covariance[row], message.arrival
        )


def result(recording: Recording, messages: list[Message]) -> tuple[dict[str, bytes], bytes, np.ndarray]:
    """Give the messages in the order of the list; return the final state, the records without arrival, the records."""
    navigator = navigator_for(recording)
    records = []
    for count, message in enumerate(messages):
        push(navigator, recording, message)
        if count % 100 == 0:
            records.append(navigator.take_records())
    records.append(navigator.finish())
    together = np.concatenate(records)
    without_arrival = together.copy()
    without_arrival["arrival"] = 0
    return estimate(navigator), without_arrival.tobytes(), together


def estimate(navigator: Navigator) -> dict[str, bytes]:
    """The state; places in the buffers depend on when old contents were dropped, everything else is the estimate."""
    state = navigator.state[0]
    return {name: state[name].tobytes() for name in state.dtype.names if name not in ("imu_next", "aid_next")}


def every_message(recording: Recording, random: np.random.Generator, doubled: float) -> list[Message]:
    """All messages, some of them twice: the same again, or with another payload."""
    messages = []
    for stream in (IMU, POSITION, VELOCITY):
        for row in range(len(stamps_of(recording, stream))):
            messages.append(Message(stream, row, 0.0, 0))
            if random.random() < doubled:
                messages.append(Message(stream, row, float(random.choice([0.0, -0.5, 0.5])), 0))
    return messages


def arriving(
    recording: Recording, messages: list[Message], random: np.random.Generator, delays: tuple[float, float, float]
) -> list[Message]:
    """The messages in an order in which none is later than the window: each delayed by up to its stream's delay."""
    timed = []
    for message in messages:
        delay = int(random.uniform(0.0, delays[message.stream]) * SECOND)
        stamp = int(stamps_of(recording, message.stream)[message.row])
        timed.append(Message(message.stream, message.row, message.change, stamp + delay))
    return sorted(timed, key=lambda message: message.arrival)


@settings(max_examples=25)
# A run of late samples that looks like a clock that was set back, while a fix comes at the end of the window.
@example(seed=375089, doubled=1.0, imu_delay=WINDOW, position_delay=WINDOW, velocity_delay=0.0)
@given(
    seed=st.integers(0, 2**32 - 1),
    doubled=st.sampled_from([0.0, 0.1, 1.0]),
    imu_delay=st.sampled_from([0.0, 0.05, 0.5, WINDOW]),
    position_delay=st.floats(0.0, WINDOW),
    velocity_delay=st.floats(0.0, WINDOW),
)
def test_arrival_order_changes_no_bit(recording, seed, doubled, imu_delay, position_delay, velocity_delay):
    random = np.random.default_rng(seed)
    messages = every_message(recording, random, doubled)
    in_order = arriving(recording, messages, random, (0.0, 0.0, 0.0))
    shuffled = arriving(recording, messages, random, (imu_delay, position_delay, velocity_delay))
    state, records, _ = result(recording, in_order)
    other_state, other_records, _ = result(recording, shuffled)
    assert other_records == records
    assert other_state == state


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", ["jitter", "bursts"])
def test_arrival_order_changes_no_bit_where_imu_stamps_scatter(recording, kind, seed):
    """The state then stands beside the stamp of its last sample, and the two rewind apart."""
    random = np.random.default_rng(seed)
    stamps = recording.imu_stamp.copy()
    if kind == "jitter":
        stamps += np.round(4e6 * random.normal(size=len(stamps))).astype(np.int64)
        stamps = np.maximum.accumulate(stamps) + np.arange(len(stamps))
    else:
        stamps = stamps[np.minimum(np.arange(len(stamps)) // 4 * 4 + 3, len(stamps) - 1)] + np.arange(len(stamps))
    scattered = dataclasses.replace(recording, imu_stamp=stamps)
    messages = every_message(scattered, random, 0.1)
    state, records, together = result(scattered, arriving(scattered, messages, random, (0.0, 0.0, 0.0)))
    assert np.mean(together["verdict"] == Verdict.FUSED) > 0.7
    for delays in ((0.5, 1.0, WINDOW), (WINDOW, WINDOW, 0.3)):
        other_state, other_records, _ = result(scattered, arriving(scattered, messages, random, delays))
        assert other_records == records
        assert other_state == state


def test_sorted_arrival_does_fuse(recording):
    """The equality above would also hold for a filter that refuses everything."""
    messages = every_message(recording, np.random.default_rng(0), 0.0)
    _, _, records = result(recording, arriving(recording, messages, np.random.default_rng(0), (0.0, 0.0, 0.0)))
    fused = np.mean(records["verdict"] == Verdict.FUSED)
    assert fused > 0.9


def test_late_data_matters(recording):
    """A filter that ignored late messages would differ: the same delays beyond the window do change the result."""
    random = np.random.default_rng(5)
    messages = every_message(recording, random, 0.0)
    state, _, _ = result(recording, arriving(recording, messages, random, (0.0, 0.0, 0.0)))
    late_state, _, records = result(recording, arriving(recording, messages, random, (0.0, 2 * WINDOW, 2 * WINDOW)))
    assert late_state != state
    assert np.any(records["verdict"] == Verdict.OUTSIDE_HISTORY)


def test_too_late_is_counted_and_never_applied(recording):
    messages = arriving(
        recording, every_message(recording, np.random.default_rng(0), 0.0), np.random.default_rng(0), (0.0, 0.1, 0.1)
    )
    kept, late = messages[:-1], next(m for m in messages if m.stream == POSITION)
    kept.remove(late)
    navigator = navigator_for(recording)
    for message in kept:
        push(navigator, recording, message)
    before = navigator.state
    push(navigator, recording, late)
    push(navigator, recording, Message(IMU, 0, 0.0, 0))
    navigator.update()
    assert navigator.state.tobytes() == before.tobytes()
    records = navigator.finish()
    assert np.count_nonzero(records["verdict"] == Verdict.OUTSIDE_HISTORY) == 1
    assert navigator.imu_counts["late"] == 1
    lateness = (recording.imu_stamp[-1] - recording.imu_stamp[0]) / SECOND
    assert navigator.window_needed == pytest.approx(lateness, abs=0.05)


@pytest.mark.parametrize(("imu_follows", "verdict"), [(False, Verdict.WAITING), (True, Verdict.FUSED)])
def test_a_measurement_ahead_of_the_imu_waits_for_it(recording, imu_follows, verdict):
    navigator = navigator_for(recording)
    half = len(recording.imu_stamp) // 2
    ahead = int(np.searchsorted(recording.fix_stamp, recording.imu_stamp[half]))
    for part in (slice(0, half), slice(half, None)):
        navigator.push_imu(recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
        if part.start == 0:
            push(navigator, recording, Message(POSITION, ahead, 0.0, 0))
            if not imu_follows:
                break
    assert navigator.finish()["verdict"].tolist() == [verdict]


def test_history_is_bounded_by_time(recording):
    """A long drive needs no more memory than a short one."""
    navigator = navigator_for(recording)
    step = int(recording.imu_stamp[1] - recording.imu_stamp[0])
    samples = 500
    for block in range(200):
        stamps = recording.imu_stamp[0] + step * np.arange(block * samples, (block + 1) * samples)
        navigator.push_imu(stamps, np.tile([0.0, 0.0, 9.8], (samples, 1)), np.zeros((samples, 3)))
        navigator.push_gnss_position(int(stamps[-1]), 48.0, 11.0, 500.0, np.eye(3).ravel(), 2, 0)
        navigator.take_records()
        if block == 10:
            held = navigator.held_bytes
    assert navigator.held_bytes == held


def test_split_and_single_pushes_agree(recording):
    """One push of many samples is many pushes of one."""
    whole, single = navigator_for(recording), navigator_for(recording)
    rows = whole.push_imu(recording.imu_stamp, recording.specific_force, recording.angular_rate)
    parts = [
        single.push_imu(
            recording.imu_stamp[i : i + 1], recording.specific_force[i : i + 1], recording.angular_rate[i : i + 1]
        )
        for i in range(len(recording.imu_stamp))
    ]
    together = np.concatenate(parts)
    for field in rows.dtype.names:
        assert together[field].tobytes() == rows[field].tobytes(), field


@pytest.mark.parametrize("rate", [0.0, 10.0])
def test_rows_are_on_the_output_grid(recording, rate):
    navigator = Navigator(from_mapping(recording.parameters()), output_rate=rate)
    rows = navigator.push_imu(recording.imu_stamp, recording.specific_force, recording.angular_rate)
    if rate:
        assert len(set(rows["stamp"] // round(SECOND / rate))) == len(rows)
    else:
        level = recording.imu_stamp >= rows["stamp"][0]
        assert np.array_equal(rows["stamp"], recording.imu_stamp[level])


def push_imu(navigator: Navigator, recording: Recording, part: slice, shift: np.ndarray | int = 0) -> None:
    """Push some IMU samples one by one, with ``shift`` (ns) added to their stamps."""
    stamps = recording.imu_stamp[part] + shift
    for k, (force, rate) in enumerate(zip(recording.specific_force[part], recording.angular_rate[part])):
        navigator.push_imu(stamps[k : k + 1], force[np.newaxis], rate[np.newaxis])


@pytest.mark.parametrize("shifts", [[3600.0], [3600.0] * 15, [3600.0, 7300.0, 20.0, 3650.0, 11.0] * 4])
def test_imu_stamps_far_ahead_that_do_not_follow_each_other_are_refused(recording, shifts):
    good, bad = navigator_for(recording), navigator_for(recording)
    half = len(recording.imu_stamp) // 2
    for navigator in (good, bad):
        push_imu(navigator, recording, slice(0, half))
    for shift in shifts:
        push_imu(bad, recording, slice(half, half + 1), round(shift * SECOND))
    for navigator in (good, bad):
        push_imu(navigator, recording, slice(half, None))
    assert estimate(bad) == estimate(good)
    assert bad.imu_counts["bad_stamp"] == len(shifts)


def test_imu_stamps_far_ahead_between_good_ones_are_refused(recording):
    """They follow each other, but not in a row."""
    good, bad = navigator_for(recording), navigator_for(recording)
    push_imu(good, recording, slice(0, None))
    for k in range(len(recording.imu_stamp)):
        push_imu(bad, recording, slice(k, k + 1))
        if 700 <= k < 750:
            push_imu(bad, recording, slice(k, k + 1), 3600 * SECOND)
    assert estimate(bad) == estimate(good)
    assert bad.imu_counts["bad_stamp"] == 50


def test_a_clock_set_forward_is_followed(recording):
    """Ten samples in a row say so: the tenth is believed."""
    navigator = navigator_for(recording)
    half = len(recording.imu_stamp) // 2
    push_imu(navigator, recording, slice(0, half))
    push_imu(navigator, recording, slice(half, half + 9), 3600 * SECOND)
    assert navigator.state["stamp"][0] == recording.imu_stamp[half - 1]
    push_imu(navigator, recording, slice(half + 9, half + 10), 3600 * SECOND)
    assert navigator.state["stamp"][0] == recording.imu_stamp[half + 9] + 3600 * SECOND


@pytest.mark.parametrize("ahead", [12.0, 3600.0, 1e9])
@pytest.mark.parametrize("count", [1, 5])
def test_a_wrong_first_stamp_costs_nine_samples(recording, ahead, count):
    """Also when a fix came before it, and another while everything looked too late."""
    good, bad = navigator_for(recording), navigator_for(recording)
    messages = arriving(
        recording, every_message(recording, np.random.default_rng(0), 0.0), np.random.default_rng(0), (0.0, 0.1, 0.1)
    )
    push(bad, recording, Message(POSITION, 0, 0.0, 0))
    push_imu(bad, recording, slice(0, count), round(ahead * SECOND))
    push(bad, recording, Message(POSITION, 0, 0.0, 0))
    for message in messages:
        push(bad, recording, message)
        if message.stream != IMU or message.row >= 9:
            push(good, recording, message)
    assert estimate(bad) == estimate(good)
    assert bad.odometry.tobytes() == good.odometry.tobytes()
    assert bad.imu_counts["bad_stamp"] == 9
    assert bad.window_needed == 0.0
    assert bad.status == good.status == Status.GOOD


def test_once_level_no_samples_far_behind_are_believed(recording):
    """What was published is not taken back: they are late.

    If they went on for more than a second, a clock would have been set (`test_clock_steps`).
    """
    good, bad = navigator_for(recording), navigator_for(recording)
    half = len(recording.imu_stamp) // 2
    for navigator in (good, bad):
        push_imu(navigator, recording, slice(0, half))
    before = bad.state
    push_imu(bad, recording, slice(0, 50), -3600 * SECOND)
    assert bad.state.tobytes() == before.tobytes()
    for navigator in (good, bad):
        push_imu(navigator, recording, slice(half, None))
    assert estimate(bad) == estimate(good)
    assert bad.imu_counts["late"] == 50


def test_no_samples_far_behind_a_barrier_are_believed(recording):
    """A service was answered: what it did is not taken back."""
    navigator = navigator_for(recording)
    push_imu(navigator, recording, slice(0, 1), 3600 * SECOND)
    navigator.set_datum(48.0, 11.0, 500.0)
    before = navigator.state
    push_imu(navigator, recording, slice(0, 50))
    assert navigator.state.tobytes() == before.tobytes()
    assert navigator.imu_counts["late"] == 50


def test_a_datum_set_before_the_first_sample_is_no_barrier(recording):
    """Nothing was given out yet: a first stamp that was never true is taken back, and the fixes that wait stay."""
    navigator = navigator_for(recording)
    push(navigator, recording, Message(POSITION, 0, 0.0, 0))
    navigator.set_datum(48.0, 11.0, 500.0)
    assert navigator.waiting == 1
    push_imu(navigator, recording, slice(0, 1), 3600 * SECOND)
    push_imu(navigator, recording, slice(0, 50))
    assert navigator.imu_counts["late"] == 0
    assert navigator.datum == pytest.approx((48.0, 11.0, 500.0), abs=1e-9)


def test_records_survive_a_barrier(recording):
    navigator = navigator_for(recording)
    push_imu(navigator, recording, slice(0, 400))
    for epoch in range(6):
        push(navigator, recording, Message(POSITION, epoch, 0.0, 0))
    navigator.set_datum(48.0, 11.0, 500.0)
    assert len(navigator.finish()) == 6


def test_nothing_in_a_long_window_is_far_behind(recording):
    """The newest sample comes first: all others are in time, more than ten seconds behind it and in a row."""
    in_order = navigator_for(recording, **{"history.window": 60.0})
    newest_first = navigator_for(recording, **{"history.window": 60.0})
    push_imu(in_order, recording, slice(0, None))
    push_imu(newest_first, recording, slice(-1, None))
    push_imu(newest_first, recording, slice(0, -1))
    assert estimate(newest_first) == estimate(in_order)
    assert newest_first.imu_counts["bad_stamp"] == 0
