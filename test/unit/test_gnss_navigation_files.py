"""Navigation files: every version, every trap of time, week, health and message, and what is damaged."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from eskf_ros.gnss.ephemeris import Ephemerides, Fault, Message
from eskf_ros.gnss.rinex import RinexError
from eskf_ros.gnss.rinex_nav import UNREADABLE, WRONG_WEEK, Navigation, read_navigation
from eskf_ros.gnss.signals import L1, L2, L5, SIGNAL_BY_CODE, SIGNALS, Gnss
from eskf_ros.gnss.time import from_calendar, leap_seconds, normalized, week_near
from support import gnss_texts as texts
from support.gnss_oracle import RtklibNavigation

LEAP = 18.0


def read(folder: Path, text: str) -> Navigation:
    path = folder / "made.nav"
    path.write_text(text, encoding="ascii")
    return read_navigation(path)


def only(folder: Path, *records: str, version: str = "3.04") -> Any:
    """The one ephemeris of a file with these records, and nothing to complain about."""
    navigation = read(folder, texts.header(version) + "".join(records))
    assert navigation.complaints.notes == []
    (record,) = navigation.ephemerides
    return record


def slot(gnss: Gnss, code: str) -> int:
    return SIGNALS[SIGNAL_BY_CODE[gnss, code]].slot


def test_numbers_land_where_they_belong(tmp_path: Path) -> None:
    record = only(tmp_path, texts.lnav("G05", sent=texts.TOE - 6000.0))
    for name, value in texts.MEO.items():
        assert record[name] == pytest.approx(value, rel=1e-12)
    assert (record["af0"], record["af1"], record["af2"]) == pytest.approx(texts.CLOCK, rel=1e-12)
    assert (record["gnss_id"], record["sv_id"], record["message"]) == (Gnss.GPS, 5, Message.LNAV)
    assert (record["issue"], record["accuracy"], record["unhealthy"]) == (45, 2.0, 0)
    assert (record["toe_week"], record["toe"]) == (texts.WEEK, texts.TOE)
    assert (record["toc_week"], record["toc"]) == (texts.WEEK, texts.TOE)
    assert (record["sent_week"], record["sent"]) == (texts.WEEK, texts.TOE - 6000.0)


def test_beidou_time_is_fourteen_seconds_behind(tmp_path: Path) -> None:
    """And the longitude of the node still wants seconds of the BeiDou week."""
    record = only(tmp_path, texts.beidou("C21"))
    assert (record["toe_week"], record["toe"], record["toe_own"]) == (texts.WEEK, texts.TOE + 14.0, texts.TOE)
    assert (record["toc_week"], record["toc"]) == (texts.WEEK, texts.TOE + 14.0)


def test_beidou_ephemeris_of_the_last_seconds_of_a_week(tmp_path: Path) -> None:
    """Sunday 0:00:00 of GPS time is Saturday 23:59:46 of BeiDou time: week, toe and node belong to different weeks."""
    record = only(tmp_path, texts.beidou("C21", date="2024 07 21 00 00 00", toe=0.0, week=texts.BEIDOU_WEEK + 1))
    assert (record["toe_week"], record["toe"], record["toe_own"]) == (texts.WEEK + 1, 14.0, 0.0)
    before = only(tmp_path, texts.beidou("C21", date="2024 07 20 23 59 50", toe=604790.0))
    assert (before["toe_week"], before["toe"], before["toe_own"]) == (texts.WEEK + 1, 4.0, 604790.0)


def test_galileo_time_is_gps_time(tmp_path: Path) -> None:
    record = only(tmp_path, texts.galileo("E11"))
    assert (record["toe_week"], record["toe"], record["toe_own"]) == (texts.WEEK, texts.TOE, texts.TOE)


@pytest.mark.parametrize(
    ("date", "leap"),
    [("2024 07 20 01 45 00", 18), ("2016 12 31 23 45 00", 17), ("2017 01 01 00 15 00", 18)],
)
def test_glonass_epochs_are_utc(tmp_path: Path, date: str, leap: int) -> None:
    """The header's leap seconds need not be there, and are those of the day the file was made."""
    year, month, day, hour, minute, second = (int(part) for part in date.split())
    week, seconds = from_calendar(year, month, day, hour, minute, second)
    record = only(tmp_path, texts.glonass("R07", date=date, sent=seconds - 300.0))
    assert (record["toe_week"], record["toe"]) == normalized(week, seconds + leap)
    assert (record["sent_week"], record["sent"]) == normalized(week, seconds - 300.0 + leap)
    # Number of the quarter of an hour of the Moscow day, which began three hours before.
    assert record["issue"] == ((hour + 3) % 24) * 4 + minute // 15


def test_a_leap_second_newer_than_the_table_is_taken_from_the_header(tmp_path: Path) -> None:
    header = texts.header("3.04", "N: GNSS NAV DATA", texts.labelled("    19", "LEAP SECONDS"))
    (record,) = read(tmp_path, header + texts.glonass()).ephemerides
    assert record["toe"] == 6 * 86400.0 + 6300.0 + 19.0
    # The count of the BeiDou epoch is another number, and an old header knows less than the table.
    for line in ("     4                  BDS", "    13"):
        header = texts.header("3.04", "N: GNSS NAV DATA", texts.labelled(line, "LEAP SECONDS"))
        (record,) = read(tmp_path, header + texts.glonass()).ephemerides
        assert record["toe"] == 6 * 86400.0 + 6300.0 + LEAP


def test_leap_seconds_table() -> None:
    assert [leap_seconds(*day) for day in ((1980, 1, 6), (1981, 6, 30), (1981, 7, 1), (2005, 12, 31))] == [0, 0, 1, 13]
    assert [leap_seconds(*day) for day in ((2006, 1, 1), (2016, 12, 31), (2017, 1, 1))] == [14, 17, 18]


def test_glonass_units_and_channel(tmp_path: Path) -> None:
    record = only(tmp_path, texts.glonass("R07", channel=-7.0))
    x, y, z = texts.GLONASS_STATE
    np.testing.assert_allclose(record["position"], [1e3 * axis[0] for axis in (x, y, z)], rtol=1e-12)
    np.testing.assert_allclose(record["velocity"], [1e3 * axis[1] for axis in (x, y, z)], rtol=1e-12)
    np.testing.assert_allclose(record["acceleration"], [1e3 * axis[2] for axis in (x, y, z)], rtol=1e-12)
    assert (record["af0"], record["af1"], record["channel"]) == pytest.approx((8.7e-5, 9.1e-13, -7))


def test_toe_around_the_turn_of_the_week(tmp_path: Path) -> None:
    """The clock's date is Saturday 23:59:44, the orbit's time Sunday 0:00: next week, whatever the field says."""
    for week in (texts.WEEK, texts.WEEK + 1):
        navigation = read(
            tmp_path, texts.header() + texts.lnav(date="2024 07 20 23 59 44", toe=0.0, week=week, sent=604740.0)
        )
        (record,) = navigation.ephemerides
        assert (record["toe_week"], record["toe"]) == (texts.WEEK + 1, 0.0)
        assert (record["toc_week"], record["toc"]) == (texts.WEEK, 604784.0)
        assert (record["sent_week"], record["sent"]) == (texts.WEEK, 604740.0)
        assert navigation.complaints.counts[WRONG_WEEK] == (week == texts.WEEK)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (texts.lnav(week=texts.WEEK - 1024), False),
        (texts.lnav(week=texts.WEEK % 1024), False),
        (texts.lnav(week=texts.WEEK + 1), True),
        (texts.lnav(week=0.0), True),
        (texts.lnav(week=None), False),
        (texts.beidou(week=texts.BEIDOU_WEEK), False),
        (texts.beidou(week=texts.WEEK), False),
        (texts.beidou(week=texts.BEIDOU_WEEK - 1), True),
    ],
)
def test_weeks_that_rolled_over_or_are_wrong(tmp_path: Path, text: str, wrong: bool) -> None:
    """The date decides; a week that contradicts it is named."""
    navigation = read(tmp_path, texts.header() + text)
    (record,) = navigation.ephemerides
    assert record["toe_week"] == texts.WEEK
    assert navigation.complaints.counts[WRONG_WEEK] == wrong
    if wrong:
        assert f"{tmp_path / 'made.nav'}:3: " in navigation.complaints.notes[0]


@given(st.integers(0, 4000), st.floats(0.0, 604799.0), st.floats(-302000.0, 302000.0))
def test_week_near(week: int, seconds: float, apart: float) -> None:
    expected, of_week = normalized(week, seconds + apart)
    assert week_near(of_week, (week, seconds)) == expected


GAMMA_L2 = (L1 / L2) ** 2
GAMMA_E5A = (L1 / L5) ** 2
GAMMA_E5B = (1575.42 / 1207.14) ** 2


def test_group_delays_of_each_message(tmp_path: Path) -> None:
    """What one signal's user subtracts from the clock; the ionosphere-free pair the clock refers to needs nothing."""
    gps = only(tmp_path, texts.lnav())["group_delay"]
    assert gps[slot(Gnss.GPS, "1C")] == pytest.approx(-1.1e-8)
    assert gps[slot(Gnss.GPS, "2W")] == pytest.approx(GAMMA_L2 * -1.1e-8)
    assert np.isnan(gps[slot(Gnss.GPS, "5Q")])
    inav = only(tmp_path, texts.galileo())["group_delay"]
    assert inav[slot(Gnss.GALILEO, "1C")] == pytest.approx(4.1e-9)
    assert inav[slot(Gnss.GALILEO, "7Q")] == pytest.approx(GAMMA_E5B * 4.1e-9)
    fnav = only(tmp_path, texts.galileo(source=0b01_0000_0010, bgd_e5b=0.0))["group_delay"]
    assert fnav[slot(Gnss.GALILEO, "1C")] == pytest.approx(3.5e-9)
    assert fnav[slot(Gnss.GALILEO, "5Q")] == pytest.approx(GAMMA_E5A * 3.5e-9)
    assert np.isnan(fnav[slot(Gnss.GALILEO, "7Q")])
    d1 = only(tmp_path, texts.beidou())["group_delay"]
    assert d1[slot(Gnss.BEIDOU, "2I")] == pytest.approx(8.6e-9)
    assert d1[slot(Gnss.BEIDOU, "7I")] == pytest.approx(-1.8e-9)
    assert d1[slot(Gnss.BEIDOU, "6I")] == 0.0
    assert np.isnan(d1[slot(Gnss.BEIDOU, "1P")])
    glonass = only(tmp_path, texts.glonass())["group_delay"]
    assert glonass[slot(Gnss.GLONASS, "1C")] == 0.0
    assert np.isnan(glonass[slot(Gnss.GLONASS, "2C")])
    with_delay = only(tmp_path, texts.glonass(extra=[179.0, 8.4e-9, 2.0, 3.0]), version="3.05")["group_delay"]
    assert with_delay[slot(Gnss.GLONASS, "2C")] == pytest.approx(8.4e-9)
    unknown = only(tmp_path, texts.glonass(extra=[None, 0.999999999999e9, 15.0, None]), version="3.05")["group_delay"]
    assert np.isnan(unknown[slot(Gnss.GLONASS, "2C")])


def test_e5a_with_the_clock_of_inav_and_of_fnav_is_one_signal(tmp_path: Path) -> None:
    """E1 leaves the satellite once: its clock by I/NAV and by F/NAV must be the same, and so E5a's."""
    e5a, e5b = 3.5e-9, 4.1e-9
    apart = e5a - e5b
    inav = only(tmp_path, texts.galileo(bgd_e5a=e5a, bgd_e5b=e5b, clock=(1e-4, 0.0, 0.0)))
    fnav = only(tmp_path, texts.galileo(source=258.0, bgd_e5a=e5a, bgd_e5b=0.0, clock=(1e-4 + apart, 0.0, 0.0)))
    for code in ("1C", "5Q"):
        clocks = [record["af0"] - record["group_delay"][slot(Gnss.GALILEO, code)] for record in (inav, fnav)]
        assert clocks[0] == pytest.approx(clocks[1], abs=1e-15)


@pytest.mark.parametrize(
    ("source", "message"),
    [(513.0, Message.INAV), (516.0, Message.INAV), (517.0, Message.INAV), (258.0, Message.FNAV)]
    + [(1.0, Message.INAV), (2.0, Message.FNAV), (0.0, Message.INAV), (None, Message.INAV)],
)
def test_galileo_messages_are_told_apart_by_their_source(tmp_path: Path, source: Any, message: Message) -> None:
    assert only(tmp_path, texts.galileo(source=source))["message"] == message


@pytest.mark.parametrize(
    ("text", "codes"),
    [
        (texts.lnav(health=0.0), ""),
        (texts.lnav(health=63.0), "all"),
        (texts.lnav(health=1.0), "all"),
        (texts.galileo(health=0.0), ""),
        (texts.galileo(health=1.0), "1C"),
        (texts.galileo(health=0b000_010_000), "5Q"),
        (texts.galileo(health=0b010_000_010), "1C 7Q"),
        (texts.beidou(health=1.0), "all"),
        (texts.glonass(health=1.0), "all"),
        (texts.glonass(health=0.0, extra=[179.0, 0.0, 2.0, 3.0]), ""),
        (texts.glonass(health=0.0, extra=[179.0, 0.0, 2.0, 4.0]), "all"),
        # L1 C/B is off where L1 C/A is on: so all healthy satellites of QZSS say today.
        (texts.lnav("J02", health=1.0), "1E"),
        (texts.lnav("J02", health=16.0), "1C"),
        (texts.lnav("J02", health=32.0), "1C 1E"),
        (texts.lnav("J02", health=8.0), "2L"),
        (texts.lnav("J02", health=4.0), "5I 5Q"),
        (texts.lnav("J02", health=2.0), "1S 1X"),
    ],
)
def test_health_is_that_of_the_signal(tmp_path: Path, text: str, codes: str) -> None:
    record = only(tmp_path, text, version="3.05")
    gnss = Gnss(record["gnss_id"])
    slots = {signal.slot for signal in SIGNALS if signal.gnss == gnss and signal.slot >= 0}
    expected = slots if codes == "all" else {slot(gnss, code) for code in codes.split()}
    assert {number for number in slots if record["unhealthy"] >> number & 1} == expected


def test_satellites_without_l5_are_healthy_on_l2c(tmp_path: Path) -> None:
    record = only(tmp_path, texts.cnav(health=1.0), version="4.00")
    assert record["unhealthy"] >> slot(Gnss.GPS, "5Q") & 1
    assert not record["unhealthy"] >> slot(Gnss.GPS, "2L") & 1


def test_fit_interval(tmp_path: Path) -> None:
    """Four hours unless it is longer; converters write 0, 1 or nothing for the flag."""
    for fit, seconds in ((4.0, 7200.0), (0.0, 7200.0), (1.0, 7200.0), (None, 7200.0), (6.0, 10800.0), (8.0, 14400.0)):
        record = only(tmp_path, texts.lnav(fit=fit))
        assert (record["max_lead"], record["max_age"]) == (seconds, seconds)


VERSION_4 = "".join(
    [
        texts.header("4.00"),
        "> STO G05 LNAV\n    2024 07 20 02 00 00 GPUT\n" + " " * 4 + texts.number(1.0) * 4 + "\n",
        texts.announced(texts.lnav("G05"), "LNAV"),
        texts.cnav("G05"),
        texts.announced(texts.galileo("E11"), "INAV"),
        texts.announced(texts.galileo("E11", source=258.0), "FNAV"),
        texts.announced(texts.beidou("C21"), "D1"),
        texts.announced(texts.beidou("C03"), "D2"),
        *(texts.beidou_cnav(message) for message in ("CNV1", "CNV2", "CNV3")),
        texts.announced(texts.glonass("R07", extra=[179.0, 8.4e-9, 2.0, 3.0]), "FDMA"),
        texts.announced(texts.lnav("I03"), "LNAV"),
        "> EOP J02 CNVX\n    2024 07 20 02 00 00" + texts.number(1.0) * 3 + "\n",
        "> ION G05 LNAV\n    2024 07 20 02 00 00"
        + "".join(texts.number(value) for value in (1e-8, 2e-8, 3e-8))
        + "\n    "
        + "".join(texts.number(value) for value in (4e-8, 5e4, 6e4, 7e4))
        + "\n    "
        + "".join(texts.number(value) for value in (8e4, 0.0))
        + "\n",
        "> EPH G05 CNV9\n" + texts.cnav().split("\n", 1)[1],
    ]
)


def test_version_4(tmp_path: Path) -> None:
    navigation = read(tmp_path, VERSION_4)
    messages = [Message(record["message"]).name for record in navigation.ephemerides]
    assert messages == ["LNAV", "CNAV", "INAV", "FNAV", "D1", "D2", "CNV1", "CNV2", "CNV3", "FDMA"]
    assert navigation.complaints.counts == {
        "STO record not used": 1,
        "EOP record not used": 1,
        "NavIC ephemeris not used": 1,
        "G message CNV9 not used": 1,
    }
    np.testing.assert_array_equal(navigation.klobuchar[Gnss.GPS], [1e-8, 2e-8, 3e-8, 4e-8, 5e4, 6e4, 7e4, 8e4])
    records = dict(zip(messages, navigation.ephemerides))
    assert (records["CNAV"]["a_rate"], records["CNAV"]["delta_n_rate"]) == (6.1e-3, -6.1e-14)
    assert records["CNAV"]["toe"] == records["CNAV"]["toc"] == texts.TOE
    assert records["CNV3"]["toe"] == texts.TOE + 14.0
    assert records["CNV1"]["issue"] == 16
    b1c, b2a = slot(Gnss.BEIDOU, "1P"), slot(Gnss.BEIDOU, "5P")
    assert records["CNV1"]["group_delay"][[b1c, b2a]] == pytest.approx([9.5e-9, -5.8e-9])
    assert records["CNV1"]["group_delay"][slot(Gnss.BEIDOU, "1D")] == pytest.approx(9.5e-9 - 8.7e-10)
    assert records["CNV2"]["group_delay"][slot(Gnss.BEIDOU, "5D")] == pytest.approx(-5.8e-9 - 2.7e-9)
    assert records["CNV3"]["group_delay"][slot(Gnss.BEIDOU, "7D")] == pytest.approx(-5.1e-9)
    # The modern messages without their rates are the old one.
    assert {name: records["CNAV"][name] for name in texts.MEO} == {name: records["LNAV"][name] for name in texts.MEO}


def version_2(kind: str, records: str) -> str:
    return texts.header("2.11", kind) + records


def as_version_2(text: str, satellite: str) -> str:
    """A record of version 3 in the columns of version 2: number and short date, three blanks of margin."""
    lines = text.splitlines()
    return "\n".join([f"{satellite} 24  7 20  2  0  0.0" + lines[0][23:], *(line[1:] for line in lines[1:])]) + "\n"


def test_version_2(tmp_path: Path) -> None:
    """The same satellites, and the numbers of GLONASS count seconds of the day."""
    three = only(tmp_path, texts.lnav("G05"))
    gps = as_version_2(texts.lnav("G05"), " 5").replace("E", "D")
    navigation = read(tmp_path, version_2("N: GPS NAV DATA", gps))
    assert navigation.ephemerides[0].tobytes() == three.tobytes()
    three = only(tmp_path, texts.glonass("R07", date=texts.DATE, sent=6 * 86400.0 + 6900.0))
    navigation = read(
        tmp_path, version_2("GLONASS NAV DATA", as_version_2(texts.glonass("R07", date=texts.DATE, sent=6900.0), " 7"))
    )
    assert navigation.ephemerides[0].tobytes() == three.tobytes()


def test_klobuchar_in_the_headers(tmp_path: Path) -> None:
    two = texts.header(
        "2.11",
        "N: GPS NAV DATA",
        texts.labelled("    0.7451D-08 -0.1490D-07 -0.5960D-07  0.1192D-06", "ION ALPHA"),
        texts.labelled("    0.9011D+05 -0.6554D+05 -0.1311D+06  0.4588D+06", "ION BETA"),
    )
    three = texts.header(
        "3.04",
        "N: GNSS NAV DATA",
        texts.labelled("GPSA   0.7451D-08 -0.1490D-07 -0.5960D-07  0.1192D-06", "IONOSPHERIC CORR"),
        texts.labelled("GPSB   0.9011D+05 -0.6554D+05 -0.1311D+06  0.4588D+06", "IONOSPHERIC CORR"),
        texts.labelled("GAL    0.4100D+02  0.5469D-01  0.1325D-01", "IONOSPHERIC CORR"),
        texts.labelled("BDSA   0.1D-07     0.2D-07    -0.3D-07     0.4D-06", "IONOSPHERIC CORR"),
    )
    expected = [0.7451e-8, -0.1490e-7, -0.5960e-7, 0.1192e-6, 0.9011e5, -0.6554e5, -0.1311e6, 0.4588e6]
    for text in (two, three):
        np.testing.assert_array_equal(read(tmp_path, text).klobuchar[Gnss.GPS], expected)
    # Half of the parameters is no model.
    assert np.isnan(read(tmp_path, three).klobuchar[Gnss.BEIDOU][4:]).all()
    assert read(tmp_path, texts.header()).klobuchar == {}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "1: not a RINEX file"),
        ("hello\n", "1: not a RINEX file"),
        (texts.header("3.04", "OBSERVATION DATA"), "1: RINEX type 'O' is not navigation data"),
        (texts.header("2.11", "H: GEO NAV DATA"), "1: RINEX 2 type 'H'"),
        (texts.header("5.00"), "1: RINEX version 5.00"),
        (texts.header().replace("END OF HEADER", "COMMENT"), "2: the header has no END OF HEADER"),
    ],
)
def test_what_is_no_navigation_file_is_said_in_one_line(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(RinexError, match=complaint.replace("(", r"\(")) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "made.nav") + ":")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RinexError, match=r"nothing.nav: No such file"):
        read_navigation(tmp_path / "nothing.nav")


def damaged() -> list[tuple[str, str]]:
    good = texts.lnav("G05")
    return [
        (good.replace("G05", "X05", 1), "unknown constellation 'X'"),
        (good.replace("2024 07 20", "2024 13 20", 1), "month"),
        (good.replace("2024 07 20", "2024 ?? 20", 1), "invalid literal"),
        ("\n".join(good.splitlines()[:4]) + "\n", "cut off"),
        (good.replace("E-01", "E!01", 1), "could not convert"),
        # One changed byte can make an exponent of three digits.
        (good.replace("E-01", "E999", 1), "infinite"),
    ]


@pytest.mark.parametrize(("text", "why"), damaged())
def test_a_damaged_record_costs_that_record(tmp_path: Path, text: str, why: str) -> None:
    navigation = read(tmp_path, texts.header() + texts.lnav("G04") + text + texts.lnav("G06"))
    assert sorted(navigation.ephemerides["sv_id"]) == [4, 6]
    assert navigation.complaints.counts == {UNREADABLE: 1}
    (note,) = navigation.complaints.notes
    assert note.startswith(f"{tmp_path / 'made.nav'}:11: {UNREADABLE}: ")
    assert why in note


def test_missing_numbers_are_refused_at_the_store(tmp_path: Path) -> None:
    lines = texts.lnav("G05").splitlines()
    lines[2] = lines[2][:4] + " " * 19 + lines[2][23:]
    navigation = read(tmp_path, texts.header() + "\n".join(lines) + "\n" + texts.lnav("G06"))
    store = Ephemerides(navigation.ephemerides)
    assert store.refused[Fault.NON_FINITE] == 1
    assert list(store.records["sv_id"]) == [6]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(st.data())
def test_no_damage_is_fatal(tmp_path: Path, data: st.DataObject) -> None:
    """Lines lost, doubled, cut, bytes changed after the header: what can be read is read, and the store accepts it."""
    text = data.draw(st.sampled_from([texts.EVERYTHING, VERSION_4]))
    head, body = text[: text.index("END OF HEADER") + 14], text[text.index("END OF HEADER") + 14 :]
    lines = body.splitlines()
    for _ in range(data.draw(st.integers(1, 6))):
        index = data.draw(st.integers(0, len(lines) - 1))
        change = data.draw(st.sampled_from(["drop", "double", "cut", "byte", "nan", "huge"]))
        at = data.draw(st.integers(0, max(0, len(lines[index]) - 1)))
        if change == "drop":
            del lines[index]
        elif change == "double":
            lines.insert(index, lines[index])
        elif change == "cut":
            lines[index] = lines[index][:at]
        elif change == "byte":
            lines[index] = lines[index][:at] + chr(data.draw(st.integers(32, 126))) + lines[index][at + 1 :]
        else:
            lines[index] = lines[index][:4] + ("nan" if change == "nan" else "9.9E+99").rjust(19) + lines[index][23:]
        if not lines:
            return
    navigation = read(tmp_path, head + "\n".join(lines))
    store = Ephemerides(navigation.ephemerides)
    assert len(store) + sum(store.refused.values()) == len(navigation.ephemerides)
    assert len(navigation.ephemerides) <= 12 + 6


def test_real_files_are_read_as_rtklib_reads_them(data_folder: Callable[[str], Path]) -> None:
    """The same satellites and reference times; RTKLIB skips what it has twice."""
    for folder, name in (
        ("nagoya_20240720", "base.nav"),
        ("static_mosaic", "base.nav"),
        ("tsukishima_20201105", "base.nav"),
        ("orbit_truth_2021265", "SEPT2650.21P"),
    ):
        path = data_folder(folder) / name
        navigation = read_navigation(path)
        assert set(navigation.complaints.counts) <= {"SBAS ephemeris not used"}
        store = Ephemerides(navigation.ephemerides)
        assert store.refused[Fault.NON_FINITE] == store.refused[Fault.BAD_VALUE] == 0
        ours = keys(store.records)
        theirs = set()
        for gnss, sv_id, record in RtklibNavigation(path).ephemerides():
            theirs.add((int(gnss), sv_id, record.toe.time))
        assert theirs <= ours
        # It has no number for the newest satellites of BeiDou.
        assert all(gnss == Gnss.BEIDOU and sv_id > 46 for gnss, sv_id, _ in ours - theirs)


def keys(records: NDArray[np.void]) -> set[tuple[int, int, int]]:
    """Satellite and reference time (s since 1970)."""
    return {
        (int(gnss), int(sv_id), 315964800 + 604800 * int(week) + math.floor(toe))
        for gnss, sv_id, week, toe in records[["gnss_id", "sv_id", "toe_week", "toe"]].tolist()
    }
