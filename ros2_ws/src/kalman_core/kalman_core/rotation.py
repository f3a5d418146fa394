# SPDX-License-Identifier: Apache-2.0
"""Rotations as kernels: Hamilton quaternions (w, x, y, z), rotation vectors, ZYX Euler angles.

Sources: Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), for the conventions and
the exponential map; Markley and Crassidis, "Fundamentals of Spacecraft Attitude Determination and Control"
(2014), for the matrix to quaternion case split.
"""

import math

import numpy as np
from numba import njit

# Below this angle (rad) sin(x)/x is replaced by its series; the neglected term is under 1e-17.
_SMALL_ANGLE = 1e-4


@njit(cache=True, nogil=True)
def wrap(angle):
    """Return `angle` (rad) wrapped to [-pi, pi), unchanged to the last bit when already there."""
    if -math.pi <= angle < math.pi:
        return angle
    # math.floor makes integers, which overflow and raise on what is not finite; np.floor keeps floats.
    wrapped = angle - 2.0 * math.pi * np.floor((angle + math.pi) / (2.0 * math.pi))
    if wrapped < -math.pi:  # by rounding, after many turns
        return -math.pi
    return wrapped


def wrap_array(angles) -> np.ndarray:
    """Return an array of angles (rad) of any shape wrapped to [-pi, pi)."""
    angles = np.asarray(angles, dtype=np.float64)
    wrapped = (angles + math.pi) % (2.0 * math.pi) - math.pi
    return np.where(wrapped < math.pi, wrapped, -math.pi)  # the remainder of a tiny negative is the divisor


@njit(cache=True, nogil=True)
def quat_multiply(p, q):
    """Return the Hamilton product ``p * q`` of two (4,) quaternions."""
    out = np.empty(4)
    out[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3]
    out[1] = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2]
    out[2] = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1]
    out[3] = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]
    return out


@njit(cache=True, nogil=True)
def quat_conjugate(q):
    """Return the inverse rotation of a unit quaternion (4,)."""
    return np.array([q[0], -q[1], -q[2], -q[3]])


@njit(cache=True, nogil=True)
def quat_normalize(q):
    """Return `q` (4,) scaled to unit norm, or the identity when its norm is zero or not finite."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if not (norm > 0.0) or not math.isfinite(norm):
        return np.array([1.0, 0.0, 0.0, 0.0])
    return q / norm


@njit(cache=True, nogil=True)
def quat_from_rotvec(rotvec):
    """Return the quaternion (4,) of a rotation vector (3,) [rad]; exact exponential map."""
    angle = math.sqrt(rotvec[0] ** 2 + rotvec[1] ** 2 + rotvec[2] ** 2)
    half = 0.5 * angle
    if angle < _SMALL_ANGLE:
        scale = 0.5 - angle * angle / 48.0
    else:
        scale = math.sin(half) / angle
    return np.array([math.cos(half), scale * rotvec[0], scale * rotvec[1], scale * rotvec[2]])


@njit(cache=True, nogil=True)
def rotvec_from_quat(q):
    """Return the rotation vector (3,) [rad] of a unit quaternion (4,), angle in [0, pi]."""
    sign = 1.0 if q[0] >= 0.0 else -1.0
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if sine < 0.5 * _SMALL_ANGLE:
        scale = sign * (2.0 + sine * sine / 3.0)
    else:
        scale = sign * 2.0 * math.atan2(sine, sign * q[0]) / sine
    return np.array([scale * q[1], scale * q[2], scale * q[3]])


@njit(cache=True, nogil=True)
def matrix_from_quat(q):
    """Return the rotation matrix (3, 3) of a unit quaternion (4,)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return out


@njit(cache=True, nogil=True)
def quat_from_matrix(mat):
    """Return the unit quaternion (4,) with w >= 0 of a rotation matrix (3, 3)."""
    trace = mat[0, 0] + mat[1, 1] + mat[2, 2]
    out = np.empty(4)
    # Divide by the largest component: the others then keep full precision (Markley and Crassidis, 2.9.3).
    if trace >= mat[0, 0] and trace >= mat[1, 1] and trace >= mat[2, 2]:
        out[0] = 1.0 + trace
        out[1] = mat[2, 1] - mat[1, 2]
        out[2] = mat[0, 2] - mat[2, 0]
        out[3] = mat[1, 0] - mat[0, 1]
    elif mat[0, 0] >= mat[1, 1] and mat[0, 0] >= mat[2, 2]:
        out[0] = mat[2, 1] - mat[1, 2]
        out[1] = 1.0 + 2.0 * mat[0, 0] - trace
        out[2] = mat[0, 1] + mat[1, 0]
        out[3] = mat[0, 2] + mat[2, 0]
    elif mat[1, 1] >= mat[2, 2]:
        out[0] = mat[0, 2] - mat[2, 0]
        out[1] = mat[0, 1] + mat[1, 0]
        out[2] = 1.0 + 2.0 * mat[1, 1] - trace
        out[3] = mat[1, 2] + mat[2, 1]
    else:
        out[0] = mat[1, 0] - mat[0, 1]
        out[1] = mat[0, 2] + mat[2, 0]
        out[2] = mat[1, 2] + mat[2, 1]
        out[3] = 1.0 + 2.0 * mat[2, 2] - trace
    out = quat_normalize(out)
    if out[0] < 0.0:
        out = -out
    return out


@njit(cache=True, nogil=True)
def quat_rotate(q, vec):
    """Return `vec` (3,) rotated by the unit quaternion `q` (4,): ``vec_n`` from ``q_nb`` and ``vec_b``."""
    # v + 2w(u×v) + 2u×(u×v): half the work of two quaternion products.
    tx = 2.0 * (q[2] * vec[2] - q[3] * vec[1])
    ty = 2.0 * (q[3] * vec[0] - q[1] * vec[2])
    tz = 2.0 * (q[1] * vec[1] - q[2] * vec[0])
    out = np.empty(3)
    out[0] = vec[0] + q[0] * tx + q[2] * tz - q[3] * ty
    out[1] = vec[1] + q[0] * ty + q[3] * tx - q[1] * tz
    out[2] = vec[2] + q[0] * tz + q[1] * ty - q[2] * tx
    return out


@njit(cache=True, nogil=True)
def quat_rotate_inverse(q, vec):
    """Return `vec` (3,) rotated by the inverse of `q` (4,): ``vec_b`` from ``q_nb`` and ``vec_n``."""
    return quat_rotate(quat_conjugate(q), vec)


@njit(cache=True, nogil=True)
def skew(vec):
    """Return the (3, 3) matrix with ``skew(a) @ b == cross(a, b)``."""
    out = np.zeros((3, 3))
    out[0, 1] = -vec[2]
    out[0, 2] = vec[1]
    out[1, 0] = vec[2]
    out[1, 2] = -vec[0]
    out[2, 0] = -vec[1]
    out[2, 1] = vec[0]
    return out


@njit(cache=True, nogil=True)
def cross(a, b):
    """Return the cross product of two (3,) vectors (numba's ``np.cross`` is slower)."""
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@njit(cache=True, nogil=True)
def quat_from_euler(roll, pitch, yaw):
    """Return the quaternion (4,) of intrinsic ZYX angles (rad): yaw about z, then pitch, then roll."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


@njit(cache=True, nogil=True)
def euler_from_quat(q):
    """Return (roll, pitch, yaw) [rad] of a unit quaternion (4,), intrinsic ZYX, pitch in [-pi/2, pi/2].

    Within 1e-7 of pitch = ±pi/2 roll and yaw are not separable: roll is 0 and yaw carries both.
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    sine = 2.0 * (w * y - z * x)
    if sine >= 1.0 - 1e-14:
        return 0.0, 0.5 * math.pi, wrap(-2.0 * math.atan2(x, w))
    if sine <= -1.0 + 1e-14:
        return 0.0, -0.5 * math.pi, wrap(2.0 * math.atan2(x, w))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, math.asin(sine), yaw
