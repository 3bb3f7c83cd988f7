"""What is wrong with the samples and stamps of the IMU, one sentence each with what to do."""

from __future__ import annotations

import numpy as np

AXES = ("x accelerometer", "y accelerometer", "z accelerometer", "x gyro", "y gyro", "z gyro")

UNITS = ("m/s2", "m/s2", "m/s2", "rad/s", "rad/s", "rad/s")

LASTING_SHARE = 0.25
"""Share of the blocks of stamps that must be uneven for a word."""

FEWEST_BLOCKS = 4
"""Blocks of uneven stamps, at least, for a word."""

LEAST_TIME = 0.3
"""s; an axis that was clipped for less in all is not worth a word."""


def stamp_complaints(state: np.void) -> list[str]:
    """Return a sentence if the stamps of the IMU come in bursts, and one if they jitter."""
    stamps = state["stamps"]
    least = max(FEWEST_BLOCKS, LASTING_SHARE * int(stamps["blocks"]))
    where = "stamp samples where they are measured (sensor clock, latency timer of the serial port)"
    if stamps["bunched_blocks"] >= least:
        size = 1.0 / (1.0 - max(float(stamps["bunched"]), 0.5))
        return [
            f"IMU stamps come in bursts of about {size:.0f}, and are spread evenly before the last of each: {where}"
        ]
    if stamps["jittered_blocks"] >= least:
        std, period = 1e3 * float(stamps["variance"]) ** 0.5, 1e3 * float(stamps["period"])
        return [f"IMU stamps jitter by {std:.1f} ms (period {period:.1f} ms), and are smoothed: {where}"]
    return []


def sample_complaints(state: np.void) -> list[str]:
    """Return one sentence for each fault of the IMU samples: filled holes, clipped and stuck axes."""
    quality = state["quality"]
    found = stamp_complaints(state)
    repeated, bridged = int(quality["repeated"]), int(quality["bridged"])
    if repeated + bridged:
        how = "repeats of one sample" if bridged == 0 else "straight lines" if repeated == 0 else "lines and repeats"
        found.append(
            f"{repeated + bridged} holes in the IMU data are filled with {how}, {float(quality['hole_time']):.1f} s in "
            "all: samples get lost before the driver; better it leaves the holes as they are"
        )
    for i, (axis, unit) in enumerate(zip(AXES, UNITS)):
        clipped, stuck = float(quality["clipped_time"][i]), float(quality["stuck_time"][i])
        if clipped > LEAST_TIME and clipped >= stuck:
            value = float(quality["clipped_value"][i])
            found.append(f"the {axis} is clipped at {value:.2f} {unit} ({clipped:.1f} s in all): set a larger range")
        elif stuck > 0.0:
            value = float(quality["stuck_value"][i])
            found.append(
                f"the {axis} was stuck at {value:.3f} {unit} for {stuck:.1f} s while the other axes moved: look at the "
                "sensor and its driver"
            )
    return found
