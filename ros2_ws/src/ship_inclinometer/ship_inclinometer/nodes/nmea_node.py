# SPDX-License-Identifier: Apache-2.0
"""The node that sends NMEA 0183 over UDP and a serial line."""

from __future__ import annotations

import os
import socket
import termios
from typing import Any

from kalman_core.parameters import ParameterError
from node_core.messages import stamp_of
from node_core.node import WorkspaceNode
from node_core.ports import BadMessage
from ship_inclinometer import topics
from ship_inclinometer.attitude_estimator import angles_of
from ship_inclinometer.bridge_params import NmeaParams
from ship_inclinometer.codec import IMU, VALUES, decode_attitude, decode_numbers, decode_validity
from ship_inclinometer.marine import Picture
from ship_inclinometer.modbus_server import configure
from ship_inclinometer.nmea import all_sentences


class NmeaNode(WorkspaceNode):
    """Sends one round of sentences at the set rate, also while nothing valid is known."""

    def __init__(self) -> None:
        super().__init__('nmea_bridge', NmeaParams)
        self._params: NmeaParams = self.parameters[NmeaParams]
        self._picture = Picture()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)
        self._serial = self._open_serial()
        self.listen(IMU, topics.ATTITUDE, self._on_attitude)
        self.listen(VALUES, topics.VALIDITY, self._on_validity, latched=True)
        self.listen(VALUES, topics.ROLL, self._on_roll)
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

    def _on_attitude(self, message: Any) -> None:
        self._guarded(topics.ATTITUDE, lambda: self._picture.take_angles(angles_of(decode_attitude(message))))

    def _on_validity(self, message: Any) -> None:
        def take() -> None:
            validity = decode_validity(message)
            self._picture.validity, self._picture.reason = validity.validity, validity.reason
            self._picture.heading_valid = validity.heading_valid

        self._guarded(topics.VALIDITY, take)

    def _on_roll(self, message: Any) -> None:
        take = self._picture.take_roll
        self._guarded(topics.ROLL, lambda: take(stamp_of(message), decode_numbers(message)))

    def _guarded(self, topic: str, take: Any) -> None:
        try:
            take()
        except BadMessage as error:
            self.get_logger().warning(f'{topic}: {error}', throttle_duration_sec=5.0)

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
