"""Lesson: how long an IMU holds, by its grade."""

from __future__ import annotations

import numpy as np
from lesson import BLUE, GREEN, GREY, ORANGE, Array, Lesson, Outcome, Track, navigate, number, two_panels

from eskf_ros.simulate.scenario import simulate
from eskf_ros.simulate.scenarios import TUNNEL_START

GRADES = {"consumer": ORANGE, "industrial": BLUE, "tactical": GREEN}
LENGTHS = (10.0, 30.0, 60.0, 120.0, 290.0)
BOUND = 10.0
"""m"""

TEXT = """
## What happens

A car drives a lap under open sky and then for five minutes in a tunnel with bends and stops, with three IMUs: consumer
(telephone, hobby), industrial (robots), tactical (the best MEMS). No wheels, no zero velocity, no constraint: the IMU
alone, with what the filter had learnt of it. {runs} drives each.

## What comes out

Horizontal error, median (in brackets: the sigma that the filter published):

| in the tunnel | consumer | industrial | tactical |
|---|---|---|---|
{rows}
| 10 m are reached after | {consumer_hold} s | {industrial_hold} s | {tactical_hold} s |

For the first ten seconds the grades are nearly alike: what counts is how well velocity and tilt were known at the
entrance, and this the receiver decides. Then each error grows by its own power of time: velocity with t, tilt and
accelerometer bias with t², gyro bias with t³, white noise of the accelerometer with t^1.5. On the double logarithmic
picture these are slopes, and late in the tunnel every sigma grows faster than t². So twice the time
costs several times the error, and the next better grade, for a multiple of the money, less than doubles the time.

## What to take home

Choose the IMU by the length of the outage, and look for an aid before you look for a better IMU: wheels, or that a car
does not slip sideways, turn the cube into a straight line ([results](../results.md) has the figures).
"""


def run(runs: int) -> Outcome:
    """Drive through the tunnel with each grade."""
    figure, left, right = two_panels()
    figures: dict[str, str] = {"runs": str(runs)}
    medians: dict[str, Array] = {}
    hold = {}
    cells: dict[float, list[str]] = {length: [] for length in LENGTHS}
    for grade, colour in GRADES.items():
        tracks: list[Track] = []
        for seed in range(runs):
            recording = simulate("long_tunnel", seed, grade=grade, imu_rate=100.0, stop=TUNNEL_START + 299.0)
            tracks.append(navigate(recording, {"zupt.enabled": False}))
        since = tracks[0].seconds - TUNNEL_START
        errors = np.array([track.horizontal for track in tracks])
        medians[grade] = np.median(errors, axis=0)
        sigma = np.median([track.horizontal_sigma for track in tracks], axis=0)
        inside = since > 1.0
        for values in errors:
            left.loglog(since[inside], values[inside], color=colour, linewidth=0.4, alpha=0.4)
        left.loglog(since[inside], medians[grade][inside], color=colour, linewidth=2, label=grade)
        right.loglog(since[inside], sigma[inside], color=colour, linewidth=2, label=grade)
        hold[grade] = float(since[inside][np.argmax(medians[grade][inside] > BOUND)])
        figures[f"{grade}_hold"] = number(hold[grade])
        for length in LENGTHS:
            at = int(np.searchsorted(since, length))
            cells[length].append(f"{number(medians[grade][at])} ({number(sigma[at])}) m")
    figures["rows"] = "\n".join(f"| {length:g} s | {' | '.join(row)} |" for length, row in cells.items())
    times = np.array([30.0, 290.0])
    right.loglog(times, 5.0 * (times / times[0]) ** 2, ":", color=GREY, label="t²")
    right.loglog(times, 5.0 * (times / times[0]) ** 3, "--", color=GREY, label="t³")
    left.set(xlabel="time in the tunnel, s", ylabel="horizontal error, m (thick: median)")
    right.set(xlabel="time in the tunnel, s", ylabel="published sigma, m (median)")
    for panel in (left, right):
        panel.set(ylim=(0.05, 2e4))
        panel.legend(fontsize=8)
    late = {grade: float(values[int(np.searchsorted(since, 120.0))]) for grade, values in medians.items()}
    return Outcome(
        figures=figures,
        claims={
            "after two minutes the grades differ": late["consumer"] > 2.0 * late["industrial"] > 2.0 * late["tactical"],
            "a better IMU holds longer": hold["consumer"] < hold["industrial"] < hold["tactical"],
        },
        picture=figure,
    )


LESSON = Lesson(
    name="imu_grade",
    title="IMU grade against the length of the outage",
    sentence="Ten metres are reached after {consumer_hold} s (consumer), {industrial_hold} s (industrial), "
    "{tactical_hold} s (tactical).",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate long_tunnel --grade tactical --out tunnel.mcap
.venv/bin/eskf_replay tunnel.mcap --config car.yaml --truth truth --report
```

`car.yaml` has the parameters that `eskf_simulate` prints, and `zupt.enabled: false`.
""",
    run=run,
    runs=5,
)
