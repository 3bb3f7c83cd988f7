"""Lesson: between two fixes the uncertainty grows, at a fix it falls: the sawtooth."""

from __future__ import annotations

import numpy as np
from lesson import BLUE, GREEN, ORANGE, RED, Lesson, Outcome, navigate, number, two_panels

from eskf_ros.simulate.scenario import simulate

INTERVALS = {0.2: BLUE, 1.0: GREEN, 10.0: ORANGE, 30.0: RED}
"""s between two fixes, and the colour of it."""
SETTLED = 130.0
"""s from which the biases are known."""

TEXT = """
## What happens

The same drive, with fixes (1 m) and velocities (0.08 m/s) every 0.2, 1, 10 and 30 s, on a consumer IMU. No zero
velocity updates, so that only the fixes correct.

## What comes out

| a fix every | published sigma, lowest | highest | error, m rms |
|---|---|---|---|
| 0.2 s | {low_0} m | {high_0} m | {rms_0} m |
| 1 s | {low_1} m | {high_1} m | {rms_1} m |
| 10 s | {low_2} m | {high_2} m | {rms_2} m |
| 30 s | {low_3} m | {high_3} m | {rms_3} m |

Right after a fix sigma is at its lowest; then noise, biases and tilt are integrated, and it grows, at first slowly,
then faster than in proportion, until the next fix cuts it. At 0.2 s the teeth are too small to be seen. At 30 s a tooth
is {tooth} times as high as its foot, and its foot is higher as well: fewer fixes are averaged, and biases and attitude
are known less well, so that each tooth climbs more steeply.

The error (thin) is one draw of what the band says. It is not expected to follow the teeth, only to stay in the band.

## What to take home

The sigma at the fixes is not that of the robot between them. Who plans with the covariance wants that of the moment he
uses it: the odometry carries it at IMU rate. And an accuracy without the interval of the fixes says nothing.
"""


def run(runs: int) -> Outcome:
    """Navigate with fixes at each of the intervals."""
    figure, left, right = two_panels()
    figures: dict[str, str] = {}
    lows, highs = [], []
    for case, (interval, colour) in enumerate(INTERVALS.items()):
        recording = simulate("drive", 1, outages=(), gnss_rate=1.0 / interval, grade="consumer")
        track = navigate(recording, {"zupt.enabled": False})
        settled = track.seconds > SETTLED
        sigma = track.horizontal_sigma
        lows.append(float(sigma[settled].min()))
        highs.append(float(sigma[settled].max()))
        rms = track.rms(track.horizontal, SETTLED)
        figures |= {f"low_{case}": number(lows[-1]), f"high_{case}": number(highs[-1]), f"rms_{case}": number(rms)}
        shown = (track.seconds > SETTLED) & (track.seconds < SETTLED + 90.0)
        left.semilogy(track.seconds[shown], sigma[shown], color=colour, label=f"{interval:g} s")
        if interval >= 10.0:
            right.plot(track.seconds[shown], sigma[shown], color=colour, linewidth=1.5, label=f"sigma, {interval:g} s")
            right.plot(track.seconds[shown], track.horizontal[shown], color=colour, linewidth=0.7, label="error")
    left.set(xlabel="time, s", ylabel="published sigma, m", ylim=(0.08, 20.0))
    left.legend(fontsize=8, title="a fix every", title_fontsize=8, loc="lower right", ncols=4)
    right.set(xlabel="time, s", ylabel="m")
    right.legend(fontsize=8)
    figures["tooth"] = number(highs[-1] / lows[-1])
    return Outcome(
        figures=figures,
        claims={
            "fewer fixes, higher feet": bool(np.all(np.diff(lows) > 0.0)),
            "fewer fixes, higher teeth": bool(np.all(np.diff(highs) > 0.0)),
            "at 0.2 s there are no teeth to speak of": highs[0] < 1.1 * lows[0],
            "at 30 s the tooth is high": highs[-1] > 5.0 * lows[-1],
        },
        picture=figure,
    )


LESSON = Lesson(
    name="fix_interval",
    title="The interval of the fixes and the sawtooth",
    sentence="With a fix every 0.2 s sigma stays at {high_0} m, with one every 30 s it swings between {low_3} and "
    "{high_3} m.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 1 --grade consumer --gnss-rate 0.1 --out sparse.mcap
.venv/bin/eskf_replay sparse.mcap --config car.yaml --truth truth --report
```

`car.yaml` has the parameters that `eskf_simulate` prints, and `zupt.enabled: false`. The report shows error and band.
""",
    run=run,
)
