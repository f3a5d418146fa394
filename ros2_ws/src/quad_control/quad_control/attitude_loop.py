# SPDX-License-Identifier: Apache-2.0
"""The three axes together: gains that move in bumplessly, both controllers, the relay of an autotune."""

from __future__ import annotations

import numpy as np

from quad_control import loops
from quad_control.params import GAINS, ControllerParams
from quad_control.tuning import RelayTest

AXES = ('roll', 'pitch', 'yaw')
# A yaw stick closer to the centre than this (rad/s) holds the heading.
YAW_CENTRE = 0.02
# Outer angle gain (1/s) while a relay drives the rate loop: slow, so that it only keeps the craft level.
_RELAY_ANGLE_P = 1.5

_INDEX = {name: i for i, name in enumerate(GAINS)}
_CASCADE = tuple(
    tuple(_INDEX[f'{axis}_{name}'] for name in ('angle_p', 'rate_p', 'rate_i', 'rate_d')) for axis in AXES
)
_PUBLISHED = tuple(tuple(_INDEX[f'{axis}_{name}'] for name in ('kp', 'ki', 'kd')) for axis in AXES)
_COMMON = tuple(
    _INDEX[name]
    for name in (
        'setpoint_weight',
        'integral_limit',
        'derivative_cutoff',
        'rate_cutoff',
        'notch_frequency',
        'notch_quality',
    )
)
_LOOPS = 3 * loops.AXIS_SIZE
# Flat state: axes of the cascade, axes of the published PID, last demand, blend time left (s), which
# controller ran last, active gains.
_DEMAND = slice(2 * _LOOPS, 2 * _LOOPS + 3)
_BLEND, _RAN_CASCADE = 2 * _LOOPS + 3, 2 * _LOOPS + 4
_GAINS = slice(2 * _LOOPS + 5, 2 * _LOOPS + 5 + len(GAINS))
SIZE = 2 * _LOOPS + 5 + len(GAINS)


class AttitudeLoop:
    """Torque demands from attitude and rate errors; everything that changes is in `state` (SIZE,)."""

    def __init__(self, params: ControllerParams, state: np.ndarray) -> None:
        self.params = params
        self.state = state
        self._cascade = state[:_LOOPS].reshape(3, loops.AXIS_SIZE)
        self._published = state[_LOOPS : 2 * _LOOPS].reshape(3, loops.AXIS_SIZE)
        self.demand = state[_DEMAND]
        self.gains = state[_GAINS]
        self.reset()

    def reset(self) -> None:
        """Forget integrals and filters and take the gains of the parameters at once."""
        self.state[:] = 0.0
        self.state[_RAN_CASCADE] = float(self.params.controller == 'cascade')
        self.gains[:] = self._wanted()

    def rest(self) -> None:
        """Forget integrals and filters while the motors stand or idle."""
        self.state[: 2 * _LOOPS] = 0.0
        self.demand[:] = 0.0

    def configure(self, params: ControllerParams) -> None:
        """Take new parameters; gains move to them over `gain_blend_time`."""
        self.params = params
        self.state[_BLEND] = params.gain_blend_time
        if not params.gain_blend_time:
            self.gains[:] = self._wanted()

    def blend(self, dt: float) -> None:
        """Move the active gains on by `dt` (s)."""
        left = self.state[_BLEND]
        if left <= 0.0:
            return
        wanted = self._wanted()
        self.gains[:] = wanted if left <= dt else self.gains + dt / left * (np.array(wanted) - self.gains)
        self.state[_BLEND] = left - dt

    def rate_targets(self, errors: tuple, yaw_rate: float, relay_axis: int = -1) -> list[float]:
        """Return the rate setpoints (rad/s) for attitude errors (rad), body axes."""
        p = self.params
        targets = []
        for axis in range(3):
            limit = p.max_yaw_rate if axis == 2 else p.max_rate
            gain = _RELAY_ANGLE_P if axis == relay_axis else float(self.gains[_CASCADE[axis][0]])
            targets.append(clip(gain * errors[axis], limit))
        if abs(yaw_rate) > YAW_CENTRE:
            targets[2] = yaw_rate
        return targets

    def step(
        self,
        rates: tuple,
        errors: tuple,
        targets: list[float],
        yaw_rate: float,
        dt: float,
        relay: tuple[int, RelayTest] | None = None,
    ) -> np.ndarray:
        """Return the torque demand (3,) in thrust fractions; a relay takes over its axis."""
        cascade = self.params.controller == 'cascade'
        if cascade != bool(self.state[_RAN_CASCADE]):
            self._hand_over(cascade)
        if not cascade:
            return self._published_step(rates, errors, yaw_rate, dt)
        g = self.gains
        weight, limit, d_cutoff, cutoff, notch_hz, notch_q = (float(g[i]) for i in _COMMON)
        for axis in range(3):
            _, kp, ki, kd = _CASCADE[axis]
            s = self._cascade[axis]
            self.demand[axis] = loops.rate_step(
                s,
                rates[axis],
                targets[axis],
                g[kp],
                g[ki],
                g[kd],
                weight,
                limit,
                d_cutoff,
                cutoff,
                notch_hz,
                notch_q,
                dt,
            )
            if relay is not None and relay[0] == axis:
                # The integral stays as it was: the relay swings around what holds the craft.
                s[loops.INTEGRAL] -= s[loops.STEP_I]
                s[loops.STEP_I] = 0.0
                self.demand[axis] = s[loops.INTEGRAL] + relay[1].output(targets[axis] - rates[axis], dt)
        return self.demand

    def _published_step(self, rates: tuple, errors: tuple, yaw_rate: float, dt: float) -> np.ndarray:
        g = self.gains
        scale = self.params.published_scale
        for axis in range(3):
            kp, ki, kd = _PUBLISHED[axis]
            # The paper's yaw PID holds the heading; with the stick out it works on the rate.
            turning = axis == 2 and abs(yaw_rate) > YAW_CENTRE
            error = yaw_rate - rates[2] if turning else errors[axis]
            self.demand[axis] = loops.published_step(
                self._published[axis], error, g[kp], g[ki], g[kd], scale, dt
            )
        return self.demand

    def unwind(self, achieved: np.ndarray) -> None:
        """Take back the integration of axes whose torque the mixer could not give in full."""
        axes = self._cascade if self.params.controller == 'cascade' else self._published
        for axis in range(3):
            loops.unwind(axes[axis], self.demand[axis], achieved[axis])

    def _hand_over(self, cascade: bool) -> None:
        """Start the other controller where this one stands: its integral takes the whole demand."""
        axes = self._cascade if cascade else self._published
        axes[:] = 0.0
        for axis in range(3):
            axes[axis, loops.INTEGRAL] = clip(float(self.demand[axis]), self.params.integral_limit)
        self.state[_RAN_CASCADE] = float(cascade)

    def _wanted(self) -> list[float]:
        return [getattr(self.params, name) for name in GAINS]


def clip(value: float, limit: float) -> float:
    """Return `value` limited to ±`limit`."""
    return min(max(value, -limit), limit)
