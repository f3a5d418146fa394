# SPDX-License-Identifier: Apache-2.0
"""The node that sends NMEA 0183 over UDP and a serial line."""

from __future__ import annotations

import socket
import termios
import time

from diagnostic_msgs.msg import DiagnosticArray

from kalman_core.parameters import ParameterError
from node_core.diagnostics import ERROR, OK, WARN, status
from ship_inclinometer import topics
from ship_inclinometer.alerts import AlertReporter
from ship_inclinometer.bridge_params import NmeaParams
from ship_inclinometer.nmea import all_sentences
from ship_inclinometer.nmea_output import SerialOutput, UdpOutput
from ship_inclinometer.nodes.bridge_node import BridgeNode

# Commands taken in one round: a flood must not hold up the sentences.
_COMMANDS_AT_ONCE = 20
# The alarm monitor may be started after this node (s); from then on its silence is an alert.
_ALARMS_AWAITED = 15.0


class NmeaNode(BridgeNode):
    """Sends one round of sentences at the set rate, also while nothing valid is known."""

    def __init__(self) -> None:
        super().__init__('nmea_bridge', NmeaParams)
        self._params: NmeaParams = self.parameters[NmeaParams]
        p = self._params
        self._udp = UdpOutput(p.udp_host, p.udp_port) if p.udp_host else None
        self._serial = self._open_serial()
        self._told_faults: dict[str, str] = {}
        self._reported_drops = 0
        self._alerts = AlertReporter(p.talker, p.manufacturer) if p.manufacturer else None
        self._pending: list[str] = []
        self._began = time.monotonic()
        self._commands = self._open_commands()
        self._publisher, self._message = self.publish_to('std_msgs/msg/String', topics.COMMAND)
        self._watch()
        self._watch_settings()
        self.create_timer(1.0 / self._params.rate, self._send, clock=self.steady_clock)

    def _open_serial(self) -> SerialOutput | None:
        p = self._params
        if not p.serial:
            return None
        line = SerialOutput(p.serial, p.baudrate)
        try:
            line.connect()
        except KeyError as error:
            raise ParameterError(f"parameter 'baudrate' is {error}, not a rate of serial lines") from error
        except (OSError, termios.error) as error:
            raise ParameterError(f"parameter 'serial' is {p.serial!r}: {error}") from error
        return line

    def _open_commands(self) -> socket.socket | None:
        p = self._params
        if not p.command_port:
            return None
        commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        commands.setblocking(False)
        try:
            commands.bind((p.command_host, p.command_port))
        except OSError as error:
            where = f"parameters 'command_host', 'command_port' are {p.command_host}:{p.command_port}"
            raise ParameterError(f'{where}: {error}') from error
        return commands

    def _take_commands(self, alerts: AlertReporter, now: int) -> None:
        for _ in range(_COMMANDS_AT_ONCE if self._commands is not None else 0):
            assert self._commands is not None
            try:
                data, peer = self._commands.recvfrom(2048)
            except OSError:
                # Nothing more has come.
                return
            for line in data.decode('ascii', 'replace').splitlines():
                command, answers = alerts.take(line, now)
                self._pending += answers
                if command is not None:
                    target = f' {command.alarm}' if command.name == 'acknowledge' else ''
                    self._message.data = f'{command.name}{target} nmea {peer[0]}'
                    self._publisher.publish(self._message)

    def _alert_sentences(self, now: int) -> list[str]:
        if self._alerts is None:
            return []
        self._take_commands(self._alerts, now)
        answers, self._pending = self._pending, []
        picture = self._picture
        alarms: dict[str, float] | None = picture.shown_alarms(now)
        if not alarms and time.monotonic() - self._began > _ALARMS_AWAITED:
            alarms = None
        return answers + self._alerts.sentences(now, alarms)

    def _send(self) -> None:
        p = self._params
        now = self.get_clock().now().nanoseconds
        lines = all_sentences(p.talker, self._picture, now, p.true_heading) + self._alert_sentences(now)
        for name, output in (('UDP', self._udp), ('serial line', self._serial)):
            if output is not None:
                output.send(lines)
                self._tell(name, output.fault)

    def _tell(self, name: str, fault: str) -> None:
        """Say once that an output fails, and once that it works again."""
        if fault == self._told_faults.get(name, ''):
            return
        self._told_faults[name] = fault
        if fault:
            self.get_logger().warning(f'{name}: {fault}')
        else:
            self.get_logger().info(f'{name}: works again')

    def diagnose(self) -> DiagnosticArray:
        """Report each output: whether it works, and what a line that is too slow has left out."""
        name = self.get_fully_qualified_name().lstrip('/')
        out = []
        if self._udp is not None:
            udp = self._udp
            level, text = (ERROR, udp.fault) if udp.fault else (OK, 'ok')
            out.append(status(f'{name}: UDP', level, text, {'datagrams': udp.sent, 'failed': udp.failed}))
        if self._serial is not None:
            line = self._serial
            fresh = line.dropped - self._reported_drops
            self._reported_drops = line.dropped
            level, text = OK, 'ok'
            if line.fault:
                level, text = ERROR, line.fault
            elif fresh:
                level, text = WARN, f'line too slow: {fresh} old sentences left out since the last report'
            values = {'sentences': line.sent, 'left_out': line.dropped, 'reopened': line.reopened}
            out.append(status(f'{name}: serial line', level, text, values))
        return DiagnosticArray(status=out)

    def destroy_node(self) -> None:
        """Close the outputs with the node."""
        for output in (self._udp, self._serial):
            if output is not None:
                output.close()
        super().destroy_node()
