"""What is rest and what is not: evidence of every sensor, a lift, a hovering drone, a garage, a tunnel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.filter.history.records import AID, RECORD
from eskf_ros.filter.measurements.kalman_update import ITERATIONS, update
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import CONSTRAINT_INTERVAL, Stream, Verdict
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.detector import learn_from_block, update_rest_evidence
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.imu import vibration
from eskf_ros.simulate.scenario import SCENARIOS, Recording, simulate
from eskf_ros.simulate.scenarios import PARKED, TUNNEL_START
from eskf_ros.simulate.wheel import WheelOdometer
from monte_carlo import BLOCKS, nees
from support.aided import run
from support.kernels import copy_of, core, make_settings, make_state, make_work, random_covariance
from support.reference_filter import correction_by, reset_by

Array = NDArray[np.float64]

SECOND = 1_000_000_000
SETTINGS = make_settings()
REST = {"zupt.enabled": True}


# ------------------------------------------------------------------------------------------ noise shared with the error


@pytest.mark.parametrize("seed", range(6))
def test_update_with_shared_noise_is_that_of_the_joint_filter(seed: int) -> None:
    """Noise that has a covariance with the errors, as one more state of a filter without measurement noise."""
    rng = np.random.default_rng(seed)
    joint = random_covariance(seed, np.concatenate([np.repeat([2.0, 0.3, 0.02, 0.1, 0.003], 3), [0.1, 0.2, 0.3]]))
    jacobian = rng.normal(size=(3, 15))
    state, work = make_state(), make_work()
    core(state)[:] = joint[:15, :15]
    work["jacobian"][:, :15] = jacobian
    work["shared"][:, :15] = joint[15:, :15]
    work["noise"] = joint[15:, 15:]
    work["innovation"] = rng.normal(0.0, 0.1, 3)
    both = np.hstack([jacobian, np.eye(3)])
    spread = both @ joint @ both.T
    gain = joint @ both.T @ np.linalg.inv(spread)
    verdict, nis = update(state, 3, 1e300, work)
    assert verdict == Verdict.FUSED
    assert nis == pytest.approx(work["innovation"] @ np.linalg.solve(spread, work["innovation"]))
    correction = correction_by(gain[:15], jacobian, work["innovation"], ITERATIONS)
    np.testing.assert_allclose(state["position_map"], correction[:3], rtol=1e-9, atol=1e-12)
    turned = reset_by(np.array([0.0, 0.0, correction[8]]), 15)
    expected = turned @ (joint - gain @ both @ joint)[:15, :15] @ turned.T
    np.testing.assert_allclose(core(state), expected, rtol=0.0, atol=1e-8)


# --------------------------------------------------------------------------------------------------------- the evidence


def offered(stream: Stream, stamp: int, values: Any, stds: Any) -> Any:
    aid = allocate(AID)[0]
    aid["stream"], aid["stamp"] = stream, stamp
    aid["payload"][:3] = values
    aid["payload"][[3, 6, 8]] = [std * abs(std) for std in stds]
    return aid


@pytest.mark.parametrize(
    ("stream", "values", "stds", "says"),
    [
        (Stream.WHEEL, (0.0, 0.0, 0.0), (0.1, 0.1, -1.0), "rest"),
        (Stream.WHEEL, (0.05, 0.0, 0.0), (0.1, 0.1, -1.0), "motion"),
        (Stream.WHEEL, (0.0, 0.2, 0.0), (0.1, 0.1, -1.0), "motion"),
        # Wheels that do not tell the speed do not tell that it is zero.
        (Stream.WHEEL, (0.0, 0.0, 0.0), (-1.0, 0.1, -1.0), "nothing"),
        # It is as likely of a robot that creeps: one message has not the resolution to see rest.
        (Stream.GNSS_VELOCITY, (0.05, -0.1, 0.1), (0.08, 0.08, 0.12), "nothing"),
        (Stream.GNSS_VELOCITY, (0.005, -0.01, 0.01), (0.01, 0.01, 0.02), "rest"),
        (Stream.GNSS_VELOCITY, (0.5, 0.3, 0.0), (0.08, 0.08, 0.12), "motion"),
        (Stream.GNSS_VELOCITY, (0.5, 0.3, 0.0), (0.8, 0.8, 0.8), "nothing"),
        (Stream.BODY_VELOCITY, (0.01, 0.0, 0.02), (0.05, 0.05, 0.05), "nothing"),
        (Stream.BODY_VELOCITY, (0.01, 0.0, 0.02), (0.02, 0.02, 0.02), "rest"),
        (Stream.BODY_VELOCITY, (0.01, 0.0, 0.0), (0.05, 0.05, -1.0), "nothing"),
        (Stream.BODY_VELOCITY, (0.01, 0.4, 0.0), (0.05, 0.05, -1.0), "motion"),
    ],
)
def test_what_one_message_says(stream: Stream, values: Any, stds: Any, says: str) -> None:
    state = make_state()
    update_rest_evidence(state, offered(stream, 7 * SECOND, values, stds))
    assert state["rest"]["resting_stamp"] == (7 * SECOND if says == "rest" else NEVER)
    assert state["rest"]["moving_stamp"] == (7 * SECOND if says == "motion" else NEVER)


def place(north: float) -> tuple[float, float, float]:
    return (math.radians(48.0) + north / 6.37e6, math.radians(11.0), 500.0)


@pytest.mark.parametrize(
    ("std", "speed", "seconds", "says"),
    [
        (0.01, 0.0, 3.0, "rest"),
        (1.0, 0.0, 8.0, "nothing"),
        (1.0, 0.0, 60.0, "rest"),
        (0.02, 0.5, 0.4, "motion"),
        (1.0, 33.0, 0.4, "motion"),
        (1.0, 0.3, 3.0, "nothing"),
        (1.0, 0.3, 30.0, "motion"),
        # A creep of a decimetre per second is not yet seen, but is not taken for rest.
        (1.0, 0.1, 10.0, "nothing"),
        (1.0, 0.1, 20.0, "nothing"),
        (1.0, 0.1, 60.0, "motion"),
    ],
)
def test_fixes_tell_rest_from_motion_as_soon_as_they_can(std: float, speed: float, seconds: float, says: str) -> None:
    """How fast the place moves, and how well that is known; the fixes are free of error, which they do not know."""
    state = make_state()
    for k in range(round(seconds / 0.2) + 1):
        stamp = SECOND + k * SECOND // 5
        state["rest"]["resting_stamp"] = state["rest"]["moving_stamp"] = NEVER
        update_rest_evidence(state, offered(Stream.GNSS_POSITION, stamp, place(speed * 0.2 * k), (std, std, std)))
    assert (state["rest"]["resting_stamp"] > NEVER) == (says == "rest")
    assert (state["rest"]["moving_stamp"] > NEVER) == (says == "motion")


@pytest.mark.parametrize(("speed", "sees"), [(0.0, "rest"), (0.1, "motion or nothing")])
def test_velocities_together_see_what_one_does_not(speed: float, sees: str) -> None:
    """Five seconds of velocities with an error of a decimetre per second; in a creep none of 50 runs sees rest."""
    seen = 0
    for seed in range(50):
        rng, state = np.random.default_rng(seed), make_state()
        for k in range(40):
            velocity = rng.normal((speed, 0.0, 0.0), 0.1)
            offer = offered(Stream.GNSS_VELOCITY, SECOND + k * SECOND // 5, velocity, (0.1, 0.1, 0.1))
            update_rest_evidence(state, offer)
        seen += state["rest"]["resting_stamp"] > NEVER
    assert seen >= 48 if sees == "rest" else seen == 0


@pytest.mark.parametrize("rate_deg", [0.0, 0.2, -2.0])
def test_a_dual_antenna_excludes_a_turn_or_sees_it(rate_deg: float) -> None:
    state, rng = make_state(), np.random.default_rng(1)
    for k in range(100):
        stamp = SECOND + k * SECOND // 5
        yaw = math.radians(179.0 + rate_deg * 0.2 * k + 0.3 * rng.normal())
        update_rest_evidence(state, offered(Stream.HEADING, stamp, (yaw, 0.0, 0.0), (math.radians(0.3), -1.0, -1.0)))
        if k == 5:
            assert stamp in (state["rest"]["doubt_stamp"], state["rest"]["moving_stamp"])
    assert (state["rest"]["moving_stamp"] == stamp) == (rate_deg != 0.0)
    assert state["rest"]["doubt_stamp"] < stamp - SECOND


def block(state: Any, rng: np.random.Generator, force: float, rate: float) -> None:
    """Fill the block with a second of readings at 100 Hz about these means along x."""
    readings = rng.normal(0.0, np.repeat([0.02, 0.002], 3), (100, 6)) + (force, 0.0, 9.8, rate, 0.0, 0.0)
    rest = state["rest"]
    rest["block_count"], rest["block_half_count"] = 100, 50
    rest["block_sum"], rest["block_half_sum"] = readings.sum(axis=0), readings[:50].sum(axis=0)
    rest["block_square_sum"] = (readings**2).sum(axis=0)


@pytest.mark.parametrize(("force", "rate", "changes"), [(0.0, 0.0, False), (0.05, 0.0, True), (0.0, 0.0035, True)])
def test_a_gentle_start_is_felt_before_it_is_seen(force: float, rate: float, changes: bool) -> None:
    """0.05 m/s2, or a turn of 0.2 deg/s, after seven quiet seconds: what was seen of rest is forgotten."""
    state, rng = make_state(), np.random.default_rng(3)
    for second in range(8):
        state["rest"]["block_end"] = state["rest"]["resting_stamp"] = (10 + second) * CONSTRAINT_INTERVAL
        block(state, rng, force if second == 7 else 0.0, rate if second == 7 else 0.0)
        learn_from_block(state, SETTINGS)
        if second < 7:
            assert state["rest"]["resting_stamp"] > NEVER
    assert (state["rest"]["resting_stamp"] == NEVER) == changes


@pytest.mark.parametrize(("climb", "moves"), [(0.0, False), (0.5, False), (12.0, True), (-12.0, True)])
def test_pressure_that_changes_is_motion(climb: float, moves: bool) -> None:
    state = make_state()
    state["rest"]["quiet"] = 1
    for second, height in ((1, 0.0), (9, climb)):
        pressure = 95_000.0 - 11.8 * height
        update_rest_evidence(state, offered(Stream.BARO, second * SECOND, (pressure, 0.0, 0.0), (5.0, -1.0, -1.0)))
    assert (state["rest"]["moving_stamp"] > NEVER) == moves


def test_how_quiet_rest_is_is_learnt_where_it_is_seen() -> None:
    """And how quiet motion is; what nobody has seen teaches nothing."""
    state = make_state()
    state["rest"]["block_end"] = 10 * CONSTRAINT_INTERVAL
    state["rest"]["block_count"], state["rest"]["block_half_count"] = 100, 50
    state["rest"]["block_square_sum"][:3] = 100 * 0.02**2
    quiet = copy_of(state)
    learn_from_block(quiet, SETTINGS)
    assert quiet["rest"]["resting_activity"] == quiet["rest"]["moving_activity"] == 0.0
    for name, other in (("resting", "moving"), ("moving", "resting")):
        seen = copy_of(state)
        seen["rest"][f"{name}_stamp"] = seen["rest"]["block_end"]
        learn_from_block(seen, SETTINGS)
        assert seen["rest"][f"{name}_activity"] == pytest.approx(3.0 * 0.02**2 / SETTINGS["still_accel_std"] ** 2)
        assert seen["rest"][f"{other}_activity"] == 0.0


def test_what_comes_before_motion_does_not_spoil_what_rest_is() -> None:
    """Wheels read zero until the car moves at half a metre per second: six seconds of that, twenty times as loud."""
    state = make_state()
    state["rest"]["resting_activity"] = 0.01
    for second in range(6):
        state["rest"]["block_end"] = state["rest"]["resting_stamp"] = (10 + second) * CONSTRAINT_INTERVAL
        state["rest"]["block_count"], state["rest"]["block_half_count"] = 100, 50
        state["rest"]["block_square_sum"][0] = 100 * 0.2 * SETTINGS["still_accel_std"] ** 2
        learn_from_block(state, SETTINGS)
    assert 0.01 < state["rest"]["resting_activity"] < 0.02


# ---------------------------------------------------------------------------------------------------------- no rest


def estimated(recording: Recording, **changes: Any) -> Any:
    parameters = {**recording.parameters(), "alignment.initial_heading_deg": SCENARIOS[recording.name].heading_deg}
    return run(recording, Navigator(from_mapping({**parameters, **REST, **changes})), 1.0)


def zeros(records: np.ndarray, recording: Recording) -> tuple[Array, Array]:
    """Speed (m/s) and height (m) of the robot when a zero velocity was believed."""
    fused = records[(records["stream"] == Stream.ZUPT) & (records["verdict"] == Verdict.FUSED)]
    speed = np.linalg.norm(recording.truth_velocity_map, axis=1)
    height = recording.truth_position_map[:, 2]
    return tuple(np.interp(fused["stamp"], recording.truth_stamp, value) for value in (speed, height))  # type: ignore[return-value]


@pytest.mark.parametrize("velocity", [True, False], ids=["with velocity", "position only"])
@pytest.mark.parametrize("name", ["multirotor", "walk", "field_robot", "motorway"])
def test_no_motion_passes_for_rest(name: str, velocity: bool) -> None:
    """A drone that hovers, sensors held in the hand, a slow robot, a smooth motorway: as if the filter asked for it."""
    for seed in range(2):
        recording = simulate(name, seed, imu_rate=100.0, stop=140.0)
        result = estimated(recording, **{"gnss.use_velocity": velocity})
        speed, height = zeros(result.records, recording)
        # What is left of braking at the end of a stop.
        assert (speed < 0.15).all()
        assert np.count_nonzero(speed > 0.03) <= 1
        if name == "multirotor":
            assert (height < 0.5).all()
        if name in ("walk", "motorway"):
            assert len(speed) == 0


def test_a_motorway_without_gnss_is_no_rest() -> None:
    """Nothing but the estimate itself tells that the car moves; after minutes it is uncertain by tens of m/s."""
    for seed in range(2):
        recording = simulate("motorway", seed, imu_rate=50.0, grade="consumer", outages=((40.0, 1e9),))
        assert len(zeros(estimated(recording).records, recording)[0]) == 0


def ride(seed: int, with_barometer: bool) -> np.ndarray:
    """Records of a robot in a lift: wheels stand, no GNSS; it rises 1 m/s2 for 1.5 s, then for 12 s at 1.5 m/s."""
    recording = simulate(
        "parked", seed, imu_rate=100.0, stop=60.0, outages=((25.0, 1e9),), wheel=WheelOdometer(rate=10.0)
    )
    seconds = (recording.imu_stamp - recording.imu_stamp[0]) * 1e-9
    push = np.where((seconds >= 30.0) & (seconds < 31.5), 1.0, 0.0) - np.where(
        (seconds >= 43.5) & (seconds < 45.0), 1.0, 0.0
    )
    rise = np.cumsum(np.cumsum(push) * 0.01) * 0.01
    force = recording.specific_force + push[:, None] * (0.0, 0.0, 1.0)
    heading = {"alignment.initial_heading_deg": SCENARIOS["parked"].heading_deg}
    navigator = Navigator(from_mapping({**recording.parameters(), **heading, **REST}))
    rng = np.random.default_rng(seed)
    wheel = np.diag([0.01, 0.01, -1.0]).ravel()
    pressure = np.diag([25.0, -1.0, -1.0]).ravel()
    fix = 0
    for k in range(0, len(seconds), 10):
        part, stamp = slice(k, k + 10), int(recording.imu_stamp[k])
        navigator.push_imu(recording.imu_stamp[part], force[part], recording.angular_rate[part])
        navigator.push(Stream.WHEEL, stamp, (0.0, 0.0, 0.0), wheel)
        if with_barometer:
            height = 95_000.0 - 11.2 * float(rise[k]) + 5.0 * float(rng.normal())
            navigator.push(Stream.BARO, stamp, (height, 0.0, 0.0), pressure)
        while fix < len(recording.fix_stamp) and recording.fix_stamp[fix] <= stamp:
            position = recording.fix_latitude_deg[fix], recording.fix_longitude_deg[fix], recording.fix_altitude[fix]
            navigator.push_gnss_position(
                int(recording.fix_stamp[fix]), *map(float, position), recording.fix_covariance[fix], 2, 0
            )
            fix += 1
    records = navigator.finish()
    records["stamp"] -= recording.imu_stamp[0]
    assert records.dtype == RECORD
    return np.asarray(records[records["stream"] == Stream.ZUPT])


@pytest.mark.parametrize("seed", range(2))
def test_a_lift_with_a_barometer_is_no_rest(seed: int) -> None:
    """The wheels stand all the time: the pressure speaks against it, and where it comes too late the gate does."""
    asked = {}
    for with_barometer in (True, False):
        records = ride(seed, with_barometer)
        moving = (records["stamp"] > 30.5 * SECOND) & (records["stamp"] < 44.5 * SECOND)
        assert not (records["verdict"][moving] == Verdict.FUSED).any()
        asked[with_barometer] = np.count_nonzero(moving)
        before, after = records["stamp"] < 30 * SECOND, records["stamp"] > 52 * SECOND
        assert np.count_nonzero(records["verdict"][before] == Verdict.FUSED) > 15
        assert np.count_nonzero(records["verdict"][after] == Verdict.FUSED) > 4
    assert asked[True] < 0.7 * asked[False], asked


# ------------------------------------------------------------------------------------------------------------- rest


def test_ten_minutes_in_a_garage() -> None:
    """No GNSS, no wheels: rest is known from the stops before. Place, heading and covariance stay what they were."""
    means: dict[str, list[float]] = {}
    drift: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(6):
        recording = simulate("garage", seed, imu_rate=50.0)
        for enabled, kept in drift.items():
            result = estimated(recording, **{"zupt.enabled": enabled})
            first = int(np.searchsorted(result.seconds, PARKED + 10.0))
            kept.append(abs(result.error[-1, 8] - result.error[first, 8]))
            if enabled:
                assert math.hypot(*result.error[-1, :2]) < 1.0
                for name in ("position", "velocity", "attitude", "gyro bias"):
                    means.setdefault(name, []).append(
                        nees(result.error[first:], result.covariance[first:], BLOCKS[name]).mean()
                    )
    assert max(drift[True]) < math.radians(0.1)
    assert max(drift[False]) > 10.0 * max(drift[True])
    for name, values in means.items():
        # Of six consistent runs, whose epochs are all alike, the mean exceeds 5.4 once in a hundred times.
        assert np.mean(values) < 5.4, (name, np.mean(values))


def test_a_stop_in_a_tunnel_is_seen_by_how_quiet_it_is() -> None:
    """On a road that shakes the car. The velocity is known to metres per second only when it stands, after 50 s."""
    for seed in range(3):
        recording = simulate(
            "long_tunnel", seed, grade="consumer", imu_rate=100.0, stop=TUNNEL_START + 60.0, vibration=(0.3, 0.01)
        )
        with_rest, without = (estimated(recording, **{"zupt.enabled": enabled}) for enabled in (True, False))
        assert (zeros(with_rest.records, recording)[0] < 0.03).all()
        stamps = with_rest.records["stamp"][with_rest.records["stream"] == Stream.ZUPT]
        assert np.count_nonzero(stamps > recording.imu_stamp[0] + (TUNNEL_START + 45.0) * SECOND) > 5
        errors = [math.hypot(*result.error[-1, :2]) for result in (with_rest, without)]
        assert errors[0] < 0.4 * errors[1]


def test_vibration_shakes_about_where_the_body_is() -> None:
    """As strong as it says at 10 m/s, nothing at rest, and its sum does not grow."""
    speed = np.repeat([0.0, 10.0, 2.5], 4000)
    shaken = vibration(speed, 0.3, np.random.default_rng(1))
    assert (shaken[1:4000] == 0.0).all()
    np.testing.assert_allclose(shaken[4001:8000].std(axis=0), 0.3, rtol=0.05)
    np.testing.assert_allclose(shaken[8001:].std(axis=0), 0.15, rtol=0.05)
    assert np.abs(np.cumsum(shaken, axis=0)).max() < 6.0 * 0.3
