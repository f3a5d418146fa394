# SPDX-License-Identifier: Apache-2.0
"""A world that is exactly what the attitude filter assumes, to test whether its covariance is honest."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numba import njit

from imu_kalman.params import AttitudeParams
from imu_kalman.scenarios import GRAVITY, ShipRecording

# The recording needs the truth's fields only; the ship's tuple has them all.
MatchedRecording = ShipRecording
# Field strength (T) and dip (rad): any field that has a horizontal part would do.
_FIELD, _DIP = 50e-6, 1.0
# Angular rates (rad/s) and frequencies (Hz) of the commanded rotation about the body axes.
_RATE = np.array([0.5, 0.4, 0.3])
_FREQUENCY = np.array([0.31, 0.23, 0.17])


def matched_params(params: AttitudeParams | None = None) -> AttitudeParams:
    """Return `params` with everything switched off that the matched world does not contain.

    No adaptation to unknown levels, no delays and no lasting errors: what is left is the plain error-state
    filter with the noise densities of `params`.
    """
    return dataclasses.replace(
        params if params is not None else AttitudeParams(),
        motion_span=0.0,
        motion_share=0.0,
        mag_span=0.0,
        rate_noise=0.0,
        sensor_delay=0.0,
        mag_delay=0.0,
        delay_sigma=0.0,
        heading_sigma=0.0,
    )


@njit(cache=True, nogil=True)
def _simulate(noise, start, rate, dt, gravity, sigma, motion, heading, field):
    n = noise.shape[0]
    quat = np.empty((n, 4))
    bias = np.empty((n, 3))
    gyr = np.empty((n, 3))
    acc = np.empty((n, 3))
    mag = np.empty((n, 3))
    q = np.array((1.0, 0.0, 0.0, 0.0))
    b = start[:3].copy()
    v = start[3:5].copy()
    p = start[5:7].copy()
    body = np.zeros(3)
    for i in range(n):
        half = 0.5 * dt
        turn = 0.5 * half * (rate[i] + rate[max(i - 1, 0)])
        x, y, z = turn[0], turn[1], turn[2]
        h = math.sqrt(x * x + y * y + z * z)
        s = math.sin(h) / h if h > 1e-12 else 1.0
        c = math.cos(h)
        x, y, z = x * s, y * s, z * s
        q = np.array(
            (
                q[0] * c - q[1] * x - q[2] * y - q[3] * z,
                q[0] * x + q[1] * c + q[2] * z - q[3] * y,
                q[0] * y - q[1] * z + q[2] * c + q[3] * x,
                q[0] * z + q[1] * y - q[2] * x + q[3] * c,
            )
        )
        q /= math.sqrt((q * q).sum())
        quat[i] = q
        b += sigma[1] * noise[i, 0:3]
        bias[i] = b
        gyr[i] = rate[i] + b + sigma[0] * noise[i, 3:6]
        a = -2.0 * motion[0] * motion[1] * v - motion[1] ** 2 * p + sigma[3] * noise[i, 6:8]
        p += dt * (v + half * a)
        v += dt * a
        swing = heading * noise[i, 8]
        north = math.cos(swing), math.sin(swing)
        force = np.array((a[0], a[1], gravity))
        around = np.array((-north[1] * field[0], north[0] * field[0], field[1]))
        w, qx, qy, qz = q
        mat = np.array(
            (
                (1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - w * qz), 2 * (qx * qz + w * qy)),
                (2 * (qx * qy + w * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - w * qx)),
                (2 * (qx * qz - w * qy), 2 * (qy * qz + w * qx), 1 - 2 * (qx * qx + qy * qy)),
            )
        )
        for k in range(3):
            body[k] = mat[0, k] * force[0] + mat[1, k] * force[1] + mat[2, k] * force[2]
            mag[i, k] = mat[0, k] * around[0] + mat[1, k] * around[1] + mat[2, k] * around[2]
        acc[i] = body + sigma[2] * noise[i, 9:12]
    return quat, bias, gyr, acc, mag


def matched_world(
    params: AttitudeParams, seed: int, duration: float = 120.0, rate: float = 100.0
) -> MatchedRecording:
    """Return a recording drawn from the model of `params` (see `matched_params`)."""
    rng = np.random.default_rng(seed)
    n, dt, root = round(duration * rate), 1.0 / rate, math.sqrt(rate)
    omega = 2.0 * math.pi * params.motion_frequency
    t = np.arange(n) * dt
    turning = _RATE * np.sin(2.0 * math.pi * _FREQUENCY * t[:, None] + rng.uniform(0, 2 * math.pi, 3))
    start = rng.normal(size=7)
    start[:3] *= params.bias_sigma
    # The stationary state of the motion.
    speed = params.motion_noise / math.sqrt(4.0 * params.motion_damping * omega)
    start[3:5] *= speed
    start[5:] *= speed / omega
    sigma = np.array(
        [
            params.gyro_noise * root,
            params.bias_walk / root,
            params.accel_noise * root,
            params.motion_noise * root,
        ]
    )
    field = _FIELD * np.array([math.cos(_DIP), -math.sin(_DIP)])
    quat, bias, gyr, acc, mag = _simulate(
        rng.normal(size=(n, 12)),
        start,
        turning,
        dt,
        GRAVITY,
        sigma,
        np.array([params.motion_damping, omega]),
        params.mag_noise * root,
        field,
    )
    stamp = 10**9 + np.round(t * 1e9).astype(np.int64)
    return MatchedRecording(stamp, gyr, acc, mag, quat, bias)
