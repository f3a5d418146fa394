# SPDX-License-Identifier: Apache-2.0
"""The paper's multi-rate vector filter: 200 Hz gyro, 5 Hz low-pass, 5 Hz update (equations 1 to 18).

Attitude error in the level frame and gyro bias, six states. The print derives H by the four quaternion
components (an additive error) and applies the correction by multiplication; here both are multiplicative.
The covariance is either carried over each gyro step, or, as printed, over 0.2 s at once with the attitude
of that instant (`INSTANT`).
"""

import math

import numpy as np
from numba import njit

from kalman_core.rotation import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rotvec,
    quat_multiply,
    quat_normalize,
)

T, Q, BIAS, FORCE, FIELD, UPDATED, FIELD_SEEN, STARTED, RATE = 0, 1, 5, 8, 11, 14, 15, 16, 17
COV = 20
SIZE = COV + 36
GYRO_NOISE, BIAS_WALK, BIAS_SIGMA, FORCE_SIGMA, FIELD_SIGMA, INTERVAL, CUTOFF, DIP, DECLINATION, INSTANT = (
    range(10)
)
SETTINGS = 10
# A field older than this (s) says nothing of where north is now.
_FIELD_AGE = 1.0


@njit(cache=True, nogil=True)
def published_imu(state, c, t, gyro, force):
    """Use one gyro and accelerometer sample; return the summed NIS of an update, or -1 without one."""
    if state[STARTED] < 2.0:
        _settle(state, c, t, force)
        return -1.0
    dt = t - state[T]
    state[T] = t
    cov = state[COV:].reshape(6, 6)
    rate = gyro - state[BIAS : BIAS + 3]
    state[RATE : RATE + 3] = rate
    state[Q : Q + 4] = quat_normalize(quat_multiply(state[Q : Q + 4], quat_from_rotvec(dt * rate)))
    state[FORCE : FORCE + 3] += _weight(c, dt) * (force - state[FORCE : FORCE + 3])
    if c[INSTANT] == 0.0:
        _carry(state, cov, c, dt)
    since = t - state[UPDATED]
    if since < c[INTERVAL] - 1e-6:
        return -1.0
    state[UPDATED] = t
    if c[INSTANT] != 0.0:
        _carry(state, cov, c, since)
    return _correct(state, cov, c)


@njit(cache=True, nogil=True)
def published_mag(state, c, t, field):
    """Smooth one magnetic field (3,) [T]; it is used at the next update."""
    if state[FIELD_SEEN] == 0.0 or t - state[FIELD_SEEN] > _FIELD_AGE:
        state[FIELD : FIELD + 3] = field
    else:
        state[FIELD : FIELD + 3] += _weight(c, t - state[FIELD_SEEN]) * (field - state[FIELD : FIELD + 3])
    state[FIELD_SEEN] = t


@njit(cache=True, nogil=True)
def _weight(c, dt):
    dt = max(dt, 0.0)
    return dt / (dt + 1.0 / (2.0 * math.pi * c[CUTOFF]))


@njit(cache=True, nogil=True)
def _settle(state, c, t, force):
    """Fill the low-pass for 1 s, then take the attitude from gravity and field (TRIAD)."""
    if state[STARTED] == 0.0:
        state[STARTED] = 1.0
        state[UPDATED] = t
        state[FORCE : FORCE + 3] = force
    else:
        state[FORCE : FORCE + 3] += _weight(c, t - state[T]) * (force - state[FORCE : FORCE + 3])
    state[T] = t
    norm = math.sqrt(np.sum(state[FORCE : FORCE + 3] ** 2))
    if t - state[UPDATED] < 1.0 or norm < 1.0:
        return
    up = state[FORCE : FORCE + 3] / norm
    ahead = np.array([1.0, 0.0, 0.0]) if state[FIELD_SEEN] == 0.0 else state[FIELD : FIELD + 3].copy()
    ahead -= (ahead @ up) * up
    length = math.sqrt(ahead @ ahead)
    if length == 0.0:
        return
    ahead /= length
    left = np.array(
        [
            up[1] * ahead[2] - up[2] * ahead[1],
            up[2] * ahead[0] - up[0] * ahead[2],
            up[0] * ahead[1] - up[1] * ahead[0],
        ]
    )
    mat = np.empty((3, 3))
    # Rows: east, north, up in body axes; the field shows magnetic north.
    sine, cosine = math.sin(c[DECLINATION]), math.cos(c[DECLINATION])
    mat[0] = -cosine * left + sine * ahead
    mat[1] = cosine * ahead + sine * left
    mat[2] = up
    state[Q : Q + 4] = quat_from_matrix(mat)
    cov = state[COV:].reshape(6, 6)
    cov[:] = 0.0
    for i in range(3):
        cov[i, i] = 0.1**2
        cov[3 + i, 3 + i] = c[BIAS_SIGMA] ** 2
    if state[FIELD_SEEN] == 0.0:
        cov[2, 2] = math.pi**2
    state[STARTED] = 2.0
    state[UPDATED] = t


@njit(cache=True, nogil=True)
def _carry(state, cov, c, dt):
    transition = np.eye(6)
    transition[:3, 3:] = -dt * matrix_from_quat(state[Q : Q + 4])
    cov[:] = transition @ cov @ transition.T
    for i in range(3):
        cov[i, i] += c[GYRO_NOISE] ** 2 * dt
        cov[3 + i, 3 + i] += c[BIAS_WALK] ** 2 * dt


@njit(cache=True, nogil=True)
def _correct(state, cov, c):
    """Update with the unit vectors of gravity and field (equations 7 to 18), rotated into the level frame."""
    mat = matrix_from_quat(state[Q : Q + 4])
    count = 0
    h = np.zeros((6, 6))
    innovation = np.zeros(6)
    variance = np.ones(6)
    horizontal = math.cos(c[DIP])
    reference = np.array(
        [horizontal * math.sin(c[DECLINATION]), horizontal * math.cos(c[DECLINATION]), -math.sin(c[DIP])]
    )
    for source in range(2):
        if source == 1 and state[T] - state[FIELD_SEEN] > _FIELD_AGE:
            continue
        vector = state[FORCE : FORCE + 3] if source == 0 else state[FIELD : FIELD + 3]
        norm = math.sqrt(np.sum(vector**2))
        if norm == 0.0:
            continue
        expected = np.array([0.0, 0.0, 1.0]) if source == 0 else reference
        # R_true z = expected with R_true = (1 + [error x]) R: R z = expected + [expected x] error.
        innovation[count : count + 3] = mat @ (vector / norm) - expected
        x, y, z = expected[0], expected[1], expected[2]
        h[count, 1], h[count, 2] = -z, y
        h[count + 1, 0], h[count + 1, 2] = z, -x
        h[count + 2, 0], h[count + 2, 1] = -y, x
        variance[count : count + 3] = (c[FORCE_SIGMA] if source == 0 else c[FIELD_SIGMA]) ** 2
        count += 3
    if count == 0:
        return -1.0
    hc = h[:count].copy()
    s = hc @ cov @ hc.T
    for i in range(count):
        s[i, i] += variance[i]
    gain = np.linalg.solve(s, hc @ cov).T
    error = gain @ innovation[:count]
    kept = np.eye(6) - gain @ hc
    updated = kept @ cov @ kept.T
    for i in range(6):
        for j in range(6):
            for m in range(count):
                updated[i, j] += gain[i, m] * variance[m] * gain[j, m]
    cov[:] = 0.5 * (updated + updated.T)
    state[Q : Q + 4] = quat_normalize(quat_multiply(quat_from_rotvec(error[:3].copy()), state[Q : Q + 4]))
    state[BIAS : BIAS + 3] += error[3:]
    return innovation[:count] @ np.linalg.solve(s, innovation[:count].copy())


@njit(cache=True, nogil=True)
def published_run(state, c, imu_t, gyro, force, mag_t, mag, out):
    """Run over a whole recording; out (N, 4) gets the quaternion after each IMU sample."""
    m = 0
    for i in range(len(imu_t)):
        while m < len(mag_t) and mag_t[m] < imu_t[i]:
            published_mag(state, c, mag_t[m], mag[m])
            m += 1
        published_imu(state, c, imu_t[i], gyro[i], force[i])
        out[i] = state[Q : Q + 4]
