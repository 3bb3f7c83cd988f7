"""Observation files of version 2 and 3: columns, epochs, time systems, events, damage; a real one against RTKLIB."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eskf_ros.gnss.ranges import CODE_VALID, DOPPLER_VALID, Status
from eskf_ros.gnss.rinex import RinexError
from eskf_ros.gnss.rinex_obs import Observations, read_observations
from eskf_ros.gnss.signals import SIGNALS, Gnss
from support import gnss_texts as texts
from support.gnss_oracle import RtklibNavigation, week_and_seconds

WEEK, SECONDS = texts.WEEK, 6 * 86400.0 + 7200.0


def header_3(version: str = "3.04", clock: str = "GPS", *more: str) -> str:
    return texts.header(
        version,
        "OBSERVATION DATA",
        texts.labelled(" -3817680.9841  3562840.0688  3650158.4543", "APPROX POSITION XYZ"),
        texts.labelled("G    8 C1C L1C D1C S1C C2W L2W D2W S2W", "SYS / # / OBS TYPES"),
        texts.labelled("C    4 C2I L2I D2I S2I", "SYS / # / OBS TYPES"),
        texts.labelled("R   14 C1C L1C D1C S1C C1P L1P D1P S1P C2C L2C D2C S2C C2P", "SYS / # / OBS TYPES"),
        texts.labelled("       L2P", "SYS / # / OBS TYPES"),
        texts.labelled(f"  2024     7    20     2     0    0.0000000     {clock}", "TIME OF FIRST OBS"),
        *more,
    )


def cell(value: float | None, tail: str = "  ") -> str:
    """Sixteen columns: a number and two flags."""
    return " " * 16 if value is None else f"{value:14.3f}{tail}"


def line_3(satellite: str, *values: float | None) -> str:
    return satellite + "".join(cell(value, " 7") for value in values).rstrip() + "\n"


def epoch_3(*lines: str, date: str = "2024 07 20 02 00  0.0000000", flag: int = 0) -> str:
    return f"> {date}  {flag}{len(lines):3d}\n" + "".join(lines)


GPS_LINE = line_3("G05", 22e6, 1e8, -700.25, 45.5, 22000003.125, 9e7, -545.5, 33.0)


def read(folder: Path, text: str) -> Observations:
    path = folder / "made.obs"
    path.write_text(text, encoding="ascii")
    return read_observations(path)


def found(observations: Observations, epoch: int = 0) -> dict[tuple[int, int, str], tuple[float, float, float]]:
    """Pseudorange, Doppler and C/N0 by constellation, satellite and signal."""
    first, count = observations.epochs[epoch]["first"], observations.epochs[epoch]["count"]
    return {
        (int(row["gnss_id"]), int(row["sv_id"]), SIGNALS[row["signal"]].code): (
            float(row["pseudorange"]),
            float(row["doppler"]),
            float(row["cn0"]),
        )
        for row in observations.observations[first : first + count]
    }


def test_columns(tmp_path: Path) -> None:
    body = epoch_3(GPS_LINE, line_3("C21", None, None, 12.5), line_3("R07", *[None] * 8, 2.1e7, None, 3.5, 41.0))
    observations = read(tmp_path, header_3() + body)
    assert observations.complaints.notes == []
    assert (observations.epochs[0]["week"], observations.epochs[0]["seconds"]) == (WEEK, SECONDS)
    np.testing.assert_array_equal(observations.approximate_position, [-3817680.9841, 3562840.0688, 3650158.4543])
    signals = found(observations)
    assert signals.pop((0, 5, "1C")) == (22e6, -700.25, 45.5)
    assert signals.pop((0, 5, "2W")) == (22000003.125, -545.5, 33.0)
    assert signals.pop((6, 7, "2C")) == (2.1e7, 3.5, 41.0)
    assert signals[3, 21, "2I"][1] == 12.5
    assert math.isnan(signals.pop((3, 21, "2I"))[0])
    assert signals == {}
    located = observations.ranges(0)
    assert list(located["flags"]) == [3, 3, DOPPLER_VALID, 3]
    assert list(located["status"]) == [Status.NOT_LOCATED] * 4
    assert located["carrier_hz"][0] == 1575.42e6
    # The channel of a GLONASS satellite comes with its ephemeris.
    assert np.isnan(located["carrier_hz"][3])


def test_epochs_events_and_what_is_not_used(tmp_path: Path) -> None:
    body = (
        epoch_3(GPS_LINE)
        + epoch_3("a comment\n", "another\n", flag=4)
        + epoch_3(GPS_LINE, "S23  22000000.000\n", "I01  22000000.000\n", date="2024 07 20 23 59 59.9990000")
        + epoch_3(GPS_LINE, date="2024 07 21 00 00  0.1990000", flag=1)
    )
    observations = read(tmp_path, header_3() + body)
    assert [(week, round(seconds, 6)) for week, seconds, *_ in observations.epochs.tolist()] == [
        (WEEK, SECONDS),
        (WEEK, 604799.999),
        (WEEK + 1, 0.199),
    ]
    assert [len(found(observations, epoch)) for epoch in range(3)] == [2, 2, 2]
    assert observations.complaints.counts == {
        "event record not used": 1,
        "satellite of constellation 'S' not used": 1,
        "satellite of constellation 'I' not used": 1,
    }


@pytest.mark.parametrize(("clock", "offset"), [("GPS", 0.0), ("GAL", 0.0), ("BDT", 14.0), ("GLO", 18.0), ("   ", 0.0)])
def test_epochs_are_gps_time_whatever_the_receivers(tmp_path: Path, clock: str, offset: float) -> None:
    observations = read(tmp_path, header_3("3.04", clock) + epoch_3(GPS_LINE))
    assert observations.epochs[0]["seconds"] == SECONDS + offset


def test_b1i_has_had_two_names(tmp_path: Path) -> None:
    """Version 3.02 calls band 1 what every other version calls band 2 (1561 MHz, not B1C at 1575 MHz)."""
    for version, name, code in (
        ("3.02", "C1I", "2I"),
        ("3.02", "C1X", "2X"),
        ("3.04", "C1I", "2I"),
        ("3.04", "C2I", "2I"),
        ("3.04", "C1X", "1X"),
        ("3.04", "C1P", "1P"),
    ):
        header = texts.header(version, "OBSERVATION DATA", texts.labelled(f"C    1 {name}", "SYS / # / OBS TYPES"))
        observations = read(tmp_path, header + epoch_3(line_3("C21", 2.2e7)))
        assert list(found(observations)) == [(Gnss.BEIDOU, 21, code)]


def test_scale_factors(tmp_path: Path) -> None:
    scale = texts.labelled("G  100  2 C1C D1C", "SYS / SCALE FACTOR")
    observations = read(tmp_path, header_3("3.04", "GPS", scale) + epoch_3(GPS_LINE))
    assert found(observations)[0, 5, "1C"] == (22e4, -7.0025, 45.5)


HEADER_2 = texts.header(
    "2.11",
    "OBSERVATION DATA",
    texts.labelled("    11    C1    L1    D1    S1    P1    P2    L2    D2    S2", "# / TYPES OF OBSERV"),
    texts.labelled("          C2    C5", "# / TYPES OF OBSERV"),
    texts.labelled("  2024     7    20     2     0    0.0000000     GPS", "TIME OF FIRST OBS"),
)


def satellite_2(*values: float | None) -> str:
    cells = [cell(value) for value in values] + [cell(None)] * (11 - len(values))
    return "".join("".join(cells[k : k + 5]).rstrip() + "\n" for k in range(0, 11, 5))


def epoch_2(satellites: list[str], rows: list[str], date: str = " 24  7 20  2  0  0.0000000", flag: int = 0) -> str:
    lines = []
    for k in range(0, max(1, len(satellites)), 12):
        start = f"{date}  {flag}{len(satellites):3d}" if k == 0 else " " * 32
        lines.append(start + "".join(satellites[k : k + 12]) + "\n")
    return "".join(lines + rows)


def test_version_2(tmp_path: Path) -> None:
    """Doppler and C/N0 go with the band; a blank constellation is GPS; thirteen satellites need a second line."""
    names = [f" {number:2d}" for number in range(1, 12)] + ["R07", "E11"]
    ranges = [22e6 + k for k in range(13)]
    rows = [satellite_2(code, 1e8, -700.25, 45.5, code + 0.5, code + 3.0, 9e7, -545.5, 33.0) for code in ranges]
    event = " " * 28 + "4  1\n" + "a comment\n"
    body = epoch_2(names, rows) + event + epoch_2([" 1"], [satellite_2(22e6)], " 24  7 20  2  0 30.0000000")
    body = body.replace("1 1\n", "1G 1\n")
    observations = read(tmp_path, HEADER_2 + body)
    signals = found(observations)
    assert len(signals) == 12 * 3 + 1
    assert (0, 5, "2X") not in signals
    assert signals[0, 5, "1C"] == (22000004.0, -700.25, 45.5)
    assert signals[0, 5, "1W"] == (22000004.5, -700.25, 45.5)
    assert signals[0, 5, "2W"] == (22000007.0, -545.5, 33.0)
    assert signals[6, 7, "1P"] == (22000011.5, -700.25, 45.5)
    assert signals[2, 11, "1X"] == (22000012.0, -700.25, 45.5)
    assert observations.epochs[1]["seconds"] == SECONDS + 30.0
    assert list(found(observations, 1)) == [(0, 1, "1C")]
    assert observations.complaints.counts == {"event record not used": 1}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (texts.header(), "is not observation data"),
        (texts.header("3.04", "OBSERVATION DATA"), "has no SYS / # / OBS TYPES"),
        (texts.header("2.11", "OBSERVATION DATA"), "has no # / TYPES OF OBSERV"),
        ("1.0                 COMPACT RINEX FORMAT".ljust(60) + "CRINEX VERS   / TYPE\n", "decompress it first"),
    ],
)
def test_what_is_no_observation_file_is_said_in_one_line(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(RinexError, match=complaint) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "made.obs") + ":")


def test_damage_costs_what_is_damaged(tmp_path: Path) -> None:
    body = (
        epoch_3(GPS_LINE.replace("22000000.000", "2200x000.000"))
        + epoch_3(GPS_LINE, date="2024 07 20 02 00 ??.0000000")
        + "garbage\n"
        + f"> 2024 07 20 02 00 30.0000000  0  3\n{GPS_LINE}"
        + epoch_3(GPS_LINE, GPS_LINE[:20] + "\n", date="2024 07 20 02 01  0.0000000")
    )
    observations = read(tmp_path, header_3() + body)
    assert len(observations.epochs) == 3
    assert math.isnan(found(observations)[0, 5, "1C"][0])
    assert found(observations)[0, 5, "2W"][0] == 22000003.125
    counts = observations.complaints.counts
    assert counts["unreadable observation"] == 1
    assert counts["unreadable epoch"] == 1
    assert counts["epoch with fewer satellites than it says"] == 1
    assert observations.complaints.notes[0].startswith(f"{tmp_path / 'made.obs'}:")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
@given(st.data(), st.booleans())
def test_no_damage_is_fatal(tmp_path: Path, data: st.DataObject, version_2: bool) -> None:
    if version_2:
        body = epoch_2([" 1", "R07"], [satellite_2(22e6)] * 2) * 3
        text = HEADER_2
    else:
        body, text = epoch_3(GPS_LINE, line_3("C21", 2.2e7)) * 3, header_3()
    lines = body.splitlines()
    for _ in range(data.draw(st.integers(1, 6))):
        if not lines:
            break
        index = data.draw(st.integers(0, len(lines) - 1))
        at = data.draw(st.integers(0, max(0, len(lines[index]) - 1)))
        change = data.draw(st.sampled_from(["drop", "double", "cut", "byte"]))
        if change == "drop":
            del lines[index]
        elif change == "double":
            lines.insert(index, lines[index])
        elif change == "cut":
            lines[index] = lines[index][:at]
        else:
            lines[index] = lines[index][:at] + chr(data.draw(st.integers(32, 126))) + lines[index][at + 1 :]
    observations = read(tmp_path, text + "\n".join(lines))
    for epoch in range(len(observations.epochs)):
        located = observations.ranges(epoch)
        assert np.isfinite(located["pseudorange"][located["flags"] & CODE_VALID != 0]).all()
    assert observations.epochs["count"].sum() == len(observations.observations)


def test_a_real_file_is_read_as_rtklib_reads_it(data_folder: Callable[[str], Path]) -> None:
    path = data_folder("static_mosaic") / "rover.obs"
    observations = read_observations(path)
    assert observations.complaints.notes == []
    assert len(observations.epochs) == 301
    oracle = RtklibNavigation(path)
    library, number = oracle.library, oracle.library.Arr1Dint(1)
    systems = {library.SYS_GPS: 0, library.SYS_GAL: 2, library.SYS_CMP: 3, library.SYS_QZS: 5, library.SYS_GLO: 6}
    theirs: dict[Any, tuple[float, float, float]] = {}
    data = oracle.observations.data
    for index in range(0, oracle.observations.n, 29):
        row = data[index]
        gnss = systems[library.satsys(row.sat, number)]
        sv_id = number[0] - (192 if gnss == Gnss.QZSS else 0)
        # Bands beyond the first are ordered by RTKLIB's own preference: L1 is enough to see columns and epochs agree.
        theirs[(*week_and_seconds(row.time), gnss, sv_id)] = (row.P[0], row.D[0], row.SNR[0])
    assert len(theirs) > 500
    ours = {}
    first = {0: "1C", 2: "1C", 3: "2I", 5: "1C", 6: "1C"}
    for index, epoch in enumerate(observations.epochs):
        for (gnss, sv_id, code), values in found(observations, index).items():
            if first[gnss] == code:
                ours[int(epoch["week"]), float(epoch["seconds"]), gnss, sv_id] = values
    for key, (pseudorange, doppler, cn0) in theirs.items():
        if pseudorange == 0.0:
            continue
        assert ours[key][:2] == (pseudorange, pytest.approx(doppler, abs=1e-3))
        assert ours[key][2] == pytest.approx(cn0, abs=1e-3)
