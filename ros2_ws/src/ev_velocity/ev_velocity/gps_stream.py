# SPDX-License-Identifier: Apache-2.0
"""Speeds from a stream of NMEA and UBX bytes: each with its accuracy and its time of validity."""

from __future__ import annotations

import calendar
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

from pynmeagps import NMEAMessage, NMEAReader
from pynmeagps.exceptions import NMEAParseError
from pyubx2 import UBXReader
from pyubx2.exceptions import UBXParseError

from node_core.byte_frames import NMEA, UBX, MessageCutter

KNOT = 1852.0 / 3600.0  # m/s
NANOSECONDS = 1_000_000_000
FIX_3D = 3
# RMC sentences without any NAV-PVT among them after which they are believed: 3 s of 10 Hz.
_UBX_PATIENCE = 30
_NO_COURSE_SPEED = 0.5  # m/s, below which receivers leave the course out


class GpsSpeed(NamedTuple):
    """Speed over ground, m/s, east and north where the course is known; σ in m/s.

    utc: validity (ns), 0 if the receiver does not know it; arrival: clock (ns) at the message's first byte.
    """

    speed: float
    east: float
    north: float
    sigma: float
    utc: int
    arrival: int = 0


class GpsStream:
    """Cuts bytes into messages and gives their speeds; what is wrong is counted by reason in `rejected`."""

    def __init__(self, nmea_sigma: float) -> None:
        self._nmea_sigma = nmea_sigma
        self._rmc_since_ubx = _UBX_PATIENCE
        self.accepted = 0
        self.rejected: Counter[str] = Counter()
        self._messages = MessageCutter(self.rejected, UBX, NMEA)

    def feed(self, data: bytes, arrival: int = 0) -> Iterator[GpsSpeed]:
        """Take bytes that came at `arrival` (ns), in pieces of any size; yield the speeds they complete."""
        for message in self._messages.feed(data, arrival):
            speed = self._decode(message)
            if speed is not None:
                self.accepted += 1
                yield speed._replace(arrival=self._messages.arrival)

    def clear(self) -> None:
        """Forget the bytes of a message that is not complete."""
        self._messages.clear()

    def _decode(self, message: bytes) -> GpsSpeed | None:
        try:
            if message.startswith(UBX.sync):
                return self._ubx(UBXReader.parse(message))
            return self._nmea(NMEAReader.parse(message))
        except (UBXParseError, NMEAParseError):
            self.rejected['format'] += 1
        except Exception as error:  # both parsers let stray errors of damaged fields through
            self.rejected[f'not decodable ({type(error).__name__})'] += 1
        return None

    def _ubx(self, message: Any) -> GpsSpeed | None:
        if message.identity != 'NAV-PVT':
            return None
        self._rmc_since_ubx = 0
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
        if message.msgID != 'RMC':
            return None
        self._rmc_since_ubx += 1
        # A receiver that speaks UBX says the same in NMEA, but worse.
        if self._rmc_since_ubx <= _UBX_PATIENCE:
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
