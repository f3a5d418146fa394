# SPDX-License-Identifier: Apache-2.0
"""The attitude estimator: typed samples in, attitude with declared validity out.

Two models stand behind it: the inertial filter (`schedule: full`) and the paper's multi-rate vector filter
(`schedule: published`). Both run in event time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalman_core.event_time import NANOSECONDS, EventTimeBuffer
from kalman_core.health import Tally
from kalman_core.rotation import euler_from_quat, matrix_from_quat
from ship_inclinometer.inertial_model import InertialModel
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.published_model import PublishedModel
from ship_inclinometer.samples import (
    INVALID,
    Angles,
    Attitude,
    ImuSample,
    MagSample,
    SettledAttitude,
    SpeedSample,
    Validity,
    VelocitySample,
)
from ship_inclinometer.topics import GNSS, IMU, LOG, MAG

# Ranges of what the MPU6050 and HMC5883L can say at all; beyond is no measurement.
_LARGEST_RATE = math.radians(2000.0)
_LARGEST_FORCE = 16.0 * 9.80665
_LARGEST_FIELD = 1e-3
_LARGEST_SPEED = 100.0


class AttitudeEstimator:
    """Heel, pitch and heading from a 9-axis IMU, optionally with GNSS velocity or a speed log."""

    def __init__(self, params: AttitudeParams | None = None) -> None:
        self.params = params if params is not None else AttitudeParams()
        self.tally = Tally()
        full = self.params.schedule == 'full'
        self.model: Any = (InertialModel if full else PublishedModel)(self.params, self.tally)
        self._window = round(self.params.window * NANOSECONDS)
        self._delay = round(self.params.gnss_delay * NANOSECONDS)
        self._buffer = EventTimeBuffer(self.model, (IMU, MAG, GNSS, LOG), self.tally, self._window)
        self._angle_period = round(NANOSECONDS / self.params.angle_rate)
        self._force_matrix = np.reshape(self.params.accelerometer_matrix, (3, 3))
        self._field_matrix = np.reshape(self.params.magnetometer_matrix, (3, 3))
        plain = AttitudeParams()
        self._calibrated = any(
            getattr(self.params, name) != getattr(plain, name)
            for name in (
                'gyro_offset',
                'accelerometer_matrix',
                'accelerometer_offset',
                'magnetometer_matrix',
                'magnetometer_offset',
            )
        )
        self._forget_outputs()

    def _forget_outputs(self) -> None:
        self._next_angles = 0
        self._next_validity = 0
        self._said: tuple[int, str, bool] | None = None

    @property
    def state(self) -> np.ndarray:
        """The model's flat state."""
        return self.model.state

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self._buffer.reset()
        self._forget_outputs()

    def on_imu(self, sample: ImuSample) -> list[Any]:
        """Use an IMU sample; return the attitude, now and then angles and validity, and what has settled."""
        reason = self._imu_fault(sample)
        if reason:
            self.tally.reject(IMU, reason)
            return []
        if self._calibrated:
            gyro = np.subtract(sample.gyro, self.params.gyro_offset)
            force = self._force_matrix @ np.subtract(sample.force, self.params.accelerometer_offset)
            sample = sample._replace(gyro=tuple(gyro.tolist()), force=tuple(force.tolist()))
        restarts = self.tally.restart_count
        prompt, settled = self._buffer.feed(0, sample)
        if self.tally.restart_count != restarts:
            self._forget_outputs()
        out: list[Any] = []
        if prompt is not None:
            self._report(prompt, out)
        out.extend(self._settled(settled))
        return out

    def _settled(self, attitudes: list[Attitude]) -> list[Any]:
        if not self.params.settled_output:
            return []
        return [SettledAttitude(*a) for a in attitudes if a.validity != INVALID]

    def on_mag(self, sample: MagSample) -> list[Any]:
        """Use a magnetic field."""
        norm = math.sqrt(sum(v * v for v in sample.field))
        if not norm <= _LARGEST_FIELD:
            self.tally.reject(MAG, 'field out of range')
            return []
        if norm == 0.0:
            self.tally.reject(MAG, 'zero field')
            return []
        if self._calibrated:
            field = self._field_matrix @ np.subtract(sample.field, self.params.magnetometer_offset)
            sample = sample._replace(field=tuple(field.tolist()))
        return self._aid(1, MAG, sample)

    def on_gnss(self, sample: VelocitySample) -> list[Any]:
        """Use a GNSS velocity, valid `gnss_delay` before its stamp."""
        if not all(abs(v) <= _LARGEST_SPEED for v in sample.velocity):
            self.tally.reject(GNSS, 'velocity out of range')
            return []
        if not all(math.isfinite(v) for v in sample.variance):
            self.tally.reject(GNSS, 'variance not finite')
            return []
        return self._aid(2, GNSS, sample._replace(stamp=sample.stamp - self._delay))

    def on_log(self, sample: SpeedSample) -> list[Any]:
        """Use a speed through water."""
        if not abs(sample.speed) <= _LARGEST_SPEED:
            self.tally.reject(LOG, 'speed out of range')
            return []
        return self._aid(3, LOG, sample)

    def _aid(self, port: int, name: str, sample: Any) -> list[Any]:
        """Feed an aiding sample unless it is far from the IMU's time.

        Only the IMU may say that time has jumped: after a stall the queue of a slow topic holds older
        samples than the IMU's, many in a row.
        """
        newest = self._buffer.newest
        if newest is not None and sample.stamp < newest - self._window:
            self.tally.reject(name, 'older than the lag window')
        elif newest is not None and sample.stamp > newest + NANOSECONDS:
            self.tally.reject(name, 'ahead of the IMU')
        else:
            return self._settled(self._buffer.feed(port, sample)[1])
        return []

    def _imu_fault(self, sample: ImuSample) -> str:
        """Return why a sample is no measurement, or ''. NaN fails each comparison."""
        if self.params.frame_id and sample.frame != self.params.frame_id:
            return 'foreign frame'
        if not all(abs(v) <= _LARGEST_RATE for v in sample.gyro):
            return 'angular velocity out of range'
        if not all(abs(v) <= _LARGEST_FORCE for v in sample.force):
            return 'specific force out of range'
        if sample.force == (0.0, 0.0, 0.0):
            return 'zero specific force'
        return ''

    def _report(self, attitude: Attitude, out: list[Any]) -> None:
        validity, reason, heading_valid = self.model.validity()
        stamp = attitude.stamp
        if validity != INVALID:
            out.append(attitude)
        said = (validity, reason, heading_valid)
        due = not self._next_validity - NANOSECONDS <= stamp < self._next_validity
        new_angles = not self._next_angles - self._angle_period <= stamp < self._next_angles
        if not (due or new_angles or said != self._said):
            return
        angles = angles_of(attitude)
        if new_angles:
            self._next_angles = (stamp // self._angle_period + 1) * self._angle_period
            if validity != INVALID:
                out.append(angles)
        if due or said != self._said:
            self._said = said
            self._next_validity = stamp + NANOSECONDS
            out.append(Validity(stamp, validity, reason, heading_valid, angles.sigmas))

    def diagnostics(self) -> dict[str, Any]:
        """Return what the node reports once a second."""
        return self.model.diagnostics()


def angles_of(attitude: Attitude) -> Angles:
    """Return roll, pitch, yaw with their 1σ and rates."""
    roll, pitch, yaw = euler_from_quat(attitude.q)
    mat = matrix_from_quat(attitude.q)
    cosine = max(math.cos(pitch), 1e-6)
    # Level-frame error to Euler angles: ZYX angles turn about the axes (bow's level direction / cos, its
    # normal, up).
    cy, sy = math.cos(yaw), math.sin(yaw)
    tangent = math.tan(pitch) if cosine > 1e-6 else 0.0
    jacobian = np.array([[cy / cosine, sy / cosine, 0.0], [-sy, cy, 0.0], [cy * tangent, sy * tangent, 1.0]])
    sigmas = np.sqrt(np.maximum(np.diag(jacobian @ attitude.covariance @ jacobian.T), 0.0))
    rates = jacobian @ (mat @ attitude.rate)
    return Angles(
        attitude.stamp,
        attitude.frame,
        (roll, pitch, yaw),
        tuple(sigmas.tolist()),
        tuple(rates.tolist()),
        attitude.validity,
    )
