"""The parameters as the estimator uses them: what the kernels read, and how the messages are taken in."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from eskf_ros.filter.layout import SETTINGS
from eskf_ros.filter.state.enums import CONSTRAINTS, Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, INTER_SYSTEM, NOWHERE, OPTIONAL_SIZES
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import SECOND
from eskf_ros.geodesy.rotation import from_roll_pitch_yaw, to_matrix
from eskf_ros.gnss.signals import Gnss
from eskf_ros.parameters.schema import Aid
from eskf_ros.parameters.tree import Parameters

Axes = tuple[float, float, float]
FloatArray = npt.NDArray[np.float64]

HIGHEST_SPEED = 600.0
STRONGEST_FIELD = 1.0
HIGHEST_PRESSURE = 1.2e5
"""What no sensor on a robot reports (m/s, T, Pa)."""

LOWEST_PRESSURE = 1.0e4
"""That at 16 km (Pa); a driver that reports hectopascal is below it."""

LARGEST_ANGLE = 2.0 * math.pi
UNKNOWN_ANGLE_VARIANCE = 1.0
"""Angles are in rad; drivers say with a variance like 1000 or pi^2 that they do not know one (rad2)."""

CONSTRAINT_GATE_PROBABILITY = 0.999

START_CLOCK_STD = (1000.0, 1000.0)
"""Of a receiver clock (m, m/s) whose first value is the median of the satellites."""

Deviation = float | tuple[float, ...]


@dataclass(frozen=True)
class Intake:
    """How the messages of a stream are taken in.

    ``std_floor`` and ``unknown_std`` per axis, in the unit of the values; the latter stands in for a covariance that is
    not there. No message with a value beyond ``largest`` can be true. ``may_lack_axes``: a negative variance, or one
    above ``largest_variance``, says that the axis was not measured. The first value is never below ``lowest``.
    """

    is_used: bool
    time_offset: float
    covariance_scale: float
    std_floor: Axes
    unknown_std: Axes
    largest: float
    may_lack_axes: bool = False
    largest_variance: float = math.inf
    lowest: float = -math.inf


class OptionalBlock(NamedTuple):
    """Optional states of one kind (`OPTIONAL_SIZES`).

    ``std``: at first; ``correlation_time`` in s, 0 for a random walk; ``streams``: those that need the states.
    """

    name: str
    is_on: bool
    std: Deviation
    noise_density: Deviation = 0.0
    correlation_time: float = 0.0
    streams: tuple[Stream, ...] = ()


def _threefold(value: float) -> Axes:
    return (value, value, value)


def _matrix(rpy_deg: tuple[float, ...]) -> FloatArray:
    """Return the rotation to base_link from the axes of a sensor that is mounted like this."""
    roll, pitch, yaw = (math.radians(angle) for angle in rpy_deg)
    return np.array(to_matrix(from_roll_pitch_yaw(roll, pitch, yaw)))


def intakes_from(parameters: Parameters) -> dict[Stream, Intake]:
    """Return how the messages of the streams are taken in, but for ranges: `Navigator.push_ranges` does that itself."""
    gnss, heading, mag = parameters.gnss, parameters.heading, parameters.mag
    wheel, body, baro = parameters.wheel, parameters.body_velocity, parameters.baro
    return {
        Stream.GNSS_POSITION: Intake(
            is_used=gnss.use_position,
            time_offset=gnss.time_offset,
            covariance_scale=gnss.covariance_scale,
            std_floor=_threefold(gnss.position_std_floor),
            unknown_std=_threefold(math.nan),
            largest=math.inf,
        ),
        Stream.GNSS_VELOCITY: Intake(
            is_used=gnss.use_velocity,
            time_offset=gnss.time_offset,
            covariance_scale=gnss.covariance_scale,
            std_floor=_threefold(gnss.velocity_std_floor),
            unknown_std=_threefold(gnss.unknown_velocity_std),
            largest=HIGHEST_SPEED,
        ),
        Stream.HEADING: _intake(
            heading,
            std_floor=_threefold(math.radians(heading.std_floor_deg)),
            # A message without a covariance says nothing of the pitch.
            unknown_std=(math.radians(heading.unknown_std_deg), math.nan, math.nan),
            largest=LARGEST_ANGLE,
            may_lack_axes=True,
            largest_variance=UNKNOWN_ANGLE_VARIANCE,
        ),
        Stream.MAG: _intake(
            mag,
            std_floor=_threefold(mag.std_floor),
            unknown_std=_threefold(mag.unknown_std),
            largest=STRONGEST_FIELD,
        ),
        Stream.WHEEL: _intake(
            wheel,
            std_floor=(wheel.speed_std_floor, wheel.yaw_rate_std_floor, 1.0),
            unknown_std=(wheel.unknown_speed_std, wheel.unknown_yaw_rate_std, 1.0),
            largest=HIGHEST_SPEED,
            may_lack_axes=True,
        ),
        Stream.BODY_VELOCITY: _intake(
            body,
            std_floor=_threefold(body.std_floor),
            unknown_std=_threefold(body.unknown_std),
            largest=HIGHEST_SPEED,
            may_lack_axes=True,
        ),
        Stream.BARO: _intake(
            baro,
            std_floor=_threefold(baro.std_floor),
            unknown_std=_threefold(baro.unknown_std),
            largest=HIGHEST_PRESSURE,
            may_lack_axes=True,
            lowest=LOWEST_PRESSURE,
        ),
    }


def _intake(group: Aid, **particulars: Any) -> Intake:
    """Return an Intake with what all aids have as parameters of one name, and their particulars."""
    return Intake(
        is_used=group.use, time_offset=group.time_offset, covariance_scale=group.covariance_scale, **particulars
    )


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
        **dict.fromkeys((Stream.PSEUDORANGE, Stream.RANGE_RATE), parameters.ranges.gate_probability),
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
    imu_to_base = _matrix(imu.mount_rpy_deg)
    settings["imu_to_base"] = imu_to_base
    settings["imu_position_base"] = imu.mount_position
    lever_arms_base = np.subtract([parameters.gnss.lever_arm, parameters.second_gnss.lever_arm], imu.mount_position)
    solves_ranges = parameters.ranges.use_point_solution
    first = parameters.ranges if solves_ranges else parameters.gnss
    settings["solves_ranges"] = solves_ranges
    settings["gnss_time_offset"] = (first.time_offset, parameters.second_gnss.time_offset)
    settings["lever_arms_body"] = lever_arms_base @ imu_to_base
    baseline = _matrix(parameters.heading.mount_rpy_deg)[:, 0]
    settings["heading_lines_body"] = np.array([baseline, (1.0, 0.0, 0.0)]) @ imu_to_base
    settings["baro_arm_body"] = np.subtract(parameters.baro.position, imu.mount_position) @ imu_to_base
    mag = parameters.mag
    mag_to_base = _matrix(mag.mount_rpy_deg) if mag.mount_rpy_deg else imu_to_base
    settings["mag_to_imu"] = imu_to_base.T @ mag_to_base
    settings["mag_strength_tolerance"] = mag.strength_tolerance
    settings["mag_inclination_tolerance"] = math.radians(mag.inclination_tolerance_deg)
    settings["mag_error_distance"] = mag.error_distance
    settings["is_orientation_magnetic"] = alignment.imu_orientation == "magnetic_north"
    probabilities = gate_probabilities(parameters)
    for stream in Stream:
        if stream != Stream.IMU:
            # A stream without a probability is a KeyError here: a gate of zero would refuse it for ever.
            settings["gate"][0, stream, 1:] = chdtri([1, 2, 3], 1.0 - probabilities[stream])
    settings["constrains"][0, Stream.ZUPT] = settings["constrains"][0, Stream.ZARU] = parameters.zupt.enabled
    settings["constrains"][0, Stream.NHC] = parameters.nhc.enabled
    settings["gnss_covariance_scale"] = parameters.gnss.covariance_scale
    # In mode tight what lasts is in the ranges, and no fix knows of it.
    settings["correlated_share"] = parameters.gnss.correlated_share if parameters.mode == "loose" else 0.0
    describe_vehicle(settings[0], parameters)
    settings["elevation_mask"] = math.radians(parameters.ranges.elevation_mask_deg)
    settings["range_covariance_scale"] = parameters.ranges.covariance_scale
    settings["code_std_floor"] = parameters.ranges.code_std_floor
    settings["range_rate_std_floor"] = parameters.ranges.range_rate_std_floor
    horizontal, vertical = parameters.ranges.correlated_std, parameters.ranges.correlated_std_vertical
    settings["range_error_std"] = (horizontal, horizontal, vertical)
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
    body = parameters.body_velocity
    settings["body_velocity_axes_body"] = _matrix(body.mount_rpy_deg).T @ settings["imu_to_base"]
    arms = (("wheel", wheel.position), ("nhc", nhc.position), ("body_velocity", body.mount_position))
    for name, position in arms:
        arm_base = np.subtract(position, parameters.imu.mount_position)
        settings[f"{name}_arm_body"] = arm_base @ settings["imu_to_base"]
    settings["wheel_slip"] = wheel.slip
    settings["nhc_lateral_std"] = nhc.lateral_std
    settings["nhc_vertical_std"] = nhc.vertical_std
    settings["nhc_angle_std"] = math.radians(nhc.angle_std_deg)
    settings["nhc_slip"] = nhc.slip


def place_optional_states(settings: np.void, parameters: Parameters) -> None:
    """Give the optional states that are switched on their places and their models, and the streams their reach.

    The offsets of the constellations join one by one, with the first signal of each (`ranges`).
    """
    settings["reach"] = end = ERROR_SIZE
    for block in optional_blocks(parameters):
        settings[f"{block.name}_at"] = end if block.is_on else NOWHERE
        if not block.is_on:
            continue
        size, time = OPTIONAL_SIZES[block.name], block.correlation_time
        place = slice(end - ERROR_SIZE, end - ERROR_SIZE + size)
        settings["optional_std"][place] = block.std
        settings["optional_noise_density"][place] = block.noise_density
        settings["optional_decay"][place] = 1.0 / time if time > 0.0 else 0.0
        end += size
        for stream in block.streams:
            settings["reach"][stream] = end


def optional_blocks(parameters: Parameters) -> tuple[OptionalBlock, ...]:
    """Return the optional states in the order of their places."""
    estimate, heading, baro, mag = parameters.estimate, parameters.heading, parameters.baro, parameters.mag
    ranges, is_tight = parameters.ranges, parameters.mode == "tight"
    time = ranges.correlation_time if is_tight else parameters.gnss.correlation_time
    return (
        OptionalBlock(
            "position_error",
            is_on=time > 0.0,
            std=1.0,
            noise_density=math.sqrt(2.0 / time) if time else 0.0,
            correlation_time=time,
            streams=(Stream.GNSS_POSITION,),
        ),
        OptionalBlock(
            "mounting",
            is_on=estimate.mounting,
            std=math.radians(estimate.mounting_std_deg),
            noise_density=estimate.mounting_random_walk,
            streams=(Stream.NHC, Stream.WHEEL),
        ),
        OptionalBlock(
            "wheel_scale",
            is_on=estimate.wheel_scale,
            std=estimate.wheel_scale_std,
            noise_density=estimate.wheel_scale_random_walk,
            streams=(Stream.WHEEL,),
        ),
        OptionalBlock(
            "clock",
            is_on=is_tight,
            std=START_CLOCK_STD,
            noise_density=(ranges.clock_bias_noise, ranges.clock_drift_noise),
            streams=(Stream.PSEUDORANGE, Stream.RANGE_RATE),
        ),
        OptionalBlock(
            "inter_system",
            is_on=is_tight,
            std=inter_system_stds(parameters),
            noise_density=ranges.inter_system_noise,
        ),
        OptionalBlock(
            "heading_offset",
            is_on=heading.offset_std_deg > 0.0,
            std=math.radians(heading.offset_std_deg),
            noise_density=heading.offset_random_walk,
            streams=(Stream.HEADING,),
        ),
        # Not by whether the sensor is used, which may change while running: places stay.
        OptionalBlock(
            "baro_offset",
            is_on=True,
            std=baro.offset_std,
            noise_density=baro.offset_random_walk,
            streams=(Stream.BARO,),
        ),
        OptionalBlock("baro_scale", is_on=True, std=baro.scale_std, streams=(Stream.BARO,)),
        OptionalBlock("mag_error", is_on=True, std=math.radians(mag.error_std_deg), streams=(Stream.MAG,)),
        OptionalBlock(
            "magnetic_bias",
            is_on=estimate.magnetic_bias,
            std=estimate.magnetic_bias_std,
            streams=(Stream.MAG,),
        ),
    )


def inter_system_stds(parameters: Parameters) -> tuple[float, ...]:
    """Return the standard deviation (m) of each of the `INTER_SYSTEM` offsets at first."""
    ranges = parameters.ranges
    return tuple(
        ranges.inter_system_std_glonass if system == Gnss.GLONASS else ranges.inter_system_std
        for system in INTER_SYSTEM
    )
