# SPDX-License-Identifier: Apache-2.0
"""Position, velocity and clock of one epoch by weighted least squares, with RAIM.

Sources: Kaplan and Hegarty, "Understanding GPS/GNSS", 3rd ed., chapters 2 and 11 (solution, RAIM by
residuals and exclusion); Baarda 1968 for the normalised residual.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ins_gps.orbit import range_and_rate
from kalman_core.gates import chi2_gate, chi2_gates

# Residual test at this probability of false alarm, for up to 64 degrees of freedom.
FALSE_ALARM = 1e-4
_CHI2_LIMIT = chi2_gates(64, FALSE_ALARM)
# The start may be the Earth's centre: Gauss-Newton needs about 6 steps from there.
_MAX_STEPS = 12
_CONVERGED = 1e-4  # m
_STATES = 5

OK = 0
TOO_FEW = 1
NOT_CONVERGED = 2
INCONSISTENT = 3


@njit(cache=True, nogil=True)
def _normal_solve(design, weight, used, residual, free, out_step, out_cov):
    """Solve the weighted normal equations for the states with free[k]; return False if singular."""
    normal = np.zeros((_STATES, _STATES))
    right = np.zeros(_STATES)
    for i in range(len(residual)):
        if not used[i]:
            continue
        for a in range(_STATES):
            right[a] += design[i, a] * weight[i] * residual[i]
            for b in range(_STATES):
                normal[a, b] += design[i, a] * weight[i] * design[i, b]
    for a in range(_STATES):
        if not free[a]:
            normal[a, :] = 0.0
            normal[:, a] = 0.0
            normal[a, a] = 1.0
            right[a] = 0.0
    scale = np.sqrt(np.diag(normal))
    for a in range(_STATES):
        if not scale[a] > 0.0:
            return False
        for b in range(_STATES):
            normal[a, b] /= scale[a]
    for a in range(_STATES):
        for b in range(_STATES):
            normal[b, a] /= scale[a]
    if abs(np.linalg.det(normal)) < 1e-12:
        return False
    inverse = np.linalg.inv(normal)
    for a in range(_STATES):
        out_step[a] = 0.0
        for b in range(_STATES):
            out_cov[a, b] = inverse[a, b] / (scale[a] * scale[b])
            if not (free[a] and free[b]):
                out_cov[a, b] = 0.0
        for b in range(_STATES):
            out_step[a] += out_cov[a, b] * right[b]
    return True


@njit(cache=True, nogil=True)
def _iterate(satellites, values, weight, system, used, rates, at, x, cov, residual):
    """Gauss-Newton on ranges (rates False) or one linear solve on range rates at position `at`."""
    m = len(values)
    free = np.zeros(_STATES, np.bool_)
    free[:4] = True
    count, first, second = 0, 0, 0
    for i in range(m):
        if used[i]:
            count += 1
            if system[i] == 0:
                first += 1
            else:
                second += 1
    # Both systems share the receiver's clock rate, so only ranges need an inter-system bias.
    if first and second and not rates:
        free[4] = True
    if count < (5 if free[4] else 4):
        return TOO_FEW
    design = np.zeros((m, _STATES))
    los = np.zeros(3)
    step = np.zeros(_STATES)
    zero = np.zeros(3)
    for _ in range(_MAX_STEPS):
        for i in range(m):
            if rates:
                predicted = range_and_rate(satellites[i], at, x[:3], los)[1]
            else:
                predicted = range_and_rate(satellites[i], x[:3], zero, los)[0]
            design[i, 0], design[i, 1], design[i, 2] = -los[0], -los[1], -los[2]
            design[i, 3] = 1.0
            design[i, 4] = 1.0 if (free[4] and system[i] != 0) else 0.0
            residual[i] = values[i] - predicted - x[3] - design[i, 4] * x[4]
        if not _normal_solve(design, weight, used, residual, free, step, cov):
            return NOT_CONVERGED
        x += step
        if abs(step[0]) + abs(step[1]) + abs(step[2]) < _CONVERGED:
            for i in range(m):
                for a in range(_STATES):
                    residual[i] -= design[i, a] * step[a]
            return OK
    return NOT_CONVERGED


@njit(cache=True, nogil=True)
def solve(satellites, values, sigma, system, used, rates, at, x, cov, residual):
    """Solve one epoch and exclude what does not fit.

    satellites: (m, >=6) states at transmission; values: (m,) pseudoranges (or rates) free of satellite
    clock and atmosphere, m (m/s); sigma: (m,); system: (m,) 0 GPS, 1 Galileo; used: (m,) bool, in: may be
    used, out: was used; at: (3,) receiver position for rates; x: (5,) start and result: ECEF position (or
    velocity), clock (m or m/s), inter-system bias; cov: (5, 5) out; residual: (m,) out.
    Returns (status, test statistic, degrees of freedom). Status INCONSISTENT: the test fails and no
    exclusion mends it.
    """
    m = len(values)
    weight = 1.0 / (sigma * sigma)
    start = x.copy()
    while True:
        x[:] = start
        status = _iterate(satellites, values, weight, system, used, rates, at, x, cov, residual)
        if status != OK:
            return status, 0.0, 0
        count, galileo, gps = 0, 0, 0
        statistic = 0.0
        for i in range(m):
            if used[i]:
                count += 1
                galileo += 1 if system[i] != 0 else 0
                gps += 1 if system[i] == 0 else 0
                statistic += weight[i] * residual[i] ** 2
        unknowns = 5 if (galileo and gps and not rates) else 4
        freedom = count - unknowns
        if freedom == 0 or statistic < _CHI2_LIMIT[min(freedom, 64)]:
            return OK, statistic, freedom
        if freedom < 2:
            return INCONSISTENT, statistic, freedom
        worst, largest = -1, -1.0
        los = np.zeros(3)
        zero = np.zeros(3)
        row = np.zeros(_STATES)
        for i in range(m):
            if not used[i]:
                continue
            range_and_rate(satellites[i], at if rates else x[:3], zero, los)
            row[0], row[1], row[2], row[3] = -los[0], -los[1], -los[2], 1.0
            row[4] = 1.0 if (unknowns == 5 and system[i] != 0) else 0.0
            spread = sigma[i] ** 2 - row @ cov @ row
            if spread <= 1e-9 * sigma[i] ** 2:
                continue
            normalised = residual[i] ** 2 / spread
            if normalised > largest:
                worst, largest = i, normalised
        if worst < 0:
            return INCONSISTENT, statistic, freedom
        used[worst] = False


class Fix(NamedTuple):
    """A least-squares solution in ECEF; clock in m, drift in m/s, covariance of position and clock."""

    status: int
    position: np.ndarray
    clock: float
    intersystem: float
    covariance: np.ndarray
    residuals: np.ndarray
    used: np.ndarray
    statistic: float
    freedom: int

    @property
    def checked(self) -> bool:
        """Whether a single fault could have been found (at least one satellite to spare)."""
        return self.status == OK and self.freedom >= 1


def solve_position(
    satellites: np.ndarray,
    ranges: np.ndarray,
    sigma: np.ndarray,
    system: np.ndarray,
    start: np.ndarray | None = None,
) -> Fix:
    """Return the fix of one epoch; arguments as in `solve`. Rows with NaN are left out."""
    used = np.isfinite(ranges) & np.isfinite(satellites).all(axis=1)
    x = np.zeros(_STATES)
    if start is not None:
        x[:3] = start
    cov = np.zeros((_STATES, _STATES))
    residual = np.zeros(len(ranges))
    status, statistic, freedom = solve(
        np.nan_to_num(satellites, nan=1e7),
        np.nan_to_num(ranges),
        sigma,
        system,
        used,
        False,
        np.zeros(3),
        x,
        cov,
        residual,
    )
    return Fix(status, x[:3], x[3], x[4], cov, residual, used, statistic, freedom)


def solve_velocity(
    satellites: np.ndarray,
    rates: np.ndarray,
    sigma: np.ndarray,
    system: np.ndarray,
    position: np.ndarray,
) -> Fix:
    """Return velocity (as `position`) and clock drift (as `clock`) from range rates (m/s) at `position`."""
    used = np.isfinite(rates) & np.isfinite(satellites).all(axis=1)
    x = np.zeros(_STATES)
    cov = np.zeros((_STATES, _STATES))
    residual = np.zeros(len(rates))
    status, statistic, freedom = solve(
        np.nan_to_num(satellites, nan=1e7),
        np.nan_to_num(rates),
        sigma,
        system,
        used,
        True,
        position,
        x,
        cov,
        residual,
    )
    return Fix(status, x[:3], x[3], 0.0, cov, residual, used, statistic, freedom)


def protection_level(sigma: float, integrity_risk: float = 1e-7) -> float:
    """Return the radius (m) that one Gaussian component exceeds with `integrity_risk`."""
    return sigma * math.sqrt(chi2_gate(1, integrity_risk))
