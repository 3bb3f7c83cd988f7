"""Lesson: what the bias states are worth, in a tunnel."""

from __future__ import annotations

from typing import Any

import numpy as np
from lesson import BLUE, GREEN, ORANGE, RED, Array, Lesson, Outcome, Track, navigate, number, two_panels

from eskf_ros.simulate.scenario import simulate

TUNNEL = (73.0, 118.0)
"""s"""
NO_GYRO_BIAS = {"imu.gyro_bias_std": 0.0, "imu.gyro_bias_random_walk": 0.0}
NO_ACCEL_BIAS = {"imu.accel_bias_std": 0.0, "imu.accel_bias_random_walk": 0.0}
CASES: dict[str, tuple[dict[str, Any], str]] = {
    "both estimated": ({}, BLUE),
    "no accelerometer bias": (NO_ACCEL_BIAS, GREEN),
    "no gyro bias": (NO_GYRO_BIAS, ORANGE),
    "none": ({**NO_GYRO_BIAS, **NO_ACCEL_BIAS}, RED),
}
GIVEN = {"alignment.initial_heading_deg": -40.0, "alignment.initial_heading_std_deg": 2.0, "zupt.enabled": False}

TEXT = """
## What happens

A car that is already in motion is driven for 73 s under open sky, then 45 s through a tunnel. Its IMU is of consumer
grade: turn-on biases of 0.57 deg/s and 0.2 m/s2 (standard deviations). The heading is given, so that all start alike.
The filter runs four times: with all 15 error states, without those of one sensor's bias, without either (standard
deviation and random walk of the bias are zero: the filter is told that there is none). {runs} drives.

## What comes out

| bias states | open sky: error, m rms | heading at the entrance, deg off | at the end: error, m | published sigma, m |
|---|---|---|---|---|
| both estimated | {open_both} | {heading_both} | {end_both} | {sigma_both} |
| no accelerometer bias | {open_no_accel} | {heading_no_accel} | {end_no_accel} | {sigma_no_accel} |
| no gyro bias | {open_no_gyro} | {heading_no_gyro} | {end_no_gyro} | {sigma_no_gyro} |
| none | {open_none} | {heading_none} | {end_none} | {sigma_none} |

(Medians.) Under open sky the position hardly shows it. With a fix every 0.2 s an IMU error has no time to grow, and the
position is good whatever the model is; the heading tells more. In the tunnel the model is all there is. An
accelerometer bias b moves the car by b t²/2, and 0.2 m/s2 are 200 m after 45 s; without the state it is less, because
most of it went into the tilt, which cancels it until the car turns. A gyro bias b tilts the level a little more every
second, and gravity leaks in: g b t³/6, for 0.57 deg/s 1.5 km after 45 s.

Where does the filter know the biases from? Nothing measures them. While a state is propagated, F couples it to what
grows from it, and so the covariance holds the correlation of bias, attitude, velocity and position. When a fix corrects
the position, the gain corrects all that is correlated with it.

A textbook filter without these states would be as sure of itself as the one that has them. This one finds that IMU and
receiver contradict each other, and adds uncertainty (last column); it has no way to say where it belongs.

## What to take home

Judge a filter where the aids fail, not where they work. A state that is left out does not vanish: its error goes into
the others, where it does not belong.
"""


def run(runs: int) -> Outcome:
    """Drive through the tunnel with each set of states."""
    tracks: dict[str, list[Track]] = {name: [] for name in CASES}
    for seed in range(runs):
        recording = simulate("fast_start:15", seed, grade="consumer", outages=(TUNNEL,))
        for name, (changes, _) in CASES.items():
            tracks[name].append(navigate(recording, {**GIVEN, **changes}))
    end = TUNNEL[1] - 0.2
    figure, left, right = two_panels()
    figures, ends = {"runs": str(runs)}, {}
    for name, (_, colour) in CASES.items():
        errors: Array = np.median([track.horizontal for track in tracks[name]], axis=0)
        first = tracks[name][0]
        left.semilogy(first.seconds, np.maximum(errors, 0.01), color=colour, label=name)
        found = [track.at(track.horizontal, end) for track in tracks[name]]
        right.plot([name.replace(" bias", "\nbias")] * runs, found, "o", color=colour, alpha=0.5)
        ends[name] = float(np.median(found))
        key = {"both estimated": "both", "none": "none"}.get(name) or name.removesuffix(" bias").replace(" ", "_")
        key = key.replace("accelerometer", "accel")
        open_sky = np.median([track.rms(track.horizontal, 40.0, TUNNEL[0]) for track in tracks[name]])
        claimed = np.median([track.at(track.horizontal_sigma, end) for track in tracks[name]])
        entrance = np.median([abs(track.at(track.heading, TUNNEL[0] - 1.0)) for track in tracks[name]])
        figures[f"heading_{key}"] = number(entrance)
        figures |= {f"open_{key}": number(open_sky), f"end_{key}": number(ends[name]), f"sigma_{key}": number(claimed)}
    left.axvspan(*TUNNEL, color="0.9")
    left.set(xlabel="time, s (grey: tunnel)", ylabel="horizontal error, m (median)", xlim=(10.0, TUNNEL[1]))
    left.legend(fontsize=8)
    right.set(ylabel="error at the end of the tunnel, m", yscale="log")
    right.tick_params(axis="x", labelsize=8)
    return Outcome(
        figures=figures,
        claims={
            "without the accelerometer bias the tunnel ends worse": ends["no accelerometer bias"]
            > 1.5 * ends["both estimated"],
            "without the gyro bias it is far worse": ends["no gyro bias"] > 5.0 * ends["both estimated"],
            "under open sky it hardly shows": float(figures["open_none"]) < 2.0 * float(figures["open_both"]),
        },
        picture=figure,
    )


LESSON = Lesson(
    name="tunnel_biases",
    title="The tunnel with bias states on and off",
    sentence="After a 45 s tunnel {end_both} m with bias states, {end_no_accel} m without that of the accelerometer, "
    "{end_no_gyro} m without that of the gyro; under open sky all are alike.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate fast_start:15 --grade consumer --episode outage:start=73,length=45 --out tunnel.mcap
.venv/bin/eskf_replay tunnel.mcap --config with.yaml --truth truth --out with
.venv/bin/eskf_replay tunnel.mcap --config without.yaml --truth truth --out without
```

`with.yaml` has the parameters that `eskf_simulate` prints, and `alignment.initial_heading_deg: -40.0`; `without.yaml`
has zero for `imu.gyro_bias_std` and `imu.gyro_bias_random_walk` besides.
""",
    run=run,
    runs=7,
)
