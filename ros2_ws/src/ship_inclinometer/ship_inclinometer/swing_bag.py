# SPDX-License-Identifier: Apache-2.0
"""The ship swing from samples: steady legs on all headings, the GNSS course as the reference.

Course and heading are one only without current and leeway: swing in slack water and little wind. The tilt
comes from the estimator itself, so the legs may be steamed in waves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from kalman_core.rotation import euler_from_quat, matrix_from_quat, quat_from_euler
from ship_inclinometer.attitude_estimator import AttitudeEstimator
from ship_inclinometer.calibration import CalibrationError, swing
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.samples import VALID, Attitude, ImuSample, MagSample

# Slower than this (m/s) a course is noise; faster than this (rad/s) the ship drifts outward in a turn.
_SLOWEST, _LARGEST_TURN = 2.0, math.radians(0.3)
# The rate of turn is smoothed over this time (s): a ship yaws in waves on a steady course too.
_SMOOTHING = 10.0
# Headings are averaged over sectors of this many degrees, of at least so many courses.
_SECTOR, _FEWEST = 15.0, 10


def swing_of(samples: Iterable[Any], params: AttitudeParams) -> np.ndarray:
    """Return the deviation coefficients A … E [deg] of IMU, magnetometer and GNSS samples in order of time.

    `params` hold the calibration of the sensors, and the declination: left at zero, A contains it. Raises
    CalibrationError when headings are missing.
    """
    estimator = AttitudeEstimator(params)
    matrix = np.reshape(params.magnetometer_matrix, (3, 3))
    declination = math.radians(params.declination)
    attitude: Attitude | None = None
    field: np.ndarray | None = None
    turn = 0.0
    found: list[tuple[float, float]] = []
    for sample in samples:
        if isinstance(sample, ImuSample):
            newest = next((e for e in estimator.on_imu(sample) if isinstance(e, Attitude)), None)
            if newest is not None:
                since = (newest.stamp - attitude.stamp) * 1e-9 if attitude is not None else 0.0
                rate = float((matrix_from_quat(newest.q) @ newest.rate)[2])
                turn += min(since / _SMOOTHING, 1.0) * (rate - turn)
            attitude = newest
        elif isinstance(sample, MagSample):
            estimator.on_mag(sample)
            field = matrix @ np.subtract(sample.field, params.magnetometer_offset)
        else:
            estimator.on_gnss(sample)
            east, north, _ = sample.velocity
            if attitude is None or field is None or attitude.validity != VALID:
                continue
            if abs(turn) < _LARGEST_TURN and math.hypot(east, north) >= _SLOWEST:
                heading = _magnetic_heading(attitude.q, field)
                course = math.atan2(east, north) - declination
                found.append((heading, math.remainder(course - heading, 2.0 * math.pi)))
    return np.degrees(swing(*_sectors(np.reshape(found, (-1, 2)))))


def _magnetic_heading(q: np.ndarray, field: np.ndarray) -> float:
    """Return the heading [rad, clockwise from magnetic north] of a body field under a known tilt."""
    roll, pitch, _ = euler_from_quat(q)
    x, y, _ = matrix_from_quat(quat_from_euler(roll, pitch, 0.0)) @ field
    return math.atan2(y, x)


def _sectors(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean heading and mean deviation (M,) of each sector of headings that is well filled."""
    sector = np.floor(np.degrees(found[:, 0]) % 360.0 / _SECTOR)
    kept = [found[sector == s] for s in np.unique(sector) if np.count_nonzero(sector == s) >= _FEWEST]
    if not kept:
        raise CalibrationError(
            f'no steady course at {_SLOWEST:g} m/s or more with GNSS velocity and a valid attitude'
        )
    headings = [math.atan2(np.mean(np.sin(p[:, 0])), np.mean(np.cos(p[:, 0]))) for p in kept]
    return np.array(headings), np.array([np.mean(p[:, 1]) for p in kept])
