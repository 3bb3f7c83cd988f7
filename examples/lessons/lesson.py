"""What all lessons share: a simulated recording through the filter, its error against the truth, page and picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import eskf_ros
from eskf_ros.simulate.recording import Recording

Array = NDArray[np.float64]

BLUE, ORANGE, GREEN, RED, BLACK, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#000000", "#888888"
"""Colours that the colour-blind tell apart (Okabe and Ito)."""


@dataclass(frozen=True)
class Outcome:
    """What a lesson found: ``figures`` as the text quotes them, the ``claims`` that the text rests on, a picture."""

    figures: dict[str, str]
    claims: dict[str, bool]
    picture: Figure


@dataclass(frozen=True)
class Lesson:
    """One lesson. ``sentence``, for the index, and ``text`` have the figures of the outcome as ``{name}``.

    ``by_hand``: commands that show the same without Python. ``run`` takes the number of simulated recordings where the
    lesson counts on many; ``runs`` is how many the page has.
    """

    name: str
    title: str
    sentence: str
    text: str
    by_hand: str
    run: Callable[[int], Outcome]
    runs: int = 1

    def page(self, figures: dict[str, str]) -> str:
        """Return the page in Markdown."""
        return (
            f"# {self.title}\n\n"
            f"{self.sentence.format_map(figures)}\n\n"
            f"```sh\n.venv/bin/python examples/lessons {self.name}\n```\n\n"
            f"![{self.title}]({self.name}.png)\n\n"
            f"{self.text.format_map(figures).strip()}\n\n"
            f"## By hand\n\n{self.by_hand.strip()}\n\n"
            "[All lessons](README.md)\n"
        )


def tables(recording: Recording) -> dict[str, dict[str, Any]]:
    """Return IMU, position and velocity of a recording as tables for `eskf_ros.run`."""
    return {
        "imu": {
            "stamp": recording.imu_stamp,
            "specific_force": recording.specific_force,
            "angular_rate": recording.angular_rate,
        },
        "gnss_position": {
            "stamp": recording.fix_stamp,
            "latitude_deg": recording.fix_latitude_deg,
            "longitude_deg": recording.fix_longitude_deg,
            "altitude": recording.fix_altitude,
            "covariance": recording.fix_covariance,
        },
        "gnss_velocity": {
            "stamp": recording.velocity_stamp,
            "velocity": recording.velocity_enu,
            "covariance": recording.velocity_covariance,
        },
    }


@dataclass(frozen=True)
class Track:
    """An estimate and its error at n times; ``seconds`` (n,) from the first IMU sample.

    ``error`` (n, 3) m: east, north, up. ``rotation_error`` (n, 3) rad about these axes: roughly tilt, tilt, heading.
    ``sigma`` (n, 3) m and ``rotation_sigma`` (n, 3) rad: the standard deviations that the filter gives. ``rows``: the
    ODOMETRY rows. NaN while position, or heading, are unknown.
    """

    seconds: Array
    error: Array
    rotation_error: Array
    sigma: Array
    rotation_sigma: Array
    rows: NDArray[Any]
    result: eskf_ros.Result

    @property
    def horizontal(self) -> Array:
        """Horizontal error (n,) in m."""
        return np.asarray(np.hypot(self.error[:, 0], self.error[:, 1]))

    @property
    def horizontal_sigma(self) -> Array:
        """Its standard deviation (n,) in m, by the filter."""
        return np.asarray(np.hypot(self.sigma[:, 0], self.sigma[:, 1]))

    @property
    def heading(self) -> Array:
        """Heading error (n,) in degrees."""
        return np.degrees(self.rotation_error[:, 2])

    def at(self, values: Array, seconds: float) -> float:
        """Return a value at a time (s)."""
        return float(values[np.searchsorted(self.seconds, seconds)])

    def rms(self, values: Array, first: float = 0.0, last: float = np.inf) -> float:
        """Return the root mean square of values between two times (s)."""
        inside = (self.seconds >= first) & (self.seconds <= last)
        return float(np.sqrt(np.nanmean(values[inside] ** 2)))


def navigate(recording: Recording, changes: dict[str, Any] | None = None, rate: float = 10.0, **given: Any) -> Track:
    """Run the filter over a recording and compare with its truth.

    ``changes``: parameters by dotted name, besides those that describe the sensors. ``rate`` of the comparison in Hz.
    ``given``: tables in the place of those of the recording, None for one that is left out.
    """
    parameters = {**recording.parameters(), **(changes or {})}
    result = eskf_ros.run(**{**tables(recording), **given}, parameters=parameters, output_rate=rate)
    return compare(recording, result)


def compare(recording: Recording, result: eskf_ros.Result) -> Track:
    """Return the errors of a result at the stamps that it shares with the truth."""
    _, at, rows_at = np.intersect1d(recording.truth_stamp, result.odometry["stamp"], return_indices=True)
    rows = result.odometry[rows_at]
    truth = Rotation.from_quat(recording.truth_attitude_body_to_map[at][:, [1, 2, 3, 0]])
    estimate = Rotation.from_quat(rows["attitude_body_to_map"][:, [1, 2, 3, 0]])
    stds = np.sqrt(np.diagonal(rows["pose_covariance"], axis1=1, axis2=2))
    known, headed = rows["position_known"][:, None], rows["heading_known"][:, None]
    return Track(
        seconds=(rows["stamp"] - recording.imu_stamp[0]) * 1e-9,
        error=np.where(known, rows["position_map"] - recording.truth_position_map[at], np.nan),
        rotation_error=np.where(headed, (estimate * truth.inv()).as_rotvec(), np.nan),
        sigma=np.where(known, stds[:, :3], np.nan),
        rotation_sigma=stds[:, 3:],
        rows=rows,
        result=result,
    )


def fix_errors(recording: Recording) -> tuple[Array, Array]:
    """Return when the receiver gave fixes (n,), s from the first IMU sample, and how far they are off, horizontally."""
    stamps = recording.truth_stamp
    turns = Rotation.from_quat(recording.truth_attitude_body_to_map[:, [1, 2, 3, 0]])
    antenna = recording.truth_position_map + turns.apply(recording.options.lever_arm)
    at = np.column_stack([np.interp(recording.fix_stamp, stamps, antenna[:, axis]) for axis in range(3)])
    places = zip(recording.fix_latitude_deg, recording.fix_longitude_deg, recording.fix_altitude)
    fixes = np.array([recording.frame.from_geodetic_deg(*place) for place in places])
    inside = (recording.fix_stamp >= stamps[0]) & (recording.fix_stamp <= stamps[-1])
    error = np.linalg.norm((fixes - at)[inside, :2], axis=1)
    return (recording.fix_stamp[inside] - recording.imu_stamp[0]) * 1e-9, np.asarray(error)


def two_panels() -> tuple[Figure, Any, Any]:
    """Return a figure with two panels side by side."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    for panel in (left, right):
        panel.grid(True, alpha=0.3)
    return figure, left, right


def number(value: float) -> str:
    """Return a number with two or three significant digits."""
    size = abs(value)
    if size >= 99.5:
        return f"{value:.3g}" if size < 1e3 else f"{float(f'{value:.3g}'):.0f}"
    return f"{value:.1f}" if size >= 9.95 else f"{value:.2g}" if size < 1.0 else f"{value:.1f}"
