"""Lesson: on a straight at constant speed nothing tells the heading."""

from __future__ import annotations

import numpy as np
from lesson import BLUE, ORANGE, RED, Lesson, Outcome, navigate, number, two_panels

from eskf_ros.simulate.scenario import simulate

WRONG = 8.0
"""deg by which the heading that is given is wrong."""
HEADING = -40.0
"""deg, the true one at the start."""
TURN = 20.0
"""s at which the first bend begins."""

TEXT = """
## What happens

A vehicle is already doing 30 m/s when the filter starts, and goes straight on for 20 s before the first bend. The
filter is started twice: with no heading, and with one that is {wrong} deg wrong and claims 10 deg. It gets fixes and
velocities all the time, and does not use the course over ground: it could be a boat in a current, or a car in reverse.

## What comes out

| | before the bend (at 19 s) | 5 s into the bend (at 25 s) | at 60 s |
|---|---|---|---|
| given: sigma of the heading | {sigma_19} deg | {sigma_25} deg | {sigma_60} deg |
| given: its error | {error_19} deg | {error_25} deg | {error_60} deg |
| none given: sigma | unknown | {free_25} deg | {free_60} deg |

Position and velocity are known to a fraction of a metre meanwhile; still nothing says which way the vehicle points.
The reason is in the equations: the heading enters the velocity through R f, the specific force turned into the map. At
constant velocity f has no horizontal part, and turning a vertical vector about the vertical changes nothing. The
heading is unobservable, and an honest filter keeps its sigma. (One that linearises with the noisy measured force thinks
that it sees accelerations, and grows sure of a heading that nothing has told.)

In the bend f has 2 m/s2 across the vehicle. With a wrong heading the filter turns it into the wrong direction, after a
second the velocity is off by more than the receiver's 0.08 m/s, and the correlation in P carries this back to the
heading. It is found {found} s after the start, without any heading sensor, whichever way the vehicle points. On the
straight that follows both grow again: one bend has shown the heading, but not yet the bias of the gyro.

## What to take home

To give the filter a heading, do something: turn, brake, accelerate. For a craft that hovers or goes straight for long,
give it a sensor (dual antenna, magnetometer), or `alignment.use_course` if it travels along its x axis. And look at the
covariance of the yaw before you trust the yaw.
"""


def run(runs: int) -> Outcome:
    """Start with a wrong heading and with none."""
    recording = simulate("fast_start:30", 1, outages=())
    given = {"alignment.initial_heading_deg": HEADING + WRONG, "alignment.initial_heading_std_deg": 10.0}
    told, free = navigate(recording, given), navigate(recording)
    sigma, free_sigma = (np.degrees(track.rotation_sigma[:, 2]) for track in (told, free))
    known = free.rows["heading_known"]
    found = float(free.seconds[np.argmax(known)])
    figure, left, right = two_panels()
    shown = told.seconds < 60.0
    left.plot(told.seconds[shown], np.abs(told.heading[shown]), color=RED, label="error")
    left.plot(told.seconds[shown], sigma[shown], color=BLUE, label="sigma")
    left.set(xlabel="time, s", ylabel="heading, deg", title=f"a heading that is {WRONG:g} deg wrong, given as ±10 deg")
    right.semilogy(free.seconds[shown], free_sigma[shown], color=BLUE, label="sigma")
    right.semilogy(free.seconds[shown], np.abs(free.heading[shown]), color=RED, label="error")
    right.set(xlabel="time, s", title="none given", ylim=(0.01, 300.0))
    for panel in (left, right):
        panel.axvline(TURN, color=ORANGE, linestyle="--", label="the bend begins")
        panel.legend(fontsize=8)
    figures = {"wrong": number(WRONG), "found": number(found)}
    for second in (19, 25, 60):
        figures |= {
            f"sigma_{second}": number(told.at(sigma, second)),
            f"error_{second}": number(abs(told.at(told.heading, second))),
            f"free_{second}": number(free.at(free_sigma, second)),
        }
    return Outcome(
        figures=figures,
        claims={
            "on the straight sigma does not shrink": told.at(sigma, 19.0) > 9.9,
            "in the bend it does": told.at(sigma, 25.0) < 2.0,
            "the error follows": abs(told.at(told.heading, 25.0)) < 3.0,
            "without a heading it is found in the bend": TURN < found < TURN + 5.0,
        },
        picture=figure,
    )


LESSON = Lesson(
    name="unobservable_heading",
    title="Heading is unobservable until a turn",
    sentence="On a straight the sigma of the heading stays at {sigma_19} deg for 20 s, however good the fixes; "
    "five seconds of a bend bring it to {sigma_25} deg.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate fast_start:30 --seed 1 --out straight.mcap
.venv/bin/eskf_replay straight.mcap --config car.yaml --truth truth --report
```

`car.yaml` has the parameters that `eskf_simulate` prints; add `alignment.initial_heading_deg: -32.0` and
`alignment.initial_heading_std_deg: 10.0` for the other start.
""",
    run=run,
)
