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
    x forward, y left, z up. Mounting and lag between both are not known: `bag_tools.align` solves them.
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
