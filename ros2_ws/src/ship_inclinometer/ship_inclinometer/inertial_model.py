# SPDX-License-Identifier: Apache-2.0
"""The inertial filter behind `schedule: full`, driven in event time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalman_core.event_time import NANOSECONDS
from kalman_core.health import Tally
from ship_inclinometer import attitude_layout as k
from ship_inclinometer.attitude_aiding import gnss_step, log_step
from ship_inclinometer.attitude_kernels import begin, imu_step
from ship_inclinometer.attitude_magnetic import mag_step
from ship_inclinometer.attitude_model import settings
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.samples import (
    DEGRADED,
    INVALID,
    VALID,
    Attitude,
    ImuSample,
    MagSample,
    SpeedSample,
    VelocitySample,
)
from ship_inclinometer.topics import GNSS, IMU, LOG, MAG

# Chi-square at 1e-3 with 1 and 3 degrees of freedom.
GATE_1, GATE_3 = 10.83, 16.27
# A speed source this old (s) no longer helps a turn; a turn's tilt error is worked off this long after it.
_SPEED_AGE, _TURN_AFTER = 10.0, 60.0
_MAG_AGE = 5.0
_MAG_REASONS = {k.GATED: 'innovation', k.MAG_NORM: 'field norm', k.MAG_DIP: 'field dip'}


class InertialModel:
    """Owns the flat state of the kernels in `attitude_kernels`."""

    def __init__(self, params: AttitudeParams, tally: Tally) -> None:
        self._params = params
        self._tally = tally
        self._settings = settings(params)
        self._origin: int | None = None
        self._nis = np.zeros(2)
        self._gyro_variance = 2.0 * self._settings[k.C_GYRO_NOISE] ** 2
        self.state = np.zeros(k.SIZE)
        self._covariance = self.state[k.S_COV :].reshape(k.N, k.N)

    def reset(self) -> None:
        """Return to the empty state."""
        self.state[:] = 0.0
        self._origin = None

    def _time(self, stamp: int) -> float:
        if self._origin is None:
            self._origin = stamp
        return (stamp - self._origin) / NANOSECONDS

    def apply(self, port: int, sample: Any) -> Attitude | None:
        """Advance to the sample and use it; called by the event-time buffer."""
        if port == 0:
            return self._imu(sample)
        if self.state[k.S_PHASE] == k.PHASE_EMPTY:
            self._tally.reject((IMU, MAG, GNSS, LOG)[port], 'before the first IMU sample')
        elif port == 1:
            self._mag(sample)
        elif port == 2:
            self._gnss(sample)
        else:
            self._log(sample)
        return None

    def _imu(self, sample: ImuSample) -> Attitude:
        state, tally = self.state, self._tally
        t = self._time(sample.stamp)
        gyro, force = np.array(sample.gyro), np.array(sample.force)
        nis, gap = None, t - state[k.S_TIME]
        if state[k.S_PHASE] == k.PHASE_EMPTY:
            begin(state, self._settings, t, force)
        elif gap > self._params.stale_time:
            self._restart(t, force, f'no IMU sample for {gap:.2f} s')
        else:
            code = imu_step(state, self._settings, t, gyro, force, self._nis)
            if code != k.STEP_OK:
                reason = 'tilt against the mean specific force' if code == k.STEP_ASTRAY else 'not finite'
                self._restart(t, force, reason)
            elif self._nis[1] > 0.0:
                nis = float(self._nis[0])
        tally.accept(IMU, sample.stamp, nis)
        validity = self.validity()[0]
        bias = state[k.S_BA : k.S_BA + 3]
        return Attitude(
            sample.stamp,
            sample.frame,
            state[k.S_Q : k.S_Q + 4].copy(),
            gyro - state[k.S_BG : k.S_BG + 3],
            force - bias,
            self._covariance[:3, :3].copy(),
            validity,
        )

    def _restart(self, t: float, force: np.ndarray, reason: str) -> None:
        begin(self.state, self._settings, t, force)
        if not self._tally.muted:
            self._tally.restart(reason)

    def _mag(self, sample: MagSample) -> None:
        code, nis = mag_step(
            self.state, self._settings, self._time(sample.stamp), np.array(sample.field), GATE_1
        )
        if code == k.OK:
            self._tally.accept(MAG, sample.stamp, nis, GATE_1)
        elif code == k.MAG_RELEARNED:
            self._tally.reject(MAG, 'field learned anew after a lasting change')
        else:
            self._tally.reject(MAG, _MAG_REASONS[code])

    def _gnss(self, sample: VelocitySample) -> None:
        default = self._params.gnss_sigma**2
        variance = np.array([v if v > 0.0 else default for v in sample.variance])
        code, nis = gnss_step(
            self.state, self._settings, self._time(sample.stamp), np.array(sample.velocity), variance, GATE_3
        )
        if code == k.OK:
            self._tally.accept(GNSS, sample.stamp, nis, GATE_3)
        else:
            self._tally.reject(GNSS, 'innovation')

    def _log(self, sample: SpeedSample) -> None:
        code, nis = log_step(self.state, self._settings, self._time(sample.stamp), sample.speed, GATE_1)
        if code == k.OK:
            self._tally.accept(LOG, sample.stamp, nis, GATE_1)
        else:
            self._tally.reject(LOG, 'innovation')

    def validity(self) -> tuple[int, str, bool]:
        """Return (validity, reason, whether the heading may be trusted)."""
        state, cov = self.state, self._covariance
        if state[k.S_PHASE] != k.PHASE_RUN:
            return INVALID, 'aligning', False
        t = state[k.S_TIME]
        limit = math.radians(self._params.valid_sigma)
        heading = 'no magnetic heading' if state[k.S_MAG] < 0.0 else ''
        if not heading and t - state[k.S_MAG] > _MAG_AGE:
            heading = 'magnetic disturbance' if state[k.S_MAG_BAD] >= 0.0 else 'magnetometer silent'
        if max(cov[0, 0], cov[1, 1]) > limit * limit:
            return DEGRADED, 'tilt uncertain', not heading
        if t - state[k.S_TURN_END] < _TURN_AFTER and not self._speed_known(t):
            return DEGRADED, 'turn without speed', not heading
        if heading:
            return DEGRADED, heading, False
        return VALID, '', True

    def _speed_known(self, t: float) -> bool:
        newest = max(self.state[k.S_GNSS], self.state[k.S_LOG])
        return newest >= 0.0 and t - newest < _SPEED_AGE

    def diagnostics(self) -> dict[str, Any]:
        """Return validity and what was learned of sea and field."""
        state = self.state
        validity, reason, _ = self.validity()
        level = state[k.S_POWER] + state[k.S_POWER + 1]
        return {
            'level': (b'\x00', b'\x01', b'\x02')[validity],
            'message': reason or 'valid',
            'gyro_bias_deg_s': ' '.join(f'{math.degrees(b):.4f}' for b in state[k.S_BG : k.S_BG + 3]),
            'tilt_sigma_deg': math.degrees(
                math.sqrt(max(self._covariance[0, 0], self._covariance[1, 1], 0.0))
            ),
            'wave_displacement_m': math.sqrt(max(level, 0.0)),
            'turn_rate_deg_s': math.degrees(state[k.S_TURN]),
            'field_norm_uT': 1e6 * float(state[k.S_NORM]),
        }
