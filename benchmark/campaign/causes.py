"""Which causes a sentence of the filter names, so that a campaign can tell right ones from wrong ones.

The closed list of causes. A sentence that matches none of them describes and blames nothing: it is neither right nor
wrong. One that lists rivals names all of them.
"""

from __future__ import annotations

import re

CAUSES = {
    "IMU stamps": r"(stamps of the IMU|IMU('s)? (samples|stamps)|IMU is stamped).*(jitter|scatter|burst|irregular"
    r"|uneven|late|share|same stamp|stamp of another)",
    "IMU holes": r"(samples|IMU|readings).*(missing|hole|gap|bridged|straight line|repeat)",
    "clipping": r"clip|saturat|end of (its|their) range",
    "shocks": r"\b(shock|blow|spike)",
    "vibration": r"vibrat",
    "IMU stuck": r"stuck|(gyro|accelerometer|axis).*(same reading|does not change|constant)",
    "IMU noise": r"IMU noise|imu\.\*_noise|imu\.(gyro|accel)_(noise_density|bias_random_walk)",
    "IMU bias": r"imu\.(gyro|accel)_bias_std|bias.*(chang|jump|step|drift)",
    "IMU axes": r"axes|axis.*(negat|swap|invert|revers)|upside|left-handed",
    "IMU mounting": r"imu\.mount_rpy_deg",
    "IMU scale": r"\bscale\b.*(gyro|accelerometer|IMU)|(gyro|accelerometer|IMU).*\bscale\b|imu_scale",
    "gravity": r"removes gravity|units of g\b",
    "IMU units": r"deg/s\? REP-103",
    "lever arm": r"(gnss|second_gnss)\.lever_arm",
    "position offset": r"(gnss|ranges)\.time_offset",
    "velocity offset": r"velocity_time_offset",
    "clocks apart": r"synchronise the clocks|clocks? .*apart|ahead of the IMU|behind the IMU",
    "clock set": r"clock.*(set (back|ahead|forward)|jump|step)|stamps? (went|go|jumped) back",
    "NED velocity": r"\bNED\b|[Nn]orth-[Ee]ast-[Dd]own.*velocit|velocit.*(north, east, down|[Nn]orth-[Ee]ast-[Dd]own)",
    "stale fixes": r"(fix|position|coordinates|message).*(frozen|stale|repeat|sent again|same coordinates|unchanged)",
    "unfilled fixes": r"\(0, 0, 0\)|unfilled|not filled|null island|0, 0",
    "lasting errors": r"gnss\.correlation_time|errors (last|are the same from fix to fix)",
    "fix covariance": r"gnss\.covariance_scale|gnss\.position_std_floor",
    "velocity covariance": r"velocit.*claim too much|velocity_std_floor|velocity.*covariance_scale",
    "multipath": r"multipath",
    "spoofing": r"spoof",
    "given heading": r"initial_heading_deg.*(wrong|contradict|off)|heading (that was )?given.*(wrong|contradict|off)",
    "course": r"use_course|course over ground|side slip|crab",
    "low rate": r"imu\.gap",
    "nanoseconds": r"nanosec",
    "altitude missing": r"without an altitude|altitude.*(NaN|not a number|missing)",
    "same stamps": r"(fix|position|velocit|message).*(share|same|equal|whole).*(stamp|second)|duplicate",
    "outage": r"outage|no fixes|silent",
}
"""Pattern in the sentence, by cause."""

_PATTERNS = {cause: re.compile(pattern) for cause, pattern in CAUSES.items()}

_DESCRIBES = re.compile(r"heading is (still unknown|known to)")
"""Sentences that say what is known, and name remedies that are no causes."""


def causes_of(sentence: str) -> frozenset[str]:
    """Return the causes that a sentence names."""
    if _DESCRIBES.search(sentence):
        return frozenset()
    return frozenset(cause for cause, pattern in _PATTERNS.items() if pattern.search(sentence))


def is_named(sentence: str, names: tuple[str, ...]) -> bool:
    """Whether a sentence names one of the right causes."""
    return not causes_of(sentence).isdisjoint(names)


def is_wrong(sentence: str, names: tuple[str, ...], also: tuple[str, ...]) -> bool:
    """Whether a sentence names causes of which none is true."""
    found = causes_of(sentence)
    return bool(found) and found.isdisjoint((*names, *also))
