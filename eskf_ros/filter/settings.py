"""The parameters as the estimator uses them: what the kernels read, and how the messages are taken in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from eskf_ros.filter.layout import CONSTRAINTS, ERROR_SIZE, NOWHERE, OPTIONAL_SIZES, SETTINGS, Stream, allocate
from eskf_ros.filter.strapdown import SECOND
from eskf_ros.parameters import Aid, Parameters
from eskf_ros.rotation import from_roll_pitch_yaw, to_matrix

Axes = tuple[float, float, float]

HIGHEST_SPEED = 600.0
STRONGEST_FIELD = 1.0
HIGHEST_PRESSURE = 1.2e5
"""What no sensor on a robot reports (m/s, T, Pa)."""

CONSTRAINT_GATE_PROBABILITY = 0.999


@dataclass(frozen=True)
class Intake:
    """How the messages of a stream are taken in.

    ``std_floor`` and ``unknown_std`` per axis, in the unit of the values; the latter stands in for a covariance that is
    not there. No message with a value beyond ``largest`` can be true. ``may_lack_axes``: a negative variance says that
    the axis was not measured.
    """

    is_used: bool
    time_offset: float
    covariance_scale: float
    std_floor: Axes
    unknown_std: Axes
    largest: float
    may_lack_axes: bool = False


def _threefold(value: float) -> Axes:
    return (value, value, value)


def intakes_from(parameters: Parameters) -> dict[Stream, Intake]:
    """Return how the messages of every stream that sensors send are taken in."""
    gnss = parameters.gnss
    position = Intake(
        gnss.use_position,
        gnss.time_offset,
        gnss.covariance_scale,
        _threefold(gnss.position_std_floor),
        _threefold(math.nan),
        math.inf,
    )
    velocity = Intake(
        gnss.use_velocity,
        gnss.time_offset,
        gnss.covariance_scale,
        _threefold(gnss.velocity_std_floor),
        _threefold(gnss.unknown_velocity_std),
        HIGHEST_SPEED,
    )
    heading, mag, wheel, body, baro = (
        parameters.heading,
        parameters.mag,
        parameters.wheel,
        parameters.body_velocity,
        parameters.baro,
    )

    def aid(group: Aid, floor: Axes, unknown: Axes, largest: float, lacks: bool) -> Intake:
        return Intake(group.use, group.time_offset, group.covariance_scale, floor, unknown, largest, lacks)

    heading_std = _threefold(math.radians(heading.std_floor_deg)), _threefold(math.radians(heading.unknown_std_deg))
    wheel_std = (
        (wheel.speed_std_floor, wheel.yaw_rate_std_floor, 1.0),
        (wheel.unknown_speed_std, wheel.unknown_yaw_rate_std, 1.0),
    )
    return {
        Stream.GNSS_POSITION: position,
        Stream.GNSS_VELOCITY: velocity,
        Stream.HEADING: aid(heading, *heading_std, 10.0, True),
        Stream.MAG: aid(mag, _threefold(mag.std_floor), _threefold(mag.unknown_std), STRONGEST_FIELD, False),
        Stream.WHEEL: aid(wheel, *wheel_std, HIGHEST_SPEED, True),
        Stream.BODY_VELOCITY: aid(body, _threefold(body.std_floor), _threefold(body.unknown_std), HIGHEST_SPEED, True),
        Stream.BARO: aid(baro, _threefold(baro.std_floor), _threefold(baro.unknown_std), HIGHEST_PRESSURE, True),
    }


def gate_probabilities(parameters: Parameters) -> dict[Stream, float]:
    """Return the share of good measurements that the gate of each stream lets pass."""
    return {
        Stream.GNSS_POSITION: parameters.gnss.gate_probability,
        Stream.GNSS_VELOCITY: parameters.gnss.gate_probability,
        Stream.HEADING: parameters.heading.gate_probability,
        Stream.MAG: parameters.mag.gate_probability,
        Stream.WHEEL: parameters.wheel.gate_probability,
        Stream.BODY_VELOCITY: parameters.body_velocity.gate_probability,
        Stream.BARO: parameters.baro.gate_probability,
        **dict.fromkeys(CONSTRAINTS, CONSTRAINT_GATE_PROBABILITY),
    }


def settings_from(parameters: Parameters, output_rate: float = 0.0) -> np.ndarray:
    """Return the parameters as the kernels use them (SETTINGS): radians, lever arms from the IMU in its axes."""
    settings = allocate(SETTINGS)
    imu, alignment = parameters.imu, parameters.alignment
    for name in (
        "gyro_noise_density",
        "accel_noise_density",
        "gyro_bias_random_walk",
        "accel_bias_random_walk",
        "gyro_bias_std",
        "accel_bias_std",
    ):
        settings[name] = getattr(imu, name)
    settings["imu_gap"] = imu.gap
    settings["gap_accel_std"] = imu.gap_accel_std
    settings["gap_gyro_std"] = imu.gap_gyro_std
    roll, pitch, yaw = (math.radians(angle) for angle in imu.mount_rpy_deg)
    imu_to_base = np.array(to_matrix(from_roll_pitch_yaw(roll, pitch, yaw)))
    settings["imu_to_base"] = imu_to_base
    settings["imu_position_base"] = imu.mount_position
    lever_arms_base = np.subtract([parameters.gnss.lever_arm, parameters.second_gnss.lever_arm], imu.mount_position)
    settings["lever_arms_body"] = lever_arms_base @ imu_to_base
    for stream, probability in gate_probabilities(parameters).items():
        settings["gate"][0, stream, 1:] = chdtri([1, 2, 3], 1.0 - probability)
    settings["constrains"][0, Stream.ZUPT] = settings["constrains"][0, Stream.ZARU] = parameters.zupt.enabled
    settings["constrains"][0, Stream.NHC] = parameters.nhc.enabled
    settings["correlated_share"] = parameters.gnss.correlated_share
    describe_vehicle(settings[0], parameters)
    place_optional_states(settings[0], parameters)
    settings["static_duration"] = alignment.static_duration
    settings["moving_start_after"] = alignment.moving_start_after
    settings["still_gyro_std"] = alignment.still_gyro_std
    settings["still_accel_std"] = alignment.still_accel_std
    settings["moving_tilt_std"] = math.radians(alignment.moving_tilt_std_deg)
    settings["initial_heading"] = math.radians(alignment.initial_heading_deg)
    settings["initial_heading_std"] = math.radians(alignment.initial_heading_std_deg)
    settings["use_course"] = alignment.use_course
    settings["found_heading_std"] = math.radians(alignment.found_heading_std_deg)
    settings["course_min_speed"] = alignment.course_min_speed
    settings["course_std"] = math.radians(alignment.course_std_deg)
    settings["good_heading_std"] = math.radians(alignment.good_heading_std_deg)
    settings["output_interval"] = round(SECOND / output_rate) if output_rate > 0.0 else 0
    return settings


def describe_vehicle(settings: np.void, parameters: Parameters) -> None:
    """Fill in what wheels and the constraints of a vehicle need: arms from the IMU in its axes, deviations."""
    wheel, nhc = parameters.wheel, parameters.nhc
    settings["zupt_velocity_std"] = parameters.zupt.velocity_std
    settings["zupt_rate_std"] = parameters.zupt.rate_std
    for name, position in (("wheel", wheel.position), ("nhc", nhc.position)):
        arm_base = np.subtract(position, parameters.imu.mount_position)
        settings[f"{name}_arm_body"] = arm_base @ settings["imu_to_base"]
    settings["wheel_slip"] = wheel.slip
    settings["nhc_lateral_std"] = nhc.lateral_std
    settings["nhc_vertical_std"] = nhc.vertical_std
    settings["nhc_angle_std"] = math.radians(nhc.angle_std_deg)
    settings["nhc_slip"] = nhc.slip


def place_optional_states(settings: np.void, parameters: Parameters) -> None:
    """Give the optional states that are switched on their places and their models, and the streams their reach."""
    settings["reach"] = end = ERROR_SIZE
    time = parameters.gnss.correlation_time
    estimate = parameters.estimate
    mounting_std, mounting_walk = math.radians(estimate.mounting_std_deg), estimate.mounting_random_walk
    scale_std, scale_walk = estimate.wheel_scale_std, estimate.wheel_scale_random_walk
    # Name, whether it is on, first deviation, driving noise, correlation time (0: random walk), streams that need it.
    blocks: tuple[tuple[str, bool, float, float, float, tuple[Stream, ...]], ...] = (
        ("position_error", time > 0.0, 1.0, math.sqrt(2.0 / time) if time else 0.0, time, (Stream.GNSS_POSITION,)),
        ("mounting", estimate.mounting, mounting_std, mounting_walk, 0.0, (Stream.NHC, Stream.WHEEL)),
        ("wheel_scale", estimate.wheel_scale, scale_std, scale_walk, 0.0, (Stream.WHEEL,)),
    )
    for name, is_on, std, noise_density, time, streams in blocks:
        settings[f"{name}_at"] = end if is_on else NOWHERE
        if not is_on:
            continue
        place = slice(end - ERROR_SIZE, end - ERROR_SIZE + OPTIONAL_SIZES[name])
        settings["optional_std"][place] = std
        settings["optional_noise_density"][place] = noise_density
        settings["optional_decay"][place] = 1.0 / time if time > 0.0 else 0.0
        end += OPTIONAL_SIZES[name]
        for stream in streams:
            settings["reach"][stream] = end
