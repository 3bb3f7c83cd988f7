"""Faults of the IMU and of its driver."""

from __future__ import annotations

import math

from campaign.fault import (
    BEGIN,
    DEFAULT_POSITION,
    DEFAULT_VELOCITY,
    END,
    MOVING,
    RATE,
    STOP,
    TOLD_POSITION,
    TOLD_VELOCITY,
    VEHICLES,
    Fault,
    Kind,
)
from eskf_ros.simulate.episodes import ClockSet, Episode
from eskf_ros.simulate.imu_episodes import (
    ImuBias,
    ImuBursts,
    ImuClipping,
    ImuDeformation,
    ImuHoles,
    ImuJitter,
    ImuNoise,
    ImuShocks,
    ImuStuck,
    ImuVibration,
)

FOR_GOOD = math.inf
LENGTH = END - BEGIN

ROUGH = {"vibration": (1.0, 0.05)}
"""What a road does to an IMU: without it a stamp that is wrong costs nothing."""

NOISE = ("IMU noise", "vibration")
STAMPS = ("IMU stamps",)


def _fault(name: str, *episodes: Episode, **more: object) -> Fault:
    return Fault(name, Kind.IMU, episodes, **{"vehicles": VEHICLES, **more})  # type: ignore[arg-type]


def _throughout(name: str, *episodes: Episode, **more: object) -> Fault:
    """What is wrong from the start, as a setting is: what is named is also allowed for, within two minutes."""
    return _fault(name, *episodes, **{"begin": MOVING, "settles": 120.0, **more})


def imu_faults(amplitude: float = 1.0) -> list[Fault]:
    """Return the faults, their sizes times ``amplitude``."""
    a = amplitude
    hole = min(1.6 * a, 9.0)
    noise = ImuNoise(0.0, FOR_GOOD, 5e-4 * a, 6e-3 * a)
    holes = {"end": END, "names": ("IMU holes",), "also": NOISE}
    return [
        *(
            _fault(f"holes of {hole:.3g} s, {what}", ImuHoles(BEGIN, LENGTH, hole, 10.0, filled), **holes)
            for filled, what in (("no", "dropped"), ("lines", "bridged by lines"), ("repeats", "last sample repeated"))
        ),
        *_stamps(a),
        _throughout(
            f"{10 * a:.3g} times the noise",
            noise,
            names=NOISE,
            filters=(TOLD_VELOCITY, TOLD_POSITION),
            vehicles=(),
        ),
        _throughout(
            f"{10 * a:.3g} times the noise, within the defaults",
            noise,
            also=NOISE,
            filters=(DEFAULT_VELOCITY, DEFAULT_POSITION),
        ),
        _fault(
            f"gyro bias step {a:.3g} deg/s", ImuBias(BEGIN, FOR_GOOD, (0.0, 0.0, a)), names=("IMU bias",), also=NOISE
        ),
        _fault(
            f"accelerometer bias step {0.3 * a:.3g} m/s2",
            ImuBias(BEGIN, FOR_GOOD, (0.0, 0.0, 0.0), (0.3 * a, 0.0, 0.0)),
            names=("IMU bias",),
            also=NOISE,
        ),
        _fault(
            f"gyro bias ramp {0.5 * a:.3g} deg/s in 400 s",
            ImuBias(BEGIN, FOR_GOOD, (0.0, 0.0, 0.5 * a), rise=400.0),
            names=("IMU bias",),
            also=NOISE,
        ),
        _throughout(
            f"scale {1.5 * a:.3g} %",
            ImuDeformation(0.0, FOR_GOOD, 0.015 * a, 0.015 * a),
            names=("IMU scale",),
            also=NOISE,
        ),
        _throughout(
            f"misalignment {a:.3g} deg",
            ImuDeformation(0.0, FOR_GOOD, gyro_rpy_deg=(a, -a, a)),
            also=("IMU scale", "IMU axes", *NOISE),
        ),
        _throughout(
            f"g-sensitivity {0.1 * a:.3g} deg/s per g",
            ImuDeformation(0.0, FOR_GOOD, g_sensitivity=0.1 * a),
            also=("IMU scale", "IMU bias", *NOISE),
        ),
        _fault(
            f"rates clipped at {0.2 / a:.3g} rad/s",
            ImuClipping(BEGIN, FOR_GOOD, rate=0.2 / a),
            names=("clipping",),
            also=NOISE,
        ),
        _fault(
            f"vibration {15 * a:.3g} m/s2, clipped at 2 g",
            ImuVibration(BEGIN, FOR_GOOD, 0.05 * a, 15.0 * a),
            ImuClipping(BEGIN, FOR_GOOD, force=19.6),
            names=("clipping",),
            also=NOISE,
        ),
        _fault(
            f"shocks of {100 * a:.3g} m/s2, {8 * a:.3g} rad/s",
            ImuShocks(BEGIN, LENGTH, 8.0 * a, 100.0 * a),
            end=END,
            also=("shocks", "clipping", *NOISE),
        ),
        _fault(
            f"vibration {a:.3g} m/s2, {0.05 * a:.3g} rad/s",
            ImuVibration(BEGIN, FOR_GOOD, 0.05 * a, a),
            also=NOISE,
        ),
        _fault("one gyro stuck for 40 s", ImuStuck(BEGIN, LENGTH), end=END, also=("IMU stuck", "IMU bias", *NOISE)),
        _fault(
            "one accelerometer stuck for 40 s",
            ImuStuck(BEGIN, LENGTH, "accel", "x"),
            end=END,
            also=("IMU stuck", "IMU bias", *NOISE),
        ),
        *_rates(),
    ]


def _stamps(a: float) -> list[Fault]:
    """Stamps that scatter, come in bursts or in pairs, and clocks that are set."""
    jitters = [(0.001, 0.0), (0.003, 0.0), (0.0, 0.001), (0.0, 0.003)]
    jittered = [
        _throughout(
            f"stamps jittered by {1e3 * std * a:.3g} ms, late by {1e3 * late * a:.3g} ms",
            ImuJitter(0.0, FOR_GOOD, std * a, late * a),
            options=ROUGH,
            names=STAMPS,
        )
        for std, late in jitters
    ]
    bursts = [
        _throughout(f"stamps in bursts of {count}", ImuBursts(0.0, FOR_GOOD, count), options=ROUGH, names=STAMPS)
        for count in (2, 4, 10)
    ]
    clocks = [
        _fault(
            f"clock set by {step * a:+.3g} s for the rest",
            ClockSet(BEGIN, FOR_GOOD, step * a),
            names=("clock set",),
            also=("clocks apart", *NOISE),
        )
        for step in (-0.5, -10.0, 0.5, 10.0)
    ]
    pairs = _throughout("pairs with one stamp", ImuBursts(0.0, FOR_GOOD, 2, 0.0), names=("IMU stamps", "same stamps"))
    return [*jittered, *bursts, pairs, *clocks]


def _rates() -> list[Fault]:
    """Other rates of the IMU than the usual one: the slow ones need another setting, and are told so."""
    return [
        Fault(
            f"IMU at {rate:g} Hz",
            Kind.IMU,
            options={"imu_rate": rate, "truth_rate": 50.0 if rate > RATE else min(rate, 50.0)},
            begin=MOVING,
            # At 10 Hz no interval is longer than `imu.gap`.
            names=("low rate",) if rate < 10.0 else (),
            also=("low rate", "IMU holes"),
            is_judged_by_name_alone=rate < 10.0,
            stop=STOP,
        )
        for rate in (5.0, 10.0, 25.0, 50.0, 200.0, 400.0)
    ]
