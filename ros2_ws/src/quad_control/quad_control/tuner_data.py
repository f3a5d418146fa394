# SPDX-License-Identifier: Apache-2.0
"""What the tuning page shows, gathered from messages: gains, plot samples, events. No ROS."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from typing import Any

from quad_control.params import GAINS, ControllerParams
from quad_control.web_server import Gain, History

ACTIONS = (
    'takeoff',
    'disarm',
    'step_roll',
    'step_pitch',
    'autotune_roll',
    'autotune_pitch',
    'autotune_yaw',
    'apply_proposal',
    'kill',
)
# The step test of the page: the paper's 10 degrees, for one second.
STEP_ANGLE, STEP_TIME = math.radians(10.0), 1.0
# The page plots at most this many samples per second: beyond it no screen shows a difference.
_PLOT_RATE = 100.0
# Samples kept for pages that come late (s of plot), and lines of the event log.
_KEPT_SECONDS, _KEPT_EVENTS = 12.0, 50
# Without a fallback the maximum of an unbounded gain; the page needs an end for its slider.
_LARGEST = 1000.0


class TunerData:
    """Written by the spinning thread, read by the server's: single attributes, replaced or appended."""

    def __init__(self) -> None:
        self.history = History()
        self.fetched = False
        self._fields = [f for f in dataclasses.fields(ControllerParams) if f.name in GAINS]
        self._values = {f.name: float(f.default) for f in self._fields}  # type: ignore[arg-type]
        self._expected: dict[str, float] = {}
        self._samples: deque[tuple[int, list]] = deque(maxlen=round(_KEPT_SECONDS * _PLOT_RATE))
        self._counter = 0
        self._last_plot = -math.inf
        self._stamps: deque[float] = deque(maxlen=100)
        self._raw: list[float] | None = None
        self._pulses = [1000.0] * 4
        self._events: deque[str] = deque(maxlen=_KEPT_EVENTS)
        self._arming = 'no controller'
        self._trial = ''
        self._voltage: float | None = None

    # Read -----------------------------------------------------------------------------------------------

    def gains(self) -> list[Gain]:
        """Return every gain with its present value and bounds."""
        out = []
        for f in self._fields:
            low, high = f.metadata['min'], f.metadata['max']
            bounds = (0.0 if low is None else low, _LARGEST if high is None else high)
            out.append(Gain(f.name, self._values[f.name], *bounds, f.metadata['unit'], f.metadata['text']))
        return out

    def state(self) -> dict[str, Any]:
        """Return arming state, battery, rate, running trial and events."""
        span = self._stamps[-1] - self._stamps[0] if len(self._stamps) > 1 else 0.0
        return {
            'arming': self._arming,
            'voltage': self._voltage,
            'rate': (len(self._stamps) - 1) / span if span > 0.0 else None,
            'trial': self._trial,
            'events': list(self._events),
        }

    def samples(self, after: int) -> tuple[int, list]:
        """Return the counter now and the samples counted after `after`."""
        return self._counter, [sample for number, sample in list(self._samples) if number > after]

    # Gains ----------------------------------------------------------------------------------------------

    def expect(self, changes: dict[str, float]) -> None:
        """Remember what the page has asked for: its echo is no change from elsewhere."""
        self._expected = dict(changes)

    def known(self, values: dict[str, float]) -> None:
        """Take values that the controller has confirmed."""
        self._values.update({name: float(value) for name, value in values.items()})

    def changed_elsewhere(self, changes: dict[str, Any]) -> None:
        """Take a parameter event of the controller: a revert, or somebody's `ros2 param set`."""
        gains = {name: float(value) for name, value in changes.items() if name in self._values}
        foreign = {name: value for name, value in gains.items() if self._expected.get(name) != value}
        self.history.add(foreign, dict(self._values), self._origin(foreign))
        self.known(gains)

    def _origin(self, changes: dict[str, float]) -> str:
        if self._events and 'reverted' in self._events[-1]:
            return 'trial'
        proposals = [text for text in self._events if text.startswith('proposal')]
        if proposals and all(f'{name} {value:.4g}' in proposals[-1] for name, value in changes.items()):
            return 'autotune'
        return 'elsewhere'

    # Messages -------------------------------------------------------------------------------------------

    def on_report(self, message: Any) -> None:
        """Take a controller/report."""
        time = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        self._stamps.append(time)
        if time < self._last_plot:
            self._stamps.clear()
        elif time - self._last_plot < 0.999 / _PLOT_RATE:
            return
        self._last_plot = time
        setpoint, measured = list(message.position[:2]), list(message.velocity[:2])
        raw = self._raw or measured
        self._counter += 1
        angles = [[round(float(v), 5) for v in pair] for pair in (setpoint, measured, raw)]
        self._samples.append((self._counter, [round(time, 4), *angles, self._pulses]))

    def on_raw(self, message: Any) -> None:
        """Take an imu/angle_raw."""
        self._raw = [message.vector.x, message.vector.y]

    def on_motors(self, message: Any) -> None:
        """Take a motors/command."""
        self._pulses = [round(float(v), 1) for v in message.position]

    def on_battery(self, message: Any) -> None:
        """Take a battery voltage."""
        self._voltage = float(message.voltage) if math.isfinite(message.voltage) else None

    def on_event(self, message: Any) -> None:
        """Take a line of controller/events."""
        text = message.data
        self._events.append(text)
        if text.startswith('trial: '):
            running = not text.startswith(('trial: kept', 'trial: reverted'))
            self._trial = f'on trial: {text.removeprefix("trial: ")}' if running else ''

    def on_arming(self, message: Any) -> None:
        """Take the arming state."""
        self._arming = message.data
