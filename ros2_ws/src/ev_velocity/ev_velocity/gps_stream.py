# SPDX-License-Identifier: Apache-2.0
"""Speeds from a stream of NMEA and UBX bytes: each with its accuracy and its time of validity."""

from __future__ import annotations

import calendar
import math
from collections import Counter
from typing import Any, NamedTuple

from pynmeagps import NMEAMessage, NMEAReader
from pynmeagps.exceptions import NMEAParseError
from pyubx2 import UBXReader
from pyubx2.exceptions import UBXParseError

KNOT = 1852.0 / 3600.0  # m/s
NANOSECONDS = 1_000_000_000
UBX_SYNC = b'\xb5\x62'
# Longest message: an NMEA line has at most 82 characters, a UBX payload beyond this is noise.
NMEA_LONGEST = 120
UBX_LONGEST = 4096
FIX_3D = 3
_NO_COURSE_SPEED = 0.5  # m/s, below which receivers leave the course out


class GpsSpeed(NamedTuple):
    """Speed over ground, m/s, east and north where the course is known; σ in m/s; validity in UTC ns or 0."""

    speed: float
    east: float
    north: float
    sigma: float
    utc: int


class GpsStream:
    """Cuts bytes into messages and gives their speeds; what is wrong is counted by reason in `rejected`."""

    def __init__(self, nmea_sigma: float) -> None:
        self._buffer = bytearray()
        self._nmea_sigma = nmea_sigma
        self._ubx_seen = False
        self.accepted = 0
        self.rejected: Counter[str] = Counter()

    def feed(self, data: bytes) -> list[GpsSpeed]:
        """Take bytes as they come, in pieces of any size; return the speeds completed by them."""
        self._buffer += data
        out: list[GpsSpeed] = []
        while True:
            message = self._next()
            if message is None:
                return out
            speed = self._decode(message)
            if speed is not None:
                self.accepted += 1
                out.append(speed)

    def _next(self) -> bytes | None:
        """Take the first whole message off the buffer; drop what belongs to none."""
        buffer = self._buffer
        while buffer:
            if buffer[0] == UBX_SYNC[0]:
                if len(buffer) < 6:
                    return None
                length = 8 + int.from_bytes(buffer[4:6], 'little')
                if buffer[1] == UBX_SYNC[1] and length <= UBX_LONGEST:
                    return self._take(length) if len(buffer) >= length else None
            elif buffer[0] == ord('$'):
                end = buffer.find(b'\n')
                if 0 <= end <= NMEA_LONGEST:
                    return self._take(end + 1)
                if end < 0 and len(buffer) <= NMEA_LONGEST:
                    return None
            starts = [i for i in (buffer.find(b'$', 1), buffer.find(UBX_SYNC, 1)) if i > 0]
            # A lone first sync byte at the end may be the start of a message.
            keep = len(buffer) - 1 if buffer[-1] == UBX_SYNC[0] and len(buffer) > 1 else len(buffer)
            dropped = min([*starts, keep])
            self.rejected['bytes between messages'] += dropped
            del buffer[:dropped]
        return None

    def _take(self, length: int) -> bytes:
        message = bytes(self._buffer[:length])
        del self._buffer[:length]
        return message

    def _decode(self, message: bytes) -> GpsSpeed | None:
        try:
            if message.startswith(UBX_SYNC):
                return self._ubx(UBXReader.parse(message))
            return self._nmea(NMEAReader.parse(message))
        except (UBXParseError, NMEAParseError):
            self.rejected['checksum or format'] += 1
        except Exception as error:  # both parsers let stray errors of damaged fields through
            self.rejected[f'not decodable ({type(error).__name__})'] += 1
        return None

    def _ubx(self, message: Any) -> GpsSpeed | None:
        if message.identity != 'NAV-PVT':
            return None
        self._ubx_seen = True
        if not message.gnssFixOk or message.fixType not in (2, FIX_3D, 4):
            self.rejected['no fix'] += 1
            return None
        utc = 0
        if message.validDate and message.validTime:
            day = (message.year, message.month, message.day, message.hour, message.min, message.second)
            utc = calendar.timegm(day) * NANOSECONDS + message.nano
        # mm/s; pyubx2 leaves velocities and their accuracy in the units of the protocol.
        east, north, sigma = message.velE * 1e-3, message.velN * 1e-3, message.sAcc * 1e-3
        return GpsSpeed(math.hypot(east, north), east, north, sigma, utc)

    def _nmea(self, message: NMEAMessage) -> GpsSpeed | None:
        # A receiver that speaks UBX says the same in NMEA, but worse.
        if message.msgID != 'RMC' or self._ubx_seen:
            return None
        if message.status != 'A' or message.spd in ('', None):
            self.rejected['no fix'] += 1
            return None
        speed = float(message.spd) * KNOT
        if message.cog in ('', None):
            if speed > _NO_COURSE_SPEED:
                self.rejected['no course'] += 1
                return None
            east, north = speed, 0.0
        else:
            course = math.radians(float(message.cog))
            east, north = speed * math.sin(course), speed * math.cos(course)
        utc = 0
        if message.date and message.time:
            day, clock = message.date, message.time
            seconds = calendar.timegm((day.year, day.month, day.day, clock.hour, clock.minute, clock.second))
            utc = seconds * NANOSECONDS + clock.microsecond * 1000
        return GpsSpeed(speed, east, north, self._nmea_sigma, utc)
