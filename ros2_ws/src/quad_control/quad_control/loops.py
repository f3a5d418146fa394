# SPDX-License-Identifier: Apache-2.0
"""Control loops of one axis as kernels: the published PID and the rate PID of the cascade.

Sources: paper 000, eq. 1; Astrom and Hagglund, "Advanced PID Control" (2006), chapters 3 and 6, for
derivative on the measurement, setpoint weighting and conditional integration; Bristow-Johnson's audio
cookbook for the bilinear notch.
"""

from __future__ import annotations

import math

from numba import njit

# Flat state of one axis.
RATE, N_X1, N_X2, N_Y1, N_Y2, LAST_RATE, DERIVATIVE, INTEGRAL, LAST_ERROR, STEP_I, PRIMED = range(11)
AXIS_SIZE = 11


@njit(cache=True, nogil=True)
def low_pass_factor(cutoff, dt):
    """Return the blend of a first-order low-pass (Hz, s); 1 lets all through, for a cutoff of 0."""
    if cutoff <= 0.0:
        return 1.0
    return 1.0 - math.exp(-2.0 * math.pi * cutoff * dt)


@njit(cache=True, nogil=True)
def notch(s, value, frequency, quality, dt):
    """Return `value` through a second-order notch at `frequency` (Hz), state in `s`; off at 0 or Nyquist."""
    if frequency <= 0.0 or frequency >= 0.45 / dt:
        return value
    w = 2.0 * math.pi * frequency * dt
    alpha = math.sin(w) / (2.0 * quality)
    c = -2.0 * math.cos(w)
    a0 = 1.0 + alpha
    y = (value + c * s[N_X1] + s[N_X2] - c * s[N_Y1] - (1.0 - alpha) * s[N_Y2]) / a0
    s[N_X2] = s[N_X1]
    s[N_X1] = value
    s[N_Y2] = s[N_Y1]
    s[N_Y1] = y
    return y


@njit(cache=True, nogil=True)
def prime(s, rate):
    """Fill the filters with the present rate (rad/s), so that the first derivative is zero."""
    for i in (RATE, N_X1, N_X2, N_Y1, N_Y2, LAST_RATE):
        s[i] = rate
    s[DERIVATIVE] = 0.0
    s[PRIMED] = 1.0


@njit(cache=True, nogil=True)
def rate_step(s, rate, target, kp, ki, kd, weight, limit, d_cutoff, cutoff, notch_hz, notch_q, dt):
    """Return the torque demand (thrust fraction) of the rate PID; state `s` (11,) in place.

    `rate` and `target` rad/s; gains per rad/s (kp), per rad (ki), per rad/s² (kd); `limit` bounds the
    integral term; cutoffs Hz, 0 = off. The derivative acts on the filtered rate only.
    """
    if s[PRIMED] == 0.0:
        prime(s, rate)
    value = notch(s, rate, notch_hz, notch_q, dt)
    s[RATE] += low_pass_factor(cutoff, dt) * (value - s[RATE])
    slope = (s[RATE] - s[LAST_RATE]) / dt
    s[LAST_RATE] = s[RATE]
    s[DERIVATIVE] += low_pass_factor(d_cutoff, dt) * (slope - s[DERIVATIVE])
    error = target - s[RATE]
    s[STEP_I] = ki * error * dt
    s[INTEGRAL] = min(max(s[INTEGRAL] + s[STEP_I], -limit), limit)
    return kp * (weight * target - s[RATE]) + s[INTEGRAL] - kd * s[DERIVATIVE]


@njit(cache=True, nogil=True)
def published_step(s, error, kp, ki, kd, scale, dt):
    """Return the torque demand of the printed PID on the angle error (rad), eq. 1, no limits, no filters.

    `scale` turns its output into a thrust fraction. The integral keeps Ki inside, so that a change of Ki
    alone moves nothing.
    """
    if s[PRIMED] == 0.0:
        s[LAST_ERROR] = error
        s[PRIMED] = 1.0
    slope = (error - s[LAST_ERROR]) / dt
    s[LAST_ERROR] = error
    s[STEP_I] = scale * ki * error * dt
    s[INTEGRAL] += s[STEP_I]
    return scale * (kp * error + kd * slope) + s[INTEGRAL]


@njit(cache=True, nogil=True)
def unwind(s, demand, achieved):
    """Take back this step's integration when the mixer gave less than the demand and it pushed on."""
    if (demand - achieved) * s[STEP_I] > 0.0:
        s[INTEGRAL] -= s[STEP_I]
