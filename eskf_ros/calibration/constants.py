"""The constants that are calibrated: the parameter each belongs to, and the motion that shows it.

Each is an augmented state of the filter without process noise (`filter.state.augmented_states`). Parameters that a
calibration has no constant for stay as they are.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.filter.measurements.row import to_base
from eskf_ros.filter.settings import settings_from
from eskf_ros.parameters.mapping import from_mapping, to_mapping
from eskf_ros.parameters.tree import Parameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Constant:
    """One constant: number ``index`` of an augmented block, and ``element`` of a parameter (None: a scalar).

    ``prior_std``, ``least_std``: standard deviation at first, and the least one that is ever told (no model of an
    installation is better than this). ``factor``: what the unit of the parameter is of that of the state. ``needs``:
    inputs, or "vehicle" for one on wheels that do not slip sideways. ``shown_by``: the motion that shows it.
    """

    name: str
    block: str
    index: int
    parameter: str
    element: int | None
    prior_std: float
    least_std: float
    unit: str
    shown_by: str
    needs: tuple[str, ...] = ()
    factor: float = 1.0


TURNS = "turns to the left and to the right, with speed"
TILT = "roll and pitch of the vehicle: ramps, kerbs, rough ground"
SPEED_CHANGES = "speeding up and braking"

MOUNTING_LEAST_DEG = 0.05
"""deg; load and springs turn a vehicle against its wheels by as much from one drive to the next."""

MOUNTING = ("mounting_yaw", "mounting_pitch")
"""Constants that turn base_link itself: `changed` treats them apart."""

CONSTANTS = (
    *(
        Constant(f"lever_arm_{axis}", "lever_arm", k, "gnss.lever_arm", k, 1.0, 0.005, "m", TILT if k == 2 else TURNS)
        for k, axis in enumerate("xyz")
    ),
    Constant("time_offset", "time_offset", 0, "gnss.time_offset", None, 0.2, 0.0005, "s", SPEED_CHANGES),
    Constant(
        "velocity_time_offset",
        "velocity_time_offset",
        0,
        "gnss.velocity_time_offset",
        None,
        0.2,
        0.0005,
        "s",
        SPEED_CHANGES,
        ("gnss_velocity",),
    ),
    *(
        Constant(
            f"accel_scale_{axis}",
            "imu_scale",
            k,
            "imu.accel_scale",
            k,
            0.01,
            2e-4,
            "",
            "accelerations along this axis, strong and in both directions (along the vertical: the IMU turned over)",
        )
        for k, axis in enumerate("xyz")
    ),
    *(
        Constant(
            f"gyro_scale_{axis}", "imu_scale", 3 + k, "imu.gyro_scale", k, 0.01, 2e-4, "", "large turns about this axis"
        )
        for k, axis in enumerate("xyz")
    ),
    Constant(
        "mounting_yaw",
        "mounting",
        0,
        "imu.mount_rpy_deg",
        2,
        math.radians(5.0),
        math.radians(MOUNTING_LEAST_DEG),
        "deg",
        "driving straight on, after turns that show the heading",
        ("vehicle",),
        math.degrees(1.0),
    ),
    Constant(
        "mounting_pitch",
        "mounting",
        1,
        "imu.mount_rpy_deg",
        1,
        math.radians(5.0),
        math.radians(MOUNTING_LEAST_DEG),
        "deg",
        "driving straight on, with speed",
        ("vehicle",),
        math.degrees(1.0),
    ),
    Constant("wheel_scale", "wheel_scale", 0, "wheel.scale", None, 0.05, 2e-4, "", "driving with speed", ("wheel",)),
    Constant(
        "wheel_time_offset",
        "wheel_time_offset",
        0,
        "wheel.time_offset",
        None,
        0.5,
        0.0005,
        "s",
        SPEED_CHANGES,
        ("wheel",),
    ),
    Constant("nhc_position", "nhc_position", 0, "nhc.position", 0, 2.0, 0.01, "m", TURNS, ("vehicle",)),
    Constant(
        "heading_offset",
        "heading_offset",
        0,
        "heading.mount_rpy_deg",
        2,
        math.radians(3.0),
        math.radians(0.02),
        "deg",
        "accelerations, which show the heading without the baseline",
        ("heading",),
        math.degrees(1.0),
    ),
)


def constants_of(inputs: Collection[str], is_vehicle: bool) -> tuple[Constant, ...]:
    """Return the constants that recordings with these inputs may show."""
    there = {*inputs, *(("vehicle",) if is_vehicle else ())}
    return tuple(constant for constant in CONSTANTS if set(constant.needs) <= there)


def as_states(parameters: Parameters, constants: Sequence[Constant], is_vehicle: bool, first_std: Array) -> Parameters:
    """Return the parameters with the constants as augmented states without process noise.

    ``first_std`` (n,): their standard deviations at first, as `begin_stds` returns them.
    """
    values: dict[str, Any] = dict(to_mapping(parameters))
    stds = dict(zip((constant.block for constant in constants), first_std.tolist(), strict=True))
    values |= {
        "nhc.enabled": is_vehicle,
        "estimate.lever_arm": "lever_arm" in stds,
        "estimate.time_offset": "time_offset" in stds,
        "estimate.imu_scale": "imu_scale" in stds,
        "estimate.nhc_position": "nhc_position" in stds,
        "estimate.mounting": "mounting" in stds,
        "estimate.mounting_random_walk": 0.0,
        "estimate.wheel_scale": "wheel_scale" in stds,
        "estimate.wheel_scale_random_walk": 0.0,
        "heading.offset_random_walk": 0.0,
    }
    for block, name in STD_PARAMETERS.items():
        if block in stds:
            values[name] = math.degrees(stds[block]) if name.endswith("_deg") else stds[block]
    return from_mapping(values)


STD_PARAMETERS = {
    "lever_arm": "estimate.lever_arm_std",
    "time_offset": "estimate.time_offset_std",
    "imu_scale": "estimate.imu_scale_std",
    "nhc_position": "estimate.nhc_position_std",
    "mounting": "estimate.mounting_std_deg",
    "wheel_scale": "estimate.wheel_scale_std",
    "heading_offset": "heading.offset_std_deg",
}
"""The parameters of the standard deviations at first, by block; one for all elements, and for all time offsets."""


def begin_stds(constants: Sequence[Constant], wanted: Array) -> Array:
    """Return the standard deviations (n,) with which a filter begins that should begin with ``wanted`` or more."""
    kinds = ["time_offset" if c.block.endswith("time_offset") else c.block for c in constants]
    largest = {kind: max(std for k, std in zip(kinds, wanted.tolist(), strict=True) if k == kind) for kind in kinds}
    return np.array([largest[kind] for kind in kinds])


def places_of(parameters: Parameters, constants: Collection[Constant]) -> list[int]:
    """Return the indices of the constants in the error state of a filter with these parameters."""
    settings = settings_from(parameters)[0]
    return [int(settings[f"{constant.block}_at"]) + constant.index for constant in constants]


def changed(parameters: Parameters, corrections: Mapping[str, float]) -> Parameters:
    """Return the parameters with ``corrections`` by name of the constant, in the units of the states.

    Yaw and pitch of the vehicle's axes in base_link make these axes the new base_link: IMU and, where they are among
    the corrections, antenna and baseline of a dual antenna are described anew in it, as they are where they were.
    """
    values: dict[str, Any] = dict(to_mapping(parameters))
    for constant in CONSTANTS:
        change = corrections.get(constant.name, 0.0) * constant.factor
        if constant.name in MOUNTING or change == 0.0:
            continue
        if constant.element is None:
            values[constant.parameter] += change
        else:
            vector = list(values[constant.parameter])
            vector[constant.element] += change
            values[constant.parameter] = vector
    angles = [corrections.get(name, 0.0) for name in ("mounting_roll", *reversed(MOUNTING))]
    if any(angles):
        vehicle_to_base = Rotation.from_euler("xyz", angles)
        imu_to_vehicle = vehicle_to_base.inv() * Rotation.from_matrix(to_base(parameters.imu.mount_rpy_deg))
        values["imu.mount_rpy_deg"] = rpy_deg(imu_to_vehicle)
        if any(name.startswith("lever_arm") for name in corrections):
            mount = np.array(values["imu.mount_position"])
            arm = vehicle_to_base.inv().apply(np.array(values["gnss.lever_arm"]) - mount)
            values["gnss.lever_arm"] = (mount + arm).tolist()
        if "heading_offset" in corrections:
            baseline_to_base = Rotation.from_matrix(to_base(tuple(values["heading.mount_rpy_deg"])))
            values["heading.mount_rpy_deg"] = rpy_deg(vehicle_to_base.inv() * baseline_to_base)
    return from_mapping(values)


def rpy_deg(rotation: Rotation) -> list[float]:
    """Return roll, pitch, yaw (deg, fixed axes)."""
    return [float(angle) for angle in rotation.as_euler("xyz", degrees=True)]


def value_of(parameters: Parameters, constant: Constant) -> float:
    """Return the value of the constant in the parameters, in the unit of these."""
    value: Any = parameters
    for part in constant.parameter.split("."):
        value = getattr(value, part)
    return float(value if constant.element is None else value[constant.element])


def with_mounting(parameters: Parameters, rpy: list[float]) -> Parameters:
    """Return the parameters with another orientation of the IMU (deg)."""
    return dataclasses.replace(parameters, imu=dataclasses.replace(parameters.imu, mount_rpy_deg=tuple(rpy)))
