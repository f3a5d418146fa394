# SPDX-License-Identifier: Apache-2.0
"""Differences of navigation solutions in the order of the filter's errors: m, m/s (NED), rad."""

import math

import numpy as np
from numba import njit

from kalman_core.earth import radii
from kalman_core.rotation import quat_conjugate, quat_from_rotvec, quat_multiply, rotvec_from_quat


@njit(cache=True, nogil=True)
def error_of(nav, truth):
    """Return the error (9,) that would turn `nav` (NAV,) into `truth`: m, m/s (NED), rad."""
    meridian, normal = radii(truth[0])
    height = truth[2]
    out = np.empty(9)
    out[0] = (truth[0] - nav[0]) * (meridian + height)
    out[1] = (truth[1] - nav[1]) * (normal + height) * math.cos(truth[0])
    out[2] = nav[2] - height
    out[3:6] = truth[3:6] - nav[3:6]
    out[6:9] = rotvec_from_quat(quat_multiply(truth[6:10], quat_conjugate(nav[6:10])))
    return out


@njit(cache=True, nogil=True)
def displaced(truth, error):
    """Return the solution (NAV,) whose `error_of` is `error` (9,)."""
    meridian, normal = radii(truth[0])
    nav = truth.copy()
    nav[0] -= error[0] / (meridian + truth[2])
    nav[1] -= error[1] / ((normal + truth[2]) * math.cos(truth[0]))
    nav[2] += error[2]
    nav[3:6] -= error[3:6]
    nav[6:10] = quat_multiply(quat_from_rotvec(-error[6:9]), truth[6:10].copy())
    return nav
