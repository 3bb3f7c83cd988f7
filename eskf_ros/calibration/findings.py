"""What a calibration has found, and whether the recordings have shown it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.calibration.coarse_mounting import CoarseMounting
from eskf_ros.calibration.combine import Combined
from eskf_ros.calibration.constants import Constant, value_of
from eskf_ros.calibration.recording import Look, Pass
from eskf_ros.calibration.roll import SHOWN_BY as ROLL_SHOWN_BY
from eskf_ros.calibration.roll import Roll
from eskf_ros.parameters.mapping import from_mapping, to_mapping
from eskf_ros.parameters.tree import Parameters

Array = NDArray[np.float64]

SHOWN_SHARE = 0.3
"""A constant is shown where its standard deviation is below this share of that at first."""

SAME = 0.95
"""Correlation of two constants from which on the motion has not told them apart."""

WELL_KNOWN_SHARE = 0.05
"""A constant with a standard deviation below this share of that at first is shown, whatever it is correlated with."""


@dataclass(frozen=True)
class Finding:
    """One value: that of ``parameter`` (its ``element``, None for a scalar), before and after, in its unit.

    ``std``: standard deviation, in the unit. ``is_shown``: False where the recordings leave it open; ``text`` says why,
    with the motion that would show it, and else the evidence.
    """

    name: str
    parameter: str
    element: int | None
    before: float
    value: float
    std: float
    unit: str
    is_shown: bool
    text: str

    def as_dict(self) -> dict[str, Any]:
        """Return the finding for the JSON file."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


@dataclass(frozen=True)
class Calibration:
    """The result of `calibrate`.

    ``before``, ``parameters``: those given, and those with all that was shown. ``figures``: "before" and "after", one
    dictionary for each of ``recordings`` (`compare.figures_of`). ``passes``: how many it took.
    """

    before: Parameters
    parameters: Parameters
    findings: list[Finding]
    figures: dict[str, list[dict[str, Any]]]
    recordings: list[str]
    passes: int
    warnings: list[str]

    def named(self, name: str) -> Finding:
        """Return the finding of one constant; raises KeyError if there is none."""
        for finding in self.findings:
            if finding.name == name:
                return finding
        raise KeyError(name)


def findings_of(
    constants: Sequence[Constant],
    start: Parameters,
    current: Parameters,
    combined: Combined,
    passes: Sequence[Pass],
    moved: Array,
) -> list[Finding]:
    """Judge each constant: its standard deviation against that at first, and its correlations."""
    std = np.sqrt(np.diag(combined.covariance))
    correlation = combined.covariance / np.outer(std, std) - np.eye(len(std))
    # Innovations that are larger than they should be, and recordings that contradict each other, are told.
    surprise = math.sqrt(max([1.0, *(nis for one in passes for nis in one.nis.values())]))
    found = []
    for k, constant in enumerate(constants):
        factor = constant.factor
        told = max(std[k] * max(1.0, surprise, combined.spread[k]), constant.least_std)
        partner = int(np.argmax(np.abs(correlation[k])))
        share = std[k] / constant.prior_std
        is_same = abs(correlation[k, partner]) > SAME and share > WELL_KNOWN_SHARE
        is_shown = share < SHOWN_SHARE and not is_same
        if is_shown:
            text = evidence(constant, told, passes, combined.spread[k], k)
        elif is_same and share < SHOWN_SHARE:
            other = constants[partner].name
            text = f"not told apart from {other} (correlation {correlation[k, partner]:.2f}); {constant.shown_by}"
        else:
            text = f"not shown: the sigma went from {constant.prior_std * factor:.3g} to {std[k] * factor:.3g}"
            text = f"{text} {constant.unit}".rstrip() + f"; it takes {constant.shown_by}"
        found.append(
            Finding(
                constant.name,
                constant.parameter,
                constant.element,
                value_of(start, constant),
                value_of(current, constant),
                float(told * factor),
                constant.unit,
                bool(is_shown),
                text,
            )
        )
    return found


def evidence(constant: Constant, told: float, passes: Sequence[Pass], spread: float, k: int) -> str:
    """Return what a value rests on, in one line."""
    factor, unit = constant.factor, constant.unit
    text = f"sigma {told * factor:.2g} {unit}".rstrip() + f" (at first {constant.prior_std * factor:.2g})"
    knowing = sum(math.sqrt(one.covariance[k, k]) < 0.5 * one.prior_std[k] for one in passes)
    if len(passes) > 1:
        text += f", shown by {knowing} of {len(passes)} recordings"
        text += f" that agree within {spread:.1f} sigma" if knowing > 1 else ""
    return text


def roll_finding(start: Parameters, current: Parameters, roll: Roll, coarse: CoarseMounting | None) -> Finding:
    """Return the roll of the mounting, which no state of the filter shows (see `roll`)."""
    value = current.imu.mount_rpy_deg[0]
    std = math.degrees(roll.joint[1])
    text = f"sigma {std:.2g} deg; {roll.text}" if roll.is_known else f"not shown: it takes {ROLL_SHOWN_BY}"
    if coarse is not None:
        coarse_rpy = ", ".join(f"{angle:.1f}" for angle in coarse.rotation.as_euler("xyz", degrees=True))
        text += f"; gravity and accelerations alone say roll, pitch, yaw {coarse_rpy}"
    before = start.imu.mount_rpy_deg[0]
    return Finding("mounting_roll", "imu.mount_rpy_deg", 0, before, value, std, "deg", roll.is_known, text)


def noise_findings(looks: Sequence[Look], parameters: Parameters) -> list[Finding]:
    """Return the noise densities of the IMU, for those parameters that are at their defaults."""
    seen = [(look.rest, look.road) for look in looks]
    found = []
    for name, unit in (("gyro", "rad/s/rtHz"), ("accel", "m/s2/rtHz")):
        key = f"{name}_noise_density"
        before = getattr(parameters.imu, key)
        rest, road = ([getattr(d, name) for pair in seen if (d := pair[k]) is not None] for k in (0, 1))
        values = road or rest
        is_given = before != getattr(Parameters().imu, key)
        value = max(values) if values else before
        text = ", ".join(
            f"{label} {max(part):.2g}" for label, part in (("at rest", rest), ("on the road", road)) if part
        )
        text = f"seen {text}" if text else "not shown: it takes 20 s of rest or of driving, with velocities of GNSS"
        if is_given and values:
            text = f"as configured; {text}"
        spread = float(np.std(values)) if len(values) > 1 else 0.2 * value
        found.append(
            Finding(f"{name}_noise", f"imu.{key}", None, before, before if is_given else value, spread, unit,
                    bool(values) and not is_given, text)
        )  # fmt: skip
    return found


def with_noise(parameters: Parameters, noises: Sequence[Finding]) -> Parameters:
    """Return the parameters with the noise that was seen."""
    values: dict[str, Any] = dict(to_mapping(parameters))
    values |= {finding.parameter: finding.value for finding in noises if finding.is_shown}
    return from_mapping(values)


def findings_of_ranges(findings: Sequence[Finding], given: Parameters) -> list[Finding]:
    """Return the findings with the time offset as that of the ranges."""
    found = []
    for finding in findings:
        if finding.name == "time_offset":
            offset = given.ranges.time_offset
            before, value = finding.before + offset, finding.value + offset
            found.append(dataclasses.replace(finding, parameter="ranges.time_offset", before=before, value=value))
        elif finding.name != "velocity_time_offset":
            found.append(finding)
    return found


LEFT_TO_THE_NODE: dict[str, dict[str, Any]] = {
    "mounting_yaw": {"nhc.enabled": True, "estimate.mounting_std_deg": 0.5},
    "wheel_scale": {"estimate.wheel_scale_std": 0.005},
}
"""Parameters that follow where a constant was shown: load and tyre pressure change it a little from day to day."""


def with_consequences(parameters: Parameters, findings: Sequence[Finding]) -> Parameters:
    """Return the parameters with what follows from the findings."""
    values: dict[str, Any] = dict(to_mapping(parameters))
    for finding in findings:
        if finding.is_shown:
            values |= LEFT_TO_THE_NODE.get(finding.name, {})
    return from_mapping(values)
