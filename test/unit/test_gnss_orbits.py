"""Satellite positions, velocities and clocks: against two libraries, numerical derivatives, precise orbits."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from eskf_ros.geodesy.earth import EARTH_RATE, east_north_up_to_ecef
from eskf_ros.gnss import geometry, orbits
from eskf_ros.gnss.ephemeris import NO_ISSUE, Ephemerides, Message, glonass_record, kepler_record
from eskf_ros.gnss.ranges import choose
from eskf_ros.gnss.rinex_nav import read_navigation
from eskf_ros.gnss.signals import LETTERS, SPEED_OF_LIGHT, Gnss
from eskf_ros.gnss.time import from_calendar, normalized
from support import gnss_texts as texts
from support.gnss_oracle import RtklibNavigation, sidereon, week_and_seconds

Array = NDArray[np.float64]
AGES = (-5400.0, -731.25, 0.0, 60.0, 1999.5, 7200.0)


def write(folder: Path, text: str = texts.EVERYTHING) -> Path:
    path = folder / "made.rnx"
    path.write_text(text, encoding="ascii")
    return path


def records_of(folder: Path, text: str = texts.EVERYTHING) -> NDArray[np.void]:
    return read_navigation(write(folder, text)).ephemerides


def state(record: np.void, age: float) -> tuple[Array, Array, float, float]:
    """Position, velocity, clock and drift ``age`` s after the reference time of the orbit."""
    week, seconds = normalized(int(record["toe_week"]), float(record["toe"]) + age)
    position, velocity, clock, drift = orbits.satellite_state(record, week, seconds)
    return np.array(position), np.array(velocity), clock, drift


def derivative(function: Callable[[float], Any], at: float, step: float) -> Any:
    """Fourth-order central difference."""
    return (8.0 * (function(at + step) - function(at - step)) - function(at + 2 * step) + function(at - 2 * step)) / (
        12.0 * step
    )


@pytest.mark.parametrize("age", AGES)
def test_velocity_and_drift_are_the_derivatives(tmp_path: Path, age: float) -> None:
    records = records_of(tmp_path)
    assert len(records) == 9
    for record in records:
        _, velocity, _, drift = state(record, age)
        # The last bits of a position divided by the step: 1e-8 m / 1 s.
        step = 1.0
        moved, ticked = (derivative(lambda t, of=record, k=k: state(of, t)[k], age, step) for k in (0, 2))
        np.testing.assert_allclose(velocity, moved, rtol=0.0, atol=1e-5)
        assert drift == pytest.approx(ticked, abs=1e-17)


angles = st.floats(-math.pi, math.pi)
small = st.floats(-1e-5, 1e-5)
harmonics_m = st.floats(-800.0, 800.0)


@st.composite
def kepler_orbits(draw: st.DrawFn) -> dict[str, float]:
    """Any orbit of a navigation satellite, with all the terms of the modern messages."""
    return {
        "sqrt_a": draw(st.floats(5000.0, 6600.0)),
        "a_rate": draw(st.floats(-0.1, 0.1)),
        "e": draw(st.floats(0.0, 0.2)),
        "m0": draw(angles),
        "delta_n": draw(st.floats(-1e-8, 1e-8)),
        "delta_n_rate": draw(st.floats(-1e-12, 1e-12)),
        "i0": draw(st.floats(0.0, 1.2)),
        "idot": draw(st.floats(-1e-9, 1e-9)),
        "omega0": draw(angles),
        "omega": draw(angles),
        "omega_dot": draw(st.floats(-1e-8, 1e-8)),
        "cuc": draw(small),
        "cus": draw(small),
        "crc": draw(harmonics_m),
        "crs": draw(harmonics_m),
        "cic": draw(small),
        "cis": draw(small),
        "af0": draw(st.floats(-1e-3, 1e-3)),
        "af1": draw(st.floats(-1e-10, 1e-10)),
        "af2": draw(st.floats(-1e-17, 1e-17)),
    }


@given(
    kepler_orbits(),
    st.sampled_from([(Gnss.GPS, 5), (Gnss.GALILEO, 5), (Gnss.BEIDOU, 3), (Gnss.BEIDOU, 61), (Gnss.BEIDOU, 30)]),
    st.floats(-7200.0, 7200.0),
)
def test_velocity_of_any_orbit_is_the_derivative(
    fields: dict[str, float], satellite: tuple[Gnss, int], age: float
) -> None:
    record = kepler_record(*satellite, Message.CNAV, (2323, texts.TOE), {**fields, "toe": texts.TOE})
    position, velocity, _, drift = state(record, age)
    assert 2e7 < np.linalg.norm(position) < 6e7
    numerical = derivative(lambda t: state(record, t)[0], age, 2.0)
    np.testing.assert_allclose(velocity, numerical, rtol=0.0, atol=1e-5)
    assert drift == pytest.approx(derivative(lambda t: state(record, t)[2], age, 2.0), abs=1e-16)


@given(angles, st.floats(0.0, 0.5))
def test_keplers_equation_is_solved(mean_anomaly: float, eccentricity: float) -> None:
    expected = brentq(lambda x: x - eccentricity * math.sin(x) - mean_anomaly, -4.0, 4.0, xtol=1e-14)
    assert orbits.eccentric_anomaly(mean_anomaly, eccentricity) == pytest.approx(expected, abs=1e-12)


def test_rtklib_finds_the_satellites_at_the_same_place(tmp_path: Path) -> None:
    compare_with_rtklib(write(tmp_path), 9)


def test_rtklib_finds_real_satellites_at_the_same_place(data_folder: Callable[[str], Path]) -> None:
    compare_with_rtklib(data_folder("nagoya_20240720") / "base.nav", 1500)


def compare_with_rtklib(path: Path, fewest: int) -> None:
    """Position within 1e-6 m, velocity within 1e-4 m/s of its difference quotient, clock to rounding."""
    oracle = RtklibNavigation(path)
    ours = defaultdict(list)
    for record in read_navigation(path).ephemerides:
        ours[record["gnss_id"], record["sv_id"], round(record["af0"] * 1e15)].append(record)
    compared = 0
    for gnss, sv_id, theirs in oracle.ephemerides()[::2] if fewest > 100 else oracle.ephemerides():
        glonass = gnss == Gnss.GLONASS
        week, toe = week_and_seconds(theirs.toe)
        af0, af1 = (-theirs.taun, theirs.gamn) if glonass else (theirs.f0, theirs.f1)
        candidates = [
            record
            for record in ours[gnss, sv_id, round(af0 * 1e15)]
            if (record["toe_week"], record["toe"], record["af1"]) == (week, toe, af1)
        ]
        assert candidates, f"{gnss.name} {sv_id}: no such ephemeris"
        compared += 1
        for age in (-880.25, 0.0, 1799.0) if glonass else (-7100.25, 0.0, 5400.0):
            instant = normalized(week, toe + age)
            position, clock = oracle.state(gnss, theirs, *instant)
            our_position, our_velocity, our_clock, _ = orbits.satellite_state(candidates[0], *instant)
            np.testing.assert_allclose(our_position, position, rtol=0.0, atol=1e-6)
            assert our_clock == pytest.approx(clock, abs=1e-17)
            if age == 0.0:
                before, after = (oracle.state(gnss, theirs, week, toe + h)[0] for h in (-0.5, 0.5))
                np.testing.assert_allclose(our_velocity, after - before, rtol=0.0, atol=1e-4)
    assert compared >= fewest


MODERN = "".join(
    [
        texts.header("4.00"),
        texts.announced(texts.lnav("G05"), "LNAV"),
        texts.cnav("G05"),
        texts.cnav("J03", sqrt_a=6493.7, e=0.075, i0=0.72),
        texts.announced(texts.galileo("E11"), "INAV"),
        texts.announced(texts.beidou("C21"), "D1"),
        texts.announced(texts.beidou("C03"), "D2"),
    ]
)


def test_sidereon_finds_the_satellites_at_the_same_place(tmp_path: Path) -> None:
    theirs = {
        (record.satellite, record.is_cnav_family): record for record in sidereon().parse_rinex_nav_records(MODERN)
    }
    ours = records_of(tmp_path, MODERN)
    assert len(ours) == len(theirs) == 6
    names = {gnss: letter for letter, gnss in LETTERS.items()}
    for record in ours:
        oracle = theirs[f"{names[record['gnss_id']]}{record['sv_id']:02d}", record["message"] == Message.CNAV]
        for age in AGES:
            expected = oracle.evaluate(float(record["toe_own"]) + age)
            position, _, clock, _ = state(record, age)
            np.testing.assert_allclose(position, expected.position_m, rtol=0.0, atol=1e-6)
            assert clock == pytest.approx(expected.clock_polynomial_s + expected.relativistic_clock_s, abs=1e-17)


def test_sidereon_gives_the_same_group_delays_of_modern_gps(tmp_path: Path) -> None:
    library = sidereon()
    (oracle,) = library.parse_rinex_nav_records(texts.header("4.00") + texts.cnav())
    (record,) = records_of(tmp_path, texts.header("4.00") + texts.cnav())
    signals = library.CnavSignal
    for slot, signal in ((0, signals.L1_CA), (3, signals.L2C), (4, signals.L5_I5), (5, signals.L5_Q5)):
        correction = oracle.cnav_single_frequency_correction_s(signal)
        assert record["group_delay"][slot] == pytest.approx(correction, abs=1e-18)


def test_geostationary_satellites_stay_where_they_are(tmp_path: Path) -> None:
    """BeiDou's are given in a frame tilted by 5 deg: as an ordinary orbit they would fly across the equator."""
    (record,) = records_of(tmp_path, texts.header() + texts.beidou("C03"))
    places = np.array([state(record, age)[0] for age in np.linspace(-3600.0, 3600.0, 25)])
    assert np.linalg.norm(places, axis=1) == pytest.approx(42.16e6, abs=60e3)
    assert np.abs(places[:, 2]).max() < 100e3
    assert np.abs(places - places[12]).max() < 200e3
    assert np.linalg.norm(state(record, 0.0)[1]) < 30.0
    ordinary = record.copy()
    ordinary["sv_id"] = 8
    assert np.linalg.norm(state(ordinary, 1800.0)[0] - state(record, 1800.0)[0]) > 1e6


def glonass_states() -> st.SearchStrategy[np.void]:
    """Circular-like states: 25 500 km away, 3.9 km/s in an inertial frame."""

    def build(latitude: float, longitude: float, heading: float, pull: float) -> np.void:
        up = np.array(
            [
                math.cos(latitude) * math.cos(longitude),
                math.cos(latitude) * math.sin(longitude),
                math.sin(latitude),
            ]
        )
        east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
        along = math.cos(heading) * east + math.sin(heading) * np.cross(up, east)
        position = 25.5e3 * up
        velocity = 3.95 * along - np.cross([0.0, 0.0, EARTH_RATE], position)
        names = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")
        fields = dict(zip(names, (*position, *velocity, pull, -pull, pull)))
        return glonass_record(7, (2323, 0.0), 18, {**fields, "af0": 1e-5, "af1": 1e-12, "channel": -3.0})

    return st.builds(build, st.floats(-1.1, 1.1), angles, angles, st.floats(-5e-9, 5e-9))


@given(glonass_states(), st.sampled_from([-1800.0, -333.3, 60.0, 900.0, 1800.0]))
def test_glonass_orbit_solves_its_equations(record: np.void, age: float) -> None:
    """Against an integrator of high order; what four stages in steps of a minute lose is below 1 mm."""
    pull = tuple(float(value) for value in record["acceleration"])
    begin = np.concatenate([record["position"], record["velocity"]])
    exact = solve_ivp(
        lambda _, y: orbits.glonass_motion(tuple(y), pull), (0.0, age), begin, method="DOP853", rtol=1e-13, atol=1e-7
    )
    position, velocity, _, _ = state(record, age)
    np.testing.assert_allclose(position, exact.y[:3, -1], rtol=0.0, atol=1.5e-3)
    np.testing.assert_allclose(velocity, exact.y[3:, -1], rtol=0.0, atol=2e-6)
    # Two-body energy in an inertial frame changes by the flattening and Sun and Moon only.
    spin = np.array([0.0, 0.0, EARTH_RATE])
    energy = [
        0.5 * np.sum((v + np.cross(spin, p)) ** 2) - 3.986e14 / np.linalg.norm(p)
        for p, v in ((begin[:3], begin[3:]), (position, velocity))
    ]
    assert energy[1] == pytest.approx(energy[0], rel=2e-4)


def test_the_clock_has_a_reference_time_of_its_own(tmp_path: Path) -> None:
    """toc is two hours after toe here: a drift of 1e-10 would else be off by 7.2e-7 s, 216 m."""
    text = texts.header() + texts.lnav(date="2024 07 20 04 00 00", toe=texts.TOE, clock=(1e-4, 1e-10, 0.0), e=0.0)
    (record,) = records_of(tmp_path, text)
    assert record["toc"] - record["toe"] == 7200.0
    assert state(record, 0.0)[2] == pytest.approx(1e-4 - 7200.0 * 1e-10, abs=1e-18)
    assert state(record, 7200.0)[2] == pytest.approx(1e-4, abs=1e-18)


def test_transmission_is_where_the_satellites_clock_reads_tag_minus_pseudorange(tmp_path: Path) -> None:
    """Whatever the receiver's clock: tag and pseudorange are off together."""
    for record in records_of(tmp_path):
        week, seconds = int(record["toe_week"]), float(record["toe"]) + 100.0
        for clock_error in (0.0, 0.37e-3, -0.1):
            pseudorange = 2.3e7 + clock_error * SPEED_OF_LIGHT
            instant = orbits.transmission(record, week, seconds + clock_error, pseudorange)
            reading = instant + orbits.clock_polynomial(record, week, instant)[0]
            assert reading == pytest.approx(seconds - 2.3e7 / SPEED_OF_LIGHT, abs=2e-10)


RECEIVERS = [(6378137.0, 0.0, 0.0), (-3817680.0, 3562840.0, 3650158.0), (0.0, 0.0, -6356752.0)]


@pytest.mark.parametrize("receiver", RECEIVERS)
def test_light_travels_straight_in_an_inertial_frame(tmp_path: Path, receiver: tuple[float, float, float]) -> None:
    """Geometry done the long way: both ends rotated into the inertial frame that coincides with ECEF at reception."""
    for record in records_of(tmp_path):
        week, seconds = int(record["toe_week"]), float(record["toe"]) + 60.0
        position, velocity, _, _, light_time = geometry.state_at_reception(record, week, seconds, receiver)
        sent = orbits.satellite_state(record, week, seconds - light_time)[0]
        # Seconds of week resolve 1e-10 s, in which a satellite flies half a micrometre.
        np.testing.assert_allclose(position, sent, rtol=0.0, atol=1e-6)
        angle = -EARTH_RATE * light_time
        rotation = np.array(
            [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
        )
        inertial = rotation @ sent
        length = np.linalg.norm(inertial - receiver)
        assert length == pytest.approx(SPEED_OF_LIGHT * light_time, abs=1e-4)
        unit, our_length, _ = geometry.line_of_sight(position, velocity, receiver, (0.0, 0.0, 0.0), False)
        assert our_length == pytest.approx(length, abs=1e-6)
        np.testing.assert_allclose(unit, (inertial - receiver) / length, atol=1e-13)
        turned = geometry.turned_at_arrival(position, receiver)
        assert geometry.line_of_sight(turned, velocity, receiver, (0.0, 0.0, 0.0), True)[1] == pytest.approx(length)
        # Ignoring the rotation costs tens of metres.
        if abs(receiver[2]) < 6e6:
            assert abs(np.linalg.norm(np.subtract(sent, receiver)) - length) > 1.0


@pytest.mark.parametrize("receiver", RECEIVERS)
def test_range_rate_is_the_derivative_of_the_range_by_time_of_reception(
    tmp_path: Path, receiver: tuple[float, float, float]
) -> None:
    motion = np.array([31.0, -17.0, 4.0])

    def length(record: np.void, time: float) -> float:
        week, seconds = int(record["toe_week"]), float(record["toe"]) + time
        place = tuple((np.array(receiver) + motion * time).tolist())
        position, velocity, *_ = geometry.state_at_reception(record, week, seconds, place)
        return float(geometry.line_of_sight(position, velocity, place, (0.0, 0.0, 0.0), False)[1])

    for record in records_of(tmp_path):
        week, seconds = int(record["toe_week"]), float(record["toe"])
        position, velocity, *_ = geometry.state_at_reception(record, week, seconds, receiver)
        rate = geometry.line_of_sight(position, velocity, receiver, tuple(motion.tolist()), False)[2]
        # Without the changing light time it would be up to 5 mm/s off.
        assert rate == pytest.approx(derivative(lambda t, of=record: length(of, t), 0.0, 1.0), abs=2e-6)


def test_elevation_and_azimuth() -> None:
    local = east_north_up_to_ecef(0.61, 2.39)
    axes = np.array(local)
    for elevation, azimuth in ((0.3, 0.0), (1.2, 1.5), (-0.2, 4.0), (math.pi / 2, 0.0)):
        horizontal = math.cos(elevation)
        unit = axes @ [horizontal * math.sin(azimuth), horizontal * math.cos(azimuth), math.sin(elevation)]
        found = geometry.elevation_azimuth(tuple(unit), local)
        assert found[0] == pytest.approx(elevation, abs=1e-7)
        if elevation < 1.5:
            assert found[1] == pytest.approx(azimuth, abs=1e-9)


# 3D rms (m) of broadcast against precise orbits, which are of the centre of mass: that alone is a metre or two.
PRECISE = {"G": 1.6, "E": 1.05, "J": 2.4}


def test_precise_orbits_are_met_within_metres(data_folder: Callable[[str], Path]) -> None:
    folder = data_folder("orbit_truth_2021265")
    store = Ephemerides(read_navigation(folder / "SEPT2650.21P").ephemerides)
    errors: dict[str, list[Array]] = defaultdict(list)
    instant = (0, 0.0)
    lines = (folder / "COD0MGXFIN_20212650000_01D_05M_ORB.SP3").read_text(encoding="ascii").splitlines()
    for line in lines:
        if line.startswith("*"):
            year, month, day, hour, minute, second = line[1:].split()
            instant = from_calendar(int(year), int(month), int(day), int(hour), int(minute), float(second))
        elif line.startswith("P") and line[1] in LETTERS:
            precise = 1e3 * np.array([float(line[4 + 14 * axis : 18 + 14 * axis]) for axis in range(3)])
            chosen, _ = choose(store.records, store.first, LETTERS[line[1]], int(line[2:4]), 0, *instant, NO_ISSUE)
            if chosen >= 0:
                errors[line[1]].append(np.array(orbits.satellite_state(store.records[chosen], *instant)[0]) - precise)
    assert set(errors) == set(PRECISE)
    for letter, bar in PRECISE.items():
        found = np.array(errors[letter])
        assert len(found) > 200
        assert np.sqrt(np.mean(np.sum(found**2, axis=1))) < bar
        assert np.abs(found).max() < 5.0


# 95 % of the difference (m) between neighbouring ephemerides half way between them.
NEIGHBOURS = {Gnss.GPS: 3.0, Gnss.GALILEO: 1.0, Gnss.BEIDOU: 3.0, Gnss.QZSS: 3.0, Gnss.GLONASS: 6.0}


def test_neighbouring_ephemerides_agree_within_metres(data_folder: Callable[[str], Path]) -> None:
    """Orbits fitted independently of each other: no wrong time scale, frame or constant survives this."""
    store = Ephemerides(read_navigation(data_folder("nagoya_20240720") / "base.nav").ephemerides)
    differences = defaultdict(list)
    for first, second in zip(store.records[:-1], store.records[1:]):
        if any(first[name] != second[name] for name in ("gnss_id", "sv_id", "message")):
            continue
        gap = 604800.0 * (second["toe_week"] - first["toe_week"]) + (second["toe"] - first["toe"])
        if not 0.0 < gap <= (1800.0 if first["gnss_id"] == Gnss.GLONASS else 7200.0):
            continue
        halves = state(first, 0.5 * gap), state(second, -0.5 * gap)
        differences[Gnss(first["gnss_id"])].append(np.linalg.norm(halves[0][0] - halves[1][0]))
    assert set(differences) == set(NEIGHBOURS)
    for gnss, bar in NEIGHBOURS.items():
        assert len(differences[gnss]) > 10
        assert np.percentile(differences[gnss], 95) < bar, gnss
