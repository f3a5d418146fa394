# SPDX-License-Identifier: Apache-2.0
"""Where the filter starts: velocity from the fix, level from gravity, yaw from the course or as given."""

from __future__ import annotations

import math

import numpy as np

from ins_gps import layout as at
from ins_gps.channels import LEVER_X, LEVER_Y, LEVER_Z, antenna
from ins_gps.loose import EpochFix
from ins_gps.params import FilterParams
from ins_gps.prediction import BIASES, GAP, Q_ACCEL, Q_GYRO, VIBRATION
from ins_gps.samples import FixEstimate, ImuSample
from ins_gps.solution import displaced
from ins_gps.strapdown import navigation_rates
from kalman_core.earth import ecef_from_geodetic, gravity, mat_ecef_from_ned
from kalman_core.rotation import matrix_from_quat, quat_from_euler

PRIOR_VELOCITY = 30.0  # m/s, where nothing measures it
PRIOR_VELOCITY_MEASURED = 5.0  # m/s, around a solution whose measurements may be used again
_COASTING_ACCELERATION = 1.0  # m/s²/√Hz: a person, a car or a gentle craft
# The course is the yaw only while it is known: σ of the velocity against the speed.
_COURSE_QUALITY = 0.4
_LEVEL_TIME = 1.0  # s, time constant of the averages for alignment


def start_velocity(geodetic, fix: EpochFix | None) -> tuple[np.ndarray, float]:
    """Return velocity (3,) m/s in NED and its σ; `PRIOR_VELOCITY` says that it is not known."""
    if fix is None or fix.velocity is None:
        return np.zeros(3), PRIOR_VELOCITY
    mat = mat_ecef_from_ned(geodetic[0], geodetic[1])
    return mat.T @ fix.velocity.position, PRIOR_VELOCITY_MEASURED


def average_sample(state, sample: ImuSample, sec: int, nsec: int) -> None:
    """Take a sample into the averages of force and rate, before its stamp becomes the last."""
    if state[at.ALIGN_COUNT] == 0.0:
        weight = 1.0
    else:
        dt = (sec - state[at.IMU_SEC]) + (nsec - state[at.IMU_NSEC]) * 1e-9
        weight = min(1.0, max(dt, 0.0) / _LEVEL_TIME + 1.0 / (1.0 + state[at.ALIGN_COUNT]))
    for start, value in ((at.ALIGN_FORCE, sample.force), (at.ALIGN_RATE, sample.rate)):
        state[start : start + 3] += weight * (value - state[start : start + 3])
    state[at.ALIGN_COUNT] += 1.0


def coasting_config(config: np.ndarray) -> np.ndarray:
    """Return the configuration for following GNSS alone: white acceleration instead of an IMU, no lever."""
    out = config.copy()
    out[Q_ACCEL] = _COASTING_ACCELERATION**2
    out[GAP] = math.inf
    out[BIASES] = 0.0
    out[Q_GYRO] = 0.0
    out[VIBRATION] = 0.0
    # Without an attitude the state is the antenna's.
    out[[LEVER_X, LEVER_Y, LEVER_Z]] = 0.0
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


def _level(force: np.ndarray, level_force: np.ndarray) -> tuple[float, float]:
    """Return roll and pitch (rad) that turn `force` (3,) in the body into `level_force` (3,) at yaw zero."""
    a, b, c = level_force
    reach = math.hypot(a, c)
    ratio = min(1.0, max(-1.0, force[0] / reach)) if reach > 0.0 else 0.0
    # a cos(pitch) − c sin(pitch) = force_x, the branch in which the craft is upright.
    pitch = min(
        (math.remainder(s * math.acos(ratio) - math.atan2(c, a), 2.0 * math.pi) for s in (1.0, -1.0)), key=abs
    )
    below = a * math.sin(pitch) + c * math.cos(pitch)
    roll = math.remainder(math.atan2(force[1], force[2]) - math.atan2(b, below), 2.0 * math.pi)
    return roll, pitch


def start_attitude(
    state, params: FilterParams, velocity, velocity_sigma: float, acceleration=(0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return q_nb (4,) and σ (3,) rad, or None while the attitude cannot be known.

    acceleration: (3,) m/s², NED, as far as it is known: what is left of the specific force is gravity.
    """
    roll, pitch, yaw = params.initial_attitude
    # base_link in ENU to forward-right-down in NED.
    pitch, yaw = -pitch, 0.5 * math.pi - yaw
    tilt, yaw_sigma = params.initial_tilt_sigma, params.initial_yaw_sigma
    if params.alignment == 'given':
        return quat_from_euler(roll, pitch, yaw), np.array([tilt, tilt, yaw_sigma])
    if state[at.ALIGN_COUNT] < 2.0:
        return None
    if params.alignment == 'velocity':
        speed = math.hypot(velocity[0], velocity[1])
        if speed < params.alignment_speed or velocity_sigma > _COURSE_QUALITY * speed:
            return None
        yaw = math.atan2(velocity[1], velocity[0])
        yaw_sigma = math.hypot(yaw_sigma, velocity_sigma / speed)
    north, east, down = acceleration
    ahead = math.cos(yaw) * north + math.sin(yaw) * east
    right = math.cos(yaw) * east - math.sin(yaw) * north
    here = gravity(state[at.NAVIGATION], state[at.NAVIGATION + 2])
    force = state[at.ALIGN_FORCE : at.ALIGN_FORCE + 3]
    roll, pitch = _level(force, np.array([ahead, right, down - here]))
    return quat_from_euler(roll, pitch, yaw), np.array([tilt, tilt, yaw_sigma])


def leave_antenna(state, nav, P, config) -> None:
    """Move a position that is the antenna's to the IMU, now that the attitude is known."""
    lever = config[[LEVER_X, LEVER_Y, LEVER_Z]]
    if not lever.any():
        return
    x, y, z = lever_n = matrix_from_quat(nav[6:10]) @ lever
    nav[:] = displaced(nav, np.r_[lever_n, np.zeros(6)])
    # The antenna is where it was: what attitude errs by moves the IMU the other way.
    turn = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    spread = turn @ P[at.ATT : at.ATT + 3, at.ATT : at.ATT + 3]
    P[at.POS : at.POS + 3, at.POS : at.POS + 3] += spread @ turn.T
    P[at.POS : at.POS + 3, at.ATT : at.ATT + 3] = -spread
    P[at.ATT : at.ATT + 3, at.POS : at.POS + 3] = -spread.T
    # The carrier of the last epoch was at the antenna's place: no difference may see the move.
    state[at.CLONE_VALID] = 0.0


def position_rows(state, nav, config, n: int, geodetic) -> tuple[np.ndarray, np.ndarray]:
    """Return innovation (3,) m NED and derivative (3, n) of a position of the antenna (rad, rad, m)."""
    mat_en = mat_ecef_from_ned(nav[0], nav[1])
    lever_n, site = np.empty(3), np.empty(3)
    antenna(state, config, matrix_from_quat(nav[6:10]), mat_en, lever_n, site)
    H = np.zeros((3, n))
    H[:, at.POS : at.POS + 3] = np.eye(3)
    x, y, z = lever_n
    H[:, at.ATT : at.ATT + 3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return mat_en.T @ (ecef_from_geodetic(*geodetic) - site), H


def fix_estimate(stamp: int, nav, P) -> FixEstimate:
    """Return the position with its covariance in ENU (m²)."""
    order = [1, 0, 2]
    sign = np.array([[1.0, 1.0, -1.0], [1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    return FixEstimate(stamp, nav[:3].copy(), P[:3, :3][np.ix_(order, order)] * sign)
