# SPDX-License-Identifier: Apache-2.0
"""What keeps the inertial attitude filter from drifting: waves, mean path, speed log, GNSS velocity."""

import math

import numpy as np
from numba import njit

from kalman_core.rotation import matrix_from_quat
from ship_inclinometer.attitude_layout import (
    ALL,
    BG,
    C_AIDING_SIGMA,
    C_ALIGN_SIGMA,
    C_ANTENNA,
    C_GYRO_NOISE,
    C_LEVER,
    C_LOG_SIGMA,
    C_SPEED_SIGMA,
    C_WAVE_TIME,
    CURRENT,
    DEV,
    GATED,
    GRAVITY,
    OK,
    P_,
    PHASE_RUN,
    S_BA,
    S_COV,
    S_DRIVE,
    S_GNSS,
    S_LOG,
    S_P,
    S_PHASE,
    S_POWER,
    S_Q,
    S_RATE,
    S_SMOOTH,
    S_SPEED,
    S_V,
    S_VP,
    S_X2,
    TH,
    TILT,
    VP,
    X2,
    N,
    V,
)
from ship_inclinometer.attitude_update import (
    heading_angle,
    inject,
    innovation_variance,
    scalar_update,
    tracked,
    widen,
)


@njit(cache=True, nogil=True)
def level(state, cov, c):
    """Align with the direction of the smoothed specific force, deeply distrusted."""
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    force_n = mat @ (state[S_SMOOTH : S_SMOOTH + 3] - state[S_BA : S_BA + 3])
    h = np.zeros(N)
    h[TH + 1] = -GRAVITY
    scalar_update(state, cov, h, force_n[0], c[C_ALIGN_SIGMA] ** 2, TILT, mat[2])
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    force_n = mat @ (state[S_SMOOTH : S_SMOOTH + 3] - state[S_BA : S_BA + 3])
    h[TH + 1] = 0.0
    h[TH] = GRAVITY
    scalar_update(state, cov, h, force_n[1], c[C_ALIGN_SIGMA] ** 2, TILT, mat[2])


@njit(cache=True, nogil=True)
def aid_position(state, cov, c, since, nis):
    """Pseudo-measurement: the place relative to the mean path is the wave displacement.

    It is that of the roll centre if the lever arm is known, else that of the IMU.
    """
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    arm = mat @ c[C_LEVER : C_LEVER + 3]
    # Without GNSS all of the level plane hangs on the estimated heading: nothing in it can correct that.
    moves = ALL if tracked(state) else TILT
    known = arm[0] != 0.0 or arm[1] != 0.0 or arm[2] != 0.0
    h = np.zeros(N)
    for i in range(3):
        innovation = -(state[S_P + i] - arm[i] - state[S_X2 + i])
        h[:] = 0.0
        h[P_ + i] = 1.0
        h[X2 + i] = -1.0
        if known:
            # -(error x arm) = arm x error
            h[TH + (i + 1) % 3] = -arm[(i + 2) % 3]
            h[TH + (i + 2) % 3] = arm[(i + 1) % 3]
        power = state[S_POWER + 2] if i == 2 else 0.5 * (state[S_POWER] + state[S_POWER + 1])
        variance = c[C_AIDING_SIGMA] ** 2 * (0.01 + power)
        value = scalar_update(state, cov, h, innovation, variance, moves, mat[2])
        nis[0] += value
        nis[1] += 1.0
        # The innovations say how rough the displacement really is; bounded, whatever happened.
        axis = S_DRIVE + (1 if i == 2 else 0)
        change = math.exp(min(since / c[C_WAVE_TIME] * (value - 1.0), 0.5))
        state[axis] = min(max(state[axis] * change, 0.05), 20.0)
    _learn_waves(state, cov, c, since)


@njit(cache=True, nogil=True)
def _learn_waves(state, cov, c, since):
    """Follow the power of displacement and velocity: their expectation given the estimate."""
    yaw = heading_angle(state)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    weight = since / (c[C_WAVE_TIME] + since)
    x, y, z = state[S_X2], state[S_X2 + 1], state[S_X2 + 2]
    xx, yy, xy = cov[X2, X2] + x * x, cov[X2 + 1, X2 + 1] + y * y, cov[X2, X2 + 1] + x * y
    ahead = cosine * cosine * xx + sine * sine * yy + 2.0 * cosine * sine * xy
    athwart = sine * sine * xx + cosine * cosine * yy - 2.0 * cosine * sine * xy
    up = cov[X2 + 2, X2 + 2] + z * z
    level = 0.0
    for i in range(2):
        level += (state[S_V + i] - state[S_VP + i]) ** 2
        level += cov[V + i, V + i] + cov[VP + i, VP + i] - 2.0 * cov[V + i, VP + i]
    upward = state[S_V + 2] ** 2 + cov[V + 2, V + 2]
    for i, value in ((0, ahead), (1, athwart), (2, up)):
        power = state[S_POWER + i]
        state[S_POWER + i] = min(max(power + weight * (value - power), 0.0025), 1000.0)
    state[S_SPEED] += weight * (level - state[S_SPEED])
    state[S_SPEED + 1] += weight * (upward - state[S_SPEED + 1])


@njit(cache=True, nogil=True)
def aid_path(state, cov, measured, variance, athwart, gate):
    """Use a speed of the mean path along the bow, or athwart it; return its NIS."""
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    yaw = heading_angle(state)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    ahead_speed = cosine * state[S_VP] + sine * state[S_VP + 1]
    athwart_speed = -sine * state[S_VP] + cosine * state[S_VP + 1]
    h = np.zeros(N)
    if athwart:
        h[VP], h[VP + 1] = -sine, cosine
        h[TH + 2] = -ahead_speed
        innovation = measured - athwart_speed
    else:
        h[VP], h[VP + 1] = cosine, sine
        h[TH + 2] = athwart_speed
        innovation = measured - ahead_speed
    nis = innovation**2 / (innovation_variance(cov, h) + variance)
    if nis <= gate:
        scalar_update(state, cov, h, innovation, variance, TILT, mat[2])
    return nis


@njit(cache=True, nogil=True)
def log_step(state, c, t, speed, gate):
    """Use a speed through water [m/s]; return (code, NIS)."""
    cov = state[S_COV:].reshape(N, N)
    if state[S_PHASE] != PHASE_RUN:
        yaw = heading_angle(state)
        state[S_VP] = speed * math.cos(yaw)
        state[S_VP + 1] = speed * math.sin(yaw)
        state[S_LOG] = t
        return OK, 1.0
    if tracked(state):
        # Water and ground differ by the current: GNSS alone is used.
        state[S_LOG] = t
        return OK, 1.0
    nis = aid_path(state, cov, speed, c[C_LOG_SIGMA] ** 2, False, gate)
    if nis > gate:
        if t - state[S_LOG] > 10.0:
            # Rejected for long: then it is the path's speed that is wrong.
            widen(cov, c[C_SPEED_SIGMA])
            state[S_LOG] = t
        return GATED, nis
    state[S_LOG] = t
    return OK, nis


@njit(cache=True, nogil=True)
def gnss_step(state, c, t, velocity, variance, gate):
    """Use a GNSS velocity (3,) ENU [m/s] of the antenna; variance (3,) [m²/s²]. Return (code, NIS)."""
    cov = state[S_COV:].reshape(N, N)
    if state[S_PHASE] != PHASE_RUN:
        return OK, 3.0
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    antenna = c[C_ANTENNA : C_ANTENNA + 3]
    rate = state[S_RATE : S_RATE + 3]
    swing = np.array(
        [
            rate[1] * antenna[2] - rate[2] * antenna[1],
            rate[2] * antenna[0] - rate[0] * antenna[2],
            rate[0] * antenna[1] - rate[1] * antenna[0],
        ]
    )
    swing_n = mat @ swing
    # Columns of mat @ skew(antenna): d(rate x antenna)/d(bias) = +skew(antenna).
    ax, ay, az = antenna[0], antenna[1], antenna[2]
    skewed = np.array([[0.0, -az, ay], [az, 0.0, -ax], [-ay, ax, 0.0]])
    by_bias = mat @ skewed
    if not tracked(state):
        # What was believed of the track was relative to the water or old: a current may lie between.
        widen(cov, math.sqrt(CURRENT**2 + min(cov[VP, VP], cov[VP + 1, VP + 1])))
    hs = np.zeros((3, N))
    innovations = np.zeros(3)
    for i in range(3):
        hs[i, V + i] = 1.0
        hs[i, TH + (i + 1) % 3] = swing_n[(i + 2) % 3]
        hs[i, TH + (i + 2) % 3] = -swing_n[(i + 1) % 3]
        for j in range(3):
            hs[i, BG + j] = by_bias[i, j]
        innovations[i] = velocity[i] - state[S_V + i] - swing_n[i]
    s = hs @ cov @ hs.T
    for i in range(3):
        s[i, i] += variance[i] + c[C_GYRO_NOISE] ** 2 * 200.0 * (by_bias[i] @ by_bias[i])
    nis = innovations @ np.linalg.solve(s, innovations)
    if nis > gate:
        return GATED, nis
    gain = np.linalg.solve(s, hs @ cov).T
    gain[DEV] = 0.0
    crossed = gain @ (hs @ cov)
    updated = cov - crossed - crossed.T + gain @ s @ gain.T
    for i in range(N):
        for j in range(N):
            cov[i, j] = 0.5 * (updated[i, j] + updated[j, i])
    inject(state, gain @ innovations)
    state[S_GNSS] = t
    return OK, nis
