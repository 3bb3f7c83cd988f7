"""Lesson: a complementary filter for the tilt, and what the ESKF does better."""

from __future__ import annotations

import numpy as np
from lesson import BLUE, GREEN, ORANGE, RED, Array, Lesson, Outcome, navigate, number, two_panels
from scipy.spatial.transform import Rotation

from eskf_ros.simulate.recording import Recording
from eskf_ros.simulate.scenario import simulate

TIME_CONSTANTS = (0.5, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""s"""
STANDS = 18.0
"""s in which the gyro bias is averaged at rest."""

TEXT = """
## What happens

Roll and pitch of a car in a city, by an industrial IMU. The complementary filter is the one of most flight controllers
and of many drivers: the gyro turns the direction of up, the accelerometer pulls it back with a time constant,

    up += (up x omega + (f/|f| - up) / tau) dt

five lines of numpy ([the file](../../examples/lessons/complementary_filter.py)), no covariance, no GNSS. It is run for
time constants from 0.5 to 300 s, with the gyro as it is and with the mean of its first {stands} s (at rest) taken off.

## What comes out

| | tilt error, deg rms | largest |
|---|---|---|
| complementary, tau {best_raw} s, the best, gyro as it is | {rms_raw} | {worst_raw} |
| complementary, tau {best} s, the best, bias taken off at rest | {rms} | {worst} |
| complementary, tau 0.5 s, bias taken off | {rms_short} | {worst_short} |
| ESKF | {rms_eskf} | {worst_eskf} |

The left picture is why. The complementary filter takes the accelerometer for a plumb line, and it is one only at rest:
in a bend of 2 m/s2 it shows atan(2/9.81) = 11.5 deg. With a short time constant it believes this, with a long one it
drifts by tau times the gyro bias. Between the two is a best one, but it depends on the drive and on the bias, and in a
long bend it is wrong whatever the constant. What is left at {best} s is the level of the start: a bias of the
accelerometer looks like a tilt, and at rest nobody can tell the two apart. The ESKF begins with the same error, and
loses it in the first bends (right picture).

The ESKF asks the receiver: what the velocity does over the second is the acceleration, and what is left of the specific
force is gravity. So a bend is no disturbance but a source of information; it is in bends that the filter learns the
heading and tells tilt from bias. And its gain is not a constant: it is large at the start, small when all is known,
and each state has its own.

## What to take home

A complementary filter is a Kalman filter with a constant gain and without the equation of motion. It is good where
accelerations are short and biases small (a hovering drone). Its error has no sigma: it cannot say when it is wrong.
"""


def complementary(recording: Recording, time_constant: float, gyro_bias: Array) -> Array:
    """Return the direction of up (n, 3) in IMU axes: gyro, pulled towards the accelerometer (s, rad/s)."""
    interval = 1.0 / recording.options.imu_rate
    gain = interval / time_constant
    pull = recording.specific_force / np.linalg.norm(recording.specific_force, axis=1)[:, None]
    # A direction fixed on Earth turns against the body; here as rotation matrices of all intervals.
    turns = Rotation.from_rotvec(-(recording.angular_rate - gyro_bias) * interval).as_matrix()
    up = np.empty_like(pull)
    up[0] = pull[0]
    for k in range(1, len(up)):
        turned = turns[k] @ up[k - 1]
        turned += gain * (pull[k] - turned)
        up[k] = turned / np.sqrt(turned @ turned)
    return up


def tilt_error(recording: Recording, up: Array) -> Array:
    """Return the angle (n,) deg between ``up`` and the true one, at the stamps of the truth."""
    _, at, imu_at = np.intersect1d(recording.truth_stamp, recording.imu_stamp, return_indices=True)
    truth = Rotation.from_quat(recording.truth_attitude_body_to_map[at][:, [1, 2, 3, 0]])
    true_up = truth.inv().apply([0.0, 0.0, 1.0])
    return np.asarray(np.degrees(np.linalg.norm(np.cross(up[imu_at], true_up), axis=1)))


def run(runs: int) -> Outcome:
    """Sweep the time constant; compare with the filter."""
    recording = simulate("drive", 1, outages=(), imu_rate=100.0)
    eskf = navigate(recording)
    moving = 25.0
    eskf_tilt = np.degrees(np.hypot(eskf.rotation_error[:, 0], eskf.rotation_error[:, 1]))
    at_rest = recording.angular_rate[: round(STANDS * recording.options.imu_rate)].mean(axis=0)
    truth_seconds = (recording.truth_stamp - recording.imu_stamp[0]) * 1e-9
    errors = {
        name: [tilt_error(recording, complementary(recording, tau, bias)) for tau in TIME_CONSTANTS]
        for name, bias in (("raw", np.zeros(3)), ("calibrated", at_rest))
    }
    after = truth_seconds > moving
    rms = {name: [float(np.sqrt(np.mean(e[after] ** 2))) for e in values] for name, values in errors.items()}
    best = {name: int(np.argmin(values)) for name, values in rms.items()}
    eskf_rms = eskf.rms(eskf_tilt, moving)
    figure, left, right = two_panels()
    left.loglog(TIME_CONSTANTS, rms["raw"], "o-", color=RED, label="complementary, gyro as it is")
    left.loglog(TIME_CONSTANTS, rms["calibrated"], "o-", color=ORANGE, label="bias taken off at rest")
    left.axhline(eskf_rms, color=BLUE, label="ESKF")
    left.set(xlabel="time constant, s", ylabel="tilt error, deg rms")
    left.legend(fontsize=8)
    short = TIME_CONSTANTS.index(0.5)
    shown = truth_seconds < 160.0
    right.semilogy(truth_seconds[shown], errors["calibrated"][short][shown], color=GREEN, linewidth=0.7, label="0.5 s")
    middle = errors["calibrated"][best["calibrated"]]
    label = f"{TIME_CONSTANTS[best['calibrated']]:g} s"
    right.semilogy(truth_seconds[shown], middle[shown], color=ORANGE, linewidth=0.7, label=label)
    right.semilogy(eskf.seconds[eskf.seconds < 160.0], eskf_tilt[eskf.seconds < 160.0], color=BLUE, label="ESKF")
    right.set(xlabel="time, s", ylabel="tilt error, deg", ylim=(0.003, 30.0))
    right.legend(fontsize=8)
    figures = {"stands": number(STANDS), "rms_eskf": number(eskf_rms)}
    figures["worst_eskf"] = number(float(np.nanmax(eskf_tilt[eskf.seconds > moving])))
    picks = (("_raw", "raw", best["raw"]), ("", "calibrated", best["calibrated"]), ("_short", "calibrated", short))
    for suffix, name, index in picks:
        figures[f"rms{suffix}"] = number(rms[name][index])
        figures[f"worst{suffix}"] = number(float(errors[name][index][after].max()))
        figures[f"best{suffix}"] = f"{TIME_CONSTANTS[index]:g}"
    return Outcome(
        figures=figures,
        claims={
            "there is a best constant": 0 < best["raw"] < len(TIME_CONSTANTS) - 1,
            "too short is worse": rms["calibrated"][short] > 1.5 * rms["calibrated"][best["calibrated"]],
            "the ESKF is better than the best of them": eskf_rms < 0.7 * rms["calibrated"][best["calibrated"]],
        },
        picture=figure,
    )


LESSON = Lesson(
    name="complementary_filter",
    title="Complementary filter against ESKF",
    sentence="The best of seven time constants has {rms} deg rms of tilt after calibration ({rms_raw} without), the "
    "ESKF {rms_eskf} deg.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 1 --out drive.mcap
.venv/bin/eskf_replay drive.mcap --config car.yaml --truth truth --report
```

`car.yaml` has the parameters that `eskf_simulate` prints.
""",
    run=run,
)
