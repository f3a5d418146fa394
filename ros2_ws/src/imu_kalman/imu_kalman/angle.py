# SPDX-License-Identifier: Apache-2.0
"""Roll and pitch by two two-state filters, yaw by integration: the paper's filter as a whole estimator.

Each sample's body rates become rates of the ZYX Euler angles at the present roll and pitch; roll and pitch
are corrected with the angles of the measured specific force. Roll and yaw do not exist at pitch ±90°: beyond
`gimbal_limit` roll is only integrated, and it starts anew from the accelerometer on return; yaw is unknown
from then on. Yaw has no measurement, so its variance grows with the gyro's bias and noise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from imu_kalman.params import TwoStateParams
from imu_kalman.samples import VALUES, Attitude, ImuSample, RollPitchYaw, SettledAttitude
from imu_kalman.two_state import ANGLE, AXIS, BIAS, P00, P01, P10, P11, correct, correct_published, predict
from kalman_core.event_time import NANOSECONDS, EventTimeBuffer
from kalman_core.health import Tally
from kalman_core.rotation import quat_from_euler, wrap

# Layout of the flat state.
_SEC, _NANOSEC, _STARTED, _IN_GIMBAL = 0, 1, 2, 3
_ROLL = 4
_PITCH = _ROLL + AXIS
_YAW = _PITCH + AXIS
_STATE = _YAW + AXIS

# Layout of the parameter vector.
(
    _Q_ANGLE,
    _Q_BIAS,
    _R,
    _BIAS_VAR,
    _GYRO_PSD,
    _GIMBAL,
    _MAX_GAP,
    _PUBLISHED,
    _ZERO_START,
    _ACC_VAR,
    _GYR_VAR,
) = range(11)

# Codes of `angle_step`.
_CORRECTED, _STARTED_NOW, _PREDICTED, _REACQUIRED, _WAITING = range(5)

# A wrapped angle of which nothing is known is uniform over the circle: variance pi²/3.
_UNKNOWN_ANGLE_VAR = math.pi**2 / 3.0


@njit(cache=True, nogil=True)
def accelerometer_angles(ax, ay, az):
    """Return (roll, pitch) [rad] of a specific force that is taken for gravity alone, any orientation."""
    return math.atan2(ay, az), math.atan2(-ax, math.sqrt(ay * ay + az * az))


@njit(cache=True, nogil=True)
def euler_rates(roll, pitch, gx, gy, gz, limit):
    """Return the rates (rad/s) of the ZYX angles for body rates; the tangent of pitch is held at `limit`."""
    held = min(max(pitch, -limit), limit)
    sr, cr = math.sin(roll), math.cos(roll)
    turn = sr * gy + cr * gz
    return gx + turn * math.tan(held), cr * gy - sr * gz, turn / math.cos(held)


@njit(cache=True, nogil=True)
def steepness(pitch, limit):
    """Return 1/cos(pitch), pitch (rad) held at `limit`: how much faster than the body yaw turns."""
    return 1.0 / math.cos(min(abs(pitch), limit))


@njit(cache=True, nogil=True)
def _start_axis(axis, angle, variance, bias_var):
    axis[ANGLE] = angle
    axis[P00] = variance
    axis[P01] = 0.0
    axis[P10] = 0.0
    axis[P11] = bias_var


@njit(cache=True, nogil=True)
def angle_step(state, par, sec, nanosec, gyr, acc, use_acc, out):
    """Take one sample: `gyr` (3,) rad/s, `acc` (3,) m/s² (ignored unless `use_acc`), at sec + nanosec.

    Updates `state` in place and fills `out` (VALUES,), unless it waits for a force to start from. Returns
    (code, NIS of roll, NIS of pitch).
    """
    roll = state[_ROLL : _ROLL + AXIS]
    pitch = state[_PITCH : _PITCH + AXIS]
    yaw = state[_YAW : _YAW + AXIS]
    # Exact in float64 for gaps below 2^53 ns, wherever the epoch is; correctly rounded to seconds.
    dt = ((sec - state[_SEC]) * 1e9 + (nanosec - state[_NANOSEC])) / 1e9
    code = _PREDICTED
    nis_roll = 0.0
    nis_pitch = 0.0
    measured_roll, measured_pitch = accelerometer_angles(acc[0], acc[1], acc[2])
    fresh = state[_STARTED] == 0.0
    if fresh or dt > par[_MAX_GAP]:
        if not use_acc:
            return _WAITING, 0.0, 0.0
        code = _STARTED_NOW if fresh else _REACQUIRED
        bias_var = par[_BIAS_VAR]
        if fresh and par[_ZERO_START] != 0.0:
            _start_axis(roll, 0.0, 0.0, 0.0)
            _start_axis(pitch, 0.0, 0.0, 0.0)
        else:
            _start_axis(roll, measured_roll, par[_R], bias_var)
            _start_axis(pitch, measured_pitch, par[_R], bias_var)
        _start_axis(yaw, yaw[ANGLE], _UNKNOWN_ANGLE_VAR, bias_var)
        if fresh:
            # Yaw is relative to the start by definition.
            yaw[P00] = 0.0
        state[_STARTED] = 1.0
    else:
        rate_r, rate_p, rate_y = euler_rates(roll[ANGLE], pitch[ANGLE], gyr[0], gyr[1], gyr[2], par[_GIMBAL])
        # Wrong roll and pitch turn the rates about the other axes into yaw.
        turn_var = (rate_r * rate_r + rate_p * rate_p) * dt * (roll[P00] + pitch[P00])
        predict(roll, rate_r, dt, par[_Q_ANGLE], par[_Q_BIAS])
        predict(pitch, rate_p, dt, par[_Q_ANGLE], par[_Q_BIAS])
        # Bias and noise of the gyro turn yaw as much faster as a rate about the tilted axis does.
        lean = steepness(pitch[ANGLE], par[_GIMBAL])
        predict(yaw, rate_y / lean, dt * lean, par[_GYRO_PSD] * lean + turn_var / lean, 0.0)
        roll[ANGLE] = wrap(roll[ANGLE])
        pitch[ANGLE] = wrap(pitch[ANGLE])
        yaw[ANGLE] = wrap(yaw[ANGLE])
        inside = abs(pitch[ANGLE]) > par[_GIMBAL]
        if use_acc:
            code = _CORRECTED
            inside = inside or abs(measured_pitch) > par[_GIMBAL]
            if par[_PUBLISHED] != 0.0:
                y, s = correct_published(pitch, measured_pitch, par[_R])
            else:
                y, s = correct(pitch, measured_pitch, par[_R])
            nis_pitch = y * y / s
            if not inside and state[_IN_GIMBAL] != 0.0:
                _start_axis(roll, measured_roll, par[_R], roll[P11])
                state[_IN_GIMBAL] = 0.0
            elif not inside:
                if par[_PUBLISHED] != 0.0:
                    y, s = correct_published(roll, measured_roll, par[_R])
                else:
                    y, s = correct(roll, measured_roll, par[_R])
                nis_roll = y * y / s
        if inside:
            state[_IN_GIMBAL] = 1.0
            roll[P00] = _UNKNOWN_ANGLE_VAR
            yaw[P00] = _UNKNOWN_ANGLE_VAR
        if yaw[P00] > _UNKNOWN_ANGLE_VAR:
            _start_axis(yaw, yaw[ANGLE], _UNKNOWN_ANGLE_VAR, par[_BIAS_VAR])
    state[_SEC] = sec
    state[_NANOSEC] = nanosec
    _fill(state, par, gyr, acc, use_acc, out)
    return code, nis_roll, nis_pitch


@njit(cache=True, nogil=True)
def _fill(state, par, gyr, acc, use_acc, out):
    """Write orientation, bias-corrected rate, specific force and their covariances into `out`.

    A force that is not usable is zero and marked as not measured (-1 as the first of its covariance).
    """
    roll, pitch, yaw = state[_ROLL + ANGLE], state[_PITCH + ANGLE], state[_YAW + ANGLE]
    out[0:4] = quat_from_euler(roll, pitch, yaw)
    sr, cr = math.sin(roll), math.cos(roll)
    sp, cp = math.sin(pitch), math.cos(pitch)
    sy, cy = math.sin(yaw), math.cos(yaw)
    bias_r, bias_p = state[_ROLL + BIAS], state[_PITCH + BIAS]
    out[4] = gyr[0] - bias_r
    out[5] = gyr[1] - cr * bias_p
    out[6] = gyr[2] + sr * bias_p
    out[7:10] = acc
    # Columns: what an error of roll, pitch and yaw is as a rotation vector in local-level axes.
    tilt = np.array(((cp * cy, -sy, 0.0), (cp * sy, cy, 0.0), (-sp, 0.0, 1.0)))
    lean = steepness(pitch, par[_GIMBAL])
    # Columns: body rates of unit Euler rates.
    body = np.array(((1.0, 0.0, -sp), (0.0, cr, sr * cp), (0.0, -sr, cr * cp)))
    for i in range(3):
        for j in range(3):
            angle_cov = 0.0
            # The bias of yaw is that of the body about the vertical axis.
            rate_cov = body[i, 2] * body[j, 2] * (lean * lean - 1.0) * state[_YAW + P11]
            for k in range(3):
                axis = _ROLL + k * AXIS
                angle_cov += tilt[i, k] * tilt[j, k] * state[axis + P00]
                rate_cov += body[i, k] * body[j, k] * state[axis + P11]
            same = 1.0 if i == j else 0.0
            out[10 + 3 * i + j] = angle_cov
            out[19 + 3 * i + j] = rate_cov + same * par[_GYR_VAR]
            out[28 + 3 * i + j] = same * par[_ACC_VAR] if use_acc else 0.0
    if not use_acc:
        out[28] = -1.0


def _pack(p: TwoStateParams) -> np.ndarray:
    return np.array(
        [
            p.angle_noise,
            p.bias_noise,
            p.measurement_variance,
            p.bias_sigma**2,
            p.gyro_noise**2,
            p.gimbal_limit,
            p.max_gap,
            p.variant == 'published',
            p.start == 'zero',
            p.accel_noise**2,
            # White noise of one sample at a nominal 100 Hz bandwidth.
            p.gyro_noise**2 * 100.0,
        ]
    )


@njit(cache=True, nogil=True)
def _run(state, par, sec, nanosec, gyr, acc, use_acc, use_gyr, orientation):
    out = np.zeros(VALUES)
    for i in range(gyr.shape[0]):
        if use_gyr[i]:
            angle_step(state, par, sec[i], nanosec[i], gyr[i], acc[i], use_acc[i], out)
        orientation[i] = out[:4]


def filter_angles(
    stamp: np.ndarray, gyr: np.ndarray, acc: np.ndarray, params: TwoStateParams | None = None
) -> np.ndarray:
    """Return the attitude (n, 4), wxyz, bit for bit what the streaming estimator says.

    `stamp` (n,) ns, increasing; `gyr` (n, 3) rad/s; `acc` (n, 3) m/s². Rows before the start are zero.
    """
    p = params if params is not None else TwoStateParams()
    sec, nanosec = np.divmod(np.asarray(stamp, dtype=np.int64), NANOSECONDS)
    force = np.sqrt((acc * acc).sum(axis=1))
    # Written so that NaN fails them.
    use_acc = (force >= p.min_force) & (force <= p.max_force)
    use_gyr = (np.abs(gyr) <= p.max_rate).all(axis=1)
    orientation = np.zeros((len(gyr), 4))
    _run(
        np.zeros(_STATE),
        _pack(p),
        sec.astype(float),
        nanosec.astype(float),
        gyr,
        acc,
        use_acc,
        use_gyr,
        orientation,
    )
    return orientation


class AngleFilter:
    """Streaming estimator of roll, pitch and yaw; see the module's docstring."""

    def __init__(self, params: TwoStateParams | None = None) -> None:
        p = params if params is not None else TwoStateParams()
        self.tally = Tally()
        self.state = np.zeros(_STATE)
        self._out = np.zeros(VALUES)
        self._buffer = EventTimeBuffer(self, ('imu/data_raw',), self.tally, int(p.lag_window * NANOSECONDS))
        self.set_params(p)
        self.warm_up()

    def set_params(self, params: TwoStateParams) -> None:
        """Take new parameters from the next sample on; the state is kept."""
        self.params = params
        self._par = _pack(params)
        self._settled = params.settled_output and params.lag_window > 0.0

    def warm_up(self) -> None:
        """Compile the kernel, so that the first sample is not late."""
        zero = np.zeros(3)
        angle_step(np.zeros(_STATE), self._par, 0.0, 0.0, zero, zero, False, self._out)

    def reset(self) -> None:
        """Return to the initial state and forget buffered samples."""
        self._buffer.clear()
        self.state[:] = 0.0

    def on_imu(self, sample: ImuSample) -> list[Any]:
        """Take one inertial sample; return the prompt estimates and, if asked for, the settled ones."""
        p = self.params
        if p.frame_id and sample.frame != p.frame_id:
            self.tally.reject('imu/data_raw', 'foreign frame')
            return []
        gx, gy, gz = sample.gyr
        # Written so that NaN fails it.
        if not (abs(gx) <= p.max_rate and abs(gy) <= p.max_rate and abs(gz) <= p.max_rate):
            self.tally.reject('imu/data_raw', 'angular velocity out of range')
            return []
        prompt, settled = self._buffer.feed(0, sample)
        out: list[Any] = [] if prompt is None else [prompt, _angles_of(self.state, prompt)]
        if self._settled:
            out.extend(SettledAttitude(*estimate) for estimate in settled)
        return out

    def apply(self, port: int, sample: ImuSample) -> Attitude | None:
        """Advance the state by one sample (called by the event-time buffer in order of stamps)."""
        p = self.params
        ax, ay, az = sample.acc
        force = math.hypot(ax, ay, az)
        use_acc = p.min_force <= force <= p.max_force
        acc = np.array(sample.acc) if use_acc else np.zeros(3)
        sec, nanosec = divmod(sample.stamp, NANOSECONDS)
        code, nis_roll, nis_pitch = angle_step(
            self.state, self._par, float(sec), float(nanosec), np.array(sample.gyr), acc, use_acc, self._out
        )
        if use_acc:
            self.tally.accept('imu/data_raw', sample.stamp, nis_roll + nis_pitch)
        else:
            self.tally.reject('imu/data_raw', 'specific force out of range')
        if code == _REACQUIRED and not self.tally.muted:
            self.tally.restart('angles from the accelerometer after a gap')
        if code == _WAITING:
            return None
        return Attitude(sample.stamp, sample.frame, self._out.copy())


def _angles_of(state: np.ndarray, estimate: Attitude) -> RollPitchYaw:
    angles = (float(state[_ROLL]), float(state[_PITCH]), float(state[_YAW]))
    return RollPitchYaw(estimate.stamp, estimate.frame, angles)
