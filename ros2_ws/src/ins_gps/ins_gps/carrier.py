# SPDX-License-Identifier: Apache-2.0
"""Carrier difference between two epochs, against a clone of the earlier one.

λ(φ_k − φ_{k−1}) is the change of the *range*, so the filter keeps a clone of antenna position and clock of
the epoch before and models exactly that; taken as the rate at the end of the interval (paper 003 eq. 14) it
would be off by a·Δt/2 under acceleration a. The carrier noise of an epoch enters two differences with
opposite signs: it is a state per channel, which makes consecutive differences correlate at −0.5 as they do.
Source: paper 003 eqs. 1-7; Wendel et al., "Tightly coupled GPS/INS integration using time-differenced
carrier phase" (2006); Farrell, "Aided Navigation" (2008), 8.4.
"""

import math

import numpy as np
from numba import njit

from ins_gps.channels import (
    CARRIER_NOISE,
    CARRIER_WALK,
    CLONES,
    GATE,
    RATE_CORRECTION,
    RATE_NEW,
    RATE_SLIP,
    RATE_USED,
    RATES,
    REPORT_RATE,
    REPORT_RATE_W,
    REPORT_WIDTH,
    SUM_RATE_NIS,
    SUM_RATE_USED,
    channel_of,
    clear_error,
    correction_of,
    signal_key,
    wavelength,
)
from ins_gps.constants import (
    SPEED_OF_LIGHT,
    WAVELENGTH_L1,
)
from ins_gps.correction import ACCEPTED, EXCLUDED, UNUSED, joint_update
from ins_gps.faults import clone_signatures, spread_signatures
from ins_gps.layout import (
    ATT,
    C_NOISE,
    C_PHASE,
    C_SAT,
    C_SATCLK,
    CHANNEL,
    CHANNEL_WIDTH,
    CLK,
    CLOCK,
    CLONE,
    CLONE_CLK,
    CLONE_CLOCK,
    CLONE_NSEC,
    CLONE_POS,
    CLONE_SEC,
    CLONE_VALID,
    HEAD,
    NSEC,
    PER_CHANNEL,
    POS,
    SEC,
)
from ins_gps.orbit import range_and_rate
from ins_gps.orbit_change import keep_orbit
from ins_gps.prediction import covariance_of, inject


@njit(cache=True, nogil=True)
def line_of_sight_row(H, los_n, lever_n):
    """Write the derivatives of a range by position and, through the lever arm, attitude into row H (n,)."""
    for k in range(3):
        H[POS + k] = -los_n[k]
    H[ATT] = los_n[1] * lever_n[2] - los_n[2] * lever_n[1]
    H[ATT + 1] = los_n[2] * lever_n[0] - los_n[0] * lever_n[2]
    H[ATT + 2] = los_n[0] * lever_n[1] - los_n[1] * lever_n[0]


@njit(cache=True, nogil=True)
def _walk_variance(config, rows, use, i, dt):
    """Return the variance (m²) of the walk of row i's carrier over dt (s).

    It is the atmosphere's: it grows with the square of the wavelength, as the ionosphere's share does, and
    all bands of a satellite have it in common. Each of n bands gets n times the variance, so that together
    they weigh as one.
    """
    bands = 0
    for j in range(len(rows)):
        if (
            use[j] >= 0
            and rows[j, 0] == rows[i, 0]
            and rows[j, 1] == rows[i, 1]
            and math.isfinite(rows[j, 4])
        ):
            bands += 1
    walk = config[CARRIER_WALK] * (wavelength(rows[i, 2]) / WAVELENGTH_L1) ** 2
    return bands * walk * walk * dt


@njit(cache=True, nogil=True)
def carrier_update(state, channels, config, rows, use, site, mat_en, lever_n, dt, report, summary, retained):
    """Difference the carrier over the epochs against the clone; keep the noise of this epoch.

    retained: (m, n + 1) out: row i holds the cross-covariance of the new carrier noise with all errors and
    its estimate, for `_reclone`; report says which rows have one.
    """
    P = covariance_of(state, channels)
    n = P.shape[0]
    m = len(rows)
    H = np.zeros((m, n))
    nu = np.zeros(m)
    R = np.ones(m)
    status = np.zeros(m, np.int64)
    zero = np.zeros(3)
    los, los_n = np.empty(3), np.empty(3)
    white = config[CARRIER_NOISE] ** 2
    for i in range(m):
        row = rows[i]
        if use[i] < 0 or not math.isfinite(row[4]):
            continue
        at = HEAD + use[i] * CHANNEL_WIDTH
        report[i, REPORT_RATE] = RATE_NEW
        if state[at + C_PHASE] == 0.0:
            continue
        if row[8] > 0.0:
            report[i, REPORT_RATE] = RATE_SLIP
            continue
        if math.isfinite(row[7]) and row[7] < dt - 0.01:
            report[i, REPORT_RATE] = RATE_SLIP
            continue
        before = range_and_rate(
            state[at + C_SAT : at + C_SAT + 6], state[CLONE_POS : CLONE_POS + 3], zero, los
        )[0]
        for k in range(3):
            los_n[k] = mat_en[0, k] * los[0] + mat_en[1, k] * los[1] + mat_en[2, k] * los[2]
        for k in range(3):
            H[i, CLONE + k] = los_n[k]
        H[i, CLONE_CLK] = -1.0
        now = range_and_rate(row[9:15], site, zero, los)[0]
        for k in range(3):
            los_n[k] = mat_en[0, k] * los[0] + mat_en[1, k] * los[1] + mat_en[2, k] * los[2]
        line_of_sight_row(H[i], los_n, lever_n)
        H[i, CLK] = 1.0
        H[i, CHANNEL + PER_CHANNEL * use[i] + 2] = -1.0
        change = row[4] * wavelength(row[2]) - state[at + C_PHASE]
        change += SPEED_OF_LIGHT * row[15] - state[at + C_SATCLK]
        if config[RATE_CORRECTION] > 0.0:
            _, rate, valid = correction_of(state, channels, config, row)
            if valid:
                change += rate * dt
        nu[i] = change - (now - before) - (state[CLOCK] - state[CLONE_CLOCK]) + state[at + C_NOISE]
        R[i] = white + _walk_variance(config, rows, use, i, dt)
        if config[RATE_CORRECTION] > 0.0:
            R[i] += 2.0 * white
        status[i] = ACCEPTED
    dx = np.zeros(n)
    normalised = np.zeros(m)
    information = np.zeros((m, m))
    nis, count = joint_update(P, H, nu, R, status, config[GATE], dx, normalised, information)
    for i in range(m):
        if status[i] == UNUSED:
            continue
        report[i, REPORT_RATE] = RATE_SLIP if status[i] == EXCLUDED else RATE_USED
        report[i, REPORT_RATE_W] = normalised[i]
    if count == 0:
        return
    summary[SUM_RATE_NIS], summary[SUM_RATE_USED] = nis, count
    # Of the new noise e (variance `white`): estimate white S⁻¹ν, covariance with the errors −white K^T.
    noise = np.full(m, -1, np.int64)
    for i in range(m):
        if status[i] == ACCEPTED:
            noise[i] = CHANNEL + PER_CHANNEL * use[i] + 2
    nowhere = np.full(m, -1, np.int64)
    spread_signatures(state, channels, H, nu, R, status, information, nowhere, noise, white)
    gain = np.zeros((n, m))
    for j in range(m):
        if status[j] != ACCEPTED:
            continue
        for i in range(m):
            if status[i] != ACCEPTED:
                continue
            w = information[i, j]
            retained[i, n] += white * w * nu[j]
    # K = P⁻ Hᵀ S⁻¹, and P⁺ Hᵀ = P⁻ Hᵀ S⁻¹ R: so K = P⁺ Hᵀ R⁻¹.
    for i in range(m):
        if status[i] != ACCEPTED:
            continue
        for k in range(n):
            h = H[i, k]
            if h != 0.0:
                for r in range(n):
                    gain[r, i] += P[k, r] * h
        for r in range(n):
            retained[i, r] = -white * gain[r, i] / R[i]
    for i in range(m):
        if status[i] == ACCEPTED:
            for j in range(m):
                if status[j] == ACCEPTED:
                    value = -white * white * information[i, j]
                    if i == j:
                        value += white
                    information[i, j] = value
    _keep_noise(state, channels, use, status, retained, information)
    # The old noise is gone; its share of dx must not be injected into the new one.
    for i in range(channels):
        dx[CHANNEL + PER_CHANNEL * i + 2] = 0.0
    inject(state, channels, dx)


@njit(cache=True, nogil=True)
def _keep_noise(state, channels, use, status, retained, covariance):
    """Replace the noise states of the used channels by those of this epoch."""
    P = covariance_of(state, channels)
    n = P.shape[0]
    m = len(use)
    is_new = np.zeros(n, np.bool_)
    for i in range(m):
        if status[i] == ACCEPTED:
            is_new[CHANNEL + PER_CHANNEL * use[i] + 2] = True
    for i in range(m):
        if status[i] != ACCEPTED:
            continue
        index = CHANNEL + PER_CHANNEL * use[i] + 2
        for r in range(n):
            if not is_new[r]:
                P[index, r] = retained[i, r]
                P[r, index] = retained[i, r]
        for j in range(m):
            if status[j] == ACCEPTED:
                other = CHANNEL + PER_CHANNEL * use[j] + 2
                P[index, other] = covariance[i, j]
                P[other, index] = covariance[i, j]
        state[HEAD + use[i] * CHANNEL_WIDTH + C_NOISE] = retained[i, n]


@njit(cache=True, nogil=True)
def reclone(state, channels, config, rows, use, site, lever_n, report):
    """Make this epoch the one that the next carrier difference refers to."""
    P = covariance_of(state, channels)
    n = P.shape[0]
    for k in range(3):
        state[CLONE_POS + k] = site[k]
    state[CLONE_CLOCK] = state[CLOCK]
    state[CLONE_SEC], state[CLONE_NSEC] = state[SEC], state[NSEC]
    state[CLONE_VALID] = 1.0
    if config[CLONES] > 0.0:
        row = np.empty((4, n))
        for r in range(n):
            row[0, r] = P[POS, r] - lever_n[1] * P[ATT + 2, r] + lever_n[2] * P[ATT + 1, r]
            row[1, r] = P[POS + 1, r] - lever_n[2] * P[ATT, r] + lever_n[0] * P[ATT + 2, r]
            row[2, r] = P[POS + 2, r] - lever_n[0] * P[ATT + 1, r] + lever_n[1] * P[ATT, r]
            row[3, r] = P[CLK, r]
        for k in range(4):
            for r in range(n):
                if not CLONE <= r <= CLONE_CLK:
                    P[CLONE + k, r] = row[k, r]
                    P[r, CLONE + k] = row[k, r]
        for k in range(4):
            P[CLONE + k, CLONE] = row[k, POS] - lever_n[1] * row[k, ATT + 2] + lever_n[2] * row[k, ATT + 1]
            P[CLONE + k, CLONE + 1] = (
                row[k, POS + 1] - lever_n[2] * row[k, ATT] + lever_n[0] * row[k, ATT + 2]
            )
            P[CLONE + k, CLONE + 2] = (
                row[k, POS + 2] - lever_n[0] * row[k, ATT + 1] + lever_n[1] * row[k, ATT]
            )
            P[CLONE + k, CLONE_CLK] = row[k, CLK]
        clone_signatures(state, channels, lever_n)
    _keep_phases(state, channels, config, rows, use, report)


@njit(cache=True, nogil=True)
def _keep_phases(state, channels, config, rows, use, report):
    present = np.zeros(channels, np.bool_)
    for i in range(len(rows)):
        if use[i] < 0:
            continue
        at = HEAD + use[i] * CHANNEL_WIDTH
        keep_orbit(state, at, rows[i])
        if not math.isfinite(rows[i, 4]):
            continue
        present[use[i]] = True
        state[at + C_PHASE] = rows[i, 4] * wavelength(rows[i, 2])
        if report[i, REPORT_RATE] != RATE_USED or config[RATES] != 2.0:
            state[at + C_NOISE] = 0.0
            index = CHANNEL + PER_CHANNEL * use[i] + 2
            clear_error(state, channels, index, config[CLONES] * config[CARRIER_NOISE] ** 2)
    for i in range(channels):
        if not present[i]:
            state[HEAD + i * CHANNEL_WIDTH + C_PHASE] = 0.0


@njit(cache=True, nogil=True)
def remember_carrier(state, channels, config, rows):
    """Keep the carriers of rows (m, OBSERVATION_COLUMNS) for rates over the next interval."""
    m = len(rows)
    use = np.full(m, -1, np.int64)
    report = np.zeros((m, REPORT_WIDTH))
    for i in range(m):
        if math.isfinite(rows[i, 9] + rows[i, 4] + rows[i, 15]):
            use[i] = channel_of(state, channels, config, signal_key(rows[i]), True)
    _keep_phases(state, channels, config, rows, use, report)
