# SPDX-License-Identifier: Apache-2.0
"""What a sample may contain at all, before any filter judges it: bounds that no real sensor exceeds."""

from __future__ import annotations

import numpy as np

from ins_gps.layout import SLOTS_PER_SYSTEM
from ins_gps.samples import OBSERVATION_COLUMNS, ImuSample

_RATE_LIMIT = 100.0  # rad/s: twice the range of the fastest MEMS gyros
_FORCE_LIMIT = 5_000.0  # m/s²: 500 g
_STATE_LIMIT = 1e7  # m or m/s: beyond any position coordinate or speed near the Earth
_VARIANCE_LIMIT = 1e12
# Bounds of the columns of an observation row; the first three are its name.
_LOW = np.full(OBSERVATION_COLUMNS, -np.inf)
_HIGH = np.full(OBSERVATION_COLUMNS, np.inf)
_LOW[3], _HIGH[3] = 1e7, 1e8  # m: orbits below 20 Mm and beyond geostationary are not GNSS
_LOW[4], _HIGH[4] = -1e11, 1e11  # cycles
_LOW[5], _HIGH[5] = -1e6, 1e6  # Hz
_LOW[6], _HIGH[6] = 0.0, 100.0  # dB-Hz
_LOW[9:12], _HIGH[9:12] = -5e7, 5e7  # m
_LOW[12:15], _HIGH[12:15] = -2e4, 2e4  # m/s
_LOW[15], _HIGH[15] = -0.1, 0.1  # s
_LOW[16], _HIGH[16] = -1e-6, 1e-6  # s/s
_LOW[17:19], _HIGH[17:19] = -10.0, 1e3  # m


def imu_fault(sample: ImuSample) -> str:
    """Return why an IMU sample cannot be used, or an empty string."""
    if not (np.isfinite(sample.rate).all() and np.isfinite(sample.force).all()):
        return 'not finite'
    if np.abs(sample.rate).max() > _RATE_LIMIT or np.abs(sample.force).max() > _FORCE_LIMIT:
        return 'implausible value'
    if not sample.force.any():
        return 'zero specific force'
    return ''


def all_plausible(rate: np.ndarray, force: np.ndarray) -> bool:
    """Return whether `imu_fault` finds nothing in any row of rate (rad/s) and force (m/s²), both (N, 3)."""
    bounded = (np.abs(rate) <= _RATE_LIMIT).all() and (np.abs(force) <= _FORCE_LIMIT).all()
    return bool(bounded and force.any(axis=1).all())


def navigation_fault(values: np.ndarray, covariance: np.ndarray) -> str:
    """Return why a position or velocity with its covariance (3, 3) cannot be used, or an empty string."""
    if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
        return 'not finite'
    if np.abs(values).max() > _STATE_LIMIT or np.abs(covariance).max() > _VARIANCE_LIMIT:
        return 'implausible value'
    if np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0] <= 0.0:
        return 'covariance not positive definite'
    return ''


def plausible_rows(rows: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return observation rows with implausible cells as NaN, and whether there were any.

    A satellite whose position cannot be right loses its whole orbit. NaN itself means not measured.
    """
    wrong = (rows < _LOW) | (rows > _HIGH)
    radius = np.linalg.norm(np.nan_to_num(rows[:, 9:12], posinf=0.0, neginf=0.0), axis=1)
    lost = np.isfinite(rows[:, 9]) & ((radius < 2e7) | (radius > 5e7))
    wrong[lost, 9:17] = True
    if not wrong.any():
        return rows, False
    return np.where(wrong, np.nan, rows), True


def valid_satellites(rows: np.ndarray) -> np.ndarray:
    """Return which rows (m,) name a satellite that the filter has a slot for."""
    system, satellite = rows[:, 0], rows[:, 1]
    named = (system == 0.0) | (system == 1.0)
    whole = (satellite == np.floor(satellite)) & np.isin(rows[:, 2], (1.0, 2.0, 5.0, 7.0))
    if rows.shape[1] == 5:  # corrections carry no signal
        whole = satellite == np.floor(satellite)
    return named & whole & (satellite >= 1.0) & (satellite < SLOTS_PER_SYSTEM)
