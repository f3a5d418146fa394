# SPDX-License-Identifier: Apache-2.0
"""Steps of the inertial attitude filter, and the whole recording at once; see `attitude_layout`."""

import math

import numpy as np
from numba import njit

from kalman_core.rotation import matrix_from_quat, quat_from_rotvec, quat_multiply, quat_normalize
from ship_inclinometer.attitude_aiding import aid_path, aid_position, gnss_step, level, log_step
from ship_inclinometer.attitude_layout import (
    ASTRAY,
    BA,
    BG,
    C_ACC_BIAS_SIGMA,
    C_ACC_BIAS_WALK,
    C_ACC_NOISE,
    C_AIDING_INTERVAL,
    C_ALIGN_TIME,
    C_BIAS_SIGMA,
    C_BIAS_WALK,
    C_DEVIATION,
    C_DEVIATION_ANGLE,
    C_GYRO_NOISE,
    C_LEEWAY_SIGMA,
    C_LEVER,
    C_PATH_TURN,
    C_PATH_WALK,
    C_SPEED_SIGMA,
    C_WAVE_DAMPING,
    C_WAVE_PERIOD,
    C_WAVE_SIGMA,
    DEV,
    GRAVITY,
    KEPT_BIAS_SIGMA,
    OK,
    P_,
    PHASE_ALIGN,
    PHASE_EMPTY,
    PHASE_RUN,
    S_AIDED,
    S_BA,
    S_BG,
    S_COV,
    S_DRIVE,
    S_FIELD_TIME,
    S_FORCE,
    S_GNSS,
    S_LEVEL,
    S_LOG,
    S_MAG,
    S_MAG_BAD,
    S_MAG_LAST_TIME,
    S_P,
    S_PATH,
    S_PHASE,
    S_POWER,
    S_Q,
    S_RATE,
    S_SLOW_TURN,
    S_SMOOTH,
    S_SPEED,
    S_START,
    S_TIME,
    S_TURN,
    S_TURN_END,
    S_V,
    S_VIBRATION,
    S_VP,
    S_X1,
    S_X2,
    STEP_ASTRAY,
    STEP_BROKEN,
    STEP_OK,
    TH,
    TURNING,
    VP,
    X1,
    X2,
    N,
    V,
)
from ship_inclinometer.attitude_magnetic import mag_step
from ship_inclinometer.attitude_update import add_row, heading_angle, scale_row, tracked, wave_frequency


@njit(cache=True, nogil=True)
def begin(state, c, t, force):
    """Start the alignment at time t [s] with the tilt of one specific force (3,).

    What a filter that was running knows of its gyro bias is kept.
    """
    known = state[S_PHASE] == PHASE_RUN and np.isfinite(np.sum(state))
    bias = state[S_BG : S_BG + 3].copy()
    state[:] = 0.0
    state[S_TIME] = t
    state[S_START] = t
    state[S_PHASE] = PHASE_ALIGN
    roll = math.atan2(force[1], force[2])
    pitch = math.atan2(-force[0], math.hypot(force[1], force[2]))
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    state[S_Q] = cr * cp
    state[S_Q + 1] = sr * cp
    state[S_Q + 2] = cr * sp
    state[S_Q + 3] = -sr * sp
    state[S_FORCE : S_FORCE + 3] = force
    state[S_SMOOTH : S_SMOOTH + 3] = force
    for source in (S_LOG, S_GNSS, S_MAG, S_MAG_BAD, S_MAG_LAST_TIME):
        state[source] = -1.0
    state[S_TURN_END] = -1e9
    state[S_AIDED] = t
    state[S_PATH] = t
    state[S_FIELD_TIME] = 0.0
    cov = state[S_COV:].reshape(N, N)
    for i in range(2):
        cov[TH + i, TH + i] = 0.2**2
    cov[TH + 2, TH + 2] = math.pi**2
    for i in range(3):
        cov[BG + i, BG + i] = min(c[C_BIAS_SIGMA], KEPT_BIAS_SIGMA) ** 2 if known else c[C_BIAS_SIGMA] ** 2
        if known:
            state[S_BG + i] = bias[i]
        cov[BA + i, BA + i] = c[C_ACC_BIAS_SIGMA] ** 2
    cov[DEV, DEV] = c[C_DEVIATION] ** 2


@njit(cache=True, nogil=True)
def imu_step(state, c, t, gyro, force, nis):
    """Use one IMU sample: gyro (3,) [rad/s], force (3,) [m/s²] at t [s] > state time.

    nis (2,) gets the sum of the NIS of the pseudo-measurements used and their number. Returns STEP_OK, or
    why the filter must be started anew: STEP_ASTRAY (tilt against the slow mean of the specific force) or
    STEP_BROKEN (not finite).
    """
    nis[0] = 0.0
    nis[1] = 0.0
    cov = state[S_COV:].reshape(N, N)
    dt = t - state[S_TIME]
    state[S_TIME] = t
    rate = gyro - state[S_BG : S_BG + 3]
    corrected = force - state[S_BA : S_BA + 3]
    mean_rate = 0.5 * (rate + state[S_RATE : S_RATE + 3])
    if t - dt == state[S_START]:
        mean_rate = rate
    q_half = quat_multiply(state[S_Q : S_Q + 4], quat_from_rotvec(0.5 * dt * mean_rate))
    mat = matrix_from_quat(q_half)
    force_n = mat @ (0.5 * (corrected + state[S_FORCE : S_FORCE + 3]))
    rate_z = mat[2, 0] * mean_rate[0] + mat[2, 1] * mean_rate[1] + mat[2, 2] * mean_rate[2]
    state[S_Q : S_Q + 4] = quat_normalize(
        quat_multiply(state[S_Q : S_Q + 4], quat_from_rotvec(dt * mean_rate))
    )
    state[S_RATE : S_RATE + 3] = rate
    state[S_FORCE : S_FORCE + 3] = corrected
    _observe(state, cov, mat[2], force, force_n, rate_z, dt)
    if state[S_PHASE] == PHASE_RUN:
        _integrate(state, c, force_n, rate_z, dt)
    propagate(state, cov, c, mat, force_n, rate_z, dt)
    if state[S_PHASE] == PHASE_ALIGN:
        if t - state[S_AIDED] >= 0.5:
            state[S_AIDED] = t
            level(state, cov, c)
        if t - state[S_START] >= c[C_ALIGN_TIME]:
            _start_running(state, cov, c)
            state[S_AIDED] = t
    else:
        if t - state[S_AIDED] >= c[C_AIDING_INTERVAL] - 1e-6:
            since = t - state[S_AIDED]
            state[S_AIDED] = t
            aid_position(state, cov, c, since, nis)
        if t - state[S_PATH] >= 1.0:
            state[S_PATH] = t
            if not tracked(state):
                aid_path(state, cov, 0.0, c[C_LEEWAY_SIGMA] ** 2, True, np.inf)
            if math.hypot(state[S_LEVEL], state[S_LEVEL + 1]) > ASTRAY and t - state[S_START] > 90.0:
                return STEP_ASTRAY
    if not np.isfinite(state[S_Q]) or not np.isfinite(np.sum(cov[TH])):
        return STEP_BROKEN
    return STEP_OK


@njit(cache=True, nogil=True)
def _start_running(state, cov, c):
    """Leave the alignment: velocity, path and waves get their priors."""
    for i in range(V, DEV):
        for j in range(N):
            cov[i, j] = 0.0
            cov[j, i] = 0.0
    for i in range(S_V, S_PHASE):
        if not (S_VP <= i < S_VP + 2 and state[S_LOG] >= 0.0):
            state[i] = 0.0
    known = state[S_LOG] >= 0.0
    speed = c[C_LEEWAY_SIGMA] if known else c[C_SPEED_SIGMA]
    omega = 2.0 * math.pi / c[C_WAVE_PERIOD]
    power = c[C_WAVE_SIGMA] ** 2
    for i in range(2):
        state[S_V + i] = state[S_VP + i]
        cov[VP + i, VP + i] = speed**2
        cov[V + i, V + i] = speed**2
        cov[V + i, VP + i] = speed**2
        cov[VP + i, V + i] = speed**2
    for i in range(3):
        cov[V + i, V + i] += 2.0 * power * omega**2
        cov[X2 + i, X2 + i] = power
        cov[X1 + i, X1 + i] = power / omega**2
        cov[P_ + i, P_ + i] = power
        state[S_POWER + i] = power
    state[S_SPEED] = 2.0 * power * omega**2
    state[S_SPEED + 1] = power * omega**2
    state[S_DRIVE] = 1.0
    state[S_DRIVE + 1] = 1.0
    arm = matrix_from_quat(state[S_Q : S_Q + 4]) @ c[C_LEVER : C_LEVER + 3]
    state[S_P : S_P + 3] = arm
    # While aligning the rate was that of an unknown bias, not of a turn.
    state[S_TURN] = state[S_SLOW_TURN] = 0.0
    state[S_TURN_END] = -1e9
    state[S_PHASE] = PHASE_RUN


@njit(cache=True, nogil=True)
def _observe(state, cov, up, force, force_n, rate_z, dt):
    """Follow rate of turn, vibration and the slow level force; up (3,) is the vertical in body axes."""
    # 5 s: over half a wave period, so that yawing in waves does not pass for a turn.
    state[S_TURN] += dt / (5.0 + dt) * (rate_z - state[S_TURN])
    state[S_SLOW_TURN] += dt / (3.0 + dt) * (state[S_TURN] - state[S_SLOW_TURN])
    turning = abs(state[S_SLOW_TURN]) - TURNING
    if turning > 0.0:
        # A gyro bias that is not yet known turns as well.
        doubt = 0.0
        for i in range(3):
            for j in range(3):
                doubt += up[i] * cov[BG + i, BG + j] * up[j]
        if turning**2 > 9.0 * doubt:
            state[S_TURN_END] = state[S_TIME]
    smooth = dt / (0.03 + dt)
    fast = 0.0
    for i in range(3):
        state[S_SMOOTH + i] += smooth * (force[i] - state[S_SMOOTH + i])
        fast += (force[i] - state[S_SMOOTH + i]) ** 2 / 3.0
    state[S_VIBRATION] += dt / (2.0 + dt) * (fast * dt - state[S_VIBRATION])
    for i in range(2):
        state[S_LEVEL + i] += dt / (30.0 + dt) * (force_n[i] - state[S_LEVEL + i])


@njit(cache=True, nogil=True)
def _integrate(state, c, force_n, rate_z, dt):
    for i in range(3):
        previous = state[S_V + i]
        state[S_V + i] += (force_n[i] - (GRAVITY if i == 2 else 0.0)) * dt
        state[S_P + i] += 0.5 * (previous + state[S_V + i]) * dt
    vx, vy = state[S_VP], state[S_VP + 1]
    state[S_P] -= vx * dt
    state[S_P + 1] -= vy * dt
    angle = rate_z * dt
    state[S_VP] = vx * math.cos(angle) - vy * math.sin(angle)
    state[S_VP + 1] = vx * math.sin(angle) + vy * math.cos(angle)
    for i in range(3):
        omega = wave_frequency(state, i == 2)
        state[S_X1 + i] += dt * state[S_X2 + i]
        state[S_X2 + i] *= 1.0 - 2.0 * c[C_WAVE_DAMPING] * omega * dt
        state[S_X2 + i] -= omega * omega * dt * state[S_X1 + i]


@njit(cache=True, nogil=True)
def propagate(state, cov, c, mat, force_n, rate_z, dt):
    """Advance the covariance by dt [s] with a chain of elementary transitions, exact to first order."""
    running = state[S_PHASE] == PHASE_RUN
    if running:
        for i in range(3):
            add_row(cov, P_ + i, V + i, dt)
        for i in range(2):
            add_row(cov, P_ + i, VP + i, -dt)
        fx, fy, fz = force_n[0] * dt, force_n[1] * dt, force_n[2] * dt
        add_row(cov, V, TH + 1, fz)
        add_row(cov, V, TH + 2, -fy)
        add_row(cov, V + 1, TH, -fz)
        add_row(cov, V + 1, TH + 2, fx)
        add_row(cov, V + 2, TH, fy)
        add_row(cov, V + 2, TH + 1, -fx)
        for i in range(3):
            for j in range(3):
                add_row(cov, V + i, BA + j, -dt * mat[i, j])
        # The path's velocity turns with the ship; its Jacobian by the gyro bias is that of the rate.
        vx, vy = state[S_VP], state[S_VP + 1]
        for j in range(3):
            add_row(cov, VP, BG + j, dt * vy * mat[2, j])
            add_row(cov, VP + 1, BG + j, -dt * vx * mat[2, j])
        add_row(cov, VP, VP + 1, -rate_z * dt)
        add_row(cov, VP + 1, VP, rate_z * dt)
        for i in range(3):
            omega = wave_frequency(state, i == 2)
            add_row(cov, X1 + i, X2 + i, dt)
            scale_row(cov, X2 + i, 1.0 - 2.0 * c[C_WAVE_DAMPING] * omega * dt)
            add_row(cov, X2 + i, X1 + i, -omega * omega * dt)
    for i in range(3):
        for j in range(3):
            add_row(cov, TH + i, BG + j, -dt * mat[i, j])
    _add_noise(state, cov, c, rate_z, running, dt)


@njit(cache=True, nogil=True)
def _add_noise(state, cov, c, rate_z, running, dt):
    for i in range(3):
        cov[TH + i, TH + i] += c[C_GYRO_NOISE] ** 2 * dt
        cov[BG + i, BG + i] += c[C_BIAS_WALK] ** 2 * dt
        cov[BA + i, BA + i] += c[C_ACC_BIAS_WALK] ** 2 * dt
    # Deviation belongs to a heading: it is forgotten with the angle turned.
    forget = abs(state[S_TURN]) / c[C_DEVIATION_ANGLE] * dt
    scale_row(cov, DEV, 1.0 - forget)
    cov[DEV, DEV] += 2.0 * forget * c[C_DEVIATION] ** 2
    if not running:
        return
    # Vibration is mostly lines that integrate to nothing: a hundredth of its power counts as noise.
    acceleration = max(c[C_ACC_NOISE] ** 2, state[S_VIBRATION] * 0.01)
    for i in range(3):
        cov[V + i, V + i] += acceleration * dt
    # A current of C_PATH_TURN does not turn with the ship: seen as a disturbance correlated over 10 s.
    path = c[C_PATH_WALK] ** 2 + 10.0 * (c[C_PATH_TURN] * state[S_TURN]) ** 2
    cov[VP, VP] += path * dt
    cov[VP + 1, VP + 1] += path * dt
    yaw = heading_angle(state)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    level = state[S_DRIVE] * 4.0 * c[C_WAVE_DAMPING] * wave_frequency(state, False) * dt
    ahead, athwart = level * state[S_POWER], level * state[S_POWER + 1]
    cov[X2, X2] += cosine * cosine * ahead + sine * sine * athwart
    cov[X2 + 1, X2 + 1] += sine * sine * ahead + cosine * cosine * athwart
    mixed = cosine * sine * (ahead - athwart)
    cov[X2, X2 + 1] += mixed
    cov[X2 + 1, X2] += mixed
    upward = state[S_DRIVE + 1] * 4.0 * c[C_WAVE_DAMPING] * wave_frequency(state, True) * dt
    cov[X2 + 2, X2 + 2] += upward * state[S_POWER + 2]


@njit(cache=True, nogil=True)
def run(state, c, imu_t, gyro, force, mag_t, mag, gnss_t, gnss, gnss_variance, log_t, log, gates, out, nis):
    """Run over a whole recording in order of time; the kernels of the streaming class.

    out (N_imu, 14): quaternion, upper triangle of the attitude covariance (6), gyro bias, phase; after each
    IMU sample. nis (3, 2): sums of NIS and numbers for position, magnetometer and GNSS.
    """
    m, k, n = 0, 0, 0
    pair = np.zeros(2)
    for i in range(len(imu_t)):
        t = imu_t[i]
        while True:
            next_mag = mag_t[m] if m < len(mag_t) else np.inf
            next_gnss = gnss_t[k] if k < len(gnss_t) else np.inf
            next_log = log_t[n] if n < len(log_t) else np.inf
            first = min(next_mag, next_gnss, next_log)
            if first >= t:
                break
            started = state[S_PHASE] != PHASE_EMPTY
            running = state[S_PHASE] == PHASE_RUN
            if first == next_mag:
                if started:
                    code, value = mag_step(state, c, first, mag[m], gates[0])
                    if code == OK and running:
                        nis[1, 0] += value
                        nis[1, 1] += 1.0
                m += 1
            elif first == next_gnss:
                if started:
                    code, value = gnss_step(state, c, first, gnss[k], gnss_variance, gates[1])
                    if code == OK and running:
                        nis[2, 0] += value
                        nis[2, 1] += 3.0
                k += 1
            else:
                if started:
                    log_step(state, c, first, log[n], gates[2])
                n += 1
        if state[S_PHASE] == PHASE_EMPTY:
            begin(state, c, t, force[i])
        else:
            if imu_step(state, c, t, gyro[i], force[i], pair) != STEP_OK:
                begin(state, c, t, force[i])
            if t - state[S_START] > 60.0:
                nis[0, 0] += pair[0]
                nis[0, 1] += pair[1]
        cov = state[S_COV:].reshape(N, N)
        out[i, 0:4] = state[S_Q : S_Q + 4]
        out[i, 4], out[i, 5], out[i, 6] = cov[0, 0], cov[0, 1], cov[0, 2]
        out[i, 7], out[i, 8], out[i, 9] = cov[1, 1], cov[1, 2], cov[2, 2]
        out[i, 10:13] = state[S_BG : S_BG + 3]
        out[i, 13] = state[S_PHASE]
