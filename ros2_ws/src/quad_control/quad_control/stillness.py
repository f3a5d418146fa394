# SPDX-License-Identifier: Apache-2.0
"""Still windows: the mean gyro of a craft at rest is its bias. Welford's running moments in a flat array."""

from __future__ import annotations

import math

from numba import njit

# Layout of the (14,) array: time in window (s), samples, mean and sum of squares of gyro and accelerometer.
_TIME, _MEAN, _SQUARES = 0, 2, 8
COUNT, GYRO, FORCE = 1, slice(2, 5), slice(5, 8)
SIZE = 14
# Below this many samples a spread says nothing.
_LEAST_SAMPLES = 10


@njit(cache=True, nogil=True)
def clear(w):
    """Start a new window, in place."""
    for i in range(SIZE):
        w[i] = 0.0


@njit(cache=True, nogil=True)
def add(w, gyro, force, dt, length, rate_spread, force_spread, largest_mean):
    """Add a sample (3,), (3,) after `dt` (s) to the window `w` (14,).

    Returns 0 while the window of `length` (s) is open, 1 when it closed and the craft was still, 2 when it
    closed and it was not; the caller reads the means w[GYRO] and w[FORCE] after a 1
    and clears the window. Still: spreads (σ) of gyro and accelerometer under `rate_spread` (rad/s) and
    `force_spread` (m/s²), mean rate under `largest_mean` (rad/s) on each axis.
    """
    w[_TIME] += dt
    w[COUNT] += 1.0
    n = w[COUNT]
    for i in range(6):
        value = gyro[i] if i < 3 else force[i - 3]
        delta = value - w[_MEAN + i]
        w[_MEAN + i] += delta / n
        w[_SQUARES + i] += delta * (value - w[_MEAN + i])
    if w[_TIME] < length:
        return 0
    if n < _LEAST_SAMPLES:
        return 2
    for i in range(6):
        spread = math.sqrt(w[_SQUARES + i] / (n - 1.0))
        if spread > (rate_spread if i < 3 else force_spread):
            return 2
        if i < 3 and abs(w[_MEAN + i]) > largest_mean:
            return 2
    return 1


@njit(cache=True, nogil=True)
def force_spread(w):
    """Return the largest spread (σ, m/s²) of the accelerometer's axes in the window."""
    largest = 0.0
    for i in range(3, 6):
        largest = max(largest, w[_SQUARES + i])
    return math.sqrt(largest / max(w[COUNT] - 1.0, 1.0))
