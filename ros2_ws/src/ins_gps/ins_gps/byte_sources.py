# SPDX-License-Identifier: Apache-2.0
"""Where a receiver's bytes come from: a file, a serial port or a TCP server."""

from __future__ import annotations

import re
import socket
from pathlib import Path
from typing import Protocol

import serial

# A read gathers what comes within this time: few wake-ups, and little beside the age of an epoch.
_GATHER = 0.02  # s
_SILENCE = 0.2  # s, how long a read of a silent server keeps its thread
_CONNECT = 3.0  # s
_CHUNK = 16_384  # bytes
_SERIAL_NAME = re.compile(r'/dev/|COM\d+$', re.IGNORECASE)


class SourceError(Exception):
    """A source cannot be opened or was lost; the text says which and why."""


class ByteSource(Protocol):
    """Bytes from somewhere."""

    def read(self) -> bytes | None:
        """Return what has come, b'' if nothing, None at the end; SourceError when it is lost."""

    def close(self) -> None:
        """Let go."""


class FileBytes:
    """A recorded file."""

    def __init__(self, path: str) -> None:
        try:
            self._file = Path(path).open('rb')  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise SourceError(f'{path}: cannot be read ({error.strerror})') from None

    def read(self) -> bytes | None:
        """Return the next piece, None at the end."""
        return self._file.read(_CHUNK) or None

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class SerialBytes:
    """A serial port."""

    def __init__(self, port: str, baud: int) -> None:
        self._name = port
        try:
            self._port = serial.Serial(port, baud, timeout=_GATHER)
        except (serial.SerialException, ValueError, OSError) as error:
            raise SourceError(f'{port}: {error}') from None

    def read(self) -> bytes | None:
        """Return what came within the gathering time."""
        try:
            return self._port.read(_CHUNK)
        except (serial.SerialException, OSError, TypeError) as error:
            raise SourceError(f'{self._name}: lost ({error})') from None

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class TcpBytes:
    """A TCP server that sends the receiver's bytes."""

    def __init__(self, source: str) -> None:
        self._name = source
        host, port = tcp_address(source)
        try:
            self._socket = socket.create_connection((host, port), timeout=_CONNECT)
        except OSError as error:
            raise SourceError(f'{source}: {error}') from None
        self._socket.settimeout(_SILENCE)

    def read(self) -> bytes | None:
        """Return what has come."""
        try:
            data = self._socket.recv(_CHUNK)
        except TimeoutError:
            return b''
        except OSError as error:
            raise SourceError(f'{self._name}: lost ({error})') from None
        if not data:
            raise SourceError(f'{self._name}: closed by the server')
        return data

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def tcp_address(source: str) -> tuple[str, int]:
    """Return host and port of ``tcp://HOST:PORT``; SourceError for another form."""
    match = re.fullmatch(r'tcp://(\[[^\]]+\]|[^:/]+):(\d{1,5})', source)
    if match is None or int(match[2]) > 65_535:
        raise SourceError(f'{source}: expected tcp://HOST:PORT')
    return match[1].strip('[]'), int(match[2])


def is_recorded(source: str) -> bool:
    """Return whether the name is that of a file rather than of a serial port or a server."""
    return not source.startswith('tcp://') and _SERIAL_NAME.match(source) is None


def open_source(source: str, baud: int) -> ByteSource:
    """Open a source by its name: ``tcp://HOST:PORT``, ``/dev/...`` or ``COMn``, else a file."""
    if source.startswith('tcp://'):
        return TcpBytes(source)
    return FileBytes(source) if is_recorded(source) else SerialBytes(source, baud)
