"""The verdict in plain words: can this result be used, what was found, what to do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from eskf_ros.report.state import Outage

GOOD, CAUTION, BAD = "good", "caution", "bad"
EXPECTED = 0.95
"""Share of the values that a right covariance leaves below the 95 % quantile of chi-square."""
TOO_SURE = 0.85
"""Share in 95 % below which covariances claim too much."""
FEWEST = 50
"""Measurements of a kind, at least, for a word on their statistics."""
MANY_REJECTED = 0.05
LEAST_USABLE = 0.9
SHORT = 5.0
"""s; shorter outages are not worth a word."""
OF_THE_START = ("before_alignment", "disabled", "duplicate", "low_elevation")
"""Verdicts that do not say that a measurement contradicts."""


@dataclass(frozen=True)
class Finding:
    """What was found: `level` GOOD, CAUTION or BAD, the fact, and what to do about it (empty: nothing)."""

    level: str
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Verdict:
    """The worst level, one sentence, and the findings behind it, the gravest first."""

    level: str
    headline: str
    findings: tuple[Finding, ...]


def verdict_of(summary: dict[str, Any], outages: Sequence[Outage] = ()) -> Verdict:
    """Return the verdict on a replay from its summary.json, and its times without an accepted position."""
    found = [*_start(summary), *_warnings(summary), *_aids(summary), *_outages(outages), *_truth(summary)]
    order = (BAD, CAUTION, GOOD)
    found.sort(key=lambda finding: order.index(finding.level))
    level = found[0].level if found else GOOD
    remarks = sum(finding.level != GOOD for finding in found)
    if level == BAD:
        headline = "Do not navigate by this result yet."
    elif level == CAUTION:
        headline = f"It works, with {'one remark' if remarks == 1 else f'{remarks} remarks'}."
    else:
        headline = "Good: nothing wrong was found."
    return Verdict(level, headline, tuple(found))


def _start(summary: dict[str, Any]) -> list[Finding]:
    """Return what is said of position, heading, the end and the usable share."""
    final, quality = summary["final"], summary["quality"]
    if final["position"] is None:
        return [Finding(BAD, "No position was found.", "See the reasons below, and eskf_check on the recording.")]
    found = []
    status = final["status"]
    if status in ("LEVELLING", "WAITING_FIX", "WAITING_HEADING", "ALIGNING"):
        what = "the heading was never certain" if "FIX" not in status else "positions were missing"
        found.append(
            Finding(
                BAD,
                f"The alignment was not complete at the end ({status}): {what}.",
                "Accelerate and turn once, give alignment.initial_heading_deg, or add a heading sensor.",
            )
        )
    elif status in ("DEGRADED", "FAULT"):
        found.append(Finding(BAD, f"At the end the state was {status}: the fixes contradict the estimate."))
    usable = quality["usable"]
    reasons = {name: share for name, share in quality.items() if name not in ("usable", "good", "coasting")}
    why = ", ".join(f"{name.replace('_', ' ')} {share:.0%}" for name, share in reasons.items() if share >= 0.005)
    if usable >= LEAST_USABLE or set(reasons) <= {"not_aligned", "coasted_too_long"}:
        rest = f"; else: {why}" if why else ""
        found.append(
            Finding(GOOD, f"Usable for navigation in {usable:.0%} of the time since the first position{rest}.")
        )
    else:
        found.append(
            Finding(CAUTION, f"Usable for navigation in only {usable:.0%} of the time since the first position: {why}.")
        )
    if summary["position_resets"]:
        count = summary["position_resets"]
        found.append(
            Finding(
                CAUTION,
                f"{count} times fixes won over the filter: position and velocity were reset to them.",
                "Look at the errors and innovations before each reset (measurements with the verdict reset).",
            )
        )
    if summary.get("takeovers"):
        count = summary["takeovers"]
        found.append(
            Finding(
                CAUTION,
                f"{count} times the filter continued from its humble lane, which believes the IMU less: the IMU was "
                "worse than its parameters say.",
                "Look for shocks, clipping and vibration in the IMU panels; raise imu.*_noise_density.",
            )
        )
    return found


def _warnings(summary: dict[str, Any]) -> list[Finding]:
    """Return the warnings of the replay; what follows the first colon says what to do."""
    found = []
    for warning in summary["warnings"]:
        fact, colon, remedy = warning.partition(": ")
        found.append(Finding(CAUTION, _sentence(fact), _sentence(remedy) if colon else ""))
    return found


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "?")) else ".")


def _aids(summary: dict[str, Any]) -> list[Finding]:
    """Return what the counts and the consistency of each kind of measurement say."""
    found, fine = [], []
    for name, aid in summary["aids"].items():
        if aid["offered"] < FEWEST:
            continue
        reasons = {key: count for key, count in aid["verdicts"].items() if key not in OF_THE_START}
        judged = sum(reasons.values())
        bad = aid["rejected"] - sum(aid["verdicts"].get(key, 0) for key in OF_THE_START)
        if judged and bad > MANY_REJECTED * judged:
            what = ", ".join(
                f"{count} {key}" for key, count in reasons.items() if key not in ("fused", "weighed_down", "waiting")
            )
            found.append(Finding(CAUTION, f"{bad / judged:.0%} of {name} were rejected ({what})."))
        share = aid["nis_in_95"]
        if share is not None and share < TOO_SURE:
            found.append(
                Finding(
                    CAUTION,
                    f"{name} disagrees with the estimate more than both claim: mean NIS {aid['nis_mean']:.1f}, "
                    f"{share:.0%} within the 95 % bound.",
                    "Covariances too small, or lever arm, time offset or mounting wrong.",
                )
            )
        elif share is not None:
            fine.append(f"{name} {share:.0%}")
    if fine:
        found.append(Finding(GOOD, f"Innovations within their 95 % bound: {', '.join(fine)}."))
    return found


def _outages(outages: Sequence[Outage]) -> list[Finding]:
    """Return how the longest outage ended."""
    long = sorted((outage for outage in outages if outage.length > SHORT), key=lambda outage: -outage.length)
    if not long:
        return []
    first = long[0]
    count = "One outage" if len(long) == 1 else f"{len(long)} outages, the longest"
    text = f"{count} of {first.length:.0f} s without an accepted position: at its end sigma {first.sigma:.1f} m"
    if math.isnan(first.error):
        return [Finding(GOOD, f"{text}.")]
    text += f", error {first.error:.1f} m."
    if first.error > 3.0 * first.sigma:
        return [Finding(CAUTION, text, "The filter was too sure: raise the noise parameters of the IMU.")]
    return [Finding(GOOD, text)]


def _truth(summary: dict[str, Any]) -> list[Finding]:
    """Return what the comparison with truth says."""
    errors, found = summary.get("error"), []
    if not errors or not errors["horizontal"]:
        return []
    horizontal, heading = errors["horizontal"], errors["heading_deg"]
    text = f"Against truth: horizontal error {horizontal['rms']:.2f} m rms, {horizontal['max']:.2f} m at most"
    text += f"; heading {heading['rms']:.2f} deg rms." if heading else "."
    found.append(Finding(GOOD, text))
    for name, nees in summary["nees"].items():
        if nees and nees["in_95"] < TOO_SURE:
            found.append(
                Finding(
                    CAUTION,
                    f"The covariance of the {name} claims too much: mean NEES {nees['mean']:.1f} (ideal 3), "
                    f"{nees['in_95']:.0%} within the 95 % bound.",
                    "Raise the noise parameters of the IMU, or gnss.covariance_scale.",
                )
            )
    return found
