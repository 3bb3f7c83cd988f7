"""Aids in any order of arrival within the window, from the first sample on: the same bits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from eskf_ros.filter.navigator import Navigator
from eskf_ros.filter.state.enums import CONSTRAINTS, Stream, Verdict
from eskf_ros.geodesy.magnetic_model import FieldUnknown, field_at
from eskf_ros.parameters.mapping import from_mapping
from eskf_ros.simulate.barometer import Barometer
from eskf_ros.simulate.body_velocity import BodyVelocity
from eskf_ros.simulate.dual_antenna import DualAntenna
from eskf_ros.simulate.episodes import MagneticDisturbance
from eskf_ros.simulate.magnetometer import Magnetometer
from eskf_ros.simulate.scenario import START_STAMP, simulate
from eskf_ros.simulate.wheel import WheelOdometer
from eskf_ros.tables.feeding import STREAMS
from monte_carlo import messages_of
from support.aided import offers
from support.kernels import copy_of

SECOND = 1_000_000_000

CASES: dict[str, tuple[Stream, dict[str, Any], dict[str, Any]]] = {
    "heading": (Stream.HEADING, {"dual_antenna": DualAntenna(pitch_std_deg=0.5)}, {}),
    "mag": (
        Stream.MAG,
        {"magnetometer": Magnetometer(hard_iron_std=1e-6, rate=10.0)},
        {"mag.use": True, "mag.declination_deg": 4.3, "estimate.magnetic_bias": True},
    ),
    # With the model of the field, where it is installed: strength and inclination at each fix.
    "mag by the model": (
        Stream.MAG,
        {"magnetometer": Magnetometer(rate=10.0), "episodes": (MagneticDisturbance(12.0, 3.0),)},
        {"mag.use": True},
    ),
    "baro": (Stream.BARO, {"barometer": Barometer(rate=5.0)}, {}),
    # The constraints lie on a grid of stamps between the samples of the IMU, whenever these come.
    "wheel": (Stream.WHEEL, {"wheel": WheelOdometer(rate=10.0)}, {"nhc.enabled": True, "zupt.enabled": True}),
    "body velocity": (Stream.BODY_VELOCITY, {"body_velocity": BodyVelocity(axes="xy", rate=10.0)}, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_arrival_order_changes_no_bit(case: str) -> None:
    stream, sensors, parameters = CASES[case]
    if "model" in case:
        try:
            field_at(48.0, 11.0, 500.0, START_STAMP)
        except FieldUnknown as problem:
            pytest.skip(str(problem))
    recording = simulate("drive", 6, imu_rate=25.0, stop=26.0, **sensors)
    if stream == Stream.WHEEL:
        # What holds at rest needs a heading before the robot moves.
        w, _, _, z = recording.truth_attitude_body_to_map[0]
        parameters = {**parameters, "alignment.initial_heading_deg": math.degrees(2.0 * math.atan2(z, w))}
    settings = from_mapping({**recording.parameters(), "datum": [], **parameters})
    measured = offers(recording)
    for arrival, name, stamp, row in messages_of(recording):
        if name in ("wheel", "body_velocity"):
            measured.append((stamp, STREAMS[name], row[:3], row[3:12], arrival))

    def result(seed: int, delays: tuple[float, float, float]) -> tuple[bytes, bytes]:
        random = np.random.default_rng(seed)
        messages: list[tuple[int, int, int]] = []
        streams = (recording.imu_stamp, recording.fix_stamp, [offer[0] for offer in measured])
        for kind, stamps in enumerate(streams):
            for row, stamp in enumerate(stamps):
                messages.append((int(stamp) + round(random.uniform(0.0, delays[kind]) * SECOND), kind, row))
        navigator = Navigator(settings)
        for _, kind, row in sorted(messages):
            if kind == 0:
                part = slice(row, row + 1)
                arguments = (recording.imu_stamp[part], recording.specific_force[part], recording.angular_rate[part])
                navigator.push_imu(*arguments)
            elif kind == 1:
                place = (recording.fix_latitude_deg, recording.fix_longitude_deg, recording.fix_altitude)
                covariance, stamp = recording.fix_covariance[row], int(recording.fix_stamp[row])
                navigator.push_gnss_position(stamp, *(float(v[row]) for v in place), covariance, 2, 0)
                velocity = recording.velocity_enu[row]
                navigator.push_gnss_velocity(stamp, velocity, recording.velocity_covariance[row])
            else:
                stamp, of_stream, values, covariance, _ = measured[row]
                navigator.push(of_stream, stamp, values, covariance)
        records = navigator.finish()
        # The equality would also hold for a filter that refuses everything.
        fused = {
            kind: np.count_nonzero(records["verdict"][records["stream"] == kind] == Verdict.FUSED) for kind in Stream
        }
        assert fused[stream] > 40
        if stream == Stream.WHEEL:
            assert min(fused[kind] for kind in CONSTRAINTS) > 10
        state = copy_of(navigator.state[0])
        state["imu_next"] = state["aid_next"] = 0
        return state.tobytes(), records.tobytes()

    in_order = result(0, (0.0, 0.0, 0.0))
    for seed in (1, 2):
        assert result(seed, (0.5, 1.9, 1.9)) == in_order
