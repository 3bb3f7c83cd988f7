"""What goes wrong with a simulated IMU, with the messages of GNSS and with clocks goes wrong as declared, and then."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.simulate import main as command
from eskf_ros.simulate.episodes import ClockSet, Episode
from eskf_ros.simulate.gnss import GnssReceiver
from eskf_ros.simulate.gnss_message_episodes import (
    GNSS_MESSAGE_EPISODES,
    FrozenFixes,
    GnssDelay,
    MissingAltitude,
    RepeatedFixes,
    UnfilledFixes,
    VelocityInNed,
    WholeSeconds,
)
from eskf_ros.simulate.imu_episodes import (
    IMU_EPISODES,
    ImuAxes,
    ImuBias,
    ImuBursts,
    ImuClipping,
    ImuDeformation,
    ImuHoles,
    ImuJitter,
    ImuNoise,
    ImuShocks,
    ImuStuck,
    ImuVibration,
)
from eskf_ros.simulate.scenario import Recording, simulate
from support.simulated import TOPICS, assert_chi_square, read, seconds

Array = NDArray[np.float64]
FOR_GOOD = math.inf


def recorded(*episodes: Episode, **options: Any) -> Recording:
    return simulate("drive", 2, episodes=episodes, **{"stop": 60.0, "imu_rate": 100.0, **options})


PLAIN = recorded()
TAKEN = seconds(PLAIN.imu_taken)


def test_samples_are_taken_when_they_are_stamped() -> None:
    np.testing.assert_array_equal(PLAIN.imu_taken, PLAIN.imu_stamp)


@pytest.mark.parametrize("kind", [*IMU_EPISODES, "clock_set"])
def test_an_episode_of_the_imu_changes_it_within_its_time_and_nothing_else(kind: str) -> None:
    kinds: dict[str, Any] = {**IMU_EPISODES, "clock_set": ClockSet}
    more = {"imu_clipping": {"rate": 0.001}, "imu_deformation": {"gyro_scale": 0.01}, "imu_axes": {"gyro": "+x-y-z"}}
    changed = recorded(kinds[kind](30.0, 10.0, **more.get(kind, {})))
    there = np.isin(PLAIN.imu_taken, changed.imu_taken)
    outside = (TAKEN < 30.0) | (TAKEN >= 40.0)
    assert there[outside].all()
    kept = (seconds(changed.imu_taken) < 30.0) | (seconds(changed.imu_taken) >= 40.0)
    is_same = there.all()
    for name in ("imu_stamp", "imu_arrival", "specific_force", "angular_rate"):
        # Stamps that are held up may hold up the next one.
        latest = 1_000_000 if name == "imu_stamp" and kind == "imu_jitter" else 0
        np.testing.assert_allclose(getattr(changed, name)[kept], getattr(PLAIN, name)[outside], rtol=0, atol=latest)
        is_same = is_same and np.array_equal(getattr(changed, name), getattr(PLAIN, name))
    assert not is_same
    if kind != "clock_set":
        assert (np.diff(changed.imu_stamp) > 0).all()
        for field in dataclasses.fields(PLAIN):
            if field.name.startswith(("fix_", "velocity_", "truth_")):
                np.testing.assert_array_equal(getattr(changed, field.name), getattr(PLAIN, field.name))


def test_holes_are_as_long_as_told_and_filled_as_told() -> None:
    inside = (TAKEN >= 30.0) & (TAKEN < 31.6 - 1e-9)
    dropped = recorded(ImuHoles(30.0, 20.0))
    missing = TAKEN[~np.isin(PLAIN.imu_taken, dropped.imu_taken)]
    assert len(missing) == 2 * 160
    assert missing.min() == pytest.approx(30.0)
    lines = recorded(ImuHoles(30.0, 10.0, filled="lines")).angular_rate
    around = np.flatnonzero(inside)[[0, -1]] + (-1, 1)
    bend = np.diff(lines[around[0] : around[1] + 1], n=2, axis=0)
    np.testing.assert_allclose(bend, 0.0, atol=1e-12)
    np.testing.assert_array_equal(lines[around], PLAIN.angular_rate[around])
    repeats = recorded(ImuHoles(30.0, 10.0, filled="repeats")).specific_force[inside]
    np.testing.assert_array_equal(repeats, np.tile(PLAIN.specific_force[around[0]], (160, 1)))


def test_stamps_scatter_and_are_late_as_told_and_stay_in_order() -> None:
    scattered = recorded(ImuJitter(0.0, FOR_GOOD, 1e-4))
    assert_chi_square((scattered.imu_stamp - scattered.imu_taken) / 1e5)
    late = (recorded(ImuJitter(0.0, FOR_GOOD, 0.0, 0.002)).imu_stamp - PLAIN.imu_taken) * 1e-9
    assert late.min() >= 0.0
    assert late.mean() == pytest.approx(0.002, rel=0.05)
    assert (np.diff(recorded(ImuJitter(0.0, FOR_GOOD, 0.02)).imu_stamp) > 0).all()


def test_bursts_bear_the_stamp_of_their_last_sample() -> None:
    stamps = recorded(ImuBursts(0.0, FOR_GOOD, 4)).imu_stamp.reshape(-1, 4)
    np.testing.assert_array_equal(stamps[:, 3], PLAIN.imu_stamp[3::4])
    np.testing.assert_array_equal(np.diff(stamps, axis=1), 1000)
    pairs = recorded(ImuBursts(0.0, FOR_GOOD, 2, 0.0)).imu_stamp
    np.testing.assert_array_equal(pairs[::2], pairs[1::2])


def test_biases_rise_or_step() -> None:
    step = recorded(ImuBias(30.0, FOR_GOOD, (0.0, 0.0, 1.0), (0.3, 0.0, 0.0)))
    inside = TAKEN >= 30.0
    np.testing.assert_allclose((step.angular_rate - PLAIN.angular_rate)[inside, 2], math.radians(1.0), rtol=1e-9)
    np.testing.assert_allclose((step.specific_force - PLAIN.specific_force)[inside, 0], 0.3, rtol=1e-9)
    rising = (recorded(ImuBias(30.0, FOR_GOOD, rise=60.0)).angular_rate - PLAIN.angular_rate)[:, 2]
    np.testing.assert_allclose(rising, np.radians(np.maximum(TAKEN - 30.0, 0.0) / 60.0), atol=1e-12)


def test_scale_misalignment_and_g_sensitivity() -> None:
    scaled = recorded(ImuDeformation(0.0, FOR_GOOD, 0.015, -0.01))
    np.testing.assert_allclose(scaled.angular_rate, 1.015 * PLAIN.angular_rate)
    np.testing.assert_allclose(scaled.specific_force, 0.99 * PLAIN.specific_force)
    turned = recorded(ImuDeformation(0.0, FOR_GOOD, gyro_rpy_deg=(0.0, 0.0, 90.0))).angular_rate
    np.testing.assert_allclose(turned, PLAIN.angular_rate[:, [1, 0, 2]] * (1.0, -1.0, 1.0), atol=1e-12)
    sensitive = recorded(ImuDeformation(0.0, FOR_GOOD, g_sensitivity=0.1)).angular_rate - PLAIN.angular_rate
    np.testing.assert_allclose(np.degrees(sensitive), 0.1 * PLAIN.specific_force / 9.80665, atol=1e-9)


def test_readings_are_clipped_struck_shaken_stuck_and_noisy() -> None:
    clipped = recorded(ImuClipping(0.0, FOR_GOOD, 0.2, 9.0))
    np.testing.assert_array_equal(clipped.angular_rate, np.clip(PLAIN.angular_rate, -0.2, 0.2))
    assert clipped.specific_force[:, 2].max() == 9.0
    blows = np.linalg.norm(recorded(ImuShocks(30.0, 20.0)).specific_force - PLAIN.specific_force, axis=1)
    assert np.count_nonzero(blows > 99.9) == 2 * 10
    assert np.count_nonzero(blows > 1e-9) == 2 * 10
    wave = recorded(ImuVibration(0.0, FOR_GOOD)).angular_rate - PLAIN.angular_rate
    np.testing.assert_allclose(wave.std(axis=0), 0.05 / math.sqrt(2.0), rtol=0.01)
    spectrum = np.abs(np.fft.rfft(wave[:, 0]))
    assert np.fft.rfftfreq(len(wave), 0.01)[np.argmax(spectrum)] == pytest.approx(23.0, abs=0.05)
    stuck = recorded(ImuStuck(30.0, 10.0, "accel", "y")).specific_force[(TAKEN >= 30.0) & (TAKEN < 40.0)]
    assert np.ptp(stuck[:, 1]) == 0.0
    assert np.ptp(stuck[:, 0]) > 0.0
    noise = recorded(ImuNoise(0.0, FOR_GOOD, 1e-3, 2e-2))
    assert_chi_square((noise.angular_rate - PLAIN.angular_rate) / (1e-3 * 10.0))
    assert_chi_square((noise.specific_force - PLAIN.specific_force) / (2e-2 * 10.0))


def test_axes_are_exchanged_with_their_signs() -> None:
    changed = recorded(ImuAxes(0.0, FOR_GOOD, "+x-y-z", "+y+x+z"))
    np.testing.assert_array_equal(changed.angular_rate, PLAIN.angular_rate * (1.0, -1.0, -1.0))
    np.testing.assert_array_equal(changed.specific_force, PLAIN.specific_force[:, [1, 0, 2]])


def test_a_clock_that_is_set_moves_the_stamps_of_imu_and_gnss_and_not_their_order() -> None:
    changed = recorded(ClockSet(30.0, FOR_GOOD, -10.0))
    for name in ("imu_stamp", "fix_stamp", "velocity_stamp"):
        before, after = getattr(PLAIN, name), getattr(changed, name)
        np.testing.assert_array_equal(after - before, np.where(seconds(before) >= 30.0, -10_000_000_000, 0))
    np.testing.assert_array_equal(changed.imu_arrival, PLAIN.imu_arrival)
    np.testing.assert_array_equal(changed.imu_taken, PLAIN.imu_taken)


@pytest.mark.parametrize("kind", GNSS_MESSAGE_EPISODES)
def test_an_episode_of_messages_changes_one_receiver_within_its_time_and_nothing_else(kind: str) -> None:
    two = {"second_gnss": GnssReceiver(rate=2.0)}
    plain, changed = recorded(**two), recorded(GNSS_MESSAGE_EPISODES[kind](30.0, 10.0, receiver=1), **two)
    is_same = True
    for field in dataclasses.fields(plain):
        before, after = getattr(plain, field.name), getattr(changed, field.name)
        if field.name.startswith(("fix_", "velocity_")):
            t = seconds(plain.fix_stamp)
            outside = (t < 30.0) | (t >= 40.0)
            np.testing.assert_array_equal(before[outside], after[outside], field.name)
            is_same = is_same and np.array_equal(before, after)
        elif isinstance(before, np.ndarray):
            np.testing.assert_array_equal(before, after, field.name)
    assert not is_same
    assert plain.second_gnss is not None
    assert changed.second_gnss is not None
    for field in dataclasses.fields(plain.second_gnss):
        np.testing.assert_array_equal(getattr(plain.second_gnss, field.name), getattr(changed.second_gnss, field.name))


def test_fixes_freeze_repeat_and_lack() -> None:
    frozen = recorded(FrozenFixes(30.0, 10.0)).fix_latitude_deg[(t := seconds(PLAIN.fix_stamp)) >= 30.0][:50]
    np.testing.assert_array_equal(frozen, PLAIN.fix_latitude_deg[t >= 30.0][0])
    repeated = recorded(RepeatedFixes(0.0, FOR_GOOD, 5))
    np.testing.assert_array_equal(repeated.fix_altitude, np.repeat(PLAIN.fix_altitude[::5], 5)[: len(t)])
    np.testing.assert_array_equal(repeated.velocity_enu[:, 0], np.repeat(PLAIN.velocity_enu[::5, 0], 5)[: len(t)])
    unfilled = recorded(UnfilledFixes(0.0, 15.0))
    assert not unfilled.fix_latitude_deg[t < 15.0].any()
    assert (unfilled.fix_status[t < 15.0] == 0).all()
    assert np.isnan(recorded(MissingAltitude(0.0, FOR_GOOD)).fix_altitude).all()
    some = np.isnan(recorded(MissingAltitude(0.0, FOR_GOOD, 0.25)).fix_altitude)
    assert 0.15 < some.mean() < 0.35


def test_stamps_and_axes_of_gnss() -> None:
    whole = recorded(WholeSeconds(0.0, FOR_GOOD))
    assert not (whole.fix_stamp % 1_000_000_000).any()
    assert len(np.unique(whole.fix_stamp)) <= 61
    late = recorded(GnssDelay(0.0, FOR_GOOD, 0.0, 0.13))
    np.testing.assert_array_equal(late.fix_stamp, PLAIN.fix_stamp)
    np.testing.assert_array_equal(late.velocity_stamp, PLAIN.velocity_stamp + 130_000_000)
    ned = recorded(VelocityInNed(0.0, FOR_GOOD)).velocity_enu
    east, north, up = PLAIN.velocity_enu.T
    np.testing.assert_array_equal(ned, np.column_stack([north, east, -up]))


@pytest.mark.parametrize(
    ("episode", "expected"),
    [
        ("imu_holes:start=0,length=9,filled=sand", "filled by no, lines or repeats, not 'sand'"),
        ("imu_holes:start=0,length=9,hole=10", "is none, or has no end"),
        ("imu_stuck:start=0,length=9,axis=w", "stuck is axis x, y or z"),
        ("imu_axes:start=0,length=9,gyro=xyz", "like +x-y-z, not 'xyz'"),
        ("repeated_fixes:start=0,length=9,times=0", "comes at least once"),
        ("frozen_fixes:start=0,length=9,receiver=3", "the receiver must be 1, 2 or, for both, 0"),
    ],
)
def test_impossible_episodes_are_refused(episode: str, expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["drive", "--episode", episode]) == 2
    assert expected in capsys.readouterr().err


def test_command_writes_the_episodes(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    texts = ("imu_holes:start=10,length=20", "imu_axes:start=0,length=inf,gyro=+x-y-z", "gnss_delay:start=5,length=9")
    arguments = [argument for text in texts for argument in ("--episode", text)]
    assert command.main(["drive", "--set", "stop=40", *arguments, "--quiet", "--out", str(path)]) == 0
    episodes = (ImuHoles(10.0, 20.0), ImuAxes(0.0, FOR_GOOD, "+x-y-z"), GnssDelay(5.0, 9.0))
    expected = simulate("drive", 0, episodes=episodes, stop=40.0)
    found = read(path, TOPICS)
    np.testing.assert_array_equal(found["imu/data"][1]["stamp"], expected.imu_stamp)
    np.testing.assert_array_equal(found["imu/data"][1]["angular_velocity"], expected.angular_rate)
    np.testing.assert_array_equal(found["gps/fix"][1]["stamp"], expected.fix_stamp)
