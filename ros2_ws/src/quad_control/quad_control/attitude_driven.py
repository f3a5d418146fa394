# SPDX-License-Identifier: Apache-2.0
"""Gyro-driven attitude filter for a multirotor: multiplicative error state with gyro bias and velocity.

In free flight an accelerometer measures thrust and drag, hardly any tilt. So it does not correct the
attitude here; it drives a velocity, and two weak facts about multirotors correct that velocity: rotor drag
makes the horizontal specific force −d·v (Leishman, Abeywardena, IEEE CSM 34(1), 2014), and a craft does not
run away from hover for ever (velocity = 0 with a wide noise, less wide for the climb). Tilt and gyro bias
follow through the covariance. While the craft stands (`attitude_model` decides) velocity = 0 holds tightly
instead, which levels it.

Error state (9,): attitude error in the local-level frame (rad, ``q_true = exp(error) q``), gyro bias
(rad/s, body), velocity (m/s, ENU). Source of the error equations: Sola (2017), global angular error.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from kalman_core.rotation import matrix_from_quat, quat_from_rotvec, quat_multiply
from quad_control.params import GRAVITY

N = 9
# A specific force below this (m/s²) has no direction.
_LEAST_FORCE = 1e-6


@njit(cache=True, nogil=True)
def tilt_quaternion(fx, fy, fz):
    """Return the shortest rotation (4,) ``q_nb`` that turns the specific force upwards (heading near 0).

    Without a force there is no direction: level.
    """
    norm = math.sqrt(fx * fx + fy * fy + fz * fz)
    if norm < _LEAST_FORCE:
        return np.array([1.0, 0.0, 0.0, 0.0])
    w = 1.0 + fz / norm
    if w < 1e-9:  # upside down: any horizontal axis serves
        return np.array([0.0, 1.0, 0.0, 0.0])
    scale = 1.0 / math.sqrt(2.0 * w)
    return np.array([w * scale, fy / norm * scale, -fx / norm * scale, 0.0])


@njit(cache=True, nogil=True)
def predict(q, b, v, P, gyro, force, dt, gyro_psd, bias_psd, force_psd):
    """Advance by `dt` (s) with bias-laden `gyro` (3,) rad/s and specific `force` (3,) m/s², in place.

    q (4,), b (3,), v (3,), P (9, 9); `*_psd` are power spectral densities (square of the root densities).
    """
    q[:] = quat_multiply(q, quat_from_rotvec((gyro - b) * dt))
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    q /= norm
    R = matrix_from_quat(q)
    fn = np.empty(3)
    for i in range(3):
        fn[i] = R[i, 0] * force[0] + R[i, 1] * force[1] + R[i, 2] * force[2]
        v[i] += dt * fn[i]
    v[2] -= dt * GRAVITY
    # F = I + dt·[[0, −R, 0], [0, 0, 0], [−[f_n]×, 0, 0]], applied to the rows, then to the columns.
    for j in range(N):
        t0, t1, t2 = P[0, j], P[1, j], P[2, j]
        for i in range(3):
            P[i, j] -= dt * (R[i, 0] * P[3, j] + R[i, 1] * P[4, j] + R[i, 2] * P[5, j])
        P[6, j] += dt * (fn[2] * t1 - fn[1] * t2)
        P[7, j] += dt * (fn[0] * t2 - fn[2] * t0)
        P[8, j] += dt * (fn[1] * t0 - fn[0] * t1)
    for i in range(N):
        t0, t1, t2 = P[i, 0], P[i, 1], P[i, 2]
        for j in range(3):
            P[i, j] -= dt * (R[j, 0] * P[i, 3] + R[j, 1] * P[i, 4] + R[j, 2] * P[i, 5])
        P[i, 6] += dt * (fn[2] * t1 - fn[1] * t2)
        P[i, 7] += dt * (fn[0] * t2 - fn[2] * t0)
        P[i, 8] += dt * (fn[1] * t0 - fn[0] * t1)
    for i in range(3):
        P[i, i] += gyro_psd * dt
        P[3 + i, 3 + i] += bias_psd * dt
        P[6 + i, 6 + i] += force_psd * dt


@njit(cache=True, nogil=True)
def update(q, b, v, P, h, innovation, variance):
    """Correct with one scalar measurement of row `h` (9,), in place. Returns the normalised innovation²."""
    ph = np.zeros(N)
    s = variance
    for i in range(N):
        for j in range(N):
            ph[i] += P[i, j] * h[j]
        s += h[i] * ph[i]
    k = innovation / s
    for i in range(N):
        for j in range(i + 1):
            P[i, j] -= ph[i] * ph[j] / s
            P[j, i] = P[i, j]
    for i in range(3):
        b[i] += k * ph[3 + i]
        v[i] += k * ph[6 + i]
    q[:] = quat_multiply(quat_from_rotvec(k * ph[:3]), q)
    return innovation * innovation / s


@njit(cache=True, nogil=True)
def correct(q, b, v, P, force, dt, drag, drag_psd, hover_psd, climb_psd):
    """Correct with rotor drag along body x and y and with velocity = 0, in place.

    `drag` 1/s; `*_psd` are the noises' power spectral densities, so a sample of `dt` counts psd/dt: of the
    drag, of both horizontal velocities and of the vertical one.
    Returns the sum of both drag terms' normalised innovations squared (2 degrees of freedom), 0 without.
    """
    nis = 0.0
    h = np.zeros(N)
    if drag > 0.0:
        for axis in range(2):
            R = matrix_from_quat(q)
            c0, c1, c2 = R[0, axis], R[1, axis], R[2, axis]
            along = c0 * v[0] + c1 * v[1] + c2 * v[2]
            # A turn δ of the body moves its axis c by δ × c, and (δ × c)·v = δ·(c × v).
            h[0] = -drag * (c1 * v[2] - c2 * v[1])
            h[1] = -drag * (c2 * v[0] - c0 * v[2])
            h[2] = -drag * (c0 * v[1] - c1 * v[0])
            h[6], h[7], h[8] = -drag * c0, -drag * c1, -drag * c2
            nis += update(q, b, v, P, h, force[axis] + drag * along, drag_psd / dt)
    h[:] = 0.0
    for axis in range(3):
        h[6 + axis] = 1.0
        update(q, b, v, P, h, -v[axis], (climb_psd if axis == 2 else hover_psd) / dt)
        h[6 + axis] = 0.0
    return nis
