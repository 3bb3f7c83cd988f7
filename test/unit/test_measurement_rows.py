"""The contract of every measurement: its row is complete, its Jacobian is that of its innovation, its gate is open."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from eskf_ros.bags.messages import message_dtype
from eskf_ros.filter.fuse import linearize
from eskf_ros.filter.history.records import AID
from eskf_ros.filter.inertial.navigation_frame import local_east_north_up_to_ecef
from eskf_ros.filter.measurements import zaru
from eskf_ros.filter.measurements.row import Row
from eskf_ros.filter.rows import CONSTRAINTS, ROWS, SENSORS
from eskf_ros.filter.settings import gate_probability, intakes_from, settings_from
from eskf_ros.filter.state.augmented_states import update_error_size
from eskf_ros.filter.state.enums import CONSTRAINT_INTERVAL, Stream
from eskf_ros.filter.state.error_state import ERROR_SIZE
from eskf_ros.filter.state.memory import allocate
from eskf_ros.filter.tight import pseudorange
from eskf_ros.filter.tight.epoch_least_squares import linearize as linearize_signal
from eskf_ros.filter.tight.signal import CARRIER, MEASURED, NOISE_FACTOR, SATELLITE, SATELLITE_VELOCITY, STD
from eskf_ros.inputs.table import INPUTS
from eskf_ros.parameters.docs import to_markdown, to_yaml
from eskf_ros.parameters.mapping import leaves
from eskf_ros.parameters.tree import Parameters
from support.kernels import make_settings, make_work, random_state, to_rotation, with_error

Array = NDArray[np.float64]

INSTALLATION: dict[str, Any] = {
    "mode": "tight",
    "imu__mount_position": [0.3, 0.1, -0.2],
    "imu__mount_rpy_deg": [10.0, -20.0, 130.0],
    "gnss__lever_arm": [0.8, -0.2, 1.4],
    "wheel__position": [0.4, 0.5, -0.3],
    "nhc__position": [-0.4, 0.1, -0.5],
    "body_velocity__mount_position": [0.2, 0.1, -0.4],
    "body_velocity__mount_rpy_deg": [5.0, -3.0, 40.0],
    "baro__position": [0.5, -0.3, 0.6],
    "heading__offset_std_deg": 2.0,
    "estimate__mounting": True,
    "estimate__wheel_scale": True,
    "estimate__magnetic_bias": True,
    "estimate__lever_arm": True,
    "estimate__time_offset": True,
    "estimate__imu_scale": True,
    "estimate__nhc_position": True,
    "zupt__enabled": True,
    "nhc__enabled": True,
}
"""Every sensor off the origin and turned, every augmented state in use."""

VALUES: dict[Stream, tuple[float, float, float]] = {
    Stream.GNSS_POSITION: (0.84, 0.2, 600.0),
    Stream.BARO: (95_000.0, 0.0, 0.0),
}
"""What a message may say, where (1, 0.5, 0.2) would be absurd."""

STRENGTH, INCLINATION = 4.8e-5, 1.1
"""The Earth's magnetic field (T, rad); the declination is zero."""

STEPS = np.repeat([1.0, 0.5, 1e-5, 0.1, 1e-4], 3)
"""Steps of the differences: m, m/s, rad, m/s2, rad/s."""

AUGMENTED_STEP = 1e-3
"""Step of the augmented states: m, rad, or a factor."""

MAGNETIC_STEP = 1e-9
"""Step of the field of the vehicle (T)."""

names = [row.stream.name.lower() for row in ROWS]


def prepared(seed: int, settings: Any) -> Any:
    """A state that stands on a grid point at rest with a certain heading, all augmented states in use."""
    state = random_state(seed, 20e3)
    state["covariance"][:15, :15] = np.diag(np.repeat([1.0, 0.01, 1e-4, 0.01, 1e-6], 3))
    update_error_size(state, int(settings["reach"].max()), settings)
    stamp = 100 * CONSTRAINT_INTERVAL
    # The block is that of a robot at rest, whose gyros read their bias and the turn of the Earth.
    rest, readings = state["rest"], np.concatenate([state["specific_force"], np.array(zaru.predict(state)) + 5e-4])
    state["stamp"] = state["imu"]["stamp"] = rest["block_end"] = rest["resting_stamp"] = stamp
    state["imu"]["interval"] = 0.01
    rest["block_count"], rest["block_half_count"] = 10, 5
    rest["block_sum"], rest["block_half_sum"], rest["block_square_sum"] = 10 * readings, 5 * readings, 10 * readings**2
    state["mag"]["field_known"], state["mag"]["strength"], state["mag"]["inclination"] = 1, STRENGTH, INCLINATION
    return state


def earth_field(state: Any, settings: Any) -> Array:
    """What the magnetometer reads (T) when the state is true: its Jacobian is that at the Earth's field."""
    east_north_up = STRENGTH * np.array([0.0, math.cos(INCLINATION), -math.sin(INCLINATION)])
    ecef = np.array(local_east_north_up_to_ecef(state)) @ east_north_up
    body = to_rotation(state["attitude"]).inv().apply(state["frame"]["map_to_ecef"].T @ ecef)
    return np.asarray(settings["mag"]["sensor_to_imu"].T @ body)


def offered(row: Row, state: Any, settings: Any) -> Any:
    """A message of this measurement as the timeline holds it."""
    aid = allocate(AID)[0]
    aid["stream"], aid["stamp"] = row.stream, state["stamp"]
    payload = aid["payload"]
    payload[:3] = VALUES.get(row.stream, (1.0, 0.5, 0.2))
    payload[3], payload[6], payload[8] = 0.04, 0.09, 0.01
    if row.stream == Stream.MAG:
        payload[:3] = earth_field(state, settings)
    if row.stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE):
        frame = state["frame"]
        place = frame["origin_ecef"] + frame["map_to_ecef"] @ state["position_map"]
        payload[:] = 0.0
        payload[SATELLITE : SATELLITE + 3] = place * 4.0 + np.array([3e6, -2e6, 1e6])
        payload[SATELLITE_VELOCITY : SATELLITE_VELOCITY + 3] = (1000.0, -2500.0, 1500.0)
        payload[MEASURED], payload[STD] = 2e7, 1.0
        payload[CARRIER], payload[NOISE_FACTOR] = 1.57542e9, 1.0
    return aid


def innovation_and_jacobian(row: Row, state: Any, aid: Any, settings: Any) -> tuple[Array, Array]:
    work = make_work()
    function = linearize_signal if row.stream in (Stream.PSEUDORANGE, Stream.RANGE_RATE) else linearize
    size = function(state, aid, settings, work)
    assert size > 0, "it says nothing in a state in which it should"
    return np.array(work["innovation"][:size]), np.array(work["jacobian"][:size, : state["error_size"]])


def moved_by(state: Any, j: int, sign: float, settings: Any) -> tuple[Any, float]:
    """The state that is true when it is in error by a step in error ``j``, and the step."""
    if j < ERROR_SIZE:
        step = float(STEPS[j])
        return with_error(state, sign * step * np.eye(ERROR_SIZE)[j]), step
    step = MAGNETIC_STEP if j >= settings["magnetic_bias_at"] else AUGMENTED_STEP
    moved = with_error(state, np.zeros(ERROR_SIZE))
    moved["optional"][j - ERROR_SIZE] += sign * step
    return moved, step


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("row", ROWS, ids=names)
def test_jacobian_is_that_of_the_innovation(row: Row, seed: int) -> None:
    """An error e of the state changes the innovation z - h by -H e, augmented states included."""
    settings = make_settings(**INSTALLATION)
    state = prepared(seed, settings)
    aid = offered(row, state, settings)
    _, jacobian = innovation_and_jacobian(row, state, aid, settings)
    for j in range(int(state["error_size"])):
        found = []
        for sign in (1.0, -1.0):
            moved, step = moved_by(state, j, sign, settings)
            found.append(innovation_and_jacobian(row, moved, aid, settings)[0] / (2.0 * step))
        scale = max(1.0, float(np.abs(jacobian).max()))
        np.testing.assert_allclose(
            found[1] - found[0], jacobian[:, j], rtol=2e-3, atol=2e-4 * scale, err_msg=f"error {j}"
        )


@pytest.mark.parametrize("row", ROWS, ids=names)
def test_gate_lets_good_measurements_pass(row: Row) -> None:
    assert 0.5 < gate_probability(row, Parameters()) < 1.0
    assert (settings_from(Parameters())["gate"][0, row.stream, 1:] > 1.0).all()


@pytest.mark.parametrize("row", ROWS, ids=names)
def test_parameters_are_documented_and_its_place_is_one(row: Row) -> None:
    assert row.label
    parameters = {leaf.name for leaf in leaves()}
    own = {name for name in parameters if name.startswith(f"{row.parameters}.")}
    assert own
    markdown, text = to_markdown(), to_yaml()
    for name in own:
        assert f"`{name}`" in markdown
        assert f"{name.split('.')[1]}:" in text
    if row.place is not None:
        assert {row.place.position, row.place.rotation} - {""} <= parameters


@pytest.mark.parametrize("row", SENSORS, ids=lambda row: row.name)
def test_it_is_reachable_from_each_of_its_messages(row: Row) -> None:
    (kind,) = [kind for kind in INPUTS if kind.stream == row.stream]
    assert getattr(Parameters().topics, row.name) == row.topic
    assert row.stream in intakes_from(Parameters())
    for name in row.types:
        assert name in kind.types
        messages = np.zeros(3, message_dtype(name))
        assert row.read is not None
        values, covariances = row.read(messages)
        assert values.shape == (3, 3)
        assert covariances.shape == (3, 9)


@pytest.mark.parametrize("row", CONSTRAINTS, ids=lambda row: row.name)
def test_constraints_follow_their_switch(row: Row) -> None:
    assert row.is_enabled is not None
    assert row.is_enabled(Parameters()) == bool(settings_from(Parameters())["constrains"][0, row.stream])
    assert make_settings(**INSTALLATION)["constrains"][row.stream] == 1


def test_there_is_a_row_for_each_stream() -> None:
    assert {row.stream for row in ROWS} == set(Stream) - {Stream.IMU}
    assert pseudorange.ROW in ROWS
