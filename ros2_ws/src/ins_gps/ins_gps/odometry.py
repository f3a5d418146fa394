# SPDX-License-Identifier: Apache-2.0
"""A navigation estimate in the conventions of nav_msgs/Odometry: ENU pose, body (forward-left-up) twist."""

import math

import numpy as np
from numba import njit

from kalman_core.rotation import matrix_from_quat, quat_multiply

# q_enu_ned and q_frd_flu: half turns about (1, 1, 0)/√2 and about x.
ENU_NED = np.array([0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0])
FLIP = np.array([0.0, 1.0, 0.0, 0.0])
# Truth carries no errors; a zero variance is not a covariance.
_LEAST_VARIANCE = 1e-12  # (rad/s)²
# rad², sum of the attitude's variances beyond which the axes of the body are not known.
_UNKNOWN_ATTITUDE = 3.0


@njit(cache=True, nogil=True)
def body_quaternion(q_nb):
    """Return base_link (forward-left-up) in ENU from forward-right-down in NED, wxyz."""
    return quat_multiply(quat_multiply(ENU_NED, q_nb), FLIP)


@njit(cache=True, nogil=True)
def _swapped(k):
    """Return index and sign of an ENU component among NED ones."""
    if k == 0:
        return 1, 1.0
    if k == 1:
        return 0, 1.0
    return 2, -1.0


@njit(cache=True, nogil=True)
def odometry_values(q_nb, velocity, P, rate_variance, pose, twist):
    """Fill pose and twist (36,) covariances; return (orientation wxyz, body velocity (3,)).

    P: (9, 9) of position, velocity, attitude in NED.
    """
    mat = matrix_from_quat(q_nb)  # columns: forward, right, down in NED
    J = np.zeros((3, 6))
    out = np.zeros(3)
    for i in range(3):
        sign = 1.0 if i == 0 else -1.0
        c0, c1, c2 = sign * mat[0, i], sign * mat[1, i], sign * mat[2, i]
        out[i] = c0 * velocity[0] + c1 * velocity[1] + c2 * velocity[2]
        J[i, 0], J[i, 1], J[i, 2] = c0, c1, c2
        # The body's velocity also errs with the attitude: δ(cᵀv) = cᵀδv + (c × v)·φ.
        J[i, 3] = c1 * velocity[2] - c2 * velocity[1]
        J[i, 4] = c2 * velocity[0] - c0 * velocity[2]
        J[i, 5] = c0 * velocity[1] - c1 * velocity[0]
    for a in range(6):
        ia, sa = _swapped(a % 3)
        row = ia + (6 if a >= 3 else 0)
        for b in range(6):
            ib, sb = _swapped(b % 3)
            pose[6 * a + b] = sa * sb * P[row, ib + (6 if b >= 3 else 0)]
    speed2 = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    unknown = P[6, 6] + P[7, 7] + P[8, 8] > _UNKNOWN_ATTITUDE
    twist[:] = 0.0
    for a in range(3):
        for b in range(3):
            total = 0.0
            for k in range(6):
                for m in range(6):
                    total += J[a, k] * P[3 + k, 3 + m] * J[b, m]
            twist[6 * a + b] = total
        if unknown:
            twist[7 * a] += speed2
        twist[7 * (a + 3)] = max(rate_variance, _LEAST_VARIANCE)
    return body_quaternion(q_nb), out
