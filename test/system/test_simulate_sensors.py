"""The simulated aids measure what an independent look at the truth says, with the errors they declare."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from eskf_ros.simulate import main as command
from eskf_ros.simulate.barometer import Barometer
from eskf_ros.simulate.body_velocity import BodyVelocity
from eskf_ros.simulate.dual_antenna import DualAntenna
from eskf_ros.simulate.episodes import MagneticDisturbance, Outage, WheelSlip
from eskf_ros.simulate.gnss import GnssReceiver
from eskf_ros.simulate.magnetometer import Magnetometer
from eskf_ros.simulate.scenario import DATUM, Recording, simulate, trajectory
from eskf_ros.simulate.wheel import WheelOdometer
from support.simulated import TOPICS, antenna_errors, assert_chi_square, attitude, read, seconds

Array = NDArray[np.float64]

ALL_SENSORS = {
    "second_gnss": GnssReceiver(),
    "dual_antenna": DualAntenna(),
    "wheel": WheelOdometer(),
    "magnetometer": Magnetometer(hard_iron_std=5e-6),
    "barometer": Barometer(),
    "body_velocity": BodyVelocity(),
}
SHORT = {"stop": 60.0, "imu_rate": 50.0}


def body_velocity_of(stamps: NDArray[np.int64], position: tuple[float, float, float], name: str = "drive") -> Array:
    """Velocity over ground of a point of the body, in body axes: the difference of its positions."""
    path, t, h = trajectory(name), seconds(stamps), 1e-3
    t = np.clip(t, h, path.duration - h)
    ends = [path.motion(t + side).position_map + attitude(path.motion(t + side)).apply(position) for side in (-h, h)]
    return attitude(path.motion(t)).inv().apply((ends[1] - ends[0]) / (2.0 * h))


def altitude_of(stamps: NDArray[np.int64], position: tuple[float, float, float], name: str = "drive") -> Array:
    motion = trajectory(name).motion(seconds(stamps))
    point = motion.position_map + attitude(motion).apply(position)
    return np.asarray(pymap3d.enu2geodetic(*point.T, *DATUM)[2])


def enu_axes(stamps: NDArray[np.int64], vectors_body: Array, name: str = "drive") -> Array:
    """Vectors in body axes as east, north, up at the body, by way of pymap3d."""
    motion = trajectory(name).motion(seconds(stamps))
    latitude, longitude, _ = pymap3d.enu2geodetic(*motion.position_map.T, *DATUM)
    ecef = pymap3d.enu2ecefv(*attitude(motion).apply(vectors_body).T, DATUM[0], DATUM[1])
    return np.stack(pymap3d.ecef2enuv(*ecef, latitude, longitude), axis=-1)


# ------------------------------------------------------------------------------------------------------------ wheels


def test_wheels_give_the_forward_speed_of_their_point_and_the_yaw_rate() -> None:
    position = (0.4, 0.8, -0.3)
    sensor = WheelOdometer(position, scale_error=0.03, scale_std=0.0, yaw_rate_scale_std=0.0)
    wheel = simulate("drive", 1, wheel=sensor).wheel
    assert wheel is not None
    assert wheel.scale == 1.03
    truth = body_velocity_of(wheel.stamp, position)
    moving = np.abs(truth[:, 0]) > 0.01
    assert_chi_square((wheel.speed / 1.03 - truth[:, 0])[moving] / (0.03 / 1.03))
    turning = np.abs(truth[:, 0] - body_velocity_of(wheel.stamp, (0.0, 0.0, 0.0))[:, 0]) > 0.2
    assert turning.sum() > 200, "the lever arm must matter for this test to see it"
    yaw_rate = trajectory("drive").motion(seconds(wheel.stamp)).angular_rate_body[:, 2]
    assert_chi_square((wheel.yaw_rate - yaw_rate)[moving] / 0.01)
    assert (wheel.speed_variance, wheel.yaw_rate_variance) == pytest.approx((9e-4, 1e-4))


def test_standing_wheels_give_exactly_zero_and_rolling_ones_never() -> None:
    wheel = simulate("drive", 1, wheel=WheelOdometer((0.4, 0.8, 0.0))).wheel
    assert wheel is not None
    speed = np.linalg.norm(trajectory("drive").motion(seconds(wheel.stamp)).velocity_map, axis=1)
    standing = speed < 1e-9
    assert standing.sum() > 50 * 40
    assert not wheel.speed[standing].any()
    assert not wheel.yaw_rate[standing].any()
    assert wheel.speed[speed > 1e-6].all()
    assert wheel.yaw_rate[speed > 1e-6].all()


def test_scale_factors_of_the_wheels_are_drawn_as_declared() -> None:
    sensor = WheelOdometer(scale_error=0.02, scale_std=0.005, yaw_rate_scale_std=0.01)
    wheels = [simulate("drive", seed, stop=1.0, imu_rate=10.0, wheel=sensor).wheel for seed in range(200)]
    assert_chi_square(np.array([(wheel.scale - 1.02) / 0.005 for wheel in wheels if wheel]))
    assert_chi_square(np.array([(wheel.yaw_rate_scale - 1.0) / 0.01 for wheel in wheels if wheel]))


def test_wheel_speed_comes_in_steps() -> None:
    plain, stepped = (
        simulate("drive", 1, wheel=WheelOdometer(speed_quantum=quantum), **SHORT).wheel for quantum in (0.0, 0.25)
    )
    assert plain is not None
    assert stepped is not None
    np.testing.assert_array_equal(stepped.speed / 0.25, np.round(stepped.speed / 0.25))
    assert 0.12 < np.abs(stepped.speed - plain.speed).max() <= 0.125
    assert stepped.speed_variance == pytest.approx(0.03**2 + 0.25**2 / 12.0)


def test_wheels_slip_in_their_episodes_only() -> None:
    # The car turns from 45 s to 49 s and from 54 s to 57 s, and stands until 20 s.
    slips = (WheelSlip(46.0, 2.0, factor=1.3), WheelSlip(54.5, 2.0, factor=0.0), WheelSlip(4.0, 2.0, speed=1.5))
    plain, slipping = (
        simulate("drive", 1, wheel=WheelOdometer(), episodes=episodes, **SHORT).wheel for episodes in ((), slips)
    )
    assert plain is not None
    assert slipping is not None
    t = seconds(plain.stamp)
    spinning, locked, on_the_spot = ((t >= slip.start) & (t < slip.start + slip.length) for slip in slips)
    true_speed = body_velocity_of(plain.stamp, (0.0, 0.0, 0.0))[:, 0]
    true_yaw_rate = trajectory("drive").motion(t).angular_rate_body[:, 2]
    assert true_yaw_rate[spinning | locked].min() > 0.1
    for quantity, scale, truth in (
        ("speed", plain.scale, true_speed),
        ("yaw_rate", plain.yaw_rate_scale, true_yaw_rate),
    ):
        added = getattr(slipping, quantity) - getattr(plain, quantity)
        np.testing.assert_allclose(added[spinning], 0.3 * scale * truth[spinning], rtol=1e-6)
    assert not slipping.speed[locked].any()
    assert not slipping.yaw_rate[locked].any()
    assert slipping.speed[on_the_spot].mean() == pytest.approx(1.5 * plain.scale, abs=0.02)
    elsewhere = ~(spinning | locked | on_the_spot)
    np.testing.assert_array_equal(slipping.speed[elsewhere], plain.speed[elsewhere])


# ------------------------------------------------------------------------------------------------------ magnetometer


def test_magnetometer_sees_the_field_of_the_earth_by_its_declination_and_inclination() -> None:
    rpy = (10.0, -20.0, 130.0)
    sensor = Magnetometer(-12.0, 70.0, 55e-6, rpy_deg=rpy, noise_std=0.0)
    magnetometer = simulate("drive", 1, magnetometer=sensor).magnetometer
    assert magnetometer is not None
    np.testing.assert_allclose(np.linalg.norm(magnetometer.field, axis=1), 55e-6, rtol=1e-12)
    in_body = Rotation.from_euler("xyz", rpy, degrees=True).apply(magnetometer.field)
    east, north, up = enu_axes(magnetometer.stamp, in_body).T
    np.testing.assert_allclose(np.degrees(np.arctan2(east, north)), -12.0, atol=1e-8)
    np.testing.assert_allclose(np.degrees(np.arctan2(-up, np.hypot(east, north))), 70.0, atol=1e-8)
    assert np.ptp(magnetometer.field, axis=0).max() > 35e-6, "the drive must turn the sensor"


def test_hard_iron_lies_in_the_axes_of_the_magnetometer() -> None:
    sensor = Magnetometer(rpy_deg=(0.0, 0.0, 90.0), hard_iron=(20e-6, -5e-6, 8e-6), noise_std=0.2e-6)
    iron, clean = (
        simulate("drive", 1, magnetometer=magnetometer, **SHORT).magnetometer
        for magnetometer in (sensor, dataclasses.replace(sensor, hard_iron=(0.0, 0.0, 0.0), noise_std=0.0))
    )
    assert iron is not None
    assert clean is not None
    np.testing.assert_array_equal(iron.hard_iron, sensor.hard_iron)
    assert_chi_square((iron.field - clean.field - sensor.hard_iron) / 0.2e-6)
    sensor = Magnetometer(hard_iron=(1e-6, 2e-6, 3e-6), hard_iron_std=4e-6)
    drawn = [simulate("drive", seed, magnetometer=sensor, stop=1.0, imu_rate=10.0).magnetometer for seed in range(70)]
    assert_chi_square(np.array([(one.hard_iron - sensor.hard_iron) / 4e-6 for one in drawn if one]))


def test_a_magnetic_disturbance_is_fixed_to_the_ground() -> None:
    disturbance = MagneticDisturbance(30.0, 10.0, (15e-6, -4e-6, 7e-6))
    plain, disturbed = (
        simulate("drive", 1, magnetometer=Magnetometer(), episodes=episodes, **SHORT).magnetometer
        for episodes in ((), (disturbance,))
    )
    assert plain is not None
    assert disturbed is not None
    added = attitude(trajectory("drive").motion(seconds(plain.stamp))).apply(disturbed.field - plain.field)
    inside = (seconds(plain.stamp) >= 30.0) & (seconds(plain.stamp) < 40.0)
    np.testing.assert_allclose(added[inside], np.tile(disturbance.field, (500, 1)), atol=1e-16)
    assert not added[~inside].any()


# --------------------------------------------------------------------------------------------------------- barometer


def hydrostatic_altitude(pressure: Array, qnh: float) -> Array:
    """Altitude (m) of pressures (Pa) in an atmosphere of 15 degC at the bottom, colder by 6.5 K/km, at rest.

    dh = -dp / (rho g) with the ideal gas of molar mass 28.9644 g/mol, integrated numerically.
    """

    def slope(p: float, h: Array) -> Array:
        density = p * 0.0289644 / (8.31432 * (288.15 - 0.0065 * h))
        return np.asarray(-1.0 / (density * 9.80665))

    span = (qnh, float(pressure.min()))
    solution = solve_ivp(slope, span, [0.0], method="DOP853", dense_output=True, rtol=1e-12, atol=1e-9)
    return np.asarray(solution.sol(pressure)[0])


def test_barometer_gives_the_height_of_a_standard_atmosphere() -> None:
    position = (0.0, 0.0, 1.2)
    sensor = Barometer(position, qnh=99800.0, drift=0.0, noise_std=0.0)
    barometer = simulate("drive", 1, barometer=sensor).barometer
    assert barometer is not None
    height = hydrostatic_altitude(barometer.pressure, 99800.0)
    truth = altitude_of(barometer.stamp, position)
    np.testing.assert_allclose(height, truth, atol=1e-5)
    assert np.ptp(truth) > 5.0
    assert np.abs(altitude_of(barometer.stamp, (0.0, 0.0, 0.0)) - truth).min() > 1.1


def test_barometer_height_errors_are_noise_and_drift_as_declared() -> None:
    sensor = Barometer(noise_std=4.0, drift=0.7)
    ideal = simulate("drive", 1, barometer=dataclasses.replace(sensor, noise_std=0.0, drift=0.0)).barometer
    barometer = simulate("drive", 1, barometer=sensor).barometer
    assert ideal is not None
    assert barometer is not None
    error = barometer.pressure - ideal.pressure
    assert_chi_square((error - barometer.drift) / 4.0)
    assert barometer.drift[0] == 0.0
    assert_chi_square(np.diff(barometer.drift) / (0.7 / math.sqrt(20.0)))
    # In metres: 1 Pa is 8.8 cm at this height.
    height_error = hydrostatic_altitude(barometer.pressure, sensor.qnh) - altitude_of(barometer.stamp, sensor.position)
    np.testing.assert_allclose(height_error, -0.088 * error, atol=0.02 * np.abs(error).max())
    runs = [simulate("drive", seed, barometer=sensor, imu_rate=2.0).barometer for seed in range(40)]
    assert_chi_square(np.array([run.drift[-1] / (0.7 * math.sqrt(seconds(run.stamp)[-1])) for run in runs if run]))


# ---------------------------------------------------------------------------------------------- heading and velocity


@pytest.mark.parametrize("baseline", [(1.0, 0.0, 0.0), (0.0, -0.8, 0.1), (-0.5, 0.5, 0.4)])
def test_dual_antenna_gives_the_yaw_of_its_baseline(baseline: tuple[float, float, float]) -> None:
    recording = simulate("drive", 1, dual_antenna=DualAntenna(baseline, yaw_std_deg=0.5))
    heading = recording.dual_antenna
    assert heading is not None
    np.testing.assert_array_equal(heading.stamp, recording.fix_stamp)
    assert not np.array_equal(heading.arrival, recording.fix_arrival)
    east, north, _ = enu_axes(heading.stamp, np.tile(baseline, (len(heading.stamp), 1))).T
    error = np.angle(np.exp(1j * (heading.yaw - np.arctan2(north, east))))
    assert_chi_square(error / math.radians(0.5))
    assert np.abs(heading.yaw).max() <= math.pi
    assert np.ptp(heading.yaw) > 5.0
    assert (heading.pitch == 0.0).all()


def test_dual_antenna_gives_the_pitch_of_its_baseline_if_asked() -> None:
    baseline = (0.9, 0.2, 0.3)
    heading = simulate("drive", 1, dual_antenna=DualAntenna(baseline, pitch_std_deg=0.8)).dual_antenna
    assert heading is not None
    east, north, up = enu_axes(heading.stamp, np.tile(baseline, (len(heading.stamp), 1))).T
    assert_chi_square((heading.pitch - np.arctan2(-up, np.hypot(east, north))) / math.radians(0.8))


def test_body_velocity_is_that_of_its_point_in_body_axes() -> None:
    position = (1.5, -0.6, 0.2)
    sensor = BodyVelocity(position, std=(0.05, 0.1, 0.2))
    measured = simulate("drive", 1, body_velocity=sensor).body_velocity
    assert measured is not None
    truth = body_velocity_of(measured.stamp, position)
    for axis, std in enumerate(sensor.std):
        assert_chi_square((measured.velocity - truth)[:, axis] / std)
    assert np.abs(truth[:, 1]).max() > 0.3, "in a turn a point ahead of the rear axle moves sideways"
    np.testing.assert_allclose(measured.variance, [0.0025, 0.01, 0.04])


@pytest.mark.parametrize("axes", ["x", "xy", "z"])
def test_body_velocity_without_some_axes(axes: str) -> None:
    whole, part = (
        simulate("drive", 1, body_velocity=BodyVelocity(axes=chosen), **SHORT).body_velocity for chosen in ("xyz", axes)
    )
    assert whole is not None
    assert part is not None
    for number, axis in enumerate("xyz"):
        if axis in axes:
            np.testing.assert_array_equal(part.velocity[:, number], whole.velocity[:, number])
            assert part.variance[number] > 0.0
        else:
            assert not part.velocity[:, number].any()
            assert part.variance[number] == -1.0


def test_second_receiver_has_its_own_antenna_and_errors() -> None:
    receiver = GnssReceiver((-1.0, 0.6, 1.1), rate=5.0, position_std=(0.5, 0.8), velocity_std=(0.05, 0.07))
    recording = simulate("drive", 1, second_gnss=receiver)
    second = recording.second_gnss
    assert second is not None
    errors = antenna_errors("drive", second, receiver.lever_arm)
    for error, std in zip(errors, (receiver.position_std, receiver.velocity_std)):
        for axis in range(3):
            assert_chi_square(error[:, axis] / std[axis // 2])
    first = antenna_errors("drive", recording, recording.options.lever_arm)[0]
    assert np.abs(np.mean(first * errors[0], axis=0)).max() < 5.0 * 1.5 * 0.8 / math.sqrt(len(first))
    np.testing.assert_allclose(second.fix_covariance[0], np.diag([0.25, 0.25, 0.64]).ravel())


def test_outages_take_everything_that_comes_from_satellites() -> None:
    recording = simulate("drive", 1, outages=((10.0, 20.0),), episodes=(Outage(40.0, 5.0),), **SHORT, **ALL_SENSORS)
    assert recording.outages == ((10.0, 20.0), (40.0, 45.0))
    assert recording.second_gnss is not None
    assert recording.dual_antenna is not None
    for stamp in (
        recording.fix_stamp,
        recording.velocity_stamp,
        recording.second_gnss.fix_stamp,
        recording.second_gnss.velocity_stamp,
        recording.dual_antenna.stamp,
    ):
        t = seconds(stamp)
        assert not (((t > 10.0) & (t < 20.0)) | ((t > 40.0) & (t < 45.0))).any()
        assert len(t) == 5 * 45


# --------------------------------------------------------------------------------------------------------- IMU faults


def test_a_driver_that_removes_gravity() -> None:
    plain, faulty = (
        simulate("drive", 1, gravity_removed=removed, imu_rpy_deg=(5.0, 0.0, 90.0), **SHORT)
        for removed in (False, True)
    )
    gravity = plain.specific_force - faulty.specific_force
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 9.8074, atol=1e-3)
    turned = attitude(trajectory("drive").motion(seconds(plain.imu_stamp))) * Rotation.from_euler(
        "xyz", (5.0, 0.0, 90.0), degrees=True
    )
    np.testing.assert_allclose(turned.apply(gravity)[:, :2], 0.0, atol=1e-3)
    np.testing.assert_array_equal(plain.angular_rate, faulty.angular_rate)
    at_rest = seconds(faulty.imu_stamp) < 20.0
    np.testing.assert_allclose((faulty.specific_force - faulty.accel_bias)[at_rest].mean(axis=0), 0.0, atol=1e-3)


def test_offsets_of_the_imu_are_part_of_its_true_bias() -> None:
    offset = (0.0, math.radians(3.0), -0.01)
    plain, faulty = (
        simulate("drive", 1, gyro_offset=gyro, accel_offset=accel, **SHORT)
        for gyro, accel in (((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (offset, (0.3, 0.0, 0.0)))
    )
    for name, added in (
        ("gyro_bias", offset),
        ("angular_rate", offset),
        ("accel_bias", (0.3, 0.0, 0.0)),
        ("specific_force", (0.3, 0.0, 0.0)),
    ):
        difference = getattr(faulty, name) - getattr(plain, name)
        np.testing.assert_allclose(difference, np.tile(added, (len(difference), 1)), atol=1e-12)
    assert faulty.parameters() == plain.parameters(), "the estimator is told nothing of a fault"


# ------------------------------------------------------------------------------------------------------ together, bag


def stamps_and_arrivals(recording: Recording) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    aids = {name: getattr(recording, name) for name in ALL_SENSORS if name != "second_gnss"}
    return {name: (aid.stamp, aid.arrival) for name, aid in aids.items()}


def test_no_sensor_is_there_unless_asked_for_and_none_changes_another() -> None:
    plain, full = simulate("drive", 7, **SHORT), simulate("drive", 7, **SHORT, **ALL_SENSORS)
    for name in ALL_SENSORS:
        assert getattr(plain, name) is None
        assert getattr(full, name) is not None
        alone = getattr(simulate("drive", 7, **SHORT, **{name: ALL_SENSORS[name]}), name)
        for field in dataclasses.fields(alone):
            np.testing.assert_array_equal(getattr(alone, field.name), getattr(getattr(full, name), field.name))
    for field in dataclasses.fields(plain):
        value = getattr(plain, field.name)
        if isinstance(value, np.ndarray):
            assert value.tobytes() == getattr(full, field.name).tobytes(), field.name


def test_aids_arrive_after_their_stamps_and_in_order() -> None:
    for name, (stamp, arrival) in stamps_and_arrivals(simulate("drive", 7, **SHORT, **ALL_SENSORS)).items():
        sensor = ALL_SENSORS[name]
        shortest, longest = sensor.latency  # type: ignore[attr-defined]
        delay = (arrival - stamp) * 1e-9
        assert shortest - 1e-9 <= delay.min() < delay.max() <= longest + 1e-9, name
        assert (np.diff(arrival) >= 0).all(), name
        assert 1e9 / np.diff(stamp).mean() == pytest.approx(sensor.rate)  # type: ignore[attr-defined]


SENSOR_ARGUMENTS = [
    "--sensor",
    "wheel:position=0.4/0.8/0,scale_error=0.02",
    "--sensor",
    "magnetometer",
    "--sensor",
    "barometer:rate=10",
    "--sensor",
    "dual_antenna:baseline=0/1/0",
    "--sensor",
    "body_velocity:axes=xy",
    "--sensor",
    "second_gnss",
    "--episode",
    "wheel_slip:start=30,length=2,factor=1.3",
    "--set",
    "stop=45",
    "--set",
    "gravity_removed=true",
]


def test_command_writes_the_aids(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    assert command.main(["drive", "--seed", "3", *SENSOR_ARGUMENTS, "--quiet", "--out", str(path)]) == 0
    recording = simulate(
        "drive",
        3,
        wheel=WheelOdometer((0.4, 0.8, 0.0), scale_error=0.02),
        magnetometer=Magnetometer(),
        barometer=Barometer(rate=10.0),
        dual_antenna=DualAntenna((0.0, 1.0, 0.0)),
        body_velocity=BodyVelocity(axes="xy"),
        second_gnss=GnssReceiver(),
        episodes=(WheelSlip(30.0, 2.0, factor=1.3),),
        stop=45.0,
        gravity_removed=True,
    )
    found = read(
        path,
        {
            **TOPICS,
            "gnss/heading": "sensor_msgs/msg/Imu",
            "wheel/odom": "nav_msgs/msg/Odometry",
            "imu/mag": "sensor_msgs/msg/MagneticField",
            "baro": "sensor_msgs/msg/FluidPressure",
            "body_velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
        },
    )
    topics = {
        "dual_antenna": "gnss/heading",
        "wheel": "wheel/odom",
        "magnetometer": "imu/mag",
        "barometer": "baro",
        "body_velocity": "body_velocity",
    }
    for name, (stamp, arrival) in stamps_and_arrivals(recording).items():
        np.testing.assert_array_equal(found[topics[name]][0], arrival)
        np.testing.assert_array_equal(found[topics[name]][1]["stamp"], stamp)
    np.testing.assert_array_equal(found["imu/data"][1]["linear_acceleration"], recording.specific_force)

    second = recording.second_gnss
    assert second is not None
    log, fix, frames = found["gps/fix"]
    assert frames == [["gps", "gps2"]]
    assert (np.diff(log) >= 0).all()
    of_second = np.isin(fix["stamp"], second.fix_stamp) & np.isin(fix["latitude"], second.fix_latitude_deg)
    assert np.count_nonzero(of_second) == len(second.fix_stamp) == len(fix) - len(recording.fix_stamp)
    np.testing.assert_array_equal(log[of_second], second.fix_arrival)
    velocities = found["gps/vel"][1]["linear_velocity"]
    assert len(velocities) == len(recording.velocity_enu) + len(second.velocity_enu)

    _, odometry, frames = found["wheel/odom"]
    assert frames == [["odom"], ["wheel_link"]]
    assert recording.wheel is not None
    np.testing.assert_array_equal(odometry["linear_velocity"][:, 0], recording.wheel.speed)
    np.testing.assert_array_equal(odometry["angular_velocity"][:, 2], recording.wheel.yaw_rate)
    expected = [recording.wheel.speed_variance, -1.0, -1.0, -1.0, -1.0, recording.wheel.yaw_rate_variance]
    np.testing.assert_array_equal(np.diagonal(odometry["twist_covariance"][0].reshape(6, 6)), expected)
    assert (np.diagonal(odometry["pose_covariance"][0].reshape(6, 6)) == -1.0).all()

    _, magnetic, _ = found["imu/mag"]
    assert recording.magnetometer is not None
    np.testing.assert_array_equal(magnetic["magnetic_field"], recording.magnetometer.field)
    np.testing.assert_allclose(magnetic["magnetic_field_covariance"][0], np.diag([9e-14] * 3).ravel())

    _, pressure, _ = found["baro"]
    assert recording.barometer is not None
    np.testing.assert_array_equal(pressure["fluid_pressure"], recording.barometer.pressure)
    assert (pressure["variance"] == 9.0).all()

    _, heading, _ = found["gnss/heading"]
    assert recording.dual_antenna is not None
    yaw = Rotation.from_quat(heading["orientation"]).as_euler("ZYX")
    np.testing.assert_allclose(yaw[:, 0], recording.dual_antenna.yaw, atol=1e-12)
    np.testing.assert_allclose(yaw[:, 1], recording.dual_antenna.pitch, atol=1e-12)
    assert heading["orientation_covariance"][0, 8] == pytest.approx(math.radians(0.3) ** 2)
    assert (heading["orientation_covariance"][:, [0, 4]] > 9.0).all()
    assert (heading["angular_velocity_covariance"][:, 0] == -1.0).all()
    assert (heading["linear_acceleration_covariance"][:, 0] == -1.0).all()

    _, velocity, _ = found["body_velocity"]
    assert recording.body_velocity is not None
    np.testing.assert_array_equal(velocity["linear_velocity"], recording.body_velocity.velocity)
    variances = np.diagonal(velocity["twist_covariance"][0].reshape(6, 6))
    np.testing.assert_allclose(variances, [0.0025, 0.0025, -1.0, -1.0, -1.0, -1.0])

    again = tmp_path / "again" / path.name
    again.parent.mkdir()
    assert command.main(["drive", "--seed", "3", *SENSOR_ARGUMENTS, "--quiet", "--out", str(again)]) == 0
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--sensor", "baro"], "unknown 'baro' in 'baro'; there are second_gnss, dual_antenna, wheel"),
        (["--sensor", "wheel:size=3"], "'size=3' must be one of position, scale_error"),
        (["--sensor", "wheel:position=3"], "'position=3': position takes 3 numbers with slashes between them"),
        (["--sensor", "wheel:rate=quick"], "'rate=quick': rate takes a number"),
        (["--sensor", "wheel:rate=0"], "rate of the wheels must be a positive number of Hz, not 0.0"),
        (["--sensor", "body_velocity:axes=xw"], "axes of the body velocity must be some of xyz, not 'xw'"),
        (["--sensor", "dual_antenna:baseline=0/0/1"], "baseline of the dual antenna must lead sideways"),
        (["--episode", "outage:start=3"], "'outage:start=3' lacks length"),
        (["--set", "gravity_removed=yes"], "gravity_removed takes true or false"),
        (["--set", "stop"], "'stop' must be one of grade, imu_rate"),
    ],
)
def test_mistakes_in_sensors_and_episodes_cost_one_line(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main(["drive", *arguments]) == 2
    printed = capsys.readouterr()
    assert expected in printed.err
    assert printed.err.count("\n") == 1
    assert not printed.out


def test_what_the_list_spells_can_be_given_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    for name, sensor in ALL_SENSORS.items():
        (line,) = [line.strip() for line in listed if line.startswith(f"  {name}:")]
        path = tmp_path / f"{name}.mcap"
        command_line = ["drive", "--set", "stop=1", "--quiet", "--out", str(path)]
        contents = []
        for text in (line, name):
            assert command.main([*command_line, "--sensor", text]) == 0
            contents.append(path.read_bytes())
        assert contents[0] == contents[1], sensor
