# SPDX-License-Identifier: Apache-2.0
"""Prediction kernels of the error-state filter: nominal state at IMU rate, covariance at a lower one.

Source: Groves, 2nd ed., sections 14.2.4 (error dynamics in NED) and 3.3.1 (prediction); paper 003 eq. 11.
"""

import math

import numpy as np
from numba import njit

from ins_gps.layout import (
    ACC,
    ACC_BIAS,
    ATT,
    C_MULTIPATH,
    C_NOISE,
    C_ONSET,
    C_SLOW,
    CHANNEL,
    CHANNEL_WIDTH,
    CLK,
    CLOCK,
    CLOCK_DRIFT,
    CLONE,
    CLONE_CLK,
    CLONE_CLOCK,
    CLONE_POS,
    CORRECTION_SLOTS,
    CORRECTION_WIDTH,
    DRIFT,
    FIX,
    FIX_ERROR,
    FORCE,
    GYR,
    GYR_BIAS,
    HAVE_IMU,
    HEAD,
    HELD,
    INTERSYSTEM,
    ISB,
    NAV_STATES,
    NAVIGATION,
    NSEC,
    PER_CHANNEL,
    POS,
    RATE,
    SEC,
    SPAN,
    SPAN_FORCE,
    VEL,
)
from ins_gps.strapdown import NAV, increments, mechanise, navigation_rates
from ins_gps.vibration import measure_noise, noise_density
from kalman_core.earth import gravity, radii
from kalman_core.rotation import matrix_from_quat, quat_from_rotvec, quat_multiply, quat_normalize

# Columns of the configuration array that the kernels read.
(
    Q_GYRO,  # (rad/s)^2/Hz
    Q_ACCEL,  # (m/s^2)^2/Hz
    Q_GYRO_BIAS,  # (rad/s)^2/s
    Q_ACCEL_BIAS,  # (m/s^2)^2/s
    Q_CLOCK,  # m^2/s
    Q_DRIFT,  # (m/s)^2/s
    COVARIANCE_STEP,  # s
    GAP,  # s
    GAP_FORCE,  # m/s^2
    GAP_RATE,  # rad/s
    BIASES,  # 1: the bias states are estimated
    DRIFTS,  # 1: the clock drift is a state
    VIBRATION,  # 1: the noise that the IMU's samples show counts
) = range(13)
CONFIG_PREDICTION = 13


@njit(cache=True, nogil=True)
def covariance_of(state, channels):
    """Return the view (n, n) of the covariance within the flat array, frozen copies included."""
    own = CHANNEL + PER_CHANNEL * channels
    start = HEAD + channels * CHANNEL_WIDTH + CORRECTION_SLOTS * CORRECTION_WIDTH
    # n² + channels n + (n − own) values follow: see `layout.state_size`.
    half = 0.5 * (channels + 1.0)
    n = round(math.sqrt(half * half + len(state) - start + own) - half)
    return state[start : start + n * n].reshape((n, n))


@njit(cache=True, nogil=True)
def signatures_of(state, channels):
    """Return the view (channels, n) of what a drift of each code would have done to the estimate."""
    n = covariance_of(state, channels).shape[0]
    start = HEAD + channels * CHANNEL_WIDTH + CORRECTION_SLOTS * CORRECTION_WIDTH + n * n
    return state[start : start + channels * n].reshape((channels, n))


@njit(cache=True, nogil=True)
def error_dynamics(nav, force_n, mat_nb, F):
    """Fill F (NAV_STATES, NAV_STATES) of ``d error/dt = F error`` at `nav`.

    force_n: (3,) specific force in NED (m/s^2); mat_nb: (3, 3) attitude.
    """
    F[:, :] = 0.0
    rates = np.empty(6)
    navigation_rates(nav[0], nav[2], nav[3], nav[4], rates)
    meridian, normal = radii(nav[0])
    rm, rn = meridian + nav[2], normal + nav[2]
    tan = math.tan(nav[0])
    ex, ey, ez = rates[3], rates[4], rates[5]
    ix, iy, iz = rates[0] + ex, rates[1] + ey, rates[2] + ez
    wx, wy, wz = rates[0] + ix, rates[1] + iy, rates[2] + iz
    for k in range(3):
        F[POS + k, VEL + k] = 1.0
    # Position errors are those of latitude, longitude and height, scaled to metres.
    F[POS, POS], F[POS, POS + 2] = -nav[5] / rm, nav[3] / rm
    F[POS + 1, POS] = nav[4] * tan / rm
    F[POS + 1, POS + 1], F[POS + 1, POS + 2] = -nav[5] / rn - nav[3] * tan / rm, nav[4] / rn
    F[VEL, VEL + 1], F[VEL, VEL + 2] = wz, -wy
    F[VEL + 1, VEL], F[VEL + 1, VEL + 2] = -wz, wx
    F[VEL + 2, VEL], F[VEL + 2, VEL + 1] = wy, -wx
    F[VEL + 2, POS + 2] = 2.0 * gravity(nav[0], nav[2]) / math.sqrt(rm * rn)
    F[VEL, ATT + 1], F[VEL, ATT + 2] = force_n[2], -force_n[1]
    F[VEL + 1, ATT], F[VEL + 1, ATT + 2] = -force_n[2], force_n[0]
    F[VEL + 2, ATT], F[VEL + 2, ATT + 1] = force_n[1], -force_n[0]
    F[ATT, ATT + 1], F[ATT, ATT + 2] = iz, -iy
    F[ATT + 1, ATT], F[ATT + 1, ATT + 2] = -iz, ix
    F[ATT + 2, ATT], F[ATT + 2, ATT + 1] = iy, -ix
    F[ATT, VEL + 1] = -1.0 / rn
    F[ATT + 1, VEL] = 1.0 / rm
    F[ATT + 2, VEL + 1] = tan / rn
    # Latitude changes the components of the Earth's rate and the transport rate's vertical part.
    F[ATT, POS] = -rates[2] / rm
    F[ATT + 2, POS] = (rates[0] + nav[4] * (1.0 + tan * tan) / rn) / rm
    for i in range(3):
        for j in range(3):
            F[VEL + i, ACC + j] = -mat_nb[i, j]
            F[ATT + i, GYR + j] = -mat_nb[i, j]
    F[CLK, DRIFT] = 1.0


@njit(cache=True, nogil=True)
def transition(state, Phi):
    """Fill Phi (NAV_STATES, NAV_STATES) with the transition over the span not yet in the covariance.

    ``I + F dt + F² dt²/2`` with the mean force of the span.
    """
    dt = state[SPAN]
    nav = state[NAVIGATION : NAVIGATION + NAV]
    mean_force = state[SPAN_FORCE : SPAN_FORCE + 3] / dt
    F = np.empty((NAV_STATES, NAV_STATES))
    error_dynamics(nav, mean_force, matrix_from_quat(nav[6:10]), F)
    Phi[:, :] = 0.0
    half = 0.5 * dt * dt
    for i in range(NAV_STATES):
        Phi[i, i] = 1.0
    for i in range(NAV_STATES):
        for k in range(NAV_STATES):
            f = F[i, k]
            if f != 0.0:
                Phi[i, k] += f * dt
                for j in range(NAV_STATES):
                    Phi[i, j] += half * f * F[k, j]


@njit(cache=True, nogil=True)
def _add_noise(state, P, config, dt):
    """Add the white noise of rates and specific force over `dt` (s)."""
    mat = matrix_from_quat(state[NAVIGATION + 6 : NAVIGATION + 10])
    qg, qa = np.empty((3, 3)), np.empty((3, 3))
    noise_density(state, 0, config[Q_GYRO], config[VIBRATION], mat, qg)
    noise_density(state, 3, config[Q_ACCEL], config[VIBRATION], mat, qa)
    for i in range(3):
        for j in range(3):
            a = qa[i, j] * dt
            P[ATT + i, ATT + j] += qg[i, j] * dt
            P[VEL + i, VEL + j] += a
            P[POS + i, POS + j] += a * dt * dt / 3.0
            P[POS + i, VEL + j] += 0.5 * a * dt
            P[VEL + i, POS + j] += 0.5 * a * dt


@njit(cache=True, nogil=True)
def advance_covariance(state, channels, config):
    """Bring the covariance up to the nominal state with the force accumulated since the last call."""
    dt = state[SPAN]
    if not dt > 0.0:
        return
    P = covariance_of(state, channels)
    n = P.shape[0]
    Phi = np.empty((NAV_STATES, NAV_STATES))
    transition(state, Phi)
    rows = np.zeros((NAV_STATES, n))
    for i in range(NAV_STATES):
        for k in range(NAV_STATES):
            f = Phi[i, k]
            if f != 0.0:
                for j in range(n):
                    rows[i, j] += f * P[k, j]
    for i in range(NAV_STATES):
        for j in range(NAV_STATES, n):
            P[i, j] = rows[i, j]
            P[j, i] = rows[i, j]
    for i in range(NAV_STATES):
        for j in range(i, NAV_STATES):
            total = 0.0
            for k in range(NAV_STATES):
                total += rows[i, k] * Phi[j, k]
            P[i, j] = total
            P[j, i] = total
    _add_noise(state, P, config, dt)
    for k in range(3):
        P[ACC + k, ACC + k] += config[BIASES] * config[Q_ACCEL_BIAS] * dt
        P[GYR + k, GYR + k] += config[BIASES] * config[Q_GYRO_BIAS] * dt
    qd = config[DRIFTS] * config[Q_DRIFT] * dt
    P[CLK, CLK] += config[Q_CLOCK] * dt + qd * dt * dt / 3.0
    P[CLK, DRIFT] += 0.5 * qd * dt
    P[DRIFT, CLK] += 0.5 * qd * dt
    P[DRIFT, DRIFT] += qd
    signatures = signatures_of(state, channels)
    moved = np.empty(NAV_STATES)
    for a in range(channels):
        if state[HEAD + a * CHANNEL_WIDTH + C_ONSET] == 0.0:
            continue
        for i in range(NAV_STATES):
            moved[i] = 0.0
            for k in range(NAV_STATES):
                moved[i] += Phi[i, k] * signatures[a, k]
        signatures[a, :NAV_STATES] = moved
    state[SPAN] = 0.0
    state[SPAN_FORCE : SPAN_FORCE + 3] = 0.0


@njit(cache=True, nogil=True)
def _doubt_gap(state, channels, config, start):
    """Add what the craft may have done since the gap of the IMU was `start` s old.

    A gap of h s leaves σ of gap_force h in velocity and gap_rate h in attitude, as noise of a density that
    grows with h: it does not matter how epochs cut the gap.
    """
    P = covariance_of(state, channels)
    end = state[HELD]
    dt = end - start
    # Integrals of 2 h u^k over the part, u being the time from h to its end.
    m = np.empty(5)
    for k in range(5):
        m[k] = 2.0 * dt ** (k + 1) * (end / (k + 1.0) - dt / (k + 2.0))
    f = matrix_from_quat(state[NAVIGATION + 6 : NAVIGATION + 10]) @ state[FORCE : FORCE + 3]
    # What attitude errs by tilts the force.
    A = np.array([[0.0, f[2], -f[1]], [-f[2], 0.0, f[0]], [f[1], -f[0], 0.0]])
    qf, qr = config[GAP_FORCE] ** 2, config[GAP_RATE] ** 2
    one, AA = np.eye(3), A @ A.T
    pos, vel, att = slice(POS, POS + 3), slice(VEL, VEL + 3), slice(ATT, ATT + 3)
    P[pos, pos] += qf * m[2] * one + 0.25 * qr * m[4] * AA
    P[vel, vel] += qf * m[0] * one + qr * m[2] * AA
    P[att, att] += qr * m[0] * one
    P[pos, vel] += qf * m[1] * one + 0.5 * qr * m[3] * AA
    P[vel, pos] += qf * m[1] * one + 0.5 * qr * m[3] * AA
    P[pos, att] += 0.5 * qr * m[2] * A
    P[att, pos] += 0.5 * qr * m[2] * A.T
    P[vel, att] += qr * m[1] * A
    P[att, vel] += qr * m[1] * A.T


@njit(cache=True, nogil=True)
def _integrate(state, channels, config, rate, force, dt):
    inc = np.empty(6)
    work = np.empty(20)
    increments(rate, force, state[RATE : RATE + 3], state[FORCE : FORCE + 3], dt, inc)
    mechanise(state[NAVIGATION : NAVIGATION + NAV], inc, dt, work)
    for k in range(3):
        state[RATE + k] = rate[k]
        state[FORCE + k] = force[k]
        state[SPAN_FORCE + k] += work[k]
    state[SPAN] += dt
    state[CLOCK] += dt * state[CLOCK_DRIFT]
    start = state[HELD]
    state[HELD] += dt
    if state[HELD] > config[GAP] + 1e-9:
        advance_covariance(state, channels, config)
        _doubt_gap(state, channels, config, start if start > config[GAP] + 1e-9 else 0.0)
    elif state[SPAN] >= config[COVARIANCE_STEP] - 1e-9:
        advance_covariance(state, channels, config)


@njit(cache=True, nogil=True)
def imu_step(state, channels, config, rate, force, sec, nsec):
    """Advance to (sec, nsec) with a sample's mean rate and force (3,), biases still in them."""
    measure_noise(state, rate, force, sec, nsec, config[Q_GYRO], config[Q_ACCEL], config[GAP])
    dt = (sec - state[SEC]) + (nsec - state[NSEC]) * 1e-9
    if not dt > 0.0:
        state[HELD] = -dt
        return
    w = np.empty(3)
    f = np.empty(3)
    for k in range(3):
        w[k] = rate[k] - state[GYR_BIAS + k]
        f[k] = force[k] - state[ACC_BIAS + k]
    if state[HAVE_IMU] == 0.0:
        state[RATE : RATE + 3] = w
        state[FORCE : FORCE + 3] = f
        state[HAVE_IMU] = 1.0
    _integrate(state, channels, config, w, f, dt)
    state[HELD] = 0.0
    state[SEC] = sec
    state[NSEC] = nsec


@njit(cache=True, nogil=True)
def hold_to(state, channels, config, sec, nsec):
    """Advance to (sec, nsec) between two IMU samples with the last one held, and flush the covariance.

    First order in the part of an IMU interval, as are eqs. 31-32 of paper 003, but it needs no sample
    from the future.
    """
    dt = (sec - state[SEC]) + (nsec - state[NSEC]) * 1e-9
    if dt > 0.0 and state[HAVE_IMU] != 0.0:
        w = state[RATE : RATE + 3].copy()
        f = state[FORCE : FORCE + 3].copy()
        _integrate(state, channels, config, w, f, dt)
        state[SEC] = sec
        state[NSEC] = nsec
    advance_covariance(state, channels, config)


@njit(cache=True, nogil=True)
def inject(state, channels, dx):
    """Move the error estimate `dx` (n,) into the nominal state."""
    nav = state[NAVIGATION : NAVIGATION + NAV]
    meridian, normal = radii(nav[0])
    s, c = math.sin(nav[0]), max(math.cos(nav[0]), 1e-3)
    so, co = math.sin(nav[1]), math.cos(nav[1])
    nav[0] += dx[POS] / (meridian + nav[2])
    nav[1] += dx[POS + 1] / ((normal + nav[2]) * c)
    nav[2] -= dx[POS + 2]
    for k in range(3):
        nav[3 + k] += dx[VEL + k]
        state[ACC_BIAS + k] += dx[ACC + k]
        state[GYR_BIAS + k] += dx[GYR + k]
        # The held sample is bias-free: it follows the bias.
        state[FORCE + k] -= dx[ACC + k]
        state[RATE + k] -= dx[GYR + k]
    nav[6:10] = quat_normalize(quat_multiply(quat_from_rotvec(dx[ATT : ATT + 3]), nav[6:10].copy()))
    state[CLOCK] += dx[CLK]
    state[CLOCK_DRIFT] += dx[DRIFT]
    state[INTERSYSTEM] += dx[ISB]
    for k in range(CLONE - FIX):
        state[FIX_ERROR + k] += dx[FIX + k]
    n, e, d = dx[CLONE], dx[CLONE + 1], dx[CLONE + 2]
    state[CLONE_POS] += -s * co * n - so * e - c * co * d
    state[CLONE_POS + 1] += -s * so * n + co * e - c * so * d
    state[CLONE_POS + 2] += c * n - s * d
    state[CLONE_CLOCK] += dx[CLONE_CLK]
    for i in range(channels):
        at = HEAD + i * CHANNEL_WIDTH
        state[at + C_SLOW] += dx[CHANNEL + PER_CHANNEL * i]
        state[at + C_MULTIPATH] += dx[CHANNEL + PER_CHANNEL * i + 1]
        state[at + C_NOISE] += dx[CHANNEL + PER_CHANNEL * i + 2]
    own = CHANNEL + PER_CHANNEL * channels
    first = len(state) - (len(dx) - own)
    for i in range(len(dx) - own):
        state[first + i] += dx[own + i]
