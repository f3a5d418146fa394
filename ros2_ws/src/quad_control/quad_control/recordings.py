# SPDX-License-Identifier: Apache-2.0
"""Readers of public recordings into arrays: Phantom 4 RTK flights with an IMU on board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kalman_core.rotation import quat_from_euler

_IMU_COLUMNS, _TRUTH_COLUMNS = 10, 10


class RecordingError(ValueError):
    """A recording is missing or malformed; the message names the file and what was expected."""


@dataclass(frozen=True)
class Recording:
    """IMU on its own clock and axes, and the autopilot's attitude on its clock.

    time (n,) s, gyro (n, 3) rad/s, force (n, 3) m/s²; truth_time (m,) s, truth (m, 4) ``q_nb`` wxyz, ENU and
    x forward, y left, z up. Mounting and lag between both are not known: see `alignment`.
    """

    time: np.ndarray
    gyro: np.ndarray
    force: np.ndarray
    truth_time: np.ndarray
    truth: np.ndarray


def read_phantom(folder: Path, name: str) -> Recording:
    """Read flight `name` (H1…H5) of the Phantom 4 RTK set. Raises RecordingError."""
    imu = _table(folder / f'{name}_IMU_1.csv', _IMU_COLUMNS)
    truth = _table(folder / f'{name}_GT.csv', _TRUTH_COLUMNS)
    # GT: heading clockwise from north, pitch up and roll right positive; body axes here are x forward, y
    # left, z up, so pitch and heading change their sign, and heading 0 is north = yaw 90°.
    heading, pitch, roll = (np.radians(truth[:, column]) for column in (3, 4, 5))
    quaternions = np.array([quat_from_euler(r, -p, np.pi / 2 - h) for r, p, h in zip(roll, pitch, heading)])
    return Recording(imu[:, 0], np.radians(imu[:, 7:10]), imu[:, 4:7].copy(), truth[:, 0], quaternions)


def _table(path: Path, columns: int) -> np.ndarray:
    if not path.is_file():
        raise RecordingError(f'{path}: no such file, expected a CSV of {columns} columns')
    try:
        table = np.loadtxt(path, delimiter=',', skiprows=1, ndmin=2)
    except ValueError as error:
        raise RecordingError(f'{path}: {error}') from None
    if table.shape[1] != columns or len(table) < 2:
        raise RecordingError(f'{path}: table of {table.shape}, expected rows of {columns}')
    return table


@dataclass(frozen=True)
class Alignment:
    """What mounting and lag leave: rotation sensor→body (3, 3), lag (s), roll and pitch errors (m, 2) rad."""

    mounting: np.ndarray
    lag: float
    errors: np.ndarray

    @property
    def rmse(self) -> float:
        """Mean of roll's and pitch's RMS error (°)."""
        return float(np.degrees(np.sqrt(np.mean(self.errors**2, axis=0)).mean()))

    @property
    def mean_absolute(self) -> float:
        """Mean of roll's and pitch's mean absolute error (°)."""
        return float(np.degrees(np.abs(self.errors).mean()))


def alignment(recording: Recording, up: np.ndarray, lags: np.ndarray | None = None) -> Alignment:
    """Solve mounting and lag between estimated upward directions `up` (n, 3), sensor axes, and the truth.

    For each lag (s, default 0…0.8 in steps of 10 ms: IMU ahead of the autopilot) the mounting is the
    rotation that best turns one set of directions into the other (Wahba's problem by singular values);
    heading plays no part. The lag with the smallest error is taken.
    """
    truth = np.column_stack([_up_row(recording.truth, i) for i in range(3)])
    best: Alignment | None = None
    for lag in np.arange(0.0, 0.81, 0.01) if lags is None else lags:
        at = recording.truth_time + lag
        inside = (at > recording.time[0]) & (at < recording.time[-1])
        seen = np.column_stack([np.interp(at[inside], recording.time, up[:, i]) for i in range(3)])
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        u, _, vt = np.linalg.svd(truth[inside].T @ seen)
        mounting = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        body = seen @ mounting.T
        errors = _roll_pitch(body) - _roll_pitch(truth[inside])
        errors = (errors + np.pi) % (2.0 * np.pi) - np.pi
        found = Alignment(mounting, float(lag), errors)
        if best is None or found.rmse < best.rmse:
            best = found
    assert best is not None
    return best


def upward(quaternions: np.ndarray) -> np.ndarray:
    """Return the upward direction in body axes (n, 3) of attitudes ``q_nb`` (n, 4)."""
    return np.column_stack([_up_row(quaternions, i) for i in range(3)])


def _up_row(q: np.ndarray, i: int) -> np.ndarray:
    w, x, y, z = q.T
    return (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))[i]


def _roll_pitch(up: np.ndarray) -> np.ndarray:
    return np.column_stack((np.arctan2(up[:, 1], up[:, 2]), np.arcsin(np.clip(-up[:, 0], -1.0, 1.0))))
