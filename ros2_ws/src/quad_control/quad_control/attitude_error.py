# SPDX-License-Identifier: Apache-2.0
"""Attitude error for the controller: a rotation vector in body axes, at any attitude."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from kalman_core.rotation import quat_conjugate, quat_from_euler, quat_multiply, rotvec_from_quat


@njit(cache=True, nogil=True)
def heading(q):
    """Return the yaw (rad) of a quaternion (4,)."""
    return math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))


@njit(cache=True, nogil=True)
def tilt_cosine(q):
    """Return the cosine of the angle between the body's z axis and up."""
    return 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])


@njit(cache=True, nogil=True)
def attitude_error(q, roll, pitch, yaw):
    """Return (x, y, z) [rad], body axes: turn by it to reach (roll, pitch, yaw) from ``q`` (4,).

    Tilt and heading are separated: the tilt error is the shortest turn of the body's z axis, so that a wrong
    heading never costs tilt authority; the heading error is what is left about z.
    Source: Brescianini, D'Andrea, "Tilt-prioritized quadrocopter attitude control", IEEE TCST 28(2), 2020.
    """
    # The wanted tilt is meant in the heading that the craft has, as a pilot sees it.
    here = math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    target = quat_from_euler(roll, pitch, here)
    e = quat_multiply(quat_conjugate(q), target)
    if e[0] < 0.0:
        e = -e
    # Split e = tilt * turn about z.
    norm = math.sqrt(e[0] * e[0] + e[3] * e[3])
    if norm < 1e-9:  # upside down: any axis is as short
        return math.pi, 0.0, 0.0
    tilt = np.empty(4)
    tilt[0] = norm
    tilt[1] = (e[0] * e[1] - e[2] * e[3]) / norm
    tilt[2] = (e[0] * e[2] + e[1] * e[3]) / norm
    tilt[3] = 0.0
    v = rotvec_from_quat(tilt)
    turn = yaw - here
    turn = turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
    return v[0], v[1], turn
