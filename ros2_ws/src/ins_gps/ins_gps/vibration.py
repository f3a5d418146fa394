# SPDX-License-Identifier: Apache-2.0
"""The noise that the IMU's own samples show: vibration that aliases, or an IMU worse than its data sheet.

The motion of a craft is smooth from sample to sample, and third differences leave next to nothing of it; of
white noise of variance σ² they have the variance 20 σ². What they show beyond the parameters' density counts
as noise of the axis. Vibration that is not white integrates to less: the covariance errs to the safe side.
"""

import math

import numpy as np
from numba import njit

from ins_gps.layout import NOISE_COUNT, NOISE_DIFFERENCES, NOISE_NSEC, NOISE_PSD, NOISE_SEC

# Axes of the rate, then of the specific force.
AXES = 6
_ORDER = 3
_GAIN = float(math.comb(2 * _ORDER, _ORDER))  # variance of the third difference of white noise of variance 1
_TIME = 5.0  # s, of the average
# A jolt or a glitch is no noise: one squared difference counts for this many times the average at most.
_LARGEST = 16.0


@njit(cache=True, nogil=True)
def measure_noise(state, rate, force, sec, nsec, gyro_floor, accel_floor, gap):
    """Take a sample into the densities of `state`, (rad/s)²/Hz and (m/s²)²/Hz by axis of the IMU.

    gyro_floor, accel_floor: those of the parameters, with which the average begins. Samples further apart
    than `gap` (s) are not differenced.
    """
    dt = (sec - state[NOISE_SEC]) + (nsec - state[NOISE_NSEC]) * 1e-9
    if dt == 0.0:
        return
    state[NOISE_SEC], state[NOISE_NSEC] = sec, nsec
    if not 0.0 < dt <= gap:
        state[NOISE_COUNT] = 0.0
    count = int(state[NOISE_COUNT])
    state[NOISE_COUNT] = min(count + 1, _ORDER)
    for k in range(AXES):
        at = NOISE_DIFFERENCES + _ORDER * k
        difference = rate[k] if k < 3 else force[k - 3]
        for j in range(_ORDER):
            before = state[at + j]
            state[at + j] = difference
            difference -= before
        if count == _ORDER:
            psd = max(state[NOISE_PSD + k], gyro_floor if k < 3 else accel_floor)
            shown = min(difference * difference * dt / _GAIN, _LARGEST * psd)
            state[NOISE_PSD + k] += min(dt / _TIME, 1.0) * (shown - state[NOISE_PSD + k])


@njit(cache=True, nogil=True)
def noise_density(state, first, floor, share, mat, out):
    """Fill `out` (3, 3) with the density of three axes from `first` on, turned by `mat` (3, 3).

    floor: of the parameters; share: 1, or 0 where nothing else counts.
    """
    psd = np.empty(3)
    for k in range(3):
        psd[k] = max(share * state[NOISE_PSD + first + k], floor)
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for k in range(3):
                out[i, j] += mat[i, k] * psd[k] * mat[j, k]
