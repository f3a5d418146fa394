# SPDX-License-Identifier: Apache-2.0
"""X mixer with sequential desaturation, and the way from thrust fraction to pulse width.

Thrust of motor i = throttle + ROLL_SIGN[i]·roll + PITCH_SIGN[i]·pitch + YAW_SIGN[i]·yaw, all in fractions
of one motor's full thrust (signs in `craft`). Roll and pitch come first: throttle gives way to them up and
down; yaw gets what is left. The paper's formulas are the same up to the signs of pitch and yaw, see README.
"""

from __future__ import annotations

import math

from numba import njit

# The signs of `craft.MOTORS` unrolled: front left, front right, rear left, rear right.


@njit(cache=True, nogil=True)
def mix(roll, pitch, yaw, throttle, low, high, thrust, achieved):
    """Fill `thrust` (4,) within [low, high] and `achieved` (4,) with what of each demand was given.

    All arguments are finite thrust fractions, low < high. Roll and pitch are kept in full whenever some
    throttle allows them; where none does, both shrink by one factor, so that the axis of the torque stays.
    """
    a = abs(roll) + abs(pitch)
    span = high - low
    # The four motors see ±roll ± pitch in all combinations: largest difference 2(|roll| + |pitch|).
    scale = 1.0
    if 2.0 * a > span:
        scale = span / (2.0 * a)
    r = roll * scale
    p = pitch * scale
    a = min(a * scale, 0.5 * span)
    t = min(max(throttle, low + a), high - a)
    # Each motor has its own room for yaw; the one with the least decides.
    room = span
    direction = 1.0 if yaw >= 0.0 else -1.0
    for m in range(4):
        base = _base(m, r, p, t)
        sign = direction if m == 1 or m == 2 else -direction
        room = min(room, (high - base) if sign > 0.0 else (base - low))
    y = direction * min(abs(yaw), max(room, 0.0))
    for m in range(4):
        value = _base(m, r, p, t) + (y if m == 1 or m == 2 else -y)
        thrust[m] = min(max(value, low), high)
    achieved[0] = r
    achieved[1] = p
    achieved[2] = y
    achieved[3] = t


@njit(cache=True, nogil=True)
def _base(m, r, p, t):
    return t + (r if m == 0 or m == 2 else -r) + (p if m >= 2 else -p)


@njit(cache=True, nogil=True)
def duty_from_thrust(thrust, curve, voltage_ratio):
    """Return the duty 0…1 that gives a thrust fraction.

    thrust = c·d² + (1 − c)·d with ``c = curve``, d = duty × voltage_ratio; `voltage_ratio` is the battery
    voltage over that of full thrust. Linearises the loop: its gain no longer depends on throttle or charge.
    """
    t = min(max(thrust, 0.0), 1.0)
    b = 1.0 - curve
    # The rationalised root: exact for a linear curve too.
    d = 2.0 * t / (b + math.sqrt(b * b + 4.0 * curve * t)) if t > 0.0 else 0.0
    return min(d / voltage_ratio, 1.0)


@njit(cache=True, nogil=True)
def pulses_from_thrust(thrust, curve, voltage_ratio, pulse_min, pulse_max, pulses):
    """Fill `pulses` (4,) µs for thrust fractions (4,)."""
    for m in range(4):
        pulses[m] = pulse_min + (pulse_max - pulse_min) * duty_from_thrust(thrust[m], curve, voltage_ratio)
