# SPDX-License-Identifier: Apache-2.0
"""Where the filter starts: velocity from the fix, level from gravity, yaw from the course or as given."""

from __future__ import annotations

import math

import numpy as np

from ins_gps import layout as at
from ins_gps.loose import EpochFix
from ins_gps.params import FilterParams
from ins_gps.prediction import BIASES, GAP, Q_ACCEL, Q_GYRO
from ins_gps.strapdown import navigation_rates
from kalman_core.earth import gravity, mat_ecef_from_ned
from kalman_core.rotation import matrix_from_quat, quat_from_euler

PRIOR_VELOCITY = 30.0  # m/s, where nothing measures it
PRIOR_VELOCITY_MEASURED = 5.0  # m/s, around a solution whose measurements may be used again
_COASTING_ACCELERATION = 1.0  # m/s²/√Hz: a person, a car or a gentle craft
# The course is the yaw only while it is known: σ of the velocity against the speed.
_COURSE_QUALITY = 0.4


def start_velocity(geodetic, fix: EpochFix | None) -> tuple[np.ndarray, float]:
    """Return velocity (3,) m/s in NED and its σ; `PRIOR_VELOCITY` says that it is not known."""
    if fix is None or fix.velocity is None:
        return np.zeros(3), PRIOR_VELOCITY
    mat = mat_ecef_from_ned(geodetic[0], geodetic[1])
    return mat.T @ fix.velocity.position, PRIOR_VELOCITY_MEASURED


def coasting_config(config: np.ndarray) -> np.ndarray:
    """Return the configuration for following GNSS alone: white acceleration instead of an IMU."""
    out = config.copy()
    out[Q_ACCEL] = _COASTING_ACCELERATION**2
    out[GAP] = math.inf
    out[BIASES] = 0.0
    out[Q_GYRO] = 0.0
    return out


def hold_still(state) -> None:
    """Make the held IMU sample one that keeps velocity: it then only carries the state over an interval."""
    nav = state[at.NAVIGATION : at.NAVIGATION + 10]
    rates = np.empty(6)
    navigation_rates(nav[0], nav[2], nav[3], nav[4], rates)
    total = 2.0 * rates[:3] + rates[3:]
    force = np.cross(total, nav[3:6]) - np.array([0.0, 0.0, gravity(nav[0], nav[2])])
    mat = matrix_from_quat(nav[6:10])
    state[at.FORCE : at.FORCE + 3] = mat.T @ force
    state[at.RATE : at.RATE + 3] = mat.T @ (rates[:3] + rates[3:])
    state[at.HAVE_IMU] = 1.0


def start_attitude(
    state, params: FilterParams, velocity, velocity_sigma: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return q_nb (4,) and σ (3,) rad, or None while the attitude cannot be known."""
    roll, pitch, yaw = params.initial_attitude
    # base_link in ENU to forward-right-down in NED.
    pitch, yaw = -pitch, 0.5 * math.pi - yaw
    tilt, yaw_sigma = params.initial_tilt_sigma, params.initial_yaw_sigma
    if params.alignment != 'given':
        if state[at.ALIGN_COUNT] < 2.0:
            return None
        fx, fy, fz = state[at.ALIGN_FORCE : at.ALIGN_FORCE + 3]
        roll, pitch = math.atan2(-fy, -fz), math.atan2(fx, math.hypot(fy, fz))
    if params.alignment == 'velocity':
        speed = math.hypot(velocity[0], velocity[1])
        if speed < params.alignment_speed or velocity_sigma > _COURSE_QUALITY * speed:
            return None
        yaw = math.atan2(velocity[1], velocity[0])
        yaw_sigma = math.hypot(yaw_sigma, velocity_sigma / speed)
    return quat_from_euler(roll, pitch, yaw), np.array([tilt, tilt, yaw_sigma])
