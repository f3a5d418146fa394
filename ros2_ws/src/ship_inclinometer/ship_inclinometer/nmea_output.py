# SPDX-License-Identifier: Apache-2.0
"""Where sentences go: a datagram per round over UDP, and a serial line that is never behind. No ROS.

A line slower than what is to be said would otherwise fill the system's buffer, and a display at its end
would show the heel of seconds ago. So a sentence goes out only when the line is free, and while it waits
a newer one of its kind takes its place; each kind gets its turn. Faults are told, never raised.
"""

from __future__ import annotations

import fcntl
import ipaddress
import os
import socket
import struct
import termios
import threading
import time
from collections.abc import Callable, Sequence

from ship_inclinometer.modbus_server import configure

# Start bit, eight data bits, stop bit (IEC 61162-1, section 5.3).
_BITS_PER_CHARACTER = 10
# A sentence goes out while less than that lies in the system's buffer (s): the time between two rounds.
_AHEAD = 0.1
# How often a lost line, or a name that was not found, is tried again (s).
_RETRY = 1.0
# Replies and alerts that wait are as many as that: no kind supersedes them, and a dead line takes none.
_LARGEST_QUEUE = 60
# What the newest supersedes: measurements. Alerts and answers tell of changes, each counts.
_SUPERSEDED = ('HRM', 'XDR', 'ROT', 'THS', 'HDT')


class SerialOutput:
    """A serial line for sentences; `connect` opens it, `send` opens it again when it has vanished."""

    def __init__(self, path: str, baudrate: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._path = path
        self._baudrate = baudrate
        self._rate = baudrate / _BITS_PER_CHARACTER
        self._clock = clock
        self._file: int | None = None
        self._retry_at = 0.0
        self._free_at = 0.0
        # By kind, in order of their turn; the rest of a sentence that is out in part comes before all.
        self._waiting: dict[str, bytes] = {}
        self._rest = b''
        self._count = 0
        self.fault = ''
        self.sent = 0
        self.dropped = 0
        self.reopened = 0

    def connect(self) -> None:
        """Open the line; raises OSError or termios.error, KeyError for a rate that no line has."""
        file = os.open(self._path, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            configure(file, self._baudrate, 'N', stop_bits=1)
        except (KeyError, termios.error):
            os.close(file)
            raise
        self._file = file
        self._free_at = self._clock()
        self.fault = ''

    def close(self) -> None:
        """Close the line."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        self._waiting.clear()
        self._rest = b''

    def send(self, sentences: Sequence[str]) -> None:
        """Send what the line takes now; the rest waits for the next call, or for a newer one of its kind."""
        if self._file is None and not self._reopen():
            return
        self._queue(sentences)
        try:
            while (self._rest or self._waiting) and self._write_next():
                pass
        except OSError as error:
            self.close()
            self.fault = f'{self._path}: {error}'
            self._retry_at = self._clock() + _RETRY

    def _reopen(self) -> bool:
        if self._clock() < self._retry_at:
            return False
        try:
            self.connect()
        except (OSError, termios.error) as error:
            self.fault = f'{self._path}: {error}'
            self._retry_at = self._clock() + _RETRY
            return False
        self.reopened += 1
        return True

    def _queue(self, sentences: Sequence[str]) -> None:
        news: dict[str, bytes] = {}
        for sentence in sentences:
            kind = sentence[3:6]
            if kind not in _SUPERSEDED:
                self._count += 1
                kind = f'{kind} {self._count}'
            news[kind] = sentence.encode('ascii')
        # What the new round does not hold any more is not true any more: a heading that became invalid.
        old = [kind for kind in self._waiting if kind in _SUPERSEDED]
        self.dropped += len(old)
        for kind in old:
            if kind not in news:
                del self._waiting[kind]
        self._waiting |= news
        while len(self._waiting) > _LARGEST_QUEUE:
            del self._waiting[next(iter(self._waiting))]
            self.dropped += 1

    def _write_next(self) -> bool:
        """Write the next sentence if the line is free; return whether to go on."""
        assert self._file is not None
        kind = '' if self._rest else next(iter(self._waiting))
        data = self._rest or self._waiting[kind]
        now = self._clock()
        behind = max(self._free_at - now, self._unsent() / self._rate)
        if behind > _AHEAD:
            return False
        try:
            written = os.write(self._file, data)
        except BlockingIOError:
            return False
        self._free_at = max(self._free_at, now) + written / self._rate
        self._waiting.pop(kind, None)
        self._rest = data[written:]
        self.sent += not self._rest
        return not self._rest

    def _unsent(self) -> int:
        """Return how many bytes the system still holds, 0 where it does not know."""
        assert self._file is not None
        try:
            (count,) = struct.unpack('i', fcntl.ioctl(self._file, termios.TIOCOUTQ, b'\0' * 4))
        except OSError:
            # A line that has vanished: writing will tell.
            return 0
        return int(count)


class UdpOutput:
    """Datagrams to one receiver, unicast or broadcast; a name is looked up beside, without waiting."""

    def __init__(self, host: str, port: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._host, self._port = host, port
        self._clock = clock
        self._address = host if _is_address(host) else ''
        self._look_up_at = 0.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)
        self.fault = ''
        self.sent = 0
        self.failed = 0

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, sentences: Sequence[str]) -> None:
        """Send one datagram."""
        if not self._address:
            self._find()
            return
        try:
            self._socket.sendto(''.join(sentences).encode('ascii'), (self._address, self._port))
        except OSError as error:
            self.failed += 1
            self.fault = f'{self._host}: {error}'
        else:
            self.sent += 1
            self.fault = ''

    def _find(self) -> None:
        """Ask for the address in a thread: without a network the system takes many seconds to say no."""
        if self._clock() < self._look_up_at:
            return
        self._look_up_at = float('inf')
        threading.Thread(target=self._look_up, daemon=True).start()

    def _look_up(self) -> None:
        try:
            found = socket.getaddrinfo(self._host, self._port, socket.AF_INET, socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            self.fault = f'{self._host}: {error}'
            self._look_up_at = self._clock() + _RETRY
        else:
            self._address = str(found[0][4][0])


def _is_address(host: str) -> bool:
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        return False
    return True
