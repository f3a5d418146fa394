# SPDX-License-Identifier: Apache-2.0
"""Named motions as analytic functions of time: orientation, velocity and all the derivatives of both.

Orientation is given by intrinsic ZYX angles. Angular velocity and acceleration follow from the angles'
derivatives for any angles at all (only the inverse relation is singular), so a motion may tumble through
every orientation. Nothing is integrated or differenced: truth is exact at any time and for ever.

Frames: n is ENU, b is the body (x forward, y left, z up).
Sources: Titterton and Weston, "Strapdown Inertial Navigation Technology" (2004), 3.6.3, for the rates;
Flash and Hogan (1985) for the minimum-jerk step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from imu_kalman.sim_params import SimulatorParams

# A spell of motion starts and ends within this time (s): smooth enough not to look like a blow.
RAMP = 1.0

_DEG = math.pi / 180.0


class Motion(NamedTuple):
    """Motion of the centre of rotation at n times.

    angles: (n, 3) roll, pitch, yaw (rad), rates and accelerations: (n, 3) their first and second time
    derivatives; velocity (m/s) and acceleration (m/s²): (n, 3) in ENU.
    """

    angles: np.ndarray
    rates: np.ndarray
    accelerations: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class Truth(NamedTuple):
    """What a perfect sensor sees at n times.

    quaternion: (n, 4) wxyz, b to n; rate: (n, 3) rad/s and force: (n, 3) m/s², specific force, both in b;
    velocity: (n, 3) m/s of the sensor in n.
    """

    quaternion: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    velocity: np.ndarray


Profile = Callable[[np.ndarray], Motion]


class Tones:
    """Sums of sines: value, first and second derivative of d quantities."""

    def __init__(self, amplitude: np.ndarray, frequency: np.ndarray, phase: np.ndarray) -> None:
        """amplitude, frequency (Hz) and phase (rad): (k, d), one row per tone."""
        self._amplitude = np.atleast_2d(np.asarray(amplitude, float))
        self._omega = 2.0 * math.pi * np.atleast_2d(np.asarray(frequency, float))
        self._phase = np.atleast_2d(np.asarray(phase, float))

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return value, rate and acceleration, each (n, d)."""
        argument = times[:, None, None] * self._omega + self._phase
        sine = self._amplitude * np.sin(argument)
        cosine = self._amplitude * np.cos(argument)
        return (
            sine.sum(axis=1),
            (cosine * self._omega).sum(axis=1),
            -(sine * self._omega**2).sum(axis=1),
        )


def step(times: np.ndarray, start: float, duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a minimum-jerk step from 0 to 1 and its derivatives, each (n,)."""
    u = np.clip((times - start) / duration, 0.0, 1.0)
    value = u**3 * (10.0 + u * (6.0 * u - 15.0))
    rate = 30.0 * u**2 * (1.0 - u) ** 2 / duration
    acceleration = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / duration**2
    return value, rate, acceleration


def stairs(times: np.ndarray, period: float, ramp: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a staircase that climbs by 1 during the last `ramp` seconds of every `period`."""
    count = np.floor(times / period)
    value, rate, acceleration = step(times - count * period, period - ramp, ramp)
    return count + value, rate, acceleration


def _still(params: SimulatorParams, rng: np.random.Generator) -> Profile:
    def profile(times: np.ndarray) -> Motion:
        zero = np.zeros((len(times), 3))
        return Motion(zero, zero, zero, zero, zero)

    return profile


def _tilt_steps(params: SimulatorParams, rng: np.random.Generator) -> Profile:
    """Roll to +30°, back, −30°, back, then the same in pitch: one step of 1 s every 4 s."""
    targets = np.array([[30, 0], [0, 0], [-30, 0], [0, 0], [0, 30], [0, 0], [0, -30], [0, 0]]) * _DEG
    before = np.roll(targets, 1, axis=0)
    hold, ramp = 3.0, 1.0

    def profile(times: np.ndarray) -> Motion:
        zero = np.zeros((len(times), 3))
        count = np.floor(times / (hold + ramp)).astype(int)
        index = count % len(targets)
        shapes = step(times - count * (hold + ramp), hold, ramp)
        angles, rates, accelerations = zero.copy(), zero.copy(), zero.copy()
        for target, shape in zip((angles, rates, accelerations), shapes):
            target[:, :2] = (targets[index] - before[index]) * shape[:, None]
        angles[:, :2] += before[index]
        return Motion(angles, rates, accelerations, zero, zero)

    return profile


def _tumble(params: SimulatorParams, rng: np.random.Generator) -> Profile:
    """Turn about all axes through every orientation, up to about 150 °/s, without translation."""
    sway = Tones(
        np.array([[0.6, 0.9, 0.5]]), np.array([[0.23, 0.17, 0.29]]), rng.uniform(0.0, 2.0 * math.pi, (1, 3))
    )
    spin = np.array([70.0, 43.0, 31.0]) * _DEG  # incommensurate, so that the sphere is covered
    start = sway(np.zeros(1))[0]

    def profile(times: np.ndarray) -> Motion:
        angles, rates, accelerations = sway(times)
        zero = np.zeros((len(times), 3))
        return Motion(angles - start + times[:, None] * spin, rates + spin, accelerations, zero, zero)

    return profile


def _hand_held(params: SimulatorParams, rng: np.random.Generator) -> Profile:
    """Turn and swing as in a hand: tilt of 25° and yaw of 60° RMS, 1.5 m/s² RMS horizontally."""
    count = 8
    frequency = np.exp(rng.uniform(math.log(0.1), math.log(1.2), (count, 3)))
    phase = rng.uniform(0.0, 2.0 * math.pi, (count, 3))
    # Slow tones carry the angle, as in a hand: amplitude falls with frequency.
    shape = 1.0 / (0.2 + frequency)
    rms = np.sqrt(0.5 * (shape**2).sum(axis=0))
    angles = Tones(shape / rms * np.array([25.0, 25.0, 60.0]) * _DEG, frequency, phase)
    start = angles(np.zeros(1))[0]
    swing_frequency = rng.uniform(0.4, 2.5, (count, 3))
    swing_phase = rng.uniform(0.0, 2.0 * math.pi, (count, 3))
    swing_accel = np.array([1.5, 1.5, 1.0]) * math.sqrt(2.0 / count)
    swing = Tones(swing_accel / (2.0 * math.pi * swing_frequency) ** 2, swing_frequency, swing_phase)

    def profile(times: np.ndarray) -> Motion:
        value, rate, acceleration = angles(times)
        _, velocity, linear = swing(times)
        return Motion(value - start, rate, acceleration, velocity, linear)

    return profile


def _rolling_ship(params: SimulatorParams, rng: np.random.Generator) -> Profile:
    """Roll, pitch and yaw of a ship in a swell with sway, heave and surge, and a turn of 90°.

    Amplitudes, frequencies and the turn are the benchmark's; phases by seed. The waves come from a fixed
    direction, so surge and sway do not turn with the ship.
    """
    roll = params.ship_roll
    amplitude = np.array([[0.75 * roll, 4.0 * _DEG, 3.0 * _DEG], [0.25 * roll, 0.0, 0.0]])
    frequency = np.array([[0.1, 0.13, 0.02], [0.113, 0.13, 0.02]])
    angles = Tones(amplitude, frequency, rng.uniform(0.0, 2.0 * math.pi, (2, 3)))
    # Surge, sway, heave (m) of the roll centre, each near the wave's frequency.
    swing = Tones(
        np.array([[1.0, 0.6, 0.8]]), np.array([[0.09, 0.1, 0.11]]), rng.uniform(0, 2 * math.pi, (1, 3))
    )
    turn_start, turn_time, turn = 200.0, 80.0, 90.0 * _DEG

    def profile(times: np.ndarray) -> Motion:
        motion = angles(times)
        for target, shape in zip(motion, step(times, turn_start, turn_time)):
            target[:, 2] += turn * shape
        _, velocity, linear = swing(times)
        return Motion(*motion, velocity, linear)

    return profile


def _vehicle(params: SimulatorParams, rng: np.random.Generator) -> Profile:
    """Drive at 6 to 14 m/s with a left turn of 90° in 8 s every 20 s, leaning out and pitching a little."""
    speed = Tones(np.array([[4.0]]), np.array([[1.0 / 37.0]]), rng.uniform(0.0, 2.0 * math.pi, (1, 1)))
    cruise = 10.0  # m/s
    lean = 0.004  # rad per m/s^2, of a soft passenger car
    road = Tones(
        np.array([[0.4, 0.5]]) * _DEG, np.array([[1.1, 1.3]]), rng.uniform(0.0, 2.0 * math.pi, (1, 2))
    )

    def profile(times: np.ndarray) -> Motion:
        heading, turn, turn_rate = (0.5 * math.pi * part for part in stairs(times, 20.0, 8.0))
        v, v_rate, _ = (part[:, 0] for part in speed(times))
        v = v + cruise
        zero = np.zeros((len(times), 3))
        angles, rates, accelerations = zero.copy(), zero.copy(), zero.copy()
        for target, shape in zip((angles, rates, accelerations), road(times)):
            target[:, :2] = shape
        # Lean follows the turn at the cruising speed: its derivatives stay those of the staircase.
        angles[:, 0] += lean * cruise * turn
        rates[:, 0] += lean * cruise * turn_rate
        accelerations[:, 0] += lean * cruise * _stairs_jerk(times)
        angles[:, 2], rates[:, 2], accelerations[:, 2] = heading, turn, turn_rate
        course = heading + params.orientation[2]
        ahead = np.stack([np.cos(course), np.sin(course), zero[:, 0]], axis=1)
        left = np.stack([-np.sin(course), np.cos(course), zero[:, 0]], axis=1)
        velocity = v[:, None] * ahead
        acceleration = v_rate[:, None] * ahead + (v * turn)[:, None] * left
        return Motion(angles, rates, accelerations, velocity, acceleration)

    return profile


def _stairs_jerk(times: np.ndarray) -> np.ndarray:
    """Return the third derivative of the heading staircase of `_vehicle` (rad/s³)."""
    u = np.clip((times - np.floor(times / 20.0) * 20.0 - 12.0) / 8.0, 0.0, 1.0)
    inside = (u > 0.0) & (u < 1.0)
    return np.where(inside, 0.5 * math.pi * 60.0 * (1.0 - 6.0 * u + 6.0 * u**2) / 8.0**3, 0.0)


PROFILES: dict[str, Callable[[SimulatorParams, np.random.Generator], Profile]] = {
    'still': _still,
    'tilt_steps': _tilt_steps,
    'tumble': _tumble,
    'hand_held': _hand_held,
    'rolling_ship': _rolling_ship,
    'vehicle': _vehicle,
}


def _ramp(times: np.ndarray, start: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the integral of a rise from 0 to 1 at `start`, the rise itself and its slope."""
    u = np.clip((times - start) / RAMP, 0.0, 1.0)
    beyond = np.maximum(times - start - RAMP, 0.0)
    integral = RAMP * (0.5 * u - np.sin(math.pi * u) / (2.0 * math.pi)) + beyond
    return integral, 0.5 - 0.5 * np.cos(math.pi * u), 0.5 * math.pi / RAMP * np.sin(math.pi * u)


def motion_clock(
    times: np.ndarray, initial_rest: float, motion_time: float, rest_time: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the time that the motion has run, its rate and acceleration: it stands still in the rests."""
    if initial_rest == 0.0 and motion_time == 0.0:
        return times, np.ones(len(times)), np.zeros(len(times))
    since = times - initial_rest
    if motion_time == 0.0:
        return _ramp(since, 0.0)
    cycle = motion_time + rest_time
    count = np.maximum(np.floor(since / cycle), 0.0)
    inside = since - count * cycle
    up, down = _ramp(inside, 0.0), _ramp(inside, motion_time - RAMP)
    clock, rate, acceleration = (a - b for a, b in zip(up, down))
    return clock + count * (motion_time - RAMP), rate, acceleration


class TruthModel:
    """Truth at any time: a named motion, run by the clock of its rests, seen at the sensor."""

    def __init__(self, params: SimulatorParams, rng: np.random.Generator) -> None:
        self._params = params
        self._profile = PROFILES[params.motion](params, rng)

    def __call__(self, times: np.ndarray) -> Truth:
        """Return the truth at `times` (n,) [s]."""
        p = self._params
        clock, rate, acceleration = motion_clock(times, p.initial_rest, p.motion_time, p.rest_time)
        m = self._profile(clock)
        r, a = rate[:, None], acceleration[:, None]
        angles = m.angles + np.asarray(p.orientation)
        angle_rates = m.rates * r
        angle_accelerations = m.accelerations * r**2 + m.rates * a
        omega, alpha = body_rates(angles, angle_rates, angle_accelerations)
        quaternion = quaternions_from_angles(angles)
        arm = np.asarray(p.lever_arm)
        swing = np.cross(omega, arm)
        body_acceleration = np.cross(alpha, arm) + np.cross(omega, swing)
        linear = m.acceleration * r**2 + m.velocity * a
        linear[:, 2] += p.gravity
        force = rotate(conjugate(quaternion), linear) + body_acceleration
        velocity = m.velocity * r + rotate(quaternion, swing)
        return Truth(quaternion, omega, force, velocity)


def body_rates(
    angles: np.ndarray, rates: np.ndarray, accelerations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return angular velocity and angular acceleration in b, each (n, 3), of ZYX angles (n, 3)."""
    sr, cr = np.sin(angles[:, 0]), np.cos(angles[:, 0])
    sp, cp = np.sin(angles[:, 1]), np.cos(angles[:, 1])
    dr, dp, dy = rates.T
    ddr, ddp, ddy = accelerations.T
    omega = np.stack([dr - dy * sp, dp * cr + dy * cp * sr, -dp * sr + dy * cp * cr], axis=1)
    alpha = np.stack(
        [
            ddr - ddy * sp - dy * dp * cp,
            ddp * cr - dp * dr * sr + ddy * cp * sr + dy * (cp * cr * dr - sp * sr * dp),
            -ddp * sr - dp * dr * cr + ddy * cp * cr - dy * (sp * cr * dp + cp * sr * dr),
        ],
        axis=1,
    )
    return omega, alpha


def quaternions_from_angles(angles: np.ndarray) -> np.ndarray:
    """Return (n, 4) wxyz, b to n, of intrinsic ZYX angles (n, 3) roll, pitch, yaw."""
    cr, cp, cy = np.cos(0.5 * angles).T
    sr, sp, sy = np.sin(0.5 * angles).T
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )


def conjugate(quaternion: np.ndarray) -> np.ndarray:
    """Return the inverse rotations of (n, 4) wxyz."""
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(quaternion: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return `vectors` (n, 3) rotated by `quaternion` (n, 4) wxyz, row by row."""
    axis = quaternion[:, 1:]
    twice = 2.0 * np.cross(axis, vectors)
    return vectors + quaternion[:, :1] * twice + np.cross(axis, twice)
