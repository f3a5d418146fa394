# SPDX-License-Identifier: Apache-2.0
"""Gyro bias from a rest, refused when it was none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# The time is cut into this many parts whose means are compared: slow rolling changes them, noise does not.
_PARTS = 8


class Refused(NamedTuple):
    """No calibration, and why."""

    reason: str


class Calibration(NamedTuple):
    """Gyro bias (3,) and the variance of its components, both in rad/s."""

    bias: np.ndarray
    variance: float


class RestWindow:
    """The samples of the last `seconds`, and whether they were a rest."""

    def __init__(
        self, seconds: float, rate: float, still_gyro: float, still_accel: float, largest_bias: float
    ) -> None:
        self._size = max(_PARTS * 4, round(seconds * rate))
        self._seconds = self._size / rate
        self._still_gyro = still_gyro
        self._still_accel = still_accel
        self._largest_bias = largest_bias
        self._ring = np.zeros((self._size, 6))
        self._count = 0

    def clear(self) -> None:
        """Start anew: samples were lost, or settings changed."""
        self._count = 0

    def add(self, gyro: np.ndarray, accel: np.ndarray) -> None:
        """Take one sample (rad/s, m/s²) without any bias removed."""
        row = self._ring[self._count % self._size]
        row[:3] = gyro
        row[3:] = accel
        self._count += 1

    @property
    def fresh(self) -> bool:
        """True once per quarter of the window, when there is something new to judge."""
        return self._count >= self._size and self._count % (self._size // 4) == 0

    def calibrate(self) -> Calibration | Refused:
        """Return the bias if the window was a rest."""
        if self._count < self._size:
            return Refused(f'less than {self._seconds:g} s of samples yet')
        ordered = np.roll(self._ring, -(self._count % self._size), axis=0)
        parts = np.array([part.mean(axis=0) for part in np.array_split(ordered, _PARTS)])
        span = np.ptp(parts, axis=0)
        bias = parts[:, :3].mean(axis=0)
        degrees = np.degrees
        if span[:3].max() > self._still_gyro:
            return Refused(
                f'moving: the rate changed by {degrees(span[:3].max()):.2f} °/s '
                f'(allowed {degrees(self._still_gyro):.2f})'
            )
        if span[3:].max() > self._still_accel:
            return Refused(
                f'moving: the specific force changed by {span[3:].max():.3f} m/s² '
                f'(allowed {self._still_accel:.3f})'
            )
        if np.abs(bias).max() > self._largest_bias:
            return Refused(
                f'turning: {degrees(np.abs(bias).max()):.1f} °/s is more than a bias can be '
                f'({degrees(self._largest_bias):.1f})'
            )
        variance = float(parts[:, :3].var(axis=0, ddof=1).max()) / _PARTS
        return Calibration(bias, variance)
