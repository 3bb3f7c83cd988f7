"""Memory layout of the estimator: the only place that knows what is where.

Everything the compiled kernels touch is a numpy record with named fields, so that ``state.position_map`` is the same
code compiled and plain, and a checkpoint is one assignment. Units are SI; stamps are integer nanoseconds.

Body axes are the axes of the IMU and the body origin is the IMU: biases, noise and lever arms live there.
``output.py`` turns the result into base_link.
"""

from __future__ import annotations

import numpy as np

from eskf_ros.filter.alignment.heading_search import SEARCH_SIZE
from eskf_ros.filter.state.enums import SENSOR_STREAMS, Stream
from eskf_ros.filter.state.error_state import (
    ACCEL_BIAS,
    ERROR_CAPACITY,
    ERROR_SIZE,
    OPTIONAL_CAPACITY,
    OPTIONAL_SIZES,
    SOURCES,
)
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.tight.epoch import LARGEST_EPOCH

STATE = np.dtype(
    [
        # Where the estimator stands in the timeline.
        ("stamp", "i8"),
        ("imu_next", "i8"),
        ("aid_next", "i8"),
        # Nominal state at ``stamp``; attitude is the quaternion (w x y z) from body to map.
        ("position_map", "f8", (3,)),
        ("velocity_map", "f8", (3,)),
        ("attitude", "f8", (4,)),
        ("accel_bias", "f8", (3,)),
        ("gyro_bias", "f8", (3,)),
        # Optional states in the order of their places; how many errors are in use, the core's included.
        ("optional", "f8", (OPTIONAL_CAPACITY,)),
        ("error_size", "i8"),
        # Covariance of the first ``error_size`` errors; the attitude error is a small rotation on the map side.
        ("covariance", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
        # Raw IMU reading at ``stamp``; the last IMU sample, its stamp and the interval (s) it ended; the one before.
        ("specific_force", "f8", (3,)),
        ("angular_rate", "f8", (3,)),
        ("imu_stamp", "i8"),
        ("imu_interval", "f8"),
        ("imu_force", "f8", (3,)),
        ("imu_rate", "f8", (3,)),
        ("earlier_force", "f8", (3,)),
        ("earlier_rate", "f8", (3,)),
        # Local frame, valid once datum_known.
        ("datum", "f8", (3,)),
        ("origin_ecef", "f8", (3,)),
        ("map_to_ecef", "f8", (3, 3)),
        ("earth_rate_map", "f8", (3,)),
        ("datum_known", "i8"),
        # Odometry without jumps: step over the last IMU interval, pose at its end, corrections since.
        ("step_position", "f8", (3,)),
        ("step_heading", "f8"),
        ("sample_position", "f8", (3,)),
        ("sample_heading", "f8"),
        ("jump_position", "f8", (3,)),
        ("jump_heading", "f8"),
        # Start-up.
        ("level_known", "i8"),
        ("position_known", "i8"),
        ("heading_known", "i8"),
        ("first_stamp", "i8"),
        # Search for the heading: position, velocity, cosine and sine, tilt and accelerometer bias as accelerations;
        # seconds since the last level.
        ("search_started", "i8"),
        ("search", "f8", (SEARCH_SIZE,)),
        ("search_covariance", "f8", (SEARCH_SIZE, SEARCH_SIZE)),
        ("search_age", "f8"),
        # What a sensor says of the unknown heading: its rank, how often it agreed with itself since when, the last
        # message, by how much (rad) it would turn the attitude, and its standard deviation.
        ("hint_rank", "i8"),
        ("hint_count", "i8"),
        ("hint_since", "i8"),
        ("hint_stamp", "i8"),
        ("hint_turn", "f8"),
        ("hint_std", "f8"),
        # When a heading was given: by parameter, from memory, or by a pose; whether the dual antenna contradicts it.
        ("given_stamp", "i8"),
        ("heading_disputed", "i8"),
        # External evidence of motion: when GNSS last proved it; by receiver, whose antennas are apart, the last fix and
        # the one the window started from.
        ("motion_stamp", "i8"),
        ("last_fix_stamp", "i8", (SOURCES,)),
        ("last_fix_ecef", "f8", (SOURCES, 3)),
        ("last_fix_variance", "f8", (SOURCES,)),
        ("anchor_stamp", "i8", (SOURCES,)),
        ("anchor_ecef", "f8", (SOURCES, 3)),
        # Stillness: sums over the window being filled, and over the unbroken run of still windows before it.
        ("window_start", "i8"),
        ("window_count", "i8"),
        ("window_sum", "f8", (6,)),
        ("window_square_sum", "f8", (6,)),
        ("still_stamp", "i8"),
        ("still_count", "i8"),
        ("still_sum", "f8", (6,)),
        # The window (see ``sway``): whether the robot moved when it began; the part being filled, sums of the means of
        # the others; the largest variances of these means in the run.
        ("moved_first", "i8"),
        ("part_start", "i8"),
        ("part_count", "i8"),
        ("part_sum", "f8", (6,)),
        ("parts", "i8"),
        ("part_mean_sum", "f8", (6,)),
        ("part_square_sum", "f8", (6,)),
        ("sway_force", "f8"),
        ("sway_rate", "f8"),
        # What was known of the gyro bias before the run.
        ("kept_gyro_bias", "f8", (3,)),
        ("kept_gyro_variance", "f8"),
        # IMU samples since the last point on the grid of the constraints: the point after them, whether one is missing,
        # how many, sums, and the sums of their first half.
        ("block_end", "i8"),
        ("block_broken", "i8"),
        ("block_count", "i8"),
        ("block_sum", "f8", (6,)),
        ("block_square_sum", "f8", (6,)),
        ("block_half_count", "i8"),
        ("block_half_sum", "f8", (6,)),
        # Rest and motion: when another sensor last saw them, how quiet the IMU is in either, and whether it was until
        # the last grid point; fix and pressure when it became so.
        ("moving_stamp", "i8"),
        ("resting_stamp", "i8"),
        ("moving_level", "f8"),
        ("resting_level", "f8"),
        ("quiet", "i8"),
        ("quiet_fix_stamp", "i8", (SOURCES,)),
        ("quiet_fix_variance", "f8", (SOURCES,)),
        ("quiet_fix_ecef", "f8", (SOURCES, 3)),
        ("quiet_pressure_stamp", "i8"),
        ("quiet_pressure", "f8"),
        # Wheels: when they spoke last, and when the gate last refused to believe them.
        ("wheel_stamp", "i8"),
        ("slip_stamp", "i8"),
        # Monitors: windows seen, those at rest, and those in which the IMU cannot be what it should be.
        ("windows", "i8"),
        ("rest_windows", "i8"),
        ("odd_gravity_windows", "i8"),
        ("odd_gravity", "f8"),
        ("tilted_windows", "i8"),
        ("tilted_force", "f8", (3,)),
        ("fast_windows", "i8"),
        # Still windows in a row with the same mean rate (rad/s), which is too large for a bias.
        ("biased_windows", "i8"),
        ("biased_rate", "f8", (3,)),
        # Monitors of the heading: sums of cosine and sine, and how many. Messages of the dual antenna and of the
        # magnetometer against the estimate; course over ground against the estimate.
        ("heading_contrast", "f8", (2, 3)),
        ("course_contrast", "f8", (3,)),
        # Strength (T) and inclination (rad) of the field last measured, how many were disturbed, and how many were.
        ("field_found", "f8", (2,)),
        ("disturbed_fields", "f8"),
        ("fields", "f8"),
        # When absolute aids were last accepted, how many were rejected since and from when on, and how often that ended
        # in a restart.
        ("absolute_stamp", "i8"),
        ("absolute_interval", "i8"),
        ("rejected_fixes", "i8"),
        ("rejected_since", "i8"),
        ("restarts", "i8"),
        # Monitors of the GNSS receivers (see ``aid_monitors``): effect of faults on the state so far, normal equations;
        # sums of innovations up and down on two axes; counts, means, sums.
        ("fault_stamp", "i8"),
        ("fault_force", "f8", (3,)),
        ("fault_absorbed", "f8", (SOURCES, ERROR_SIZE, 4)),
        ("fault_information", "f8", (SOURCES, 4, 4)),
        ("fault_evidence", "f8", (SOURCES, 4)),
        ("drift_sums", "f8", (SOURCES, 4)),
        ("departures", "i8", (SOURCES,)),
        ("departure_stamp", "i8", (SOURCES,)),
        ("seen_stamp", "i8", (SOURCES,)),
        ("fix_count", "i8", (SOURCES,)),
        ("scattered_fixes", "i8", (SOURCES,)),
        ("scatter_sum", "f8", (SOURCES,)),
        ("contradicted_fixes", "i8", (SOURCES,)),
        ("contradiction_rate", "f8", (SOURCES,)),
        ("velocity_nis", "f8", (SOURCES, 2)),
        ("coasts", "i8"),
        ("coast_nis", "f8"),
        ("heading_mark_stamp", "i8"),
        ("heading_mark_std", "f8"),
        ("heading_stuck", "i8"),
        # The Earth's magnetic field where the last good fix was (rad, rad, T; strength 0: unknown), whether it is
        # known, when it was last found disturbed; heading and place since which its error is another.
        ("field_declination", "f8"),
        ("field_inclination", "f8"),
        ("field_strength", "f8"),
        ("field_known", "i8"),
        ("disturbed_stamp", "i8"),
        ("mag_heading", "f8"),
        ("mag_position", "f8", (3,)),
        # Tight coupling: whether the errors of clock bias and drift have values yet, milliseconds it has jumped by,
        # and how often most of the satellites contradicted the state.
        ("clock_known", "i8", (2,)),
        ("clock_jumps", "i8"),
        ("range_faults", "i8"),
        # Recovery, by stream and source: last measurement and the usual interval, last accepted one and since when they
        # are, rejected in a row.
        ("aid_stamp", "i8", (SENSOR_STREAMS, SOURCES)),
        ("aid_interval", "i8", (SENSOR_STREAMS, SOURCES)),
        ("aid_fused_stamp", "i8", (SENSOR_STREAMS, SOURCES)),
        ("aid_fused_since", "i8", (SENSOR_STREAMS, SOURCES)),
        ("aid_rejected", "i8", (SENSOR_STREAMS, SOURCES)),
        # The track of the fixes by receiver: where they are (m) and move (m/s) beside the reckoned position, which
        # is the position without any correction, and variances per axis; misses and rejected members, jumps (m).
        ("corrections_map", "f8", (3,)),
        ("track_stamp", "i8", (SOURCES,)),
        ("track_offset", "f8", (SOURCES, 3)),
        ("track_rate", "f8", (SOURCES, 3)),
        ("track_offset_variance", "f8", (SOURCES, 3)),
        ("track_mixed_variance", "f8", (SOURCES, 3)),
        ("track_rate_variance", "f8", (SOURCES, 3)),
        ("track_misses", "i8", (SOURCES,)),
        ("track_hit_stamp", "i8", (SOURCES,)),
        ("track_jumps", "i8", (SOURCES,)),
        ("track_jump", "f8", (SOURCES,)),
        ("track_rejected", "i8", (SOURCES,)),
        ("track_rejected_since", "i8", (SOURCES,)),
        ("scatter", "f8", (SOURCES,)),
        ("scatter_paid", "f8", (SOURCES,)),
        # How far the velocities of the receiver lead away from the reckoned position (m), and how well that is known.
        ("velocity_lead", "f8", (SOURCES, 3)),
        ("velocity_lead_variance", "f8", (SOURCES, 3)),
        # Resets of position and velocity, and when and how often lately.
        ("resets", "i8"),
        ("reset_stamp", "i8"),
        ("recent_resets", "i8"),
    ],
    align=True,
)
"""One state of the estimator: all it knows and all it decides with. Copying it is a checkpoint."""


SETTINGS = np.dtype(
    [
        ("gyro_noise_density", "f8"),
        ("accel_noise_density", "f8"),
        ("gyro_bias_random_walk", "f8"),
        ("accel_bias_random_walk", "f8"),
        ("gyro_bias_std", "f8"),
        ("accel_bias_std", "f8"),
        ("imu_gap", "f8"),
        ("gap_accel_std", "f8"),
        ("gap_gyro_std", "f8"),
        ("imu_to_base", "f8", (3, 3)),
        ("imu_position_base", "f8", (3,)),
        ("lever_arms_body", "f8", (SOURCES, 3)),
        ("gnss_time_offset", "f8", (SOURCES,)),
        ("solves_ranges", "i8"),
        ("heading_lines_body", "f8", (SOURCES, 3)),
        ("baro_arm_body", "f8", (3,)),
        ("mag_to_imu", "f8", (3, 3)),
        ("mag_strength_tolerance", "f8"),
        ("mag_inclination_tolerance", "f8"),
        ("mag_error_distance", "f8"),
        ("is_orientation_magnetic", "i8"),
        ("gnss_covariance_scale", "f8"),
        ("correlated_share", "f8"),
        ("zupt_velocity_std", "f8"),
        ("zupt_rate_std", "f8"),
        ("body_velocity_arm_body", "f8", (3,)),
        ("body_velocity_axes_body", "f8", (3, 3)),
        ("wheel_arm_body", "f8", (3,)),
        ("wheel_slip", "f8"),
        ("nhc_arm_body", "f8", (3,)),
        ("nhc_lateral_std", "f8"),
        ("nhc_vertical_std", "f8"),
        ("nhc_angle_std", "f8"),
        ("nhc_slip", "f8"),
        # Ranges: lowest elevation (rad), factor on variances, floors (m, m/s), what lasts in their errors (m).
        ("elevation_mask", "f8"),
        ("range_covariance_scale", "f8"),
        ("code_std_floor", "f8"),
        ("range_rate_std_floor", "f8"),
        ("range_error_std", "f8", (3,)),
        ("gate", "f8", (len(Stream), 4)),
        ("reach", "i8", (len(Stream),)),
        ("constrains", "i8", (len(Stream),)),
        ("static_duration", "f8"),
        ("moving_start_after", "f8"),
        ("still_gyro_std", "f8"),
        ("still_accel_std", "f8"),
        ("moving_tilt_std", "f8"),
        ("initial_heading", "f8"),
        ("initial_heading_std", "f8"),
        ("use_course", "i8"),
        ("found_heading_std", "f8"),
        ("course_min_speed", "f8"),
        ("course_std", "f8"),
        ("good_heading_std", "f8"),
        # Memory of an earlier run: biases, place and heading of base_link (see ``warm_start``).
        ("has_memory", "i8"),
        ("remembered_accel_bias", "f8", (3,)),
        ("remembered_accel_bias_std", "f8"),
        ("remembered_gyro_bias", "f8", (3,)),
        ("remembered_gyro_bias_std", "f8"),
        ("remembered_place_ecef", "f8", (3,)),
        ("remembered_place_std", "f8"),
        ("remembered_place_tolerance", "f8"),
        ("remembered_forward_ecef", "f8", (3,)),
        ("remembered_heading_std", "f8"),
        ("output_interval", "i8"),
        *((f"{name}_at", "i8") for name in OPTIONAL_SIZES),
        ("optional_std", "f8", (OPTIONAL_CAPACITY,)),
        ("optional_noise_density", "f8", (OPTIONAL_CAPACITY,)),
        ("optional_decay", "f8", (OPTIONAL_CAPACITY,)),
    ],
    align=True,
)
"""Parameters as the kernels use them: radians, body axes, gate thresholds by stream and degrees of freedom.

``reach``: how many errors have to be in use for a measurement of a stream. ``constrains``: which constraints are
switched on. ``NAME_at``: place of an optional error, or
`NOWHERE`. ``optional_*``, from the first place behind the core: standard deviation at first, white noise that drives it
(unit/rtHz), inverse correlation time (1/s).
"""


WORK = np.dtype(
    [
        ("half", "f8", (ACCEL_BIAS, ERROR_SIZE)),
        ("turned", "f8", (ERROR_SIZE, ACCEL_BIAS)),
        ("jacobian", "f8", (3, ERROR_CAPACITY)),
        ("innovation", "f8", (3,)),
        ("noise", "f8", (3, 3)),
        ("effect", "f8", (3, 4)),
        ("shared", "f8", (3, ERROR_CAPACITY)),
        ("projected", "f8", (3, ERROR_CAPACITY)),
        ("innovation_covariance", "f8", (3, 3)),
        ("noise_seen", "f8", (3, 3)),
        ("gain", "f8", (ERROR_CAPACITY, 3)),
        ("residual_gain", "f8", (ERROR_CAPACITY, 3)),
        ("correction", "f8", (ERROR_CAPACITY,)),
        # The signals of one epoch, and their least squares (see ``ranges``).
        ("signal_count", "i8"),
        ("signal_index", "i8", (LARGEST_EPOCH,)),
        ("signal_innovation", "f8", (LARGEST_EPOCH,)),
        ("signal_spread", "f8", (LARGEST_EPOCH,)),
        ("signal_noise", "f8", (LARGEST_EPOCH,)),
        ("signal_direction", "f8", (LARGEST_EPOCH, 3)),
        ("signal_weight", "f8", (LARGEST_EPOCH,)),
        ("signal_residual", "f8", (LARGEST_EPOCH,)),
        ("signal_square", "f8", (LARGEST_EPOCH,)),
        ("sorted", "f8", (LARGEST_EPOCH,)),
        ("normal", "f8", (4, 4)),
        ("right", "f8", (4,)),
        ("step", "f8", (4,)),
    ],
    align=True,
)
"""Scratch memory of the kernels: nothing is allocated per sample.

``shared``: covariance of the noise of a measurement with the errors, zero but where an aid says otherwise.
"""


_EVIDENCE = (
    "given_stamp",
    "still_stamp",
    "motion_stamp",
    "last_fix_stamp",
    "anchor_stamp",
    "block_end",
    "moving_stamp",
    "resting_stamp",
    "quiet_fix_stamp",
    "quiet_pressure_stamp",
    "wheel_stamp",
    "slip_stamp",
)
_RECOVERY = ("aid_stamp", "aid_fused_stamp", "aid_fused_since", "track_stamp", "reset_stamp")
_MONITORS = ("fault_stamp", "departure_stamp", "seen_stamp", "heading_mark_stamp")


def blank_state() -> np.ndarray:
    """Return the state before the first IMU sample."""
    state = allocate(STATE)
    stamps = ("stamp", "imu_stamp", "first_stamp", "window_start", "absolute_stamp", "disturbed_stamp")
    for field in (*stamps, *_EVIDENCE, *_RECOVERY, *_MONITORS):
        state[field] = NEVER
    state["scatter"] = state["scatter_paid"] = 1.0
    state["attitude"][0, 0] = 1.0
    state["kept_gyro_variance"] = np.inf
    state["error_size"] = ERROR_SIZE
    # Until there are two samples: longer than any gap, so that the first interval takes no bend from an earlier one.
    state["imu_interval"] = 1e9
    return state
