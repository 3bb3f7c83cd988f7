"""The parameters as the estimator uses them: the settings of the kernels, and the intakes of the messages."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from eskf_ros.filter.alignment.warm_start import Memory
from eskf_ros.filter.layout import SETTINGS
from eskf_ros.filter.measurements.row import Intake, OptionalBlock, Row, to_base
from eskf_ros.filter.rows import ROWS
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE, NOWHERE, OPTIONAL_SIZES
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import SECOND
from eskf_ros.geodesy.earth import east_north_up_to_ecef, geodetic_to_ecef
from eskf_ros.parameters.tree import Imu, Parameters

SWITCHED_ON_SHARE = 0.1
"""Share of its initial standard deviation by which a bias changes when the IMU is switched off and on, at another
temperature.
"""

HUMBLE_NOISE = (0.12, 6e-3, 3e-3, 3e-4)
"""Densities of the noise of the humble lane, at least: accelerometer (m/s2/rtHz), gyro (rad/s/rtHz), and the random
walks of their biases (m/s3/rtHz, rad/s2/rtHz). Four times the default noise, and biases that follow a step in seconds.
"""


def intakes_from(parameters: Parameters) -> dict[Stream, Intake]:
    """Return the `Intake` of each stream; ranges have none, `Navigator.push_ranges` checks them itself."""
    intakes = {}
    for row in ROWS:
        if row.limits is not None:
            group = getattr(parameters, row.parameters)
            particulars = {
                "is_used": getattr(group, "use", True),
                "time_offset": group.time_offset,
                "covariance_scale": group.covariance_scale,
                **row.limits(group),
            }
            intakes[row.stream] = Intake(**particulars)
    return intakes


def gate_probability(row: Row, parameters: Parameters) -> float:
    """Return the share of good measurements that the chi-square gate lets pass."""
    if row.gate_probability is not None:
        return row.gate_probability
    probability: float = getattr(parameters, row.parameters).gate_probability
    return probability


def settings_from(parameters: Parameters, output_rate: float = 0.0) -> np.ndarray:
    """Return the parameters as the kernels use them (SETTINGS): radians, lever arms from the IMU in its axes.

    ``output_rate`` in Hz; 0: a row for every IMU sample.
    """
    settings = allocate(SETTINGS)
    imu, alignment = parameters.imu, parameters.alignment
    describe_imu_noise(settings, imu)
    settings["has_humble_lane"] = 1
    settings["imu_gap"] = imu.gap
    settings["gap_accel_std"] = imu.gap_accel_std
    settings["gap_gyro_std"] = imu.gap_gyro_std
    imu_to_base = to_base(imu.mount_rpy_deg)
    settings["imu_to_base"] = imu_to_base
    settings["imu_position_base"] = imu.mount_position
    lever_arms_base = np.subtract([parameters.gnss.lever_arm, parameters.second_gnss.lever_arm], imu.mount_position)
    solves_ranges = parameters.ranges.use_point_solution
    first = parameters.ranges if solves_ranges else parameters.gnss
    settings["solves_ranges"] = solves_ranges
    settings["gnss_time_offset"] = (first.time_offset, parameters.second_gnss.time_offset)
    settings["velocity_time_offset"] = parameters.gnss.velocity_time_offset
    settings["lever_arms_body"] = lever_arms_base @ imu_to_base
    for row in ROWS:
        settings["gate"][0, row.stream, 1:] = chdtri([1, 2, 3], 1.0 - gate_probability(row, parameters))
        settings["needs"][0, row.stream] = row.needs
        if row.is_enabled:
            settings["constrains"][0, row.stream] = row.is_enabled(parameters)
        if row.settings.names:
            row.describe(settings[row.name][0], parameters)
    settings["gnss_covariance_scale"] = parameters.gnss.covariance_scale
    # In mode tight the correlated error belongs to the ranges, not to fixes.
    settings["correlated_share"] = parameters.gnss.correlated_share if parameters.mode == "loose" else 0.0
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
    for name in ("position_std", "coast_time", "settle_time"):
        settings[f"quality_{name}"] = getattr(parameters.quality, name)
    settings["output_interval"] = round(SECOND / output_rate) if output_rate > 0.0 else 0
    return settings


def describe_imu_noise(settings: np.ndarray, imu: Imu) -> None:
    """Write the noise of the IMU to the settings, as told and for the humble lane."""
    for name in (
        "gyro_noise_density",
        "accel_noise_density",
        "gyro_bias_random_walk",
        "accel_bias_random_walk",
        "gyro_bias_std",
        "accel_bias_std",
    ):
        settings[name] = getattr(imu, name)
    told = (
        imu.accel_noise_density,
        imu.gyro_noise_density,
        imu.accel_bias_random_walk,
        imu.gyro_bias_random_walk,
    )
    # Where the estimation of a bias is switched off it is off in both lanes.
    is_estimated = (
        True,
        True,
        imu.accel_bias_std > 0.0 or imu.accel_bias_random_walk > 0.0,
        imu.gyro_bias_std > 0.0 or imu.gyro_bias_random_walk > 0.0,
    )
    noise = np.maximum(HUMBLE_NOISE, np.multiply(told, (4.0, 4.0, 1.0, 1.0)))
    settings["humble_noise"] = np.square(noise * is_estimated)


def place_optional_states(settings: np.void, parameters: Parameters) -> None:
    """Assign the active augmented states their indices and models, and the streams the errors that they need.

    The offsets of the constellations are activated one by one, with the first signal of each (`receiver_clock`).
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
    settings["error_capacity"] = end


def optional_blocks(parameters: Parameters) -> tuple[OptionalBlock, ...]:
    """Return the augmented states in the order of their indices."""
    blocks = [block for row in ROWS for block in row.augmented(parameters)]
    estimate = parameters.estimate
    streams = (Stream.GNSS_POSITION, Stream.PSEUDORANGE)
    blocks.append(OptionalBlock("imu_scale", is_on=estimate.imu_scale, std=estimate.imu_scale_std, streams=streams))
    return tuple(sorted(blocks, key=lambda block: list(OPTIONAL_SIZES).index(block.name)))


def recall(memory: Memory, age: float, parameters: Parameters, settings: np.ndarray) -> None:
    """Write a memory that is ``age`` seconds old to the settings (SETTINGS), with its present uncertainty."""
    imu, warm = parameters.imu, parameters.warm_start
    for name, at_start, walk in (
        ("accel_bias", imu.accel_bias_std, imu.accel_bias_random_walk),
        ("gyro_bias", imu.gyro_bias_std, imu.gyro_bias_random_walk),
    ):
        at_end = max(getattr(memory, f"{name}_std"))
        std = math.sqrt(at_end**2 + walk**2 * age + (SWITCHED_ON_SHARE * at_start) ** 2)
        settings[f"remembered_{name}"] = getattr(memory, name)
        settings[f"remembered_{name}_std"] = min(std, at_start)
    latitude, longitude = math.radians(memory.latitude_deg), math.radians(memory.longitude_deg)
    heading = math.radians(memory.heading_deg)
    forward = (math.cos(heading), math.sin(heading), 0.0)
    settings["remembered_place_ecef"] = geodetic_to_ecef(latitude, longitude, memory.altitude)
    settings["remembered_place_std"] = memory.position_std
    settings["remembered_place_tolerance"] = warm.position_tolerance
    settings["remembered_forward_ecef"] = np.array(east_north_up_to_ecef(latitude, longitude)) @ forward
    settings["remembered_heading_std"] = math.radians(math.hypot(memory.heading_std_deg, warm.heading_std_deg))
    settings["has_memory"] = 1
