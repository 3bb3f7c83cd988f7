"""Findings on the readings of the IMU alone: units, gravity, mounting, frozen and bridged samples, clipping, noise."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from eskf_ros.doctor.finding import Finding, Severity
from eskf_ros.doctor.sensors import Array, Recording, Sensor
from eskf_ros.doctor.stamps import timing_of
from eskf_ros.doctor.track import AT_REST, Track, seconds_from
from eskf_ros.filter.integrity.imu_monitor import FASTEST_TURN, GRAVITY_TOLERANCE, NO_GRAVITY, UPRIGHT_COSINE
from eskf_ros.geodesy.earth import STANDARD_GRAVITY
from eskf_ros.geodesy.rotation import from_roll_pitch_yaw, to_matrix
from eskf_ros.parameters.tree import Parameters

AXES = ("x", "y", "z")

QUIET_FORCE, QUIET_RATE = 0.5, 0.05
"""m/s2, rad/s; standard deviations within a second below which the IMU may be at rest."""

ALIKE_FORCE, ALIKE_RATE = 0.1, 0.005
"""m/s2, rad/s; changes of the means from one second at rest to the next, at most."""

SLOW_BY_POSITIONS = 1.0
"""m/s; as `AT_REST` where the speed comes from scattered positions."""

REPEATED_SHARE = 0.01
"""Share of samples equal to the one before in all axes from which on they are told."""

STUCK = 2.0
"""s; a reading that stays the same bit for bit for longer, while others change, is stuck."""

BRIDGED = 10
"""Samples in a row on a straight line in all six axes: no sensor does that."""

CLIPPED = 5
"""Samples in a row at the largest reading of an axis: the sensor is at its limit."""

SHOCK = 50.0
"""m/s2; a change of the specific force within two samples that is a blow, not motion."""

NOISE_RATIO = 1.5
"""Ratio of the noise in the readings to the parameter from which on it is told."""


WANDERING = math.radians(0.1)
"""rad/s; a gyro whose reading at rest changes by more during a recording warms up, or was changed."""


def imu_findings(sensor: Sensor, recording: Recording, track: Track | None) -> list[Finding]:
    """Return what is wrong with the readings of an IMU; the ``track`` tells when the robot rests."""
    found = []
    finite = np.isfinite(sensor.values).all(axis=1)
    if not finite.all():
        bad = int(np.count_nonzero(~finite))
        severity = Severity.ERROR if 10 * bad > len(sensor) else Severity.WARNING
        text = f"{bad} of {len(sensor)} samples are not finite"
        found.append(Finding(severity, "not_finite", sensor.topic, text, "look at the driver", {"samples": bad}))
    samples = sensor.at(np.flatnonzero(finite)).by_stamp()
    if len(samples) < 20:
        return found
    interval = timing_of(samples.stamp).interval
    found += _repetition_findings(samples, interval)
    found += _clipping_findings(samples)
    found += _shock_findings(samples)
    seconds = Seconds(samples, track)
    found += _gravity_findings(samples, seconds, recording.parameters)
    rates = _rate_findings(samples, seconds, recording.parameters)
    found += rates
    if any(finding.name == "degrees_per_second" for finding in rates):
        return found
    found += _wandering_findings(samples, seconds)
    return found + _noise_findings(samples, seconds, interval, recording.parameters)


class Seconds:
    """Means and standard deviations of the readings by whole seconds with at least half their samples.

    ``stamp``: (m,) ns of the middle. ``mean``, ``std``: (m, 6). ``quiet``: (m,) as at rest. ``rest``: (m,) quiet
    between two quiet ones with the same means, and slow by the track if there is one. ``white``: (m, 6) standard
    deviation of what changes from sample to sample.
    """

    def __init__(self, samples: Sensor, track: Track | None = None) -> None:
        """Take samples by stamp."""
        second = samples.stamp // 1_000_000_000
        edges = np.flatnonzero(np.diff(second, prepend=second[0] - 1))
        counts = np.diff(np.append(edges, len(second)))
        kept = (counts >= 0.5 * np.median(counts)) & (counts >= 3)
        values = samples.values
        total = np.add.reduceat(values, edges)
        self.mean: Array = (total / counts[:, None])[kept]
        square = np.add.reduceat((values - np.repeat(total / counts[:, None], counts, axis=0)) ** 2, edges)
        self.std: Array = np.sqrt(square / counts[:, None])[kept]
        # Second differences: what is straight over three samples is motion. Their variance is six times that of one.
        bend = np.zeros_like(values)
        bend[1:-1] = values[2:] - 2.0 * values[1:-1] + values[:-2]
        self.white: Array = np.sqrt(np.add.reduceat(bend**2, edges) / counts[:, None] / 6.0)[kept]
        self.stamp = (second[edges] * 1_000_000_000 + 500_000_000)[kept]
        force, rate = self.std[:, :3].max(axis=1, initial=0.0), self.std[:, 3:].max(axis=1, initial=0.0)
        quiet_force = np.maximum(QUIET_FORCE, 1.5 * np.percentile(force, 5.0)) if len(force) else QUIET_FORCE
        self.quiet: NDArray[np.bool_] = (force < min(quiet_force, 2.0)) & (rate < QUIET_RATE)
        change = np.abs(np.diff(self.mean, axis=0))
        alike = (change[:, :3].max(axis=1, initial=0.0) < ALIKE_FORCE) & (
            change[:, 3:].max(axis=1, initial=0.0) < ALIKE_RATE
        )
        pair = self.quiet[1:] & self.quiet[:-1] & alike
        self.rest: NDArray[np.bool_] = np.zeros(len(self.mean), bool)
        self.rest[1:-1] = pair[1:] & pair[:-1]
        time, velocity = track.speeds() if track is not None else (np.zeros(0), np.zeros((0, 2)))
        if track is not None and len(time):
            speed = np.interp(seconds_from(self.stamp, track.origin), time, np.hypot(*velocity.T))
            self.rest &= speed < (AT_REST if track.has_velocity else SLOW_BY_POSITIONS)


def longest_runs(is_so: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Return the length of the longest run of True in (n,), where it begins, and the number of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_so, [False]]).astype(np.int8)))
    if not len(edges):
        return 0, 0, 0
    lengths = edges[1::2] - edges[::2]
    longest = int(np.argmax(lengths))
    return int(lengths[longest]), int(edges[2 * longest]), int(lengths.sum())


def is_limit(column: Array, value: float) -> bool:
    """Whether a value at which an axis (n,) stays is its limit: an extreme, or a size at which it stays repeatedly.

    A sensor whose range was set smaller in mid-drive has read more before.
    """
    if value in (column.min(), column.max()):
        return True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], np.abs(column) == abs(value), [False]]).astype(np.int8)))
    return int(np.count_nonzero(edges[1::2] - edges[::2] >= CLIPPED)) > 1


def _repetition_findings(samples: Sensor, interval: float) -> list[Finding]:
    found = []
    values, begin = samples.values, samples.stamp[0]
    same = np.diff(values, axis=0) == 0.0
    whole = same.all(axis=1)
    length, start, count = longest_runs(whole)
    if count > REPEATED_SHARE * len(samples) or length * interval > 0.5:
        at = (samples.stamp[start] - begin) * 1e-9
        text = (
            f"{count} samples repeat the one before in every axis, up to {length} in a row ({at:.1f} s after the start)"
        )
        remedy = "let the driver publish new samples only, and leave out what was lost"
        evidence = {"samples": count, "longest_s": length * interval}
        found.append(Finding(Severity.WARNING, "repeated_samples", samples.topic, text, remedy, evidence))
    for axis in range(6):
        length, start, _ = longest_runs(same[:, axis] & ~whole)
        if length * interval > STUCK and not is_limit(values[:, axis], values[start, axis]):
            name = f"{'accelerometer' if axis < 3 else 'gyro'} {AXES[axis % 3]}"
            at = (samples.stamp[start] - begin) * 1e-9
            text = f"the {name} stays at {values[start, axis]:.4g} for {length * interval:.1f} s, from {at:.1f} s on"
            remedy = "look at the sensor: the other axes move"
            evidence = {"seconds": length * interval}
            found.append(Finding(Severity.ERROR, "stuck_axis", samples.topic, text, remedy, evidence))
    bend = np.abs(values[2:] - 2.0 * values[1:-1] + values[:-2])
    size = np.abs(values).max(axis=0) + 1e-300
    straight = (bend < 1e-9 * size).all(axis=1) & ~whole[1:]
    length, start, count = longest_runs(straight)
    if length >= BRIDGED:
        at = (samples.stamp[start] - begin) * 1e-9
        text = f"{count} samples lie on straight lines between others, up to {length} in a row (at {at:.1f} s)"
        remedy = "do not interpolate: leave out samples that were lost"
        evidence = {"samples": count, "longest_s": length * interval}
        found.append(Finding(Severity.WARNING, "bridged_samples", samples.topic, text, remedy, evidence))
    return found


def _clipping_findings(samples: Sensor) -> list[Finding]:
    found = []
    for axis in range(6):
        column = samples.values[:, axis]
        _, start, _ = longest_runs(np.diff(column) == 0.0)
        stays = float(column[start])
        limits = {float(column.max()): "above", float(column.min()): "below"}
        if is_limit(column, stays):
            limits.setdefault(stays, "above" if stays > np.median(column) else "below")
        for limit, side in limits.items():
            at_limit = column == limit
            length, _, count = longest_runs(at_limit)
            spread = np.percentile(column, 75.0) - np.percentile(column, 25.0)
            if length < CLIPPED or count < 2 * CLIPPED or abs(limit - np.median(column)) < 2.0 * spread:
                continue
            if len(np.unique(column[:: max(1, len(column) // 5000)])) < 20:
                continue  # so coarse a sensor repeats every reading
            name = f"{'accelerometer' if axis < 3 else 'gyro'} {AXES[axis % 3]}"
            unit = "m/s2" if axis < 3 else "rad/s"
            text = f"the {name} is clipped {side} at {limit:.4g} {unit}: {count} samples, up to {length} in a row"
            remedy = "choose a larger range of the sensor, or dampen its mounting"
            evidence = {"samples": count, "limit": float(limit)}
            found.append(Finding(Severity.WARNING, "clipped", samples.topic, text, remedy, evidence))
    return found


def _shock_findings(samples: Sensor) -> list[Finding]:
    """Return how often the force leaps within two samples as no vehicle does."""
    leap = np.linalg.norm(np.diff(samples.values[:, :3], axis=0), axis=1) > SHOCK
    shocks = int(np.count_nonzero(np.diff(samples.stamp[1:][leap]) > 500_000_000)) + 1 if leap.any() else 0
    if not shocks:
        return []
    at = float((samples.stamp[1:][leap][0] - samples.stamp[0]) * 1e-9)
    text = f"{shocks} times the specific force leaps by more than {SHOCK:.0f} m/s2 between samples, first at {at:.1f} s"
    remedy = "shocks: fasten or dampen the IMU, and choose a range that it can read"
    return [Finding(Severity.WARNING, "shocks", samples.topic, text, remedy, {"shocks": shocks})]


def rotation_imu_to_base(parameters: Parameters) -> Array:
    """Return the rotation matrix (3, 3) from IMU axes to base_link of the parameters."""
    return np.array(to_matrix(from_roll_pitch_yaw(*map(math.radians, parameters.imu.mount_rpy_deg))))


def up_in_imu(seconds: Seconds) -> Array:
    """Return the mean direction of the specific force, up on the whole, in IMU axes (3,)."""
    mean = (
        seconds.mean[seconds.quiet, :3].mean(axis=0) if seconds.quiet.sum() >= 3 else seconds.mean[:, :3].mean(axis=0)
    )
    up: Array = mean / max(float(np.linalg.norm(mean)), 1e-12)
    return up


def _gravity_findings(samples: Sensor, seconds: Seconds, parameters: Parameters) -> list[Finding]:
    rests = seconds.rest.sum() >= 3
    chosen = seconds.mean[seconds.rest, :3] if rests else seconds.mean[:, :3]
    if not len(chosen):
        return []
    strengths = np.linalg.norm(chosen, axis=1)
    strength = float(np.median(strengths))
    evidence = {"strength": strength}
    where = "at rest" if rests else "on average"
    says = f"{where} the accelerometer reads {strength:.3f} m/s2 where gravity is {STANDARD_GRAVITY:.2f}"
    if abs(strength - 1.0) < GRAVITY_TOLERANCE:
        remedy = "it is in units of g: multiply by 9.80665 (REP-103 wants m/s2)"
        return [Finding(Severity.ERROR, "units_of_g", samples.topic, says, remedy, evidence)]
    if strength < NO_GRAVITY * STANDARD_GRAVITY:
        remedy = "the driver removes gravity: publish the raw specific force (REP-145: +g up at rest)"
        return [Finding(Severity.ERROR, "gravity_removed", samples.topic, says, remedy, evidence)]
    if abs(strength / STANDARD_GRAVITY - 1.0) > GRAVITY_TOLERANCE:
        return [Finding(Severity.ERROR, "gravity_scale", samples.topic, says, "look at unit and scale", evidence)]
    found = []
    if rests and abs(strength - STANDARD_GRAVITY) > 3.0 * parameters.imu.accel_bias_std:
        remedy = f"calibrate the accelerometer, or raise imu.accel_bias_std ({parameters.imu.accel_bias_std:g})"
        found.append(Finding(Severity.WARNING, "gravity_scale", samples.topic, says, remedy, evidence))
    up = rotation_imu_to_base(parameters) @ up_in_imu(seconds)
    if up[2] < UPRIGHT_COSINE:
        found.append(_tilted(samples, up_in_imu(seconds), up))
    return found


def _tilted(samples: Sensor, up_imu: Array, up_base: Array) -> Finding:
    """Return the finding on an IMU whose up is not up in base_link, with roll and pitch that would make it so."""
    roll = math.degrees(math.atan2(up_imu[1], up_imu[2])) % 360.0
    pitch = math.degrees(math.atan2(-up_imu[0], math.hypot(up_imu[1], up_imu[2])))
    right = tuple(90.0 * round(angle / 90.0) if abs(angle - 90.0 * round(angle / 90.0)) < 15.0 else round(angle, 1)
                  for angle in (roll, pitch))  # fmt: skip
    x, y, z = STANDARD_GRAVITY * up_base
    cause = "upside down, or its axes are North-East-Down" if up_base[2] < -UPRIGHT_COSINE else "mounted on its side"
    return Finding(
        Severity.ERROR,
        "not_upright",
        samples.topic,
        f"gravity is ({x:.1f}, {y:.1f}, {z:.1f}) m/s2 in base_link, not along +z: the IMU is {cause}",
        f"set imu.mount_rpy_deg to [{right[0]:g}, {right[1]:g}, yaw], yaw as it is mounted",
        {"roll_deg": roll, "pitch_deg": pitch},
        {"imu.mount_rpy_deg": (float(right[0]), float(right[1]), 0.0)},
    )


def _rate_findings(samples: Sensor, seconds: Seconds, parameters: Parameters) -> list[Finding]:
    fast = int(np.count_nonzero(np.linalg.norm(seconds.mean[:, 3:], axis=1) > FASTEST_TURN))
    if fast:
        text = f"the gyro reads more than {FASTEST_TURN:.0f} rad/s for {fast} s"
        remedy = "it is in deg/s: multiply by pi / 180 (REP-103 wants rad/s)"
        return [Finding(Severity.ERROR, "degrees_per_second", samples.topic, text, remedy, {"seconds": fast})]
    if seconds.rest.sum() < 3:
        return []
    bias = np.median(seconds.mean[seconds.rest, 3:], axis=0)
    size = float(np.abs(bias).max())
    if size < 3.0 * parameters.imu.gyro_bias_std:
        return []
    x, y, z = np.degrees(bias)
    wanted = min(1.0, float(f"{size:.2g}"))
    text = f"at rest the gyro reads ({x:.2f}, {y:.2f}, {z:.2f}) deg/s, more than imu.gyro_bias_std allows for"
    remedy = f"calibrate it, or set imu.gyro_bias_std to {wanted:g}"
    evidence, changes = {"rad_per_s": size}, {"imu.gyro_bias_std": wanted}
    return [Finding(Severity.WARNING, "gyro_bias", samples.topic, text, remedy, evidence, changes)]


def _wandering_findings(samples: Sensor, seconds: Seconds) -> list[Finding]:
    """Compare what the gyro reads at rest early and late in the recording."""
    rests = np.flatnonzero(seconds.rest)
    if len(rests) < 6:
        return []
    first, last = (np.median(seconds.mean[part, 3:], axis=0) for part in (rests[:3], rests[-3:]))
    change = float(np.linalg.norm(last - first))
    span = float((seconds.stamp[rests[-1]] - seconds.stamp[rests[0]]) * 1e-9)
    noise = float(np.linalg.norm(np.std(np.diff(seconds.mean[rests, 3:], axis=0), axis=0))) / math.sqrt(2.0)
    if change < max(WANDERING, 5.0 * noise):
        return []
    wanted = min(0.1, float(f"{change / math.sqrt(max(span, 1.0)):.1g}"))
    text = (
        f"at rest the gyro reads {math.degrees(change):.2f} deg/s else after {span:.0f} s: it warms up, or was changed"
    )
    remedy = f"set imu.gyro_bias_random_walk to {wanted:g}, or let it warm up first"
    evidence, changes = {"rad_per_s": change, "seconds": span}, {"imu.gyro_bias_random_walk": wanted}
    return [Finding(Severity.WARNING, "gyro_wanders", samples.topic, text, remedy, evidence, changes)]


def _noise_findings(samples: Sensor, seconds: Seconds, interval: float, parameters: Parameters) -> list[Finding]:
    """Compare what changes from sample to sample, vibration included, with the white noise of the parameters."""
    found = []
    for first, name, unit in ((0, "accel", "m/s2/rtHz"), (3, "gyro", "rad/s/rtHz")):
        if not len(seconds.white):
            continue
        # The worst axis in the median second: vibration counts as the filter integrates it.
        density = float(np.median(seconds.white[:, first : first + 3], axis=0).max()) * math.sqrt(interval)
        told = getattr(parameters.imu, f"{name}_noise_density")
        if density > NOISE_RATIO * told:
            wanted = float(f"{density:.1g}")
            text = (
                f"the readings scatter like {density:.2g} {unit}, {density / told:.1f} times imu.{name}_noise_density"
            )
            remedy = f"set imu.{name}_noise_density to {wanted:g}, or dampen the mounting"
            evidence, changes = {"density": density, "ratio": density / told}, {f"imu.{name}_noise_density": wanted}
            found.append(Finding(Severity.WARNING, "noise_told_small", samples.topic, text, remedy, evidence, changes))
    return found
