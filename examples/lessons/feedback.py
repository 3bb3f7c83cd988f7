"""Lesson: an error state that is fed back, and one that is only subtracted (feed-forward)."""

from __future__ import annotations

import math

import numpy as np
from lesson import BLUE, ORANGE, RED, Array, Lesson, Outcome, number, two_panels

from eskf_ros.simulate.scenario import trajectory

RATE = 50.0
FIX_EVERY = 10
"""IMU samples."""
FIX_STD = 1.0
"""m"""
GYRO_NOISE, ACCEL_NOISE = 1e-3, 0.02
"""rad/s and m/s2 of one sample."""
ACCEL_BIAS_PER_GYRO_BIAS = 20.0
"""(m/s2) / (rad/s): a consumer IMU has 0.2 and 0.01."""
GYRO_BIASES = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
"""rad/s"""

TEXT = """
## What happens

A plane world: a car, two accelerometers, one gyro, fixes of 1 m at 5 Hz. The error-state filter has eight states:
position, velocity, heading, gyro bias, two accelerometer biases
([the file](../../examples/lessons/feedback.py), numpy only). It is built in two ways that share every line but two:

- **feed-forward** (open loop): the INS runs on its own for ever. The filter estimates its error, and the user gets the
  difference.
- **feedback** (closed loop): after each fix the estimated error is put into the INS, biases too, and the error state
  is zero again.

For a linear system the two are the same. {runs} drives of five minutes for each of five sizes of biases.

## What comes out

| gyro bias | feed-forward, m rms | feedback, m rms | heading of the free INS at the end, deg off |
|---|---|---|---|
| 0.006 deg/s | {forward_0} | {back_0} | {free_0} |
| 0.017 deg/s | {forward_1} | {back_1} | {free_1} |
| 0.057 deg/s | {forward_2} | {back_2} | {free_2} |
| 0.17 deg/s | {forward_3} | {back_3} | {free_3} |
| 0.57 deg/s | {forward_4} | {back_4} | {free_4} |

As long as the free INS is off by a few degrees there is no difference. Then feed-forward fails: the error equations are
a linearisation around the INS. R(heading) is taken at a heading that is wrong by tens of degrees, sin of the error is
replaced by the error, and the second order that was left out is larger than what the filter estimates. Its covariance
knows nothing of this: it comes from the same linearisation.

Feedback keeps the point of linearisation at the estimate, so that the error state is small by construction, and what
was neglected is the square of something small. That is the whole reason for "error state": not that errors are
estimated, but that they are small.

## What to take home

Feed-forward is for an INS that one must not touch (an aircraft's, navigation grade, which drifts a mile in an hour).
With MEMS sensors close the loop, biases included. This package does; see [theory](../theory.md).
"""


def turn(heading: float) -> Array:
    """Return the rotation (2, 2) from the car to the map."""
    return np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])


def transition(heading: float, force: Array) -> Array:
    """Return the transition (8, 8) of the error (estimate minus truth) over one sample.

    The order is position, velocity, heading, gyro bias, accelerometer biases; ``force`` (2,) is in the car.
    """
    interval, rotation = 1.0 / RATE, turn(heading)
    f = np.eye(8)
    f[0:2, 2:4] = np.eye(2) * interval
    f[2:4, 4] = rotation @ np.array([-force[1], force[0]]) * interval
    f[2:4, 6:8] = -rotation * interval
    f[4, 5] = -interval
    return f


def navigate_plane(seed: int, gyro_bias: float, is_fed_back: bool) -> tuple[Array, Array, float]:
    """Return times (n,) s, the position error (n,) m, and how far the heading of the INS is off at the end (deg)."""
    rng = np.random.default_rng(seed)
    path = trajectory("drive")
    times = np.arange(20.0, path.duration - 1.0, 1.0 / RATE)
    truth = path.motion(times)
    heading = np.unwrap(np.arctan2(truth.rotation_body_to_map[:, 1, 0], truth.rotation_body_to_map[:, 0, 0]))
    rate = np.diff(heading) * RATE
    middle = 0.5 * (heading[1:] + heading[:-1])
    push = np.diff(truth.velocity_map[:, :2], axis=0) * RATE
    signs = rng.choice([-1.0, 1.0], 3)
    biases = np.array([1.0, ACCEL_BIAS_PER_GYRO_BIAS, ACCEL_BIAS_PER_GYRO_BIAS]) * signs * gyro_bias
    position, velocity, yaw = truth.position_map[0, :2].copy(), truth.velocity_map[0, :2].copy(), heading[0]
    found = np.zeros(3)
    error = np.zeros(8)
    stds = np.array([1.0, 1.0, 0.1, 0.1, 0.05, gyro_bias, *[ACCEL_BIAS_PER_GYRO_BIAS * gyro_bias] * 2])
    covariance = np.diag(stds**2)
    noise = np.diag([0.0, 0.0, *[(ACCEL_NOISE / RATE) ** 2] * 2, (GYRO_NOISE / RATE) ** 2, 0.0, 0.0, 0.0])
    errors = np.zeros(len(rate))
    for k in range(len(rate)):
        force = turn(middle[k]).T @ push[k] + biases[1:] + ACCEL_NOISE * rng.standard_normal(2) - found[1:]
        spin = rate[k] + biases[0] + GYRO_NOISE * rng.standard_normal() - found[0]
        f = transition(yaw + 0.5 * spin / RATE, force)
        step = turn(yaw + 0.5 * spin / RATE) @ force / RATE
        position, velocity, yaw = position + (velocity + 0.5 * step) / RATE, velocity + step, yaw + spin / RATE
        error = f @ error
        covariance = f @ covariance @ f.T + noise
        if k % FIX_EVERY == FIX_EVERY - 1:
            fix = truth.position_map[k + 1, :2] + FIX_STD * rng.standard_normal(2)
            gain = covariance[:, :2] @ np.linalg.inv(covariance[:2, :2] + FIX_STD**2 * np.eye(2))
            error = error + gain @ (position - fix - error[:2])
            keep = np.eye(8)
            keep[:, :2] -= gain
            covariance = keep @ covariance @ keep.T + FIX_STD**2 * gain @ gain.T
            if is_fed_back:
                position, velocity, yaw = position - error[:2], velocity - error[2:4], yaw - error[4]
                found, error = found - error[5:8], np.zeros(8)
        errors[k] = np.linalg.norm(position - error[:2] - truth.position_map[k + 1, :2])
    return times[1:], errors, math.degrees(yaw - heading[-1])


def run(runs: int) -> Outcome:
    """Drive with each size of biases, both ways."""
    figures = {"runs": str(runs)}
    rms: dict[str, list[float]] = {"forward": [], "back": []}
    figure, left, right = two_panels()
    for case, bias in enumerate(GYRO_BIASES):
        for name, label, colour in (("forward", "feed-forward", RED), ("back", "feedback", BLUE)):
            drives = [navigate_plane(seed, bias, name == "back") for seed in range(runs)]
            rms[name].append(float(np.sqrt(np.mean([errors[len(errors) // 3 :] ** 2 for _, errors, _ in drives]))))
            figures[f"{name}_{case}"] = number(rms[name][-1])
            if name == "forward":
                figures[f"free_{case}"] = number(float(np.median([abs(drift) for *_, drift in drives])))
            if case in (1, len(GYRO_BIASES) - 1):
                times, errors, _ = drives[0]
                style = "-" if case > 1 else ":"
                text = f"{label}, {math.degrees(bias):.2g} deg/s"
                left.semilogy(times[::10], errors[::10], style, color=colour, linewidth=0.8, label=text)
    left.set(xlabel="time, s", ylabel="horizontal error, m", ylim=(0.01, 1e4))
    left.legend(fontsize=7, loc="upper left")
    degrees = np.degrees(GYRO_BIASES)
    right.loglog(degrees, rms["forward"], "o-", color=RED, label="feed-forward")
    right.loglog(degrees, rms["back"], "o-", color=BLUE, label="feedback")
    right.axhline(FIX_STD * math.sqrt(2.0), color=ORANGE, linestyle=":", label="the fixes themselves")
    right.set(xlabel="gyro bias, deg/s", ylabel="error of the last two thirds, m rms")
    right.legend(fontsize=8)
    return Outcome(
        figures=figures,
        claims={
            "the same for small biases": rms["forward"][0] < 1.2 * rms["back"][0],
            "feed-forward fails for large ones": rms["forward"][-1] > 20.0 * rms["back"][-1],
            "feedback does not": rms["back"][-1] < FIX_STD,
        },
        picture=figure,
    )


LESSON = Lesson(
    name="feedback",
    title="Feed-forward against feedback",
    sentence="With a gyro bias of 0.006 deg/s {forward_0} m and {back_0} m, with 0.57 deg/s {forward_4} m "
    "(feed-forward) and {back_4} m (feedback).",
    text=TEXT,
    by_hand="The filter of this lesson is in its file; change `GYRO_BIASES` and run it again.",
    run=run,
    runs=3,
)
