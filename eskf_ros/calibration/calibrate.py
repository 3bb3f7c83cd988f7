"""`calibrate`: passes of the filter with the constants of the installation as states, until nothing changes.

A constant has no process noise: what the filter knows of it at the end of a recording is what the whole recording says,
and a backward pass would add nothing. The model is linear in the constants only near the truth; so each pass begins at
what the one before has found. Where the recordings leave a constant open, its value stays what it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from eskf_ros.calibration.coarse_mounting import CoarseMounting
from eskf_ros.calibration.combine import Combined, combine
from eskf_ros.calibration.compare import compared
from eskf_ros.calibration.constants import (
    CONSTANTS,
    Constant,
    as_states,
    begin_stds,
    changed,
    constants_of,
    rpy_deg,
    with_mounting,
)
from eskf_ros.calibration.findings import (
    Calibration,
    findings_of,
    findings_of_ranges,
    noise_findings,
    roll_finding,
    with_consequences,
    with_noise,
)
from eskf_ros.calibration.ranges import constants_of_ranges, with_fixes, with_ranges
from eskf_ros.calibration.recording import Look, Pass, Recording, as_recording, look_at, run_pass
from eskf_ros.calibration.roll import Roll, weighed_mean
from eskf_ros.filter.measurements.row import to_base
from eskf_ros.inputs.table import uses_ranges
from eskf_ros.parameters.ros_yaml import load
from eskf_ros.parameters.tree import Parameters

Array = NDArray[np.float64]
Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""`map` over recordings; None where one has failed and is to be left out."""

MOST_PASSES = 8
"""Passes after which the calibration ends although something still changes, with a warning."""

SETTLED_SHARE = 0.2
"""A constant has settled when a pass changes it by less than this share of its standard deviation."""

SETTLED_ROLL = math.radians(0.02)
"""rad; the same of the roll of the mounting."""

BEGIN_SIGMAS = 10.0
"""From the second pass on a constant begins with this many of the sigmas of the pass before, at most with its prior:
near the truth the filter is linear from the start. What a recording says is the same, whatever it began with.
"""

LARGEST_STEP = 3.0
"""A pass changes a constant by at most this many of its prior standard deviations."""

OTHER_MOUNTING_DEG = 15.0
"""deg; a configured mounting that is further from the coarse one is not believed."""

OUTAGE = (30.0, 120.0)
"""s; length of the outages of the comparison, and from the start of one to that of the next."""


def calibrate(
    recordings: Any,
    parameters: str | PathLike[str] | Parameters | None = None,
    is_vehicle: bool | None = None,
    truth: str = "",
    compares: bool = True,
    each: Each = map,
    say: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Return the calibration of one installation from one or several recordings.

    ``recordings``: a path, tables as `eskf_ros.run` takes them (stamps in ns), or a list of these. ``parameters``: what
    is known; topics, lever arm and mounting from there are the start. ``is_vehicle``: it is on wheels and does not slip
    sideways (default: ``nhc.enabled``, or wheels in a recording). ``truth``: a topic to compare with. ``compares``:
    run each recording before and after. ``each``: replaces `map` over recordings, for several processes
    (`fleet.Rounds`); ``say`` hears of the progress.

    Raises:
        BagError, InputError: a recording cannot be read.
        ParameterError: the parameter file cannot be used.
        ValueError: there is no recording, or none that can be used.
    """
    if not isinstance(parameters, Parameters):
        parameters = Parameters() if parameters is None else load(parameters)
    sources = recordings if isinstance(recordings, list | tuple) else [recordings]
    given = [as_recording(source, parameters) for source in sources]
    if not given:
        raise ValueError("there is no recording to calibrate with")
    if not uses_ranges(parameters):
        return calibrated(given, parameters, constants_of, is_vehicle, truth, compares, each, say)
    if any(recording.held is not None for recording in given):
        raise ValueError("mode tight is calibrated with recordings: tables have no ranges of satellites")
    found = calibrated(given, with_fixes(parameters), constants_of_ranges, is_vehicle, truth, compares, each, say)
    return replace(
        found,
        before=parameters,
        parameters=with_ranges(found.parameters, parameters),
        findings=findings_of_ranges(found.findings, parameters),
    )


def calibrated(
    given: list[Recording],
    parameters: Parameters,
    wanted: Callable[[set[str], bool], tuple[Constant, ...]],
    is_vehicle: bool | None,
    truth: str,
    compares: bool,
    each: Each,
    say: Callable[[str], None],
) -> Calibration:
    """Return the calibration with positions and velocities, of the constants ``wanted`` of inputs and vehicle."""
    given, looks = each_of(given, partial(look_at, may_be_vehicle=is_vehicle is not False), each)
    inputs = {name for look in looks for name in look.inputs}
    if is_vehicle is None:
        is_vehicle = parameters.nhc.enabled or "wheel" in inputs
    warnings: list[str] = []
    noises = noise_findings(looks, parameters)
    start = with_noise(parameters, noises)
    coarse = None
    if is_vehicle:
        start, coarse = with_coarse_mounting(looks, start, warnings, say)
    constants = wanted(inputs, is_vehicle)
    given, current, combined, passes, moved, roll, count = iterate(
        given, start, constants, is_vehicle, each, warnings, say
    )
    findings = findings_of(constants, start, current, combined, passes, moved)
    if is_vehicle:
        findings.append(roll_finding(start, current, roll, coarse))
    final = with_consequences(start_with(start, current, findings, moved, constants), findings)
    figures: dict[str, list[dict[str, Any]]] = {}
    if compares:
        say("comparing before and after")
        both = partial(compared, before=parameters, after=final, outage=OUTAGE, truth=truth)
        given, pairs = each_of(given, both, each)
        figures = {label: [pair[label] for pair in pairs] for label in ("before", "after")}
    return Calibration(parameters, final, [*findings, *noises], figures, [r.name for r in given], count, warnings)


def each_of(
    given: Sequence[Recording], function: Callable[[Recording], Any], each: Each
) -> tuple[list[Recording], list[Any]]:
    """Return the recordings with which ``each`` could do the function, and what it returned for them.

    Raises ValueError if it could with none.
    """
    done = [(one, result) for one, result in zip(given, each(function, given), strict=True) if result is not None]
    if not done:
        raise ValueError("there is no recording that can be used")
    return [one for one, _ in done], [result for _, result in done]


def iterate(
    given: list[Recording],
    start: Parameters,
    constants: Sequence[Constant],
    is_vehicle: bool,
    each: Each,
    warnings: list[str],
    say: Callable[[str], None],
) -> tuple[list[Recording], Parameters, Combined, list[Pass], Array, Roll, int]:
    """Run passes until nothing changes.

    Returns the recordings that went through, parameters, what the last pass said together and for each recording, the
    sum of all corrections, the last roll, and the number of passes.
    """
    current, moved = start, np.zeros(len(constants))
    prior_std = np.array([constant.prior_std for constant in constants])
    least = np.array([constant.least_std for constant in constants])
    first_std = begin_stds(constants, prior_std)
    for number in range(1, MOST_PASSES + 1):
        say(f"pass {number}")
        states = as_states(current, constants, is_vehicle, first_std)
        one_pass = partial(run_pass, parameters=states, constants=constants, first_std=first_std)
        given, passes = each_of(given, one_pass, each)
        combined = combine(passes, moved, prior_std)
        std = np.maximum(np.sqrt(np.diag(combined.covariance)), least)
        first_std = begin_stds(constants, np.minimum(prior_std, BEGIN_SIGMAS * std))
        step = np.clip(combined.correction, -LARGEST_STEP * prior_std, LARGEST_STEP * prior_std)
        corrections = dict(zip((constant.name for constant in constants), step.tolist(), strict=True))
        roll = joint_roll(passes)
        if is_vehicle and roll.is_known:
            corrections["mounting_roll"] = -roll.joint[0]
        current, moved = changed(current, corrections), moved + step
        share = np.abs(step) / std
        if share.max() < SETTLED_SHARE and abs(corrections.get("mounting_roll", 0.0)) < SETTLED_ROLL:
            break
    else:
        slowest = constants[int(share.argmax())].name
        warnings.append(f"after {number} passes {slowest} still changes by {share.max():.1f} of its sigma")
    for one, recording in zip(passes, given, strict=True):
        if one.restarts:
            warnings.append(f"{recording.name}: the alignment had to start again {one.restarts} times")
    return given, current, combined, passes, moved, roll, number


def joint_roll(passes: Sequence[Pass]) -> Roll:
    """Return the roll of base_link that several recordings say together."""
    by_turns = weighed_mean([one.roll.by_turns for one in passes])
    by_road = weighed_mean([one.roll.by_road for one in passes])
    return Roll(by_turns, by_road)


def with_coarse_mounting(
    looks: Sequence[Look], parameters: Parameters, warnings: list[str], say: Callable[[str], None]
) -> tuple[Parameters, CoarseMounting | None]:
    """Return the parameters with the coarse mounting of the IMU, unless the configured one is close to it."""
    found = [look.coarse for look in looks if look.coarse is not None]
    if not found:
        warnings.append(
            "the orientation of the IMU was taken from imu.mount_rpy_deg: a coarse one is not shown without GNSS "
            "velocities that speed up and brake above 3 m/s"
        )
        return parameters, None
    best = min(found, key=lambda coarse: coarse.std_deg)
    apart = max(math.degrees((best.rotation.inv() * other.rotation).magnitude()) for other in found)
    if apart > OTHER_MOUNTING_DEG:
        warnings.append(f"the IMU is mounted differently in the recordings, by {apart:.0f} deg: calibrate them apart")
    configured = Rotation.from_matrix(to_base(parameters.imu.mount_rpy_deg))
    off = math.degrees((configured.inv() * best.rotation).magnitude())
    if off <= OTHER_MOUNTING_DEG:
        return parameters, best
    rpy = rpy_deg(best.rotation)
    say(f"coarse mounting of the IMU: {', '.join(f'{angle:.1f}' for angle in rpy)} deg")
    if any(parameters.imu.mount_rpy_deg):
        warnings.append(f"imu.mount_rpy_deg is {off:.0f} deg from what gravity and the drive say: it was not used")
    return with_mounting(parameters, rpy), best


def start_with(
    start: Parameters, current: Parameters, findings: Sequence[Any], moved: Array, constants: Sequence[Constant]
) -> Parameters:
    """Return the parameters that were found, those that were refused as at the ``start``."""
    refused = {finding.name for finding in findings if not finding.is_shown}
    back = {c.name: -float(change) for c, change in zip(constants, moved, strict=True) if c.name in refused}
    assert set(back) <= {constant.name for constant in CONSTANTS}
    found = changed(current, back)
    if "heading_offset" in refused:  # The baseline is where it was in the axes of the vehicle, not in those of the IMU.
        found = replace(found, heading=start.heading)
    return found
