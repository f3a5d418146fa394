# SPDX-License-Identifier: Apache-2.0
"""Linear algebra of the attitude filter's error state; model and sources: see `attitude_kernel`."""

import math

from numba import njit

from imu_kalman.attitude_layout import (
    ACC_PSD,
    BIAS,
    BIAS_PSD,
    CORRECTION,
    GAIN,
    GRAVITY_NORM,
    GYRO_PSD,
    HALF,
    OMEGA_MIN,
    PH,
    PHI,
    RATE2,
    ROT,
    SCALE_PSD,
    SPAN,
    START_VEL_VAR,
    TILT_VAR,
    UNKNOWN_ANGLE_VAR,
    VECTORS,
    VEL,
    N,
    Q,
)


@njit(cache=True, nogil=True)
def turn(state, x, y, z):
    """Left-multiply the attitude by the exponential of the rotation vector (x, y, z) [rad], exactly."""
    h2 = 0.25 * (x * x + y * y + z * z)
    h = math.sqrt(h2)
    c = math.cos(h)
    s = 0.5 * math.sin(h) / h if h > 1e-6 else 0.5
    x *= s
    y *= s
    z *= s
    q0, q1, q2, q3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    a0 = c * q0 - x * q1 - y * q2 - z * q3
    a1 = c * q1 + x * q0 + y * q3 - z * q2
    a2 = c * q2 - x * q3 + y * q0 + z * q1
    a3 = c * q3 + x * q2 - y * q1 + z * q0
    n = 1.0 / math.sqrt(a0 * a0 + a1 * a1 + a2 * a2 + a3 * a3)
    state[Q] = a0 * n
    state[Q + 1] = a1 * n
    state[Q + 2] = a2 * n
    state[Q + 3] = a3 * n


@njit(cache=True, nogil=True)
def whole_turn(state, before, out):
    """Write the rotation vector (rad) that leads from the attitude `before` (4,) to the present one."""
    b0, b1, b2, b3 = before[0], before[1], before[2], before[3]
    q0, q1, q2, q3 = state[Q], state[Q + 1], state[Q + 2], state[Q + 3]
    w = q0 * b0 + q1 * b1 + q2 * b2 + q3 * b3
    x = q1 * b0 - q0 * b1 + q3 * b2 - q2 * b3
    y = q2 * b0 - q0 * b2 + q1 * b3 - q3 * b1
    z = q3 * b0 - q0 * b3 + q2 * b1 - q1 * b2
    sine = math.sqrt(x * x + y * y + z * z)
    sign = 1.0 if w >= 0.0 else -1.0
    scale = sign * 2.0 * math.atan2(sine, sign * w) / sine if sine > 1e-12 else sign * 2.0
    out[0] = scale * x
    out[1] = scale * y
    out[2] = scale * z


@njit(cache=True, nogil=True)
def inject(state, work, scale):
    """Apply the correction ``gain * scale`` (N,) to attitude, bias, velocity and position, and sum it.

    Velocity and position turn with the attitude, whose tilt moves them only by what is not followed (height).
    """
    gain = work[VECTORS, GAIN]
    for i in range(N):
        work[VECTORS, CORRECTION, i] += gain[i] * scale
    angle = gain[2] * scale
    turn(state, gain[0] * scale, gain[1] * scale, angle)
    c, s = math.cos(angle), math.sin(angle)
    for i in range(3):
        state[BIAS + i] += gain[3 + i] * scale
    for k in range(2):
        first = VEL + 2 * k
        x, y = state[first], state[first + 1]
        state[first] = c * x - s * y + gain[6 + 2 * k] * scale
        state[first + 1] = s * x + c * y + gain[7 + 2 * k] * scale


@njit(cache=True, nogil=True)
def turned_since(work, h):
    """Return what the attitude corrections of this block change in a measurement of row `h`."""
    correction = work[VECTORS, CORRECTION]
    return h[0] * correction[0] + h[1] * correction[1] + h[2] * correction[2]


@njit(cache=True, nogil=True)
def transition(state, phi):
    """Fill the (N, N) transition matrix of the block; its structure is described in `propagate`."""
    span = state[SPAN]
    gain = GRAVITY_NORM * span
    phi[:] = 0.0
    for i in range(N):
        phi[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            phi[i, 3 + j] = -state[ROT + 3 * i + j]
    phi[6, 1] = gain
    phi[7, 0] = -gain
    for j in range(3):
        # Constant bias over the block: it acts on velocity through half of the span.
        phi[6, 3 + j] = -0.5 * gain * state[ROT + 3 + j]
        phi[7, 3 + j] = 0.5 * gain * state[ROT + j]
    for i in range(2):
        for j in range(3):
            phi[8 + i, j] = 0.5 * span * phi[6 + i, j]
            phi[8 + i, 3 + j] = span / 3.0 * phi[6 + i, 3 + j]
        phi[8 + i, 6 + i] = span


@njit(cache=True, nogil=True)
def propagate(state, par, work, cov):
    """Move `cov` over the block: ``cov = phi cov phi' + Q`` (phi is left in work[PHI])."""
    phi = work[PHI]
    half = work[HALF]
    transition(state, phi)
    for j in range(N):
        for i in range(3):
            s = cov[i, j]
            for k in range(3, 6):
                s += phi[i, k] * cov[k, j]
            half[i, j] = s
            half[3 + i, j] = cov[3 + i, j]
        for i in range(6, 8):
            s = cov[i, j]
            t = cov[i + 2, j] + phi[i + 2, i] * cov[i, j]
            for k in range(6):
                s += phi[i, k] * cov[k, j]
                t += phi[i + 2, k] * cov[k, j]
            half[i, j] = s
            half[i + 2, j] = t
    for i in range(N):
        for j in range(3):
            s = half[i, j]
            for k in range(3, 6):
                s += half[i, k] * phi[j, k]
            cov[i, j] = s
            cov[i, 3 + j] = half[i, 3 + j]
        for j in range(6, 8):
            s = half[i, j]
            t = half[i, j + 2] + half[i, j] * phi[j + 2, j]
            for k in range(6):
                s += half[i, k] * phi[j, k]
                t += half[i, k] * phi[j + 2, k]
            cov[i, j] = s
            cov[i, j + 2] = t
    span = state[SPAN]
    attitude_var = par[GYRO_PSD] * span + par[SCALE_PSD] * state[RATE2]
    for i in range(3):
        cov[i, i] += attitude_var
        cov[3 + i, 3 + i] += par[BIAS_PSD] * span
    for i in range(6, 8):
        cov[i, i] += par[ACC_PSD] * span
    for i in range(N):
        for j in range(i):
            cov[i, j] = cov[j, i]


@njit(cache=True, nogil=True)
def scalar_update(state, cov, work, h, innovation, variance, considered):
    """Correct with one scalar measurement of row `h` (N,) and noise `variance`.

    With `considered` only heading and bias are corrected and the covariance is that of this smaller gain.
    Returns the variance of the innovation.
    """
    ph = work[VECTORS, PH]
    gain = work[VECTORS, GAIN]
    s = variance
    for i in range(N):
        t = 0.0
        for j in range(N):
            t += cov[i, j] * h[j]
        ph[i] = t
        s += h[i] * t
    for i in range(N):
        gain[i] = ph[i]
    if considered:
        gain[0] = 0.0
        gain[1] = 0.0
        for i in range(6, N):
            gain[i] = 0.0
    inverse = 1.0 / s
    for i in range(N):
        for j in range(i + 1):
            # P - K h'P - P h K' + K s K', which for the full gain is the usual P - K s K'.
            t = cov[i, j] + inverse * (gain[i] * gain[j] - gain[i] * ph[j] - ph[i] * gain[j])
            cov[i, j] = t
            cov[j, i] = t
    inject(state, work, innovation * inverse)
    return s


@njit(cache=True, nogil=True)
def start_covariance(state, par, cov):
    """Set the covariance of a start: tilt, speed and place as the parameters say, heading unknown.

    The variances of the bias are kept, its correlations are not.
    """
    for i in range(N):
        for j in range(N):
            if i != j:
                cov[i, j] = 0.0
    for i in range(2):
        cov[i, i] = par[TILT_VAR]
        cov[6 + i, 6 + i] = par[START_VEL_VAR]
        cov[8 + i, 8 + i] = par[START_VEL_VAR] / par[OMEGA_MIN] ** 2
    cov[2, 2] = UNKNOWN_ANGLE_VAR
