"""Lesson: the antenna is not where the robot is."""

from __future__ import annotations

import numpy as np
from lesson import BLUE, RED, Lesson, Outcome, Track, navigate, number, two_panels

from eskf_ros.simulate.scenario import simulate

LEVER_ARM = (2.0, 0.5, 1.5)
SETTLED = 60.0

TEXT = """
## What happens

The antenna sits 2 m ahead of base_link, 0.5 m to the left and 1.5 m above it. The same drive is navigated twice: with
this `gnss.lever_arm`, and with zeros.

## What comes out

| | lever arm as measured | forgotten |
|---|---|---|
| horizontal error, m rms | {rms_right} | {rms_wrong} |
| published sigma, m rms | {sigma_right} | {sigma_wrong} |
| height error, m rms | {up_right} | {up_wrong} |
| heading error, deg rms | {heading_right} | {heading_wrong} |
| NIS of the fixes (ideal 3) | {nis_right} | {nis_wrong} |
| NIS of the velocities (ideal 3) | {nis_velocity_right} | {nis_velocity_wrong} |

Forgotten, the filter navigates the antenna and calls it base_link: {length} m off horizontally, always ahead and to the
left, whatever the course. The picture shows it in the axes of the car: the cloud does not lie around zero.

The heading suffers, too. In a bend the antenna ahead is carried outwards with omega x lever, {swing} m/s at 30 deg/s,
and the filter, which knows of no lever arm, takes this sideways velocity for that of the car. The only way to explain
it is another heading.

And the innovations? Their size hardly changes: fixes, velocities and a slowly turned state agree with each other. No
gate closes, and a test on NIS does not ring. An error that turns with the robot is absorbed by states that turn with
it. A textbook filter would publish {sigma_before} m to the end, as this one does up to the first bends.

What rings is a second opinion. A filter beside this one, which hardly believes the IMU, predicts the fixes of the bends
better, and the estimate goes on from there with its sigma: the {sigma_wrong} m of the table. Innovations that turn with
the car have one cause, and the warning at the end names it:

> {says}

## What to take home

Measure it to a few centimetres; it goes into the result one to one. Where truth is missing, drive circles in both
directions, or turn on the spot: with the right lever arm base_link stays where it is. `eskf_calibrate` finds it in a
recording with turns, and `estimate.lever_arm` has the filter estimate what is left.
"""


def in_car(track: Track) -> np.ndarray:
    """Return the error (n, 2) m, ahead and to the left, by the estimated heading."""
    w, x, y, z = track.rows["attitude_body_to_map"].T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    east, north = track.error[:, 0], track.error[:, 1]
    ahead = np.cos(yaw) * east + np.sin(yaw) * north
    return np.column_stack([ahead, np.cos(yaw) * north - np.sin(yaw) * east])


def run(runs: int) -> Outcome:
    """Navigate with the lever arm and without."""
    recording = simulate("drive", 1, outages=(), lever_arm=LEVER_ARM)
    tracks = {"right": navigate(recording), "wrong": navigate(recording, {"gnss.lever_arm": [0.0, 0.0, 0.0]})}
    figure, left, right = two_panels()
    figures = {"length": number(float(np.hypot(*LEVER_ARM[:2]))), "swing": number(np.radians(30.0) * LEVER_ARM[0])}
    forgotten = tracks["wrong"]
    says = next((warning for warning in forgotten.result.warnings if "antenna" in warning), "nothing")
    sigma_before = float(np.nanmin(forgotten.horizontal_sigma[forgotten.seconds > SETTLED]))
    figures |= {"says": says, "sigma_before": number(sigma_before)}
    found: dict[str, tuple[float, float, float]] = {}
    for name, label, colour in (("right", "as measured", BLUE), ("wrong", "forgotten", RED)):
        track = tracks[name]
        settled = track.seconds > SETTLED
        error = in_car(track)[settled]
        left.plot(error[:, 1], error[:, 0], ".", markersize=1.5, color=colour, label=label)
        right.plot(track.seconds[settled], track.heading[settled], color=colour, label=label)
        rms, heading = track.rms(track.horizontal, SETTLED), track.rms(track.heading, SETTLED)
        aids = track.result.summary["aids"]
        found[name] = rms, heading, aids["gnss_position"]["nis_mean"]
        figures |= {
            f"rms_{name}": number(rms),
            f"sigma_{name}": number(track.rms(track.horizontal_sigma, SETTLED)),
            f"up_{name}": number(track.rms(track.error[:, 2], SETTLED)),
            f"heading_{name}": number(heading),
            f"nis_{name}": number(aids["gnss_position"]["nis_mean"]),
            f"nis_velocity_{name}": number(aids["gnss_velocity"]["nis_mean"]),
        }
    left.set(xlabel="to the left, m", ylabel="ahead, m", xlim=(1.5, -1.5), title="error in the axes of the car")
    left.legend(fontsize=8)
    right.set(xlabel="time, s", ylabel="heading error, deg")
    right.legend(fontsize=8)
    return Outcome(
        figures=figures,
        claims={
            "the error is the length of the lever arm": 1.7 < found["wrong"][0] < 2.5,
            "the heading suffers": found["wrong"][1] > 5.0 * found["right"][1],
            "the fixes do not tell": found["wrong"][2] < 1.2 * found["right"][2],
            "the filter names the antenna": says != "nothing",
            "up to the first bends sigma does not tell": sigma_before < 0.2 * found["wrong"][0],
        },
        picture=figure,
    )


LESSON = Lesson(
    name="lever_arm_forgotten",
    title="The lever arm forgotten",
    sentence="Two metres forgotten are {rms_wrong} m of error, {heading_wrong} deg of heading, and a NIS of "
    "{nis_wrong} instead of {nis_right}: no gate rings.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 1 --set lever_arm=2.0/0.5/1.5 --out drive.mcap
.venv/bin/eskf_replay drive.mcap --config car.yaml --truth truth --out measured
.venv/bin/eskf_replay drive.mcap --config forgotten.yaml --truth truth --out forgotten
```

`car.yaml` has the parameters that `eskf_simulate` prints, `forgotten.yaml` all of them but `gnss.lever_arm`.
""",
    run=run,
)
