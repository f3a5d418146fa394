# SPDX-License-Identifier: Apache-2.0
"""One GNSS epoch in the tight modes: carrier difference or Doppler, then code, then the new clone.

Source: paper 003 eqs. 13-30; Groves, 2nd ed., 14.3.2 (tight coupling).
"""

import math

import numpy as np
from numba import njit

from ins_gps.carrier import carrier_update, line_of_sight_row, reclone
from ins_gps.channels import (
    CARRIER_INTERVAL,
    CLONES,
    CODE_BAND,
    CODE_BAND_COMMON,
    CODE_MULTIPATH,
    CODE_NOISE,
    CODE_SLOW,
    CODE_SLOW_ALONE,
    DOPPLER_NOISE,
    FAULT_GATE,
    FIRST_BAND,
    GATE,
    LOST_TIME,
    PUBLISHED_RATE_NOISE,
    RATE_CORRECTION,
    RATE_DOPPLER,
    RATE_SLIP,
    RATE_USED,
    RATES,
    REPORT_CODE,
    REPORT_CODE_W,
    REPORT_ELEVATION,
    REPORT_RATE,
    REPORT_RATE_W,
    ROW_CODE_REJECTED,
    ROW_DRIFTS,
    ROW_USED,
    SUM_CLOCK_JUMP,
    SUM_CODE_NIS,
    SUM_CODE_USED,
    SUM_RATE_NIS,
    SUM_RATE_USED,
    SUM_RESTART,
    antenna,
    antenna_velocity,
    assign,
    clear_error,
    corrected_range,
    correction_of,
    decay_multipath,
    has_code,
    wavelength,
)
from ins_gps.constants import (
    SPEED_OF_LIGHT,
)
from ins_gps.correction import ACCEPTED, UNUSED, joint_update
from ins_gps.faults import admit_again, open_hypotheses, spread_signatures, take_out_drift
from ins_gps.layout import (
    C_BARRED,
    C_MULTIPATH,
    C_PHASE,
    C_REJECTED,
    C_SATCLK,
    C_SLOW,
    CHANNEL,
    CHANNEL_WIDTH,
    CLK,
    CLOCK,
    CLOCK_DRIFT,
    CLONE_NSEC,
    CLONE_SEC,
    CLONE_VALID,
    DRIFT,
    EPOCH_NSEC,
    EPOCH_SEC,
    HAVE_EPOCH,
    HEAD,
    INTERSYSTEM,
    ISB,
    LOST,
    NAVIGATION,
    PER_CHANNEL,
    POS,
    VEL,
)
from ins_gps.orbit import range_and_rate
from ins_gps.prediction import covariance_of, hold_to, inject
from kalman_core.earth import mat_ecef_from_ned
from kalman_core.rotation import matrix_from_quat

# A common shift of all codes counts as a jump of the receiver's clock beyond this (m); below it the clock
# states follow by themselves.
_CLOCK_JUMP = 30.0
_CLOCK_JUMP_SIGMA = 30.0  # m, clock uncertainty after a jump was taken out


@njit(cache=True, nogil=True)
def _median(values, count):
    ordered = np.sort(values[:count])
    if count % 2:
        return ordered[count // 2]
    return 0.5 * (ordered[count // 2 - 1] + ordered[count // 2])


@njit(cache=True, nogil=True)
def _code_innovations(state, channels, config, rows, use, site, mat_en, lever_n, H, nu, R, report):
    """Fill H, nu, R of the codes of rows with use[i] > 0; `site` is the antenna in ECEF."""
    n = H.shape[1]
    zero = np.zeros(3)
    los = np.empty(3)
    los_n = np.empty(3)
    biases = config[CLONES]
    for i in range(len(rows)):
        for k in range(n):
            H[i, k] = 0.0
        if use[i] < 0:
            continue
        row = rows[i]
        distance, _ = range_and_rate(row[9:15], site, zero, los)
        for k in range(3):
            los_n[k] = mat_en[0, k] * los[0] + mat_en[1, k] * los[1] + mat_en[2, k] * los[2]
        measured, _, corrected = corrected_range(state, channels, config, row)
        at = HEAD + use[i] * CHANNEL_WIDTH
        nu[i] = measured - distance - state[CLOCK] - state[at + C_SLOW] - state[at + C_MULTIPATH]
        line_of_sight_row(H[i], los_n, lever_n)
        H[i, CLK] = 1.0
        if row[0] != 0.0:
            nu[i] -= state[INTERSYSTEM]
            H[i, ISB] = 1.0
        H[i, CHANNEL + PER_CHANNEL * use[i]] = biases
        H[i, CHANNEL + PER_CHANNEL * use[i] + 1] = biases
        R[i] = config[CODE_NOISE] ** 2 * report[i, REPORT_ELEVATION]
        if biases == 0.0:
            slow = config[CODE_SLOW] if corrected else config[CODE_SLOW_ALONE]
            R[i] += slow**2 + config[CODE_MULTIPATH] ** 2
            if row[2] != FIRST_BAND:
                R[i] += config[CODE_BAND] ** 2 + config[CODE_BAND_COMMON] ** 2


@njit(cache=True, nogil=True)
def _take_out_clock_jump(state, channels, nu, use, rows):
    """Move a shift that all codes share into the clock; return its size (m) or 0."""
    values = np.empty(len(nu))
    count = 0
    for i in range(len(nu)):
        if use[i] >= 0 and math.isfinite(rows[i, 3]):
            values[count] = nu[i]
            count += 1
    if count < 4:
        return 0.0
    shift = _median(values, count)
    P = covariance_of(state, channels)
    if abs(shift) < _CLOCK_JUMP + 6.0 * math.sqrt(P[CLK, CLK] + P[POS, POS] + P[POS + 1, POS + 1]):
        return 0.0
    for i in range(count):
        values[i] = abs(values[i] - shift)
    # Only a jump if most satellites agree on it.
    if _median(values, count) > 0.2 * abs(shift):
        return 0.0
    state[CLOCK] += shift
    clear_error(state, channels, CLK, _CLOCK_JUMP_SIGMA**2)
    return shift


@njit(cache=True, nogil=True)
def _rate_update(state, channels, config, rows, use, site, mat_nb, mat_en, dt, report, summary):
    """Range rates: from Doppler, or (published variant) the carrier difference over dt taken as a rate."""
    P = covariance_of(state, channels)
    n = P.shape[0]
    m = len(rows)
    H = np.zeros((m, n))
    nu = np.zeros(m)
    R = np.ones(m)
    status = np.zeros(m, np.int64)
    los, los_n = np.empty(3), np.empty(3)
    velocity = np.empty(3)
    antenna_velocity(state, config, mat_nb, mat_en, velocity)
    as_rate = config[RATES] == 3.0
    for i in range(m):
        row = rows[i]
        if use[i] < 0 or report[i, REPORT_RATE] == RATE_USED:
            continue
        at = HEAD + use[i] * CHANNEL_WIDTH
        if as_rate:
            if not math.isfinite(row[4]) or state[at + C_PHASE] == 0.0 or row[8] > 0.0 or not dt > 0.0:
                continue
            measured = row[4] * wavelength(row[2]) - state[at + C_PHASE]
            measured = (measured + SPEED_OF_LIGHT * row[15] - state[at + C_SATCLK]) / dt
            R[i] = config[PUBLISHED_RATE_NOISE] ** 2
        else:
            if not math.isfinite(row[5]) or not math.isfinite(row[12] + row[13] + row[14]):
                continue
            measured = -row[5] * wavelength(row[2]) + SPEED_OF_LIGHT * row[16]
            R[i] = config[DOPPLER_NOISE] ** 2 * report[i, REPORT_ELEVATION]
        if config[RATE_CORRECTION] > 0.0:
            measured += correction_of(state, channels, config, row)[1]
        predicted = range_and_rate(row[9:15], site, velocity, los)[1]
        for k in range(3):
            los_n[k] = mat_en[0, k] * los[0] + mat_en[1, k] * los[1] + mat_en[2, k] * los[2]
            H[i, VEL + k] = -los_n[k]
        H[i, DRIFT] = 1.0
        nu[i] = measured - predicted - state[CLOCK_DRIFT]
        status[i] = ACCEPTED
    dx = np.zeros(n)
    normalised = np.zeros(m)
    information = np.zeros((m, m))
    nis, count = joint_update(P, H, nu, R, status, config[GATE], dx, normalised, information)
    nowhere = np.full(m, -1, np.int64)
    spread_signatures(state, channels, H, nu, R, status, information, nowhere, nowhere, 0.0)
    inject(state, channels, dx)
    if count:
        summary[SUM_RATE_NIS] += nis
        summary[SUM_RATE_USED] += count
    for i in range(m):
        # A slip stays reported although its satellite's Doppler stands in.
        if status[i] != UNUSED and report[i, REPORT_RATE] != RATE_SLIP:
            report[i, REPORT_RATE] = RATE_DOPPLER if status[i] == ACCEPTED else RATE_SLIP
            report[i, REPORT_RATE_W] = normalised[i]


@njit(cache=True, nogil=True)
def gnss_epoch(state, channels, config, rows, sec, nsec, report, summary):
    """Apply one epoch to the flat state: rows (m, OBSERVATION_COLUMNS), m >= 0.

    report: (m, REPORT_WIDTH) and summary: (SUMMARY,) are filled with what became of each satellite.
    """
    hold_to(state, channels, config, sec, nsec)
    P = covariance_of(state, channels)
    n = P.shape[0]
    m = len(rows)
    summary[:] = 0.0
    nav = state[NAVIGATION : NAVIGATION + 10]
    since = 0.0
    if state[HAVE_EPOCH] > 0.0:
        since = (sec - state[EPOCH_SEC]) + (nsec - state[EPOCH_NSEC]) * 1e-9
    state[EPOCH_SEC], state[EPOCH_NSEC], state[HAVE_EPOCH] = sec, nsec, 1.0
    decay_multipath(state, channels, config, since)
    mat_nb = matrix_from_quat(nav[6:10])
    mat_en = mat_ecef_from_ned(nav[0], nav[1])
    lever_n, site = np.empty(3), np.empty(3)
    antenna(state, config, mat_nb, mat_en, lever_n, site)
    use = np.empty(m, np.int64)
    available = assign(state, channels, config, rows, site, mat_en, use, report)
    H = np.zeros((m, n))
    nu, R = np.zeros(m), np.ones(m)
    _code_innovations(state, channels, config, rows, use, site, mat_en, lever_n, H, nu, R, report)
    summary[SUM_CLOCK_JUMP] = _take_out_clock_jump(state, channels, nu, use, rows)
    dt = (sec - state[CLONE_SEC]) + (nsec - state[CLONE_NSEC]) * 1e-9
    usable = state[CLONE_VALID] > 0.0 and 0.0 < dt <= config[CARRIER_INTERVAL]
    if usable and config[RATES] == 2.0 and summary[SUM_CLOCK_JUMP] == 0.0:
        retained = np.zeros((m, n + 1))
        carrier_update(
            state, channels, config, rows, use, site, mat_en, lever_n, dt, report, summary, retained
        )
    if config[RATES] > 0.0:
        antenna(state, config, mat_nb, mat_en, lever_n, site)
        _rate_update(
            state, channels, config, rows, use, site, mat_nb, mat_en, dt if usable else 0.0, report, summary
        )
    mat_nb = matrix_from_quat(nav[6:10])
    antenna(state, config, mat_nb, mat_en, lever_n, site)
    _code_innovations(state, channels, config, rows, use, site, mat_en, lever_n, H, nu, R, report)
    status = np.zeros(m, np.int64)
    codes = 0
    for i in range(m):
        if use[i] < 0 or not has_code(state, channels, config, rows[i]):
            continue
        if state[HEAD + use[i] * CHANNEL_WIDTH + C_BARRED] > 0.0:
            report[i, REPORT_CODE] = ROW_DRIFTS
            continue
        status[i] = ACCEPTED
        codes += 1
    dx = np.zeros(n)
    normalised = np.zeros(m)
    information = np.zeros((m, m))
    nis, count = joint_update(P, H, nu, R, status, config[GATE], dx, normalised, information)
    inject(state, channels, dx)
    summary[SUM_CODE_NIS], summary[SUM_CODE_USED] = nis, count
    if config[CLONES] > 0.0:
        open_hypotheses(state, channels, use, status, normalised, since)
        nowhere = np.full(m, -1, np.int64)
        spread_signatures(state, channels, H, nu, R, status, information, use, nowhere, 0.0)
        admit_again(state, channels, H, nu, R, dx, use, status, since)
    for i in range(m):
        if status[i] == UNUSED:
            continue
        report[i, REPORT_CODE] = ROW_USED if status[i] == ACCEPTED else ROW_CODE_REJECTED
        report[i, REPORT_CODE_W] = normalised[i]
        at = HEAD + use[i] * CHANNEL_WIDTH
        state[at + C_REJECTED] = 0.0 if status[i] == ACCEPTED else state[at + C_REJECTED] + 1.0
    if config[CLONES] > 0.0:
        barred = take_out_drift(state, channels, config[FAULT_GATE], count, use, status)
        for i in range(m):
            if barred >= 0 and use[i] == barred:
                report[i, REPORT_CODE] = ROW_DRIFTS
    # In a street canyon epochs with a few satellites alternate: one that fits by chance is not recovery.
    if codes >= 2 and 2 * count < codes:
        state[LOST] += since
    elif codes >= 2:
        state[LOST] = max(0.0, state[LOST] - since)
    if state[LOST] > config[LOST_TIME]:
        summary[SUM_RESTART] = 1.0
    mat_nb = matrix_from_quat(nav[6:10])
    antenna(state, config, mat_nb, mat_en, lever_n, site)
    reclone(state, channels, config, rows, use, site, lever_n, report)
    return available
