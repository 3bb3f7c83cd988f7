"""Wrong mounting and wrong settings: what the filter is told is not how it is."""

from __future__ import annotations

import math

from campaign.fault import MOVING, WITH_VELOCITY, Fault, Kind
from eskf_ros.simulate.episodes import Episode
from eskf_ros.simulate.gnss_message_episodes import GnssDelay, VelocityInNed
from eskf_ros.simulate.imu_episodes import ImuAxes

FOR_GOOD = math.inf
AXES = ("IMU axes", "IMU mounting")


def _fault(name: str, *episodes: Episode, **more: object) -> Fault:
    return Fault(name, Kind.SETTINGS, episodes, **{"begin": MOVING, "settles": 120.0, **more})  # type: ignore[arg-type]


def settings_faults(amplitude: float = 1.0) -> list[Fault]:
    """Return the faults, their sizes times ``amplitude``."""
    a = amplitude
    return [
        *(
            _fault(
                f"IMU yaw {yaw * a:.3g} deg off",
                parameters={"imu.mount_rpy_deg": (0.0, 0.0, yaw * a)},
                names=("IMU mounting",),
                also=("IMU axes",),
                is_judged_by_name_alone=True,
            )
            for yaw in (5.0, 8.0, 90.0)
        ),
        *(
            _fault(what, ImuAxes(0.0, FOR_GOOD, gyro, accel), names=AXES, is_judged_by_name_alone=True)
            for what, gyro, accel in (
                ("one gyro axis negated", "+x+y-z", "+x+y+z"),
                ("two gyro axes negated", "+x-y-z", "+x+y+z"),
                ("three gyro axes negated", "-x-y-z", "+x+y+z"),
                ("accelerometer x and y swapped", "+x+y+z", "+y+x+z"),
                ("gyro x and y swapped", "+y+x+z", "+x+y+z"),
                ("IMU upside down", "+x-y-z", "+x-y-z"),
            )
        ),
        *(
            _fault(
                f"lever arm {1.5 * a:.3g} m off in {axis}",
                parameters={"gnss.lever_arm": tuple(1.5 * a * (axis == other) for other in "xyz")},
                names=("lever arm",),
            )
            for axis in "xy"
        ),
        _fault(
            f"positions stamped {0.25 * a:.3g} s late",
            GnssDelay(0.0, FOR_GOOD, 0.25 * a, 0.0),
            names=("position offset",),
        ),
        _fault(
            f"velocities stamped {0.13 * a:.3g} s late",
            GnssDelay(0.0, FOR_GOOD, 0.0, 0.13 * a),
            names=("velocity offset",),
            filters=WITH_VELOCITY,
        ),
        _fault(
            f"clocks of IMU and receiver {1.2 * a:.3g} s apart",
            GnssDelay(0.0, FOR_GOOD, 1.2 * a, 1.2 * a),
            names=("clocks apart", "position offset"),
        ),
        _fault(
            "GNSS stamps 4294.97 s ahead",
            GnssDelay(0.0, FOR_GOOD, 4294.967296, 4294.967296),
            names=("clocks apart",),
            is_judged_by_name_alone=True,
        ),
        *(
            _fault(
                f"heading given {wrong:g} deg wrong",
                given_heading_std_deg=5.0,
                given_heading_off_deg=wrong,
                settles=60.0,
                names=("given heading",),
            )
            for wrong in (70.0, 120.0, 180.0)
        ),
        _fault(
            "velocity in north, east, down",
            VelocityInNed(0.0, FOR_GOOD),
            names=("NED velocity",),
            filters=WITH_VELOCITY,
        ),
    ]
