"""Lesson: a filter that is as good as another one, but lies about its covariance."""

from __future__ import annotations

import numpy as np
from lesson import BLACK, BLUE, RED, Array, Lesson, Outcome, Track, navigate, number, two_panels

from eskf_ros.simulate.scenario import simulate

TUNNEL = (125.0, 170.0)
FACTOR = 0.1
TOLD = ("gyro_noise_density", "accel_noise_density", "gyro_bias_random_walk", "accel_bias_random_walk")
BOUND = 5.99
"""95 % of chi-square with two degrees of freedom."""

TEXT = """
## What happens

{runs} drives with an industrial IMU, five minutes each, with a tunnel of 45 s. Two filters: one is told what the IMU's
noise and bias random walks are, the other a tenth of it, as one does with a data sheet, or to get smooth curves.

## What comes out

| | told the truth | told a tenth |
|---|---|---|
| under open sky: error, m rms | {open_honest} | {open_lying} |
| under open sky: published sigma, m | {open_sigma_honest} | {open_sigma_lying} |
| under open sky: NIS of the velocities (ideal 3) | {nis_honest} | {nis_lying} |
| at the end of the tunnel: error, m (median) | {end_honest} | {end_lying} |
| at the end of the tunnel: published sigma, m | {end_sigma_honest} | {end_sigma_lying} |
| drives whose error is inside the 95 % ellipse there | {inside_honest} of {runs} | {inside_lying} of {runs} |

Under open sky nothing gives the lie away: the error is the same, sigma is the same, since the receiver determines both,
and the innovations are the same to a few per cent. Tuned by looking at a trajectory both pass. In the tunnel the second
filter claims {end_sigma_lying} m and is {end_lying} m off. It is worse than the honest one, too, since it has stopped
to correct the biases that it is sure of; but the claim is what makes it dangerous. A planner keeps a distance by it,
and a gate built with it refuses the true fixes at the exit.

How does one find out? With truth: NEES, the error in units of its own covariance, e' P⁻¹ e. For two axes it has the
mean 2, and is below {bound} in 95 % of the drives; the right picture shows it drive by drive. One drive says little, an
ensemble says it exactly. Without truth: NIS after outages, when the innovations are large.

## What to take home

Measure the noise of your IMU as mounted, engine on, and tell the filter that. Test NEES where the aids are missing
([consistency](../consistency.md) does, over hundreds of runs). A sigma that is too large costs a little accuracy; one
that is too small costs the trust in all of it.
"""


def run(runs: int) -> Outcome:
    """Drive with the true noise parameters, and with a tenth of them."""
    tracks: dict[str, list[Track]] = {"honest": [], "lying": []}
    for seed in range(runs):
        recording = simulate("tunnel_drive", seed)
        true = recording.parameters()
        for name, factor in (("honest", 1.0), ("lying", FACTOR)):
            told = {f"imu.{key}": true[f"imu.{key}"] * factor for key in TOLD}
            tracks[name].append(navigate(recording, {**told, "zupt.enabled": False}))
    figure, left, right = two_panels()
    end = TUNNEL[1] - 0.5
    figures = {"runs": str(runs), "bound": number(BOUND)}
    opens, ends, inside = {}, {}, {}
    for name, label, colour in (("honest", "told the truth", BLUE), ("lying", "told a tenth", RED)):
        found = tracks[name]
        shown = (found[0].seconds > 100.0) & (found[0].seconds < 185.0)
        if name == "lying":
            for track in found:
                left.plot(track.seconds[shown], track.horizontal[shown], color="0.7", linewidth=0.5)
        sigma = np.median([track.horizontal_sigma for track in found], axis=0)
        left.plot(found[0].seconds[shown], 2.0 * sigma[shown], color=colour, label=f"twice sigma, {label}")
        nees = np.array([nees_of(track, end) for track in found])
        right.semilogy(np.sort(nees), np.linspace(100.0, 0.0, runs), ".-", color=colour, label=label)
        right.set_xscale("log")
        opens[name] = float(np.mean([track.rms(track.horizontal, 60.0, TUNNEL[0] - 1.0) for track in found]))
        ends[name] = float(np.median([track.at(track.horizontal, end) for track in found]))
        inside[name] = int(np.sum(nees < BOUND))
        claimed = [track.rms(track.horizontal_sigma, 60.0, TUNNEL[0] - 1.0) for track in found]
        nis = [track.result.summary["aids"]["gnss_velocity"]["nis_mean"] for track in found]
        figures |= {
            f"open_{name}": number(opens[name]),
            f"open_sigma_{name}": number(float(np.mean(claimed))),
            f"nis_{name}": f"{np.mean(nis):.2f}",
            f"end_{name}": number(ends[name]),
            f"end_sigma_{name}": number(float(np.median([track.at(track.horizontal_sigma, end) for track in found]))),
            f"inside_{name}": str(inside[name]),
        }
    right.set_yscale("linear")
    grid = np.logspace(-2, 2.5, 100)
    right.plot(grid, 100.0 * np.exp(-0.5 * grid), color=BLACK, linewidth=0.8, label="chi-square")
    left.axvspan(*TUNNEL, color="0.93")
    left.set(xlabel="time, s", ylabel="m (thin: errors of the second filter)")
    left.legend(fontsize=8, loc="upper left")
    right.set(xlabel="NEES of the position at the end of the tunnel", ylabel="drives above it, %", xlim=(0.02, 300.0))
    right.legend(fontsize=8)
    return Outcome(
        figures=figures,
        claims={
            "under open sky it does not show": opens["lying"] < 1.3 * opens["honest"],
            "in the tunnel it is sure of itself, and wrong": inside["lying"] < 0.5 * runs,
            "the honest one is honest": inside["honest"] > 0.8 * runs,
            "the error itself is not much larger": ends["lying"] < 3.0 * ends["honest"],
        },
        picture=figure,
    )


def nees_of(track: Track, seconds: float) -> float:
    """Return e' P⁻¹ e of the horizontal position at a time (s)."""
    at = int(np.searchsorted(track.seconds, seconds))
    error: Array = track.error[at, :2]
    return float(error @ np.linalg.solve(track.rows["pose_covariance"][at, :2, :2], error))


LESSON = Lesson(
    name="lying_covariance",
    title="A filter that lies about its covariance",
    sentence="Told a tenth of the IMU's noise, it is as good under open sky; after a tunnel it claims "
    "{end_sigma_lying} m and is {end_lying} m off: {inside_lying} of {runs} drives inside 95 %.",
    text=TEXT,
    by_hand="""
```sh
.venv/bin/eskf_simulate tunnel_drive --out tunnel.mcap
.venv/bin/eskf_replay tunnel.mcap --config car.yaml --truth truth --out honest
.venv/bin/eskf_replay tunnel.mcap --config tenth.yaml --truth truth --out lying
```

`car.yaml` has the parameters that `eskf_simulate` prints, and `zupt.enabled: false`; in `tenth.yaml` the two
`noise_density` and the two `random_walk` of `imu` are a tenth of it. Compare the NEES in the tables.
""",
    run=run,
    runs=20,
)
