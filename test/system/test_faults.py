"""The campaign of faults: a clean drive shows none, what is broken is seen to be, and the bars judge as they say."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from campaign.advice import advice_of
from campaign.causes import causes_of, is_named, is_wrong
from campaign.document import replace_section
from campaign.fault import DEFAULT_POSITION, DEFAULT_VELOCITY, TOLD_POSITION, TOLD_VELOCITY, Fault, Filter, Kind
from campaign.independent import FOLDER, recording_from
from campaign.judge import Figures, Row, figures_of, summary
from campaign.running import Trace, heading_at_start_deg, parameters_of, recording_of, run_one
from eskf_ros.parameters.mapping import from_mapping
from faults import all_faults
from names import follow

CLEAN = Fault("clean", Kind.CLEAN)
BY_NAME = {fault.name: fault for fault in all_faults()}


@lru_cache(maxsize=8)
def run_named(name: str, given: Filter, seed: int = 3) -> Trace:
    return run_one(BY_NAME[name], recording_of(BY_NAME[name], seed), given)


def test_a_heading_that_has_drifted_with_the_gyro_bias_is_not_called_wrong_from_the_start() -> None:
    """Five minutes straight on: the course corrects it by 65 deg, as much as its sigma has allowed for."""
    trace = run_named("motorway 10 min, straight", TOLD_VELOCITY, 20)
    assert np.degrees(np.abs(trace.heading_error)).max() > 45.0
    assert np.degrees(trace.heading_error[-1]) < 15.0
    assert not [sentence for sentence in trace.final if "the heading that was given" in sentence]


def test_an_imu_that_is_upside_down_is_not_taken_for_clocks_that_are_apart() -> None:
    fault = BY_NAME["IMU upside down"]
    assert figures_of(fault, run_named("IMU upside down", DEFAULT_POSITION, 1)).wrong == ()


def test_names_of_faults_are_not_repeated_and_amplitudes_change_them() -> None:
    assert len(BY_NAME) == len(all_faults())
    larger = {fault.name: fault for fault in all_faults(2.0)}
    assert len(larger) == len(BY_NAME)
    assert "gyro bias step 2 deg/s" in larger
    assert larger["gyro bias step 2 deg/s"].episodes != BY_NAME["gyro bias step 1 deg/s"].episodes


@pytest.mark.parametrize("kind", Kind)
def test_every_fault_can_be_recorded_and_its_parameters_are_some(kind: Kind) -> None:
    for fault in all_faults():
        if fault.kind == kind and not fault.is_version and fault.scenario != "hour_drive":
            recording = recording_of(dataclasses.replace(fault, stop=12.0), 0)
            assert len(recording.imu_taken) == len(recording.imu_stamp)
            for is_told in (True, False):
                from_mapping(parameters_of(fault, recording, is_told))


def test_a_clean_drive_is_neither_lost_nor_a_lie() -> None:
    trace = run_named("clean", TOLD_VELOCITY)
    figures = figures_of(CLEAN, trace)
    assert figures.worst < 1.0
    assert (figures.lost, figures.position_lies, figures.heading_lies) == (0.0, 0.0, 0.0)
    assert (figures.restarts, figures.resets, figures.thrown_away, figures.said) == (0, 0, 0, ())
    assert 0.0 < figures.known_after < 30.0
    assert figures.is_right
    assert Row(CLEAN, TOLD_VELOCITY, [figures], [figures]).verdict() == "ok"


def test_errors_are_those_of_base_link_against_the_truth() -> None:
    """A filter that never had a heading is compared with the truth, too: its sigma says how little it knows."""
    trace = run_named("fixes 10 s apart", TOLD_VELOCITY)
    early = trace.seconds < 15.0
    assert (trace.error[early] < 5.0 * trace.sigma[early]).all()
    assert not trace.is_known[early].any()


def test_velocities_stamped_late_are_harmless_once_their_offset_is_given() -> None:
    """The remedy of a fault, followed."""
    fault = BY_NAME["velocities stamped 0.13 s late"]
    remedied = dataclasses.replace(fault, parameters={"gnss.velocity_time_offset": -0.13})
    clean = run_named("clean", TOLD_VELOCITY)
    late = run_named(fault.name, TOLD_VELOCITY)
    cured = run_one(remedied, recording_of(remedied, 3), TOLD_VELOCITY)

    def rms(trace: Trace) -> float:
        return float(np.sqrt(np.mean(trace.error[trace.seconds > 60.0] ** 2)))

    assert rms(late) > 1.5 * rms(clean)
    assert rms(cured) < 1.1 * rms(clean)


@pytest.mark.parametrize(
    "name",
    [
        "holes of 1.6 s, dropped",
        "rates clipped at 0.2 rad/s",
        "one gyro axis negated",
        "accelerometer x and y swapped",
        "IMU yaw 8 deg off",
        "velocity in north, east, down",
        "clocks of IMU and receiver 1.2 s apart",
        "clock set by +0.5 s for the rest",
        "clock set by +10 s for the rest",
        "clock set by -0.5 s for the rest",
        "stamps cut to whole seconds",
        "positions stamped 0.25 s late",
        "heading given 120 deg wrong",
    ],
)
def test_a_fault_is_named_and_no_other(name: str) -> None:
    figures = figures_of(BY_NAME[name], run_named(name, DEFAULT_VELOCITY))
    assert math.isfinite(figures.named_after)
    assert not figures.wrong


@pytest.mark.parametrize(
    ("name", "given", "seed"),
    [
        ("IMU yaw 8 deg off", DEFAULT_POSITION, 0),
        ("IMU yaw 5 deg off", TOLD_POSITION, 1),
        ("stamps jittered by 0 ms, late by 1 ms", TOLD_VELOCITY, 0),
        ("heading given 70 deg wrong", TOLD_POSITION, 0),
        ("clocks of IMU and receiver 1.2 s apart", TOLD_POSITION, 1),
        ("clocks of IMU and receiver 1.2 s apart", DEFAULT_POSITION, 0),
        ("lasting errors 1.5 m, 30 s", TOLD_POSITION, 2),
        ("rates clipped at 0.2 rad/s: boat", DEFAULT_VELOCITY, 0),
        ("RTK claims 1 cm and wanders 0.3 m: boat", DEFAULT_VELOCITY, 0),
    ],
)
def test_a_fault_is_named_where_others_look_like_it(name: str, given: Filter, seed: int) -> None:
    figures = figures_of(BY_NAME[name], run_named(name, given, seed))
    assert math.isfinite(figures.named_after)
    assert not figures.wrong


def test_faults_that_no_installation_has_blame_none() -> None:
    """With gyro axes exchanged an antenna 12 m above its place would be certain, and fixes 0.2 s early with it."""
    final = run_named("gyro x and y swapped", TOLD_POSITION, 0).final
    assert final
    assert not [text for text in final if "time_offset" in text or "lever_arm" in text]


def test_the_first_turns_of_positions_alone_do_not_set_clocks_apart() -> None:
    """Courses of a few windows scatter: after 46 s of motion the turns of this clean drive seem to be 0.7 s early."""
    fault = Fault("clean", Kind.CLEAN, scenario="hour_drive", stop=120.0)
    assert run_one(fault, recording_of(fault, 16), DEFAULT_POSITION).said == {}


@pytest.mark.parametrize(
    ("name", "given", "parameters"),
    [
        ("positions stamped 0.25 s late", TOLD_POSITION, ("gnss.time_offset",)),
        ("positions stamped 0.25 s late", TOLD_VELOCITY, ("gnss.time_offset", "gnss.velocity_time_offset")),
        ("lever arm 1.5 m off in x", TOLD_VELOCITY, ("gnss.lever_arm",)),
    ],
)
def test_advice_that_is_followed_helps(name: str, given: Filter, parameters: tuple[str, ...]) -> None:
    """The sentence names the right cause; what it says to set, set, makes the error smaller by half."""
    for seed in (0, 1):
        run = follow(BY_NAME[name], seed, given)
        assert math.isfinite(run.after)
        assert not run.wrong
        assert run.advised == parameters
        assert run.followed < 0.5 * run.before


def test_gyro_noise_that_was_told_too_small_is_measured_at_rest_and_allowed_for() -> None:
    """Told a tenth, the heading would be beyond five sigma for a tenth of the time; now it is as if it were told."""
    name = "10 times the noise"
    trace = run_named(name, TOLD_POSITION, 0)
    is_judged = trace.is_known & (trace.seconds > 140.0)
    square = (trace.heading_error / trace.heading_sigma)[is_judged] ** 2
    assert square.mean() < 3.0
    assert square.max() < 16.0
    run = follow(BY_NAME[name], 0, TOLD_POSITION)
    assert run.advised == ("imu.gyro_noise_density",)
    assert not run.wrong
    assert run.followed < 1.1 * run.before


def test_advice_is_read_from_sentences() -> None:
    said = [
        "the fixes are stamped 0.251 s (+- 0.010) late: set gnss.time_offset to -0.251, or synchronise the clocks",
        "the antenna seems to be (-1.50, +0.25, +0.00) m (+- 0.10) in base_link from where gnss.lever_arm says: "
        "measure it again",
        "the heading is still unknown in 3 minutes of motion",
    ]
    found = advice_of(said, {"gnss.lever_arm": (2.0, 0.0, 1.0)})
    assert found == {"gnss.time_offset": -0.251, "gnss.lever_arm": [0.5, 0.25, 1.0]}


def test_causes_are_told_apart_and_descriptions_blame_nothing() -> None:
    late = "the fixes are stamped . s (+- . ) late: set gnss.time_offset to . , or synchronise the clocks"
    assert causes_of(late) == {"position offset", "clocks apart"}
    assert is_named(late, ("position offset",))
    assert is_wrong(late, ("lever arm",), ())
    assert not is_wrong(late, ("lever arm",), ("clocks apart",))
    unknown = "the heading is still unknown in minutes of motion: ... alignment.use_course for a vehicle"
    assert not causes_of(unknown)
    assert not is_wrong(unknown, ("lever arm",), ())


def trace_of(**changes: object) -> Trace:
    """A run of 200 s with an error of a metre at a sigma of one, heading known to a degree and right, and no word."""
    count = 200
    usual = {
        "seconds": np.arange(1.0, count + 1.0),
        "error": np.ones(count),
        "sigma": np.ones(count),
        "heading_error": np.zeros(count),
        "heading_sigma": np.full(count, math.radians(1.0)),
        "is_known": np.ones(count, bool),
        "speed": np.ones(count),
        "turn": np.zeros(count),
        "restarts": 0,
        "resets": 0,
        "thrown_away": 0,
        "said": {},
        "final": (),
        "offered": 1000,
        "refused": 1,
        "rest": np.zeros(0),
        "rest_speed": np.zeros(0),
        "rest_turn": np.zeros(0),
    }
    return Trace(**{**usual, **changes})  # type: ignore[arg-type]


def at(begin: float, end: float, value: float, other: float = 1.0) -> np.ndarray:
    seconds = np.arange(1.0, 201.0)
    return np.where((seconds >= begin) & (seconds < end), value, other)


def verdict(fault: Fault, trace: Trace, ungated: Trace | None = None, given: Filter = TOLD_VELOCITY) -> str:
    other = trace if ungated is None else ungated
    return Row(fault, given, [figures_of(fault, trace)], [figures_of(fault, other)]).verdict()


IMU = Fault("fault", Kind.IMU, names=("IMU bias",), also=("IMU noise",))
SAID = {"bias jump of the gyro": 110.0}


@pytest.mark.parametrize(
    ("trace", "expected"),
    [
        (trace_of(said=SAID), "ok"),
        (trace_of(said=SAID, error=at(120, 140, 11.0), sigma=at(120, 140, 3.0)), "1: worst 11.0 m"),
        (trace_of(said=SAID, error=at(120, 140, 9.0), sigma=at(120, 140, 0.1)), "ok"),
        (trace_of(said=SAID, error=at(160, 201, 9.0), sigma=at(160, 201, 0.1)), "2: position lies 100.0 %"),
        (trace_of(said=SAID, heading_error=at(160, 201, 0.2, 0.0)), "2: heading lies 100.0 %"),
        (trace_of(said=SAID, heading_error=at(160, 201, 0.2, 0.0), is_known=np.zeros(200, bool)), "ok"),
        (trace_of(said=SAID, thrown_away=1), "1: 1 headings thrown away"),
        (trace_of(), "8: named 0 %"),
        (trace_of(said={**SAID, "multipath": 150.0}), "8: wrong cause 100 %"),
        (trace_of(said={**SAID, "IMU noise parameters are too small": 150.0}), "ok"),
    ],
)
def test_the_bars_of_a_fault_of_the_imu(trace: Trace, expected: str) -> None:
    assert verdict(IMU, trace) == expected


def test_lost_is_counted_while_fixes_are_usable_and_lies_from_when_they_must_be_over() -> None:
    far = trace_of(said=SAID, error=at(120, 140, 400.0))
    assert verdict(IMU, far).startswith("1: lost 19.8 %, worst 400 m")
    receiver = Fault("fault", Kind.RECEIVER, end=140.0, unusable=((100.0, 140.0),))
    assert verdict(receiver, trace_of(error=far.error)) == "ok"
    slow = trace_of(error=at(120, 170, 400.0))
    assert verdict(receiver, slow) == "1: lost 32.6 %; 2: position lies 32.6 %"


def test_a_filter_that_is_worse_than_without_gates_misses_the_bar() -> None:
    worse, better = trace_of(said=SAID, error=at(120, 140, 3.0)), trace_of(said=SAID, error=at(120, 140, 2.0))
    assert verdict(IMU, worse, better) == "1: without gates 2.0 m"
    assert verdict(IMU, better, worse) == "ok"


def test_rest_in_motion_and_motion_at_rest() -> None:
    motion = Fault("motion", Kind.MOTION, begin=0.0)
    assert verdict(motion, trace_of(rest_speed=np.array([0.2, 0.01]))) == "5: 1 false rests"
    assert verdict(motion, trace_of(rest_turn=np.array([math.radians(0.2)]))) == "5: 1 false rests"
    parked = dataclasses.replace(motion, is_at_rest=True)
    still = trace_of(speed=np.zeros(200), rest=np.arange(30.0, 130.0))
    assert verdict(parked, still) == "5: rest held 58 %"
    assert verdict(parked, trace_of(speed=np.zeros(200), rest=np.arange(201.0))) == "ok"


def test_slow_robots_must_know_a_right_heading_in_time() -> None:
    slow = Fault("slow", Kind.MOTION, begin=0.0, is_slow=True)
    known_late = np.arange(200) >= 70
    assert verdict(slow, trace_of(is_known=known_late)) == "6: 1 late"
    assert verdict(slow, trace_of(heading_error=np.full(200, 0.4), heading_sigma=np.full(200, 0.5))) == "6: 1 wrong"
    assert verdict(slow, trace_of()) == "ok"


def test_headings_that_nothing_tells_are_as_uncertain_as_they_are_wrong() -> None:
    steady = Fault("steady", Kind.MOTION, begin=0.0, is_steady=True)
    sigma = math.radians(1.0)
    assert verdict(steady, trace_of(heading_error=np.full(200, sigma))) == "ok"
    assert verdict(steady, trace_of(heading_error=np.full(200, 2.0 * sigma))) == "2: (e/s)^2 4"
    assert verdict(steady, trace_of(heading_error=np.full(200, 0.1 * sigma))) == "2: (e/s)^2 0.01"


def test_the_summary_counts_the_rows_that_meet_each_bar() -> None:
    good: Figures = figures_of(IMU, trace_of(said=SAID))
    bad = figures_of(IMU, trace_of())
    rows = [Row(IMU, TOLD_VELOCITY, [good], [good]), Row(IMU, DEFAULT_VELOCITY, [bad], [bad])]
    assert summary(rows) == [("1 lost", "2", "2"), ("2 lies", "2", "2"), ("8 names", "1", "2"), ("all", "1", "2")]


def test_a_section_of_a_document_is_replaced_and_the_others_stay(tmp_path: Path) -> None:
    document = tmp_path / "trust.md"
    replace_section(document, "Bars", "one")
    replace_section(document, "Names", "two\n\n### deeper\n\nthree")
    replace_section(document, "Bars", "four")
    assert document.read_text() == "# Trust\n\n## Bars\n\nfour\n\n## Names\n\ntwo\n\n### deeper\n\nthree\n"


@pytest.fixture
def other_drives(data_folder: Callable[[str], Path]) -> Path:
    """The folder with the drives of the other generator."""
    return data_folder(FOLDER)


def test_drives_of_the_other_generator_are_what_their_files_say(other_drives: Path) -> None:
    """Its own truth, differentiated, feels what its IMU measures; so frames, signs and times are understood."""
    recording = recording_from(other_drives, CLEAN, 2)
    trace = run_one(CLEAN, recording, DEFAULT_VELOCITY)
    settled = trace.seconds > 150.0
    assert trace.error[settled].max() < 1.5
    assert np.degrees(np.abs(trace.heading_error[settled]).max()) < 3.0
    given = Fault("given", Kind.MOTION, given_heading_std_deg=5.0, given_heading_off_deg=25.0)
    found = parameters_of(given, recording, True)
    assert found["alignment.initial_heading_deg"] == pytest.approx(heading_at_start_deg(recording) + 25.0)


@pytest.mark.parametrize("given", [TOLD_VELOCITY, DEFAULT_POSITION], ids=str)
def test_clean_drives_of_the_other_generator_are_complained_of_by_nothing(given: Filter, other_drives: Path) -> None:
    """Two cars that start gently, one of them after 20 s at rest, and tilt while they stand."""
    for seed in range(3):
        trace = run_one(CLEAN, recording_from(other_drives, CLEAN, seed), given)
        assert trace.final == ()
        assert np.abs(trace.heading_error / trace.heading_sigma)[trace.is_known].max() < 5.0


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("one gyro stuck for 40 s", TOLD_VELOCITY),
        ("one accelerometer stuck for 40 s", DEFAULT_POSITION),
        ("holes of 1.6 s, last sample repeated", DEFAULT_POSITION),
        ("stamps in bursts of 4", TOLD_VELOCITY),
        ("velocities stamped 0.13 s late", DEFAULT_VELOCITY),
        ("one gyro axis negated", TOLD_VELOCITY),
    ],
)
def test_faults_of_the_other_generator_blame_no_other_cause(name: str, given: Filter, other_drives: Path) -> None:
    """What does not measure blames no axes, mounting or clocks, uneven stamps and axes no velocities."""
    fault = BY_NAME[name]
    for seed in range(3):
        figures = figures_of(fault, run_one(fault, recording_from(other_drives, fault, seed), given))
        assert figures.wrong == ()
