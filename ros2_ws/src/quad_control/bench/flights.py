# SPDX-License-Identifier: Apache-2.0
"""Recorded flights: this package's filters and VQF, each with its own mounting and lag solved alike."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from quad_control.attitude_filter import AttitudeFilter
from quad_control.params import AttitudeParams
from quad_control.recordings import Alignment, Recording, alignment, read_phantom, upward
from quad_control.samples import Attitude, ImuSample

FLIGHTS = ('H1', 'H2', 'H3', 'H4', 'H5')


def folder() -> Path | None:
    """Return the folder of the flights, or None where the recordings are not there."""
    path = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'quad' / 'phantom4rtk'
    return path if path.is_dir() else None


def own(recording: Recording, name: str) -> Alignment:
    """Score one of this package's filters, causal, one sample at a time."""
    period = float(np.median(np.diff(recording.time)))
    attitude = AttitudeFilter(AttitudeParams(filter=name, period=period))
    quaternions = np.empty((len(recording.time), 4))
    for i, (t, gyro, force) in enumerate(zip(recording.time, recording.gyro, recording.force)):
        out = attitude.on_imu(ImuSample(10**9 + round(t * 1e9), tuple(gyro), tuple(force)))
        said = [e for e in out or [] if type(e) is Attitude]
        quaternions[i] = said[0].quaternion if said else quaternions[i - 1]
    return alignment(recording, upward(quaternions))


def vqf(recording: Recording) -> Alignment:
    """Score VQF's causal six-axis estimate with its defaults."""
    from vqf import VQF

    result = VQF(float(np.median(np.diff(recording.time)))).updateBatch(
        np.ascontiguousarray(recording.gyro), np.ascontiguousarray(recording.force)
    )
    return alignment(recording, upward(result['quat6D']))


def mean_over_flights(score, where: Path) -> tuple[float, float]:
    """Return the means over all flights of RMSE and mean absolute error (°)."""
    found = [score(read_phantom(where, name)) for name in FLIGHTS]
    return float(np.mean([a.rmse for a in found])), float(np.mean([a.mean_absolute for a in found]))
