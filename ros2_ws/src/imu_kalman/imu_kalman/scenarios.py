# SPDX-License-Identifier: Apache-2.0
"""The rolling ship: truth, inertial and magnetic samples of an instrument away from the roll centre.

Slow rolling looks like rest to a detector that waits for small rates, and sway and heave look like tilt; a
filter for ships must be fooled by neither. Settings: the workspace's benchmark definition.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kalman_core.parameters import parameter

# Standard gravity, m/s².
GRAVITY = 9.80665
_DEGREE = math.pi / 180.0
# Step (s) of the central differences that give rates and accelerations: the motions last seconds, so the
# error is below 1e-6 of the value, and rounding stays below 1e-9 m/s².
_STEP = 0.01


@dataclass(frozen=True, slots=True)
class ShipParams:
    """A ship that rolls, pitches, yaws, turns once and is moved by the sea."""

    roll: float = parameter(15.0, 'largest roll', unit='deg', minimum=0.0, maximum=60.0)
    duration: float = parameter(600.0, 'length of the recording', unit='s', minimum=1.0, maximum=1e5)
    rate: float = parameter(200.0, 'sample rate of all sensors', unit='Hz', minimum=10.0, maximum=2000.0)
    linear: float = parameter(1.0, 'scale of all linear motion; 0 = pure rotation', minimum=0.0, maximum=10.0)
    gyro_noise: float = parameter(0.01, 'gyro white noise', unit='deg/s/sqrt(Hz)', minimum=0.0)
    gyro_walk: float = parameter(0.003, 'gyro bias random walk', unit='deg/s/sqrt(s)', minimum=0.0)
    accel_noise: float = parameter(300.0, 'accelerometer white noise', unit='ug/sqrt(Hz)', minimum=0.0)
    mag_noise: float = parameter(0.6, 'magnetometer white noise per sample', unit='uT', minimum=0.0)
    mag_residual: float = parameter(1.0, 'scale of the left-over magnetometer bias', minimum=0.0)


class ShipRecording(NamedTuple):
    """Samples at common stamps (n,) ns: gyr rad/s, acc m/s², mag T, all (n, 3) in the body frame; truth.

    `orientation` (n, 4): wxyz, body to ENU; `bias` (n, 3): true gyro bias (rad/s).
    """

    stamp: np.ndarray
    gyr: np.ndarray
    acc: np.ndarray
    mag: np.ndarray
    orientation: np.ndarray
    bias: np.ndarray


# Initial gyro bias (deg/s), left-over magnetometer bias (uT), place of the instrument (m: forward, port, up).
_BIAS = np.array([0.5, -0.3, 0.4])
_RESIDUAL = np.array([0.3, -0.2, 0.2])
_ARM = np.array([2.0, 5.0, 8.0])
# Field strength (uT) and dip (deg, down positive).
_FIELD, _DIP = 48.5, 68.0


class _Motion:
    """Attitude and position of the instrument as functions of time, phases drawn once."""

    def __init__(self, params: ShipParams, rng: np.random.Generator) -> None:
        self._roll = params.roll * _DEGREE
        self._linear = params.linear
        self._phase = rng.uniform(0.0, 2.0 * math.pi, 7)
        self._turn_start = rng.uniform(0.2, 0.7) * params.duration

    def angles(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return roll, pitch, yaw (rad): two close roll tones, pitch, yaw with one turn of 90° in 80 s."""
        phase, tau = self._phase, 2.0 * math.pi * t
        roll = self._roll * (0.75 * np.sin(0.1 * tau + phase[0]) + 0.25 * np.sin(0.113 * tau + phase[1]))
        pitch = 4.0 * _DEGREE * np.sin(0.13 * tau + phase[2])
        turned = np.clip((t - self._turn_start) / 80.0, 0.0, 1.0)
        # A cycloid: rate and angular acceleration are continuous at both ends.
        turned = turned - np.sin(2.0 * math.pi * turned) / (2.0 * math.pi)
        yaw = 3.0 * _DEGREE * np.sin(0.02 * tau + phase[3]) + 90.0 * _DEGREE * turned
        return roll, pitch, yaw

    def matrix(self, t: np.ndarray) -> np.ndarray:
        """Return body to ENU (n, 3, 3)."""
        roll, pitch, yaw = self.angles(t)
        cr, sr = np.cos(roll), np.sin(roll)
        cp, sp = np.cos(pitch), np.sin(pitch)
        cy, sy = np.cos(yaw), np.sin(yaw)
        rows = (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    def position(self, t: np.ndarray) -> np.ndarray:
        """Return the instrument's position (n, 3) in ENU (m): surge, sway, heave and the lever arm."""
        phase, tau = self._phase, 2.0 * math.pi * t
        surge = 1.0 * np.sin(0.097 * tau + phase[4])
        sway = 0.6 * np.sin(0.1 * tau + phase[5])
        heave = 0.8 * np.sin(0.103 * tau + phase[6])
        _, _, yaw = self.angles(t)
        cy, sy = np.cos(yaw), np.sin(yaw)
        centre = np.stack([cy * surge - sy * sway, sy * surge + cy * sway, heave], axis=-1)
        return self._linear * (centre + self.matrix(t) @ _ARM)


def _rates(motion: _Motion, t: np.ndarray) -> np.ndarray:
    """Return body rates (n, 3) from the Euler angles' rates."""
    roll, pitch, _ = motion.angles(t)
    late, early = motion.angles(t + _STEP), motion.angles(t - _STEP)
    d_roll, d_pitch, d_yaw = ((b - a) / (2.0 * _STEP) for a, b in zip(early, late))
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return np.stack(
        [d_roll - sp * d_yaw, cr * d_pitch + sr * cp * d_yaw, cr * cp * d_yaw - sr * d_pitch], axis=-1
    )


def _orientation(motion: _Motion, t: np.ndarray) -> np.ndarray:
    roll, pitch, yaw = (0.5 * angle for angle in motion.angles(t))
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def rolling_ship(
    params: ShipParams | None = None, seed: int = 0, start: int = 1_700_000_000_000_000_000
) -> ShipRecording:
    """Return a recording whose first stamp is `start` (ns); equal arguments give equal arrays."""
    p = params if params is not None else ShipParams()
    rng = np.random.default_rng(seed)
    motion = _Motion(p, rng)
    n = round(p.duration * p.rate)
    t = np.arange(n) / p.rate
    body_n = motion.matrix(t).transpose(0, 2, 1)
    position = [motion.position(t + k * _STEP) for k in (-1, 0, 1)]
    acceleration = (position[0] - 2.0 * position[1] + position[2]) / _STEP**2
    acceleration[:, 2] += GRAVITY
    field = _FIELD * np.array([0.0, math.cos(_DIP * _DEGREE), -math.sin(_DIP * _DEGREE)])

    root_rate = math.sqrt(p.rate)
    walk = np.cumsum(rng.normal(size=(n, 3)), axis=0) * (p.gyro_walk * _DEGREE / root_rate)
    bias = _BIAS * _DEGREE + walk
    gyr = _rates(motion, t) + bias + rng.normal(size=(n, 3)) * (p.gyro_noise * _DEGREE * root_rate)
    acc = np.einsum('nij,nj->ni', body_n, acceleration)
    acc += rng.normal(size=(n, 3)) * (p.accel_noise * 1e-6 * GRAVITY * root_rate)
    mag = body_n @ field + p.mag_residual * _RESIDUAL + p.mag_noise * rng.normal(size=(n, 3))
    stamp = start + np.round(t * 1e9).astype(np.int64)
    return ShipRecording(stamp, gyr, acc, mag * 1e-6, _orientation(motion, t), bias)
