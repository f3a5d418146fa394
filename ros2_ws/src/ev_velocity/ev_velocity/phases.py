# SPDX-License-Identifier: Apache-2.0
"""Driving phase from pedals and acceleration: the paper's rules (15)–(17), made total.

The printed rules say nothing of both pedals at rest, of braking that does not slow the car, of an
accelerator that does not speed it up, of both pedals together, or of reverse. `classify` gives every input
exactly one phase and agrees with the printed rules wherever one of them applies.
"""

from __future__ import annotations

from enum import IntEnum

from numba import njit


class Phase(IntEnum):
    """What the driver does."""

    ACCELERATING = 0
    STEADY = 1
    BRAKING = 2
    COASTING = 3


@njit(cache=True, nogil=True)
def classify(accelerator, brake, acceleration, direction, a_threshold):
    """Return the phase (int) of pedals (0…1), acceleration (m/s², forward) and direction (±1).

    Brake pressed: BRAKING, whatever else. Accelerator pressed: ACCELERATING, STEADY or, where the car slows
    all the same (a hill, the motor's limit), COASTING. No pedal: COASTING.
    """
    along = acceleration * direction
    if brake > 0.0:
        return 2
    if accelerator > 0.0:
        if along > a_threshold:
            return 0
        return 1 if along >= -a_threshold else 3
    return 3


@njit(cache=True, nogil=True)
def classify_printed(accelerator, brake, acceleration, a_threshold, pedal_threshold, previous):
    """Return the phase by rules (15)–(17) as printed; where none applies the `previous` one stays."""
    if accelerator > 0.0 and acceleration > a_threshold and brake == 0.0:
        return 0
    if 0.0 < accelerator <= pedal_threshold and abs(acceleration) <= a_threshold and brake == 0.0:
        return 1
    if accelerator == 0.0 and acceleration <= -a_threshold and brake > 0.0:
        return 2
    return previous
