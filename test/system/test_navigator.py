"""The navigator at its door and on its way up the ladder: bad input, start-up, holes in the data."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eskf_ros.filter.fuse import offer
from eskf_ros.filter.history.records import AID, RECORD
from eskf_ros.filter.history.timeline import EARLY_AIDS
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.output.global_odometry import ODOMETRY
from eskf_ros.filter.settings import settings_from
from eskf_ros.filter.state.enums import Status, Stream, Verdict
from eskf_ros.filter.state.memory import allocate
from eskf_ros.geodesy.earth import ecef_to_geodetic
from eskf_ros.gnss.measurements import MEASURED_SIGNAL
from eskf_ros.gnss.ranges import CODE_VALID
from eskf_ros.gnss.ranges import Status as RangeStatus
from eskf_ros.gnss.signals import Gnss
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.parameters.tree import Parameters
from eskf_ros.simulate.scenario import Recording, simulate
from support.kernels import core

SECOND = 1_000_000_000
GOOD_COVARIANCE = np.diag([1.0, 1.0, 4.0]).ravel()


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate("drive", seed=1, imu_rate=100.0, start=12.0, stop=52.0)


def run(recording: Recording, hole: tuple[float, float] = (0.0, 0.0), gnss_from: float = 0.0, **parameters: object):
    """Give a recording in stamp order; IMU samples inside ``hole`` (s from the start) are missing."""
    navigator = Navigator(from_mapping({**recording.parameters(), **parameters}))
    rows = []
    start = int(recording.imu_stamp[0])
    first = 0
    for epoch, stamp in enumerate([*recording.fix_stamp, recording.imu_stamp[-1]]):
        last = int(np.searchsorted(recording.imu_stamp, stamp, side="right"))
        seconds = (recording.imu_stamp[first:last] - start) / SECOND
        kept = slice(first, last) if not hole[1] else first + np.flatnonzero((seconds < hole[0]) | (seconds > hole[1]))
        rows.append(
            navigator.push_imu(recording.imu_stamp[kept], recording.specific_force[kept], recording.angular_rate[kept])
        )
        first = last
        if (stamp - start) / SECOND < gnss_from or epoch == len(recording.fix_stamp):
            continue
        navigator.push_gnss_position(
            int(stamp),
            float(recording.fix_latitude_deg[epoch]),
            float(recording.fix_longitude_deg[epoch]),
            float(recording.fix_altitude[epoch]),
            recording.fix_covariance[epoch],
            2,
            0,
        )
        navigator.push_gnss_velocity(int(stamp), recording.velocity_enu[epoch], recording.velocity_covariance[epoch])
    return navigator, np.concatenate(rows)


def truth_at(recording: Recording, rows: np.ndarray, field: str) -> np.ndarray:
    return getattr(recording, field)[np.searchsorted(recording.truth_stamp, rows["stamp"])]


def on_truth(recording: Recording, rows: np.ndarray) -> np.ndarray:
    return rows[np.isin(rows["stamp"], recording.truth_stamp)]


def test_the_ladder_is_climbed_in_order(recording):
    _, rows = run(recording, gnss_from=4.0)
    climbed = [Status(int(status)) for status in rows["status"][np.r_[True, np.diff(rows["status"]) != 0]]]
    assert climbed[:2] == [Status.WAITING_FIX, Status.WAITING_HEADING]
    assert climbed[2] == Status.ALIGNING
    assert climbed[-1] == Status.GOOD
    # Published from the start of levelling: no row before the attitude is level.
    assert rows["stamp"][0] > recording.imu_stamp[0] + 1.9 * SECOND


def test_while_heading_is_unknown_position_is_fused_and_yaw_variance_is_a_half_turn(recording):
    _, rows = run(recording)
    waiting = on_truth(recording, rows[rows["status"] == Status.WAITING_HEADING])
    assert len(waiting) > 100
    assert np.allclose(np.sqrt(waiting["pose_covariance"][:, 5, 5]), math.pi, rtol=1e-3)
    settled = waiting[100:]
    error = settled["position_map"] - truth_at(recording, settled, "truth_position_map")
    sigma = np.sqrt(np.einsum("nii->ni", settled["pose_covariance"])[:, :3])
    assert np.all(np.abs(error) < 4.0 * sigma)
    # Honest is not the same as useless.
    assert np.median(sigma) < 2.0


def test_a_long_lever_arm_of_unknown_heading_is_no_error_that_lasts():
    """Fixes change from one to the next as they claim, wherever the antenna is."""
    resting = simulate("stand:60", seed=1, imu_rate=100.0, gnss_rate=5.0, lever_arm=(4.0, 0.0, 1.0))
    navigator, _ = run(resting)
    state = navigator.state[0]
    assert state["heading_known"] == 0
    np.testing.assert_allclose(state["scatter"]["claimed"][0], resting.fix_covariance[-1, ::4], rtol=1e-3)
    # 289 pairs in three axes, the running mean of the last fifty: a standard deviation of 0.12.
    assert state["scatter"]["change"][0] == pytest.approx(1.0, abs=0.36)
    assert state["scatter"]["calm"][0] == 0.0


@pytest.mark.parametrize("heading_deg", [None, 35.0])
def test_heading_from_course_or_parameter(recording, heading_deg):
    mapping = {} if heading_deg is None else {"alignment.initial_heading_deg": heading_deg}
    _, rows = run(recording, **mapping)
    known = rows[rows["heading_known"]]
    if heading_deg is not None:
        assert known["stamp"][0] < recording.imu_stamp[0] + 3 * SECOND
    final = on_truth(recording, known)[-1:]
    w, x, y, z = (truth_at(recording, final, "truth_attitude_body_to_map")[0, i] for i in range(4))
    true_heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    w, x, y, z = final["attitude_body_to_map"][0]
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    error = math.remainder(heading - true_heading, 2 * math.pi)
    assert abs(error) < 4 * math.sqrt(final["pose_covariance"][0, 5, 5])
    assert abs(error) < math.radians(3.0)


def test_start_while_driving_needs_no_stop():
    moving = simulate("drive", seed=2, imu_rate=100.0, start=60.0, stop=110.0)
    assert np.linalg.norm(moving.truth_velocity_map[0]) > 5.0
    _, rows = run(moving)
    assert rows["status"][-1] == Status.GOOD
    last = on_truth(moving, rows)[-500:]
    error = last["position_map"] - truth_at(moving, last, "truth_position_map")
    assert np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))) < 1.0


def test_the_datum_is_the_first_accepted_fix_and_stays(recording):
    navigator, _ = run(recording, datum=[], gnss_from=3.0)
    first = int(np.searchsorted(recording.fix_stamp, recording.imu_stamp[0] + 3 * SECOND))
    assert navigator.datum == pytest.approx(
        (recording.fix_latitude_deg[first], recording.fix_longitude_deg[first], recording.fix_altitude[first]), abs=1e-9
    )


@pytest.mark.parametrize(
    ("hole", "longest_error"), [((30.0, 30.3), 2.0), ((30.0, 32.0), 8.0)], ids=["short hole", "long hole"]
)
def test_a_hole_in_the_imu_data_is_bridged_with_honest_covariance(recording, hole, longest_error):
    _, rows = run(recording, hole=hole)
    after = on_truth(recording, rows[rows["stamp"] > recording.imu_stamp[0] + hole[1] * SECOND])
    error = after["position_map"] - truth_at(recording, after, "truth_position_map")
    variance = np.einsum("nii->ni", after["pose_covariance"])[:, :3]
    assert np.all(np.isfinite(after["position_map"]))
    assert np.abs(error).max() < longest_error
    assert np.mean(error**2 / variance) < 4.0


def test_after_a_silence_too_long_to_bridge_it_starts_again(recording):
    _, rows = run(recording, hole=(26.0, 33.0))
    after = rows[rows["stamp"] > recording.imu_stamp[0] + 33 * SECOND]
    assert after["status"][0] < Status.ALIGNING
    assert after["status"][-1] >= Status.ALIGNING
    known = on_truth(recording, after[after["heading_known"]])
    error = known["position_map"] - truth_at(recording, known, "truth_position_map")
    assert np.abs(error).max() < 3.0


def offer_position(navigator: Navigator, stamp: int, **changes: object) -> None:
    message = {
        "latitude_deg": 48.137,
        "longitude_deg": 11.575,
        "altitude": 565.0,
        "covariance": GOOD_COVARIANCE,
        "covariance_type": 2,
        "status": 0,
    }
    navigator.push_gnss_position(stamp, **{**message, **changes})


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"latitude_deg": math.nan}, Verdict.NON_FINITE),
        ({"altitude": math.inf}, Verdict.NON_FINITE),
        ({"covariance": np.full(9, math.nan)}, Verdict.NON_FINITE),
        ({"covariance": np.diag([1.0, -1.0, 1.0]).ravel()}, Verdict.BAD_COVARIANCE),
        ({"covariance": np.array([1.0, 2.0, 0, 2.0, 1.0, 0, 0, 0, 1.0])}, Verdict.BAD_COVARIANCE),
        ({"latitude_deg": 91.0}, Verdict.BAD_VALUE),
        ({"status": -1}, Verdict.NO_FIX),
        ({"latitude_deg": 48.2}, Verdict.CONTRADICTED),
    ],
)
def test_a_bad_fix_is_named_and_never_touches_the_state(recording, changes, verdict):
    navigator, _ = run(recording)
    navigator.take_records()
    navigator.update()
    before = navigator.state
    offer_position(navigator, int(recording.imu_stamp[-1]) - 1, **changes)
    navigator.update()
    assert navigator.finish()["verdict"][-1] == verdict
    after = navigator.state
    for field in ("position_map", "velocity_map", "attitude", "accel_bias", "gyro_bias"):
        assert np.allclose(after[field], before[field], rtol=0, atol=1e-12), field


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"covariance": np.diag([1.0, -1.0, 1.0]).ravel()}, "covariance that is not positive definite"),
        ({"latitude_deg": math.nan}, "numbers that are not finite"),
        ({"altitude": 1e7}, "values that cannot be true"),
    ],
)
def test_a_stream_that_is_refused_at_the_door_is_named(changes, words):
    """Not for a single message, but when most of them are like this."""
    navigator = Navigator(Parameters())
    for k in range(20):
        offer_position(navigator, SECOND + k, **(changes if k >= 5 else {}))
        assert bool(navigator.complaints) == (k >= 14)
    (complaint,) = navigator.complaints
    assert complaint.startswith("15 of 20 messages of gnss_position ")
    assert words in complaint


@pytest.mark.parametrize("broken", [math.nan, -1.0, math.inf])
def test_a_covariance_that_is_none_is_a_fault(recording, broken):
    navigator, _ = run(recording)
    assert navigator.status == Status.GOOD
    navigator._states["covariance"][0, 7, 7] = broken
    assert navigator.status == Status.FAULT


@pytest.mark.parametrize("stamp", [0, -5])
def test_a_stamp_of_zero_is_refused(recording, stamp):
    navigator, _ = run(recording)
    offer_position(navigator, stamp)
    navigator.push_imu(np.array([stamp]), np.array([[0.0, 0.0, 9.8]]), np.zeros((1, 3)))
    assert navigator.finish()["verdict"][-1] == Verdict.BAD_STAMP
    assert navigator.imu_counts["bad_stamp"] == 1


def test_a_stamp_seconds_away_is_refused(recording):
    navigator, _ = run(recording)
    offer_position(navigator, int(recording.imu_stamp[-1]) + 11 * SECOND)
    offer_position(navigator, int(recording.imu_stamp[-1]) - 11 * SECOND)
    assert navigator.finish()["verdict"][-2:].tolist() == [Verdict.BAD_STAMP, Verdict.OUTSIDE_HISTORY]


@pytest.mark.parametrize("status", [0, 1, 2])
def test_an_unknown_covariance_takes_the_table(recording, status):
    """An all-zero covariance, and NaN declared unknown, have the sigma of the table for their status."""
    stamp = int(recording.imu_stamp[-1]) - 1
    nis = []
    for covariance, covariance_type in ((np.zeros(9), 2), (np.full(9, math.nan), 0), (None, 2)):
        navigator, _ = run(recording)
        navigator.take_records()
        gnss = navigator.parameters.gnss
        if covariance is None:
            horizontal, vertical = gnss.status_std_horizontal[status], gnss.status_std_vertical[status]
            covariance = np.diag([horizontal**2, horizontal**2, vertical**2]).ravel()
        latitude, longitude, altitude = geodetic_of(navigator)
        offer_position(
            navigator,
            stamp,
            latitude_deg=latitude + 5e-6,
            longitude_deg=longitude,
            altitude=altitude,
            covariance=covariance,
            covariance_type=covariance_type,
            status=status,
        )
        navigator.update()
        nis.append(navigator.finish()["nis"][-1])
    assert nis[0] == nis[1] == nis[2]


def geodetic_of(navigator: Navigator) -> tuple[float, float, float]:
    state = navigator.state[0]
    ecef = state["frame"]["origin_ecef"] + state["frame"]["map_to_ecef"] @ state["position_map"]
    latitude, longitude, altitude = ecef_to_geodetic(*ecef)
    return math.degrees(latitude), math.degrees(longitude), altitude


def test_a_floor_lifts_an_over_confident_covariance(recording):
    """Three millimetres reported with a metre of error: with a floor of a metre it is fused, with none it is not."""
    verdicts = []
    for floor in (0.001, 1.0):
        navigator, _ = run(recording, **{"gnss.position_std_floor": floor, "gnss.use_velocity": True})
        navigator.take_records()
        latitude, longitude, altitude = geodetic_of(navigator)
        offer_position(
            navigator,
            int(recording.imu_stamp[-1]) - 1,
            latitude_deg=latitude + 2.5 / 111e3,
            longitude_deg=longitude,
            altitude=altitude,
            covariance=np.diag([9e-6] * 3).ravel(),
        )
        navigator.update()
        verdicts.append(navigator.finish()["verdict"][-1])
    assert verdicts == [Verdict.CONTRADICTED, Verdict.FUSED]


ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=150)
@given(
    values=st.lists(ANY_FLOAT, min_size=3, max_size=3),
    covariance=st.lists(st.one_of(ANY_FLOAT, st.floats(-2.0, 2.0)), min_size=9, max_size=9),
    covariance_type=st.integers(0, 3),
    status=st.integers(-2, 2),
    force=st.lists(ANY_FLOAT, min_size=6, max_size=6),
)
def test_no_message_makes_the_state_non_finite(warm_navigator, values, covariance, covariance_type, status, force):
    """Whatever numbers arrive, what is published stays finite and the covariance positive."""
    navigator = warm_navigator
    stamp = int(navigator.state["imu"]["stamp"][0])
    navigator.push_gnss_position(stamp, *values, covariance, covariance_type, status)
    navigator.push_gnss_velocity(stamp, values, covariance)
    navigator.push_imu(np.array([stamp + 10_000_000]), np.array([force[:3]]), np.array([force[3:]]))
    navigator.push_imu(np.array([stamp + 20_000_000]), np.array([[0.0, 0.0, 9.8]]), np.zeros((1, 3)))
    row = navigator.odometry[0]
    for field in ("position_map", "velocity_map", "attitude_body_to_map", "pose_covariance", "twist_covariance"):
        assert np.all(np.isfinite(row[field])), field
    assert np.linalg.eigvalsh(row["pose_covariance"]).min() > 0.0
    navigator.take_records()


@pytest.fixture(scope="module")
def warm_navigator(recording):
    return run(recording)[0]


def test_shapes_are_what_they_are_said_to_be(recording):
    navigator, rows = run(recording)
    assert rows.dtype == ODOMETRY
    assert navigator.take_records().dtype == RECORD
    assert np.array_equal(rows["pose_covariance"], rows["pose_covariance"].transpose(0, 2, 1))
    assert np.array_equal(rows["twist_covariance"], rows["twist_covariance"].transpose(0, 2, 1))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda force, rate: (force - [0.0, 0.0, 9.8], rate), "removes gravity"),
        (lambda force, rate: (force / 9.80665, rate), "units of g"),
        (lambda force, rate: (force * [1.0, -1.0, -1.0], rate * [1.0, -1.0, -1.0]), "North-East-Down"),
        (lambda force, rate: (force[:, [2, 0, 1]], rate[:, [2, 0, 1]]), "mount_rpy_deg"),
        (lambda force, rate: (force, np.degrees(rate)), "deg/s"),
    ],
)
def test_a_stream_in_the_wrong_unit_or_axes_is_named(change, complaint):
    drive = simulate("drive", seed=1, imu_rate=100.0)
    navigator = Navigator(from_mapping(drive.parameters()))
    force, rate = change(drive.specific_force, drive.angular_rate)
    navigator.push_imu(drive.imu_stamp, force, rate)
    assert [sentence for sentence in navigator.complaints if complaint in sentence]


def test_a_good_stream_has_no_complaint(recording):
    navigator, _ = run(recording)
    assert navigator.complaints == []


@pytest.mark.parametrize("offset", [18.0, -18.0])
def test_clocks_that_differ_are_named_with_the_difference(recording, offset):
    navigator, _ = run(recording, gnss_from=1e9)
    offer_position(navigator, int(recording.imu_stamp[-1]) + round(offset * SECOND))
    direction = "ahead of" if offset > 0.0 else "behind"
    assert [sentence for sentence in navigator.complaints if f"18.0 s {direction}" in sentence]


def test_reset_forgets_everything(recording):
    """After a reset the same messages give the same result as in a new navigator."""
    navigator, _ = run(recording)
    fresh = Navigator(navigator.parameters)
    navigator.reset()
    first = slice(0, 500)
    arguments = (recording.imu_stamp[first], recording.specific_force[first], recording.angular_rate[first])
    assert navigator.push_imu(*arguments).tobytes() == fresh.push_imu(*arguments).tobytes()
    assert navigator.state.tobytes() == fresh.state.tobytes()


def test_a_new_datum_is_the_same_place(recording):
    """The map moves; on the Earth the robot stays where it is, and goes on navigating."""
    navigator, _ = run(recording)
    before, covariance = geodetic_of(navigator), core(navigator.state[0])
    heading_std = math.sqrt(covariance[8, 8])
    assert navigator.set_datum_here()
    assert geodetic_of(navigator) == pytest.approx(before, abs=1e-9)
    assert navigator.datum == pytest.approx(before, abs=1e-9)
    np.testing.assert_allclose(navigator.state["position_map"][0], 0.0, atol=1e-6)
    assert math.sqrt(core(navigator.state[0])[8, 8]) == pytest.approx(heading_std, rel=1e-3)
    # A barrier: what is older is refused, what follows is fused.
    offer_position(navigator, int(recording.imu_stamp[-1]) - SECOND)
    stamp = int(recording.imu_stamp[-1])
    for _ in range(10):
        stamp += 10_000_000
        navigator.push_imu(np.array([stamp]), recording.specific_force[-1:], recording.angular_rate[-1:])
    latitude, longitude, altitude = geodetic_of(navigator)
    offer_position(navigator, stamp - 1, latitude_deg=latitude, longitude_deg=longitude, altitude=altitude)
    verdicts = navigator.finish()["verdict"].tolist()
    assert verdicts[-1] == Verdict.OUTSIDE_HISTORY
    assert verdicts[-2] == Verdict.FUSED


def test_without_a_position_there_is_no_datum_here():
    assert not Navigator(from_mapping({})).set_datum_here()


def test_stamps_in_float_seconds_are_refused_with_the_remedy():
    navigator = Navigator(Parameters())
    with pytest.raises(TypeError, match="int64 nanoseconds"):
        navigator.push_imu(np.array([1.0, 1.01]), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(TypeError, match="int64 nanoseconds"):
        navigator.push_gnss_velocity(1.5, (0.0, 0.0, 0.0), GOOD_COVARIANCE)  # type: ignore[arg-type]
    assert navigator.imu_counts["offered"] == 0


@pytest.mark.parametrize(("force", "rate"), [((3, 3), (2, 3)), ((2, 3), (3,)), ((2, 4), (2, 3))])
def test_imu_arrays_of_another_shape_are_refused_by_name(force: tuple[int, ...], rate: tuple[int, ...]):
    with pytest.raises(ValueError, match=r"(specific_force|angular_rate) has the shape .* 2 stamps need \(2, 3\)"):
        Navigator(Parameters()).push_imu(np.array([1, 2]), np.zeros(force), np.zeros(rate))


def test_a_covariance_is_nine_numbers_or_three_by_three(recording: Recording):
    def pushed(covariance: np.ndarray) -> np.ndarray:
        navigator, _ = run(recording)
        stamp = int(recording.imu_stamp[-1])
        navigator.push_gnss_velocity(stamp, (1.0, 2.0, 0.1), covariance)
        navigator.update()
        return navigator.state

    covariance = np.array([[1.0, 0.2, 0.0], [0.2, 2.0, 0.1], [0.0, 0.1, 4.0]])
    assert pushed(covariance).tobytes() == pushed(covariance.ravel()).tobytes()
    with pytest.raises(ValueError, match="nine numbers"):
        Navigator(Parameters()).push_gnss_velocity(1, (0.0, 0.0, 0.0), np.ones(3))


def test_measurements_dropped_before_the_first_imu_sample_are_said():
    navigator = Navigator(Parameters())
    for k in range(EARLY_AIDS + 3):
        navigator.push_gnss_velocity(SECOND + k, (0.0, 0.0, 0.0), GOOD_COVARIANCE)
    (sentence,) = navigator.complaints
    assert "3 measurements of gnss_velocity were dropped" in sentence
    assert "order of their stamps" in sentence


def test_ranges_dropped_before_the_first_imu_sample_are_said():
    navigator = Navigator(from_mapping({"mode": "tight"}))
    signals = np.zeros(8, MEASURED_SIGNAL)
    signals["status"], signals["flags"], signals["signal"] = RangeStatus.USABLE, CODE_VALID, 0
    signals["gnss_id"], signals["sv_id"] = Gnss.GPS, np.arange(1, 9)
    epochs = EARLY_AIDS // len(signals) + 1
    for k in range(epochs):
        navigator.push_ranges(SECOND + k, (2300, 0.0), signals)
    (sentence,) = navigator.complaints
    assert f"{len(signals)} measurements of pseudorange were dropped" in sentence


def test_a_refused_stamp_is_not_counted():
    navigator = Navigator(Parameters())
    with pytest.raises(TypeError, match="int64 nanoseconds"):
        navigator.push_gnss_velocity(1.5, (0.0, 0.0, 0.0), GOOD_COVARIANCE)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="int64 nanoseconds"):
        navigator.push_ranges(1.5, (2300, 0.0), np.zeros(0, MEASURED_SIGNAL))  # type: ignore[arg-type]
    assert not navigator._traffic.offered


@pytest.mark.parametrize("stream", [stream for stream in Stream if stream != Stream.IMU])
def test_every_stream_has_a_gate(stream: Stream):
    assert (settings_from(Parameters())["gate"][0, stream, 1:] > 0.0).all()


def test_a_stream_without_a_model_is_refused_with_a_record(recording: Recording):
    """Signals of ranges go another way: to `fusion` they are streams of which it knows no model."""
    navigator, _ = run(recording)
    state, aid = navigator._states.copy(), allocate(AID)
    aid["stream"] = Stream.PSEUDORANGE
    before = state["covariance"].copy()
    offer(state, aid[0], 0.0, navigator._settings[0], navigator._work[0])
    assert aid["verdict"][0] == Verdict.DISABLED
    assert np.array_equal(before, state["covariance"])


def test_velocities_that_are_stamped_late_are_put_right(recording: Recording) -> None:
    """With the parameter the filter gives, bit for bit, what it gives with right stamps; the positions stay."""
    late = round(0.13e9)
    rows = []
    for delay, offset in ((0, 0.0), (late, -0.13)):
        given = {**recording.parameters(), "gnss.velocity_time_offset": offset}
        navigator = Navigator(from_mapping(given))
        for k, stamp in enumerate(recording.fix_stamp.tolist()):
            place = recording.fix_latitude_deg[k], recording.fix_longitude_deg[k], recording.fix_altitude[k]
            navigator.push_gnss_position(stamp, *map(float, place), recording.fix_covariance[k], 2, 0)
        for k, stamp in enumerate(recording.velocity_stamp.tolist()):
            velocity, covariance = recording.velocity_enu[k], recording.velocity_covariance[k]
            navigator.push_gnss_velocity(stamp + delay, velocity, covariance)
        rows.append(navigator.push_imu(recording.imu_stamp, recording.specific_force, recording.angular_rate))
    assert len(rows[0]) > 1000
    # By field: the padding between them is nobody's.
    for name in ODOMETRY.names or ():
        np.testing.assert_array_equal(rows[0][name], rows[1][name])


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_fixes_without_altitude_are_used_horizontally(recording: Recording, share: float) -> None:
    """Always or at times: the horizontal error stays, the vertical one is within what its sigma says."""
    rng, errors = np.random.default_rng(5), []
    for missing in (0.0, share):
        navigator = Navigator(from_mapping({**recording.parameters(), "gnss.use_velocity": True}))
        is_flat = rng.random(len(recording.fix_stamp)) < missing
        for k, stamp in enumerate(recording.fix_stamp.tolist()):
            altitude = np.nan if is_flat[k] else float(recording.fix_altitude[k])
            place = float(recording.fix_latitude_deg[k]), float(recording.fix_longitude_deg[k]), altitude
            navigator.push_gnss_position(stamp, *place, recording.fix_covariance[k], 2, 0)
        for k, stamp in enumerate(recording.velocity_stamp.tolist()):
            navigator.push_gnss_velocity(stamp, recording.velocity_enu[k], recording.velocity_covariance[k])
        rows = navigator.push_imu(recording.imu_stamp, recording.specific_force, recording.angular_rate)
        known = rows[rows["position_known"] & rows["heading_known"]]
        truth = recording.truth_position_map[np.searchsorted(recording.truth_stamp, known["stamp"])]
        error = known["position_map"] - truth
        errors.append(float(np.sqrt(np.mean(error[:, :2] ** 2))))
        records = navigator.finish()
        fixes = records[records["stream"] == Stream.GNSS_POSITION]
        assert (fixes["verdict"] == Verdict.FUSED).mean() > 0.9
        assert (np.abs(error[:, 2]) < 4.0 * np.sqrt(known["pose_covariance"][:, 2, 2])).all()
        assert bool(navigator.notes) == (missing > 0.0)
    assert errors[1] < 1.2 * errors[0] + 0.02


def test_fixes_without_altitude_in_any_order(recording: Recording) -> None:
    """The stand-in altitude is a function of the state: a fix that is fused again after a rewind gives the same."""
    final = []
    for is_late in (False, True):
        navigator = Navigator(from_mapping({**recording.parameters(), "datum": [], "history.window": 60.0}))

        def push(fixes: list[int], navigator: Navigator = navigator) -> None:
            for k in fixes:
                place = float(recording.fix_latitude_deg[k]), float(recording.fix_longitude_deg[k]), math.nan
                navigator.push_gnss_position(int(recording.fix_stamp[k]), *place, recording.fix_covariance[k], 2, 0)

        # In parts of 4 s: fixes far ahead of the IMU would be refused.
        for first in range(0, len(recording.imu_stamp), 400):
            part = slice(first, first + 400)
            stamps = recording.imu_stamp[part]
            inside = (recording.fix_stamp >= stamps[0]) & (recording.fix_stamp <= stamps[-1])
            fixes = np.flatnonzero(inside).tolist()
            if not is_late:
                push(fixes)
            navigator.push_imu(stamps, recording.specific_force[part], recording.angular_rate[part])
            if is_late:
                push(fixes[1::2])
                navigator.update()
                push(fixes[::2])
        navigator.update()
        final.append(navigator.state[0])
    assert final[0]["position_known"] == 1
    for name in ("position_map", "velocity_map", "attitude", "covariance", "scatter", "rest"):
        assert final[0][name].tobytes() == final[1][name].tobytes()
