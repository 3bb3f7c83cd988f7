"""Lesson: fixes that are stamped late."""

from __future__ import annotations

import re

import numpy as np
from lesson import BLUE, GREEN, GREY, ORANGE, RED, Lesson, Outcome, Track, navigate, number, tables, two_panels

from eskf_ros.simulate.scenario import simulate

DELAYS = {0.0: BLUE, 0.05: GREEN, 0.1: ORANGE, 0.2: RED}
"""s by which positions and velocities are stamped late, and the colour of it."""
SETTLED = 60.0

TEXT = """
## What happens

A receiver needs some time to compute a fix and to send it, and many a driver stamps the message when it comes, not when
the satellites were measured. Here the stamps of all positions and velocities are 0.05, 0.1 and 0.2 s late.

## What comes out

| late by | horizontal error, m rms | heading error, deg rms | NIS of the velocities (ideal 3) | the filter says |
|---|---|---|---|---|
| 0 s | {rms_0} | {heading_0} | {nis_0} | {says_0} |
| 0.05 s | {rms_1} | {heading_1} | {nis_1} | {says_1} |
| 0.1 s | {rms_2} | {heading_2} | {nis_2} | {says_2} |
| 0.2 s | {rms_3} | {heading_3} | {nis_3} | {says_3} |
| 0.2 s, `gnss.time_offset: -0.2` | {rms_mended} | {heading_mended} | {nis_mended} | {says_mended} |

The position lags behind by speed times delay: the left picture is a straight line through zero. At rest there is
nothing to see, and a parked robot is no test. Where the speed changes, the velocities are late, too: in a bend the
late velocity points to where the car was heading, and the filter turns its heading to fit.

As with the lever arm the innovations of the fixes say little. What gives it away is that the residuals are
proportional to speed and acceleration; the filter looks for this, and names the offset. It is a little too small where
the states have taken over a part of it, so look at it once more after a correction, until nothing is said.

## What to take home

Stamp at the measurement (PPS, the time in the message), not at the arrival. A message that arrives late with the right
stamp costs nothing: the filter puts it where it belongs. One with a wrong stamp is a wrong measurement.
"""


def said(track: Track) -> str:
    """Return what the filter says of the stamps."""
    for warning in track.result.warnings:
        if found := re.search(r"stamped ([0-9.]+) s \(.*\) late", warning):
            return f"late by {found.group(1)} s"
    return "nothing"


def run(runs: int) -> Outcome:
    """Navigate with each delay, and with the largest corrected."""
    recording = simulate("drive", 1, outages=())
    tracks: dict[str, Track] = {}
    for case, delay in enumerate(DELAYS):
        late = {name: table for name, table in tables(recording).items() if name != "imu"}
        for table in late.values():
            table["stamp"] = table["stamp"] + round(delay * 1e9)
        tracks[str(case)] = navigate(recording, **late)
        if case == len(DELAYS) - 1:
            tracks["mended"] = navigate(recording, {"gnss.time_offset": -delay}, **late)
    figures: dict[str, str] = {}
    errors, headings = {}, {}
    for name, track in tracks.items():
        errors[name], headings[name] = track.rms(track.horizontal, SETTLED), track.rms(track.heading, SETTLED)
        figures |= {
            f"rms_{name}": number(errors[name]),
            f"heading_{name}": number(headings[name]),
            f"nis_{name}": number(track.result.summary["aids"]["gnss_velocity"]["nis_mean"]),
            f"says_{name}": said(track),
        }
    figure, left, right = two_panels()
    for (delay, colour), track in zip(DELAYS.items(), tracks.values()):
        settled = track.seconds > SETTLED
        speed = np.linalg.norm(track.rows["velocity_map"], axis=1)
        left.plot(speed[settled], track.horizontal[settled], ".", markersize=1.5, color=colour, label=f"{delay:g} s")
        left.plot([0.0, 14.0], [0.0, 14.0 * delay], color=GREY, linewidth=0.7)
        right.plot(track.seconds[settled], track.heading[settled], color=colour, linewidth=1, label=f"{delay:g} s")
    left.set(xlabel="speed, m/s (grey: speed times delay)", ylabel="horizontal error, m")
    left.legend(fontsize=8, title="late by", title_fontsize=8, markerscale=4)
    right.set(xlabel="time, s", ylabel="heading error, deg")
    return Outcome(
        figures=figures,
        claims={
            "the error grows with the delay": errors["0"] < errors["1"] < errors["2"] < errors["3"],
            "the heading suffers": headings["3"] > 10.0 * headings["0"],
            "the parameter mends it": errors["mended"] < 1.1 * errors["0"],
            "the filter names it, and only it": figures["says_0"] == "nothing" != figures["says_1"],
        },
        picture=figure,
    )


LESSON = Lesson(
    name="late_stamps",
    title="Time offset",
    sentence="Stamps that are 0.2 s late make {rms_0} m into {rms_3} m and the heading {heading_3} deg wrong; "
    "`gnss.time_offset` mends it.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate drive --seed 1 --episode gnss_delay:start=0,length=1e9,position=0.2,velocity=0.2 --out late.mcap
.venv/bin/eskf_replay late.mcap --config car.yaml --truth truth
```

`car.yaml` has the parameters that `eskf_simulate` prints; add `gnss.time_offset: -0.2` and compare.
""",
    run=run,
)
