"""The store of ephemerides, and which one a measurement gets: order, issue, age, health, duplicates."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from eskf_ros.gnss import orbits, ranges
from eskf_ros.gnss.ephemeris import EPHEMERIS, NO_ISSUE, Ephemerides, Fault, Message, glonass_record, kepler_record
from eskf_ros.gnss.ranges import (
    ALREADY_TURNED,
    CLOCK_APPLIED,
    CODE_VALID,
    DOPPLER_VALID,
    SATELLITE_KNOWN,
    Status,
    allocate_ranges,
    choose,
    locate,
)
from eskf_ros.gnss.rinex_nav import read_navigation
from eskf_ros.gnss.signals import (
    SIGNAL_BY_CODE,
    SIGNAL_BY_UBLOX,
    SIGNALS,
    SPEED_OF_LIGHT,
    Gnss,
    carrier_hz,
    is_upper_band,
)
from support import gnss_texts as texts

WEEK, TOE = texts.WEEK, texts.TOE
CLOCK = {"af0": 1e-4, "af1": 0.0}
GLONASS_NAMES = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "af0", "af1")


def gps(sv_id: int = 5, toe: float = TOE, **fields: float) -> np.void:
    """A GPS ephemeris sent two hours before its reference time."""
    values = {**texts.MEO, **CLOCK, "toe": toe, "sent": toe - 7200.0, "issue": 45.0, "tgd": -1e-8}
    return kepler_record(Gnss.GPS, sv_id, Message.LNAV, (WEEK, toe), {**values, **fields})


def galileo(message: Message = Message.INAV, toe: float = TOE, **fields: float) -> np.void:
    values = {**texts.MEO, **CLOCK, "sqrt_a": 5440.6, "toe": toe, "sent": toe + 600.0}
    delays = {"bgd_e5a": 3e-9, "bgd_e5b": 4e-9}
    return kepler_record(Gnss.GALILEO, 11, message, (WEEK, toe), {**values, **delays, **fields})


def store(*records: np.void) -> Ephemerides:
    return Ephemerides(np.array(list(records), EPHEMERIS))


def chosen(
    ephemerides: Ephemerides, seconds: float, code: str = "1C", gnss: Gnss = Gnss.GPS, sv_id: int = 5, **how: Any
) -> Any:
    """The record chosen for a signal, or the `Status` that says why there is none."""
    slot = SIGNALS[SIGNAL_BY_CODE[gnss, code]].slot
    index, status = choose(
        ephemerides.records,
        ephemerides.first,
        int(gnss),
        sv_id,
        slot,
        how.get("week", WEEK),
        seconds,
        how.get("issue", NO_ISSUE),
    )
    return ephemerides.records[index] if index >= 0 else Status(status)


def test_the_closest_in_its_time_is_chosen() -> None:
    both = store(gps(toe=TOE, issue=1.0), gps(toe=TOE + 7200.0, issue=2.0))
    assert chosen(both, TOE + 3599.0)["issue"] == 1
    assert chosen(both, TOE + 3601.0)["issue"] == 2
    assert chosen(both, TOE - 7200.0)["issue"] == 1
    assert chosen(both, TOE - 7201.0) == Status.STALE
    assert chosen(both, TOE + 14401.0) == Status.STALE
    assert chosen(both, TOE, week=WEEK + 1) == Status.STALE
    assert chosen(both, TOE, week=WEEK - 1024) == Status.STALE
    assert chosen(both, TOE, sv_id=6) == Status.NO_EPHEMERIS
    assert chosen(both, math.nan) == Status.STALE


def test_a_week_ends() -> None:
    last = store(gps(toe=604784.0))
    assert chosen(last, 100.0, week=WEEK + 1)["toe"] == 604784.0
    index = choose(last.records, last.first, 0, 5, 0, WEEK + 1, 100.0, NO_ISSUE)[0]
    across = orbits.satellite_state(last.records[index], WEEK + 1, 100.0)
    np.testing.assert_allclose(across[0], orbits.satellite_state(last.records[index], WEEK, 604900.0)[0], atol=1e-6)


def test_galileo_looks_back_rather_than_ahead() -> None:
    """Its orbits are fitted to the hours after toe: 40 minutes later is better than 20 minutes too early."""
    both = store(galileo(toe=TOE, issue=1.0), galileo(toe=TOE + 3600.0, issue=2.0))
    assert chosen(both, TOE + 2400.0, gnss=Gnss.GALILEO, sv_id=11)["issue"] == 1
    assert chosen(both, TOE + 4200.0, gnss=Gnss.GALILEO, sv_id=11)["issue"] == 2


def test_an_issue_can_be_asked_for() -> None:
    both = store(gps(toe=TOE, issue=1.0), gps(toe=TOE + 16.0, issue=2.0))
    for issue in (1, 2):
        assert chosen(both, TOE, issue=issue)["issue"] == issue
    assert chosen(both, TOE, issue=3) == Status.NO_EPHEMERIS


def test_a_new_warning_is_not_evaded_with_an_old_ephemeris() -> None:
    warned = store(gps(toe=TOE, sent=TOE - 7200.0), gps(toe=TOE + 7200.0, sent=TOE, health=63.0, issue=46.0))
    # Closest to the old, healthy one; the warning was sent at TOE.
    assert chosen(warned, TOE - 60.0)["unhealthy"] == 0
    assert chosen(warned, TOE + 60.0) == Status.UNHEALTHY
    assert chosen(warned, TOE + 7200.0) == Status.UNHEALTHY


def test_an_ephemeris_serves_from_when_it_was_sent() -> None:
    """A navigation file knows the next issue before the satellite sends it; it does without where it must."""
    first = gps(toe=TOE, issue=1.0, sent=TOE - 7200.0)
    second = gps(toe=TOE + 7200.0, issue=2.0, sent=TOE + 3900.0)
    both = store(first, second)
    # The second is closer from TOE + 3600 on.
    assert chosen(both, TOE + 3899.0)["issue"] == 1
    assert chosen(both, TOE + 3901.0)["issue"] == 2
    # Files that begin late, and files that do not tell when.
    assert chosen(store(second), TOE + 3601.0)["issue"] == 2
    assert chosen(store(first, gps(toe=TOE + 7200.0, issue=2.0, sent=math.nan)), TOE + 3601.0)["issue"] == 2
    # Of two yet to come the closer one.
    third = gps(toe=TOE + 14400.0, issue=3.0, sent=TOE + 7200.0)
    assert chosen(store(second, third), TOE + 3700.0)["issue"] == 2
    assert chosen(store(second, third), TOE + 7300.0)["issue"] == 2


def test_a_warning_holds_from_when_it_was_sent() -> None:
    warning = gps(toe=TOE + 7200.0, issue=2.0, sent=TOE + 3900.0, health=63.0)
    both = store(gps(toe=TOE, issue=1.0, sent=TOE - 7200.0), warning)
    assert chosen(both, TOE + 3899.0)["issue"] == 1
    assert chosen(both, TOE + 3901.0) == Status.UNHEALTHY
    assert chosen(store(warning), TOE + 3601.0) == Status.UNHEALTHY


def test_a_message_that_has_been_sent_goes_before_a_better_one_to_come() -> None:
    fields = {**texts.MEO, **CLOCK, "tgd": -1e-8, "isc_l1ca": 0.0}
    modern = kepler_record(Gnss.GPS, 5, Message.CNAV, (WEEK, TOE), {**fields, "sent": TOE - 7200.0})
    both = store(gps(sent=TOE + 60.0), modern)
    assert chosen(both, TOE)["message"] == Message.CNAV
    assert chosen(both, TOE + 60.0)["message"] == Message.LNAV


def test_health_flags_that_were_not_broadcast_are_no_illness() -> None:
    fields = dict.fromkeys(GLONASS_NAMES, 1.0)
    for flags, ill in ((0.0, False), (4.0, True), (3.0, False), (999999999.0, False), (math.nan, False)):
        record = glonass_record(1, (WEEK, TOE), 18, {**fields, "flags": flags})
        assert bool(record["unhealthy"]) == ill


def test_health_of_one_signal_leaves_the_others() -> None:
    sick = store(galileo(health=0b000_010_000))
    assert chosen(sick, TOE, "5Q", Gnss.GALILEO, 11) == Status.UNHEALTHY
    assert chosen(sick, TOE, "1C", Gnss.GALILEO, 11)["sv_id"] == 11


def test_a_signal_gets_the_message_that_tells_its_delay() -> None:
    """I/NAV for all it serves, F/NAV only where there is no I/NAV; GPS L5 needs CNAV."""
    both = store(galileo(Message.FNAV), galileo(Message.INAV))
    for code in ("1C", "5Q", "7Q"):
        assert chosen(both, TOE, code, Gnss.GALILEO, 11)["message"] == Message.INAV
    alone = store(galileo(Message.FNAV))
    assert chosen(alone, TOE, "5Q", Gnss.GALILEO, 11)["message"] == Message.FNAV
    assert chosen(alone, TOE, "7Q", Gnss.GALILEO, 11) == Status.NO_GROUP_DELAY
    assert chosen(both, TOE, "6C", Gnss.GALILEO, 11) == Status.NO_GROUP_DELAY
    modern = gps(isc_l1ca=1e-10, isc_l2c=2e-10, isc_l5i=3e-10, isc_l5q=4e-10)
    cnav = kepler_record(
        Gnss.GPS,
        5,
        Message.CNAV,
        (WEEK, TOE),
        {**texts.MEO, **CLOCK, "tgd": -1e-8, "isc_l5q": 4e-10},
    )
    assert chosen(store(modern), TOE, "5Q") == Status.NO_GROUP_DELAY
    assert chosen(store(gps(), cnav), TOE, "5Q")["message"] == Message.CNAV
    assert chosen(store(gps(), cnav), TOE, "1C")["message"] == Message.LNAV


POOL = [
    *(gps(sv_id, TOE + 7200.0 * k, issue=float(k)) for sv_id in (1, 5, 32) for k in range(3)),
    *(gps(5, TOE, issue=0.0, sent=TOE - 7200.0 + 30.0 * k, af1=1e-12 * k) for k in range(3)),
    galileo(),
    galileo(Message.FNAV),
    gps(7, e=math.nan),
    gps(8, sqrt_a=100.0),
    gps(9, toe=1e7),
]


@given(st.permutations(range(len(POOL))), st.integers(0, len(POOL)))
def test_the_store_does_not_depend_on_the_order_of_arrival(order: list[int], cut: int) -> None:
    once = Ephemerides(np.array(POOL, EPHEMERIS))
    mixed = Ephemerides()
    for part in (order[:cut], order[cut:], order[:3]):
        mixed.add(np.array([POOL[index] for index in part], EPHEMERIS))
    assert mixed.records.tobytes() == once.records.tobytes()
    np.testing.assert_array_equal(mixed.first, once.first)


def test_what_is_known_already_changes_nothing() -> None:
    """A receiver repeats its ephemerides: they are counted, and nothing is sorted anew."""
    full = store(gps(issue=1.0), gps(toe=TOE + 7200.0, issue=2.0), galileo())
    before = full.records
    full.add(before[::2])
    assert full.records is before
    assert full.refused[Fault.DUPLICATE] == 2
    news = np.array([gps(issue=1.0), gps(toe=TOE + 14400.0, issue=3.0), gps(9, e=math.nan)], EPHEMERIS)
    assert full.unknown(news).tobytes() == news[1:2].tobytes()
    full.add(news)
    assert len(full) == 4
    assert len(full.unknown(news)) == 0


@given(st.integers(0, 40000), st.integers(0, 40000))
def test_what_has_ended_is_forgotten_unnoticed(late: int, later: int) -> None:
    """At that instant and from then on each signal gets what it got before, or the same reason why there is none."""
    pool = [gps(5, TOE + 3600.0 * k, issue=float(k)) for k in range(6)]
    pool += [gps(6, fit=6.0), gps(7, TOE + 50000.0), galileo()]
    pool += [galileo(Message.FNAV, TOE + 600.0 * k) for k in range(9)]
    full, pruned = store(*pool), store(*pool)
    pruned.drop_ended(WEEK, TOE + late)
    signals = [("1C", Gnss.GPS, 5), ("1C", Gnss.GPS, 6), ("1C", Gnss.GPS, 7), ("5Q", Gnss.GALILEO, 11)]
    for seconds in (TOE + late, TOE + late + later):
        for signal in signals:
            # As text, in which NaN equals NaN.
            assert str(chosen(pruned, seconds, *signal)) == str(chosen(full, seconds, *signal))
    assert chosen(pruned, TOE, sv_id=8) == Status.NO_EPHEMERIS
    # Of each message of a satellite one is left.
    pruned.drop_ended(WEEK + 1, TOE)
    assert len(pruned) == 5
    Ephemerides().drop_ended(WEEK, TOE)


def test_records_have_no_gaps() -> None:
    """Their bytes decide between two of one issue."""
    assert EPHEMERIS.itemsize == sum(dtype.itemsize for dtype, _ in EPHEMERIS.fields.values())  # type: ignore[union-attr]


def test_duplicates_faults_and_nothing_are_counted() -> None:
    full = Ephemerides(np.array(POOL, EPHEMERIS))
    assert full.refused == {Fault.NON_FINITE: 1, Fault.BAD_VALUE: 2, Fault.DUPLICATE: 3}
    assert len(full) == len(POOL) - 6
    # Of one issue the one sent last.
    assert [record["af1"] for record in full.of(Gnss.GPS, 5) if record["toe"] == TOE] == [2e-12]
    assert len(full.of(Gnss.GPS, 6)) == len(full.of(Gnss.BEIDOU, 5)) == 0
    assert len(Ephemerides()) == 0
    assert chosen(Ephemerides(), TOE) == Status.NO_EPHEMERIS


@pytest.mark.parametrize("name", ["e", "sqrt_a", "m0", "cis", "omega_dot", "af0", "af1", "toe"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_parameters_are_refused(name: str, value: float) -> None:
    assert store(gps(**{name: value})).refused[Fault.NON_FINITE] == 1


@pytest.mark.parametrize(
    "record",
    [
        gps(e=-0.1),
        gps(e=0.7),
        gps(sqrt_a=0.0),
        gps(sqrt_a=9000.0),
        gps(af0=1.0),
        gps(crs=1e9),
        gps(sv_id=0),
        gps(sv_id=999),
        # Clock and orbit of different days.
        kepler_record(Gnss.GPS, 5, Message.LNAV, (WEEK, TOE), {**texts.MEO, **CLOCK, "toe": TOE - 1.6e5}),
        glonass_record(1, (WEEK, TOE), 18, dict.fromkeys(GLONASS_NAMES, 0.0)),
    ],
)
def test_impossible_satellites_are_refused(record: np.void) -> None:
    assert store(record).refused[Fault.BAD_VALUE] == 1


def epoch(*signals: tuple[Gnss, int, str]) -> NDArray[np.void]:
    """Ranges of 22 000 km with Doppler."""
    observed = allocate_ranges(len(signals))
    for row, (gnss, sv_id, code) in zip(observed, signals):
        row["gnss_id"], row["sv_id"], row["signal"] = gnss, sv_id, SIGNAL_BY_CODE[gnss, code]
    observed["pseudorange"], observed["doppler"], observed["cn0"] = 2.2e7, -700.0, 45.0
    observed["flags"] = CODE_VALID | DOPPLER_VALID
    return observed


def everything(folder: Path) -> Ephemerides:
    path = folder / "made.nav"
    path.write_text(texts.EVERYTHING, encoding="ascii")
    return Ephemerides(read_navigation(path).ephemerides)


def test_ranges_get_satellite_clock_and_carrier(tmp_path: Path) -> None:
    ephemerides = everything(tmp_path)
    satellites = [(Gnss.GPS, 5, "1C"), (Gnss.GALILEO, 11, "7Q"), (Gnss.BEIDOU, 3, "2I"), (Gnss.GLONASS, 7, "1C")]
    observed = epoch(*satellites)
    locate(observed, WEEK, TOE, ephemerides)
    assert ranges.status_counts(observed) == {Status.USABLE: 4}
    for row, (gnss, sv_id, code) in zip(observed, satellites):
        signal = SIGNALS[SIGNAL_BY_CODE[gnss, code]]
        record = chosen(ephemerides, TOE, code, gnss, sv_id)
        sent = orbits.transmission(record, WEEK, TOE, 2.2e7)
        position, velocity, clock, drift = orbits.satellite_state(record, WEEK, sent)
        np.testing.assert_array_equal(row["satellite"], position)
        np.testing.assert_array_equal(row["satellite_velocity"], velocity)
        assert row["satellite_clock"] == clock - record["group_delay"][signal.slot]
        assert (row["satellite_clock_drift"], row["issue"]) == (drift, record["issue"])
        expected = 1602e6 + 5 * 0.5625e6 if gnss == Gnss.GLONASS else signal.carrier_hz
        assert row["carrier_hz"] == expected
        assert row["flags"] & SATELLITE_KNOWN


def test_every_reason_not_to_use_a_range_is_named(tmp_path: Path) -> None:
    ephemerides = everything(tmp_path)
    observed = epoch(*[(Gnss.GPS, 5, "1C")] * 7, (Gnss.GPS, 6, "1C"), (Gnss.GPS, 5, "5Q"))
    observed["pseudorange"][0] = math.nan
    observed["pseudorange"][1] = -2.2e7
    observed["pseudorange"][2] = math.inf
    observed["signal"][3] = ranges.UNKNOWN_SIGNAL
    observed["signal"][4] = SIGNAL_BY_CODE[Gnss.GALILEO, "1C"]
    observed["gnss_id"][5] = 77
    observed["doppler"][6] = math.nan
    locate(observed, WEEK, TOE, ephemerides)
    assert [Status(status).name for status in observed["status"]] == (
        ["BAD_VALUE"] * 3 + ["UNKNOWN_SIGNAL"] * 3 + ["USABLE", "NO_EPHEMERIS", "NO_GROUP_DELAY"]
    )
    assert observed["flags"][6] & DOPPLER_VALID == 0
    late = epoch((Gnss.GPS, 5, "1C"))
    for week, seconds, status in (
        (WEEK, TOE + 43200.0, Status.STALE),
        (WEEK + 1, TOE, Status.WRONG_WEEK),
        (WEEK - 1024, TOE, Status.WRONG_WEEK),
        (WEEK, math.nan, Status.BAD_VALUE),
        (WEEK, 604800.0, Status.BAD_VALUE),
    ):
        locate(late, week, seconds, ephemerides)
        assert late["status"][0] == status


def test_satellites_that_come_with_the_range_are_kept() -> None:
    observed = epoch((Gnss.GPS, 5, "1C"), (Gnss.GPS, 6, "1C"))
    observed["flags"] |= SATELLITE_KNOWN
    observed["satellite"], observed["satellite_velocity"] = [2e7, 1e7, 5e6], [1.0, 2.0, 3.0]
    observed["satellite_clock"], observed["satellite_clock_drift"] = 1e-4, 0.0
    observed["satellite"][1, 2] = math.nan
    before = observed["satellite"].copy()
    locate(observed, WEEK, TOE, Ephemerides())
    assert list(observed["status"]) == [Status.USABLE, Status.BAD_VALUE]
    np.testing.assert_array_equal(observed["satellite"], before)
    assert observed["carrier_hz"][0] == 1575.42e6


@pytest.mark.parametrize("gnss_id", [-1, 4, 7, 8, 250])
def test_a_constellation_that_is_not_known_is_not_taken_for_another(gnss_id: int) -> None:
    """NavIC (7) has its own time and L5; its satellites may come with their states all the same."""
    observed = epoch((Gnss.GPS, 5, "1C"), (Gnss.GPS, 6, "1C"), (Gnss.GPS, 7, "1C"))
    observed["flags"] |= SATELLITE_KNOWN
    observed["satellite"], observed["satellite_velocity"] = [2e7, 1e7, 5e6], [1.0, 2.0, 3.0]
    observed["satellite_clock"], observed["satellite_clock_drift"] = 1e-4, 0.0
    observed["gnss_id"][:2] = gnss_id, Gnss.SBAS
    locate(observed, WEEK, TOE, Ephemerides())
    assert list(observed["status"]) == [Status.UNKNOWN_SIGNAL, Status.USABLE, Status.USABLE]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("satellite", [1e9, 0.0, 0.0]),
        ("satellite", [1e5, 0.0, 0.0]),
        ("satellite_velocity", [2e4, 0.0, 0.0]),
        ("satellite_clock", 0.2),
        ("satellite_clock", math.inf),
        ("satellite_clock_drift", 1e-3),
    ],
)
def test_impossible_satellites_do_not_pass_the_door(name: str, value: Any) -> None:
    observed = epoch((Gnss.GPS, 5, "1C"), (Gnss.GPS, 6, "1C"))
    observed["flags"] |= SATELLITE_KNOWN
    observed["satellite"], observed["satellite_velocity"] = [2e7, 1e7, 5e6], [1.0, 2.0, 3.0]
    observed["satellite_clock"], observed["satellite_clock_drift"] = 1e-4, 0.0
    observed[name][1] = value
    locate(observed, WEEK, TOE, Ephemerides())
    assert list(observed["status"]) == [Status.USABLE, Status.BAD_VALUE]


def test_a_satellite_without_its_clock_is_taken_from_the_ephemerides(tmp_path: Path) -> None:
    """NaN is what a missing field is: no drift, and no satellite state; unless the clock is taken out already."""
    ephemerides = everything(tmp_path)
    plain = epoch((Gnss.GPS, 5, "1C"))
    locate(plain, WEEK, TOE, ephemerides)
    given_state = epoch(*[(Gnss.GPS, 5, "1C")] * 3)
    given_state["flags"] |= SATELLITE_KNOWN | ALREADY_TURNED
    given_state["flags"][2] |= CLOCK_APPLIED
    given_state["satellite"], given_state["satellite_velocity"] = [2e7, 1e7, 5e6], [1.0, 2.0, 3.0]
    given_state["satellite_clock"] = [math.nan, 1e-4, math.nan]
    located = given_state.copy()
    locate(located, WEEK, TOE, ephemerides)
    assert (located["status"] == Status.USABLE).all()
    assert located[0].tobytes() == plain[0].tobytes()
    np.testing.assert_array_equal(located["satellite"][1:], given_state["satellite"][1:])
    assert located["satellite_clock"][1:].tolist() == [1e-4, 0.0]
    assert located["satellite_clock_drift"][1:].tolist() == [0.0, 0.0]
    locate(given_state, WEEK, TOE, Ephemerides())
    assert list(given_state["status"]) == [Status.NO_EPHEMERIS, Status.USABLE, Status.USABLE]


def test_impossible_numbers_become_unknown(tmp_path: Path) -> None:
    observed = epoch(*[(Gnss.GPS, 5, "1C")] * 4)
    observed["cn0"] = [45.0, -3.0, 1e9, math.inf]
    observed["pseudorange_std"] = [2.0, 0.0, -1.0, math.inf]
    observed["doppler_std"] = [0.5, 0.0, -1.0, math.nan]
    observed["carrier_hz"] = [1575.42e6, 0.0, -1.0, math.inf]
    locate(observed, WEEK, TOE, everything(tmp_path))
    for name, first in (("cn0", 45.0), ("pseudorange_std", 2.0), ("doppler_std", 0.5)):
        np.testing.assert_array_equal(observed[name], [first, math.nan, math.nan, math.nan])
    assert (observed["carrier_hz"] == 1575.42e6).all()
    assert (observed["status"] == Status.USABLE).all()


@given(
    st.lists(
        st.tuples(
            st.integers(-3, 300),
            st.integers(-3, 300),
            st.integers(-3, 300),
            st.floats(allow_nan=True),
            st.floats(allow_nan=True),
        ),
        max_size=12,
    ),
    st.integers(-10, 5000),
    st.floats(allow_nan=True),
)
def test_no_measurement_is_fatal(rows: list[tuple[int, int, int, float, float]], week: int, seconds: float) -> None:
    ephemerides = Ephemerides(np.array(POOL, EPHEMERIS))
    observed = allocate_ranges(len(rows))
    for name, values in zip(("gnss_id", "sv_id", "signal", "pseudorange", "doppler"), zip(*rows)):
        observed[name] = values
    observed["flags"] = CODE_VALID | DOPPLER_VALID
    locate(observed, week, seconds, ephemerides)
    usable = observed[observed["status"] == Status.USABLE]
    assert np.isfinite(usable["satellite"]).all()
    assert np.isfinite(usable["satellite_clock"]).all()
    assert sum(ranges.status_counts(observed).values()) == len(rows)


def given(observed: NDArray[np.void]) -> list[tuple[int, int, str, int]]:
    """Constellation, satellite, signal and what it gives, of one code and one Doppler per satellite."""
    picked = ranges.one_per_satellite(observed)
    return [(row["gnss_id"], row["sv_id"], SIGNALS[row["signal"]].code, row["flags"]) for row in picked]


def test_one_per_satellite_takes_code_of_the_upper_band_only() -> None:
    """What another band has is its Doppler, where the upper band has none."""
    observed = epoch((Gnss.GPS, 5, "5Q"), (Gnss.GPS, 5, "1C"), (Gnss.GALILEO, 5, "7Q"), (Gnss.GPS, 6, "2L"))
    observed["status"] = Status.USABLE
    observed["carrier_hz"] = [SIGNALS[row["signal"]].carrier_hz for row in observed]
    both = CODE_VALID | DOPPLER_VALID
    others = [(0, 6, "2L", DOPPLER_VALID), (2, 5, "7Q", DOPPLER_VALID)]
    assert given(observed) == [(0, 5, "1C", both), *others]
    observed["flags"][1] = CODE_VALID
    assert given(observed) == [(0, 5, "1C", CODE_VALID), (0, 5, "5Q", DOPPLER_VALID), *others]
    observed["cn0"][1] = 20.0
    assert given(observed) == [(0, 5, "5Q", DOPPLER_VALID), *others]
    observed["cn0"][1], observed["status"][1] = 45.0, Status.UNHEALTHY
    assert given(observed) == [(0, 5, "5Q", DOPPLER_VALID), *others]
    assert given(observed[:0]) == []


def test_the_ionosphere_free_combination_is_free_of_it() -> None:
    """Delays of 8 m at L1 that go with 1 / f^2 cancel; a common delay stays; clocks combine as the ranges do."""
    observed = epoch((Gnss.GPS, 5, "1C"), (Gnss.GPS, 5, "2W"), (Gnss.GPS, 6, "1C"), (Gnss.GPS, 5, "1W"))
    observed["status"] = Status.USABLE
    observed["carrier_hz"] = [1575.42e6, 1227.6e6, 1575.42e6, 1575.42e6]
    ionosphere = 8.0 * (1575.42e6 / observed["carrier_hz"]) ** 2
    delays = np.array([-1.1e-8, -1.1e-8 * (77 / 60) ** 2, 0.0, 0.0])
    observed["satellite_clock"] = 1e-4 - delays
    observed["pseudorange"] = 2.2e7 + ionosphere + SPEED_OF_LIGHT * delays
    (combined,) = ranges.ionosphere_free(observed)
    assert combined["sv_id"] == 5
    assert combined["pseudorange"] == pytest.approx(2.2e7, abs=1e-6)
    assert combined["satellite_clock"] == pytest.approx(1e-4, abs=1e-18)
    assert combined["noise_factor"] == pytest.approx(2.978, abs=1e-3)
    assert combined["flags"] & ranges.IONOSPHERE_APPLIED


def test_signals() -> None:
    upper = {signal.code[0] for k, signal in enumerate(SIGNALS) if is_upper_band(k, math.nan)}
    lower = {signal.code[0] for k, signal in enumerate(SIGNALS) if not is_upper_band(k, signal.carrier_hz)}
    # BeiDou's B1I is band 2 of RINEX.
    assert upper == {"1", "2"}
    assert lower == {"2", "3", "5", "6", "7", "8"}
    assert is_upper_band(SIGNAL_BY_CODE[Gnss.BEIDOU, "2I"], math.nan)
    assert not is_upper_band(SIGNAL_BY_CODE[Gnss.GPS, "2W"], math.nan)
    # Of a signal without a name the carrier decides.
    assert [is_upper_band(ranges.UNKNOWN_SIGNAL, hz) for hz in (1598e6, 1278.75e6, math.nan)] == [True, False, True]
    assert len({(signal.gnss, signal.code) for signal in SIGNALS}) == len(SIGNALS) < ranges.UNKNOWN_SIGNAL
    named = {(Gnss.GPS, 0): "1C", (Gnss.GPS, 3): "2L", (Gnss.GALILEO, 0): "1C", (Gnss.BEIDOU, 1): "2I"}
    named |= {(Gnss.BEIDOU, 5): "1P", (Gnss.BEIDOU, 7): "5P", (Gnss.QZSS, 5): "2L", (Gnss.GLONASS, 2): "2C"}
    for key, code in named.items():
        assert SIGNALS[SIGNAL_BY_UBLOX[key]].code == code
    assert carrier_hz(SIGNAL_BY_CODE[Gnss.GLONASS, "2C"], -7) == pytest.approx(1246e6 - 7 * 0.4375e6)
    assert carrier_hz(SIGNAL_BY_CODE[Gnss.GPS, "1C"], 3) == 1575.42e6
