"""Memory layout of the estimator: the records of the rooms put together.

Everything the compiled kernels touch is a numpy record with named fields, so that ``state.position_map`` is the same
code compiled and plain, and a checkpoint is one assignment. Units are SI; stamps are integer nanoseconds. A room
defines its own record, in the file that writes it; a kernel says with ``state.ROOM.field`` whose memory it touches.

Body axes are the axes of the IMU and the body origin is the IMU: biases, noise and lever arms refer to them.
``output/global_odometry.py`` turns the result into base_link.
"""

from __future__ import annotations

import numpy as np

from eskf_ros.filter.alignment.heading_from_turning import SPOT
from eskf_ros.filter.alignment.heading_search import SEARCH
from eskf_ros.filter.alignment.heading_sensors import CANDIDATE
from eskf_ros.filter.alignment.levelling import LEVELLING
from eskf_ros.filter.inertial.covariance import EXCITATION, TURNED_COLUMNS
from eskf_ros.filter.inertial.gyro_noise import GYRO_NOISE
from eskf_ros.filter.inertial.navigation_frame import FRAME
from eskf_ros.filter.inertial.sample_quality import LEAST_FORCE_JUMP, LEAST_RATE_JUMP, SAMPLE_QUALITY
from eskf_ros.filter.inertial.stamps import IMU_STAMPS
from eskf_ros.filter.inertial.strapdown import IMU_READINGS
from eskf_ros.filter.integrity.departure import DEPARTURE
from eskf_ros.filter.integrity.fault_effects import FAULTS
from eskf_ros.filter.integrity.heading_corrections import CORRECTIONS
from eskf_ros.filter.integrity.heading_monitor import HEADING_MONITOR
from eskf_ros.filter.integrity.heading_trial import TRIAL
from eskf_ros.filter.integrity.humble_lane import TRUST
from eskf_ros.filter.integrity.imu_monitor import IMU_MONITOR
from eskf_ros.filter.integrity.installation_monitor import INSTALLATION
from eskf_ros.filter.integrity.motion_monitor import MOTION
from eskf_ros.filter.integrity.receiver_monitor import RECEIVER_MONITOR
from eskf_ros.filter.integrity.recovery import RECOVERY
from eskf_ros.filter.integrity.repeated_fixes import REPEATED_FIXES
from eskf_ros.filter.integrity.scatter import SCATTER
from eskf_ros.filter.measurements.mag import EARTH_FIELD
from eskf_ros.filter.output.forward_log import FORWARD
from eskf_ros.filter.output.local_odometry import STEP
from eskf_ros.filter.rows import ROWS
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import (
    ACCEL_BIAS,
    ERROR_CAPACITY,
    ERROR_SIZE,
    OPTIONAL_CAPACITY,
    OPTIONAL_SIZES,
    SOURCES,
)
from eskf_ros.filter.state.lanes import LANES
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.state.streams import STREAMS
from eskf_ros.filter.state.time import NEVER
from eskf_ros.filter.stationarity.detector import REST
from eskf_ros.filter.stationarity.residual_motion import RESIDUAL_MOTION
from eskf_ros.filter.stationarity.seen_motion import SEEN_MOTION
from eskf_ros.filter.stationarity.static_window import STATIC_WINDOW
from eskf_ros.filter.tight.epoch_least_squares import LARGEST_EPOCH
from eskf_ros.filter.tight.receiver_clock import TIGHT

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
        # Augmented states in the order of their indices; how many errors are active, the core's included.
        ("optional", "f8", (OPTIONAL_CAPACITY,)),
        ("error_size", "i8"),
        # Covariance of the first ``error_size`` errors; the attitude error is a small rotation on the map side.
        ("covariance", "f8", (ERROR_CAPACITY, ERROR_CAPACITY)),
        # Raw IMU reading at ``stamp``.
        ("specific_force", "f8", (3,)),
        ("angular_rate", "f8", (3,)),
        # What the alignment has found, its first stamp, and how often it was restarted.
        ("level_known", "i8"),
        ("position_known", "i8"),
        ("heading_known", "i8"),
        ("first_stamp", "i8"),
        ("restarts", "i8"),
        # How much the IMU noise is widened, from 0 (as the parameters say) to 1 (as for the humble lane).
        ("doubt", "f8"),
        ("bias_doubt", "f8"),
        # The records of the rooms.
        ("imu", IMU_READINGS),
        ("excitation", EXCITATION),
        ("stamps", IMU_STAMPS),
        ("quality", SAMPLE_QUALITY),
        ("gyro_noise", GYRO_NOISE),
        ("frame", FRAME),
        ("odom", STEP),
        ("search", SEARCH),
        ("spot", SPOT),
        ("heading", CANDIDATE),
        ("window", STATIC_WINDOW),
        ("residual", RESIDUAL_MOTION),
        ("rest", REST),
        ("seen", SEEN_MOTION),
        ("levelling", LEVELLING),
        ("imu_monitor", IMU_MONITOR),
        ("heading_monitor", HEADING_MONITOR),
        ("recovery", RECOVERY),
        ("trust", TRUST),
        ("trial", TRIAL),
        ("corrections", CORRECTIONS),
        ("receiver", RECEIVER_MONITOR),
        ("installation", INSTALLATION),
        ("motion", MOTION),
        ("departure", DEPARTURE),
        ("mag", EARTH_FIELD),
        ("tight", TIGHT),
        ("streams", STREAMS),
        ("scatter", SCATTER),
        ("repeats", REPEATED_FIXES),
        ("forward", FORWARD),
    ],
    align=True,
)
"""One state of the estimator: all it knows and all it decides with. A copy is a checkpoint."""

SETTINGS = np.dtype(
    [
        ("gyro_noise_density", "f8"),
        ("accel_noise_density", "f8"),
        ("gyro_bias_random_walk", "f8"),
        ("accel_bias_random_walk", "f8"),
        ("humble_noise", "f8", (4,)),
        ("has_humble_lane", "i8"),
        ("gyro_bias_std", "f8"),
        ("accel_bias_std", "f8"),
        ("imu_gap", "f8"),
        ("gap_accel_std", "f8"),
        ("gap_gyro_std", "f8"),
        ("imu_to_base", "f8", (3, 3)),
        ("imu_position_base", "f8", (3,)),
        ("lever_arms_body", "f8", (SOURCES, 3)),
        ("gnss_time_offset", "f8", (SOURCES,)),
        ("velocity_time_offset", "f8"),
        ("solves_ranges", "i8"),
        ("gnss_covariance_scale", "f8"),
        ("correlated_share", "f8"),
        ("gate", "f8", (len(Stream), 4)),
        ("reach", "i8", (len(Stream),)),
        ("constrains", "i8", (len(Stream),)),
        ("needs", "i8", (len(Stream),)),
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
        ("quality_position_std", "f8"),
        ("quality_coast_time", "f8"),
        ("quality_settle_time", "f8"),
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
        ("keeps_log", "i8"),
        ("error_capacity", "i8"),
        *((f"{name}_at", "i8") for name in OPTIONAL_SIZES),
        *((row.name, row.settings) for row in ROWS if row.settings.names),
        ("optional_std", "f8", (OPTIONAL_CAPACITY,)),
        ("optional_noise_density", "f8", (OPTIONAL_CAPACITY,)),
        ("optional_decay", "f8", (OPTIONAL_CAPACITY,)),
    ],
    align=True,
)
"""Parameters as the kernels use them: radians, body axes, innovation gates by stream and degrees of freedom.

``humble_noise``: spectral densities of the humble lane (`predict.imu_noise`);
``has_humble_lane``: 1, but 0 where a campaign compares with a filter that trusts itself.
``keeps_log``: whether the forward pass is logged. ``error_capacity``: errors that can come into use.
``reach``: errors that must be active for a measurement of a stream. ``constrains``: which constraints are switched on.
``needs``: what must be known before a measurement of a stream is fused. ``NAME_at``: index of an augmented state, or
`NOWHERE`. ``optional_*``, from the first index behind the core: initial standard deviation, process noise density
(unit/rtHz), inverse correlation time (1/s). The records behind ``NAME_at`` belong to the measurements.
"""


WORK = np.dtype(
    [
        ("half", "f8", (ACCEL_BIAS, ERROR_CAPACITY)),
        ("turned", "f8", (ERROR_SIZE, TURNED_COLUMNS)),
        ("jacobian", "f8", (3, ERROR_CAPACITY)),
        ("innovation", "f8", (3,)),
        ("noise", "f8", (3, 3)),
        ("lever_noise", "f8"),
        ("direct_effect", "f8", (3, FAULTS)),
        ("effect", "f8", (3, FAULTS)),
        ("fault_fit", "f8", (FAULTS + 1, FAULTS + 1)),
        ("is_chosen", "i8", (FAULTS,)),
        ("solution", "f8", (3,)),
        ("solution_covariance", "f8", (3, 3)),
        ("shared", "f8", (3, ERROR_CAPACITY)),
        ("holds_heading", "i8"),
        ("heading_offset_at", "i8"),
        ("projected", "f8", (3, ERROR_CAPACITY)),
        ("innovation_covariance", "f8", (3, 3)),
        ("noise_seen", "f8", (3, 3)),
        ("gain", "f8", (ERROR_CAPACITY, 3)),
        ("residual_gain", "f8", (ERROR_CAPACITY, 3)),
        ("correction", "f8", (ERROR_CAPACITY,)),
        ("missed", "f8", (3,)),
        # The signals of one epoch, and their least squares (see ``tight``).
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

- ``half``, ``turned``: the covariance after one side of the transition, and its transpose.
- ``jacobian``, ``innovation``, ``noise``: the measurement to fuse; ``shared``: covariance of its noise with the errors,
  zero unless the measurement writes it; ``holds_heading``: 1 for GNSS, which shows the heading by accelerations
  alone, and with it the error at ``heading_offset_at``.
- ``projected`` ... ``correction``: intermediate results of the update.
- ``lever_noise``: part of the noise of a fix that is the lever arm of an unknown heading (m2, on two axes of map).
- ``direct_effect``: derivative of the measurement by the faults of its receiver, ``effect``: that of its innovation,
  which the estimate has in part absorbed; ``fault_fit``, ``is_chosen``: normal
  equations of these, and the ones that are estimated (`installation_monitor`, `stepwise`).
- ``solution``, ``solution_covariance``: position or velocity (map) of the antenna from the ranges of one epoch.
- ``signal_*`` ... ``step``: the signals of one epoch and their least squares.
"""


_NEVER = {
    "imu": ("stamp",),
    "stamps": ("raw",),
    "window": (
        "start",
        "still_stamp",
        "motion_stamp",
        "last_fix_stamp",
        "anchor_stamp",
    ),
    "recovery": (
        "absolute_stamp",
        "reset_stamp",
    ),
    "trust": ("doubt_stamp",),
    "trial": ("given_stamp", "moved", "found"),
    "corrections": ("since",),
    "scatter": ("last_stamp", "walk_stamp"),
    "installation": ("stamp", "checked"),
    "motion": ("fix_stamp", "heard_stamp", "velocity_stamp", "start_stamp", "last_stamp", "pause_stamp", "clock_stamp"),
    "departure": ("since",),
    "mag": ("disturbed_stamp",),
    "heading": ("given_stamp", "tried_stamp", "contradicted_since"),
    "heading_monitor": ("given_stamp", "given_moved", "slip_stamp"),
    "rest": (
        "block_end",
        "moving_stamp",
        "resting_stamp",
        "doubt_stamp",
        "changed_stamp",
        "quiet_pressure_stamp",
        "wheel_stamp",
        "slip_stamp",
    ),
    "spot": ("stamp",),
    "seen": ("stamp", "origin_stamp", "turn_stamp"),
    "streams": (
        "last_stamp",
        "fused_stamp",
        "fused_since",
    ),
    "repeats": ("fix_stamp",),
    "forward": ("node_stamp", "breaks", "given_stamp"),
    "receiver": (
        "departure_stamp",
        "seen_stamp",
        "heading_mark_stamp",
    ),
}
"""Stamps that are `NEVER` in the blank state, by room."""


def blank_state() -> np.ndarray:
    """Return the lanes (see `state.lanes`) before the first IMU sample."""
    state = allocate(STATE, LANES)
    state["stamp"] = state["first_stamp"] = NEVER
    for room, fields in _NEVER.items():
        for field in fields:
            state[room][field] = NEVER
    for field in ("spread", "change", "white", "velocity"):
        state["scatter"][field] = 1.0
    state["stamps"]["even"] = 1.0
    state["quality"]["least_jump"] = np.repeat((LEAST_FORCE_JUMP**2, LEAST_RATE_JUMP**2), 3)
    state["quality"]["lowest"], state["quality"]["highest"] = np.inf, -np.inf
    state["quality"]["held_value"] = np.inf
    state["attitude"][:, 0] = 1.0
    state["forward"]["transition"], state["forward"]["reset"] = np.eye(ERROR_SIZE), np.eye(3)
    state["forward"]["fade"] = 1.0
    state["levelling"]["kept_gyro_variance"] = np.inf
    state["error_size"] = ERROR_SIZE
    # Longer than any gap: the first interval is integrated without a curvature from an earlier one.
    state["imu"]["interval"] = 1e9
    return state
