# SPDX-License-Identifier: Apache-2.0
"""Typed samples and estimates of this package; stamps in ns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

VALID, DEGRADED, INVALID = 0, 1, 2
VALIDITY = ('valid', 'degraded', 'invalid')


class ImuSample(NamedTuple):
    """Body rate (rad/s) and specific force (m/s²), body axes."""

    stamp: int
    gyro: tuple[float, float, float]
    force: tuple[float, float, float]
    frame: str = ''


class MagSample(NamedTuple):
    """Magnetic field (T), body axes."""

    stamp: int
    field: tuple[float, float, float]


class VelocitySample(NamedTuple):
    """GNSS velocity of the antenna in ENU (m/s); variances (m²/s²), not positive: unknown."""

    stamp: int
    velocity: tuple[float, float, float]
    variance: tuple[float, float, float] = (0.0, 0.0, 0.0)


class SpeedSample(NamedTuple):
    """Speed through water along the bow (m/s)."""

    stamp: int
    speed: float


class Attitude(NamedTuple):
    """Attitude ``q_nb`` (wxyz, ENU), corrected body rate and specific force.

    covariance (3, 3) of the attitude error in the level frame [rad²]; `validity` as VALIDITY.
    """

    stamp: int
    frame: str
    q: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    covariance: np.ndarray
    validity: int


class SettledAttitude(NamedTuple):
    """What `Attitude` says once all within the window is in."""

    stamp: int
    frame: str
    q: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    covariance: np.ndarray
    validity: int


class Angles(NamedTuple):
    """Roll (+ starboard down), pitch (+ bow down), yaw from east, counter-clockwise [rad], 1σ of each.

    `level` as VALIDITY; `rates` roll, pitch, yaw rate [rad/s].
    """

    stamp: int
    frame: str
    angles: tuple[float, float, float]
    sigmas: tuple[float, float, float]
    rates: tuple[float, float, float]
    validity: int


class Validity(NamedTuple):
    """Validity with its reason, said on change and once a second."""

    stamp: int
    validity: int
    reason: str
    heading_valid: bool
    sigmas: tuple[float, float, float]
