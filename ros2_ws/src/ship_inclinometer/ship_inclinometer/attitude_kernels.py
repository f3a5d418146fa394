# SPDX-License-Identifier: Apache-2.0
"""Kernels of the inertial attitude filter: error-state EKF with a wave model, see `attitude_model`.

Error states (true = estimate + error, attitude error in the level frame ``q_true = exp(error_n) * q``):
attitude 0:3 · gyro bias 3:6 · accelerometer bias 6:9 · velocity 9:12 · position relative to the mean path
12:15 · velocity of the mean path 15:17 · wave oscillator 17:20 and its output, the wave displacement,
20:23 · magnetic deviation 23.

The mean path turns with the ship (its velocity keeps its angle to the bow); the displacement from it is a
narrow-band process that has no power at zero frequency (Fossen, "Handbook of Marine Craft Hydrodynamics and
Motion Control", 2011, section 8.2.6, linear approximation of a wave spectrum). So a slow growth of the
integrated position is the fault of tilt and biases, a quick one is the sea.
"""

import math

import numpy as np
from numba import njit

from kalman_core.rotation import (
    euler_from_quat,
    matrix_from_quat,
    quat_from_rotvec,
    quat_multiply,
    quat_normalize,
    wrap,
)

GRAVITY = 9.80665
N = 24
TH, BG, BA, V, P_, VP, X1, X2, DEV = 0, 3, 6, 9, 12, 15, 17, 20, 23

# Nominal state and memory, in front of the covariance in one flat array.
S_TIME = 0
S_Q = 1
S_BG = 5
S_BA = 8
S_V = 11
S_P = 14
S_VP = 17
S_X1 = 19
S_X2 = 22
S_DEV = 25
S_PHASE = 26
S_START = 27
S_POWER = 28  # mean square of the wave displacement: ahead, athwart, up [m²]
S_SPEED = 31  # mean square of the velocity relative to the path: level (both axes), up [m²/s²]
S_TURN = 33  # smoothed rate of turn [rad/s]
S_RATE = 34  # last corrected body rate [rad/s]
S_FORCE = 37  # last corrected specific force [m/s²]
S_LOG = 40  # times [s] of the last use of each source, -1 before the first
S_GNSS = 41
S_MAG = 42
S_AIDED = 43
S_NORM = 44  # learned field: norm [T], sine of the dip
S_DIP = 45
S_MAG_R = 46  # adaptive variance of a magnetic heading [rad²]
S_LEVEL = 47  # slow mean of the level specific force [m/s²], shows a filter that has gone astray
S_SLOW_TURN = 49
S_TURN_END = 50  # time [s] when the last turn ended
S_MAG_BAD = 51  # time [s] since when the magnetometer is rejected, -1 if it is not
S_VIBRATION = 52  # mean square of the specific force's fast part [m²/s⁴]
S_SMOOTH = 53  # specific force, 5 Hz low-pass [m/s²]
S_PATH = 56  # time [s] of the last leeway pseudo-measurement
S_FIELD_TIME = 57  # how long [s] the field has been learned
S_MAG_LAST = 58  # last magnetic innovation [rad] and its time [s]
S_MAG_LAST_TIME = 59
S_COV = 64
SIZE = S_COV + N * N

PHASE_EMPTY, PHASE_ALIGN, PHASE_RUN = 0.0, 1.0, 2.0

# Settings, filled by attitude_model.settings().
(
    C_GYRO_NOISE,
    C_BIAS_WALK,
    C_BIAS_SIGMA,
    C_ACC_NOISE,
    C_ACC_BIAS_SIGMA,
    C_ACC_BIAS_WALK,
    C_ALIGN_TIME,
    C_ALIGN_SIGMA,
    C_WAVE_DAMPING,
    C_WAVE_SIGMA,
    C_WAVE_PERIOD,
    C_WAVE_TIME,
    C_AIDING_INTERVAL,
    C_AIDING_SIGMA,
    C_PATH_WALK,
    C_PATH_TURN,
    C_SPEED_SIGMA,
    C_LEEWAY_SIGMA,
    C_LOG_SIGMA,
    C_GNSS_SIGMA,
    C_MAG_NOISE,
    C_DEVIATION,
    C_DEVIATION_ANGLE,
    C_DECLINATION,
    C_NORM_GATE,
    C_DIP_GATE,
    C_MAG_LOCKOUT,
    C_LEVER,
) = range(28)
C_ANTENNA = C_LEVER + 3
SETTINGS = C_ANTENNA + 3

_OK, _GATED = 0, 1
# Codes of mag_step beyond these two.
MAG_NORM, MAG_DIP, MAG_RELEARNED = 2, 3, 4
# Current (m/s) that a velocity over ground may differ by from what was assumed through the water.
_CURRENT = 3.0


@njit(cache=True, nogil=True)
def add_row(cov, target, source, factor):
    """Apply the elementary transition ``x[target] += factor * x[source]`` to the covariance in place."""
    for j in range(N):
        cov[target, j] += factor * cov[source, j]
    for j in range(N):
        cov[j, target] += factor * cov[j, source]


@njit(cache=True, nogil=True)
def scale_row(cov, target, factor):
    """Apply ``x[target] *= factor`` to the covariance in place."""
    for j in range(N):
        cov[target, j] *= factor
    for j in range(N):
        cov[j, target] *= factor


@njit(cache=True, nogil=True)
def scalar_update(state, cov, h, innovation, variance, apply):
    """Use one scalar measurement ``innovation = h · error + noise`` and return its NIS.

    h (N,). With `apply` False only the NIS is computed. The error is moved into the nominal state.
    """
    ph = np.zeros(N)
    for j in range(N):
        if h[j] != 0.0:
            for i in range(N):
                ph[i] += cov[i, j] * h[j]
    s = variance
    for j in range(N):
        s += h[j] * ph[j]
    nis = innovation * innovation / s
    if apply:
        gain = ph / s
        for i in range(N):
            for j in range(i, N):
                value = cov[i, j] - gain[i] * ph[j]
                cov[i, j] = value
                cov[j, i] = value
        inject(state, gain * innovation)
    return nis


@njit(cache=True, nogil=True)
def masked_update(state, cov, h, innovation, variance, mask):
    """Use one scalar measurement for the masked directions only; the others are considered, not moved.

    mask (N, N) projects the gain. Covariance in Joseph's form, valid for any gain.
    """
    ph = cov @ h
    s = variance + h @ ph
    gain = mask @ (ph / s)
    for i in range(N):
        for j in range(i, N):
            value = cov[i, j] - gain[i] * ph[j] - ph[i] * gain[j] + s * gain[i] * gain[j]
            cov[i, j] = value
            cov[j, i] = value
    inject(state, gain * innovation)


@njit(cache=True, nogil=True)
def inject(state, error):
    """Move an error vector (N,) into the nominal state."""
    q = quat_multiply(quat_from_rotvec(error[TH : TH + 3]), state[S_Q : S_Q + 4])
    state[S_Q : S_Q + 4] = quat_normalize(q)
    for i in range(3):
        state[S_BG + i] += error[BG + i]
        state[S_BA + i] += error[BA + i]
        state[S_V + i] += error[V + i]
        state[S_P + i] += error[P_ + i]
        state[S_X1 + i] += error[X1 + i]
        state[S_X2 + i] += error[X2 + i]
    state[S_VP] += error[VP]
    state[S_VP + 1] += error[VP + 1]
    state[S_DEV] += error[DEV]


@njit(cache=True, nogil=True)
def wave_frequency(state, up):
    """Return the wave displacement's mean angular frequency [rad/s], within periods of 4 to 30 s."""
    if up:
        ratio = state[S_SPEED + 1] / state[S_POWER + 2]
    else:
        ratio = state[S_SPEED] / (state[S_POWER] + state[S_POWER + 1])
    return min(max(math.sqrt(ratio), 2.0 * math.pi / 30.0), 2.0 * math.pi / 4.0)


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
    # Vibration beyond the declared noise is noise too.
    acceleration = max(c[C_ACC_NOISE] ** 2, state[S_VIBRATION] * 0.01)
    for i in range(3):
        cov[V + i, V + i] += acceleration * dt
    # A current of C_PATH_TURN does not turn with the ship: seen as a disturbance correlated over 10 s.
    path = c[C_PATH_WALK] ** 2 + 10.0 * (c[C_PATH_TURN] * state[S_TURN]) ** 2
    cov[VP, VP] += path * dt
    cov[VP + 1, VP + 1] += path * dt
    yaw = heading_angle(state)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    level = 4.0 * c[C_WAVE_DAMPING] * wave_frequency(state, False) * dt
    ahead, athwart = level * state[S_POWER], level * state[S_POWER + 1]
    cov[X2, X2] += cosine * cosine * ahead + sine * sine * athwart
    cov[X2 + 1, X2 + 1] += sine * sine * ahead + cosine * cosine * athwart
    mixed = cosine * sine * (ahead - athwart)
    cov[X2, X2 + 1] += mixed
    cov[X2 + 1, X2] += mixed
    cov[X2 + 2, X2 + 2] += 4.0 * c[C_WAVE_DAMPING] * wave_frequency(state, True) * dt * state[S_POWER + 2]


@njit(cache=True, nogil=True)
def heading_angle(state):
    """Return the yaw [rad] of the nominal attitude."""
    _, _, yaw = euler_from_quat(state[S_Q : S_Q + 4])
    return yaw


@njit(cache=True, nogil=True)
def begin(state, c, t, force):
    """Start the alignment at time t [s] with the tilt of one specific force (3,)."""
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
        cov[BG + i, BG + i] = c[C_BIAS_SIGMA] ** 2
        cov[BA + i, BA + i] = c[C_ACC_BIAS_SIGMA] ** 2
    cov[DEV, DEV] = c[C_DEVIATION] ** 2


@njit(cache=True, nogil=True)
def _start_running(state, cov, c):
    """Leave the alignment: velocity, path and waves get their priors."""
    for i in range(V, DEV):
        for j in range(N):
            cov[i, j] = 0.0
            cov[j, i] = 0.0
    for i in range(S_V, S_DEV):
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
    arm = matrix_from_quat(state[S_Q : S_Q + 4]) @ c[C_LEVER : C_LEVER + 3]
    state[S_P : S_P + 3] = arm
    state[S_PHASE] = PHASE_RUN


@njit(cache=True, nogil=True)
def imu_step(state, c, t, gyro, force, nis):
    """Use one IMU sample: gyro (3,) [rad/s], force (3,) [m/s²] at t [s] > state time.

    nis (2,) gets the sum of the NIS of the pseudo-measurements used and their number.
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
    _observe(state, c, force, force_n, rate_z, dt)
    if state[S_PHASE] == PHASE_RUN:
        _integrate(state, c, force_n, rate_z, dt)
    propagate(state, cov, c, mat, force_n, rate_z, dt)
    if state[S_PHASE] == PHASE_ALIGN:
        if t - state[S_AIDED] >= 0.5:
            state[S_AIDED] = t
            _level(state, cov, c)
        if t - state[S_START] >= c[C_ALIGN_TIME]:
            _start_running(state, cov, c)
            state[S_AIDED] = t
    else:
        if t - state[S_AIDED] >= c[C_AIDING_INTERVAL] - 1e-6:
            since = t - state[S_AIDED]
            state[S_AIDED] = t
            _aid_position(state, cov, c, since, nis)
        if t - state[S_PATH] >= 1.0:
            state[S_PATH] = t
            if state[S_GNSS] < 0.0 or t - state[S_GNSS] > 5.0:
                _aid_path(state, cov, 0.0, c[C_LEEWAY_SIGMA] ** 2, True, True)


@njit(cache=True, nogil=True)
def _observe(state, c, force, force_n, rate_z, dt):
    """Follow rate of turn, vibration and the slow level force."""
    # 5 s: over half a wave period, so that yawing in waves does not pass for a turn.
    state[S_TURN] += dt / (5.0 + dt) * (rate_z - state[S_TURN])
    state[S_SLOW_TURN] += dt / (3.0 + dt) * (state[S_TURN] - state[S_SLOW_TURN])
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
def _level(state, cov, c):
    """Align with the direction of the smoothed specific force, deeply distrusted."""
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    force_n = mat @ (state[S_SMOOTH : S_SMOOTH + 3] - state[S_BA : S_BA + 3])
    h = np.zeros(N)
    h[TH + 1] = -GRAVITY
    scalar_update(state, cov, h, force_n[0], c[C_ALIGN_SIGMA] ** 2, True)
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    force_n = mat @ (state[S_SMOOTH : S_SMOOTH + 3] - state[S_BA : S_BA + 3])
    h[TH + 1] = 0.0
    h[TH] = GRAVITY
    scalar_update(state, cov, h, force_n[1], c[C_ALIGN_SIGMA] ** 2, True)


@njit(cache=True, nogil=True)
def _aid_position(state, cov, c, since, nis):
    """Pseudo-measurement: the place relative to the mean path is the wave displacement.

    It is that of the roll centre if the lever arm is known, else that of the IMU.
    """
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    arm = mat @ c[C_LEVER : C_LEVER + 3]
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
        nis[0] += scalar_update(state, cov, h, innovation, variance, True)
        nis[1] += 1.0
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
def _aid_path(state, cov, measured, variance, athwart, apply):
    """Use a speed of the mean path along the bow, or athwart it."""
    yaw = heading_angle(state)
    cosine, sine = math.cos(yaw), math.sin(yaw)
    ahead_speed = cosine * state[S_VP] + sine * state[S_VP + 1]
    athwart_speed = -sine * state[S_VP] + cosine * state[S_VP + 1]
    h = np.zeros(N)
    if athwart:
        h[VP], h[VP + 1] = -sine, cosine
        h[TH + 2] = -ahead_speed
        return scalar_update(state, cov, h, measured - athwart_speed, variance, apply)
    h[VP], h[VP + 1] = cosine, sine
    h[TH + 2] = athwart_speed
    return scalar_update(state, cov, h, measured - ahead_speed, variance, apply)


@njit(cache=True, nogil=True)
def log_step(state, c, t, speed, gate):
    """Use a speed through water [m/s]; return (code, NIS)."""
    cov = state[S_COV:].reshape(N, N)
    if state[S_PHASE] != PHASE_RUN:
        yaw = heading_angle(state)
        state[S_VP] = speed * math.cos(yaw)
        state[S_VP + 1] = speed * math.sin(yaw)
        state[S_LOG] = t
        return _OK, 1.0
    if state[S_GNSS] >= 0.0 and t - state[S_GNSS] < 5.0:
        state[S_LOG] = t
        return _OK, 1.0
    variance = c[C_LOG_SIGMA] ** 2
    nis = _aid_path(state, cov, speed, variance, False, False)
    if nis > gate:
        return _GATED, nis
    _aid_path(state, cov, speed, variance, False, True)
    state[S_LOG] = t
    return _OK, nis


@njit(cache=True, nogil=True)
def gnss_step(state, c, t, velocity, variance, gate):
    """Use a GNSS velocity (3,) ENU [m/s] of the antenna; variance (3,) [m²/s²]. Return (code, NIS)."""
    cov = state[S_COV:].reshape(N, N)
    if state[S_PHASE] != PHASE_RUN:
        return _OK, 3.0
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
    if state[S_GNSS] < 0.0 or t - state[S_GNSS] > 5.0:
        # What was believed of the track was relative to the water or old: a current may lie between.
        for i in range(2):
            cov[V + i, V + i] += _CURRENT**2
            cov[VP + i, VP + i] += _CURRENT**2
            cov[V + i, VP + i] += _CURRENT**2
            cov[VP + i, V + i] += _CURRENT**2
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
        return _GATED, nis
    gain = np.linalg.solve(s, hs @ cov).T
    updated = cov - gain @ s @ gain.T
    for i in range(N):
        for j in range(N):
            cov[i, j] = 0.5 * (updated[i, j] + updated[j, i])
    inject(state, gain @ innovations)
    state[S_GNSS] = t
    return _OK, nis


@njit(cache=True, nogil=True)
def mag_step(state, c, t, field, gate):
    """Use a magnetic field (3,) [T] for the heading alone; return (code, NIS).

    Gated by norm and dip against what was learned, then by the innovation. Tilt is considered, never moved.
    """
    cov = state[S_COV:].reshape(N, N)
    mat = matrix_from_quat(state[S_Q : S_Q + 4])
    m = mat @ field
    norm = math.sqrt(m[0] ** 2 + m[1] ** 2 + m[2] ** 2)
    level2 = m[0] ** 2 + m[1] ** 2
    if not level2 > (0.05 * norm) ** 2:
        return MAG_DIP, 0.0
    north = 0.5 * math.pi - c[C_DECLINATION]
    innovation = wrap(north - math.atan2(m[1], m[0]) - state[S_DEV])
    white = (c[C_MAG_NOISE] ** 2) / level2
    if state[S_MAG] < 0.0:
        _set_heading(state, cov, c, innovation)
        state[S_NORM] = norm
        state[S_DIP] = -m[2] / norm
        state[S_MAG_R] = white
        state[S_MAG] = t
        return _OK, 1.0
    code = _judge_field(state, cov, c, norm, -m[2] / norm)
    h = np.zeros(N)
    h[TH] = -m[2] * m[0] / level2
    h[TH + 1] = -m[2] * m[1] / level2
    h[TH + 2] = 1.0
    h[DEV] = 1.0
    spread = h @ cov @ h
    if t - state[S_MAG_LAST_TIME] < 0.1 and state[S_MAG_LAST_TIME] >= 0.0:
        # Half the square of successive differences is white noise alone, whatever the deviation.
        difference = min(abs(wrap(innovation - state[S_MAG_LAST])), 0.2)
        state[S_MAG_R] += 0.01 * (0.5 * difference**2 - state[S_MAG_R])
    state[S_MAG_LAST] = innovation
    state[S_MAG_LAST_TIME] = t
    variance = max(state[S_MAG_R], 0.25 * white)
    nis = innovation**2 / (spread + variance)
    if code == _OK and nis > gate:
        code = _GATED
    if code != _OK:
        if state[S_MAG_BAD] < 0.0:
            state[S_MAG_BAD] = t
        if t - state[S_MAG_BAD] > c[C_MAG_LOCKOUT]:
            # The field has changed for good (cargo, a crane): start from it with a wide deviation.
            cov[DEV, DEV] += _RELEARNED_DEVIATION**2
            state[S_NORM] = norm
            state[S_DIP] = -m[2] / norm
            state[S_FIELD_TIME] = 0.0
            state[S_MAG_BAD] = -1.0
            return MAG_RELEARNED, nis
        return code, nis
    state[S_MAG_BAD] = -1.0
    _learn_field(state, norm, -m[2] / norm, min(t - state[S_MAG], 1.0))
    state[S_MAG] = t
    mask = np.zeros((N, N))
    mask[TH + 2, TH + 2] = 1.0
    mask[DEV, DEV] = 1.0
    for i in range(3):
        for j in range(3):
            mask[BG + i, BG + j] = mat[2, i] * mat[2, j]
    masked_update(state, cov, h, innovation, variance, mask)
    return _OK, nis


# Deviation (rad) that a field learned anew may hold.
_RELEARNED_DEVIATION = 0.2


@njit(cache=True, nogil=True)
def _set_heading(state, cov, c, innovation):
    """Turn the attitude onto the first magnetic heading."""
    turn = quat_from_rotvec(np.array([0.0, 0.0, innovation]))
    state[S_Q : S_Q + 4] = quat_normalize(quat_multiply(turn, state[S_Q : S_Q + 4]))
    vx, vy = state[S_VP], state[S_VP + 1]
    state[S_VP] = vx * math.cos(innovation) - vy * math.sin(innovation)
    state[S_VP + 1] = vx * math.sin(innovation) + vy * math.cos(innovation)
    for j in range(N):
        cov[TH + 2, j] = 0.0
        cov[j, TH + 2] = 0.0
    # The tilt at the start may be 10 deg off, and the dip multiplies that.
    cov[TH + 2, TH + 2] = 0.3**2 + c[C_DEVIATION] ** 2


@njit(cache=True, nogil=True)
def _judge_field(state, cov, c, norm, dip):
    tilt = math.sqrt(cov[TH, TH] + cov[TH + 1, TH + 1])
    if abs(norm / state[S_NORM] - 1.0) > c[C_NORM_GATE]:
        return MAG_NORM
    if abs(math.asin(min(max(dip, -1.0), 1.0)) - math.asin(state[S_DIP])) > c[C_DIP_GATE] + 3.0 * tilt:
        return MAG_DIP
    return _OK


@njit(cache=True, nogil=True)
def _learn_field(state, norm, dip, dt):
    """Follow norm and dip: a mean over the first 100 s, then with 100 s."""
    state[S_FIELD_TIME] = min(state[S_FIELD_TIME] + dt, 100.0)
    weight = min(dt / max(state[S_FIELD_TIME], dt, 1e-3), 1.0)
    state[S_NORM] += weight * (norm - state[S_NORM])
    state[S_DIP] = min(max(state[S_DIP] + weight * (dip - state[S_DIP]), -1.0), 1.0)


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
        while m < len(mag_t) and mag_t[m] < t:
            if state[S_PHASE] != PHASE_EMPTY:
                code, value = mag_step(state, c, mag_t[m], mag[m], gates[0])
                if code == _OK and state[S_PHASE] == PHASE_RUN:
                    nis[1, 0] += value
                    nis[1, 1] += 1.0
            m += 1
        while k < len(gnss_t) and gnss_t[k] < t:
            if state[S_PHASE] != PHASE_EMPTY:
                code, value = gnss_step(state, c, gnss_t[k], gnss[k], gnss_variance, gates[1])
                if code == _OK and state[S_PHASE] == PHASE_RUN:
                    nis[2, 0] += value
                    nis[2, 1] += 3.0
            k += 1
        while n < len(log_t) and log_t[n] < t:
            if state[S_PHASE] != PHASE_EMPTY:
                log_step(state, c, log_t[n], log[n], gates[2])
            n += 1
        if state[S_PHASE] == PHASE_EMPTY:
            begin(state, c, t, force[i])
        else:
            imu_step(state, c, t, gyro[i], force[i], pair)
            if t - state[S_START] > 60.0:
                nis[0, 0] += pair[0]
                nis[0, 1] += pair[1]
        cov = state[S_COV:].reshape(N, N)
        out[i, 0:4] = state[S_Q : S_Q + 4]
        out[i, 4], out[i, 5], out[i, 6] = cov[0, 0], cov[0, 1], cov[0, 2]
        out[i, 7], out[i, 8], out[i, 9] = cov[1, 1], cov[1, 2], cov[2, 2]
        out[i, 10:13] = state[S_BG : S_BG + 3]
        out[i, 13] = state[S_PHASE]
