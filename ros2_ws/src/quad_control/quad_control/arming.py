# SPDX-License-Identifier: Apache-2.0
"""Arming and failsafe as a state machine over a flat state: pure, driven by stamps, never by a clock.

| state | motors | leaves by |
|---|---|---|
| disarmed | stopped | the arm switch goes on, all checks passed |
| armed | fly | switch off, kill, a fault |
| descent | fly level, sink | switch off, kill, a worse fault, too long no sinking; link back: armed again |
| stopped | stopped after a fault | switch off |
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quad_control.params import ArmingParams

DISARMED, ARMED, DESCENT, STOPPED = 0.0, 1.0, 2.0, 3.0
NAMES = {DISARMED: 'disarmed', ARMED: 'armed', DESCENT: 'failsafe descent', STOPPED: 'failsafe stopped'}

# Flat state: mode, time of entering it (of a descent: of last seeing it sink), last switch (1 on, 0 off,
# -1 not seen), start of low voltage (s, < 0 none), whether the descent is for a lost link.
MODE, SINCE, SWITCH, LOW_SINCE, LINK_REASON = range(5)
SIZE = 5


class Checks(NamedTuple):
    """What the machine looks at on one tick. `time` in s; `tilt` rad; ages in s; `rate_sigma` rad/s.

    `sinking`: a measured height is above the ground and falls.
    """

    time: float
    attitude_age: float
    setpoint_age: float
    rate_sigma: float
    tilt: float
    throttle: float
    switch: bool
    voltage: float | None
    sinking: bool = False


class Arming:
    """Decides whether the motors may turn. `state` (5,) holds everything that changes."""

    def __init__(self, params: ArmingParams, state: np.ndarray) -> None:
        self.params = params
        self.state = state
        self.reset()

    def reset(self) -> None:
        """Return to disarmed; the switch must be seen off before it can arm."""
        self.state[:] = (DISARMED, 0.0, -1.0, -1.0, 0.0)

    @property
    def mode(self) -> float:
        """DISARMED, ARMED, DESCENT or STOPPED."""
        return float(self.state[MODE])

    @property
    def flying(self) -> bool:
        """Whether the controller drives the motors."""
        return self.mode in (ARMED, DESCENT)

    def refusal(self, c: Checks) -> str:
        """Return why arming is refused now, or an empty string."""
        p = self.params
        if c.attitude_age > p.imu_timeout:
            return 'attitude is stale'
        if c.setpoint_age > p.link_timeout:
            return 'no setpoint'
        if not c.rate_sigma <= p.max_rate_sigma:
            return f'gyro bias not known: rate sigma {c.rate_sigma:.3f} rad/s, allowed {p.max_rate_sigma:.3f}'
        if not c.tilt <= p.max_arming_tilt:
            return f'tilt is {c.tilt:.2f} rad, allowed {p.max_arming_tilt:.2f}'
        if not c.throttle <= p.max_arming_throttle:
            return f'throttle is {c.throttle:.2f}, allowed {p.max_arming_throttle:.2f}'
        if c.voltage is not None and c.voltage < p.battery_warn:
            return f'battery is {c.voltage:.1f} V, allowed {p.battery_warn:.1f}'
        return ''

    def request(self, on: bool, c: Checks) -> str:
        """Arm or disarm on the pilot's demand; return what happened, for the event log."""
        if not on:
            if self.mode == DISARMED:
                return ''
            return self._enter(DISARMED, c.time, 'by the pilot')
        if self.mode == ARMED:
            return ''
        if self.mode != DISARMED:
            return f'refused: {NAMES[self.mode]}'
        reason = self.refusal(c)
        if reason:
            return f'refused: {reason}'
        return self._enter(ARMED, c.time, '')

    def kill(self, time: float) -> str:
        """Stop the motors at once, until the pilot disarms."""
        return self._enter(STOPPED, time, 'kill switch')

    def tick(self, c: Checks) -> str:
        """Look at everything once; return the text of a change of state, or an empty string."""
        text = self._switch(c)
        if text or not self.flying:
            return text
        p = self.params
        if c.attitude_age > p.imu_timeout:
            return self._enter(STOPPED, c.time, f'attitude is {1e3 * c.attitude_age:.0f} ms old')
        if not c.rate_sigma <= p.max_rate_sigma:
            return self._enter(STOPPED, c.time, f'rates not known: sigma {c.rate_sigma:.2f} rad/s')
        if c.sinking and self.mode == DESCENT:
            self.state[SINCE] = c.time
        low = self._battery_low(c)
        lost = c.setpoint_age > p.link_timeout
        if self.mode == ARMED:
            if lost:
                self.state[LINK_REASON] = 1.0
                return self._enter(DESCENT, c.time, f'no setpoint for {c.setpoint_age:.2f} s')
            if low:
                self.state[LINK_REASON] = 0.0
                return self._enter(DESCENT, c.time, f'battery is {c.voltage:.1f} V')
        elif c.time - self.state[SINCE] > p.descent_time:
            return self._enter(STOPPED, c.time, 'descent timed out')
        elif self.state[LINK_REASON] and not lost:
            return self._enter(ARMED, c.time, 'link is back')
        return ''

    def landed(self, time: float) -> str:
        """End a descent on the ground."""
        return self._enter(STOPPED, time, 'landed')

    def _switch(self, c: Checks) -> str:
        if c.setpoint_age > self.params.link_timeout:
            return ''  # a lost link says nothing about the switch
        before, now = self.state[SWITCH], 1.0 if c.switch else 0.0
        self.state[SWITCH] = now
        if before < 0.0 or before == now:
            return ''
        return self.request(c.switch, c)

    def _battery_low(self, c: Checks) -> bool:
        if c.voltage is None or c.voltage >= self.params.battery_warn:
            self.state[LOW_SINCE] = -1.0
            return False
        if self.state[LOW_SINCE] < 0.0:
            self.state[LOW_SINCE] = c.time
        return c.time - self.state[LOW_SINCE] >= self.params.battery_hold

    def _enter(self, mode: float, time: float, why: str) -> str:
        self.state[MODE] = mode
        self.state[SINCE] = time
        return NAMES[mode] + (f': {why}' if why else '')
