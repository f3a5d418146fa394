# SPDX-License-Identifier: Apache-2.0
"""Where GPS bytes come from: a serial port, a TCP server, or a file."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Protocol

import serial

TIMEOUT = 0.2  # s, after which a silent source gives the thread a chance to stop
CHUNK = 4096


class SourceError(Exception):
    """A source cannot be opened or was lost; the text says which and why."""


class Source(Protocol):
    """Bytes from somewhere: b'' means none within the timeout, None the end."""

    def read(self) -> bytes | None:
        """Return what has come."""

    def close(self) -> None:
        """Let go."""


class SerialSource:
    """A serial port."""

    def __init__(self, port: str, baud: int) -> None:
        try:
            self._port = serial.Serial(port, baud, timeout=TIMEOUT)
        except (serial.SerialException, ValueError, OSError) as error:
            raise SourceError(f'{port}: {error}') from None
        self._name = port

    def read(self) -> bytes | None:
        """Return what has come; raises SourceError when the port is gone."""
        try:
            return self._port.read(max(1, self._port.in_waiting))
        except (serial.SerialException, OSError, TypeError) as error:
            raise SourceError(f'{self._name}: lost ({error})') from None

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class TcpSource:
    """A TCP server that sends the receiver's bytes."""

    def __init__(self, address: str) -> None:
        self._name = address
        host, _, port = address.removeprefix('tcp://').rpartition(':')
        if not host or not port.isdigit():
            raise SourceError(f'{address}: expected tcp://HOST:PORT')
        try:
            self._socket = socket.create_connection((host.strip('[]'), int(port)), timeout=2.0)
        except (OSError, OverflowError) as error:
            raise SourceError(f'{address}: {error}') from None
        self._socket.settimeout(TIMEOUT)

    def read(self) -> bytes | None:
        """Return what has come; raises SourceError when the server hangs up."""
        try:
            data = self._socket.recv(CHUNK)
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


class FileSource:
    """A recorded file."""

    def __init__(self, path: str) -> None:
        try:
            self._file = Path(path).open('rb')  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise SourceError(f'{path}: {error.strerror}') from None

    def read(self) -> bytes | None:
        """Return the next piece, None at the end."""
        return self._file.read(CHUNK) or None

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def open_source(source: str, baud: int) -> Source:
    """Open a source by its name; raises SourceError."""
    if source.startswith('tcp://'):
        return TcpSource(source)
    if Path(source).is_file():
        return FileSource(source)
    return SerialSource(source, baud)
