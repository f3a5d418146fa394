# SPDX-License-Identifier: Apache-2.0
"""A new ephemeris between two epochs: what is kept of the earlier one is brought to the new orbit and clock.

A satellite's orbit and clock step by decimetres to metres from one ephemeris to the next, code and carrier do
not. What the filter keeps over an epoch refers to the old ephemeris: the satellite's place and clock at the
start of the carrier difference, the slow error of the code, and the corrections of a base that were made with
it. The step shows in the observations themselves: over the time between two transmissions, an orbit moves by
the mean of the velocities at its ends, and a clock by that of the drifts.
"""

import math

import numpy as np
from numba import njit

from ins_gps.constants import SPEED_OF_LIGHT
from ins_gps.layout import (
    C_CODE,
    C_CORRECTED,
    C_DRIFT,
    C_SAT,
    C_SATCLK,
    C_SLOW,
    C_VELOCITY,
    K_SHIFT,
    K_SHIFT_NSEC,
    K_SHIFT_SEC,
    NSEC,
    SEC,
)
from ins_gps.orbit import range_and_rate

# A step below this (m) is within the noise of the carrier.
_LEAST = 0.005
# m/s³: the third derivative of a GNSS orbit over 12 is 7e-6; three times that is no step.
_CURVATURE = 2e-5
# s: beyond it what the curvature leaves open is as large as a step.
_LONGEST = 30.0
# m: no ephemeris is off by as much.
_MOST = 100.0
# m: a code that leaves its range by more tells of a jump of the receiver's clock, not when it was sent.
_CLOCK_JUMP = 3e4


@njit(cache=True, nogil=True)
def keep_orbit(state, at, row):
    """Keep a row's satellite and code with its channel, which begins at `at`."""
    for k in range(3):
        state[at + C_SAT + k] = row[9 + k]
    state[at + C_SATCLK] = SPEED_OF_LIGHT * row[15]
    state[at + C_CODE] = 0.0
    whole = row[3] + row[12] + row[13] + row[14] + row[16]
    if math.isfinite(whole) and row[12] * row[12] + row[13] * row[13] + row[14] * row[14] > 0.0:
        state[at + C_CODE] = row[3]
        state[at + C_DRIFT] = SPEED_OF_LIGHT * row[16]
        for k in range(3):
            state[at + C_VELOCITY + k] = row[12 + k]


@njit(cache=True, nogil=True)
def follow_orbit(state, at, slot, estimated, row, site, dt):
    """Bring the channel at `at` to the ephemeris of `row`, dt (s) after it was kept; return the step (m).

    slot: start of the satellite's corrections; estimated: whether slow errors are states; site: (3,) antenna,
    ECEF m. The step is that of the modelled pseudorange, range minus satellite clock; 0 if there is none.
    """
    if state[at + C_CODE] == 0.0 or not 0.0 < dt <= _LONGEST:
        return 0.0
    if not math.isfinite(row[3] + row[12] + row[13] + row[14] + row[16]):
        return 0.0
    zero, los = np.zeros(3), np.empty(3)
    now = range_and_rate(row[9:15], site, zero, los)[0]
    before = range_and_rate(state[at + C_SAT : at + C_SAT + 6], site, zero, los)[0]
    clock = SPEED_OF_LIGHT * row[15]
    received = row[3] - state[at + C_CODE]
    if abs(received - (now - before) + clock - state[at + C_SATCLK]) > _CLOCK_JUMP:
        return 0.0
    # By the satellite's own clock: reception less travel time.
    sent = dt - (received + clock - state[at + C_SATCLK]) / SPEED_OF_LIGHT
    place = np.zeros(6)  # where the new ephemeris has the satellite at the earlier epoch
    for k in range(3):
        place[k] = row[9 + k] - 0.5 * (row[12 + k] + state[at + C_VELOCITY + k]) * sent
    clock -= 0.5 * (SPEED_OF_LIGHT * row[16] + state[at + C_DRIFT]) * sent
    step = range_and_rate(place, site, zero, los)[0] - before - (clock - state[at + C_SATCLK])
    if not _LEAST + _CURVATURE * dt * dt * dt < abs(step) < _MOST:
        return 0.0
    for k in range(3):
        state[at + C_SAT + k] = place[k]
    state[at + C_SATCLK] = clock
    if state[at + C_CORRECTED] == 0.0:
        if estimated:
            state[at + C_SLOW] -= step
    elif state[slot + K_SHIFT_SEC] != state[SEC] or state[slot + K_SHIFT_NSEC] != state[NSEC]:
        # Base and receiver choose alike: what the base made until now, it made with the old ephemeris.
        state[slot + K_SHIFT] = step
        state[slot + K_SHIFT_SEC], state[slot + K_SHIFT_NSEC] = state[SEC], state[NSEC]
    return step
