# SPDX-License-Identifier: Apache-2.0
"""Whole recordings through the inertial filter's kernels, and their errors against truth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ship_inclinometer import attitude_layout as k
from ship_inclinometer.attitude_kernels import run
from ship_inclinometer.attitude_model import settings
from ship_inclinometer.inertial_model import GATE_1, GATE_3
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.simulation import Recording, rotation_matrices

_NONE, _NONE3 = np.empty(0), np.empty((0, 3))


class Run(NamedTuple):
    """rows (N, 14) as `attitude_kernels.run` fills them; nis: mean NIS by source, per degree of freedom."""

    rows: np.ndarray
    nis: dict[str, float]


class AttitudeErrors(NamedTuple):
    """angles (N, 3): roll, pitch, yaw error [deg]; NEES of tilt (2) and attitude (3); sigmas (N, 3) [deg]."""

    angles: np.ndarray
    nees_tilt: np.ndarray
    nees: np.ndarray
    sigmas: np.ndarray


def run_recording(recording: Recording, params: AttitudeParams, use_log: bool = False) -> Run:
    """Run the inertial filter over `recording`."""
    state = np.zeros(k.SIZE)
    rows = np.zeros((len(recording.truth.t), 14))
    nis = np.zeros((3, 2))
    run(
        state,
        settings(params),
        _stamped(recording.truth.t),
        recording.gyro,
        recording.accelerometer,
        _stamped(recording.magnetometer_t),
        recording.magnetometer,
        _stamped(recording.gnss_t - params.gnss_delay),
        recording.gnss_velocity,
        np.full(3, params.gnss_sigma**2),
        _stamped(recording.log_t) if use_log else _NONE,
        recording.log_speed if use_log else _NONE,
        np.array([GATE_1, GATE_3, GATE_1]),
        rows,
        nis,
    )
    names = ('position', 'magnetometer', 'gnss')
    return Run(rows, {n: total / count for n, (total, count) in zip(names, nis) if count})


def _stamped(t: np.ndarray) -> np.ndarray:
    """Return times [s] as whole nanoseconds make them: streaming and batch then agree to the last bit."""
    return np.round(t * 1e9) / 1e9


def attitude_errors(recording: Recording, rows: np.ndarray, every: int = 1) -> AttitudeErrors:
    """Return estimate minus truth of a run, at each `every`-th IMU sample."""
    rows, angles_true = rows[::every], recording.truth.angles[::every]
    estimate, covariance = _matrices(rows[:, :4]), np.zeros((len(rows), 3, 3))
    for column, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        covariance[:, i, j] = covariance[:, j, i] = rows[:, 4 + column]
    truth = rotation_matrices(angles_true)
    difference = truth @ np.swapaxes(estimate, 1, 2)
    vector = 0.5 * np.column_stack(
        [
            difference[:, 2, 1] - difference[:, 1, 2],
            difference[:, 0, 2] - difference[:, 2, 0],
            difference[:, 1, 0] - difference[:, 0, 1],
        ]
    )
    roll = np.arctan2(estimate[:, 2, 1], estimate[:, 2, 2])
    pitch = -np.arcsin(np.clip(estimate[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(estimate[:, 1, 0], estimate[:, 0, 0])
    angles = np.column_stack([roll, pitch, yaw]) - angles_true
    angles = np.degrees((angles + np.pi) % (2.0 * np.pi) - np.pi)
    tilt = np.einsum('ni,nij,nj->n', vector[:, :2], np.linalg.inv(covariance[:, :2, :2]), vector[:, :2])
    full = np.einsum('ni,nij,nj->n', vector, np.linalg.inv(covariance), vector)
    sigmas = np.degrees(np.sqrt(covariance[:, [0, 1, 2], [0, 1, 2]]))
    return AttitudeErrors(angles, tilt, full, sigmas)


def _matrices(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
