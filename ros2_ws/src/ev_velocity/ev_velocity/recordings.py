# SPDX-License-Identifier: Apache-2.0
"""Reads the recorded drives that the package is measured on: columns to arrays, nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ev_velocity.can_frames import Acceleration, CanDecoder, Gear, Wheels, load_dbc, replay
from ev_velocity.can_profiles import PROFILES


class RecordingError(Exception):
    """A recording cannot be used; the text says which file, what was wrong and what was expected."""


class Kingston(NamedTuple):
    """A downtown drive: times in s and values of each sensor, and the reference speed."""

    force: tuple[np.ndarray, np.ndarray]  # along the car, m/s²
    gps: tuple[np.ndarray, np.ndarray]  # m/s
    obd: tuple[np.ndarray, np.ndarray]  # m/s
    truth: tuple[np.ndarray, np.ndarray]  # m/s


def columns(path: Path, *names: str) -> tuple[np.ndarray, ...]:
    """Return the named columns of a CSV file with a header; raise RecordingError naming what is missing."""
    try:
        table = np.genfromtxt(path, delimiter=',', names=True)
    except (OSError, ValueError) as error:
        raise RecordingError(f'{path}: {error}') from None
    present = table.dtype.names or ()
    for name in names:
        if name not in present:
            raise RecordingError(f"{path}: no column '{name}'; it has: {', '.join(present)}")
        if not np.all(np.isfinite(table[name])):
            raise RecordingError(f"{path}: column '{name}' has gaps or text, expected numbers")
    return tuple(np.atleast_1d(table[name]) for name in names)


def read_kingston(folder: Path) -> Kingston:
    """Read the four files of the drive; raises RecordingError."""
    return Kingston(
        *(
            columns(folder / file, 't_s', name)
            for file, name in (
                ('imu.csv', 'f_fwd_y'),
                ('gps.csv', 'speed_mps'),
                ('obd.csv', 'speed_mps'),
                ('reference.csv', 'speed_mps'),
            )
        )  # type: ignore[arg-type]
    )


def read_obd(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time (s), reference speed and OBD speed (m/s) of an `obd_kingston` file."""
    return columns(path, 'gps_s', 'ref_mps', 'obd_mps')  # type: ignore[return-value]


class CanDrive(NamedTuple):
    """What a CAN log says of the motion: times in s from its first frame."""

    force: tuple[np.ndarray, np.ndarray]  # m/s², empty where the car tells none
    wheels: tuple[np.ndarray, np.ndarray]  # (n,), (n, wheels) m/s
    gear: tuple[np.ndarray, np.ndarray]  # 1, −1 or 0
    frames: int
    rejected: int
    duration: float  # s


def read_can(log: Path, dbc: Path, profile: str) -> CanDrive:
    """Decode a CAN log with a DBC and the profile of that name; raises CanError."""
    decoder = CanDecoder(load_dbc(str(dbc)), PROFILES[profile])
    readings, frames, start, stamp = [], 0, None, 0
    for frame in replay(str(log)):
        start = frame[0] if start is None else start
        stamp = frame[0]
        frames += 1
        readings += decoder.on_frame(*frame)
    origin = start or 0
    wheels = [r for r in readings if isinstance(r, Wheels)]
    force = [r for r in readings if isinstance(r, Acceleration)]
    gear = [r for r in readings if isinstance(r, Gear)]
    return CanDrive(
        (_times(force, origin), np.array([r.acceleration for r in force])),
        (_times(wheels, origin), np.array([r.speeds for r in wheels])),
        (_times(gear, origin), np.array([r.direction for r in gear])),
        frames,
        sum(health.rejected.total() for health in decoder.health.values()),
        (stamp - origin) * 1e-9,
    )


def _times(readings: list, origin: int) -> np.ndarray:
    return np.array([reading.stamp - origin for reading in readings]) * 1e-9
