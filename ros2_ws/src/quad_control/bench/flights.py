# SPDX-License-Identifier: Apache-2.0
"""Recorded flights: this package's filters and VQF, each with its own mounting and lag solved alike."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bag_tools.align import LAG, MOUNTING, aligned, solve
from bag_tools.errors import at, euler_angles
from bag_tools.series import Series
from quad_control.attitude_filter import AttitudeFilter
from quad_control.params import AttitudeParams
from quad_control.recordings import Recording, read_phantom
from quad_control.samples import Attitude, ImuSample

FLIGHTS = ('H1', 'H2', 'H3', 'H4', 'H5')


def folder() -> Path | None:
    """Return the folder of the flights, or None where the recordings are not there."""
    path = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'quad' / 'phantom4rtk'
    return path if path.is_dir() else None


def own(recording: Recording, name: str) -> np.ndarray:
    """Score one of this package's filters, causal, one sample at a time."""
    period = float(np.median(np.diff(recording.time)))
    attitude = AttitudeFilter(AttitudeParams(filter=name, period=period))
    quaternions = np.empty((len(recording.time), 4))
    for i, (t, gyro, force) in enumerate(zip(recording.time, recording.gyro, recording.force)):
        out = attitude.on_imu(ImuSample(10**9 + round(t * 1e9), tuple(gyro), tuple(force)))
        said = [e for e in out or [] if type(e) is Attitude]
        quaternions[i] = said[0].quaternion if said else quaternions[i - 1]
    return roll_pitch_errors(recording, quaternions)


def vqf(recording: Recording) -> np.ndarray:
    """Score VQF's causal six-axis estimate with its defaults."""
    from vqf import VQF

    result = VQF(float(np.median(np.diff(recording.time)))).updateBatch(
        np.ascontiguousarray(recording.gyro), np.ascontiguousarray(recording.force)
    )
    return roll_pitch_errors(recording, result['quat6D'])


def roll_pitch_errors(recording: Recording, quaternions: np.ndarray) -> np.ndarray:
    """Return errors (m, 2) rad at the autopilot's samples, once mounting and lag are solved."""
    estimate = _series(recording.time, quaternions)
    truth = _series(recording.truth_time, recording.truth)
    solved = solve(estimate, truth, (MOUNTING, LAG), lambda stamps: np.ones(len(stamps), dtype=bool))
    seen, known = at(aligned(estimate, solved), truth.stamps)
    errors = (euler_angles(seen[known]) - euler_angles(truth.values[known]))[:, :2]
    return (errors + np.pi) % (2.0 * np.pi) - np.pi


def _series(time: np.ndarray, quaternions: np.ndarray) -> Series:
    stamps = np.round(time * 1e9).astype(np.int64)
    return Series('orientation', 'orientation', stamps, quaternions, ('w', 'x', 'y', 'z'), 'rad')


def mean_over_flights(errors: Callable[[Recording], np.ndarray], where: Path) -> tuple[float, float]:
    """Return RMSE and mean absolute error (°), means over roll and pitch and over all flights."""
    found = [np.degrees(errors(read_phantom(where, name))) for name in FLIGHTS]
    rmse = np.mean([np.sqrt(np.mean(e**2, axis=0)) for e in found])
    return float(rmse), float(np.mean([np.abs(e).mean() for e in found]))
