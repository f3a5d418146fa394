# SPDX-License-Identifier: Apache-2.0
"""The node around the alarm monitor: what it raises or ends is in the event log before it is published."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import ROSClock
from std_srvs.srv import SetBool, Trigger

from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.messages import stamp_of
from node_core.node import WorkspaceNode
from node_core.ports import BadMessage
from ship_inclinometer import topics
from ship_inclinometer.alarms import AlarmEvent, AlarmMonitor, quantities
from ship_inclinometer.bridge_params import AlarmParams
from ship_inclinometer.codec import (
    VALUES,
    VECTOR,
    decode_angles,
    decode_numbers,
    decode_validity,
    encode_numbers,
)
from ship_inclinometer.event_log import LogError
from ship_inclinometer.marine import Picture
from ship_inclinometer.nodes.bridge_node import open_log
from ship_inclinometer.samples import INVALID

# Judged at the rate of the standard's output.
_PERIOD = 0.1  # s
# The attitude takes up to a minute to align: its absence is no alarm before.
_START_UP = 60.0  # s


class AlarmNode(WorkspaceNode):
    """Publishes ship/alarms; takes ship/command and ship/settings."""

    def __init__(self) -> None:
        super().__init__('alarm_monitor', AlarmParams)
        params: AlarmParams = self.parameters[AlarmParams]
        self._log = open_log(params.event_log)
        self._configured = self._thresholds()
        self._monitor = AlarmMonitor(dict(self._configured), params.latching)
        self.parameters.on_change(self._parameters_changed)
        self._picture = Picture()
        self._began = self._elapsed()
        self._unlogged = ''
        self._publisher, self._message = self.publish_to(VALUES, topics.ALARMS, latched=True)
        self.listen(VECTOR, topics.ANGLES, self._on_angles)
        self.listen(VALUES, topics.VALIDITY, self._on_validity, latched=True)
        self.listen(VALUES, topics.ROLL, self._on_roll)
        self.listen(VALUES, topics.SETTINGS, self._on_settings, latched=True)
        self.listen('std_msgs/msg/String', topics.COMMAND, self._on_command)
        self.create_service(Trigger, '~/acknowledge', self._on_acknowledge)
        self.create_service(Trigger, '~/silence', self._on_silence)
        self.create_service(SetBool, '~/stop', self._on_stop)
        self.create_timer(_PERIOD, self._judge, clock=self.steady_clock)
        self._append('start', 'alarm_monitor', 'started')

    def _thresholds(self) -> dict[str, float]:
        values = asdict(self.parameters[AlarmParams])
        return {name: value for name, value in values.items() if isinstance(value, float)}

    def destroy_node(self) -> None:
        """Log the stop."""
        self._append('stop', 'alarm_monitor', 'stopped')
        self._log.close()
        super().destroy_node()

    def _elapsed(self) -> int:
        """Return the time (ns) that alarms go by: the wall clock may step, simulated time may run faster."""
        clock = self.get_clock()
        simulated = isinstance(clock, ROSClock) and clock.ros_time_is_active
        return clock.now().nanoseconds if simulated else time.monotonic_ns()

    def _append(self, kind: str, who: str, text: str) -> None:
        try:
            self._log.append(self.get_clock().now().nanoseconds, kind, who, text)
            self._unlogged = ''
        except LogError as error:
            # An alarm that cannot be logged must still sound.
            self._unlogged = str(error)
            self.get_logger().error(str(error), throttle_duration_sec=5.0)

    def _parameters_changed(self) -> None:
        # What was set over Modbus stays, unless this very parameter is changed.
        before, self._configured = self._configured, self._thresholds()
        changed = {n: v for n, v in self._configured.items() if v != before[n]}
        self._change(changed, 'parameter')
        self._monitor.latching = self.parameters[AlarmParams].latching

    def _change(self, settings: dict[str, float], who: str) -> None:
        known = self._monitor.settings
        changes = {n: v for n, v in settings.items() if n in known and known[n] != v}
        if changes:
            text = ', '.join(f'{n} {known[n]:g} -> {v:g}' for n, v in changes.items())
            self._append('setting', who, text)
            known.update(changes)

    def _on_angles(self, message: Any) -> None:
        self._guarded(topics.ANGLES, lambda: self._picture.take_angles(decode_angles(message)))

    def _on_validity(self, message: Any) -> None:
        self._guarded(topics.VALIDITY, lambda: self._picture.take_validity(decode_validity(message)))

    def _on_roll(self, message: Any) -> None:
        take = self._picture.take_roll
        self._guarded(topics.ROLL, lambda: take(stamp_of(message), decode_numbers(message)))

    def _on_settings(self, message: Any) -> None:
        def take() -> None:
            settings = decode_numbers(message)
            self._picture.take_settings(settings)
            self._change(settings, 'modbus')

        self._guarded(topics.SETTINGS, take)

    def _guarded(self, topic: str, take: Any) -> None:
        try:
            take()
        except BadMessage as error:
            self.get_logger().warning(f'{topic}: {error}', throttle_duration_sec=5.0)

    def _on_command(self, message: Any) -> None:
        name, _, who = message.data.partition(' ')
        if name == 'acknowledge':
            alarm, _, rest = who.partition(' ')
            known = alarm in self._monitor.states
            self._tell(self._monitor.acknowledge(alarm if known else ''), rest if known else who)
        elif name == 'silence':
            self._silence(who)
        elif name == 'log_mark':
            self._append('mark', who, 'mark')
        elif name in ('stop_set', 'stop_clear'):
            self._stop(name == 'stop_set', who)

    def _silence(self, who: str) -> None:
        self._monitor.silence(self._elapsed())
        self._append('silence', who, 'silenced')

    def _stop(self, stopped: bool, who: str) -> None:
        if self._monitor.stopped != stopped:
            self._append('stop flag', who, 'alarms suspended' if stopped else 'alarms judged again')
            self._monitor.stopped = stopped

    def _on_stop(self, request: Any, response: Any) -> Any:
        self._stop(request.data, 'service')
        response.success = True
        response.message = 'alarms suspended' if request.data else 'alarms judged again'
        return response

    def _on_acknowledge(self, _request: Any, response: Any) -> Any:
        events = self._monitor.acknowledge()
        self._tell(events, 'service')
        response.success = True
        response.message = f'{len(events)} acknowledged'
        return response

    def _on_silence(self, _request: Any, response: Any) -> Any:
        self._silence('service')
        response.success = True
        response.message = 'silenced'
        return response

    def _tell(self, events: list[AlarmEvent], who: str) -> None:
        for event in events:
            self._append(event.kind, who, f'{event.name}: {event.text}')

    def _judge(self) -> None:
        now = self.get_clock().now().nanoseconds
        elapsed = self._elapsed()
        started = elapsed - self._began > _START_UP * 1e9
        self._tell(self._monitor.update(elapsed, quantities(self._picture, now, started)), 'alarm_monitor')
        encode_numbers(self._message, now, self._monitor.numbers(elapsed))
        self._publisher.publish(self._message)

    def diagnose(self) -> DiagnosticArray:
        """Report what cannot be judged, and an event log that cannot be written."""
        now = self.get_clock().now().nanoseconds
        validity, reason = self._picture.shown_validity(now)
        level, text = OK, 'ok'
        if self._unlogged:
            level, text = ERROR, self._unlogged
        elif validity == INVALID:
            level, text = ERROR, f'no attitude to judge: {reason}'
        elif not self._picture.rolling_known(now):
            level, text = WARN, 'roll amplitude and resonance are not judged: no roll analysis'
        elif self._monitor.stopped:
            level, text = WARN, 'stop flag set: nothing is judged'
        values = {
            'active': sum(state.active for state in self._monitor.states.values()),
            'unacknowledged': sum(not state.acknowledged for state in self._monitor.states.values()),
        }
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, level, text, values)])
