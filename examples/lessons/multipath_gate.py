"""Lesson: reflected signals, and the gate that keeps their fixes out."""

from __future__ import annotations

from typing import Any

import numpy as np
from lesson import BLUE, GREEN, GREY, ORANGE, RED, Lesson, Outcome, Track, fix_errors, navigate, number, two_panels

from eskf_ros.simulate.gnss_episodes import Multipath
from eskf_ros.simulate.scenario import simulate

EPISODE = Multipath(150.0, 20.0, offset=(8.0, -5.0, 4.0))
OPEN = {"gnss.gate_probability": 1.0 - 1e-16}
AROUND = (130.0, 200.0)

TEXT = """
## What happens

Between houses the receiver hears reflections, and for 20 s its position steps aside by {offset} m, while it claims 1 m
as before. Four filters: with the gate (`gnss.gate_probability` 0.999) and with a gate so wide that nothing meets it,
each with the receiver's velocities and without.

## What comes out

| | largest horizontal error from 20 s before to 30 s after, m | fixes of the 100 that were fused |
|---|---|---|
| gate, velocities | {worst_gate} | {fused_gate} |
| gate, positions only | {worst_gate_alone} | {fused_gate_alone} |
| no gate, velocities | {worst_open} | {fused_open} |
| no gate, positions only | {worst_open_alone} | {fused_open_alone} |

The gate compares the innovation with what the filter expects: with y the innovation and S its covariance, NIS = y' S⁻¹
y is chi-square with three degrees of freedom, and one good fix in a thousand is above {limit}. The first false fix has
{nis}. It has to be judged by S, not by metres: after a tunnel an innovation of ten metres is welcome.

A gate makes a filter that is wrong deaf: if the filter had drifted away, the same test would refuse the true fixes. So
the gate alone must not have the last word. Here the velocities of the same receiver have it: they agree with the filter
and not with the jump, so the jump is multipath, however long it lasts. Without velocities the filter is on its own for
20 s, drifts, and would have to give in after a time, as a step that stays cannot be told from an error of its own.

Without gate the position follows, and with velocities in another way: the filter sees that the fixes move otherwise
than the velocities, takes that for an error of the fixes that lasts, and learns it. When the true fixes come back, they
look like the next such error: {left_open} m are left 30 s later. What a false measurement has taught outlives it.

## What to take home

A gate needs an honest covariance on both sides, a second witness, and a way back. With too small a sigma of the filter
it rejects good fixes; with too large a sigma of the receiver it lets the false ones in.
"""


def run(runs: int) -> Outcome:
    """Drive past the houses with and without gate, with and without velocities."""
    recording = simulate("drive", 1, outages=(), episodes=(EPISODE,))
    alone: dict[str, Any] = {"gnss_velocity": None}
    tracks: dict[str, Track] = {
        "gate": navigate(recording),
        "gate_alone": navigate(recording, **alone),
        "open": navigate(recording, OPEN),
        "open_alone": navigate(recording, OPEN, **alone),
    }
    figures = {"offset": number(float(np.hypot(*EPISODE.offset[:2])))}
    worst = {}
    inside = recording.imu_stamp[0] + np.array([EPISODE.start, EPISODE.start + EPISODE.length]) * 1e9
    for name, track in tracks.items():
        shown = (track.seconds > AROUND[0]) & (track.seconds < AROUND[1])
        worst[name] = float(np.max(track.horizontal[shown]))
        records = track.result.innovations
        false = (records["aid"] == "gnss_position") & (records["stamp"] > inside[0]) & (records["stamp"] < inside[1])
        fused = int(np.sum(np.asarray(records["verdict"])[false] == "fused"))
        figures[f"left_{name}"] = number(track.at(track.horizontal, AROUND[1]))
        figures |= {f"worst_{name}": number(worst[name]), f"fused_{name}": str(fused)}
        if name == "gate":
            nis = np.asarray(records["nis"])[false]
            figures |= {"nis": number(float(nis[0])), "limit": "16.3"}
    figure, left, right = two_panels()
    seconds, error = fix_errors(recording)
    near = (seconds > AROUND[0]) & (seconds < AROUND[1])
    for panel, names in ((left, ("gate", "open")), (right, ("gate_alone", "open_alone"))):
        panel.semilogy(seconds[near], error[near], ".", color=GREY, markersize=2, label="fixes")
        for name, colour in zip(names, (BLUE, RED) if panel is left else (GREEN, ORANGE)):
            track = tracks[name]
            shown = (track.seconds > AROUND[0]) & (track.seconds < AROUND[1])
            label = "with gate" if "gate" in name else "without gate"
            panel.semilogy(track.seconds[shown], track.horizontal[shown], color=colour, label=label)
        panel.set(xlabel="time, s", ylim=(0.01, 30.0))
        panel.legend(fontsize=8)
    left.set(ylabel="horizontal error, m", title="positions and velocities")
    right.set(title="positions only")
    return Outcome(
        figures=figures,
        claims={
            "gated, it does not show": worst["gate"] < 1.0,
            "without gate the position follows": worst["open"] > 5.0 * worst["gate"],
            "the velocities help": worst["gate"] < worst["gate_alone"] < worst["open_alone"],
        },
        picture=figure,
    )


LESSON = Lesson(
    name="multipath_gate",
    title="Multipath, gated",
    sentence="Fixes that are {offset} m off for 20 s move the position by {worst_gate} m with the gate, "
    "{worst_open} m without, {worst_open_alone} m without gate and velocities.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 1 --episode multipath:start=150,length=20,offset=8/-5/4 --out multipath.mcap
.venv/bin/eskf_replay multipath.mcap --config car.yaml --truth truth --report
```

`car.yaml` has the parameters that `eskf_simulate` prints. The report shows innovations, gates and verdicts.
""",
    run=run,
)
