"""Stamps of the IMU: even ones stay, jitter and bursts go, what is real is followed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.compiled import njit
from eskf_ros.filter.inertial.stamps import take_stamp
from eskf_ros.filter.integrity.sample_report import stamp_complaints
from eskf_ros.filter.layout import blank_state

Stamps = NDArray[np.int64]

COUNT = 20_000
LEARNT = 2_000


@njit
def _take_all(state, raw, out):
    for k in range(len(raw)):
        out[k] = take_stamp(state, raw[k])
        state.imu.stamp = out[k]


def taken(raw: Stamps) -> tuple[Stamps, np.void]:
    """The times that a filter takes the samples for, and its state at the end."""
    state = blank_state()[0]
    out = np.zeros_like(raw)
    _take_all(state, raw, out)
    return out, state


def even(rate: float, count: int = COUNT) -> Stamps:
    return np.round(1e9 + np.arange(count) * (1e9 / rate)).astype(np.int64)


def in_order(stamps: Stamps) -> Stamps:
    return np.maximum.accumulate(stamps) + np.arange(len(stamps))


def jittered(true: Stamps, kind: str) -> Stamps:
    rng = np.random.default_rng(4)
    name, _, size = kind.partition(" ")
    if name == "gaussian":
        return in_order(true + np.round(1e6 * float(size) * rng.normal(size=len(true))).astype(np.int64))
    if name == "late":
        return in_order(true + np.round(1e6 * rng.uniform(1.0, 3.0, len(true))).astype(np.int64))
    if name == "exponential":
        return in_order(true + np.round(1e6 * rng.exponential(float(size), len(true))).astype(np.int64))
    # Bursts: all get the stamp of the last, a microsecond apart.
    sizes = rng.integers(2, 11, len(true)) if size == "any" else np.full(len(true), int(size))
    ends = np.cumsum(sizes) - 1
    number = np.searchsorted(ends, np.arange(len(true)))
    last = np.minimum(ends[number], len(true) - 1)
    return true[last] + 1000 * (np.arange(len(true)) - last)


def off(times: Stamps, true: Stamps) -> tuple[float, float]:
    """Mean of the error (ms), and rms of the error of the intervals over their length, once it is learnt."""
    error = (times - true)[LEARNT:]
    return float(1e-6 * error.mean()), float(np.std(np.diff(error)) / np.median(np.diff(true)))


@pytest.mark.parametrize("rate", [5.0, 30.0, 100.0, 200.0, 400.0, 1000.0])
@pytest.mark.parametrize("dropped", [0.0, 0.1])
def test_even_stamps_are_not_touched(rate: float, dropped: float) -> None:
    """Not by a nanosecond, whatever is missing between them, and with the jitter of a good clock."""
    rng = np.random.default_rng(1)
    raw = even(rate)
    raw += np.round(0.005e9 / rate * rng.normal(size=COUNT)).astype(np.int64)
    kept = rng.random(COUNT) >= dropped
    kept[5000:5320] = False
    times, state = taken(raw[kept])
    np.testing.assert_array_equal(times, raw[kept])
    assert not stamp_complaints(state)


@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_another_rate_is_followed_at_once(jitter: float) -> None:
    """200, 100, then 400 Hz: exactly where stamps are even, within ten periods where they scatter."""
    true = np.concatenate([even(200.0, 4000), 22_000_000_000 + even(100.0, 4000), 63_000_000_000 + even(400.0, 4000)])
    assert (np.diff(true) > 0).all()
    times, _ = taken(jittered(true, f"gaussian {jitter}") if jitter else true)
    if jitter:
        assert np.abs(times - true).max() < 100e6
        settled = np.r_[3000:4000, 7000:8000, 11000:12000]
        assert np.std((times - true)[settled]) < 0.3e6
    else:
        np.testing.assert_array_equal(times, true)


@pytest.mark.parametrize(
    ("kind", "rate", "lateness"),
    [
        ("gaussian 1", 200.0, 0.0),
        ("gaussian 2", 100.0, 0.0),
        ("gaussian 3", 200.0, 0.0),
        ("late", 200.0, 2.0),
        ("exponential 1", 200.0, 1.0),
    ],
)
def test_jitter_is_smoothed_away(kind: str, rate: float, lateness: float) -> None:
    """The intervals are right to a hundredth, the times but for the mean lateness, which nothing shows."""
    true = even(rate)
    raw = jittered(true, kind)
    assert off(raw, true)[1] > 0.1
    times, state = taken(raw)
    mean, spread = off(times, true)
    assert spread < 0.01
    assert mean == pytest.approx(lateness, abs=0.3)
    assert (np.diff(times) > 0).all()
    (sentence,) = stamp_complaints(state)
    assert "jitter by" in sentence


@pytest.mark.parametrize("size", ["2", "3", "4", "10", "any"])
@pytest.mark.parametrize("rate", [100.0, 200.0])
def test_bursts_are_spread_before_the_last_of_each(size: str, rate: float) -> None:
    true = even(rate)
    raw = jittered(true, f"bursts {size}")
    assert off(raw, true)[1] > 0.9
    times, state = taken(raw)
    mean, spread = off(times, true)
    assert spread < 0.01
    assert abs(mean) < 0.1
    (sentence,) = stamp_complaints(state)
    assert "in bursts of about" in sentence


def test_drops_are_followed_among_jitter() -> None:
    """Of stamps that scatter by a tenth of the period a hole shows at once, a lost sample within a few."""
    rng = np.random.default_rng(2)
    true = even(200.0)
    kept = rng.random(COUNT) > 0.002
    kept[9000:9320] = False
    times, _ = taken(jittered(true, "gaussian 0.5")[kept])
    error = (times - true[kept])[LEARNT:]
    assert np.mean(np.abs(error) > 1e6) < 0.02
    assert np.abs(error).max() < 6e6
