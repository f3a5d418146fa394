# SPDX-License-Identifier: Apache-2.0
"""Where a device's bytes come from: a file, a serial port, a TCP server or an NTRIP caster.

The source's name says which: ``tcp://HOST:PORT``, ``ntrip://[USER:PASSWORD@]HOST[:PORT]/MOUNTPOINT``,
``/dev/...`` or ``COMn``, else the path of a file. A path that is a character device counts as a port.
"""

from __future__ import annotations

import base64
import os
import re
import socket
import stat
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar
from urllib.parse import unquote, urlsplit

import serial

_SILENCE = 0.2  # s, how long a read of a silent source keeps its thread
_CONNECT = 3.0  # s
_CHUNK = 16_384  # bytes
_SERIAL_NAME = re.compile(r'/dev/|COM\d+$', re.IGNORECASE)
_NTRIP_PORT = 2101
_LONGEST_HEAD = 8192  # bytes of a caster's answer before its data
# A peer that vanished without a word is noticed after 5 + 3 · 2 s: as long as receivers may be silent.
_KEEPALIVE = (('TCP_KEEPIDLE', 5), ('TCP_KEEPINTVL', 2), ('TCP_KEEPCNT', 3))  # s, s, probes

Item = TypeVar('Item', covariant=True)


class SourceError(Exception):
    """A source cannot be opened or was lost; the text says which and why."""


class Source(Protocol[Item]):
    """Something that gives items one after the other."""

    def read(self) -> Item | None:
        """Return what has come, empty if nothing, None at the end; SourceError when it is lost."""

    def close(self) -> None:
        """Let go."""


class FileBytes:
    """A recorded file."""

    def __init__(self, path: str) -> None:
        try:
            self._file = Path(path).open('rb')  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise SourceError(f'{path}: cannot be read ({error.strerror})') from None
        self._path = path

    def read(self) -> bytes | None:
        """Return the next piece, None at the end."""
        try:
            return self._file.read(_CHUNK) or None
        except OSError as error:
            raise SourceError(f'{self._path}: cannot be read ({error.strerror})') from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class SerialBytes:
    """A serial port, held exclusively: two readers would each get half of the bytes."""

    def __init__(self, port: str, baud: int) -> None:
        self._name = port
        try:
            self._port = serial.Serial(port, baud, timeout=_SILENCE, exclusive=True)
        except (serial.SerialException, ValueError, OSError) as error:
            number = getattr(error, 'errno', None)
            raise SourceError(f'{port}: {os.strerror(number) if number else error}') from None

    def read(self) -> bytes | None:
        """Return what has come, as soon as something has."""
        try:
            return self._port.read(max(1, self._port.in_waiting))
        except (serial.SerialException, OSError, TypeError) as error:
            raise SourceError(f'{self._name}: lost ({error})') from None

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class TcpBytes:
    """A TCP server that sends the device's bytes."""

    def __init__(self, source: str) -> None:
        self._name = source
        self._socket = _connect(source, *tcp_address(source))
        self._socket.settimeout(_SILENCE)

    def read(self) -> bytes | None:
        """Return what has come."""
        return _receive(self._socket, self._name)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class Caster(NamedTuple):
    """An NTRIP stream; `login` is USER:PASSWORD or empty."""

    host: str
    port: int
    mountpoint: str
    login: str

    @property
    def name(self) -> str:
        """What may be said on a terminal: without the password."""
        return f'ntrip://{self.host}:{self.port}/{self.mountpoint}'


class NtripBytes:
    """A stream of an NTRIP caster, version 1 or 2 without chunks, with basic authentication.

    Source: RTCM 10410.1, sections 2 and 5. Casters of virtual stations, which want the rover's position as
    GGA, are not served.
    """

    def __init__(self, source: str) -> None:
        caster = ntrip_address(source)
        self._name = caster.name
        self._socket = _connect(self._name, caster.host, caster.port)
        try:
            self._rest = self._request(caster)
        except BaseException:
            self._socket.close()
            raise
        self._socket.settimeout(_SILENCE)

    def _request(self, caster: Caster) -> bytes:
        lines = [
            f'GET /{caster.mountpoint} HTTP/1.0',
            f'Host: {caster.host}',
            'User-Agent: NTRIP ros2-driver/1',
        ]
        if caster.login:
            lines.append(f'Authorization: Basic {base64.b64encode(caster.login.encode()).decode()}')
        self._socket.settimeout(_CONNECT)
        answer = b''
        try:
            self._socket.sendall('\r\n'.join([*lines, '', '']).encode())
            # "ICY 200 OK" of version 1 may have no empty line after it.
            while b'\r\n\r\n' not in answer and not answer.startswith(b'ICY 200 OK\r\n'):
                data = self._socket.recv(_CHUNK)
                if not data or len(answer) > _LONGEST_HEAD:
                    break
                answer += data
        except OSError as error:
            raise SourceError(f'{self._name}: {error}') from None
        first, _, rest = answer.partition(b'\r\n')
        said = first.decode(errors='replace')[:80]
        if answer.startswith(b'SOURCETABLE'):
            raise SourceError(f'{self._name}: the caster has no such mountpoint')
        if not re.match(r'(ICY|HTTP/1\.[01]) 200\b', said):
            raise SourceError(f'{self._name}: the caster answered {said!r}')
        if said.startswith('ICY'):
            return rest.removeprefix(b'\r\n')
        return rest.partition(b'\r\n\r\n')[2]

    def read(self) -> bytes | None:
        """Return what has come."""
        if self._rest:
            rest, self._rest = self._rest, b''
            return rest
        return _receive(self._socket, self._name)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def _connect(name: str, host: str, port: int) -> socket.socket:
    try:
        connection = socket.create_connection((host, port), timeout=_CONNECT)
    except OSError as error:
        raise SourceError(f'{name}: {error.strerror or error}') from None
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        if hasattr(socket, option):  # not on every system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
    return connection


def _receive(connection: socket.socket, name: str) -> bytes:
    try:
        data = connection.recv(_CHUNK)
    except TimeoutError:
        return b''
    except OSError as error:
        raise SourceError(f'{name}: lost ({error.strerror or error})') from None
    if not data:
        raise SourceError(f'{name}: closed by the server')
    return data


def tcp_address(source: str) -> tuple[str, int]:
    """Return host and port of ``tcp://HOST:PORT``; SourceError for another form."""
    match = re.fullmatch(r'tcp://(\[[^\]]+\]|[^:/]+):(\d{1,5})', source)
    if match is None or int(match[2]) > 65_535:
        raise SourceError(f'{source}: expected tcp://HOST:PORT')
    return match[1].strip('[]'), int(match[2])


def ntrip_address(source: str) -> Caster:
    """Return the parts of an NTRIP address; SourceError for another form than the module says."""
    try:
        parts = urlsplit(source)
        port, mountpoint = parts.port or _NTRIP_PORT, parts.path.strip('/')
    except ValueError:
        port, mountpoint = 0, ''
    if not port or not mountpoint or not parts.hostname or not re.fullmatch(r'[\w.~-]+', mountpoint):
        # Not the source itself: it may hold a password.
        raise SourceError('expected ntrip://[USER:PASSWORD@]HOST[:PORT]/MOUNTPOINT')
    login = f'{unquote(parts.username)}:{unquote(parts.password or "")}' if parts.username else ''
    return Caster(parts.hostname, port, mountpoint, login)


def public_name(source: str) -> str:
    """Return the source's name without a password; SourceError when an address is malformed."""
    if source.startswith('ntrip://'):
        return ntrip_address(source).name
    if source.startswith('tcp://'):
        tcp_address(source)
    return source


def is_recorded(source: str) -> bool:
    """Return whether the name is that of a file rather than of a serial port or a server."""
    if source.startswith(('tcp://', 'ntrip://')) or _SERIAL_NAME.match(source):
        return False
    try:
        return not stat.S_ISCHR(os.stat(source).st_mode)
    except (OSError, ValueError):
        return True


def open_source(source: str, baud: int, recorded: bool) -> Source[bytes]:
    """Open a source by its name, with what `is_recorded` said of it at first; SourceError if it cannot be.

    A link to a port that is unplugged would look like a missing file.
    """
    if source.startswith('tcp://'):
        return TcpBytes(source)
    if source.startswith('ntrip://'):
        return NtripBytes(source)
    return FileBytes(source) if recorded else SerialBytes(source, baud)
