"""The filter is as wrong as it says: NEES and NIS over many simulated drives, and what it is better than.

Everything uses fixed seeds. The bounds of the share of epochs in the band are not those of the whole proof, which is
`benchmark/consistency.py` with its 1000 runs: errors of neighbouring epochs are alike, biases hardly change, so that
with few runs the share of a perfect filter scatters (docs/consistency.md says how much).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from eskf_ros.filter import fuse, loop, predict, settings
from eskf_ros.filter.history.records import AID, IMU
from eskf_ros.filter.layout import WORK
from eskf_ros.filter.measurements import kalman_update
from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import Stream
from eskf_ros.filter.state.error_state import ACCEL_BIAS, GYRO_BIAS
from eskf_ros.filter.state.memory import allocate
from eskf_ros.geodesy.rotation import to_matrix
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.scenario import SCENARIOS, Recording, simulate
from monte_carlo import (
    BLOCKS,
    NO_REST,
    NO_SIDE_SLIP,
    Ensemble,
    ensemble,
    feed,
    mean_band,
    messages_of,
    share_in_band,
    state_error,
)
from support.kernels import core

RUNS = 30
LOWEST_SHARE = 0.6
"""Below this falls less than one in a hundred ensembles of as many runs of a perfectly consistent filter."""

SETTLED = 60.0
"""From here on (s) nothing is left of the cautious guesses of the start-up."""

TUNNEL_END = 170.0


@lru_cache(maxsize=4)
def default_ensemble(name: str) -> Ensemble:
    return ensemble(name, range(RUNS), interval=1.0)


def horizontal_error(runs: Ensemble, epochs: Any) -> np.ndarray:
    """Squared horizontal position error (m2) at the chosen epochs, (runs, epochs)."""
    return np.asarray((runs.error[:, epochs, :2] ** 2).sum(axis=-1))


def horizontal_variance(runs: Ensemble, epochs: Any) -> np.ndarray:
    """What the filter says its square is, (runs, epochs)."""
    return np.asarray(runs.covariance[:, epochs, 0, 0] + runs.covariance[:, epochs, 1, 1])


def root_mean(values: np.ndarray) -> float:
    return float(np.sqrt(values.mean()))


def inconsistencies(runs: Ensemble) -> list[str]:
    """Name the blocks whose NEES says that the covariance is wrong."""
    settled = runs.seconds >= SETTLED
    found = []
    for name, block in BLOCKS.items():
        degrees = block.stop - block.start
        nees = runs.nees[name][:, settled]
        share = share_in_band(nees, degrees)
        # Runs are independent of each other, the epochs of one run are not.
        of_run = nees.mean(axis=1)
        deviation = (of_run.mean() - degrees) / (of_run.std(ddof=1) / math.sqrt(len(of_run)))
        if share < LOWEST_SHARE or abs(deviation) > 3.0:
            found.append(f"{name}: mean {of_run.mean():.2f} ({deviation:+.1f} sigma), {share:.0%} in band")
    return found


@pytest.mark.parametrize("name", ["drive", "tunnel_drive"])
def test_nees_is_that_of_the_covariance(name: str) -> None:
    assert inconsistencies(default_ensemble(name)) == []


@pytest.mark.parametrize(
    ("wrong", "block"),
    [
        ({"gnss.covariance_scale": 0.6}, "position"),
        ({"gnss.covariance_scale": 1.6}, "velocity"),
        ({"imu.gyro_bias_random_walk": 4e-7}, "gyro bias"),
        ({"imu.accel_noise_density": 3e-3}, "velocity"),
    ],
)
def test_a_wrong_noise_model_does_not_pass_as_consistent(wrong: dict[str, float], block: str) -> None:
    """The check above has teeth."""
    found = inconsistencies(ensemble("tunnel_drive", range(15), wrong, interval=1.0))
    assert any(line.startswith(block) for line in found), found


@pytest.mark.parametrize("stream", ["gnss_position", "gnss_velocity"])
@pytest.mark.parametrize("name", ["drive", "tunnel_drive"])
def test_mean_nis_is_that_of_chi_square(name: str, stream: str) -> None:
    """One part in a hundred: a measurement noise wrong by 3 % fails."""
    nis = default_ensemble(name).nis[stream]
    low, high = mean_band(3, len(nis), 0.999)
    assert low < nis.mean() < high


def test_error_grows_with_the_time_between_fixes_as_the_covariance_says() -> None:
    errors = []
    for interval in (1.0, 5.0, 20.0):
        # A known heading: what is compared is the navigation, not what little slow fixes tell about the start.
        known = {"alignment.initial_heading_deg": SCENARIOS["drive"].heading_deg}
        runs = ensemble("drive", range(8), known, interval=1.0, gnss_rate=1.0 / interval)
        epochs = runs.seconds >= SETTLED
        error = root_mean(horizontal_error(runs, epochs))
        assert error == pytest.approx(root_mean(horizontal_variance(runs, epochs)), rel=0.2)
        errors.append(error)
    assert errors[1] > 1.3 * errors[0]
    assert errors[2] > 1.3 * errors[1]


@pytest.mark.parametrize("interval", [5.0, 10.0, 20.0])
def test_rare_fixes_do_not_spoil_the_start(interval: float) -> None:
    """The robot drives off between two fixes; what it feels then is not gravity, however slowly it gathers speed."""
    runs = ensemble("drive", range(6), interval=1.0, gnss_rate=1.0 / interval)
    settled = runs.seconds >= SETTLED
    assert runs.nees["all 15"][:, settled].mean() < 18.0
    assert root_mean(horizontal_error(runs, settled)) < 1.3 * root_mean(horizontal_variance(runs, settled))


def test_without_bias_estimation_the_tunnel_costs_several_times_more() -> None:
    """What the filter learns of the biases before the tunnel is what carries it through.

    With a tactical grade IMU, with which a filter without bias states still navigates while there are fixes. Equal
    errors would mean that bias states do nothing.
    """
    off = {f"imu.{sensor}_bias_{kind}": 0.0 for sensor in ("accel", "gyro") for kind in ("std", "random_walk")}
    errors = []
    for changes in ({}, off):
        runs = ensemble("tunnel_drive", range(8), changes, interval=1.0, grade="tactical")
        errors.append(root_mean(horizontal_error(runs, runs.seconds == TUNNEL_END)))
    assert errors[1] > 4.0 * errors[0]


class FrozenGain:
    """A complementary filter: the estimator's own prediction and innovations, and gains that never change.

    It starts from a converged estimator with the gains of its next fix. They are kept in map axes, also those of the
    biases, which live in body axes: the directions in which GNSS corrects do not turn with the robot.
    """

    def __init__(self, recording: Recording, state: Any, parameters: Any) -> None:
        self.recording = recording
        self.state = state
        self.settings = settings.settings_from(parameters)[0]
        self.work = allocate(WORK)[0]
        self.sample = allocate(IMU)[0]
        self.next_imu = int(np.searchsorted(recording.imu_stamp, state["imu"]["stamp"])) + 1
        self.next_fix = int(np.searchsorted(recording.fix_stamp, state["stamp"]))
        self.gains: dict[Stream, np.ndarray] = {}

    def run_to(self, stamp: int) -> None:
        """Use IMU and GNSS in the order of their stamps up to ``stamp``."""
        recording = self.recording
        while self.next_imu < len(recording.imu_stamp) and recording.imu_stamp[self.next_imu] <= stamp:
            i = self.next_imu
            self.sample["stamp"] = recording.imu_stamp[i]
            self.sample["specific_force"] = recording.specific_force[i]
            self.sample["angular_rate"] = recording.angular_rate[i]
            while (
                self.next_fix < len(recording.fix_stamp) and recording.fix_stamp[self.next_fix] < self.sample["stamp"]
            ):
                fix_stamp = int(recording.fix_stamp[self.next_fix])
                predict.propagate(
                    self.state, fix_stamp, self.sample, int(self.sample["stamp"]), self.settings, self.work
                )
                self.correct(self.next_fix)
                self.next_fix += 1
            sample_stamp = int(recording.imu_stamp[i])
            predict.propagate(self.state, sample_stamp, self.sample, sample_stamp, self.settings, self.work)
            loop.take_sample(self.state, self.sample, sample_stamp)
            self.next_imu += 1

    def correct(self, k: int) -> None:
        recording = self.recording
        six = np.array([0, 1, 2, 4, 5, 8])
        geodetic = (
            math.radians(recording.fix_latitude_deg[k]),
            math.radians(recording.fix_longitude_deg[k]),
            recording.fix_altitude[k],
        )
        for stream, values, covariance in (
            (Stream.GNSS_POSITION, geodetic, recording.fix_covariance[k]),
            (Stream.GNSS_VELOCITY, recording.velocity_enu[k], recording.velocity_covariance[k]),
        ):
            aid = allocate(AID)[0]
            aid["stream"] = stream
            aid["payload"][:9] = np.concatenate([values, covariance[six]])
            fuse.linearize(self.state, aid, self.settings, self.work)
            body_to_map = np.array(to_matrix(tuple(self.state["attitude"])))
            if stream not in self.gains:
                self.gains[stream] = self.optimal_gain(body_to_map)
            correction = self.gains[stream] @ self.work["innovation"]
            for block in (ACCEL_BIAS, GYRO_BIAS):
                correction[block : block + 3] = body_to_map.T @ correction[block : block + 3]
            self.work["correction"][:15] = correction
            kalman_update.update_nominal_state(self.state, self.work["correction"])

    def optimal_gain(self, body_to_map: np.ndarray) -> np.ndarray:
        """The Kalman gain of what was just linearised, (15, 3), the rows of the biases in map axes."""
        covariance, jacobian = core(self.state), self.work["jacobian"][:, :15]
        spread = jacobian @ covariance @ jacobian.T + self.work["noise"]
        gain = np.linalg.solve(spread, jacobian @ covariance).T
        # As the estimator does, so that the velocity of the same epoch finds the position already used.
        covariance -= gain @ jacobian @ covariance
        for block in (ACCEL_BIAS, GYRO_BIAS):
            gain[block : block + 3] = body_to_map @ gain[block : block + 3]
        return np.asarray(gain)


def test_a_gain_frozen_after_convergence_is_worse_through_a_tunnel_and_after_it() -> None:
    """What the Kalman filter does that a complementary filter does not: it knows how certain it is, and of what.

    Would fail if the estimator's covariance had no bearing on its gain. The first two minutes after the freeze show
    that the opponent is not a straw man: its position is as good.
    """
    frozen_at, tunnel = 100.0, (215.0, 260.0)
    errors: dict[float, list[tuple[np.ndarray, np.ndarray]]] = {}
    for seed in range(8):
        # Without latency the two see the same: the opponent works in the order of stamps.
        recording = simulate("drive", seed, imu_rate=50.0, outages=(tunnel,), latency=(0.0, 0.0))
        parameters = from_mapping({**recording.parameters(), **NO_SIDE_SLIP, **NO_REST})
        estimator = Navigator(parameters)
        frozen = None
        stops = np.arange(round(frozen_at * 50) - 1, len(recording.imu_stamp), 250)
        for i, state in feed(recording, estimator, stops):
            if frozen is None:
                frozen = FrozenGain(recording, estimator.state[0], parameters)
            frozen.run_to(int(recording.imu_stamp[i]))
            truth = int(np.searchsorted(recording.truth_stamp, recording.imu_stamp[i]))
            pair = (state_error(recording, i, truth, state), state_error(recording, i, truth, frozen.state))
            errors.setdefault((i + 1) / 50, []).append(pair)

    def ratio(first: float, last: float, block: slice) -> float:
        """Root mean square error from ``first`` to ``last`` s: frozen over full."""
        chosen = np.array([pairs for seconds, pairs in errors.items() if first <= seconds <= last])[..., block]
        return root_mean(chosen[:, :, 1] ** 2) / root_mean(chosen[:, :, 0] ** 2)

    horizontal, heading = slice(0, 2), slice(8, 9)
    assert ratio(frozen_at, tunnel[0] - 1.0, horizontal) < 1.1
    assert ratio(tunnel[0] - 20.0, tunnel[0], heading) > 2.0
    assert ratio(tunnel[1] - 15.0, tunnel[1], horizontal) > 1.2
    assert ratio(tunnel[1] + 5.0, tunnel[1] + 20.0, horizontal) > 5.0


def test_a_parked_robot_does_not_grow_certain_of_the_heading_it_was_given() -> None:
    """Ten minutes of noise show no heading: what was given to 10 degrees stays known to 10 degrees.

    Would fail with the measured force in the dynamics of the error, or with an attitude error that tips at each update.
    """
    given_std = 10.0
    recording = simulate("parked", 3, imu_rate=50.0, stop=600.0)
    for told in (True, False):
        parameters = {
            name: value for name, value in recording.parameters().items() if told or not name.endswith("noise_density")
        }
        parameters["alignment.initial_heading_deg"] = SCENARIOS["parked"].heading_deg + given_std
        parameters["alignment.initial_heading_std_deg"] = given_std
        navigator = Navigator(from_mapping(parameters))
        for _, state in feed(recording, navigator, np.array([len(recording.imu_stamp) - 1])):
            assert state["heading_known"]
            assert math.degrees(math.sqrt(core(state)[8, 8])) == pytest.approx(given_std, rel=0.05)


@pytest.mark.parametrize("with_velocity", [False, True])
def test_a_heading_that_is_known_to_40_degrees_becomes_certain_and_right(with_velocity: bool) -> None:
    """Errors of up to 80 degrees, as often as such a standard deviation has them: never beyond 5 of them.

    Would fail if the errors of position and velocity did not turn with the heading that is corrected, or their
    corrections were injected in axes that stay: the largest is 19 then (8 with velocities), the mean square 12 (3).
    """
    given_std = 40.0
    squares = []
    for k in range(16):
        recording = simulate("drive", 20 + k, imu_rate=100.0, stop=75.0)
        messages = [m for m in messages_of(recording) if with_velocity or m[1] != "gnss_velocity"]
        parameters = {
            **recording.parameters(),
            "alignment.initial_heading_deg": SCENARIOS["drive"].heading_deg + given_std * norm.ppf((k + 0.5) / 16.0),
            "alignment.initial_heading_std_deg": given_std,
        }
        navigator = Navigator(from_mapping(parameters))
        for i, state in feed(recording, navigator, np.arange(1499, 7400, 50), messages):
            assert state["heading_known"]
            truth = int(np.searchsorted(recording.truth_stamp, recording.imu_stamp[i]))
            squares.append(state_error(recording, i, truth, state)[8] ** 2 / core(state)[8, 8])
    assert np.max(squares) < 25.0
    assert np.mean(squares) < 1.5


@pytest.mark.parametrize("with_velocity", [False, True])
def test_on_the_motorway_the_course_corrects_a_given_heading_that_is_wrong_and_nothing_else_does(
    with_velocity: bool,
) -> None:
    """Straight on at 33 m/s: 25 degrees off as 5 are corrected within a minute; what is honest is left as it is.

    Would fail without the course, or if GNSS corrected a heading that no acceleration shows: its error grows with the
    bias of the gyro, and the standard deviation must grow with it.
    """
    recording = simulate("straight:33", 4, imu_rate=50.0, stop=300.0)
    messages = [m for m in messages_of(recording) if with_velocity or m[1] != "gnss_velocity"]
    for off, seconds in ((25.0, 60.0), (-4.0, 300.0)):
        parameters = {
            **recording.parameters(),
            "alignment.initial_heading_deg": SCENARIOS["motorway"].heading_deg + off,
            "alignment.initial_heading_std_deg": 5.0,
        }
        navigator = Navigator(from_mapping(parameters))
        stops = np.arange(49, round(50.0 * seconds), 50)
        for i, state in feed(recording, navigator, stops, messages):
            truth = int(np.searchsorted(recording.truth_stamp, recording.imu_stamp[i]))
            error = abs(state_error(recording, i, truth, state)[8])
            std = math.sqrt(core(state)[8, 8])
        assert error < 3.0 * std
        if off == 25.0:
            assert math.degrees(error) < 15.0
        else:
            # Without velocities a levelling that takes the even motion for rest may have told the bias.
            drift = 300.0 * recording.parameters()["imu.gyro_bias_std"] if with_velocity else 0.0
            assert std > 0.9 * math.hypot(math.radians(5.0), drift)
