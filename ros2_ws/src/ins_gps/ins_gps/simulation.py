# SPDX-License-Identifier: Apache-2.0
"""Truth, IMU and GNSS observations for the scenarios of the package, seeded and pure.

Level frame NED, body forward-right-down. Truth is kinematic: velocity by Gauss quadrature of an analytic
acceleration, IMU means by Gauss quadrature of the exact rate and specific force, so nothing here shares
an integrator with the mechanisation under test.
Source: paper 003 section 4 and tables 1-3 (readings in papers.md); HG1700 data sheet classes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ins_gps.constants import GPS_EPOCH_UNIX
from ins_gps.samples import GnssEpoch, ImuSample
from ins_gps.strapdown import NAV, mechanise_series, navigation_rates
from kalman_core.earth import gravity, radii
from kalman_core.rotation import matrix_from_quat, quat_from_euler

NANOSECONDS = 1_000_000_000
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_NODES = 0.5 * (_NODES + 1.0)
_WEIGHTS = 0.5 * _WEIGHTS


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """Errors of an IMU; biases are drawn as σ times a standard normal, or uniform ± if `uniform`."""

    gyro_bias: float = 0.0  # rad/s
    gyro_noise: float = 0.0  # rad/s/√Hz
    accel_bias: float = 0.0  # m/s²
    accel_noise: float = 0.0  # m/s²/√Hz
    gyro_offset: float = 0.0  # rad/s, the same on each axis
    accel_offset: float = 0.0  # m/s², the same on each axis
    uniform: bool = False


DEGREE_PER_HOUR = math.radians(1.0) / 3600.0
HG1700 = ImuErrors(
    gyro_bias=1.0 * DEGREE_PER_HOUR,
    gyro_noise=math.radians(0.125) / 60.0,
    accel_bias=1e-3 * 9.80665,
    accel_noise=0.06 / 60.0,
)
# Paper 003 eqs. 34-35, read as a fixed offset and a bias drawn once per run.
PAPER_IMU = ImuErrors(
    gyro_offset=2.424068e-6, gyro_bias=2.424068e-6, accel_offset=0.0249, accel_bias=0.00637, uniform=True
)
MEMS = ImuErrors(gyro_bias=math.radians(0.1), gyro_noise=1e-4, accel_bias=0.03, accel_noise=2e-3)
PERFECT = ImuErrors()


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """Bounds (m) of uniform range errors, paper 003 table 1.

    white: all redrawn each epoch. Otherwise ionosphere, troposphere, orbit and satellite clock are constant
    per satellite, multipath and selective availability are first order, the receiver's noise is white.
    """

    ionosphere: float = 0.5
    troposphere: float = 0.2
    satellite_clock: float = 0.0
    orbit: float = 0.3
    multipath: float = 1.0
    receiver: float = 1.0
    selective_availability: float = 0.0
    white: bool = True
    multipath_time: float = 60.0  # s
    availability_time: float = 180.0  # s
    carrier_noise: float = 0.003  # m
    carrier_walk: float = 0.0005  # m/√s
    doppler_noise: float = 0.05  # m/s

    @property
    def slow(self) -> float:
        """σ (m) of the errors that are constant per satellite in the correlated case."""
        parts = (self.ionosphere, self.troposphere, self.satellite_clock, self.orbit)
        return math.sqrt(sum(p * p for p in parts) / 3.0)

    @property
    def total(self) -> float:
        """σ (m) of one pseudorange, all errors together."""
        fast = (self.multipath, self.receiver, self.selective_availability)
        return math.sqrt(self.slow**2 + sum(p * p for p in fast) / 3.0)


DGPS = ErrorBudget()
STANDALONE = ErrorBudget(ionosphere=5.0, troposphere=1.5, satellite_clock=3.0, orbit=4.2)
NOISELESS = ErrorBudget(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, True, 60.0, 180.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Clock:
    """Receiver clock: bias (m), drift (m/s), random walks (m/√s, m/s/√s)."""

    bias: float = 1e4
    drift: float = 30.0
    walk: float = 0.03
    drift_walk: float = 0.05


@dataclass(frozen=True, slots=True)
class Fault:
    """An error added to one satellite: kind 'jump' or 'ramp' (code, m or m/s), 'slip' (cycles)."""

    kind: str
    satellite: int
    start: float
    size: float
    end: float = math.inf


@dataclass(frozen=True, slots=True)
class Outage:
    """Only the `left` satellites highest in the sky remain between start and end (s)."""

    start: float
    end: float
    left: int


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything that defines a run except the seed."""

    trajectory: str = 'constant'
    satellites: str = 'open_sky'
    duration: float = 500.0
    imu_rate: float = 100.0
    gnss_rate: float = 1.0
    origin: tuple[float, float, float] = (math.radians(21.0), math.radians(105.8), 100.0)
    imu: ImuErrors = HG1700
    budget: ErrorBudget = DGPS
    clock: Clock = field(default_factory=Clock)
    faults: tuple[Fault, ...] = ()
    outages: tuple[Outage, ...] = ()
    mask: float = 0.0  # rad
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, forward-right-down
    gnss_offset: float = 0.0  # s added to the stamps of GNSS, for the doctor
    start: int = (GPS_EPOCH_UNIX + 2244 * 604_800 + 252_000) * NANOSECONDS


@dataclass(frozen=True, slots=True)
class Run:
    """A simulated run: truth nav (N + 1, NAV) at IMU stamps (N + 1,), IMU (N, 3) means, epochs."""

    stamps: np.ndarray
    truth: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    epochs: list[GnssEpoch]
    clock: np.ndarray  # (epochs, 2) bias and drift
    true_rate: np.ndarray

    def imu_samples(self) -> list[ImuSample]:
        """Return the IMU as samples stamped at the end of their interval."""
        return [
            ImuSample(int(t), w, f) for t, w, f in zip(self.stamps[1:], self.rate, self.force, strict=True)
        ]


# A motion returns, at times (k,): Euler angles (k, 3), their rates (k, 3), acceleration NED (k, 3).
Motion = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _level(yaw, yaw_rate, forward, right) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    zero = np.zeros_like(yaw)
    angles = np.stack([zero, zero, yaw], axis=1)
    rates = np.stack([zero, zero, yaw_rate], axis=1)
    c, s = np.cos(yaw), np.sin(yaw)
    acceleration = np.stack([c * forward - s * right, s * forward + c * right, zero], axis=1)
    return angles, rates, acceleration


def constant_motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Specific force (0.2, 0.1, −g), yaw rate 0.01 rad/s: the flyable reading of paper 003."""
    one = np.ones_like(t)
    return _level(0.01 * t, 0.01 * one, 0.2 * one, 0.1 * one)


def s_turns(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Yaw rate 0.1 sin(2πt/40), forward 1.0 sin(2πt/60), lateral 10 times the yaw rate (m/s²)."""
    w = 2.0 * math.pi / 40.0
    yaw_rate = 0.1 * np.sin(w * t)
    yaw = 0.1 / w * (1.0 - np.cos(w * t))
    return _level(yaw, yaw_rate, np.sin(2.0 * math.pi * t / 60.0), 10.0 * yaw_rate)


def flight(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A fixed-wing profile: banked figure-of-eight at 22 m/s with climbs; bank and pitch follow."""
    speed, w, wc = 22.0, 2.0 * math.pi / 60.0, 2.0 * math.pi / 90.0
    a = 0.9  # rad, half the swing of the course: a lazy eight
    course = 0.5 + a * np.sin(w * t)
    course_rate = a * w * np.cos(w * t)
    course_acc = -a * w * w * np.sin(w * t)
    climb, climb_rate = -1.5 * np.sin(wc * t), -1.5 * wc * np.cos(wc * t)  # down velocity and its rate
    g = 9.81
    roll = np.arctan(speed * course_rate / g)
    roll_rate = speed * course_acc / g / (1.0 + (speed * course_rate / g) ** 2)
    pitch = np.arctan(-climb / speed)
    pitch_rate = -climb_rate / speed / (1.0 + (climb / speed) ** 2)
    c, s = np.cos(course), np.sin(course)
    acceleration = np.stack([-speed * s * course_rate, speed * c * course_rate, climb_rate], axis=1)
    return (
        np.stack([roll, pitch, course], axis=1),
        np.stack([roll_rate, pitch_rate, course_rate], axis=1),
        acceleration,
    )


MOTIONS: dict[str, tuple[Motion, tuple[float, float, float]]] = {
    'constant': (constant_motion, (0.0, 0.0, 0.0)),
    's_turns': (s_turns, (10.0, 0.0, 0.0)),
    'flight': (flight, (22.0 * math.cos(0.5), 22.0 * math.sin(0.5), 0.0)),
}
TRAJECTORIES = (*MOTIONS, 'literal')


@lru_cache(maxsize=8)
def make_truth(
    name: str, origin: tuple[float, float, float], duration: float, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return truth (N + 1, NAV) and the exact means of rate and specific force (N, 3) of a trajectory.

    'literal' is paper 003 eq. 33 as printed, (0.2, 0.1, −10) m/s² and (0, 0.01, 0.01) rad/s in the body: it
    is defined by its IMU and hence integrated by the mechanisation, at 10 times the rate. The arrays are
    shared between calls and read-only.
    """
    count, dt = round(duration * rate), 1.0 / rate
    if name == 'literal':
        return _frozen(*_literal(origin, count, dt))
    if name not in MOTIONS:
        raise ValueError(f'unknown trajectory {name!r}; known: {", ".join(TRAJECTORIES)}')
    motion, velocity = MOTIONS[name]
    edges = dt * np.arange(count + 1)
    nodes = (edges[:-1, None] + dt * _NODES).ravel()
    acceleration = motion(nodes)[2].reshape(count, 3, 3)
    gain = dt * np.einsum('k,nkj->nj', _WEIGHTS, acceleration)
    v = np.vstack([velocity, velocity + np.cumsum(gain, axis=0)])
    # ∫v over an interval = v dt + ∫(dt − s) a ds
    moved = dt * v[:-1] + dt * dt * np.einsum('k,nkj->nj', _WEIGHTS * (1.0 - _NODES), acceleration)
    geodetic = _travel(origin, moved)
    angles = motion(edges)[0]
    truth = np.empty((count + 1, NAV))
    truth[:, :3], truth[:, 3:6] = geodetic, v
    for i, (roll, pitch, yaw) in enumerate(angles):
        truth[i, 6:] = quat_from_euler(roll, pitch, yaw)
    return _frozen(truth, *_imu_means(motion, nodes, geodetic, v, count))


def _frozen(*arrays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    for array in arrays:
        array.flags.writeable = False
    truth, rate, force = arrays
    return truth, rate, force


def _travel(origin, moved: np.ndarray) -> np.ndarray:
    out = np.empty((len(moved) + 1, 3))
    out[0] = origin
    for i, (n, e, d) in enumerate(moved):
        lat, lon, h = out[i]
        meridian, _ = radii(lat)
        mid_lat = lat + 0.5 * n / (meridian + h)
        meridian, normal = radii(mid_lat)
        mid_h = h - 0.5 * d
        out[i + 1] = (
            lat + n / (meridian + mid_h),
            lon + e / ((normal + mid_h) * math.cos(mid_lat)),
            h - d,
        )
    return out


def _imu_means(motion: Motion, nodes, geodetic, v, count: int) -> tuple[np.ndarray, np.ndarray]:
    angles, angle_rates, acceleration = motion(nodes)
    fraction = np.tile(_NODES, count)[:, None]
    before = np.repeat(np.arange(count), 3)
    velocity = v[before] * (1.0 - fraction) + v[before + 1] * fraction
    place = geodetic[before] * (1.0 - fraction) + geodetic[before + 1] * fraction
    w, f = np.empty((3 * count, 3)), np.empty((3 * count, 3))
    rates = np.empty(6)
    for i in range(3 * count):
        roll, pitch, yaw = angles[i]
        mat = matrix_from_quat(quat_from_euler(roll, pitch, yaw))
        navigation_rates(place[i, 0], place[i, 2], velocity[i, 0], velocity[i, 1], rates)
        p, q, r = angle_rates[i]
        sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
        body = np.array([p - r * sp, q * cr + r * sr * cp, -q * sr + r * cr * cp])
        w[i] = body + mat.T @ (rates[:3] + rates[3:])
        # Written out: np.cross costs as much as all the rest of this loop.
        x, y, z = (2.0 * rates[:3] + rates[3:]).tolist()
        vx, vy, vz = velocity[i].tolist()
        coriolis = np.array([y * vz - z * vy, z * vx - x * vz, x * vy - y * vx])
        g = np.array([0.0, 0.0, gravity(place[i, 0], place[i, 2])])
        f[i] = mat.T @ (acceleration[i] + coriolis - g)
    return (
        np.einsum('k,nkj->nj', _WEIGHTS, w.reshape(count, 3, 3)),
        np.einsum('k,nkj->nj', _WEIGHTS, f.reshape(count, 3, 3)),
    )


def _literal(origin, count: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    nav = np.zeros(NAV)
    nav[:3], nav[6] = origin, 1.0
    fine = 10
    rate = np.tile([0.0, 0.01, 0.01], (count * fine, 1))
    force = np.tile([0.2, 0.1, -10.0], (count * fine, 1))
    truth = mechanise_series(nav, rate, force, dt / fine)[::fine]
    return truth, rate[::fine].copy(), force[::fine].copy()


def add_imu_errors(
    rate: np.ndarray, force: np.ndarray, errors: ImuErrors, dt: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return measured rate and force: truth + offset + bias drawn once + white noise."""
    draw = (lambda: rng.uniform(-1.0, 1.0, 3)) if errors.uniform else (lambda: rng.standard_normal(3))
    gyro = errors.gyro_offset + errors.gyro_bias * draw()
    accel = errors.accel_offset + errors.accel_bias * draw()
    scale = 1.0 / math.sqrt(dt)
    w = rate + gyro + errors.gyro_noise * scale * rng.standard_normal(rate.shape)
    f = force + accel + errors.accel_noise * scale * rng.standard_normal(force.shape)
    return w, f
