# SPDX-License-Identifier: Apache-2.0
"""Modbus over TCP and over a serial line, on asyncio.

Both answer requests in order, one after the other, and say nothing to a foreign unit or to a broadcast
(whose writes are carried out under the same lock as any).
"""

from __future__ import annotations

import asyncio
import ipaddress
import os
import socket
import termios
from collections.abc import Callable

from ship_inclinometer.modbus_device import ModbusDevice
from ship_inclinometer.modbus_frames import (
    BROADCAST,
    LONGEST_RTU,
    FramingLostError,
    add_crc,
    silence,
    split_rtu,
    split_tcp,
)

# On TCP the unit identifier of a device that is no gateway (implementation guide, section 4.4.1.2).
_DIRECT = 0xFF
# Bytes of an unfinished frame are forgotten after this pause (s). On the serial line it is longer than the
# 3.5 characters of the specification: USB adapters deliver a frame in pieces.
_TCP_PAUSE = 1.0
_RTU_PAUSE = 0.05
# Silence (s) after which the system asks whether a TCP peer is still there, and pause between three probes.
_KEEP_ALIVE = 10
# A master may be that many requests ahead before the connection is no longer read.
_LARGEST_BACKLOG = 64 * 260
_BAUDS = {9600: termios.B9600, 19200: termios.B19200, 38400: termios.B38400, 57600: termios.B57600}
_BAUDS |= {1200: termios.B1200, 2400: termios.B2400, 4800: termios.B4800, 115200: termios.B115200}


async def answer(device: ModbusDevice, unit: int, pdu: bytes, who: str, direct: bool) -> bytes | None:
    """Return the reply PDU of `device`, None where it keeps silent."""
    if unit == BROADCAST:
        if pdu and pdu[0] in (5, 6, 15, 16, 22):
            await device.respond(pdu, f'{who} broadcast')
        return None
    if unit == device.unit or (direct and unit == _DIRECT):
        return await device.respond(pdu, who)
    return None


class TcpServer:
    """Modbus TCP for the networks in `allowed` (addresses or CIDR)."""

    def __init__(
        self,
        device: ModbusDevice,
        host: str,
        port: int,
        allowed: list[str],
        on_refused: Callable[[str], None] = lambda _peer: None,
        max_connections: int = 16,
    ) -> None:
        self._device = device
        self._host, self._port = host, port
        self._allowed = [ipaddress.ip_network(a, strict=False) for a in allowed]
        self._on_refused = on_refused
        self._max_connections = max_connections
        # In order of the last request, longest silent first.
        self._connections: dict[asyncio.StreamWriter, None] = {}
        self._server: asyncio.Server | None = None

    @property
    def port(self) -> int:
        """The port listened on, also when 0 was asked for."""
        assert self._server is not None
        return int(self._server.sockets[0].getsockname()[1])

    async def start(self) -> None:
        """Listen; raises OSError when the address is taken."""
        self._server = await asyncio.start_server(self._serve, self._host, self._port, limit=_LARGEST_BACKLOG)

    async def stop(self) -> None:
        """Close the listener and all connections."""
        if self._server is not None:
            self._server.close()
        for writer in list(self._connections):
            writer.close()

    def _may_talk(self, peer: str) -> bool:
        try:
            address = ipaddress.ip_address(peer.split('%')[0])
        except ValueError:
            return False
        mapped = getattr(address, 'ipv4_mapped', None)
        return any((mapped or address) in network for network in self._allowed)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = writer.get_extra_info('peername')
        host = peer[0] if peer else ''
        if not self._may_talk(host):
            self._on_refused(host)
            writer.close()
            return
        self._make_room()
        _keep_alive(writer)
        self._touch(writer)
        try:
            await self._talk(reader, writer, f'tcp {host}:{peer[1]}')
        except (OSError, FramingLostError):
            # The peer has gone, or has lost the framing: both end the connection and nothing else.
            pass
        finally:
            self._connections.pop(writer, None)
            writer.close()

    def _touch(self, writer: asyncio.StreamWriter) -> None:
        self._connections.pop(writer, None)
        self._connections[writer] = None

    def _make_room(self) -> None:
        """Hang up on the connection that was silent longest (implementation guide, section 4.2.1.3).

        Masters that vanished without a word would otherwise lock all others out.
        """
        while len(self._connections) >= self._max_connections:
            oldest = next(iter(self._connections))
            del self._connections[oldest]
            oldest.transport.abort()

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, who: str) -> None:
        buffer = b''
        while True:
            try:
                chunk = await asyncio.wait_for(reader.read(4096), _TCP_PAUSE if buffer else None)
            except TimeoutError as error:
                if error.errno is not None:
                    # The system's probes stayed unanswered; every further read would fail alike.
                    raise
                buffer = b''
                continue
            if not chunk:
                return
            if writer not in self._connections:
                return
            self._touch(writer)
            requests, used = split_tcp(buffer + chunk)
            buffer = (buffer + chunk)[used:]
            for request in requests:
                reply = await answer(self._device, request.unit, request.pdu, who, direct=True)
                if reply is not None:
                    writer.write(request.reply(reply))
            await writer.drain()


def _keep_alive(writer: asyncio.StreamWriter) -> None:
    """Have the system probe a silent peer: one that lost its power never says goodbye."""
    connection = writer.get_extra_info('socket')
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _KEEP_ALIVE)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, _KEEP_ALIVE)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)


class RtuServer:
    """Modbus RTU on a serial line or pseudo-terminal; opens it again when it vanishes."""

    def __init__(
        self, device: ModbusDevice, path: str, baudrate: int = 19200, parity: str = 'E', echo: bool = False
    ) -> None:
        if baudrate not in _BAUDS:
            listed = ', '.join(map(str, sorted(_BAUDS)))
            raise ValueError(f"parameter 'baudrate' is {baudrate}, allowed: {listed}")
        self._device = device
        self._path = path
        self._baudrate = baudrate
        self._parity = parity
        self._echo = echo
        self._silence = silence(baudrate)
        self._file: int | None = None
        self._buffer = b''
        self._last = 0.0
        self._expected_echo = b''
        self._timer: asyncio.TimerHandle | None = None
        self._requests: asyncio.Queue = asyncio.Queue()
        self._worker: asyncio.Task | None = None
        self._stopped = False

    async def start(self) -> None:
        """Open the line; raises OSError or termios.error when it cannot be."""
        self._open()
        self._worker = asyncio.create_task(self._work())

    async def stop(self) -> None:
        """Close the line."""
        self._stopped = True
        self._close()
        if self._worker is not None:
            self._worker.cancel()

    def _open(self) -> None:
        file = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            configure(file, self._baudrate, self._parity)
        except termios.error:
            os.close(file)
            raise
        self._file = file
        asyncio.get_running_loop().add_reader(file, self._readable)

    def _close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._file is not None:
            asyncio.get_running_loop().remove_reader(self._file)
            os.close(self._file)
            self._file = None
        self._buffer = self._expected_echo = b''

    def _lost(self) -> None:
        """The line has gone (adapter unplugged): try once a second to open it again."""
        self._close()
        if not self._stopped:
            asyncio.get_running_loop().call_later(1.0, self._reopen)

    def _reopen(self) -> None:
        if self._stopped:
            return
        try:
            self._open()
        except (OSError, termios.error):
            asyncio.get_running_loop().call_later(1.0, self._reopen)

    def _readable(self) -> None:
        assert self._file is not None
        try:
            chunk = os.read(self._file, 4096)
        except BlockingIOError:
            return
        except OSError:
            self._lost()
            return
        if not chunk:
            self._lost()
            return
        loop = asyncio.get_running_loop()
        now = loop.time()
        if now - self._last > _RTU_PAUSE + self._silence:
            self._buffer = b''
        self._last = now
        self._buffer = (self._buffer + chunk)[-16 * LONGEST_RTU :]
        if self._timer is not None:
            self._timer.cancel()
        self._timer = loop.call_later(self._silence, self._silent)

    def _silent(self) -> None:
        """The line has fallen silent: what is there are frames, or will be noise."""
        data = self._buffer
        if self._expected_echo and data.startswith(self._expected_echo):
            data = data[len(self._expected_echo) :]
        self._expected_echo = b''
        requests, done = split_rtu(data, self._device.unit)
        self._buffer = data[done:]
        for request in requests:
            self._requests.put_nowait(request)

    async def _work(self) -> None:
        while True:
            request = await self._requests.get()
            reply = await answer(self._device, request.unit, request.pdu, f'rtu {self._path}', direct=False)
            if reply is not None:
                await self._send(add_crc(bytes([self._device.unit]) + reply))

    async def _send(self, frame: bytes) -> None:
        if self._echo:
            self._expected_echo = frame
        while frame and self._file is not None:
            try:
                frame = frame[os.write(self._file, frame) :]
            except BlockingIOError:
                await asyncio.sleep(self._silence)
            except OSError:
                self._lost()
                return


def configure(file: int, baudrate: int, parity: str, stop_bits: int | None = None) -> None:
    """Set a terminal to raw bytes at `baudrate`, 8 bits, `parity` 'N', 'E' or 'O'.

    Without `stop_bits` a character has eleven bits, as Modbus wants it: two stop bits if there is no parity.
    Raises KeyError for a rate that no line has, termios.error for what is no line.
    """
    attributes = termios.tcgetattr(file)
    control = termios.CS8 | termios.CREAD | termios.CLOCAL
    if parity != 'N':
        control |= termios.PARENB | (termios.PARODD if parity == 'O' else 0)
    if (stop_bits or (2 if parity == 'N' else 1)) == 2:
        control |= termios.CSTOPB
    attributes[0] = termios.INPCK if parity != 'N' else 0
    attributes[1] = 0
    attributes[2] = control
    attributes[3] = 0
    attributes[4] = attributes[5] = _BAUDS[baudrate]
    attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
    termios.tcsetattr(file, termios.TCSANOW, attributes)
    termios.tcflush(file, termios.TCIOFLUSH)
