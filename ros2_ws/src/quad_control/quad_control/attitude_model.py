# SPDX-License-Identifier: Apache-2.0
"""The attitude filters on one flat state: start, still windows, standing, and the chosen filter's step."""

from __future__ import annotations

import math

import numpy as np

from kalman_core.event_time import NANOSECONDS
from kalman_core.health import Tally
from kalman_core.rotation import (
    euler_from_quat,
    quat_from_euler,
    quat_from_rotvec,
    quat_multiply,
    rotvec_from_quat,
)
from quad_control import attitude_driven as driven
from quad_control import attitude_published as published
from quad_control import stillness
from quad_control.params import GRAVITY, AttitudeParams
from quad_control.samples import Attitude, ImuSample

SENSOR = 'imu/data_raw'
# The tilt of a start is settled over this time (s): ten samples at 200 Hz tell vibration from rest.
_SETTLING_TIME = 0.05
# Steps longer than this (s) hide motion: the means of both ends are used, and the variances of tilt and
# velocity grow by (this rate (rad/s), this force (m/s²) × excess)². When a craft tips by 10° the means are
# at most 0.64 rad/s wrong, and 1.3 m/s² RMS.
_GAP, _HIDDEN_RATE, _HIDDEN_FORCE = 0.05, 1.0, 2.0
# Specific force (m/s²) below which its direction is noise.
_LEAST_FORCE = 0.1
# A longer gap starts the tilt anew from the accelerometer (bias and heading are kept).
_LONG_GAP = 1.0
# Variance of a heading that nothing is known of, any direction being as likely (rad²).
_ANY_HEADING = math.pi**2 / 3.0
# A frozen gyro says nothing: its rate error is that of a craft that turns anyhow within ±500 °/s.
_FROZEN_VARIANCE = (math.radians(500.0) ** 2) / 3.0
# chi-square, 2 degrees of freedom, probability 10⁻³: shown in diagnostics, nothing is rejected by it.
_NIS_GATE = 13.8

# Flat state: everything that roll-back restores.
_SEC, _NANO, _STARTED, _CALIBRATED, _FROZEN = 0, 1, 2, 3, 4
_LAST = slice(5, 11)
_STILL = slice(11, 25)
_Q = slice(25, 29)
_B = slice(29, 32)
_V = slice(32, 35)
_P = slice(35, 116)
_ROLL_X, _PITCH_X = slice(116, 118), slice(118, 120)
_ROLL_P, _PITCH_P = slice(120, 124), slice(124, 128)
_YAW, _STANDING, _SETTLING = 128, 129, 130
_REFERENCE = slice(131, 134)
_SIZE = 134


class AttitudeModel:
    """The filter proper; `EventTimeBuffer` rolls its `state` back."""

    def __init__(self, params: AttitudeParams, tally: Tally) -> None:
        self.params = params
        self._tally = tally
        self.state = np.zeros(_SIZE)
        s = self.state
        self.still, self.q, self.b, self.v = s[_STILL], s[_Q], s[_B], s[_V]
        self.P = s[_P].reshape(9, 9)
        self.axes = (
            (s[_ROLL_X], s[_ROLL_P].reshape(2, 2)),
            (s[_PITCH_X], s[_PITCH_P].reshape(2, 2)),
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything, the bias too."""
        p = self.params
        s = self.state
        s[:] = 0.0
        self.q[0] = 1.0
        self.P[:] = np.diag([p.tilt_prior**2] * 3 + [p.bias_prior**2] * 3 + [p.velocity_prior**2] * 3)
        self.P[2, 2] = 1e-6  # heading is a convention until a reference comes: it starts at zero
        for _, covariance in self.axes:
            covariance[:] = np.diag([published.ANGLE_PRIOR, published.RATE_PRIOR])

    def start(self, quaternion: np.ndarray, bias: np.ndarray, tilt: float, bias_sigma: float) -> None:
        """Begin with a known attitude (4,), gyro bias (3,) rad/s and their σ (rad, rad/s)."""
        s = self.state
        s[_STARTED] = s[_CALIBRATED] = 1.0
        s[_SETTLING] = 0.0
        self.q[:] = quaternion
        self.b[:] = bias
        self.v[:] = 0.0
        self.P[:] = np.diag([tilt**2] * 3 + [bias_sigma**2] * 3 + [self.params.velocity_prior**2 * 1e-2] * 3)
        roll, pitch, yaw = euler_from_quat(self.q)
        self.axes[0][0][:] = roll, 0.0
        self.axes[1][0][:] = pitch, 0.0
        s[_YAW] = yaw

    def apply(self, port: int, sample: ImuSample) -> Attitude:
        """Take one sample; see `EventTimeBuffer`."""
        p = self.params
        s = self.state
        gyro = np.array(sample.rate)
        force = np.array(sample.force) - np.array(p.accelerometer_offset)
        second, nano = divmod(sample.stamp, NANOSECONDS)
        dt = (second - s[_SEC]) + (nano - s[_NANO]) * 1e-9
        first = s[_SEC] == 0.0 and s[_NANO] == 0.0
        turned, pushed = gyro, force
        if first:
            dt = p.period
        if not s[_STARTED]:
            self._level(force)
        elif dt > _LONG_GAP:
            self._turn(0.5 * (gyro[2] + s[_LAST][2]) - self.b[2], dt)
            self._start_anew(force)
            dt = p.period
        elif dt > _GAP:
            turned, pushed = 0.5 * (gyro + s[_LAST][:3]), 0.5 * (force + s[_LAST][3:])
            for i in range(3):
                self.P[i, i] += (_HIDDEN_RATE * (dt - _GAP)) ** 2
                self.P[6 + i, 6 + i] += (_HIDDEN_FORCE * (dt - _GAP)) ** 2
            stillness.clear(self.still)
        s[_SEC], s[_NANO] = second, nano
        last = s[_LAST]
        same = bool(np.array_equal(last[:3], gyro) and np.array_equal(last[3:], force))
        s[_FROZEN] = s[_FROZEN] + 1.0 if same else 0.0
        last[:3] = gyro
        last[3:] = force

        self._calibrate(gyro, force, dt)
        self._stand(gyro, force)
        if s[_SETTLING] > 0.0:
            s[_SETTLING] -= dt
            self._settle()
            nis = 0.0
        else:
            nis = self._driven_step(turned, pushed, force, dt)
        if p.filter != 'gyro_driven':
            nis = self._published_step(turned, force, dt)
        self._tally.accept(SENSOR, sample.stamp, nis, _NIS_GATE)
        return self._estimate(sample)

    def _level(self, force: np.ndarray) -> None:
        self._tilt(force, 0.0)
        roll, pitch = published.accelerometer_angles(force[0], force[1], force[2])
        self.axes[0][0][:] = roll, 0.0
        self.axes[1][0][:] = pitch, 0.0
        self.state[_STARTED] = 1.0
        self.state[_SETTLING] = _SETTLING_TIME
        self.state[_STANDING] = 1.0  # until it moves: the first sample that does not fit ends it
        self.state[_REFERENCE] = force

    def _turn(self, rate: float, gap: float) -> None:
        """Carry the heading over a `gap` (s) in which only its mean `rate` (rad/s) can be guessed."""
        turn = quat_from_rotvec(np.array([0.0, 0.0, rate * gap]))
        self.q[:] = quat_multiply(turn, self.q)
        self.state[_YAW] = math.remainder(self.state[_YAW] + rate * gap, 2.0 * math.pi)
        self.P[2, 2] = min(self.P[2, 2] + (_HIDDEN_RATE * gap) ** 2, _ANY_HEADING)

    def _start_anew(self, force: np.ndarray) -> None:
        """Begin again from the accelerometer after a long silence; gyro bias and heading are kept."""
        p = self.params
        bias_block, heading = self.P[3:6, 3:6].copy(), self.P[2, 2]
        self.P[:] = np.diag([p.tilt_prior**2] * 2 + [heading] + [0.0] * 3 + [p.velocity_prior**2] * 3)
        self.P[3:6, 3:6] = bias_block
        self.v[:] = 0.0
        for _, covariance in self.axes:
            covariance[:] = np.diag([published.ANGLE_PRIOR, published.RATE_PRIOR])
        self._level(force)
        stillness.clear(self.still)

    def _settle(self) -> None:
        """Set the tilt from all samples since the start.

        At rest their mean is gravity. In flight it is thrust, which says nothing about tilt: there the best
        guess is level. The more it shakes, the more it is flight.
        """
        if self.still[stillness.COUNT]:  # else a still window has just closed
            self._tilt(self.still[stillness.FORCE], stillness.force_spread(self.still))

    def _tilt(self, force: np.ndarray, spread: float) -> None:
        """Set the tilt from a mean specific force and its spread (m/s²); the heading stays.

        Both the spread and what the mean has more or less than gravity count as noise of the angle, against
        the prior of a level craft.
        """
        size = math.sqrt(force @ force)
        noise = ((spread + abs(size - GRAVITY)) / max(size, _LEAST_FORCE)) ** 2
        share = self.params.tilt_prior**2 / (self.params.tilt_prior**2 + noise)
        tilt = quat_from_rotvec(share * rotvec_from_quat(driven.tilt_quaternion(*force)))
        # q = turn about the vertical · shortest tilt, so the turn's half angle has this tangent.
        turn = quat_from_rotvec(np.array([0.0, 0.0, 2.0 * math.atan2(self.q[3], self.q[0])]))
        self.q[:] = quat_multiply(turn, tilt)

    def _calibrate(self, gyro: np.ndarray, force: np.ndarray, dt: float) -> None:
        p = self.params
        s = self.state
        verdict = stillness.add(
            self.still,
            gyro,
            force,
            dt,
            p.calibration_time,
            p.still_rate,
            p.still_acceleration,
            p.still_bias,
        )
        if verdict == 0:
            return
        # A sensor that repeats itself is not a craft at rest.
        if verdict == 1 and not self.frozen:
            variance = p.bias_sigma**2
            mean = self.still[stillness.GYRO].copy()
            if stillness.force_spread(self.still) <= p.ground_acceleration:
                s[_STANDING] = 1.0
                s[_REFERENCE] = self.still[stillness.FORCE]
            if not s[_CALIBRATED]:
                # Heading has turned with the unknown bias meanwhile; the craft has not.
                if s[_STANDING]:
                    self.q[:] = driven.tilt_quaternion(*self.still[stillness.FORCE])
                    self.v[:] = 0.0
                    s[_YAW] = 0.0
                s[_CALIBRATED] = 1.0
                self.b[:] = mean
                self.P[3:6, :] = 0.0
                self.P[:, 3:6] = 0.0
                self.P[3:6, 3:6] = variance * np.eye(3)
            else:
                # A slow steady turn in flight looks still: the heading's mean is bias only on the ground.
                row = np.zeros(driven.N)
                for i in range(3 if s[_STANDING] else 2):
                    row[3 + i] = 1.0
                    driven.update(self.q, self.b, self.v, self.P, row, mean[i] - self.b[i], variance)
                    row[3 + i] = 0.0
        stillness.clear(self.still)

    def _stand(self, gyro: np.ndarray, force: np.ndarray) -> None:
        """End standing when the craft turns or the specific force changes."""
        p = self.params
        s = self.state
        if not s[_STANDING]:
            return
        turning = np.abs(gyro).max() > p.still_bias + 3.0 * p.still_rate
        moving = np.abs(force - s[_REFERENCE]).max() > p.ground_departure
        shaken = abs(math.sqrt(force @ force) - GRAVITY) > 2.0 * p.ground_departure
        if turning or moving or shaken:
            s[_STANDING] = 0.0

    def _driven_step(self, gyro: np.ndarray, pushed: np.ndarray, force: np.ndarray, dt: float) -> float:
        """Move by the means over `dt` of rate and force `pushed`; correct by the present `force`."""
        p = self.params
        driven.predict(
            self.q,
            self.b,
            self.v,
            self.P,
            gyro,
            pushed,
            dt,
            p.gyro_noise**2,
            p.bias_walk**2,
            p.specific_force_noise**2,
        )
        standing = self.standing
        return driven.correct(
            self.q,
            self.b,
            self.v,
            self.P,
            force,
            dt if dt <= _GAP else p.period,  # one sample after a gap is no mean over the gap
            0.0 if standing else p.drag,
            p.drag_noise**2,
            p.ground_noise**2 if standing else p.hover_noise**2,
            p.ground_noise**2 if standing else p.climb_noise**2,
        )

    def _published_step(self, gyro: np.ndarray, force: np.ndarray, dt: float) -> float:
        p = self.params
        paper = p.filter == 'published'
        step = p.period if paper else dt
        q11 = published.printed_q11(p.angular_acceleration, step, paper)
        factor = published.adaptive_factor(force[0], force[1], force[2], p.adaptive_gain, p.adaptive_deadband)
        angles = published.accelerometer_angles(force[0], force[1], force[2])
        nis = 0.0
        for axis, (x, covariance) in enumerate(self.axes):
            innovation, variance = published.step(
                x,
                covariance,
                step,
                p.angular_acceleration,
                q11,
                angles[axis],
                p.angle_variance * factor,
                gyro[axis] - self.b[axis],
                0.0 if paper else p.rate_variance,
            )
            nis += innovation * innovation / variance
        self.state[_YAW] = math.remainder(self.state[_YAW] + dt * (gyro[2] - self.b[2]), 2.0 * math.pi)
        return nis

    @property
    def started(self) -> bool:
        """Whether a first sample has given a tilt."""
        return bool(self.state[_STARTED])

    @property
    def calibrated(self) -> bool:
        """Whether a still window, or `start`, has given the gyro bias."""
        return bool(self.state[_CALIBRATED])

    @property
    def standing(self) -> bool:
        """Whether the craft is taken to stand on something."""
        return bool(self.state[_STANDING])

    @property
    def frozen(self) -> bool:
        """Whether the sensor repeats one sample."""
        limit = self.params.frozen_samples
        return limit > 0 and self.state[_FROZEN] >= limit - 1

    def _estimate(self, sample: ImuSample) -> Attitude:
        p = self.params
        P = self.P
        gx, gy, gz = sample.rate
        fx, fy, fz = (float(f - o) for f, o in zip(sample.force, p.accelerometer_offset))
        bx, by, bz = (float(v) for v in self.b)
        rate = (gx - bx, gy - by, gz - bz)
        q = self.q
        # The accelerometer bias is not a state: neither standing nor drag can tell it from tilt.
        unseen = (p.accelerometer_bias / GRAVITY) ** 2
        variance = (float(P[0, 0]) + unseen, float(P[1, 1]) + unseen, float(P[2, 2]))
        if p.filter != 'gyro_driven':
            (roll, rolling), (pitch, pitching) = self.axes[0][0], self.axes[1][0]
            q = quat_from_euler(roll, pitch, self.state[_YAW])
            variance = (float(self.axes[0][1][0, 0]), float(self.axes[1][1][0, 0]), variance[2])
        if self.frozen:
            spread = (_FROZEN_VARIANCE,) * 3
        else:
            white = p.gyro_noise**2 / p.period  # of one sample; it is not in the state
            spread = (float(P[3, 3]) + white, float(P[4, 4]) + white, float(P[5, 5]) + white)
        if p.filter == 'published':
            # Its rate lags, and the gyro shows how far: E[error²] = (estimate - gyro)² + the gyro's variance.
            lag = float(rolling) - rate[0], float(pitching) - rate[1]
            spread = (spread[0] + lag[0] ** 2, spread[1] + lag[1] ** 2, spread[2])
            rate = (float(rolling), float(pitching), rate[2])
        return Attitude(
            sample.stamp,
            (float(q[0]), float(q[1]), float(q[2]), float(q[3])),
            rate,
            (fx, fy, fz),
            variance,
            spread,
            sample.frame,
        )
