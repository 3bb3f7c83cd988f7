"""Simulated ranges: they lead back to the truth, by our own code and by others; what happens in the sky happens."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.bags import POINT_CLOUD, open_bag
from eskf_ros.geodesy.earth import ecef_to_geodetic
from eskf_ros.geodesy.map_frame import east_north_up_to_ecef
from eskf_ros.gnss import time as gnss_time
from eskf_ros.gnss.cloud import read_epoch
from eskf_ros.gnss.ephemeris import Ephemerides
from eskf_ros.gnss.ephemeris_cloud import read_ephemerides
from eskf_ros.gnss.measurements import measured_epoch, predict_measured
from eskf_ros.gnss.point_solution import SolutionStatus, solve
from eskf_ros.gnss.range_model import PREDICTION
from eskf_ros.gnss.ranges import SATELLITE_KNOWN, Status, locate
from eskf_ros.gnss.rinex_nav import read_navigation
from eskf_ros.gnss.signals import GNSS_COUNT, SPEED_OF_LIGHT, Gnss
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING
from eskf_ros.simulate import constellation
from eskf_ros.simulate.episodes import Outage
from eskf_ros.simulate.main import main
from eskf_ros.simulate.range_episodes import ClockStep, KeepSatellites, Reflections, StreetCanyon
from eskf_ros.simulate.range_receiver import MILLISECOND, RangeMeasurements, RangeReceiver
from eskf_ros.simulate.scenario import Recording, simulate, trajectory
from support.gnss_observation_text import observation_text
from support.gnss_oracle import RtklibNavigation
from support.simulated import TOPICS, assert_chi_square, seconds

Array = NDArray[np.float64]
SKY_FILE = Path(__file__).resolve().parents[2] / "bags" / "sky.nav"
EXACT = {"noise_scale": 0.0, "ionosphere_error": 0.0, "troposphere_error": 0.0, "orbit_std": 0.0, "offset_std": 0.0}
KLOBUCHAR = constellation.KLOBUCHAR[Gnss.GPS]
PART = {"start": 40.0, "stop": 100.0, "outages": ()}


def recorded(*episodes: Any, seed: int = 1, **receiver: Any) -> Recording:
    return simulate("tunnel_drive", seed, ranges=RangeReceiver(**receiver), episodes=episodes, **PART)


def ranges_of(recording: Recording) -> RangeMeasurements:
    assert recording.ranges is not None
    return recording.ranges


def antenna(recording: Recording, stamps: NDArray[np.int64]) -> tuple[Array, Array]:
    """True position and velocity of the antenna, ECEF."""
    motion = trajectory(recording.name).motion(seconds(stamps))
    position = recording.frame.to_ecef(motion.position_of(recording.options.lever_arm))
    return position, motion.velocity_of(recording.options.lever_arm) @ recording.frame.rotation_map_to_ecef.T


def store(measured: RangeMeasurements) -> Ephemerides:
    return Ephemerides(np.array([broadcast.record() for broadcast in measured.broadcasts]))


def test_the_bundled_file_is_the_sky_of_the_simulation() -> None:
    assert SKY_FILE.read_text(encoding="ascii") == constellation.text()
    navigation = read_navigation(SKY_FILE)
    assert not navigation.complaints.counts
    assert len(Ephemerides(navigation.ephemerides)) == len(constellation.messages()) == 79
    for read, made in zip(navigation.broadcasts, constellation.messages()):
        assert read.record().tobytes() == made.record().tobytes()
    np.testing.assert_array_equal(navigation.klobuchar[Gnss.GPS], KLOBUCHAR)


@pytest.mark.parametrize(
    "stamp", [1_748_764_800_123_456_789, 1_483_228_799_999_999_999, 1_483_228_800_000_000_000, 10**18]
)
def test_gps_time_and_computer_time(stamp: int) -> None:
    """There and back to the ns, across a leap second too; one instant is known from elsewhere."""
    week, second = gnss_time.from_unix(stamp)
    assert abs(gnss_time.to_unix(week, second) - stamp) <= 1
    # 5 November 2020, 00:00:00 UTC is second 345618 of week 2130 (18 leap seconds since 2017).
    assert gnss_time.from_unix(1_604_534_400_000_000_000) == (2130, 345618.0)
    assert gnss_time.to_unix(2130, 345618.0) == 1_604_534_400_000_000_000


def test_without_errors_the_point_solution_is_the_truth() -> None:
    """Position to millimetres, velocity to 0.1 mm/s, clock and its jumps: one model on both sides, moving antenna."""
    recording = recorded(clock_jumps=True, clock_bias=4.9e-4, **EXACT)
    measured = ranges_of(recording)
    position, velocity = antenna(recording, measured.stamp)
    ephemerides = store(measured)
    for k in range(0, len(measured.stamp), 20):
        found = measured.epoch(k).copy()
        week, second = int(measured.week[k]), float(measured.seconds[k])
        locate(found, week, second, ephemerides)
        solution = solve(found, week, second, KLOBUCHAR)
        assert solution.status == SolutionStatus.SOLVED
        assert solution.used > 15
        np.testing.assert_allclose(solution.position_ecef, position[k], atol=3e-3)
        np.testing.assert_allclose(solution.velocity_ecef, velocity[k], atol=1e-4)
        assert solution.clock_bias == pytest.approx(measured.clock_bias[k], abs=3e-3)
        assert solution.clock_drift == pytest.approx(measured.clock_drift[k], abs=1e-4)
        # The time tag shows the receiver's clock.
        assert gnss_time.to_unix(week, second) - measured.stamp[k] == pytest.approx(
            1e9 * measured.clock_bias[k] / SPEED_OF_LIGHT, abs=2
        )
    jumps = np.diff(measured.clock_bias)
    jumps = jumps[np.abs(jumps) > 1000.0]
    assert len(jumps) > 0
    np.testing.assert_allclose(np.abs(jumps), MILLISECOND, rtol=1e-3)
    assert np.abs(measured.clock_bias).max() < 0.51 * MILLISECOND


def test_rtklib_finds_the_antenna(tmp_path: Path) -> None:
    """The same epochs as RINEX files, by single-point positioning of RTKLIB, whose troposphere is another."""
    recording = recorded(**EXACT, clock_drift=0.0, clock_bias=0.0, rate=0.2)
    measured = ranges_of(recording)
    position, _ = antenna(recording, measured.stamp)
    epochs = [
        (int(week), float(second), measured.epoch(k))
        for k, (week, second) in enumerate(zip(measured.week, measured.seconds))
    ]
    (tmp_path / "rover.obs").write_text(observation_text(epochs, position[0]), encoding="ascii")
    oracle = RtklibNavigation(SKY_FILE, tmp_path / "rover.obs")
    library, observations = oracle.library, oracle.observations
    library.sortobs(observations)
    options = library.prcopt_default
    options.mode, options.ionoopt, options.tropopt = library.PMODE_SINGLE, library.IONOOPT_BRDC, library.TROPOPT_SAAS
    options.navsys = library.SYS_GPS | library.SYS_GAL | library.SYS_CMP
    options.elmin, options.nf = math.radians(15.0), 1
    begin = epoch = 0
    while begin < observations.n:
        end = begin + sum(
            observations.data[index].time.time == observations.data[begin].time.time
            for index in range(begin, observations.n)
        )
        data = library.Arr1Dobsd_t(end - begin)
        for index in range(begin, end):
            data[index - begin] = observations.data[index]
        solution, directions = library.sol_t(), library.Arr1Ddouble(2 * (end - begin))
        assert library.pntpos(
            data.ptr, end - begin, oracle.navigation, options, solution, directions, None, library.Arr1Dchar(128)
        )
        error = np.array([solution.rr[axis] for axis in range(3)]) - position[epoch]
        latitude, longitude, _ = ecef_to_geodetic(*position[epoch].tolist())
        east, north, up = east_north_up_to_ecef(np.array([[latitude, longitude]]))[0].T @ error
        assert math.hypot(east, north) < 0.1
        assert abs(up) < 0.5
        begin, epoch = end, epoch + 1
    assert epoch == len(epochs) >= 12


def test_errors_have_the_sizes_they_are_given() -> None:
    """Noise as the weighting says; offsets of the constellations; a clock that wanders as its random walks do."""
    options = {**EXACT, "noise_scale": 1.0, "offset_std": 3.0}
    noisy, exact = ranges_of(recorded(**options)), ranges_of(recorded(**EXACT))
    assert len(noisy.ranges) == len(exact.ranges)
    np.testing.assert_array_equal(noisy.clock_bias, exact.clock_bias)
    groups = np.array([Gnss.GPS, Gnss.GALILEO, Gnss.BEIDOU])
    assert noisy.system_offset[Gnss.GPS] == 0.0
    with_std = ranges_of(recorded(**options, stds=True)).ranges
    bias = noisy.system_offset[np.where(with_std["gnss_id"] == Gnss.BEIDOU, 4, with_std["gnss_id"])]
    code = noisy.ranges["pseudorange"] - exact.ranges["pseudorange"] - bias
    assert_chi_square(code / with_std["pseudorange_std"])
    assert_chi_square((noisy.ranges["doppler"] - exact.ranges["doppler"]) / with_std["doppler_std"])
    assert set(np.unique(noisy.ranges["gnss_id"])) == set(groups)
    assert len(np.unique(noisy.system_offset)) == GNSS_COUNT
    walk = {"clock_drift_noise": 0.2, "clock_noise": 0.0, "rate": 5.0}
    drifts = [np.diff(ranges_of(recorded(seed=seed, **walk)).clock_drift) for seed in range(5)]
    assert_chi_square(np.concatenate(drifts) / (0.2 * math.sqrt(0.2)))
    steady = ranges_of(recorded(clock_drift_noise=0.0, clock_noise=0.0))
    np.testing.assert_allclose(np.diff(steady.clock_bias), 60.0 * 0.2, rtol=1e-9)


def test_slow_errors_are_slow_and_as_large_as_they_should() -> None:
    slow = {**EXACT, "orbit_std": 2.0}
    differences = []
    for seed in range(6):
        with_error, exact = (
            ranges_of(recorded(seed=seed, **slow)).ranges,
            ranges_of(recorded(seed=seed, **EXACT)).ranges,
        )
        first = np.isin(np.arange(len(exact)), np.unique(exact["sv_id"] + 100 * exact["gnss_id"], return_index=True)[1])
        differences.append((with_error["pseudorange"] - exact["pseudorange"])[first])
    assert_chi_square(np.concatenate(differences) / 2.0)
    atmosphere = {**EXACT, "ionosphere_error": 0.3, "troposphere_error": 0.05}
    with_error = ranges_of(recorded(**atmosphere)).ranges["pseudorange"]
    exact_ranges = ranges_of(recorded(**EXACT)).ranges["pseudorange"]
    assert 0.05 < np.abs(with_error - exact_ranges).max() < 30.0


def counts(measured: RangeMeasurements) -> NDArray[np.int64]:
    return np.diff(measured.first)


@pytest.mark.parametrize("choice", ["random", "highest", "lowest"])
@pytest.mark.parametrize("keep", [0, 1, 3, 8])
def test_so_many_satellites_stay(choice: str, keep: int) -> None:
    """The same ones during the episode; before, after and in all else the recording is as it was."""
    plain = ranges_of(recorded())
    measured = ranges_of(recorded(KeepSatellites(60.0, 20.0, keep=keep, choice=choice)))
    inside = (seconds(measured.stamp) >= 60.0) & (seconds(measured.stamp) < 80.0)
    assert inside.any()
    assert (counts(measured)[inside] == keep).all()
    np.testing.assert_array_equal(counts(measured)[~inside], counts(plain)[~inside])
    names = {
        tuple((row["gnss_id"], row["sv_id"]) for row in measured.epoch(k)) for k in np.flatnonzero(inside).tolist()
    }
    assert len(names) == 1
    for k in range(len(measured.stamp)):
        kept = np.isin(plain.epoch(k)[["gnss_id", "sv_id"]], measured.epoch(k)[["gnss_id", "sv_id"]])
        assert measured.epoch(k).tobytes() == plain.epoch(k)[kept].tobytes()


def test_different_seeds_keep_different_satellites() -> None:
    kept = set()
    for seed in range(6):
        measured = ranges_of(recorded(KeepSatellites(60.0, 20.0, keep=2), seed=seed))
        kept.add(tuple(measured.epoch(120)[["gnss_id", "sv_id"]].tolist()))
    assert len(kept) > 3


def test_houses_hide_what_is_beside_the_street() -> None:
    """Along the street low satellites remain; across it only high ones, or their echoes, late and weak."""
    plain = ranges_of(recorded(**EXACT))
    measured = ranges_of(recorded(StreetCanyon(50.0, 40.0, height=25.0, width=20.0, nlos=0.4), **EXACT))
    recording = recorded()
    position, _ = antenna(recording, measured.stamp)
    motion = trajectory("tunnel_drive").motion(seconds(measured.stamp))
    forward = motion.rotation_body_to_map[:, :2, 0]
    inside = (seconds(measured.stamp) >= 50.0) & (seconds(measured.stamp) < 90.0)
    ephemerides = store(plain)
    hidden = echoes = 0
    for k in np.flatnonzero(inside).tolist():
        week, second = int(plain.week[k]), float(plain.seconds[k])
        seen = measured_epoch(plain.epoch(k), week, second, ephemerides, tuple(position[k].tolist()))
        seen = seen[seen["status"] == Status.USABLE]
        direction = np.stack([np.sin(seen["azimuth"]), np.cos(seen["azimuth"])], axis=1)
        across = np.abs(direction[:, 0] * forward[k, 1] - direction[:, 1] * forward[k, 0])
        across /= np.linalg.norm(forward[k])
        behind = np.tan(seen["elevation"]) < 25.0 * across / 10.0
        rows = {(row["gnss_id"], row["sv_id"]): index for index, row in enumerate(measured.epoch(k))}
        first = int(measured.first[k])
        clear_of = {(row["gnss_id"], row["sv_id"]): row for row in plain.epoch(k)}
        for row, behind_house, sideways in zip(seen, behind, across):
            name = (row["gnss_id"], row["sv_id"])
            if not behind_house:
                assert name in rows
                assert measured.epoch(k)[rows[name]].tobytes() == clear_of[name].tobytes()
            elif name in rows:
                echo = measured.epoch(k)[rows[name]]
                assert measured.reflected[first + rows[name]]
                detour = 20.0 * sideways * math.cos(row["elevation"])
                assert echo["pseudorange"] - clear_of[name]["pseudorange"] == pytest.approx(detour, abs=0.05)
                assert echo["cn0"] == pytest.approx(clear_of[name]["cn0"] - 10.0)
                echoes += 1
            else:
                hidden += 1
    assert hidden > 200
    assert echoes > 100


def test_reflections_and_clock_steps() -> None:
    plain = ranges_of(recorded(**EXACT))
    reflected = ranges_of(recorded(Reflections(60.0, 10.0, count=4, detour=30.0), **EXACT))
    inside = (seconds(plain.stamp) >= 60.0) & (seconds(plain.stamp) < 70.0)
    for k in range(len(plain.stamp)):
        longer = reflected.epoch(k)["pseudorange"] - plain.epoch(k)["pseudorange"]
        assert np.count_nonzero(longer) == (4 if inside[k] else 0)
        np.testing.assert_allclose(longer[longer != 0.0], 30.0, atol=1e-6)
    stepped = ranges_of(recorded(ClockStep(60.0, 10.0, step=2e-3), **EXACT))
    np.testing.assert_allclose(
        stepped.clock_bias - plain.clock_bias, np.where(inside, 2.0 * MILLISECOND, 0.0), atol=1e-6
    )
    k = int(np.flatnonzero(inside)[5])
    np.testing.assert_allclose(
        stepped.epoch(k)["pseudorange"] - plain.epoch(k)["pseudorange"], 2.0 * MILLISECOND, atol=1e-6
    )
    assert stepped.seconds[k] - plain.seconds[k] == pytest.approx(2e-3, abs=1e-9)


def test_no_ranges_in_tunnels() -> None:
    measured = ranges_of(recorded(Outage(55.0, 10.0)))
    elapsed = seconds(measured.stamp)
    assert not ((elapsed >= 55.0) & (elapsed < 65.0)).any()
    assert len(elapsed) == 250


@pytest.mark.parametrize("satellites", [False, True])
def test_a_recording_holds_all_that_is_needed(tmp_path: Path, satellites: bool) -> None:
    """From the file alone: what remains of the ranges is the receiver's clock. The same seed gives the same bytes."""
    sensor = f"ranges:satellites={str(satellites).lower()},noise_scale=0,orbit_std=0"
    sensor += ",ionosphere_error=0,troposphere_error=0"
    command = ["tunnel_drive", "--seed", "4", "--set", "stop=60", "--sensor", sensor, "--quiet"]
    command += ["--episode", "satellites:start=30,length=10,keep=5"]
    paths = [tmp_path / "a" / "x.mcap", tmp_path / "b" / "x.mcap"]
    for path in paths:
        path.parent.mkdir()
        assert main([*command, "--out", str(path)]) == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()
    topics = {"gnss/ranges": POINT_CLOUD}
    if not satellites:
        topics["gnss/ephemerides"] = POINT_CLOUD
    expected = ranges_of(
        simulate(
            "tunnel_drive",
            4,
            stop=60.0,
            ranges=RangeReceiver(**{**EXACT, "offset_std": 3.0}),
            episodes=(KeepSatellites(30.0, 10.0, keep=5),),
        )
    )
    recording = simulate("tunnel_drive", 4, stop=60.0)
    position, velocity = antenna(recording, expected.stamp)
    ephemerides, klobuchar, done = Ephemerides(), np.zeros(8), 0
    with open_bag([paths[0]]) as bag:
        assert set(bag.topics) == {*TOPICS, *topics}
        for batch in bag.batches(topics):
            for message in batch["gnss/ephemerides"].messages if "gnss/ephemerides" in batch else ():
                sent = read_ephemerides(message["points"])
                ephemerides.add(sent.records)
                klobuchar = sent.klobuchar[Gnss.GPS]
            for message in batch["gnss/ranges"].messages:
                assert message["stamp"] == expected.stamp[done]
                assert bag.strings[message["frame_id"]] == "gps"
                epoch = read_epoch(message["points"])
                assert (epoch.ranges["flags"] & SATELLITE_KNOWN != 0).all() == satellites
                measured = measured_epoch(epoch.ranges, epoch.week, epoch.seconds, ephemerides)
                usable = measured[measured["status"] == Status.USABLE]
                assert len(usable) >= 5
                place, motion = tuple(position[done].tolist()), tuple(velocity[done].tolist())
                geodetic = ecef_to_geodetic(*place)
                axes = tuple(map(tuple, east_north_up_to_ecef(np.array([geodetic[:2]]))[0].tolist()))
                prediction = np.zeros(1, PREDICTION)[0]
                for signal in usable:
                    predict_measured(
                        signal,
                        place,
                        motion,
                        *geodetic,
                        axes,
                        epoch.week,
                        epoch.seconds,
                        KLOBUCHAR if satellites else klobuchar,
                        DEFAULT_WEIGHTING,
                        prediction,
                    )
                    bias = expected.clock_bias[done] + expected.system_offset[signal["system"]]
                    assert prediction["code_residual"] == pytest.approx(bias, abs=3e-3)
                    assert prediction["doppler_residual"] == pytest.approx(expected.clock_drift[done], abs=1e-4)
                done += 1
    assert done == len(expected.stamp) > 250


def test_a_real_sky_may_be_given(tmp_path: Path) -> None:
    path = tmp_path / "gps.nav"
    lines = constellation.text().splitlines(keepends=True)
    path.write_text("".join(lines[: 8 + 8 * 31]), encoding="ascii")
    measured = ranges_of(recorded(nav=str(path)))
    assert set(np.unique(measured.ranges["gnss_id"])) == {Gnss.GPS}
    assert measured.system_offset[Gnss.GPS] == 0.0
    path.write_text(path.read_text("ascii").replace("2025 06 01", "2024 06 02"), encoding="ascii")
    with pytest.raises(ValueError, match="no ephemeris of GEC for the time of the scenario, GPS week 2369"):
        recorded(nav=str(path), rate=4.0)
    # A year before, on a recording whose clock is as much ahead.
    before = ranges_of(recorded(nav=str(path), clock_offset=364.0 * 86400.0))
    assert set(before.week) == {2317}
    np.testing.assert_array_equal(before.stamp, measured.stamp)
    found = measured_epoch(before.epoch(0), int(before.week[0]), float(before.seconds[0]), store(before))
    assert np.isin(found["status"], (Status.USABLE, Status.LOW_CN0)).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sensor", "ranges:systems=GX"], "systems are letters out of GECJR, not 'GX'"),
        (["--sensor", "ranges:rate=0"], "rate of the ranges must be a positive number"),
        (["--sensor", "ranges:rate=0.1", "--set", "start=4"], "at 0.1 Hz there is no epoch of ranges from 4 s to 5 s"),
        (["--sensor", "ranges:nav=nowhere.nav"], "nowhere.nav: No such file"),
        (["--episode", "satellites:start=1,length=2,keep=-1"], "the number of satellites to keep is not negative"),
        (["--episode", "satellites:start=1,length=2,choice=best"], "unknown choice of satellites 'best'"),
        (["--episode", "street_canyon:start=1,length=2,width=0"], "a street has a width"),
    ],
)
def test_mistakes_are_named(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tunnel_drive", "--set", "stop=5", "--out", str(tmp_path / "x.mcap"), *arguments]) == 2
    assert message in capsys.readouterr().err
