"""Lesson: INS alone drifts, GNSS alone is noisy, both together are neither."""

from __future__ import annotations

import numpy as np
from lesson import BLUE, GREY, ORANGE, Lesson, Outcome, fix_errors, navigate, number, two_panels

from eskf_ros.simulate.scenario import simulate

LOST = 60.0
"""s from which the INS is alone."""

TEXT = """
## What happens

A car drives five minutes through a city with an industrial IMU (200 Hz) and a receiver of 1 m (5 Hz). Three ways to say
where it is: the fixes as they come; the IMU alone, which had GNSS for the first minute to level itself and to find its
heading and biases; and the filter with both.

## What comes out

| | horizontal error |
|---|---|
| GNSS alone | {gnss_rms} m rms, at every fix, and nothing between two fixes |
| INS alone | {ins_10} m after 10 s, {ins_60} m after a minute, {ins_end} m after {minutes} min |
| both | {both_rms} m rms, 200 times a second, with heading ({heading_rms} deg rms) and tilt |

The IMU is smooth, and right over seconds: it measures every motion, but adds up its errors twice. A bias of the
accelerometer grows with the square of time, a tilt does too (it leaks gravity), and a bias of the gyro, which is a tilt
that grows, with the cube. GNSS is as good after an hour as after a second, and no better. The filter weighs the two by
their covariances: over a second it believes the IMU, over minutes the receiver. That it beats the fixes by a factor of
{gain} is averaging: the IMU carries many fixes to one point, and the receiver's velocities (0.08 m/s) help it.

GNSS shows more than position. Where the car accelerates, a wrong heading or tilt turns the measured acceleration into
the wrong direction, and the fixes tell. So the filter learns attitude and biases from a sensor that measures neither.

## What to take home

Neither sensor can be left out, and no constant mix of the two replaces the filter: what the IMU is worth depends on how
long ago it was corrected. The standard deviation that the filter publishes says so at any time.
"""


def run(runs: int) -> Outcome:
    """Compare the three over one drive."""
    recording = simulate("drive", 1, outages=())
    both = navigate(recording)
    alone = navigate(simulate("drive", 1, outages=((LOST, 1e6),)), {"zupt.enabled": False})
    fix_seconds, fix_error = fix_errors(recording)
    after = both.seconds > LOST
    end = both.seconds[-1] - 0.1
    gnss_rms = float(np.sqrt(np.mean(fix_error**2)))
    both_rms = both.rms(both.horizontal, LOST)
    figure, left, right = two_panels()
    truth = recording.truth_position_map
    left.plot(*truth[:, :2].T, color=GREY, linewidth=4, alpha=0.5, label="truth")
    position = alone.rows["position_map"]
    left.plot(*position[alone.seconds > LOST, :2].T, color=ORANGE, label="INS alone")
    left.plot(*both.rows["position_map"][after, :2].T, color=BLUE, linewidth=1, label="both")
    left.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    left.legend(fontsize=8)
    right.semilogy(fix_seconds, fix_error, ".", color=GREY, markersize=2, label="GNSS alone")
    right.semilogy(alone.seconds, alone.horizontal, color=ORANGE, label="INS alone from 60 s on")
    right.semilogy(both.seconds, both.horizontal, color=BLUE, label="both")
    right.set(xlabel="time, s", ylabel="horizontal error, m", ylim=(0.01, 2000.0))
    right.legend(fontsize=8)
    ends = {length: alone.at(alone.horizontal, LOST + length) for length in (10.0, 60.0)}
    last = alone.at(alone.horizontal, end)
    return Outcome(
        figures={
            "gnss_rms": number(gnss_rms),
            "ins_10": number(ends[10.0]),
            "ins_60": number(ends[60.0]),
            "ins_end": number(last),
            "minutes": number((end - LOST) / 60.0),
            "both_rms": number(both_rms),
            "heading_rms": number(both.rms(both.heading, LOST)),
            "gain": number(gnss_rms / both_rms),
        },
        claims={
            "both are better than GNSS alone by a factor of five": both_rms < 0.2 * gnss_rms,
            "INS alone is good for ten seconds": ends[10.0] < gnss_rms,
            "INS alone is lost in the end": last > 100.0,
        },
        picture=figure,
    )


LESSON = Lesson(
    name="ins_and_gnss",
    title="INS alone, GNSS alone, both",
    sentence="INS alone is {ins_10} m off after 10 s and {ins_end} m after {minutes} min, GNSS alone {gnss_rms} m, "
    "both {both_rms} m.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 1 --out drive.mcap    # prints the parameters of its sensors: put them in car.yaml
.venv/bin/eskf_replay drive.mcap --config car.yaml --truth truth --out both --report
.venv/bin/eskf_replay drive.mcap --config car.yaml --truth truth --mode ins-only --out alone --report
```
""",
    run=run,
)
