"""Lesson: a tilt that is wrong by a tenth of a degree leaks gravity into the horizontal."""

from __future__ import annotations

import math

import numpy as np
from lesson import BLUE, GREEN, ORANGE, RED, Array, Lesson, Outcome, navigate, number, two_panels
from scipy.spatial.transform import Rotation

from eskf_ros.simulate.imu import ideal_samples
from eskf_ros.simulate.scenario import simulate, trajectory

RATE = 200.0
TILTS_DEG = {0.02: GREEN, 0.1: BLUE, 0.5: RED}
LENGTH = 60.0
GRAVITY = 9.81

TEXT = """
## What happens

First a perfect IMU: no noise, no bias. A car drives for a minute, and a strapdown of 20 lines of numpy
([the file](../../examples/lessons/tilt_and_gravity.py)) starts with the true position, velocity and heading, but with
the level wrong by 0.02, 0.1 and 0.5 deg. Then the filter, with a real (industrial) IMU: what does it know of its tilt?

## What comes out

| tilt | acceleration that is not there | after 10 s | after 60 s | g·tilt·t²/2 |
|---|---|---|---|---|
| 0.02 deg | {leak_0} m/s2 | {ten_0} m | {sixty_0} m | {formula_0} m |
| 0.1 deg | {leak_1} m/s2 | {ten_1} m | {sixty_1} m | {formula_1} m |
| 0.5 deg | {leak_2} m/s2 | {ten_2} m | {sixty_2} m | {formula_2} m |

An accelerometer cannot tell gravity from acceleration; the strapdown takes gravity away in the direction in which it
believes it. If that is wrong by a small angle, the part g·sin(tilt) is left, and looks like an acceleration sideways.
It is integrated twice, so the error grows with t². All the rest of the IMU was perfect.

A robot at rest levels itself by the accelerometer. But a bias of the accelerometer looks the same as a tilt: 0.05 m/s2
(one sigma of this IMU) over 9.81 m/s2 is {level} deg. The right picture shows it. While the car stands, for 20 s, sigma
of the tilt stays at {standing} deg however long it stands, and it is no better on the straight that follows. The error
does no harm yet, since tilt and bias cancel each other; the filter knows, by their correlation in the covariance. When
the car turns, the tilt stays where it is in the map, the bias turns with the car, and the two no longer cancel: now
they can be told apart, and after a minute sigma is {moving} deg.

## What to take home

Tilt is the error that costs most, and it is not seen while it is made. A bias of the accelerometer is worth estimating
only together with the tilt. Whoever levels a robot and writes zero for the correlation gets a filter that is sure of
both, and wrong in both at the first bend.
"""


def strapdown(tilt: float) -> tuple[Array, Array]:
    """Return times (n,) s and the position error (n, 3) m of a perfect IMU that starts with a ``tilt`` (rad)."""
    path, frame = trajectory("drive"), simulate("drive", 0, outages=(), stop=1.0).frame
    times = 19.0 + np.arange(int(LENGTH * RATE) + 1) / RATE
    # Samples in the middle of their intervals: the integration is then exact enough to show nothing but the tilt.
    force, rate = ideal_samples(path, frame, times[:-1] + 0.5 / RATE)
    truth = path.motion(times)
    position, velocity = truth.position_map[0].copy(), truth.velocity_map[0].copy()
    quaternion = truth.attitude_body_to_map[0][[1, 2, 3, 0]]
    attitude = (Rotation.from_rotvec([tilt, 0.0, 0.0]) * Rotation.from_quat(quaternion)).as_matrix()
    turns = Rotation.from_rotvec(rate / RATE).as_matrix()
    halves = Rotation.from_rotvec(0.5 * rate / RATE).as_matrix()
    earth = Rotation.from_rotvec(-frame.earth_rate_map / RATE).as_matrix()
    gravity = frame.gravity_map(truth.position_map)
    error = np.zeros((len(times), 3))
    for k in range(len(times) - 1):
        coriolis = 2.0 * np.cross(frame.earth_rate_map, velocity)
        step = (attitude @ halves[k] @ force[k] + gravity[k] - coriolis) / RATE
        position += (velocity + 0.5 * step) / RATE
        velocity += step
        attitude = earth @ attitude @ turns[k]
        error[k + 1] = position - truth.position_map[k + 1]
    return times - times[0], error


def run(runs: int) -> Outcome:
    """Integrate with wrong tilts; then show what the filter knows of its own."""
    figure, left, right = two_panels()
    figures: dict[str, str] = {}
    ratios = []
    for case, (tilt_deg, colour) in enumerate(TILTS_DEG.items()):
        tilt = math.radians(tilt_deg)
        seconds, error = strapdown(tilt)
        horizontal = np.hypot(error[:, 0], error[:, 1])
        formula = 0.5 * GRAVITY * tilt * seconds**2
        left.loglog(seconds[1:], horizontal[1:], color=colour, label=f"{tilt_deg:g} deg")
        left.loglog(seconds[1:], formula[1:], ":", color=colour)
        ten, sixty = (float(horizontal[round(length * RATE)]) for length in (10.0, LENGTH))
        ratios.append(sixty / float(formula[-1]))
        figures |= {
            f"leak_{case}": number(GRAVITY * tilt),
            f"ten_{case}": number(ten),
            f"sixty_{case}": number(sixty),
            f"formula_{case}": number(float(formula[-1])),
        }
    left.set(xlabel="time, s", ylabel="horizontal error, m", xlim=(1.0, LENGTH), ylim=(1e-3, 300.0))
    left.legend(fontsize=8, title="tilt (dotted: g tilt t²/2)", title_fontsize=8)
    track = navigate(simulate("drive", 1, outages=()))
    tilt_sigma = np.degrees(np.hypot(track.rotation_sigma[:, 0], track.rotation_sigma[:, 1]) / math.sqrt(2.0))
    bias_sigma = track.rows["accel_bias_std"][:, :2].mean(axis=1)
    shown = (track.seconds > 2.0) & (track.seconds < 120.0)
    right.semilogy(track.seconds[shown], tilt_sigma[shown], color=BLUE, label="sigma of the tilt, deg")
    right.semilogy(track.seconds[shown], bias_sigma[shown], color=ORANGE, label="of the accelerometer bias, m/s2")
    right.axvspan(0.0, 20.0, color="0.9")
    right.set(xlabel="time, s (grey: at rest)", xlim=(0.0, 120.0))
    right.legend(fontsize=8)
    standing, moving = track.at(tilt_sigma, 19.0), track.at(tilt_sigma, 80.0)
    level = math.degrees(0.05 / GRAVITY)
    figures |= {"level": number(level), "standing": number(standing), "moving": number(moving)}
    return Outcome(
        figures=figures,
        claims={
            "the error is that of the formula": all(0.8 < ratio < 1.2 for ratio in ratios),
            "at rest the tilt is as good as the accelerometer": abs(standing / level - 1.0) < 0.1,
            "turns tell tilt and bias apart": moving < 0.2 * standing,
        },
        picture=figure,
    )


LESSON = Lesson(
    name="tilt_and_gravity",
    title="Tilt leaks gravity",
    sentence="A tilt of 0.1 deg on a perfect IMU is {sixty_1} m after a minute; at rest the filter cannot know it to "
    "better than {standing} deg.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 1 --out drive.mcap
.venv/bin/eskf_replay drive.mcap --config car.yaml --truth truth --report
```

`car.yaml` has the parameters that `eskf_simulate` prints. Look at attitude and biases in the report.
""",
    run=run,
)
