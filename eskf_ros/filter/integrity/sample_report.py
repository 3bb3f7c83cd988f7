"""What is wrong with the samples and stamps of the IMU, one sentence each with what to do."""

from __future__ import annotations

import numpy as np

from eskf_ros.filter.inertial.gyro_noise import CLEARLY_MORE

AXES = ("x accelerometer", "y accelerometer", "z accelerometer", "x gyro", "y gyro", "z gyro")

UNITS = ("m/s2", "m/s2", "m/s2", "rad/s", "rad/s", "rad/s")

LASTING_SHARE = 0.25
"""Share of the blocks of stamps that must be uneven for a word."""

FEWEST_BLOCKS = 4
"""Blocks of uneven stamps, at least, for a word."""

LEAST_STUCK = 8.0
"""s; an axis that kept its value for less in all may be clipped, which the next time will tell."""

FEWEST_AT_END = 30
"""Samples at the end of what an axis has ever read, to the last bit, from which on that is the end of its range."""

USUAL_SHARE = 0.1
"""Share of repeated readings above which a resolution is so coarse that the same extreme comes again by chance."""

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


def axis_complaints(state: np.void) -> list[str]:
    """Return one sentence for each axis of the IMU that is clipped or stuck."""
    quality, found = state["quality"], []
    for i, (axis, unit) in enumerate(zip(AXES, UNITS)):
        clipped, stuck = float(quality["clipped_time"][i]), float(quality["stuck_time"][i])
        ends, share = quality["at_extreme"][i], float(quality["equal_share"][i])
        if ends.max() > FEWEST_AT_END and share < USUAL_SHARE:
            value = float((quality["lowest"] if ends[0] > ends[1] else quality["highest"])[i])
            found.append(f"the {axis} is clipped at {value:.2f} {unit} ({ends.max()} samples): set a larger range")
        elif clipped > LEAST_TIME and clipped >= stuck:
            value = float(quality["held_value"][i])
            found.append(f"the {axis} is clipped at {value:.2f} {unit} ({clipped:.1f} s in all): set a larger range")
        elif stuck > LEAST_STUCK:
            value = float(quality["held_value"][i])
            found.append(
                f"the {axis} was stuck at {value:.3f} {unit} for {stuck:.1f} s while the other axes moved: look at the "
                "sensor and its driver"
            )
    return found


def noise_complaints(state: np.void, settings: np.void) -> list[str]:
    """Return a sentence if the gyros are clearly noisier at rest than the parameters say."""
    told, measured = float(settings["gyro_noise_density"]), float(state["gyro_noise"]["density"])
    if measured <= CLEARLY_MORE * told:
        return []
    return [
        f"at rest the gyros are {measured / told:.1f} times as noisy as told, which is allowed for: set "
        f"imu.gyro_noise_density to {measured:.2g}"
    ]


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
    return found + axis_complaints(state)
