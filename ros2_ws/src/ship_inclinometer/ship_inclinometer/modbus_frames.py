# SPDX-License-Identifier: Apache-2.0
"""Modbus frames from bytes: RTU with resynchronisation, and the MBAP header of TCP. Pure, no I/O.

Source: "MODBUS over Serial Line Specification and Implementation Guide V1.02", section 2.5, and "MODBUS
Messaging on TCP/IP Implementation Guide V1.0b", section 3.1.3.

What the stock framer does not do and this one does: after noise, a truncated frame or the reply of another
device on the bus, the next request is found even when it follows without a pause.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from pymodbus.framer.rtu import FramerRTU

LONGEST_RTU = 256
LONGEST_PDU = 253
BROADCAST = 0
_FIXED_REQUESTS = {1: 8, 2: 8, 3: 8, 4: 8, 5: 8, 6: 8, 7: 4, 8: 8, 11: 4, 12: 4, 17: 4, 22: 10, 24: 6}
# Position of the byte count and what a request holds beside its data.
_COUNTED_REQUESTS = {15: (6, 9), 16: (6, 9), 23: (10, 13), 20: (2, 5), 21: (2, 5)}
_FIXED_REPLIES = {5: 8, 6: 8, 7: 5, 8: 8, 11: 8, 15: 8, 16: 8, 22: 10}
_COUNTED_REPLIES = (1, 2, 3, 4, 12, 17, 20, 21, 23)


class Request(NamedTuple):
    """A request to this unit or to all."""

    unit: int
    pdu: bytes


def add_crc(frame: bytes) -> bytes:
    """Return `frame` with its CRC-16, low byte first on the wire."""
    return frame + FramerRTU.compute_CRC(frame).to_bytes(2, 'big')


def crc_valid(frame: bytes) -> bool:
    """Return whether the last two bytes are the CRC-16 of those before."""
    return len(frame) >= 4 and FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], 'big'))


def silence(baudrate: int, bits_per_character: int = 11) -> float:
    """Return the pause [s] that ends a frame: 3.5 characters, 1.75 ms above 19200 baud."""
    return 0.00175 if baudrate > 19200 else 3.5 * bits_per_character / baudrate


def split_rtu(data: bytes, unit: int) -> tuple[list[Request], int]:
    """Return the requests to `unit` or to all in `data`, and how many bytes are done with.

    Called when the line has fallen silent. Frames are known by length and CRC, those of others are passed
    over whole, so that what looks like a request inside another's data is not taken for one. A byte that
    begins no frame is skipped; what follows the last frame is left, for a sender that pauses inside a frame.
    """
    requests: list[Request] = []
    at = done = 0
    while at + 4 <= len(data):
        size, request = _frame_at(data, at, unit)
        if size == 0:
            at += 1
            continue
        if request is not None:
            requests.append(request)
        at += size
        done = at
    return requests, done


def _frame_at(data: bytes, at: int, unit: int) -> tuple[int, Request | None]:
    """Return (size, request) of the frame that begins at `at`; size 0: none, request None: not for us."""
    address, function = data[at], data[at + 1]
    rest = len(data) - at
    mine = address in (unit, BROADCAST)
    size = _request_size(data, at)
    if size is not None and size <= rest and crc_valid(data[at : at + size]):
        return size, Request(address, data[at + 1 : at + size - 2]) if mine else None
    if not mine:
        size = _reply_size(data, at)
        if size is not None and size <= rest and crc_valid(data[at : at + size]):
            return size, None
    # To the end of the burst with a right CRC: a function or a structure unknown here, to be answered as
    # such when it is for us. Function codes from 0x80 on are replies, ours at most.
    if rest <= LONGEST_RTU and crc_valid(data[at:]) and (mine or at == 0):
        return rest, Request(address, data[at + 1 : -2]) if mine and function < 0x80 else None
    return 0, None


def _request_size(data: bytes, at: int) -> int | None:
    function = data[at + 1]
    if function in _FIXED_REQUESTS:
        return _FIXED_REQUESTS[function]
    if function in _COUNTED_REQUESTS:
        position, other = _COUNTED_REQUESTS[function]
        return other + data[at + position] if at + position < len(data) else None
    return None


def _reply_size(data: bytes, at: int) -> int | None:
    function = data[at + 1]
    if function >= 0x80:
        return 5
    if function in _FIXED_REPLIES:
        return _FIXED_REPLIES[function]
    return 5 + data[at + 2] if function in _COUNTED_REPLIES else None


class Mbap(NamedTuple):
    """A request over TCP with what its reply must repeat."""

    transaction: int
    unit: int
    pdu: bytes

    def reply(self, pdu: bytes) -> bytes:
        """Return the frame that answers with `pdu`."""
        return struct.pack('>HHHB', self.transaction, 0, len(pdu) + 1, self.unit) + pdu


class FramingLostError(ValueError):
    """The stream cannot be followed any more: the header's length is impossible."""


def split_tcp(data: bytes) -> tuple[list[Mbap], int]:
    """Return all complete requests in `data` and the number of bytes used.

    A frame of another protocol is passed over. Raises FramingLostError for an impossible length.
    """
    requests: list[Mbap] = []
    at = 0
    while at + 7 <= len(data):
        transaction, protocol, length, unit = struct.unpack_from('>HHHB', data, at)
        if not 2 <= length <= LONGEST_PDU + 1:
            raise FramingLostError(f'length {length} in the MBAP header')
        if at + 6 + length > len(data):
            break
        if protocol == 0:
            requests.append(Mbap(transaction, unit, data[at + 7 : at + 6 + length]))
        at += 6 + length
    return requests, at
