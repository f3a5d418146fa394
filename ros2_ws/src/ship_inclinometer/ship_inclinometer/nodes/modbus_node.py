# SPDX-License-Identifier: Apache-2.0
"""The node around the Modbus servers: ROS in one thread, the bus in another."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from pathlib import Path
from typing import Any

from kalman_core.parameters import ParameterError
from ship_inclinometer import modbus_map as m
from ship_inclinometer import topics
from ship_inclinometer.bridge_params import ModbusParams
from ship_inclinometer.codec import VALUES, encode_numbers
from ship_inclinometer.modbus_device import ModbusDevice
from ship_inclinometer.modbus_server import RtuServer, TcpServer
from ship_inclinometer.nodes.bridge_node import BridgeNode, open_log
from ship_inclinometer.roll_analysis import NO_ROLL, ROLLING
from ship_inclinometer.samples import DEGRADED, INVALID, VALID
from ship_inclinometer.settings_file import SettingsError, load_settings, save_settings

# Closing sockets takes milliseconds, on a stalled machine seconds.
_STOP_LIMIT = 10.0  # s


class ModbusNode(BridgeNode):
    """Serves the register map; its device calls `record`, `command`, `changed` and `save` from the bus."""

    def __init__(self) -> None:
        super().__init__('modbus_bridge', ModbusParams)
        self._params: ModbusParams = self.parameters[ModbusParams]
        self._file = Path(self._params.settings_file).expanduser()
        try:
            settings, crc = load_settings(self._file)
        except SettingsError as error:
            raise ParameterError(f"parameter 'settings_file': {error}") from error
        self._log = open_log(self._params.event_log)
        self.device = ModbusDevice(
            self._params.unit, self, self._params.unlock_key, self._params.unlock_time, settings
        )
        self.device.saved_crc = crc
        self._command, self._command_message = self.publish_to('std_msgs/msg/String', topics.COMMAND)
        self._settings, self._settings_message = self.publish_to(VALUES, topics.SETTINGS, latched=True)
        self._watch()
        self._loop = asyncio.new_event_loop()
        self._servers = self._start()
        self.create_timer(1.0 / self._params.update_rate, self._update, clock=self.steady_clock)
        self.record('start', 'modbus_bridge', 'started')
        # Defaults are nobody's wish: they must not take the place of what a node's own parameters say.
        self._known = dict(self.device.settings)
        self._given: dict[str, float] = {}
        self._picture.take_settings(self.device.settings)
        if settings:
            self._give(settings)

    def _start(self) -> list[Any]:
        p = self._params
        servers: list[Any] = []
        if p.tcp:
            servers.append(
                TcpServer(self.device, p.tcp_host, p.tcp_port, p.tcp_allowed.split(), self._refused)
            )
        if p.serial:
            try:
                servers.append(RtuServer(self.device, p.serial, p.baudrate, p.parity, p.local_echo))
            except ValueError as error:
                raise ParameterError(str(error)) from error
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        for server in servers:
            try:
                asyncio.run_coroutine_threadsafe(server.start(), self._loop).result()
            except Exception as error:  # OSError, termios.error: whatever the operating system says
                where = (
                    f"parameter 'serial' is {p.serial!r}"
                    if isinstance(server, RtuServer)
                    else f'Modbus TCP on {p.tcp_host}:{p.tcp_port}'
                )
                raise ParameterError(f'{where}: {error}') from error
        return servers

    def destroy_node(self) -> None:
        """Stop the servers, log the stop."""
        for server in self._servers:
            try:
                asyncio.run_coroutine_threadsafe(server.stop(), self._loop).result(_STOP_LIMIT)
            except TimeoutError:
                # The process ends in any case and takes the sockets along; the log still has to be closed.
                self.get_logger().warning(f'a server did not stop within {_STOP_LIMIT:g} s')
        self._loop.call_soon_threadsafe(self._loop.stop)
        self.record('stop', 'modbus_bridge', 'stopped')
        self._log.close()
        super().destroy_node()

    def record(self, kind: str, who: str, text: str) -> None:
        """Log an event; it is on the medium on return."""
        self._log.append(time.time_ns(), kind, who, text)

    def command(self, name: str, who: str) -> None:
        """Hand a coil's command to the nodes that carry it out."""
        self._command_message.data = f'{name} {who}'
        self._command.publish(self._command_message)

    def changed(self, settings: dict[str, float]) -> None:
        """Use settings here, and publish those that were ever set for the nodes that use them."""
        self._picture.take_settings(settings)
        self._give({name: value for name, value in settings.items() if self._known[name] != value})
        self._known = settings

    def _give(self, settings: dict[str, float]) -> None:
        self._given |= settings
        encode_numbers(self._settings_message, time.time_ns(), self._given)
        self._settings.publish(self._settings_message)

    def save(self, settings: dict[str, float], crc: int) -> None:
        """Write settings to the medium."""
        save_settings(self._file, settings, crc)

    def _refused(self, peer: str) -> None:
        self.get_logger().warning(f'Modbus TCP: {peer} is not in tcp_allowed')

    def _update(self) -> None:
        now = self.get_clock().now().nanoseconds
        picture = self._picture
        validity, _ = picture.shown_validity(now)
        known = validity != INVALID
        values = {f.name: getattr(picture, f.name, math.nan) if known else math.nan for f in m.MEASURED}
        for name in ('roll_period', 'amplitude_port', 'amplitude_starboard', 'peak_port', 'peak_starboard'):
            values[name] = picture.number(name, now)
        utc = picture.stamp or now
        values |= {
            'utc_seconds': utc // 10**9,
            'utc_milliseconds': utc // 10**6 % 1000,
            'age': min(max(1e3 * picture.age(now), 0.0), 65535.0),
        }
        alarms = picture.shown_alarms(now)
        bits = {name: bool(alarms.get(name, 0.0)) for name in m.DISCRETE[6:15]}
        bits |= {'valid': validity == VALID, 'degraded': validity == DEGRADED, 'invalid': not known}
        bits |= {
            'heading_valid': known and picture.heading_valid,
            'rolling': picture.number('status', now) == ROLLING,
            'no_roll': picture.number('status', now) == NO_ROLL,
            'alarms_unknown': not picture.alarms_known(now),
            'roll_unknown': not picture.rolling_known(now),
        }
        asyncio.run_coroutine_threadsafe(self.device.update(values, bits), self._loop)
