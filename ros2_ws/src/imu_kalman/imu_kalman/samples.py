# SPDX-License-Identifier: Apache-2.0
"""Typed samples and estimates of the attitude estimators: what codecs make and handlers take.

An estimate carries its numbers as one array (layout in the constants below), which costs one copy per
sample; the properties name the parts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Layout of `Attitude.values`: quaternion wxyz, angular velocity, specific force, then three row-major
# 3x3 covariances: orientation error (rotation vector, local-level axes), angular velocity, specific force.
ORIENTATION = slice(0, 4)
RATE = slice(4, 7)
FORCE = slice(7, 10)
ORIENTATION_COV = slice(10, 19)
RATE_COV = slice(19, 28)
FORCE_COV = slice(28, 37)
VALUES = 37


class ImuSample(NamedTuple):
    """One inertial sample in the body frame (x forward, y left, z up).

    `gyr`: angular velocity (rad/s); `acc`: specific force (m/s²), +g upwards at rest; `gyr_var`: variance of
    an axis of `gyr` as its sender tells it ((rad/s)²), 0 when it does not.
    """

    stamp: int
    gyr: tuple[float, float, float]
    acc: tuple[float, float, float]
    frame: str = ''
    gyr_var: float = 0.0


class MagSample(NamedTuple):
    """One magnetometer sample in the body frame (tesla)."""

    stamp: int
    field: tuple[float, float, float]
    frame: str = ''


class Attitude(NamedTuple):
    """Orientation, angular velocity and specific force with covariances; see `VALUES` for the layout."""

    stamp: int
    frame: str
    values: np.ndarray

    @property
    def orientation(self) -> np.ndarray:
        """Unit quaternion (4,), wxyz, body to local level (ENU)."""
        return self.values[ORIENTATION]

    @property
    def rate(self) -> np.ndarray:
        """Angular velocity (3,) in the body frame with the estimated bias removed (rad/s)."""
        return self.values[RATE]

    @property
    def orientation_covariance(self) -> np.ndarray:
        """Covariance (3, 3) of the attitude error as a rotation vector about local-level axes (rad²)."""
        return self.values[ORIENTATION_COV].reshape(3, 3)

    @property
    def rate_covariance(self) -> np.ndarray:
        """Covariance (3, 3) of `rate` ((rad/s)²)."""
        return self.values[RATE_COV].reshape(3, 3)


class SettledAttitude(Attitude):
    """An `Attitude` after everything within the lag window is in."""


class RollPitchYaw(NamedTuple):
    """Intrinsic ZYX Euler angles (rad)."""

    stamp: int
    frame: str
    angles: tuple[float, float, float]


class GyroBias(NamedTuple):
    """Estimated gyro bias (rad/s) in the body frame and its covariance (3, 3)."""

    stamp: int
    frame: str
    bias: tuple[float, float, float]
    covariance: np.ndarray
