"""Lesson: with fewer than four satellites there is no fix, but there are ranges."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from lesson import BLUE, ORANGE, Array, Lesson, Outcome, number, two_panels

from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.replay.run import Options, replay
from eskf_ros.simulate.main import main as eskf_simulate
from eskf_ros.simulate.scenario import simulate

START, LENGTH = 75.0, 60.0
KEPT = (5, 4, 3, 2, 1, 0)
NO_REST = {"zupt.enabled": False}
WAYS = {
    "loose": ({"mode": "loose", "ranges.use_point_solution": True}, ORANGE),
    "tight": ({"mode": "tight"}, BLUE),
}

TEXT = """
## What happens

A car with a consumer IMU drives under open sky, then for a minute with 5, 4, 3, 2, 1 or no satellites. Loose: the
satellites of each epoch are solved for a position and a velocity, and the filter fuses these. Tight: the filter fuses
pseudorange and Doppler of each satellite. Both get the same signals. {runs} drives, each with its own satellites.

## What comes out

Horizontal error after the minute, median:

| satellites | loose, m | tight, m |
|---|---|---|
| 5 | {loose_5} | {tight_5} |
| 4 | {loose_4} | {tight_4} |
| 3 | {loose_3} | {tight_3} |
| 2 | {loose_2} | {tight_2} |
| 1 | {loose_1} | {tight_1} |
| 0 | {loose_0} | {tight_0} |

A position has three unknowns, and the clock of the receiver is a fourth: four satellites, or no fix. Loose coupling
falls off this cliff. In tight coupling
each range is a measurement of its own, of the position along one line of sight, and each Doppler one of the velocity.
The filter knows its position and its clock from before, so three satellites correct nearly everything, two about half.
One mostly feeds the clock: its range says how far the sum of position and clock is off, and a common crystal wanders
as much as the position does.

With four satellites the two differ although both have a fix: four satellites seldom surround the car, and a fix of
theirs is poor along one direction. Tight coupling does not need to solve for what the satellites do not show.

## What to take home

Tight coupling is worth it where the sky is narrow, not where it is open. What it needs is a receiver that gives ranges,
ephemerides, and an honest `ranges.clock_drift_noise`.
"""


def errors_of(folder: Path, seed: int, kept: int) -> dict[str, tuple[Array, Array]]:
    """Return seconds (n,) and horizontal errors (n,) m of one drive with ``kept`` satellites, by way of coupling."""
    bag = folder / f"few_{seed}_{kept}.mcap"
    episode = f"satellites:start={START:g},length={LENGTH:g},keep={kept}"
    drive = ["drive", "--seed", str(seed), "--grade", "consumer", "--imu-rate", "100", "--sensor", "ranges"]
    eskf_simulate([*drive, "--set", f"stop={START + LENGTH:g}", "--episode", episode, "--out", str(bag), "--quiet"])
    sensors = simulate("drive", seed, grade="consumer", imu_rate=100.0, stop=1.0).parameters()
    found = {}
    for way, (changes, _) in WAYS.items():
        results = folder / f"{bag.stem}_{way}"
        replay(bag, from_mapping({**sensors, **NO_REST, **changes}), Options(results, truth="truth"))
        with np.load(results / "details.npz") as details:
            compared = details["errors"]
        found[way] = (compared["stamp"] - compared["stamp"][0]) * 1e-9, compared["horizontal"]
    bag.unlink()
    return found


def run(runs: int) -> Outcome:
    """Replay drives with each number of satellites."""
    errors: dict[str, dict[int, list[float]]] = {way: {kept: [] for kept in KEPT} for way in WAYS}
    figure, left, right = two_panels()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(runs):
            for kept in KEPT:
                for way, (seconds, horizontal) in errors_of(Path(folder), seed, kept).items():
                    errors[way][kept].append(float(horizontal[-1]))
                    if seed == 0 and kept == 3:
                        left.semilogy(seconds, horizontal, color=WAYS[way][1], label=way)
    left.axvspan(START, START + LENGTH, color="0.9")
    left.set(xlabel="time, s (grey: three satellites)", ylabel="horizontal error, m", xlim=(40.0, START + LENGTH))
    left.legend(fontsize=8)
    medians = {way: {kept: float(np.median(of_way[kept])) for kept in KEPT} for way, of_way in errors.items()}
    for way, (_, colour) in WAYS.items():
        for kept in KEPT:
            right.semilogy([kept] * runs, errors[way][kept], ".", color=colour, alpha=0.5)
        right.semilogy(KEPT, list(medians[way].values()), "o-", color=colour, label=way)
    right.set(xlabel="satellites", ylabel="error after a minute, m", xticks=KEPT)
    right.invert_xaxis()
    right.legend(fontsize=8)
    tight, loose = medians["tight"], medians["loose"]
    return Outcome(
        figures={"runs": str(runs)} | {f"{way}_{kept}": number(medians[way][kept]) for way in WAYS for kept in KEPT},
        claims={
            "three satellites are nearly as good as five, tight": tight[3] < 0.3 * loose[3],
            "loose has nothing below four": min(loose[3], loose[2], loose[1]) > 3.0 * loose[5],
            "two are better than none": tight[2] < 0.8 * tight[0],
        },
        picture=figure,
    )


LESSON = Lesson(
    name="few_satellites",
    title="Loose and tight with fewer satellites",
    sentence="A minute with three satellites ends {loose_3} m off when fixes are fused, {tight_3} m when ranges are.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 0 --grade consumer --sensor ranges \\
    --episode satellites:start=75,length=60,keep=3 --out few.mcap
.venv/bin/eskf_replay few.mcap --config car.yaml --truth truth --mode tight --out tight --report
```

`car.yaml` has the parameters that `eskf_simulate` prints; with `ranges.use_point_solution: true` and `--mode loose` it
is the other one.
""",
    run=run,
    runs=4,
)
