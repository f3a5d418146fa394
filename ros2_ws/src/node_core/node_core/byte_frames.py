# SPDX-License-Identifier: Apache-2.0
"""Cuts a byte stream into messages of the protocols that GNSS receivers mix on one port.

Sources: u-blox interface descriptions, "UBX frame structure"; IEC 61162-1 section 7; RTCM 10403.3 section 4.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

_NO_MESSAGE = -1
_MORE = 0


class Protocol(NamedTuple):
    """How messages begin, how long they are and whether they are whole.

    `length(data, start)` returns the length of the message at `start`, 0 while it cannot be told yet, -1 if
    there is none.
    """

    sync: bytes
    length: Callable[[bytes, int], int]
    whole: Callable[[bytes], bool]


# Payloads beyond 255 measurements of RXM-RAWX do not occur: such a length is not that of a message.
_UBX_LONGEST = 16 + 32 * 255
# IEC 61162-1 allows 82 characters; makers' sentences are longer.
_NMEA_LONGEST = 255


def _ubx_length(data: bytes, start: int) -> int:
    if len(data) < start + 6:
        return _MORE
    payload = int.from_bytes(data[start + 4 : start + 6], 'little')
    return payload + 8 if payload <= _UBX_LONGEST else _NO_MESSAGE


def _ubx_whole(message: bytes) -> bool:
    values = np.frombuffer(message[2:-2], dtype=np.uint8).astype(np.int64)
    second = int(values @ np.arange(len(values), 0, -1))
    return bytes((int(values.sum()) & 0xFF, second & 0xFF)) == message[-2:]


def _nmea_length(data: bytes, start: int) -> int:
    end = data.find(b'\n', start, start + _NMEA_LONGEST)
    # A sentence that lost its end must not take the next one with it.
    again = data.find(b'$', start + 1, end if end >= 0 else start + _NMEA_LONGEST)
    if again >= 0:
        return _NO_MESSAGE
    if end < 0:
        return _MORE if len(data) < start + _NMEA_LONGEST else _NO_MESSAGE
    return end + 1 - start


def _nmea_whole(message: bytes) -> bool:
    body, star, digits = message[1:].rstrip(b'\r\n').rpartition(b'*')
    if not star or len(digits) != 2:
        return False
    checksum = 0
    for byte in body:
        checksum ^= byte
    return digits.upper() == b'%02X' % checksum


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        crc = value << 16
        for _ in range(8):
            crc = crc << 1 ^ (0x1864CFB if crc & 0x800000 else 0)
        table.append(crc & 0xFFFFFF)
    return tuple(table)


_CRC = _crc_table()


def crc24q(data: bytes) -> int:
    """Return the CRC of RTCM 10403.3 (Qualcomm's 24 bits); 0 for data with their right CRC behind."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFFFF) ^ _CRC[crc >> 16 ^ byte]
    return crc


def _rtcm_length(data: bytes, start: int) -> int:
    if len(data) < start + 3:
        return _MORE
    if data[start + 1] & 0xFC:
        return _NO_MESSAGE  # the six reserved bits are 0
    return (data[start + 1] << 8 | data[start + 2]) + 6


UBX = Protocol(b'\xb5\x62', _ubx_length, _ubx_whole)
NMEA = Protocol(b'$', _nmea_length, _nmea_whole)
RTCM = Protocol(b'\xd3', _rtcm_length, lambda message: crc24q(message) == 0)


class MessageCutter:
    """Cuts a stream into whole messages with a right checksum; `rejected` counts what is none.

    After a bad message the search goes on inside it, so that a false start costs no true message; and a start
    that waits for the rest of its bytes gives way to a whole message among those that came. `arrival` is that
    of the first byte of the message yielded last.
    """

    def __init__(self, rejected: Counter[str], *protocols: Protocol) -> None:
        self.arrival = 0
        self._buffer = b''
        self._pieces: list[tuple[int, int]] = []  # where in the buffer a piece begins, its arrival
        self._rejected = rejected
        self._protocols = protocols

    def clear(self) -> None:
        """Forget the bytes held: what follows comes from a source that was opened anew."""
        self._buffer, self._pieces = b'', []

    def feed(self, data: bytes, arrival: int = 0) -> Iterator[bytes]:
        """Yield the messages that `data`, which came at `arrival`, completes."""
        pieces = [*self._pieces, (len(self._buffer), arrival)]
        view, position = self._buffer + data, 0
        while True:
            start, protocol = self._next(view, position)
            if protocol is None:
                position = start
                break
            length = protocol.length(view, start)
            if length == _MORE or len(view) < start + length:
                inside = self._whole_after(view, start + len(protocol.sync))
                if inside < 0:
                    position = start
                    break
                self._rejected['no message'] += 1
                position = inside
                continue
            if length == _NO_MESSAGE:
                self._rejected['no message'] += 1
                position = start + len(protocol.sync)
                continue
            message = view[start : start + length]
            if protocol.whole(message):
                self.arrival = pieces[_piece_of(pieces, start)][1]
                yield message
                position = start + length
            else:
                self._rejected['checksum'] += 1
                position = start + len(protocol.sync)
        self._buffer = view[position:]
        kept = pieces[_piece_of(pieces, position) :]
        self._pieces = [(max(at - position, 0), came) for at, came in kept]

    def _whole_after(self, view: bytes, position: int) -> int:
        """Return where the first whole message from `position` on begins, -1 without one."""
        while True:
            start, protocol = self._next(view, position)
            if protocol is None:
                return -1
            length = protocol.length(view, start)
            if length > 0 and len(view) >= start + length and protocol.whole(view[start : start + length]):
                return start
            position = start + len(protocol.sync)

    def _next(self, view: bytes, position: int) -> tuple[int, Protocol | None]:
        """Return the first sync and its protocol; without one, from where bytes may still become a sync."""
        found = [(at, p) for p in self._protocols if (at := view.find(p.sync, position)) >= 0]
        # A sync of two bytes may be half there.
        half = len(view) - any(
            len(p.sync) > 1 and view[position:].endswith(p.sync[:1]) for p in self._protocols
        )
        return min(found, key=lambda pair: pair[0]) if found else (half, None)


def _piece_of(pieces: list[tuple[int, int]], position: int) -> int:
    """Return the index of the piece that the byte at `position` belongs to."""
    return bisect_right(pieces, position, key=lambda piece: piece[0]) - 1
