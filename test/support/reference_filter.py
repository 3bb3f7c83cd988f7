"""The filter once more: dense matrices and plain numpy, straight from the equations of docs/theory.md.

Written to be compared with the kernels, and not to look like them: attitude is a matrix, the transition is formed, the
Joseph form is the textbook's, normal gravity comes from Legendre polynomials. What it takes from the package are
constants and the models of atmosphere and receiver noise, which have tests of their own. Alignment, rest and the
decisions of `integrity/` are not here: it is given what is fused.

Units are SI; ``map`` as in docs/theory.md; matrices are (3, 3) or (n, n).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.geodesy import earth
from eskf_ros.gnss.atmosphere import ionosphere_scale, klobuchar, troposphere
from eskf_ros.gnss.signals import SPEED_OF_LIGHT
from eskf_ros.gnss.weighting import DEFAULT_WEIGHTING, code_std, doppler_std

Array = NDArray[np.float64]

P, V, T, A, G = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
"""Places of the errors of position, velocity, attitude, accelerometer bias and gyro bias."""

EYE = np.eye(3)


def skew(a: Any) -> Array:
    """Return [a]x, with [a]x b = a x b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def cross(a: Any, b: Any) -> Array:
    """Return a x b (`numpy.cross` takes ten times as long for one pair)."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def mean_rotation(turn: Any) -> Array:
    """Return the mean of exp(s [turn]x) over s from 0 to 1, by its power series."""
    matrix, term, total = skew(turn), EYE, EYE
    for order in range(2, 20):
        term = term @ matrix / order
        total = total + term
    return total


def correction_by(gain: Any, h: Any, innovation: Any, iterations: int = 10) -> Array:
    """Return the correction by a measurement: position and velocity in axes that turn with the attitude meanwhile.

    What they change less by than the gain says counts again, until they meet the measurement all the same.
    """
    met = innovation
    for _ in range(iterations):
        error = gain @ met
        turned = error.copy()
        turned[:6] = np.kron(np.eye(2), mean_rotation(error[6:9])) @ error[:6]
        met = innovation + h @ (error - turned)
    return np.asarray(turned)


def reset_by(turn: Any, size: int) -> Array:
    """Return the matrix by which the errors of position, velocity and attitude turn with a corrected heading."""
    matrix = np.eye(size)
    matrix[:9, :9] = np.kron(EYE, exponential(turn))
    return matrix


def exponential(turn: Any) -> Array:
    """Return exp([turn]x) (Rodrigues), exact near zero too."""
    angle = math.sqrt(turn @ turn)
    matrix = skew(turn)
    half = np.sinc(0.5 * angle / math.pi)
    return EYE + np.sinc(angle / math.pi) * matrix + 0.5 * half * half * (matrix @ matrix)


def geodetic(ecef: Array) -> tuple[float, float, float]:
    """Return latitude, longitude (rad) and ellipsoidal height (m), by the fixed point of the latitude."""
    x, y, z = ecef.tolist()
    horizontal, square = math.hypot(x, y), earth.ECCENTRICITY_SQUARED
    latitude = math.atan2(z, horizontal * (1.0 - square))
    for _ in range(8):
        radius = earth.SEMI_MAJOR_AXIS / math.sqrt(1.0 - square * math.sin(latitude) ** 2)
        latitude = math.atan2(z + square * radius * math.sin(latitude), horizontal)
    radius = earth.SEMI_MAJOR_AXIS / math.sqrt(1.0 - square * math.sin(latitude) ** 2)
    height = horizontal * math.cos(latitude) + z * math.sin(latitude) - earth.SEMI_MAJOR_AXIS**2 / radius
    return latitude, math.atan2(y, x), height


def from_geodetic(latitude: float, longitude: float, height: float) -> Array:
    """Return ECEF coordinates (m)."""
    radius = earth.SEMI_MAJOR_AXIS / math.sqrt(1.0 - earth.ECCENTRICITY_SQUARED * math.sin(latitude) ** 2)
    ring = (radius + height) * math.cos(latitude)
    polar = (radius * (1.0 - earth.ECCENTRICITY_SQUARED) + height) * math.sin(latitude)
    return np.array([ring * math.cos(longitude), ring * math.sin(longitude), polar])


def east_north_up(latitude: float, longitude: float) -> Array:
    """Return the directions east, north and up in ECEF, as columns."""
    up = np.array(
        [math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude), math.sin(latitude)]
    )
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    return np.column_stack([east, cross(up, east), up])


def _zonal(n: int) -> float:
    """Return the harmonic J_2n of a level ellipsoid (Heiskanen and Moritz, eq. 2-92)."""
    square = earth.ECCENTRICITY_SQUARED
    sign = 1.0 if n % 2 else -1.0
    factor = 3.0 * square**n / ((2 * n + 1) * (2 * n + 3))
    return sign * factor * (1.0 - n + 5.0 * n * earth.J2 / square)


HARMONICS = ((2, earth.J2), (4, _zonal(2)), (6, _zonal(3)))


def legendre(n: int, s: float) -> tuple[float, float]:
    """Return the Legendre polynomial of degree 2, 4 or 6, and its derivative."""
    if n == 2:
        return (3.0 * s**2 - 1.0) / 2.0, 3.0 * s
    if n == 4:
        return (35.0 * s**4 - 30.0 * s**2 + 3.0) / 8.0, (140.0 * s**3 - 60.0 * s) / 8.0
    value = (231.0 * s**6 - 315.0 * s**4 + 105.0 * s**2 - 5.0) / 16.0
    return value, (1386.0 * s**5 - 1260.0 * s**3 + 210.0 * s) / 16.0


def gravity(ecef: Array) -> Array:
    """Return normal gravity (ECEF): the gradient of (GM/r) (1 - sum J_n (a/r)^n P_n(z/r)) + centrifugal potential."""
    r = math.sqrt(ecef @ ecef)
    s = float(ecef[2]) / r
    along, across = 1.0, 0.0
    for n, harmonic in HARMONICS:
        value, slope = legendre(n, s)
        share = harmonic * (earth.SEMI_MAJOR_AXIS / r) ** n
        along -= (n + 1) * share * value
        across -= share * slope
    outward = ecef / r
    strength = earth.GRAVITATIONAL_CONSTANT / r**2
    radial = -strength * along * outward
    polar = strength * across * (np.array([0.0, 0.0, 1.0]) - s * outward)
    return radial + polar + earth.EARTH_RATE**2 * np.array([ecef[0], ecef[1], 0.0])


@dataclass(frozen=True)
class Model:
    """What the filter is told: noise, lever arm, augmented states.

    ``velocity_noise`` (m2/s3), ``attitude_noise`` (rad2/s), ``accel_walk`` (m2/s5), ``gyro_walk`` (rad2/s3): spectral
    densities of this lane. ``accel_density`` (m/s2/rtHz), ``gyro_density`` (rad/s/rtHz): of the sensors, as told.
    ``places``: index of each augmented state by name; ``walk`` (unit/rts) and ``decay`` (1/s) of all of them, in their
    order. ``error_std`` (m): what lasts in all ranges together.
    """

    datum: tuple[float, float, float]
    velocity_noise: float
    attitude_noise: float
    accel_walk: float
    gyro_walk: float
    accel_density: float
    gyro_density: float
    lever_arm: Array
    places: dict[str, int] = field(default_factory=dict)
    walk: Array = field(default_factory=lambda: np.zeros(0))
    decay: Array = field(default_factory=lambda: np.zeros(0))
    error_std: Array = field(default_factory=lambda: np.zeros(3))


class ReferenceFilter:
    """Nominal state, covariance, and the two steps that change them."""

    def __init__(self, model: Model, state: Any) -> None:
        """Begin with the nominal state and the covariance of a STATE record."""
        self.model = model
        latitude, longitude = math.radians(model.datum[0]), math.radians(model.datum[1])
        self.origin = from_geodetic(latitude, longitude, model.datum[2])
        self.axes = east_north_up(latitude, longitude)
        self.omega = self.axes.T @ np.array([0.0, 0.0, earth.EARTH_RATE])
        size = int(state["error_size"])
        self.p, self.v = state["position_map"].copy(), state["velocity_map"].copy()
        w, x, y, z = state["attitude"]
        # R = (w^2 - v.v) I + 2 v v' + 2 w [v]x (Sola, eq. 115).
        vector = np.array([x, y, z])
        self.r = (w * w - vector @ vector) * EYE + 2.0 * np.outer(vector, vector) + 2.0 * w * skew(vector)
        self.ba, self.bg = state["accel_bias"].copy(), state["gyro_bias"].copy()
        self.x = state["optional"][: size - 15].copy()
        self.covariance = state["covariance"][:size, :size].copy()
        self.mean_acceleration = state["excitation"]["acceleration"].copy()
        self.believed = float(state["excitation"]["left"])

    def ecef(self, position_map: Array) -> Array:
        """Return a position in ECEF."""
        return self.origin + self.axes @ position_map

    def gravity_map(self, position_map: Array) -> Array:
        """Return normal gravity in map axes."""
        return self.axes.T @ gravity(self.ecef(position_map))

    def place(self, name: str) -> int | None:
        """Return the index of an augmented state, or None while it has not joined."""
        place = self.model.places.get(name)
        return place if place is not None and place < len(self.covariance) else None

    def predict(self, f0: Array, w0: Array, f1: Array, w1: Array, dt: float) -> None:
        """Propagate by ``dt`` s with readings (m/s2, rad/s) that are straight lines in between."""
        f0, f1, w0, w1 = f0 - self.ba, f1 - self.ba, w0 - self.bg, w1 - self.bg
        alpha = dt / 2.0 * (w0 + w1) + dt**2 / 12.0 * cross(w0, w1)
        nu = dt / 2.0 * (f0 + f1) + dt**2 / 12.0 * (cross(w0, f1) + cross(f0, w1))
        nu = nu + cross(alpha, cross(alpha, nu)) / 24.0
        middle = self.r @ exponential(alpha / 2.0)
        delta = middle @ nu
        g = self.gravity_map(self.p + dt / 2.0 * self.v)
        mid_velocity = self.v + (delta + g * dt) / 2.0
        change = delta - dt / 2.0 * cross(self.omega, delta) + dt * (g - 2.0 * cross(self.omega, mid_velocity))
        self.p = self.p + dt / 2.0 * (self.v + self.v + change)
        self.v = self.v + change
        turned = exponential(-self.omega * dt) @ self.r @ exponential(alpha)
        self.r = turned @ (3.0 * EYE - turned.T @ turned) / 2.0
        force = self.force_of_errors(middle, delta / dt, g, dt)
        transition = self.transition(middle, force, g, dt)
        covariance = transition @ self.covariance @ transition.T + self.process_noise(dt)
        self.covariance = (covariance + covariance.T) / 2.0
        self.x = transition[15:, 15:] @ self.x

    def force_of_errors(self, rotation: Array, force: Array, g: Array, dt: float) -> Array:
        """Return the force in F: the horizontal part only where, and for a minute after, it stands out of its error.

        When it begins to, what the low-passed acceleration of 1 s holds is made up for.
        """
        vertical = force @ g / (g @ g) * g
        self.mean_acceleration = self.mean_acceleration + dt / 1.0 * (force - vertical - self.mean_acceleration)
        rows = np.hstack([-skew(vertical), -rotation])[:2]
        covariance = self.covariance[6:12, 6:12]
        variance = np.trace(rows @ covariance @ rows.T) / 2.0 + self.model.accel_density**2 / 2.0
        self.believed = max(0.0, self.believed - dt)
        if self.mean_acceleration @ self.mean_acceleration > 25.0 * variance:
            missed = 1.0 / dt if self.believed == 0.0 else 0.0
            self.believed = 60.0
            return force + missed * self.mean_acceleration
        return force if self.believed > 0.0 else vertical

    def transition(self, rotation: Array, force: Array, g: Array, dt: float) -> Array:
        """Return the transition matrix: mean attitude error in the velocity, mean velocity error in the position."""
        phi = np.eye(len(self.covariance))
        strength = math.sqrt(g @ g)
        up = -g / strength
        gradient = strength / earth.SEMI_MAJOR_AXIS * (3.0 * np.outer(up, up) - EYE)
        phi[T, T] -= dt * skew(self.omega)
        phi[T, G] = -dt * rotation
        turning = -dt / 2.0 * skew(force)
        phi[V, P] = dt * gradient
        phi[V, V] -= 2.0 * dt * skew(self.omega)
        phi[V, T] = turning @ (EYE + phi[T, T])
        phi[V, A] = -dt * rotation
        phi[V, G] = turning @ phi[T, G]
        phi[P, :] += dt / 2.0 * phi[V, :]
        phi[P, V] += dt / 2.0 * EYE
        augmented = np.arange(15, len(phi))
        phi[augmented, augmented] = 1.0 - dt * self.model.decay[: len(augmented)]
        if (i := self.place("clock")) is not None:
            phi[i, i + 1] = dt
        return phi

    def process_noise(self, dt: float) -> Array:
        """Return the covariance of what an interval adds."""
        model, q = self.model, np.zeros_like(self.covariance)
        q[P, P] = model.velocity_noise * dt**3 / 3.0 * EYE
        q[P, V] = q[V, P] = model.velocity_noise * dt**2 / 2.0 * EYE
        q[V, V] = model.velocity_noise * dt * EYE
        q[T, T] = model.attitude_noise * dt * EYE
        q[A, A] = model.accel_walk * dt * EYE
        q[G, G] = model.gyro_walk * dt * EYE
        augmented = np.arange(15, len(q))
        q[augmented, augmented] = model.walk[: len(augmented)] ** 2 * dt
        if (i := self.place("clock")) is not None:
            drift = q[i + 1, i + 1]
            q[i, i] += drift * dt**2 / 3.0
            q[i, i + 1] = q[i + 1, i] = drift * dt / 2.0
        return q

    def nis(self, innovation: Array, h: Array, noise: Array) -> float:
        """Return y' S^-1 y."""
        return float(innovation @ np.linalg.solve(h @ self.covariance @ h.T + noise, innovation))

    def update(self, innovation: Array, h: Array, noise: Array) -> None:
        """Fuse a measurement: gain, Joseph form, injection, reset."""
        s = h @ self.covariance @ h.T + noise
        gain = np.linalg.solve(s, h @ self.covariance).T
        keep = np.eye(len(self.covariance)) - gain @ h
        covariance = keep @ self.covariance @ keep.T + gain @ noise @ gain.T
        error = correction_by(gain, h, innovation)
        self.p = self.p + error[P]
        self.v = self.v + error[V]
        self.r = exponential(error[T]) @ self.r
        self.ba = self.ba + error[A]
        self.bg = self.bg + error[G]
        self.x = self.x + error[15:]
        g = self.gravity_map(self.p)
        up = -g / math.sqrt(g @ g)
        reset = reset_by(up @ error[T] * up, len(covariance))
        covariance = reset @ covariance @ reset.T
        self.covariance = (covariance + covariance.T) / 2.0

    def sway(self, reading: Array) -> tuple[Array, Array]:
        """Return the lever arm and its velocity in map axes, for a gyro ``reading`` (rad/s)."""
        rate = reading - self.bg - self.r.T @ self.omega
        return self.r @ self.model.lever_arm, self.r @ cross(rate, self.model.lever_arm)

    def turning_of_sway(self, lever: Array, sway: Array) -> tuple[Array, Array]:
        """Return the derivatives of the velocity of the antenna by attitude error and gyro bias."""
        return -skew(sway) + skew(lever) @ skew(self.omega), self.r @ skew(self.model.lever_arm)

    def to_map(self, covariance_enu: Array, latitude: float, longitude: float) -> Array:
        """Return a covariance in East-North-Up at a place in map axes."""
        turn = self.axes.T @ east_north_up(latitude, longitude)
        return np.asarray(turn @ covariance_enu @ turn.T)

    def gnss_position(self, fix: Array, covariance_enu: Array) -> tuple[Array, Array, Array]:
        """Return innovation, H and noise of a fix (latitude, longitude in rad, height in m) of the antenna."""
        lever = self.r @ self.model.lever_arm
        h = np.zeros((3, len(self.covariance)))
        h[:, P], h[:, T] = EYE, -skew(lever)
        innovation = self.axes.T @ (from_geodetic(*fix.tolist()) - self.origin) - (self.p + lever)
        return innovation, h, self.to_map(covariance_enu, fix[0], fix[1])

    def gnss_velocity(
        self, velocity_enu: Array, covariance_enu: Array, reading: Array, interval: float
    ) -> tuple[Array, Array, Array]:
        """Return innovation, H and noise of a velocity; gyro ``reading`` and ``interval`` (s) of the IMU there."""
        latitude, longitude, _ = geodetic(self.ecef(self.p))
        lever, sway = self.sway(reading)
        h = np.zeros((3, len(self.covariance)))
        h[:, V] = EYE
        h[:, T], h[:, G] = self.turning_of_sway(lever, sway)
        measured = self.axes.T @ east_north_up(latitude, longitude) @ velocity_enu
        gyro = self.model.gyro_density**2 / interval * (lever @ lever * EYE - np.outer(lever, lever))
        return measured - (self.v + sway), h, self.to_map(covariance_enu, latitude, longitude) + gyro

    def sight(self, signal: Any, reading: Array) -> dict[str, Any]:
        """Return what pseudorange and range rate of a signal (MEASURED_SIGNAL) need, vectors in map axes."""
        lever, sway = self.sway(reading)
        antenna, velocity = self.ecef(self.p + lever), self.axes @ (self.v + sway)
        satellite = signal["satellite"].copy()
        for _ in range(3):
            light_time = math.sqrt((satellite - antenna) @ (satellite - antenna)) / SPEED_OF_LIGHT
            # The axes of reception have turned by the Earth rate since the signal was sent.
            turn = exponential(np.array([0.0, 0.0, -earth.EARTH_RATE * light_time]))
            satellite = turn @ signal["satellite"]
        distance = math.sqrt((satellite - antenna) @ (satellite - antenna))
        unit, moves = (satellite - antenna) / distance, turn @ signal["satellite_velocity"]
        # The range is that of the instant of sending, which is later by the change of the light time.
        inertial = moves + cross([0.0, 0.0, earth.EARTH_RATE], satellite)
        relative = moves - velocity
        place = geodetic(antenna)
        east, north, up = (east_north_up(place[0], place[1]).T @ unit).tolist()
        return {
            "lever": lever,
            "sway": sway,
            "distance": distance,
            "rate": unit @ relative / (1.0 + unit @ inertial / SPEED_OF_LIGHT),
            "unit": self.axes.T @ unit,
            "turning": self.axes.T @ (relative - unit @ relative * unit) / distance,
            "place": place,
            "elevation": math.asin(up),
            "azimuth": math.atan2(east, north) % (2.0 * math.pi),
        }

    def pseudorange(
        self, signal: Any, seen: dict[str, Any], time: tuple[int, float], ionosphere: Array, order: int
    ) -> tuple[Array, Array, Array]:
        """Return innovation, H and noise; ``time``: GPS week and seconds; ``order`` of the offset, -1 for GPS."""
        unit, elevation, (latitude, longitude, height) = seen["unit"], seen["elevation"], seen["place"]
        delay = klobuchar(ionosphere, time[1], latitude, longitude, elevation, seen["azimuth"])
        delay *= ionosphere_scale(signal["carrier_hz"])
        h = np.zeros((1, len(self.covariance)))
        h[0, P], h[0, T] = -unit, cross(unit, seen["lever"])
        clock = self.model.places["clock"]
        h[0, clock] = 1.0
        expected = seen["distance"] + self.x[clock - 15] + delay
        expected += troposphere(time[0], time[1], latitude, height, elevation)
        if order >= 0:
            offset = self.model.places["inter_system"] + order
            h[0, offset] = 1.0
            expected += self.x[offset - 15]
        if (place := self.place("position_error")) is not None:
            h[0, place : place + 3] = -unit * self.model.error_std
            expected += h[0, place : place + 3] @ self.x[place - 15 : place - 12]
        std = code_std(
            DEFAULT_WEIGHTING,
            signal["gnss_id"],
            signal["sv_id"],
            elevation,
            signal["cn0"],
            delay,
            signal["noise_factor"],
        )
        return np.array([signal["pseudorange"] - expected]), h, np.array([[max(std, 0.3) ** 2]])

    def range_rate(self, signal: Any, seen: dict[str, Any], interval: float) -> tuple[Array, Array, Array]:
        """Return innovation, H and noise; ``interval`` (s) of the IMU there."""
        unit, lever, turning = seen["unit"], seen["lever"], seen["turning"]
        by_attitude, by_bias = self.turning_of_sway(lever, seen["sway"])
        h = np.zeros((1, len(self.covariance)))
        h[0, P], h[0, V] = -turning, -unit
        # -e . d(antenna velocity) - tau . d(antenna position).
        h[0, T] = -unit @ by_attitude + turning @ skew(lever)
        h[0, G] = -unit @ by_bias
        drift = self.model.places["clock"] + 1
        h[0, drift] = 1.0
        across = cross(unit, lever)
        noise = max(doppler_std(DEFAULT_WEIGHTING, signal["cn0"]), 0.03) ** 2
        noise += self.model.gyro_density**2 / interval * (across @ across)
        return np.array([signal["range_rate"] - seen["rate"] - self.x[drift - 15]]), h, np.array([[noise]])
