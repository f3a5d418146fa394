# SPDX-License-Identifier: Apache-2.0
"""Where CAN frames come from: a log or an interface of python-can."""

from __future__ import annotations

from typing import NamedTuple

import can

from ev_velocity.can_frames import CanError, replay
from node_core.byte_sources import SourceError

_TIMEOUT = 0.2  # s, how long a silent bus keeps the thread
# CAN_ERR_BUSOFF of linux/can/error.h, in the id of an error frame: socketcan's only word of it.
_BUS_OFF = 0x40


class Frame(NamedTuple):
    """A frame; `stamp` (ns) is 0 where only its arrival tells the time."""

    stamp: int
    frame_id: int
    data: bytes
    error: bool


class LogFrames:
    """A recorded log (candump .log, .asc, .blf)."""

    def __init__(self, path: str) -> None:
        self._frames = replay(path)
        # A file that is no log ends the node at its start.
        self._first = self._next()

    def _next(self) -> Frame | None:
        try:
            values = next(self._frames, None)
        except CanError as error:
            raise SourceError(str(error)) from None
        return None if values is None else Frame(*values)

    def read(self) -> Frame | None:
        """Return the next frame, None at the end."""
        first, self._first = self._first, None
        return first or self._next()

    def close(self) -> None:
        """Close the log."""
        self._frames.close()


class BusFrames:
    """A live interface."""

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        self._name = f"{interface} '{channel}'"
        try:
            self._bus = can.Bus(interface=interface, channel=channel, bitrate=bitrate)
        except Exception as error:  # python-can's interfaces raise whatever their libraries do
            raise SourceError(f'{self._name} cannot be opened: {error}') from None

    def read(self) -> Frame | tuple[()]:
        """Return a frame, () if none has come."""
        try:
            message = self._bus.recv(_TIMEOUT)
            if message is None:
                off = self._bus.state is can.BusState.ERROR
            else:
                off = message.is_error_frame and bool(message.arbitration_id & _BUS_OFF)
        except (can.CanError, OSError) as error:
            raise SourceError(f'{self._name} lost: {error}') from None
        if off:
            raise SourceError(f'{self._name}: bus-off, the controller has left the bus')
        if message is None:
            return ()
        return Frame(0, message.arbitration_id, bytes(message.data), message.is_error_frame)

    def close(self) -> None:
        """Let go of the interface."""
        self._bus.shutdown()
