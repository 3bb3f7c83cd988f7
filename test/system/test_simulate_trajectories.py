"""The truth is consistent in itself, and each scenario moves as what it is named after."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.simulate import aeroplane, boat, multirotor, walk
from eskf_ros.simulate.aeroplane import AeroplaneTrajectory
from eskf_ros.simulate.imu import ImuMount, ideal_samples
from eskf_ros.simulate.jets import Taylor, arctan2, moving_body, sin_cos, sqrt
from eskf_ros.simulate.motion import Motion
from eskf_ros.simulate.multirotor import Land, Leg, MultirotorTrajectory, TakeOff
from eskf_ros.simulate.path import PathState
from eskf_ros.simulate.profile import ClimbTo, Hold, SpeedTo, Turn, TurnInPlace
from eskf_ros.simulate.scenario import SCENARIOS, scenario, simulate, trajectory
from eskf_ros.simulate.scenario_families import FAMILIES
from eskf_ros.simulate.trajectory import DriveTrajectory
from eskf_ros.simulate.walk import WalkTrajectory
from eskf_ros.simulate.wheel import WheelOdometer
from support.simulated import FRAME, assert_chi_square, assert_imu_integrates_back, attitude, seconds

Array = NDArray[np.float64]

SHORT = [name for name in SCENARIOS if name != "hour_drive"]
NUMBERED = {
    "stand": 300.0,
    "straight": 33.0,
    "creep": 0.4,
    "slow_turn": 0.5,
    "turn_in_place": 20.0,
    "fast_start": 60.0,
    "tractor": 0.5,
    "skid_steer": 0.8,
    "train": 30.0,
    "crab": 40.0,
}
"""A number for each family."""
ONE_OF_EACH = [f"{kind}:{number:g}" for kind, number in NUMBERED.items()]
WHEELED = ["drive", "tunnel_drive", "hour_drive", "reverse_start", "parked", "field_robot"]


def sampled(name: str, rate: float = 20.0) -> tuple[Array, Motion]:
    path = trajectory(name)
    t = np.linspace(0.0, path.duration, round(rate * path.duration) + 1)
    return t, path.motion(t)


def roll_pitch_yaw(motion: Motion) -> Array:
    return attitude(motion).as_euler("ZYX")[:, ::-1]


def body_axes(motion: Motion, vectors_map: Array) -> Array:
    return attitude(motion).inv().apply(vectors_map)


# ------------------------------------------------------------------------------------------------ consistent in itself


@pytest.mark.parametrize("name", [*SHORT, *ONE_OF_EACH])
def test_truth_is_its_own_derivative(name: str) -> None:
    path = trajectory(name)
    t = np.random.default_rng(1).uniform(0.01, path.duration - 0.01, 4000)
    # The shorter the step, the less the differences err where the motion is quick, and the more they suffer from
    # rounding where the way is long.
    h = 5e-4 if name == "walk" else 2e-3
    tolerance = 5e-9 if name in ("walk", "multirotor", "long_flight", "aeroplane", "skid_steer:0.8") else 2e-9
    # Rounding grows with the way.
    tolerance = max(tolerance, 1e-12 * np.abs(path.motion(path.duration).position_map).max())
    # Differences across a joint of the polynomials are less exact: higher derivatives jump there.
    t = t[np.abs(t[:, None] - path.breakpoints).min(axis=1) > 2.0 * h]
    before2, before, here, after, after2 = (path.motion(t + k * h) for k in (-2, -1, 0, 1, 2))

    def derivative(quantity: str) -> Array:
        """Central differences of fourth order."""
        b2, b, a, a2 = (getattr(motion, quantity) for motion in (before2, before, after, after2))
        return (b2 - 8.0 * b + 8.0 * a - a2) / (12.0 * h)

    np.testing.assert_allclose(derivative("position_map"), here.velocity_map, atol=tolerance)
    np.testing.assert_allclose(derivative("velocity_map"), here.acceleration_map, atol=tolerance)
    np.testing.assert_allclose(derivative("angular_rate_body"), here.angular_acceleration_body, atol=tolerance)
    turned = (attitude(before).inv() * attitude(after)).as_rotvec() / (2.0 * h)
    turned2 = (attitude(before2).inv() * attitude(after2)).as_rotvec() / (4.0 * h)
    np.testing.assert_allclose((4.0 * turned - turned2) / 3.0, here.angular_rate_body, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(here.attitude_body_to_map, axis=1), 1.0, atol=1e-14)


@pytest.mark.parametrize("name", ["tunnel_drive", "aeroplane"])
def test_position_is_the_integral_of_velocity(name: str) -> None:
    path = trajectory(name)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    position = np.zeros(3)
    for begin, end in zip(path.breakpoints[:-1], path.breakpoints[1:], strict=True):
        half = 0.5 * (end - begin)
        position += half * weights @ path.motion(begin + half * (1.0 + nodes)).velocity_map
        np.testing.assert_allclose(path.motion(end).position_map[0], position, atol=1e-10)


@pytest.mark.parametrize("name", [*SHORT, *ONE_OF_EACH])
def test_acceleration_and_angular_rate_have_no_jumps(name: str) -> None:
    path = trajectory(name)
    at = path.breakpoints[1:-1]
    before, after = path.motion(at - 1e-8), path.motion(at + 1e-8)
    for quantity in ("velocity_map", "acceleration_map", "angular_rate_body", "angular_acceleration_body"):
        np.testing.assert_allclose(getattr(before, quantity), getattr(after, quantity), atol=4e-6)


@pytest.mark.parametrize(
    ("name", "begin", "length"),
    [
        ("reverse_start", 25.5, 2.0),  # begins to turn, backwards
        ("field_robot", 36.6, 2.0),  # stops and turns in place
        ("walk", 17.0, 0.7),  # comes up to speed; some steps
        ("multirotor", 43.0, 2.0),  # sets out sideways
        ("aeroplane", 75.5, 2.0),  # rolls into its first turn
        ("boat", 100.0, 2.0),
    ],
)
def test_imu_integrates_back_to_the_truth(name: str, begin: float, length: float) -> None:
    """With an IMU mounted off base_link and askew, in the inertial frame."""
    path = trajectory(name)
    mount = ImuMount((0.7, -0.4, 0.9), (3.0, -5.0, 100.0))
    assert_imu_integrates_back(path, [begin, begin + 0.5 * length, begin + length], mount)


@pytest.mark.parametrize("name", SHORT)
def test_motion_is_within_what_its_kind_can_do(name: str) -> None:
    t, motion = sampled(name)
    assert np.abs(motion.position_map[0]).max() < 0.5
    assert np.linalg.norm(motion.acceleration_map, axis=1).max() < {"walk": 8.0, "aeroplane": 6.0}.get(name, 4.0)
    assert np.degrees(np.abs(motion.angular_rate_body).max()) < 75.0
    found = SCENARIOS[name]
    assert all(0.0 <= first < last <= t[-1] for first, last in found.outages)
    off = math.degrees(roll_pitch_yaw(motion)[0, 2]) - found.heading_deg
    assert abs(off) < 1e-9, "the heading at the start is the one that is stated"


def test_tyres_that_slip_turn_the_body_into_the_curve() -> None:
    """The heading leads the course by the slip; what the rear axle does sideways is all that differs."""
    instructions = (SpeedTo(9.0), Turn(90.0, 2.5), Hold(3.0), SpeedTo(4.0), Turn(-60.0))
    slip = 0.01
    rolling, slipping = DriveTrajectory(instructions), DriveTrajectory(instructions, side_slip=slip)
    t = np.linspace(0.0, rolling.duration, 400)
    straight, turned = rolling.motion(t), slipping.motion(t)
    np.testing.assert_array_equal(turned.position_map, straight.position_map)
    (vx, vy, _), (ax, ay, _) = straight.velocity_map.T, straight.acceleration_map.T
    lateral = (vx * ay - vy * ax) / np.maximum(np.hypot(vx, vy), 1e-9)
    change = roll_pitch_yaw(turned)[:, 2] - roll_pitch_yaw(straight)[:, 2]
    np.testing.assert_allclose(change, slip * lateral, rtol=0.0, atol=1e-4)
    assert change.max() > 0.02
    assert change.min() < -0.015


@pytest.mark.parametrize("name", [*WHEELED, "multirotor", "aeroplane"])
def test_what_stands_on_the_ground_starts_and_ends_at_rest(name: str) -> None:
    path = trajectory(name)
    ends = path.motion([0.0, path.duration])
    assert np.abs(ends.velocity_map).max() < 1e-9
    assert np.abs(ends.angular_rate_body).max() < 1e-9
    assert np.abs(roll_pitch_yaw(ends)[:, :2]).max() < 0.06
    standing = path.motion(np.linspace(0.0, 10.0, 50))
    np.testing.assert_allclose(standing.position_map, 0.0, atol=1e-9)


def test_durations() -> None:
    assert trajectory("hour_drive").duration == pytest.approx(3600.0, abs=1.0)
    assert 270.0 < trajectory("drive").duration < 330.0
    assert all(120.0 < trajectory(name).duration <= 600.0 for name in SHORT if name != "garage")
    assert 720.0 < trajectory("garage").duration < 900.0


# --------------------------------------------------------------------------------------------------------------- cars


def test_heading_follows_the_velocity_and_the_body_leans_outward() -> None:
    path = DriveTrajectory([SpeedTo(10.0, 2.0), Hold(5.0), Turn(90.0, 2.0), SpeedTo(0.0, 2.0)], heading_deg=30.0)
    t = np.arange(0.5, path.duration - 0.5, 0.1)
    motion = path.motion(t)
    rpy = roll_pitch_yaw(motion)
    track = np.arctan2(motion.velocity_map[:, 1], motion.velocity_map[:, 0])
    np.testing.assert_allclose(rpy[:, 2], track, atol=1e-12)
    assert math.degrees(rpy[0, 2]) == pytest.approx(30.0)
    assert math.degrees(rpy[-1, 2]) == pytest.approx(120.0)
    # In a turn to the left the right side goes down; braking lowers the nose. REP-103: both positive.
    left = np.argmax(motion.angular_rate_body[:, 2])
    assert math.degrees(rpy[left, 0]) == pytest.approx(4.0 * 2.0 / 9.80665, rel=0.02)
    flat = DriveTrajectory([SpeedTo(10.0), SpeedTo(0.0)], hills=())
    braking = flat.motion(flat.duration - 2.5)
    assert math.degrees(attitude(braking).as_euler("ZYX")[0, 1]) == pytest.approx(2.0 * 2.0 / 9.80665, rel=1e-6)


def test_impossible_instructions_are_refused() -> None:
    for instructions, expected in (
        ([Turn(90.0)], "turns only while it moves"),
        ([SpeedTo(5.0), SpeedTo(5.0)], "differ from the present one"),
        ([Hold(0.0)], "must be positive"),
        ([SpeedTo(2.0), TurnInPlace(90.0)], "only what stands turns in place"),
        ([ClimbTo(5.0)], "only what moves climbs"),
    ):
        with pytest.raises(ValueError, match=expected):
            AeroplaneTrajectory(instructions)
    with pytest.raises(ValueError, match="must be positive"):
        MultirotorTrajectory([Leg(0.0)])
    for path in (DriveTrajectory([Hold(2.0)]), AeroplaneTrajectory([Hold(2.0)]), MultirotorTrajectory([Leg(2.0)])):
        with pytest.raises(ValueError, match="within the trajectory"):
            path.motion(2.1)


def test_reverse_start_drives_backwards_first_and_turns_as_a_car_does() -> None:
    _, motion = sampled("reverse_start")
    forward = body_axes(motion, motion.velocity_map)
    moving = np.flatnonzero(np.abs(forward[:, 0]) > 0.1)
    assert forward[moving[0], 0] < 0.0
    assert forward[:, 0].min() == pytest.approx(-2.0, abs=0.01)
    assert forward[:, 0].max() > 10.0
    np.testing.assert_allclose(forward[:, 1], 0.0, atol=0.02)
    backing = (forward[:, 0] < -1.9) & (motion.angular_rate_body[:, 2] > 0.1)
    assert backing.sum() > 20
    # The centre of the turn lies to the right of a car that turns left while it backs up.
    leftward = body_axes(motion, motion.acceleration_map)[backing, 1]
    assert leftward.max() < -0.1
    assert leftward.min() == pytest.approx(-1.0, abs=0.03)


def test_parked_stands_for_ten_minutes_and_motorway_moves_without_any_change() -> None:
    _, parked = sampled("parked", 1.0)
    assert trajectory("parked").duration == 600.0
    for quantity in ("position_map", "velocity_map", "acceleration_map", "angular_rate_body"):
        assert not getattr(parked, quantity).any()
    t, motorway = sampled("motorway", 1.0)
    np.testing.assert_allclose(np.linalg.norm(motorway.velocity_map, axis=1), 33.0, rtol=1e-14)
    assert not np.ptp(motorway.velocity_map, axis=0).any()
    assert not motorway.acceleration_map.any()
    assert not motorway.angular_rate_body.any()
    np.testing.assert_allclose(motorway.position_map, t[:, None] * motorway.velocity_map, atol=1e-8)


def test_every_family_has_a_scenario_here() -> None:
    assert set(NUMBERED) == set(FAMILIES)
    for name in ("creep", "creep:", "creep:fast", "creep:-1", "creep:nan"):
        with pytest.raises(ValueError, match="wants a positive number of m/s"):
            scenario(name)


def test_what_creeps_goes_straight_on_without_a_shock() -> None:
    _, motion = sampled("creep:0.1")
    speed = np.linalg.norm(motion.velocity_map, axis=1)
    assert speed.max() == pytest.approx(0.1, rel=1e-9)
    assert np.count_nonzero(speed > 0.0999) > 20 * 200
    assert np.linalg.norm(motion.acceleration_map, axis=1).max() < 0.15
    assert not motion.angular_rate_body[:, 2].any()


def test_slow_turns_turn_at_the_rate_told_and_do_not_move() -> None:
    _, motion = sampled("slow_turn:0.2")
    rate = np.degrees(motion.angular_rate_body[:, 2])
    assert np.count_nonzero(np.abs(rate - 0.2) < 1e-9) > 20 * 190
    assert not motion.velocity_map.any()


def test_a_boat_in_a_current_from_the_side_crabs_by_the_angle_told() -> None:
    _, motion = sampled("crab:40")
    cruising = slice(20 * 40, 20 * 110)
    course = motion.velocity_map[cruising].mean(axis=0)
    heading = motion.rotation_body_to_map[cruising, :, 0].mean(axis=0)
    off = math.degrees(math.atan2(course[1], course[0]) - math.atan2(heading[1], heading[0]))
    assert off == pytest.approx(40.0, abs=0.5)


def test_wheels_that_do_not_steer_slip_in_bends() -> None:
    _, motion = sampled("skid_steer:0.8")
    velocity = body_axes(motion, motion.velocity_map)
    slip = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0]))[np.abs(velocity[:, 0]) > 0.7]
    assert 6.0 < np.abs(slip).max() < 12.0
    standing = np.linalg.norm(motion.velocity_map, axis=1) < 1e-9
    assert np.degrees(np.abs(motion.angular_rate_body[standing, 2]).max()) > 25.0, "it turns in place"


def test_trains_are_smooth_and_fast_starts_are_fast_from_the_start() -> None:
    _, train = sampled("train:30")
    assert np.linalg.norm(train.acceleration_map, axis=1).max() < 0.6
    assert np.degrees(np.abs(train.angular_rate_body[:, 2]).max()) < 1.0
    _, fast = sampled("fast_start:250")
    assert np.linalg.norm(fast.velocity_map[0]) == pytest.approx(250.0)
    assert np.linalg.norm(fast.acceleration_map, axis=1).max() < 2.5


def test_field_robot_turns_in_place() -> None:
    _, motion = sampled("field_robot")
    speed = np.linalg.norm(motion.velocity_map, axis=1)
    assert 0.9 < speed.max() < 1.1
    turning = np.abs(motion.angular_rate_body[:, 2]) > 0.01
    assert turning.sum() > 20 * 40
    assert speed[turning].max() < 1e-9
    assert np.degrees(np.abs(motion.angular_rate_body[:, 2]).max()) == pytest.approx(40.0, abs=0.5)
    assert np.degrees(np.ptp(roll_pitch_yaw(motion)[:, 1])) > 5.0, "the ground is uneven"


def test_wheels_turn_while_a_robot_turns_in_place() -> None:
    wheel = simulate("field_robot", 1, imu_rate=10.0, wheel=WheelOdometer()).wheel
    assert wheel is not None
    yaw_rate = trajectory("field_robot").motion(seconds(wheel.stamp)).angular_rate_body[:, 2]
    turning = np.abs(yaw_rate) > 0.01
    assert_chi_square((wheel.yaw_rate / wheel.yaw_rate_scale - yaw_rate)[turning] * wheel.yaw_rate_scale / 0.01)
    assert_chi_square(wheel.speed[turning] / 0.03)


# --------------------------------------------------------------------------------------------------------------- walk


def test_a_walker_bobs_twice_and_sways_once_a_stride() -> None:
    path = trajectory("walk")
    t = np.arange(22.0, 42.0, 0.01)  # straight on at 1.4 m/s
    motion = path.motion(t)
    assert np.linalg.norm(motion.velocity_map[:, :2].mean(axis=0)) == pytest.approx(1.4, abs=0.02)
    course = motion.velocity_map[:, :2].mean(axis=0)
    across = motion.acceleration_map[:, :2] @ np.array([-course[1], course[0]]) / np.linalg.norm(course)

    def frequency(signal: Array) -> float:
        spectrum = np.abs(np.fft.rfft(signal - signal.mean()))
        return float(np.fft.rfftfreq(len(signal), 0.01)[np.argmax(spectrum)])

    assert frequency(motion.acceleration_map[:, 2]) == pytest.approx(2.0 * 1.4 / walk.STRIDE, abs=0.06)
    assert frequency(across) == pytest.approx(1.4 / walk.STRIDE, abs=0.06)
    assert 2.0 < motion.acceleration_map[:, 2].std() < 4.0


def test_a_walker_who_stands_has_no_gait_but_is_not_quite_still() -> None:
    t = np.arange(1.0, 14.0, 0.05)
    standing = trajectory("walk").motion(t)
    assert 1e-4 < np.linalg.norm(standing.velocity_map, axis=1).max() < 0.05
    assert np.abs(standing.acceleration_map).max() < 0.1
    assert 1e-3 < np.linalg.norm(standing.angular_rate_body, axis=1).max() < 0.1


def test_a_walker_does_not_point_where_he_walks() -> None:
    _, motion = sampled("walk")
    walking = np.linalg.norm(motion.velocity_map[:, :2], axis=1) > 1.0
    course = np.arctan2(motion.velocity_map[walking, 1], motion.velocity_map[walking, 0])
    off = np.angle(np.exp(1j * (roll_pitch_yaw(motion)[walking, 2] - course)))
    assert 5.0 < np.degrees(off.std()) < 15.0
    assert np.degrees(roll_pitch_yaw(motion)[:, 1].mean()) == pytest.approx(20.0, abs=2.0)
    np.testing.assert_allclose(WalkTrajectory([Hold(5.0)], 80.0).motion(0.0).position_map[0], motion.position_map[0])


# --------------------------------------------------------------------------------------------------------- multirotor


def test_multirotor_moves_sideways_and_backwards() -> None:
    _, motion = sampled("multirotor")
    velocity = body_axes(motion, motion.velocity_map)
    speed = np.linalg.norm(motion.velocity_map[:, :2], axis=1)
    sideways = (np.abs(velocity[:, 1]) > 3.0) & (np.abs(velocity[:, 0]) < 0.5 * np.abs(velocity[:, 1]))
    assert sideways.sum() / 20.0 > 5.0, "seconds"
    assert velocity[:, 0].min() < -3.0
    along = np.abs(velocity[speed > 2.0, 0]) / speed[speed > 2.0]
    assert along.mean() < 0.7, "its course says little of its heading"
    assert motion.position_map[:, 2].max() > 15.0


def test_multirotor_is_pushed_along_its_own_z_axis_and_by_the_air() -> None:
    """Specific force less drag, from the equation of motion, is thrust: it has no part across the body's z axis."""
    path = trajectory("multirotor")
    t = np.linspace(35.0, 100.0, 500)  # in the air
    motion = path.motion(t)
    force_body, _ = ideal_samples(path, FRAME, t)
    wind = np.array([*multirotor.WIND, 0.0])
    gust = 0.8 * np.sin(2.0 * np.pi * t / 9.0) + 0.4 * np.sin(2.0 * np.pi * t / 3.7 + 1.0)
    air = wind + np.stack([gust, gust, np.zeros_like(t)], axis=-1)
    drag = -multirotor.DRAG * (motion.velocity_map - air) * [1.0, 1.0, 0.0]
    thrust = force_body - body_axes(motion, drag)
    # Coriolis force and the bend of gravity are not in it: 2e-3 m/s2.
    np.testing.assert_allclose(thrust[:, :2], 0.0, atol=4e-3)
    assert np.abs(force_body[:, :2]).max() > 1.0, "without drag this would say little"


def test_multirotor_hovers_leaning_against_the_wind_and_drifts() -> None:
    motion = trajectory("multirotor").motion(np.linspace(28.0, 43.0, 600))
    lean = motion.rotation_body_to_map[:, :2, 2].mean(axis=0)
    wind = np.array(multirotor.WIND)
    assert lean @ wind / np.linalg.norm(lean) / np.linalg.norm(wind) < -0.98
    assert np.linalg.norm(lean) == pytest.approx(multirotor.DRAG * np.linalg.norm(wind) / 9.80665, rel=0.15)
    assert 0.5 < np.ptp(motion.position_map[:, 0]) < 3.0
    assert motion.position_map[:, 2].mean() == pytest.approx(12.0, abs=0.3)


def test_multirotor_stands_level_before_take_off_and_after_landing() -> None:
    path = MultirotorTrajectory(
        [Leg(3.0), TakeOff(5.0, (0, 0, 9.0)), Leg(5.0), Land(6.0, (0, 0, -9.0)), Leg(4.0)], 30.0
    )
    for t in (np.linspace(0.0, 3.0, 20), np.linspace(19.0, 23.0, 20)):
        motion = path.motion(t)
        np.testing.assert_allclose(motion.position_map, 0.0, atol=1e-12)
        np.testing.assert_allclose(roll_pitch_yaw(motion), np.tile([0.0, 0.0, math.radians(30.0)], (20, 1)), atol=1e-12)
    assert path.motion(10.0).position_map[0, 2] > 8.5


# ---------------------------------------------------------------------------------------------------------- aeroplane


def test_aeroplane_turns_are_coordinated() -> None:
    path = trajectory("aeroplane")
    t, motion = sampled("aeroplane")
    force_body, _ = ideal_samples(path, FRAME, t)
    # Coriolis force and the bend of gravity over 4 km are not in the bank.
    np.testing.assert_allclose(force_body[:, 1], 0.0, atol=0.02)
    rpy = roll_pitch_yaw(motion)
    # Level turns at 45 m/s: tan(bank) = V yaw_rate / g, left wing down (REP-103: negative) in a turn to the left.
    yaw_rate = (attitude(motion).apply(motion.angular_rate_body))[:, 2]
    steady = (np.abs(np.gradient(rpy[:, 0], t)) < 0.003) & (np.abs(yaw_rate) > 0.04)
    assert steady.sum() > 200
    np.testing.assert_allclose(np.tan(rpy[steady, 0]), -45.0 * yaw_rate[steady] / 9.80665, atol=0.02)
    assert np.degrees(rpy[:, 0].min()) < -20.0
    assert np.degrees(rpy[:, 0].max()) > 15.0


coefficients = st.floats(-0.15, 0.15)


@given(st.lists(st.tuples(coefficients, coefficients, coefficients, coefficients), min_size=4, max_size=4))
def test_aeroplane_is_coordinated_whatever_it_does_at_once(rows: list[tuple[float, ...]]) -> None:
    """Gaining speed in a climbing turn while the wings take over, too."""
    speed, yaw, climb, lift = (Taylor(np.array(row)[:, None]) for row in rows)
    speed, lift = 5.0 * speed + 40.0, lift + 0.5
    path = AeroplaneTrajectory([Hold(1.0)])
    zero = np.zeros(1)
    state = PathState(Taylor(np.array([[0.0], [1.0], [0.0], [0.0]])), speed.integral(zero), speed, yaw, climb, lift)
    way = [rate.integral(zero) for rate in path.velocity(state)]
    motion = moving_body(*path.pose(state, way))
    force = body_axes(motion, motion.acceleration_map + [0.0, 0.0, 9.80665])
    assert force[0, 1] == pytest.approx(0.0, abs=1e-9)
    assert force[0, 2] > 0.0


def test_aeroplane_climbs_flies_in_wind_and_lands_where_it_is_as_high() -> None:
    t, motion = sampled("aeroplane")
    height = motion.position_map[:, 2]
    assert height.max() > 100.0
    assert height[-1] == pytest.approx(0.0, abs=1e-6)
    assert height.min() > -1e-6
    flying = height > 50.0
    forward = attitude(motion).apply([1.0, 0.0, 0.0])
    through_air = motion.velocity_map - np.array([*aeroplane.WIND, 0.0])
    # Neither the angle of attack nor the bank of a climbing turn let the nose leave the way through the air far.
    along = np.sum(forward * through_air, axis=1) / np.linalg.norm(through_air, axis=1)
    assert np.degrees(np.arccos(along[flying])).max() < 9.0
    np.testing.assert_allclose(body_axes(motion, through_air)[flying, 1], 0.0, atol=1e-9)
    course = np.arctan2(motion.velocity_map[:, 1], motion.velocity_map[:, 0])
    crab = np.angle(np.exp(1j * (roll_pitch_yaw(motion)[:, 2] - course)))
    assert np.degrees(np.abs(crab[flying])).max() > 5.0
    rolling = (height < 0.01) & (np.linalg.norm(motion.velocity_map, axis=1) > 1.0) & (t < 28.0)
    assert rolling.sum() > 50
    np.testing.assert_allclose(crab[rolling], 0.0, atol=1e-9)


# --------------------------------------------------------------------------------------------------------------- boat


def test_boat_heaves_rolls_and_pitches_in_the_waves() -> None:
    t, motion = sampled("boat")
    rpy = np.degrees(roll_pitch_yaw(motion))
    for signal, spread in ((motion.position_map[:, 2], 0.2), (rpy[:, 0], 4.5), (rpy[:, 1], 1.9)):
        assert signal.std() == pytest.approx(spread, rel=0.15)
        assert abs(signal.mean()) < 0.1 * spread
    crossings = np.count_nonzero(np.diff(np.sign(rpy[:, 0])))
    assert crossings / (2.0 * t[-1]) == pytest.approx(0.19, abs=0.03)
    assert np.linalg.norm(motion.velocity_map, axis=1).min() > 0.01, "never at rest"
    assert np.linalg.norm(motion.velocity_map, axis=1).max() < 4.0


def test_boat_drifts_with_the_current() -> None:
    path = trajectory("boat")
    for begin, end in ((0.0, 40.0), (path.duration - 55.0, path.duration)):
        ends = path.motion([begin, end])
        drift = np.diff(ends.position_map, axis=0)[0, :2] / (end - begin)
        np.testing.assert_allclose(drift, boat.CURRENT, atol=0.03)
    motion = path.motion(np.linspace(55.0, 105.0, 1000))  # straight on at 2.5 m/s through the water
    heading = roll_pitch_yaw(motion)[:, 2].mean()
    expected = 2.5 * np.array([math.cos(heading), math.sin(heading)]) + boat.CURRENT
    np.testing.assert_allclose(motion.velocity_map[:, :2].mean(axis=0), expected, atol=0.03)


# ------------------------------------------------------------------------------------------------------------- Taylor


def polynomials(lowest: float = -2.0) -> st.SearchStrategy[Taylor]:
    """Random Taylor coefficients of order 4 at three times; the value is at least ``lowest``."""
    value = st.floats(lowest, 3.0)
    other = st.floats(-2.0, 2.0)
    row = st.tuples(value, other, other, other, other)
    return st.lists(row, min_size=3, max_size=3).map(lambda rows: Taylor(np.array(rows).T))


def at(series: Taylor, h: float) -> Array:
    """The Taylor polynomial a little later."""
    return np.asarray(np.polynomial.polynomial.polyval(h, series.c))


@given(a=polynomials(), b=polynomials(0.5), h=st.floats(-1e-3, 1e-3))
def test_taylor_arithmetic_is_that_of_the_functions(a: Taylor, b: Taylor, h: float) -> None:
    # What is left out is of order h^5.
    sine, cosine = sin_cos(a)
    x, y = at(a, h), at(b, h)
    for series, function in (
        (a + b, x + y),
        (2.0 - a, 2.0 - x),
        (a - 1.5, x - 1.5),
        (a * b, x * y),
        (a / b, x / y),
        (sine, np.sin(x)),
        (cosine, np.cos(x)),
        (sqrt(b), np.sqrt(y)),
        (arctan2(a, b), np.arctan2(x, y)),
    ):
        np.testing.assert_allclose(at(series, h), function, atol=1e-10)


@given(a=polynomials())
def test_taylor_derivative_and_integral_undo_each_other(a: Taylor) -> None:
    slope = a.derivative()
    assert slope.order == a.order - 1
    np.testing.assert_allclose(slope.integral(a.c[0]).c, a.c)
    np.testing.assert_allclose(Taylor.of_derivatives([a.c[0], a.c[1], 2.0 * a.c[2], 6.0 * a.c[3]]).c, a.c[:4])


def test_turns_follow_each_other_about_the_axes_reached() -> None:
    angles = (0.4, -0.7, 1.1, 0.3)
    constants = [Taylor(np.array([[angle], [0.0], [0.0]])) for angle in angles]
    turns = list(zip("zyxy", constants))
    found = attitude(moving_body(constants[:3], turns))
    expected = Rotation.from_euler("ZYX", angles[:3]) * Rotation.from_euler("Y", angles[3])
    assert (found[0].inv() * expected).magnitude() < 1e-14
