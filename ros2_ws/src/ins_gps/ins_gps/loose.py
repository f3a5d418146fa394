# SPDX-License-Identifier: Apache-2.0
"""The fix of an epoch for loose coupling and for the start, and the vector update that takes it.

Source: Groves, 2nd ed., 14.3.1 (loose coupling with lever arm).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ins_gps.channels import corrected_range, signal_key, wavelength
from ins_gps.constants import SPEED_OF_LIGHT
from ins_gps.correction import ACCEPTED, joint_update
from ins_gps.faults import spread_signatures
from ins_gps.fix import OK, Fix, solve_position, solve_velocity
from ins_gps.lasting import Lasting
from ins_gps.layout import C_KEY, C_PHASE, C_SATCLK, CHANNEL_WIDTH, HEAD
from ins_gps.orbit import azimuth_elevation, range_and_rate
from ins_gps.prediction import covariance_of, inject
from kalman_core.earth import geodetic_from_ecef, mat_ecef_from_ned

# s: errors of orbit, clock and atmosphere keep for minutes to hours.
_SLOW_TIME = 600.0


class EpochFix(NamedTuple):
    """Position fix, geodetic position (rad, rad, m), velocity fix (or None).

    lasting: of multipath and of slow errors.
    """

    position: Fix
    geodetic: np.ndarray
    velocity: Fix | None
    lasting: Lasting


def code_sigma(params, corrected: bool) -> float:
    """Return σ (m) of one code at the zenith, all its errors together, with or without DGPS correction."""
    slow = params.code_slow if corrected else params.code_slow_alone
    return math.sqrt(params.code_noise**2 + slow**2 + params.code_multipath**2)


def _weights(rows, sites, params) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors on σ and a mask of satellites above the elevation mask."""
    lat, lon, _ = geodetic_from_ecef(sites)
    factor, above = np.ones(len(rows)), np.ones(len(rows), bool)
    los, zero = np.empty(3), np.zeros(3)
    for i, row in enumerate(rows):
        if not np.isfinite(row[9:12]).all():
            continue
        range_and_rate(row[9:15], sites, zero, los)
        elevation = azimuth_elevation(los, lat, lon)[1]
        above[i] = elevation >= params.elevation_mask
        if params.elevation_weighting:
            sine = math.sin(max(elevation, 0.05))
            factor[i] = math.sqrt(0.5 + 0.5 / sine**2)
    return factor, above


def epoch_fix(state, channels: int, config, params, rows, since: float, start=None) -> EpochFix | None:
    """Return the fix of one epoch, or None if there is none.

    rows: (m, OBSERVATION_COLUMNS). Velocity comes from Doppler; where a satellite has none, from the
    carrier's change over the `since` seconds since the last epoch (0: unknown).
    """
    rows = rows[rows[:, 2] == 1.0]
    if len(rows) < 4:
        return None
    satellites, system = rows[:, 9:15], rows[:, 0]
    codes = [corrected_range(state, channels, config, row) for row in rows]
    ranges = np.array([code[0] for code in codes])
    base = np.array([code_sigma(params, code[2]) for code in codes])
    first = solve_position(satellites, ranges, base, system, start)
    if first.status != OK:
        return None
    factor, above = _weights(rows, first.position, params)
    ranges[~above] = np.nan
    fix = solve_position(satellites, ranges, base * factor, system, first.position)
    if fix.status != OK:
        return None
    geodetic = np.array(geodetic_from_ecef(fix.position))
    rates = np.array([_rate(state, channels, row, since) for row in rows])
    rates[~above] = np.nan
    velocity = solve_velocity(satellites, rates, params.doppler_noise * factor, system, fix.position)
    multipath, white = (
        float(np.mean((sigma / base[fix.used]) ** 2)) for sigma in (params.code_multipath, params.code_noise)
    )
    lasting = ((multipath, params.multipath_time), (max(1.0 - multipath - white, 0.0), _SLOW_TIME))
    return EpochFix(fix, geodetic, velocity if velocity.status == OK else None, lasting)


def _rate(state, channels: int, row, since: float) -> float:
    """Return a range rate free of the satellite clock (m/s), NaN if none."""
    if math.isfinite(row[5]):
        return -row[5] * wavelength(row[2]) + SPEED_OF_LIGHT * row[16]
    key = signal_key(row)
    for i in range(channels):
        at = HEAD + i * CHANNEL_WIDTH
        if state[at + C_KEY] == key and state[at + C_PHASE] != 0.0 and since > 0.0 and not row[8] > 0.0:
            change = row[4] * wavelength(row[2]) - state[at + C_PHASE]
            if math.isfinite(row[16]):  # unlike the difference of clocks not upset by a new ephemeris
                return change / since + SPEED_OF_LIGHT * row[16]
            return (change + SPEED_OF_LIGHT * row[15] - state[at + C_SATCLK]) / since
    return math.nan


@njit(cache=True, nogil=True)
def _weaken(S, nu, covariance, gate):
    """Return the covariance (m, m), grown until the NIS is `gate`; S: (m, m) of the innovation nu, in place.

    Bounded influence (Huber): a fix beyond the gate moves the state less, the further off it is.
    """
    weight = 1.0
    # Newton's method on 1/NIS, which is concave in the weight: it comes from below and is exact for m = 1.
    for _ in range(20):
        y = np.linalg.solve(S, nu)
        nis = nu @ y
        if not nis > gate * (1.0 + 1e-6):
            break
        step = (1.0 / gate - 1.0 / nis) * nis * nis / (y @ covariance @ y)
        S += step * covariance
        weight += step
    return weight * covariance


@njit(cache=True, nogil=True)
def vector_update(state, channels, H, nu, covariance, gate):
    """Correct with a vector of at most a few correlated measurements; return (NIS, whether within the gate).

    H: (m, n), nu: (m,), covariance: (m, m). Judged as a whole: `gate` limits the NIS with m degrees of
    freedom. What lies beyond it gets the weight that puts it on the gate: systematic errors (a delay, a
    lever arm) of a precise fix would otherwise shut it out for good.
    """
    P = covariance_of(state, channels)
    n = P.shape[0]
    m = len(nu)
    S = H @ P @ H.T + covariance
    nis = nu @ np.linalg.solve(S, nu)
    if not math.isfinite(nis):
        return nis, False
    within = nis <= gate
    if not within:
        covariance = _weaken(S, nu, covariance, gate)
    L = np.linalg.cholesky(covariance)
    white_H = np.linalg.solve(L, H)
    white_nu = np.linalg.solve(L, nu)
    dx = np.zeros(n)
    status = np.full(m, ACCEPTED, np.int64)
    R, information = np.ones(m), np.zeros((m, m))
    joint_update(P, white_H, white_nu, R, status, np.inf, dx, np.zeros(m), information)
    nowhere = np.full(m, -1, np.int64)
    spread_signatures(state, channels, white_H, white_nu, R, status, information, nowhere, nowhere, 0.0)
    inject(state, channels, dx)
    return nis, within


def ned_covariance(fix: Fix, geodetic: np.ndarray) -> np.ndarray:
    """Return the covariance (3, 3) of a fix in NED."""
    mat = mat_ecef_from_ned(geodetic[0], geodetic[1])
    return mat.T @ fix.covariance[:3, :3] @ mat
