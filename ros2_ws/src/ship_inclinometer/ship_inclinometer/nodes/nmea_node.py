# SPDX-License-Identifier: Apache-2.0
"""The node that sends NMEA 0183 over UDP and a serial line."""

from __future__ import annotations

import os
import socket
import termios

from kalman_core.parameters import ParameterError
from ship_inclinometer.bridge_params import NmeaParams
from ship_inclinometer.modbus_server import configure
from ship_inclinometer.nmea import all_sentences
from ship_inclinometer.nodes.bridge_node import BridgeNode


class NmeaNode(BridgeNode):
    """Sends one round of sentences at the set rate, also while nothing valid is known."""

    def __init__(self) -> None:
        super().__init__('nmea_bridge', NmeaParams)
        self._params: NmeaParams = self.parameters[NmeaParams]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)
        self._serial = self._open_serial()
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

    def _send(self) -> None:
        p = self._params
        now = self.get_clock().now().nanoseconds
        text = ''.join(all_sentences(p.talker, self._picture, now, p.true_heading)).encode('ascii')
        try:
            if p.udp_host:
                self._socket.sendto(text, (p.udp_host, p.udp_port))
            if self._serial is not None:
                os.write(self._serial, text)
        except OSError as error:
            # A cable that is out is no reason to stop; a full line drops this round, the next is newer.
            self.get_logger().warning(f'NMEA: {error}', throttle_duration_sec=5.0)
