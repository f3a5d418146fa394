# SPDX-License-Identifier: Apache-2.0
"""The node that sends NMEA 0183 over UDP and a serial line."""

from __future__ import annotations

import os
import socket
import termios
import time

from kalman_core.parameters import ParameterError
from ship_inclinometer import topics
from ship_inclinometer.alerts import AlertReporter
from ship_inclinometer.bridge_params import NmeaParams
from ship_inclinometer.modbus_server import configure
from ship_inclinometer.nmea import all_sentences
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
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)
        self._serial = self._open_serial()
        p = self._params
        self._alerts = AlertReporter(p.talker, p.manufacturer) if p.manufacturer else None
        self._pending: list[str] = []
        self._began = time.monotonic()
        self._commands = self._open_commands()
        self._publisher, self._message = self.publish_to('std_msgs/msg/String', topics.COMMAND)
        self._watch()
        self._watch_settings()
        self.create_timer(1.0 / self._params.rate, self._send, clock=self.steady_clock)

    def _open_serial(self) -> int | None:
        path = self._params.serial
        if not path:
            return None
        try:
            file = os.open(path, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
            configure(file, self._params.baudrate, 'N')
        except KeyError as error:
            raise ParameterError(f"parameter 'baudrate' is {error}, not a rate of serial lines") from error
        except (OSError, termios.error) as error:
            raise ParameterError(f"parameter 'serial' is {path!r}: {error}") from error
        return file

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
        text = ''.join(lines).encode('ascii')
        try:
            if p.udp_host:
                self._socket.sendto(text, (p.udp_host, p.udp_port))
            if self._serial is not None:
                os.write(self._serial, text)
        except OSError as error:
            # A cable that is out is no reason to stop; a full line drops this round, the next is newer.
            self.get_logger().warning(f'NMEA: {error}', throttle_duration_sec=5.0)
