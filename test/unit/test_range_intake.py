"""What becomes of messages of ranges and ephemerides on their way into the navigator, and what is said of them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Stream, Verdict
from eskf_ros.gnss.cloud import write_epoch
from eskf_ros.gnss.ephemeris import Broadcast, Message
from eskf_ros.gnss.ephemeris_cloud import write_ephemerides
from eskf_ros.gnss.range_files import read_navigation_files
from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, SATELLITE_KNOWN, allocate_ranges
from eskf_ros.gnss.ranges import Status as RangeStatus
from eskf_ros.gnss.signals import Gnss
from eskf_ros.inputs.epochs import DEFAULT_KLOBUCHAR, RECENT, RangeIntake
from eskf_ros.parameters.mapping import from_mapping

SECOND = 1_000_000_000
STAMP = 1_700_000_000_123_456_789
ANTENNA = np.array([6.378e6, 0.0, 0.0])
WEEK, TOW = 2300, 1000.0
SKY = Path(__file__).resolve().parents[2] / "bags" / "sky.nav"


def intake_of(**given: Any) -> RangeIntake:
    navigator = Navigator(from_mapping({name.replace("__", "."): value for name, value in given.items()}))
    return RangeIntake(navigator, navigator.parameters)


def records_of(intake: RangeIntake) -> NDArray[Any]:
    return intake._navigator.finish()


def epoch(count: int = 8, known: bool = True) -> NDArray[Any]:
    """Points of an epoch of GPS satellites all around an antenna at rest, with their states if ``known``."""
    ranges = allocate_ranges(count)
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    up = np.where(np.arange(count) % 2, 0.5, 1.5)
    ranges["sv_id"], ranges["signal"] = np.arange(1, count + 1), 0
    ranges["satellite"] = ANTENNA + 2e7 * np.stack([up, np.cos(turn), np.sin(turn)], axis=1)
    ranges["pseudorange"] = np.linalg.norm(ranges["satellite"] - ANTENNA, axis=1)
    for name in ("satellite_velocity", "satellite_clock", "satellite_clock_drift", "doppler"):
        ranges[name] = 0.0
    ranges["flags"] = CODE_VALID | DOPPLER_VALID | SATELLITE_KNOWN * known
    return write_epoch(ranges, WEEK, TOW, satellites=known)


def test_a_point_solution_gets_the_time_offset_of_the_ranges_and_no_other() -> None:
    offsets = {"ranges__time_offset": 0.25, "gnss__time_offset": -0.4, "second_gnss__time_offset": 3.0}
    intake = intake_of(ranges__use_point_solution=True, **offsets)
    intake.take_ranges(STAMP, epoch())
    records = records_of(intake)
    assert sorted(records["stream"]) == [Stream.GNSS_POSITION, Stream.GNSS_VELOCITY]
    assert records["stamp"].tolist() == [STAMP + SECOND // 4] * 2


def spoiled(broadcasts: list[Broadcast], **fields: float) -> list[Broadcast]:
    return [broadcast._replace(fields={**broadcast.fields, **fields}) for broadcast in broadcasts]


@pytest.mark.parametrize(
    ("fields", "words"),
    [({"sqrt_a": math.nan}, "missing or not finite"), ({"e": 0.9}, "none that a satellite can have")],
)
def test_ephemerides_that_place_no_satellite_are_named_and_counted(fields: dict[str, float], words: str) -> None:
    intake = intake_of(mode="tight")
    good = read_navigation_files([SKY]).broadcasts[:9]
    intake.take_ephemerides(STAMP, write_ephemerides(good))
    assert not intake.refused
    intake.take_ephemerides(STAMP, write_ephemerides([*spoiled(good[:2], **fields), *good[2:]]))
    ((reason, count),) = intake.refused.items()
    assert words in reason
    assert count == 2
    assert any("2 times: ephemerides" in text and words in text for text in intake.complaints)


def test_what_is_left_out_of_navigation_files_is_told(tmp_path: Path) -> None:
    assert intake_of(mode="tight", ranges__rinex_nav_files=str(SKY)).notes == []
    lines = SKY.read_text(encoding="ascii").splitlines(keepends=True)
    first = next(k for k, line in enumerate(lines) if "END OF HEADER" in line) + 1
    lines[first + 1] = lines[first + 1].replace("E", "?")
    lines[first + 10] = lines[first + 10][:61] + " 0.000000000000E+00" + lines[first + 10][80:]
    path = tmp_path / "spoiled.nav"
    path.write_text("".join(lines), encoding="ascii")
    intake = intake_of(mode="tight", ranges__rinex_nav_files=str(path))
    unreadable, impossible = intake.notes
    assert unreadable.startswith(str(path))
    assert unreadable.endswith("(1)")
    assert impossible == "ranges.rinex_nav_files: a parameter of orbit or clock is none that a satellite can have (1)"
    assert set(intake.notes) <= set(intake.complaints)


def test_what_is_wrong_now_is_told_by_the_last_messages_and_at_the_end_by_all() -> None:
    """Ephemerides that come late are no complaint for long, and a feed that dies after long is one soon."""
    intake = intake_of(mode="tight", ranges__rinex_nav_files=str(SKY))
    good, without = epoch(), epoch(known=False)

    def take(points: NDArray[Any], count: int) -> tuple[bool, bool]:
        for _ in range(count):
            intake.take_ranges(STAMP, points)
        lists = intake.recent_complaints, intake.complaints
        now, all_along = (any("ranges.rinex_nav_files" in text for text in found) for found in lists)
        return now, all_along

    assert take(without, 10 * RECENT) == (True, True)
    assert f"{8 * RECENT} of the last {8 * RECENT} signals cannot be used (stale)" in intake.recent_complaints[0]
    assert take(good, RECENT // 2 + 1) == (False, True)
    assert take(good, 20 * RECENT) == (False, False)
    assert take(without, RECENT // 2 - 1) == (False, False)
    assert take(without, 2) == (True, False)


def test_a_message_that_was_refused_is_a_complaint_for_a_while_and_counted_for_ever() -> None:
    intake = intake_of(mode="tight", ranges__rinex_nav_files=str(SKY))
    bad = epoch()[["gnss_id", "sv_id"]]
    intake.take_ranges(STAMP, bad)
    intake.take_ephemerides(STAMP, bad)
    assert len(intake.recent_complaints) == len(intake.complaints) == 2
    for _ in range(RECENT - 1):
        intake.take_ranges(STAMP, epoch())
    (text,) = intake.recent_complaints
    assert text.startswith("ephemerides: ")
    assert text.endswith(f"(1 in the last {RECENT} messages of ranges and ephemerides)")
    intake.take_ranges(STAMP, epoch())
    assert intake.recent_complaints == []
    assert len(intake.complaints) == sum(intake.refused.values()) == 2


@pytest.mark.parametrize("solves", [False, True])
def test_recent_signals_are_judged_with_a_point_solution_too(solves: bool) -> None:
    given = {"ranges__use_point_solution": True} if solves else {"mode": "tight"}
    intake = intake_of(**given)
    intake.take_ranges(STAMP, epoch(known=False))
    assert any("8 of the last 8 signals cannot be used (no_ephemeris)" in text for text in intake.recent_complaints)
    assert sum(intake._navigator.range_statuses.values()) == 8


def test_the_ionosphere_is_that_of_gps_and_where_there_is_none_of_qzss(monkeypatch: pytest.MonkeyPatch) -> None:
    """BeiDou's parameters belong to another model and are not used."""
    intake = intake_of(mode="tight")
    used: list[NDArray[np.float64]] = []
    monkeypatch.setattr(intake._navigator, "push_ranges", lambda *arguments: used.append(arguments[3]))
    ephemeris = read_navigation_files([SKY]).broadcasts[0]
    messages = {Gnss.BEIDOU: Message.D1, Gnss.QZSS: Message.LNAV, Gnss.GPS: Message.LNAV}

    def after(gnss: Gnss, seconds: int, number: float) -> float:
        """The first parameter an epoch is used with, long after a message of this constellation."""
        broadcast = ephemeris._replace(gnss=gnss, sv_id=2, message=messages[gnss])
        points = write_ephemerides([broadcast], {gnss: np.full(8, number)})
        intake.take_ephemerides(STAMP + seconds * SECOND, points)
        intake.take_ranges(STAMP + 100 * SECOND, epoch())
        return float(used[-1][0])

    def stands_in() -> bool:
        return any("those of a middling day stand in" in text for text in intake.recent_complaints)

    assert after(Gnss.BEIDOU, 10, 3.0) == DEFAULT_KLOBUCHAR[0]
    assert stands_in()
    assert after(Gnss.QZSS, 11, 5.0) == 5.0
    assert not stands_in()
    assert after(Gnss.GPS, 12, 1.0) == 1.0
    assert after(Gnss.QZSS, 13, 6.0) == 1.0
    assert after(Gnss.GPS, 14, 2.0) == 2.0
    assert not intake.refused


@pytest.mark.parametrize("letter", ["QZS", "BDS"])
def test_the_ionosphere_of_qzss_out_of_a_file(tmp_path: Path, letter: str) -> None:
    path = tmp_path / "other.nav"
    text = SKY.read_text(encoding="ascii")
    path.write_text(text.replace("GPSA", f"{letter}A").replace("GPSB", f"{letter}B"), encoding="ascii")
    intake = intake_of(mode="tight", ranges__rinex_nav_files=str(path))
    intake.take_ranges(STAMP, epoch())
    assert bool(intake.recent_complaints) == (letter == "BDS")
    first = DEFAULT_KLOBUCHAR[0] if letter == "BDS" else 1.8626e-8
    assert intake._serving(STAMP, (WEEK, TOW))[1][0] == first


def test_two_hundred_signals_of_an_epoch_go_through_the_filter_and_are_counted() -> None:
    """Of 250 the first 200 are read: each has its record, and the robot stays where it is."""
    intake = intake_of(mode="tight")
    navigator = intake._navigator
    points = np.concatenate([epoch(50)] * 5)
    points["gnss_id"] = np.repeat([Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU, Gnss.QZSS, Gnss.GPS], 50)
    epochs = 20
    stamps = STAMP + np.arange(0, (epochs + 3) * SECOND, SECOND // 50)
    for k in range(epochs + 3):
        part = stamps[50 * k : 50 * (k + 1)]
        navigator.push_imu(part, np.tile([0.0, 0.0, 9.8], (50, 1)), np.zeros((50, 3)))
        if k >= 3:
            intake.take_ranges(int(part[-1]), points)
    records = records_of(intake)
    assert navigator.range_statuses == {RangeStatus.USABLE: 200 * epochs}
    assert sum(intake.refused.values()) == 50 * epochs
    assert any("signals beyond the first 200 of an epoch" in text for text in intake.complaints)
    for stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE):
        verdicts = records["verdict"][records["stream"] == stream]
        assert len(verdicts) == 200 * epochs
        assert len(set(records["source"][records["stream"] == stream])) == 200
        assert np.isin(verdicts, (Verdict.FUSED, Verdict.WEIGHED_DOWN)).sum() > 100 * epochs
    assert len(navigator.latest_epoch) == 200
    row = navigator.odometry[0]
    assert np.isfinite(row["pose_covariance"]).all()
    assert np.linalg.norm(row["velocity_map"]) < 0.1
