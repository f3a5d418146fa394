# SPDX-License-Identifier: Apache-2.0
"""Where the filter starts: velocity from the fix, level from gravity, yaw from the course or as given."""

from __future__ import annotations

import math

import numpy as np

from ins_gps import layout as at
from ins_gps.loose import EpochFix
from ins_gps.params import FilterParams
from kalman_core.earth import mat_ecef_from_ned
from kalman_core.rotation import quat_from_euler

NANOSECONDS = 1_000_000_000
PRIOR_VELOCITY = 30.0  # m/s, where nothing measures it
PRIOR_VELOCITY_MEASURED = 5.0  # m/s, around a solution whose measurements may be used again


def start_velocity(state, stamp: int, geodetic, fix: EpochFix | None) -> tuple[np.ndarray, float]:
    """Return velocity (3,) m/s in NED and its σ; `PRIOR_VELOCITY` says that it is not known."""
    if fix is not None and fix.velocity is not None:
        mat = mat_ecef_from_ned(geodetic[0], geodetic[1])
        return mat.T @ fix.velocity.position, PRIOR_VELOCITY_MEASURED
    if abs(stamp // NANOSECONDS - state[at.START_SEC]) <= 1:
        return state[at.START_VELOCITY : at.START_VELOCITY + 3].copy(), 1.0
    return np.zeros(3), PRIOR_VELOCITY


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
        if velocity_sigma == PRIOR_VELOCITY or speed < params.alignment_speed:
            return None
        yaw = math.atan2(velocity[1], velocity[0])
    return quat_from_euler(roll, pitch, yaw), np.array([tilt, tilt, yaw_sigma])
