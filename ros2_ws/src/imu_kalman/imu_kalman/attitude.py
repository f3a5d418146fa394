# SPDX-License-Identifier: Apache-2.0
"""The attitude filter as a streaming estimator; its maths stands in `attitude_kernel`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from imu_kalman import attitude_layout as layout
from imu_kalman.attitude_faults import hidden_force, hidden_rate, unseen_time
from imu_kalman.attitude_kernel import attitude_cov, carried, follow_variance, inertial_step, magnetic_step
from imu_kalman.params import AttitudeParams
from imu_kalman.samples import VALUES, Attitude, GyroBias, ImuSample, MagSample, SettledAttitude
from kalman_core.event_time import NANOSECONDS, EventTimeBuffer
from kalman_core.health import Tally

_IMU, _MAG = 'imu/data_raw', 'imu/mag'
_REFUSED = {
    layout.WAITING: 'no direction to start from',
    layout.FAILED: 'numerics failed',
    layout.HELD: 'wild jump',
}
_RESTARTS = {
    layout.RESTARTED: 'attitude from one sample after a gap',
    layout.REALIGNING: 'attitude contradicted gravity',
    layout.LOST: 'roll and pitch lost while the rate was not measured',
}
_SCRATCH = (layout.WORK, layout.N, layout.N)


@njit(cache=True, nogil=True)
def stream_step(state, par, work, out, sec, nanosec, gyr_var, gx, gy, gz, ax, ay, az):
    """Take one inertial sample; write the estimate into `out` (VALUES,). Returns the code of `inertial_step`.

    Rate and force are the readings that were believed; one that was not measured is the last, less certain.
    """
    follow_variance(state, par, gyr_var)
    code = inertial_step(state, par, work, sec, nanosec, gx, gy, gz, ax, ay, az)
    carried(state, par, out)
    period = max(state[layout.PERIOD], 1e-3)
    deaf = unseen_time(state, layout.PUSH, 3)
    for i in range(3):
        out[4 + i] = state[layout.LAST_GYR + i] - state[layout.BIAS + i]
        out[7 + i] = state[layout.LAST_ACC + i]
        for j in range(3):
            k = 3 * i + j
            out[10 + k] = attitude_cov(state, par, i, j)
            out[19 + k] = state[layout.COV + layout.N * (3 + i) + 3 + j]
        blind = unseen_time(state, layout.JUMP, i)
        out[19 + 4 * i] += par[layout.GYRO_PSD] / period
        out[28 + 4 * i] = par[layout.ACC_PSD] / period
        if blind > 0.0:
            out[19 + 4 * i] += hidden_rate(state, par, blind)
        if deaf > 0.0:
            out[28 + 4 * i] += hidden_force(state, par, deaf)
    return code


class AttitudeFilter:
    """Streaming estimator of attitude and gyro bias from imu/data_raw and, if present, imu/mag."""

    def __init__(self, params: AttitudeParams | None = None) -> None:
        p = params if params is not None else AttitudeParams()
        self.tally = Tally()
        self.state = np.zeros(layout.STATE)
        self._work = np.zeros(_SCRATCH)
        self._out = np.zeros(VALUES)
        self._buffer = EventTimeBuffer(self, (_IMU, _MAG), self.tally, int(p.lag_window * NANOSECONDS))
        self._bias_due = 0
        self.set_params(p)
        self.warm_up()

    def set_params(self, params: AttitudeParams) -> None:
        """Take new parameters from the next sample on; the state is kept."""
        self.params = params
        self._par = layout.pack(params)
        self._settled = params.settled_output and params.lag_window > 0.0
        self._bias_period = int(params.bias_period * NANOSECONDS)

    def warm_up(self) -> None:
        """Compile the kernels, so that the first sample is not late."""
        state = np.zeros(layout.STATE)
        stream_step(state, self._par, self._work, self._out, 0.0, 0.0, *([0.0] * 7))
        magnetic_step(state, self._par, 0.0, 0.0, 0.0, 0.0, 0.0)

    def reset(self) -> None:
        """Return to the initial state and forget buffered samples."""
        self._buffer.clear()
        self.state[:] = 0.0
        self._bias_due = 0

    def on_imu(self, sample: ImuSample) -> list[Any]:
        """Take one inertial sample; return the prompt estimate, the bias when due, and settled estimates."""
        p = self.params
        limit = p.max_rate
        gx, gy, gz = sample.gyr
        ax, ay, az = sample.acc
        if p.frame_id and sample.frame != p.frame_id:
            self.tally.reject(_IMU, 'foreign frame')
            return []
        # Written so that NaN fails them.
        if not (abs(gx) <= limit and abs(gy) <= limit and abs(gz) <= limit):
            self.tally.reject(_IMU, 'angular velocity out of range')
            return []
        limit = p.max_force
        if not (abs(ax) <= limit and abs(ay) <= limit and abs(az) <= limit):
            self.tally.reject(_IMU, 'specific force out of range')
            return []
        if ax == 0.0 and ay == 0.0 and az == 0.0:  # a dead sensor: a living one has noise
            self.tally.reject(_IMU, 'zero specific force')
            return []
        prompt, settled = self._buffer.feed(0, sample)
        out: list[Any] = []
        if prompt is not None:
            out.append(prompt)
            if not self._bias_due <= sample.stamp < self._bias_due + self._bias_period:
                self._bias_due = sample.stamp
                out.append(self.gyro_bias(sample))
        if self._settled:
            out.extend(SettledAttitude(*estimate) for estimate in settled)
        return out

    def on_mag(self, sample: MagSample) -> list[Any]:
        """Take one field sample; it corrects heading at the end of its block. Returns settled estimates."""
        p = self.params
        mx, my, mz = sample.field
        if not p.use_magnetometer:
            return []
        if p.frame_id and sample.frame != p.frame_id:
            self.tally.reject(_MAG, 'foreign frame')
        elif not (abs(mx) <= p.max_field and abs(my) <= p.max_field and abs(mz) <= p.max_field):
            self.tally.reject(_MAG, 'field out of range')
        elif max(abs(mx), abs(my), abs(mz)) <= layout.MIN_FIELD:
            self.tally.reject(_MAG, 'zero field')
        else:
            _, settled = self._buffer.feed(1, sample)
            if self._settled:
                return [SettledAttitude(*estimate) for estimate in settled]
        return []

    def apply(self, port: int, sample: Any) -> Attitude | None:
        """Advance the state by one sample (called by the event-time buffer in order of stamps)."""
        sec, nanosec = divmod(sample.stamp, NANOSECONDS)
        state = self.state
        if port == 1:
            magnetic_step(state, self._par, float(sec), float(nanosec), *sample.field)
            if state[layout.MAG_STATUS] == layout.MAG_DISTURBED:
                self.tally.reject(_MAG, 'disturbed field')
            else:
                self.tally.accept(_MAG, sample.stamp, float(state[layout.MAG_NIS]))
            return None
        code = stream_step(
            state,
            self._par,
            self._work,
            self._out,
            float(sec),
            float(nanosec),
            sample.gyr_var,
            *sample.gyr,
            *sample.acc,
        )
        tally = self.tally
        if code == layout.OK:
            tally.accept(_IMU, sample.stamp, float(state[layout.MOTION_NIS]))
        elif code in _REFUSED:
            tally.reject(_IMU, _REFUSED[code])
            if code != layout.HELD:
                return None
        else:
            tally.accept(_IMU, sample.stamp)
            if code in _RESTARTS and not tally.muted:
                tally.restart(_RESTARTS[code])
        return Attitude(sample.stamp, sample.frame, self._out.copy())

    def gyro_bias(self, sample: ImuSample) -> GyroBias:
        """Return the present bias estimate with its covariance."""
        state = self.state
        cov = state[layout.COV :].reshape(layout.N, layout.N)[3:6, 3:6].copy()
        bias = state[layout.BIAS : layout.BIAS + 3].tolist()
        return GyroBias(sample.stamp, sample.frame, tuple(bias), cov)
