# SPDX-License-Identifier: Apache-2.0
"""Kernels of the paper's fusion: multirate Kalman filters, filtered acceleration, weighted mean (002).

A modified multirate Kalman filter (M-MKF) raises one slow speed to the fast rate. Between two samples it
corrects at every fast step with the residual predicted from the last sample z, which is carried forward
with the estimated acceleration: ε = z + τ·a − v, τ after the sample. One sample is thus used N times, and
its noise must count N-fold: N corrections with N·R are then one with R. As printed the noise is R.

Eq. (9) takes what the filters say at each fast step for new, though one slow sample is in hundreds of them:
as printed the variance is hundreds of times too small. `corrected` gives the bound that holds however the
errors hang together, the square of the weighted sum of the σ.
"""

from __future__ import annotations

import math

from numba import njit

from ev_velocity.phases import classify, classify_printed

# One M-MKF: speed, acceleration, their covariance, last sample, steps left and total, its time, used.
M_SPEED, M_ACCEL, M_P00, M_P01, M_P11, M_SAMPLE, M_LEFT, M_TOTAL, M_TIME, M_USED = range(10)
M_SIZE = 10
# Layout of the whole memory.
TIME, SPEED, ACCEL, ACCEL_P, PHASE, ACCELERATOR, BRAKE, DIRECTION = range(8)
RUNNING, VARIANCE, ANGLE, ANGLE_TIME, ANGLE_SENSE, STEP = range(8, 14)
WHEEL = 14
GPS = WHEEL + M_SIZE
SIZE = GPS + M_SIZE

# What is fixed while filtering; the σ of each sensor by phase are four consecutive entries.
(
    JERK_Q, ACCEL_Q, ACCEL_R, WHEEL_R, GPS_R, A_THRESHOLD, PEDAL_THRESHOLD, CORRECTED, STALE,
) = range(9)  # fmt: skip
SIGMA_WHEEL = 9
SIGMA_GPS = SIGMA_WHEEL + 4
SIGMA_ACCEL = SIGMA_GPS + 4
CONSTANTS = SIGMA_ACCEL + 4

NS = 1e-9
# P of an M-MKF at its first sample: speed from the sample, acceleration within a car's limits.
START_ACCEL_VARIANCE = 9.0  # (m/s²)²
# A slow sample is spread over at most so many fast steps: 2 s at 500 Hz.
MOST_STEPS = 1000.0


@njit(cache=True, nogil=True)
def multirate_sample(m, at, z, r, t, step):
    """Give the M-MKF at offset `at` the sample `z` (m/s) of time `t` (ns); `step` (s) is the fast one."""
    f = m[at : at + M_SIZE]
    if f[M_USED] == 0.0:
        f[:] = 0.0
        f[M_SPEED] = z
        f[M_P00] = r
        f[M_P11] = START_ACCEL_VARIANCE
        f[M_USED] = 1.0
    else:
        interval = (t - f[M_TIME]) * NS
        f[M_TOTAL] = min(max(1.0, math.floor(interval / step + 0.5)), MOST_STEPS)
        f[M_LEFT] = f[M_TOTAL]
        f[M_SAMPLE] = z
    f[M_TIME] = t


@njit(cache=True, nogil=True)
def multirate_step(m, at, dt, q, r, corrected):
    """Advance the M-MKF by the fast step `dt` (s) and correct with the predicted residual.

    `q`: power spectral density of the jerk; `r`: variance of a slow sample; see the module for `corrected`.
    """
    f = m[at : at + M_SIZE]
    f[M_SPEED] += dt * f[M_ACCEL]
    f[M_P00] += dt * (2.0 * f[M_P01] + dt * f[M_P11]) + q * dt * dt * dt / 3.0
    f[M_P01] += dt * f[M_P11] + q * dt * dt / 2.0
    f[M_P11] += q * dt
    if f[M_LEFT] <= 0.0:
        return
    f[M_LEFT] -= 1.0
    tau = (f[M_TOTAL] - f[M_LEFT]) * dt
    noise = r * f[M_TOTAL] if corrected else r
    # H = (1, −τ): the speed at the sample.
    p0 = f[M_P00] - tau * f[M_P01]
    p1 = f[M_P01] - tau * f[M_P11]
    s = p0 - tau * p1 + noise
    residual = f[M_SAMPLE] + tau * f[M_ACCEL] - f[M_SPEED]
    f[M_SPEED] += p0 / s * residual
    f[M_ACCEL] += p1 / s * residual
    f[M_P00] -= p0 * p0 / s
    f[M_P01] -= p0 * p1 / s
    f[M_P11] -= p1 * p1 / s


@njit(cache=True, nogil=True)
def weights(s1, s2, s3):
    """Return k1, k2, k3 of eqs. (12)–(14) from three standard deviations; the least-variance mean.

    The paper calls σ a variance and uses it as a standard deviation: it is one.
    """
    a, b, c = s1 * s1, s2 * s2, s3 * s3
    total = a * b + b * c + a * c
    return b * c / total, a * c / total, a * b / total


@njit(cache=True, nogil=True)
def fuse_step(m, constants, force, t):
    """Take the accelerometer reading `force` (m/s²) at `t` (ns): all filters one step, then the fusion.

    The integral of the acceleration starts each step from the fused speed: that is how it stays bounded.
    A sensor that is silent for STALE has infinite σ. Returns speed (m/s) and its variance.
    """
    dt = (t - m[TIME]) * NS
    if m[RUNNING] == 0.0 or dt <= 0.0:
        if m[RUNNING] == 0.0:
            m[TIME] = t
            m[ACCEL] = force
            m[RUNNING] = 1.0
        return m[SPEED], m[VARIANCE]
    m[TIME] = t
    m[STEP] = dt
    corrected = constants[CORRECTED] > 0.0
    m[ACCEL_P] += constants[ACCEL_Q] * dt
    gain = m[ACCEL_P] / (m[ACCEL_P] + constants[ACCEL_R])
    m[ACCEL] += gain * (force - m[ACCEL])
    m[ACCEL_P] *= 1.0 - gain
    multirate_step(m, WHEEL, dt, constants[JERK_Q], constants[WHEEL_R], corrected)
    multirate_step(m, GPS, dt, constants[JERK_Q], constants[GPS_R], corrected)
    if corrected:
        m[PHASE] = classify(
            m[ACCELERATOR], m[BRAKE], m[ACCEL], -1.0 if m[DIRECTION] < 0.0 else 1.0, constants[A_THRESHOLD]
        )
    else:
        m[PHASE] = classify_printed(
            m[ACCELERATOR], m[BRAKE], m[ACCEL], constants[A_THRESHOLD], constants[PEDAL_THRESHOLD], m[PHASE]
        )
    phase = int(m[PHASE])
    s1 = _sigma(m, WHEEL, constants[SIGMA_WHEEL + phase], t, constants)
    s2 = _sigma(m, GPS, constants[SIGMA_GPS + phase], t, constants)
    s3 = constants[SIGMA_ACCEL + phase]
    k1, k2, k3 = weights(s1, s2, s3)
    integrated = m[SPEED] + dt * m[ACCEL]
    m[SPEED] = k1 * m[WHEEL + M_SPEED] + k2 * m[GPS + M_SPEED] + k3 * integrated
    if corrected:
        own = math.sqrt(m[VARIANCE]) + dt * math.sqrt(constants[ACCEL_R])
        m[VARIANCE] = (k1 * s1 + k2 * s2 + k3 * own) ** 2
    else:
        # Eq. (9), with the fused speed's own variance in the integrated one.
        m[VARIANCE] = (k1 * s1) ** 2 + (k2 * s2) ** 2 + k3 * k3 * (m[VARIANCE] + dt * dt * constants[ACCEL_R])
    return m[SPEED], m[VARIANCE]


# σ (m/s) that stands for a sensor without a say.
SILENT = 1e6


@njit(cache=True, nogil=True)
def _sigma(m, at, sigma, t, constants):
    """Return `sigma`, or SILENT for an M-MKF without a recent sample."""
    f = m[at : at + M_SIZE]
    if f[M_USED] == 0.0 or (t - f[M_TIME]) * NS > constants[STALE]:
        return SILENT
    return sigma
