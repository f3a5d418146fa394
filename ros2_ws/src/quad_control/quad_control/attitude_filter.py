# SPDX-License-Identifier: Apache-2.0
"""The attitude filter as an estimator: IMU samples in, attitude with honest covariance out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalman_core.event_time import NANOSECONDS, EventTimeBuffer
from kalman_core.health import Tally
from kalman_core.rotation import matrix_from_quat
from quad_control import attitude_published as published
from quad_control.attitude_model import SENSOR, AttitudeModel
from quad_control.params import AttitudeParams
from quad_control.samples import ImuSample, RawAngle, SettledAttitude

# Beyond any MEMS range (±2000 °/s, ±16 g), so a decoding fault or a broken wire.
_MAX_RATE, _MAX_FORCE = 40.0, 200.0
# A specific force below this has no direction to start from (m/s²).
_LEAST_FORCE = 0.5
# Samples in a row from another frame before it is taken for a changed set-up (1 s at 200 Hz).
_FRAME_CONFIRMATIONS = 200


class AttitudeFilter:
    """Estimator of the `attitude_filter` node.

    `on_imu` returns the raw accelerometer angles, the prompt attitude and whatever attitudes have settled.
    """

    def __init__(self, params: AttitudeParams | None = None) -> None:
        self.params = params or AttitudeParams()
        self.tally = Tally()
        self._model = AttitudeModel(self.params, self.tally)
        self._buffer = EventTimeBuffer(
            self._model, (SENSOR,), self.tally, window=round(self.params.window * NANOSECONDS)
        )
        self._frame: str | None = None
        self._foreign = 0

    @property
    def state(self) -> np.ndarray:
        """The flat state, for snapshots."""
        return self._model.state

    @property
    def bias(self) -> np.ndarray:
        """Gyro bias (3,), rad/s."""
        return self._model.b

    @property
    def calibrated(self) -> bool:
        """Whether a still window has given a gyro bias."""
        return self._model.calibrated

    @property
    def frozen(self) -> bool:
        """Whether the sensor repeats one sample."""
        return self._model.frozen

    def start(
        self, quaternion: Any, bias: Any = (0.0, 0.0, 0.0), tilt: float = 1e-3, bias_sigma: float = 1e-3
    ) -> None:
        """Begin with a known attitude (wxyz) and bias (rad/s) instead of a still window; σ in rad, rad/s."""
        self._buffer.reset()
        self._model.start(
            np.asarray(quaternion, dtype=float), np.asarray(bias, dtype=float), tilt, bias_sigma
        )

    def reset(self) -> None:
        """Forget everything, the bias too."""
        self._buffer.reset()
        self._frame = None
        self._foreign = 0

    def set_params(self, params: AttitudeParams) -> None:
        """Take new parameters and start anew: none of them is live."""
        self.params = self._model.params = params
        self.reset()

    def on_imu(self, sample: ImuSample) -> list | None:
        """Take one IMU sample; None when it was rejected or came late."""
        reason = _unusable(sample)
        if not reason and not self._model.started and math.hypot(*sample.force) < _LEAST_FORCE:
            reason = 'no specific force to start from'
        if reason:
            self.tally.reject(SENSOR, reason)
            return None
        if not self._own_frame(sample.frame):
            return None
        prompt, settled = self._buffer.feed(0, sample)
        if prompt is not None and not np.all(np.isfinite(self.state)):
            reason = 'state was not finite'
            self.tally.restart(reason)
            self._buffer.reset()
            return None
        out: list = []
        if prompt is not None:
            out.append(prompt)
            roll, pitch = published.accelerometer_angles(*sample.force)
            out.append(RawAngle(sample.stamp, roll, pitch, sample.frame))
        out.extend(SettledAttitude(*estimate) for estimate in settled)
        return out

    def _own_frame(self, frame: str) -> bool:
        """Whether the sample comes from the frame that the filter runs on; after 1 s it follows the other."""
        if self._frame is None or frame == self._frame:
            self._frame = frame
            self._foreign = 0
            return True
        self.tally.reject(SENSOR, f"frame '{frame}', expected '{self._frame}'")
        self._foreign += 1
        if self._foreign >= _FRAME_CONFIRMATIONS:
            self.tally.restart(f"frame is now '{frame}'")
            self.reset()
        return False

    def diagnostics(self) -> dict:
        """Return the filter's own values for the diagnostics."""
        m = self._model
        bias = [float(v) for v in m.b]
        sigma = math.sqrt(max(float(np.max(np.diag(m.P)[3:6])), 0.0))
        return {
            'calibrated': self.calibrated,
            'frozen': self.frozen,
            'standing': m.standing,
            'bias_x_rad_s': bias[0],
            'bias_y_rad_s': bias[1],
            'bias_z_rad_s': bias[2],
            'bias_sigma_rad_s': sigma,
            'tilt_sigma_rad': math.sqrt(max(float(m.P[0, 0]), float(m.P[1, 1]))),
        }


def _unusable(sample: ImuSample) -> str:
    values = (*sample.rate, *sample.force)
    if not all(map(math.isfinite, values)):
        return 'not finite'
    if max(map(abs, sample.rate)) > _MAX_RATE or max(map(abs, sample.force)) > _MAX_FORCE:
        return 'beyond the sensor range'
    if not any(sample.force):
        return 'zero specific force'
    return ''


def up_in_body(quaternion: Any) -> np.ndarray:
    """Return the upward direction (3,) in body axes of ``q_nb``: tilt without heading."""
    return matrix_from_quat(np.asarray(quaternion, dtype=float))[2].copy()


def tilt_error(estimate: Any, truth: Any) -> float:
    """Return the angle (rad) between the estimated and the true upward direction."""
    a, b = up_in_body(estimate), up_in_body(truth)
    return float(math.atan2(np.linalg.norm(np.cross(a, b)), a @ b))
