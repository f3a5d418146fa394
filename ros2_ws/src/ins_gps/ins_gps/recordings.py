# SPDX-License-Identifier: Apache-2.0
"""Public recordings in the form of samples: logger files of the IMU, tracks, RINEX with navigation files."""

from __future__ import annotations

import datetime
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ins_gps.observations import EpochBuilder
from ins_gps.rinex import read_navigation, read_observations
from ins_gps.samples import GnssEpoch

NANOSECONDS = 1_000_000_000
GRAVITY = 9.80665  # m/s² per g


class Track(NamedTuple):
    """A reference: stamps (k,) ns (GPS as Unix time), geodetic, velocity NED and sigmas, each (k, 3)."""

    stamps: np.ndarray
    geodetic: np.ndarray
    velocity: np.ndarray
    sigmas: np.ndarray


class ImuLog(NamedTuple):
    """An IMU: stamps (n,) ns, rate (n, 3) rad/s and force (n, 3) m/s², forward-right-down."""

    stamps: np.ndarray
    rate: np.ndarray
    force: np.ndarray


def gnss_epochs(observations: Path, navigation: tuple[Path, ...], bands=(1,), **options) -> list[GnssEpoch]:
    """Return the epochs of a RINEX file with satellite states from navigation files."""
    files = [read_navigation(path) for path in navigation]
    coefficients = next((f.klobuchar for f in files if math.isfinite(f.klobuchar.sum())), None)
    builder = EpochBuilder(np.vstack([f.ephemerides for f in files]), coefficients, **options)
    return [builder.build(raw) for raw in read_observations(observations, bands).epochs]


def read_track(path: Path) -> Track:
    """Read an RTKLIB .pos file with geodetic positions and velocities (GPST)."""
    stamps, values = [], []
    with path.open() as lines:
        for line in lines:
            if line.startswith('%') or not line.strip():
                continue
            words = line.split()
            date = datetime.datetime.strptime(words[0], '%Y/%m/%d').replace(tzinfo=datetime.UTC)
            hours, minutes, seconds = words[1].split(':')
            day = int(date.timestamp()) + 3600 * int(hours) + 60 * int(minutes)
            stamps.append(day * NANOSECONDS + round(float(seconds) * NANOSECONDS))
            values.append([float(w) for w in words[2:]])
    v = np.array([row[:19] + [math.nan] * max(0, 19 - len(row)) for row in values])
    geodetic = np.column_stack([np.radians(v[:, :2]), v[:, 2]])
    velocity = np.column_stack([v[:, 13], v[:, 14], -v[:, 15]])
    return Track(np.array(stamps), geodetic, velocity, v[:, 5:8])


def read_walk_imu(path: Path) -> ImuLog:
    """Read the logger of the recorded walk (t_s, g, rad/s); its stamps are GPS time as Unix seconds.

    The sensor is mounted with roll 180° and yaw −90° against forward-right-down.
    """
    data = np.loadtxt(path, delimiter=',', skiprows=1)
    stamps = np.round(data[:, 0] * 1e6).astype(np.int64) * 1000
    mat = mounting(math.pi, 0.0, -0.5 * math.pi)
    return ImuLog(stamps, data[:, 4:7] @ mat.T, GRAVITY * data[:, 1:4] @ mat.T)


def read_drive_imu(path: Path, start: int = 0) -> ImuLog:
    """Read the logger of the recorded drive (g, °/s, ms of the logger); `start` (ns) is its time zero.

    The sensor's z axis is up and its x axis points backwards (found by correlation with the track).
    """
    data = np.loadtxt(path, delimiter=',')
    stamps = np.round(data[:, 6] * 1e6).astype(np.int64) + start
    flip = np.array([-1.0, 1.0, -1.0])
    return ImuLog(stamps, np.radians(data[:, 3:6]) * flip, GRAVITY * data[:, :3] * flip)


def mounting(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the (3, 3) rotation from sensor to body of ZYX angles (rad)."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x
