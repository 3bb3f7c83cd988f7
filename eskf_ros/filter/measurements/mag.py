"""Magnetometer: the heading, and nothing else, from the direction of the field in the level plane.

Payload: field in the axes of the sensor (T) and its covariance (T2). The field b of the Earth, freed of the hard iron
and turned to local East-North-Up with the estimated attitude, should point to magnetic north, at the angle pi/2 -
declination from east. Its angle atan2(b_n, b_e) contains the yaw error, the tilt error times the tangent of the
inclination, white noise, and disturbances by iron and currents.

Disturbances fixed to the body are the hard iron, an augmented state (T, axes of the sensor). The others are an
augmented state (rad) whose deviation never shrinks with time alone, because a parked robot measures the same wrong
field again and again: a first-order Gauss-Markov process in the angle turned and the distance travelled. A field whose
strength or inclination cannot be the Earth's is disturbed and is not used. Strength and inclination do not correct the
estimate: they would observe the tilt, which the accelerometers observe better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from eskf_ros.compiled import njit
from eskf_ros.filter.history.records import XX, XY, XZ, YY, YZ, ZZ
from eskf_ros.filter.inertial.navigation_frame import local_east_north_up_to_ecef
from eskf_ros.filter.measurements.jacobians import clear, set_attitude_row, to_local
from eskf_ros.filter.measurements.row import (
    NEEDS_FIELD,
    NEEDS_POSITION,
    OptionalBlock,
    Place,
    Readings,
    Row,
    threefold,
    to_base,
)
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.geodesy.rotation import dot, rotate, rotate_back, to_matrix, wrapped
from eskf_ros.parameters.schema import Aid, parameter

EARTH_FIELD = np.dtype(
    [
        ("declination", "f8"),
        ("inclination", "f8"),
        ("strength", "f8"),
        ("field_known", "i8"),
        ("disturbed_stamp", "i8"),
        ("heading", "f8"),
        ("position", "f8", (3,)),
    ],
    align=True,
)
"""The Earth's magnetic field at the last good fix, and the error of its direction.

``declination``, ``inclination`` (rad), ``strength`` (T; 0: unknown), valid once ``field_known``. ``disturbed_stamp``:
when the field was last disturbed (ns). ``heading``, ``position``: heading (rad) and position (m) at the last change of
the error.
"""

WEAKEST_LEVEL = 2.0e-6
"""T; a weaker field in the level plane, as near the magnetic poles, gives no heading."""

TURN = 1.0
"""rad; angle over which the error of the field decorrelates (e-folding)."""

STEP = 0.2
"""Least way, in units of the correlation length, after which the error of the field is propagated."""

FIELD = 12
"""Index in the payload of a fix: whether the Earth's field is known, declination, inclination (rad), strength (T)."""

HOLD = 1_000_000_000
"""ns; after a disturbed field none is used for this long: at its edges a disturbance looks like the Earth's field."""

SIGMAS = 3.0
"""Standard deviations of the hard iron that widen the tolerances of a disturbed field."""


@njit
def earth_field_body(state, payload, settings):
    """Return the measured field (T, IMU axes) without the hard iron."""
    m = (payload[0], payload[1], payload[2])
    place = settings.magnetic_bias_at
    if place < state.error_size:
        b = state.optional[place - ERROR_SIZE : place - ERROR_SIZE + 3]
        m = (m[0] - b[0], m[1] - b[1], m[2] - b[2])
    return rotate(settings.mag.sensor_to_imu, m)


@njit
def predict(state, payload, settings):
    """Return the angle (rad) from east of the measured field in the level plane, minus its estimated error."""
    b = to_local(state, local_east_north_up_to_ecef(state), earth_field_body(state, payload, settings))
    return math.atan2(b[1], b[0]) - state.optional[settings.mag_error_at - ERROR_SIZE]


@njit
def linearize(state, payload, settings, work):
    """Write innovation, Jacobian and noise of one field to ``work``; return the number of scalars."""
    clear(work)
    local_to_ecef = local_east_north_up_to_ecef(state)
    b = to_local(state, local_to_ecef, earth_field_body(state, payload, settings))
    level_square = b[0] ** 2 + b[1] ** 2
    if level_square < WEAKEST_LEVEL**2:
        return 0
    expected = 0.5 * math.pi - state.mag.declination
    work.innovation[0] = wrapped(expected - predict(state, payload, settings))
    # Linearized at the expected direction. The measured one has the noise of the innovation, which would then enter
    # tilt and hard iron as well.
    angle = expected + state.optional[settings.mag_error_at - ERROR_SIZE]
    level = math.sqrt(level_square)
    east, north, slope = math.cos(angle), math.sin(angle), -b[2] / level
    if state.mag.strength > 0.0:
        level = state.mag.strength * math.cos(state.mag.inclination)
        slope = math.tan(state.mag.inclination)
    set_attitude_row(work.jacobian, 0, state, local_to_ecef, (slope * east, slope * north, 1.0))
    work.jacobian[0, settings.mag_error_at] = -1.0

    # How the angle changes with the reading: first in local axes, then in map, body, and the axes of the sensor.
    change = (-north / level, east / level, 0.0)
    change = rotate_back(state.frame.map_to_ecef, rotate(local_to_ecef, change))
    change = rotate_back(settings.mag.sensor_to_imu, rotate_back(to_matrix(state.attitude), change))
    xx, xy, xz, yy, yz, zz = payload[XX], payload[XY], payload[XZ], payload[YY], payload[YZ], payload[ZZ]
    spread = rotate(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)), change)
    work.noise[0, 0] = dot(change, spread)
    if settings.magnetic_bias_at < state.error_size:
        for i in range(3):
            work.jacobian[0, settings.magnetic_bias_at + i] = -change[i]
    return 1


@njit
def update_disturbance(state, aid, settings):
    """Say whether the field is, or was within `HOLD`, other than the Earth's in strength or inclination.

    Strength and inclination are kept for the heading monitor.
    """
    if state.mag.strength <= 0.0:
        return False
    b = to_local(state, local_east_north_up_to_ecef(state), earth_field_body(state, aid.payload, settings))
    strength = math.sqrt(dot(b, b))
    inclination = math.atan2(-b[2], math.hypot(b[0], b[1]))
    state.heading_monitor.field_found[0] = strength
    state.heading_monitor.field_found[1] = inclination
    doubt = 0.0
    place = settings.magnetic_bias_at
    if place < state.error_size:
        for i in range(3):
            doubt = max(doubt, state.covariance[place + i, place + i])
    doubt = SIGMAS * math.sqrt(doubt) / state.mag.strength
    if (
        abs(strength / state.mag.strength - 1.0) > settings.mag.strength_tolerance + doubt
        or abs(inclination - state.mag.inclination) > settings.mag.inclination_tolerance + doubt
    ):
        state.mag.disturbed_stamp = aid.stamp
    return aid.stamp - state.mag.disturbed_stamp < HOLD


@njit
def propagate_mag_error(state, heading, settings):
    """Propagate the error of the field over the way, turned and travelled, since the last step; ``heading`` in rad.

    The error decays by exp(-way) and is driven so that its variance stays the initial one (Gelb, Applied Optimal
    Estimation, section 3.8, with the way in place of the time). Ways shorter than `STEP` wait, so that a parked robot,
    whose estimate trembles, makes no way.
    """
    i = settings.mag_error_at
    p, last = state.position_map, state.mag.position
    distance = math.sqrt((p[0] - last[0]) ** 2 + (p[1] - last[1]) ** 2 + (p[2] - last[2]) ** 2)
    way = distance / settings.mag.error_distance + abs(wrapped(heading - state.mag.heading)) / TURN
    if way < STEP:
        return
    fading = math.exp(-way)
    state.optional[i - ERROR_SIZE] *= fading
    state.forward.fade[i - ERROR_SIZE] *= fading
    covariance = state.covariance
    for j in range(state.error_size):
        covariance[i, j] *= fading
        covariance[j, i] *= fading
    covariance[i, i] += (1.0 - fading**2) * settings.optional_std[i - ERROR_SIZE] ** 2
    state.mag.heading = heading
    for k in range(3):
        state.mag.position[k] = p[k]


@njit
def note_field(state, aid, place):
    """Take the Earth's field from a fused fix or range, which carries it from index ``place`` of its payload on."""
    if aid.verdict == Verdict.FUSED and aid.payload[place] > 0.0:
        state.mag.declination = aid.payload[place + 1]
        state.mag.inclination = aid.payload[place + 2]
        state.mag.strength = aid.payload[place + 3]
        state.mag.field_known = 1


@dataclass(frozen=True)
class Mag(Aid):
    use: bool = parameter(
        False,
        "",
        "Fuse the heading that the magnetometer shows. Off unless asked for: in vehicles, indoors and near iron it "
        "misleads.",
        live=True,
    )
    mount_rpy_deg: tuple[float, ...] = parameter(
        (),
        "deg",
        "Orientation of the magnetometer in base_link: roll, pitch, yaw about fixed axes as in a URDF. "
        "Empty: its axes are those of the IMU.",
        lengths=(0, 3),
        minimum=-360.0,
        maximum=360.0,
    )
    declination_deg: float = parameter(
        math.nan,
        "deg",
        "Angle from true north to magnetic north, east positive. .nan: from the World Magnetic Model for the place of "
        "the fixes and the date of their stamps, for which the Python package pygeomag must be installed.",
        minimum=-180.0,
        maximum=180.0,
        nan_allowed=True,
    )
    error_std_deg: float = parameter(
        4.0,
        "deg",
        "Standard deviation of the heading error that remains after calibration, by iron in the vehicle and nearby. It "
        "does not average out while the vehicle stands.",
        above=0.0,
        maximum=180.0,
    )
    error_distance: float = parameter(
        50.0,
        "m",
        "After this distance, or a turn by one radian, the error by disturbances is another.",
        above=0.0,
        maximum=1.0e6,
    )
    strength_tolerance: float = parameter(
        0.15,
        "",
        "A field is taken for disturbed where its strength differs by more than this part from that of the World "
        "Magnetic Model. Without the model nothing is checked.",
        above=0.0,
        maximum=10.0,
        live=True,
    )
    inclination_tolerance_deg: float = parameter(
        8.0,
        "deg",
        "The same for its inclination (dip).",
        above=0.0,
        maximum=180.0,
        live=True,
    )
    std_floor: float = parameter(
        1.0e-6,
        "T",
        "The standard deviation per axis is never taken smaller than this.",
        above=0.0,
        maximum=1.0,
        live=True,
    )
    unknown_std: float = parameter(
        1.0e-6, "T", "Standard deviation per axis where the message gives none.", above=0.0, maximum=1.0, live=True
    )


SETTINGS = np.dtype(
    [
        ("sensor_to_imu", "f8", (3, 3)),
        ("strength_tolerance", "f8"),
        ("inclination_tolerance", "f8"),
        ("error_distance", "f8"),
    ],
    align=True,
)
"""``sensor_to_imu``: rotation from the axes of the magnetometer to those of the IMU. ``strength_tolerance``,
``inclination_tolerance``: share of the strength and angle (rad) by which a field may differ from the Earth's.
``error_distance``: distance (m) over which the error of the field decorrelates.
"""

STRONGEST_FIELD = 1.0
"""T; no magnetometer on a robot reports more."""


def read(messages: npt.NDArray[Any]) -> Readings:
    """Return fields (T, axes of the magnetometer) with their covariances."""
    return messages["magnetic_field"], messages["magnetic_field_covariance"]


def limits(mag: Mag) -> dict[str, Any]:
    """Return the fields of the `Intake` that the parameters of this measurement determine."""
    return {
        "std_floor": threefold(mag.std_floor),
        "unknown_std": threefold(mag.unknown_std),
        "largest": STRONGEST_FIELD,
    }


def describe(settings: np.void, parameters: Any) -> None:
    """Fill `SETTINGS` from the parameters."""
    mag: Mag = parameters.mag
    imu_to_base = to_base(parameters.imu.mount_rpy_deg)
    mag_to_base = to_base(mag.mount_rpy_deg) if mag.mount_rpy_deg else imu_to_base
    settings["sensor_to_imu"] = imu_to_base.T @ mag_to_base
    settings["strength_tolerance"] = mag.strength_tolerance
    settings["inclination_tolerance"] = math.radians(mag.inclination_tolerance_deg)
    settings["error_distance"] = mag.error_distance


def augmented(parameters: Any) -> tuple[OptionalBlock, ...]:
    """Return the error of the field by disturbances on the way, and the hard iron of the vehicle.

    The former is there whether or not the sensor is used, because use may change while running and indices may not.
    """
    mag, estimate = parameters.mag, parameters.estimate
    return (
        OptionalBlock("mag_error", is_on=True, std=math.radians(mag.error_std_deg), streams=(Stream.MAG,)),
        OptionalBlock(
            "magnetic_bias", is_on=estimate.magnetic_bias, std=estimate.magnetic_bias_std, streams=(Stream.MAG,)
        ),
    )


ROW = Row(
    Stream.MAG,
    "magnetometer",
    Mag,
    "Magnetometer.",
    types=("sensor_msgs/msg/MagneticField",),
    topic="imu/mag",
    topic_about="sensor_msgs/MagneticField: field in the axes of the magnetometer.",
    read=read,
    limits=limits,
    needs=NEEDS_POSITION | NEEDS_FIELD,
    augmented=augmented,
    place=Place(rotation="mag.mount_rpy_deg", inputs=("mag",)),
    settings=SETTINGS,
    describe=describe,
    columns=("field",),
    is_vector=True,
)
"""The facts of this measurement."""
