# SPDX-License-Identifier: Apache-2.0
"""An NMEA stream of any talker to fixes and velocities: GGA, RMC, GST, VTG, GSA, and ZDA for the date.

Source: IEC 61162-1 (NMEA 0183), sections on these sentences.
"""

from __future__ import annotations

import calendar
import datetime
import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pynmeagps import NMEAReader
from pynmeagps.exceptions import NMEAMessageError, NMEAParseError, NMEAStreamError, NMEATypeError

from ins_gps.samples import ReceiverFix, VelocitySample
from node_core.byte_frames import NMEA, MessageCutter

NANOSECONDS = 1_000_000_000
KNOT = 1852.0 / 3600.0  # m/s
_DAY = 86_400 * NANOSECONDS
_TIMED = ('GGA', 'RMC', 'GST', 'ZDA')
# The last field that each sentence must have; makers leave out later ones.
_KINDS = {'GGA': 'sep', 'RMC': 'date', 'GST': 'stdAlt', 'ZDA': 'year', 'VTG': 'sogn', 'GSA': 'VDOP'}
_UNREADABLE = (NMEAParseError, NMEAMessageError, NMEATypeError, NMEAStreamError)
# Status as in NavSatStatus by GGA's quality: no fix for dead reckoning, manual input and simulators.
_STATUS = {1: 0, 2: 1, 3: 0, 4: 2, 5: 2}
# Error of a range against that of a fix without corrections: what differential corrections, the precise
# service, fixed and floating ambiguities leave of it; the order of magnitude that receivers state.
_SHARE = {1: 1.0, 2: 0.4, 3: 0.5, 4: 0.005, 5: 0.1}
_VERTICAL_DOP = 2.0  # VDOP by HDOP where no GSA tells: the upper end of what an open sky gives
_LARGEST_DOP = 50.0  # receivers say 99.99 when they do not know
_GEOID = 31.0  # m, rms of the geoid against the ellipsoid, where the sentence leaves its separation out
_FASTEST = 600.0  # m/s, beyond what receivers may say (export limit 1000 kn)
_NO_COURSE = 0.5  # m/s, below which receivers leave the course out
_CLIMB = 100.0  # m/s, one σ of the vertical velocity, which NMEA does not tell
_APPROXIMATED, _DIAGONAL, _UNKNOWN = 1, 2, 0  # NavSatFix.position_covariance_type


@dataclass(slots=True)
class _Epoch:
    """Sentences of one time of day (ns)."""

    moment: int
    sentences: dict[str, Any] = field(default_factory=dict)
    kinds: Counter[str] = field(default_factory=Counter)
    done: bool = False


class NmeaDecoder:
    """Bytes in, `ReceiverFix` and `VelocitySample` out; nothing is raised. What is wrong is in `rejected`.

    Sentences of one time belong together, VTG and GSA to the time before them. An epoch is given as soon as
    it has what the two before had, else with the next one's first sentence. `range_sigma` (m) is the error
    of one range without corrections, for positions that have no GST; `speed_sigma` (m/s) that of a speed,
    of which NMEA says nothing. The date is that of RMC or ZDA; a time without is taken to be near the last
    stamp, or `reference()` (ns, UTC). `utc`: stamps in UTC, else `leap` (s) later, GPS time.
    """

    def __init__(
        self,
        range_sigma: float,
        speed_sigma: float,
        *,
        utc: bool = True,
        leap: int = 18,
        reference: Callable[[], int] | None = None,
    ) -> None:
        self.accepted: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self.quality = 0
        self._range_sigma, self._speed_sigma = range_sigma, speed_sigma
        self._offset = 0 if utc else leap * NANOSECONDS
        self._reference = reference
        self._messages = MessageCutter(self.rejected, NMEA)
        self._epoch: _Epoch | None = None
        self._before: Counter[str] = Counter()
        self._usual: Counter[str] = Counter()
        self._last = 0

    def feed(self, data: bytes) -> Iterator[ReceiverFix | VelocitySample]:
        """Yield what `data` completes."""
        for message in self._messages.feed(data):
            sentence = self._parse(message)
            if sentence is not None:
                yield from self._add(sentence)

    def rest(self) -> Iterator[ReceiverFix | VelocitySample]:
        """Yield what was held back, at the end of a recording."""
        yield from self._finish()

    def _parse(self, message: bytes) -> Any:
        # Proprietary sentences and what is not used need no parser.
        last = _KINDS.get(message[3:6].decode(errors='replace'))
        if last is None or message[1:2] == b'P':
            return None
        try:
            sentence = NMEAReader.parse(message)
            if hasattr(sentence, last):
                return sentence
        except (*_UNREADABLE, ValueError, TypeError, AttributeError, IndexError):
            pass  # counted below: damaged fields make the parser raise any of these
        self.rejected['unreadable sentence'] += 1
        return None

    def _add(self, sentence: Any) -> Iterator[ReceiverFix | VelocitySample]:
        kind = sentence.msgID
        if kind in _TIMED:
            moment = _moment(sentence.time)
            if moment is None:
                self.rejected['no time'] += 1
                return
            if self._epoch is None or moment != self._epoch.moment:
                yield from self._finish()
                if self._epoch is not None:
                    self._usual, self._before = self._epoch.kinds | self._before, self._epoch.kinds
                self._epoch = _Epoch(moment)
        if self._epoch is None:
            return  # nothing that VTG or GSA could belong to
        self.accepted[kind] += 1
        epoch = self._epoch
        epoch.kinds[kind] += 1
        epoch.sentences.setdefault(kind, sentence)
        if self._usual and epoch.kinds >= self._usual:
            yield from self._finish()

    def _finish(self) -> Iterator[ReceiverFix | VelocitySample]:
        epoch = self._epoch
        if epoch is None or epoch.done:
            return
        epoch.done = True
        stamp = self._stamp(epoch)
        if stamp is None:
            self.rejected['date unknown'] += 1
            return
        if self._last and stamp < self._last:
            self.rejected['time went back'] += 1
        self._last = stamp
        fix = self._fix(epoch, stamp + self._offset)
        if fix is not None:
            yield fix
        velocity = self._velocity(epoch, stamp + self._offset)
        if velocity is not None:
            yield velocity

    def _stamp(self, epoch: _Epoch) -> int | None:
        day = _date(epoch.sentences)
        if day is not None:
            return day * _DAY + epoch.moment
        near = self._last or (self._reference() if self._reference is not None else 0)
        if near <= 0:
            return None
        return near + (epoch.moment - near % _DAY + _DAY // 2) % _DAY - _DAY // 2

    def _fix(self, epoch: _Epoch, stamp: int) -> ReceiverFix | None:
        gga, rmc = epoch.sentences.get('GGA'), epoch.sentences.get('RMC')
        if gga is None and rmc is None:
            return None
        source: Any = rmc if gga is None else gga
        quality = int(source.status == 'A') if gga is None else int(_number(gga.quality, 0.0))
        self.quality, status = quality, _STATUS.get(quality, -1)
        lat, lon = _number(source.lat), _number(source.lon)
        if status >= 0 and not (abs(lat) <= 90.0 and abs(lon) <= 180.0):
            self.rejected['position that cannot be'] += 1
            return None
        height, separation = math.nan, math.nan
        if gga is not None:
            height, separation = _number(gga.alt), _number(gga.sep)
        ellipsoidal = height + (separation if math.isfinite(separation) else 0.0)
        covariance, kind = self._covariance(epoch.sentences, quality, math.isfinite(separation))
        geodetic = np.array([math.radians(lat), math.radians(lon), ellipsoidal])
        return ReceiverFix(stamp, geodetic, covariance, status, kind if status >= 0 else _UNKNOWN)

    def _covariance(self, sentences: dict[str, Any], quality: int, separated: bool) -> tuple[np.ndarray, int]:
        """Return covariance (3, 3) in ENU and its kind: from GST, else from the DOPs and the quality."""
        gst, gsa, gga = sentences.get('GST'), sentences.get('GSA'), sentences.get('GGA')
        geoid = 0.0 if separated else _GEOID
        if gst is not None:
            north, east, up = (_number(v) for v in (gst.stdLat, gst.stdLong, gst.stdAlt))
            if north > 0.0 and east > 0.0 and up > 0.0:
                return np.diag([east**2, north**2, up**2 + geoid**2]), _DIAGONAL
        dops = [_number(gga.HDOP) if gga is not None else math.nan, math.nan, math.nan]
        if gsa is not None:
            dops[1:] = _number(gsa.HDOP), _number(gsa.VDOP)
        hdop = dops[0] if 0.0 < dops[0] <= _LARGEST_DOP else dops[1]
        if not 0.0 < hdop <= _LARGEST_DOP:
            return np.zeros((3, 3)), _UNKNOWN
        vdop = dops[2] if 0.0 < dops[2] <= _LARGEST_DOP else _VERTICAL_DOP * hdop
        sigma = self._range_sigma * _SHARE.get(quality, 1.0)
        horizontal = 0.5 * (hdop * sigma) ** 2  # HDOP² is the sum of both axes
        return np.diag([horizontal, horizontal, (vdop * sigma) ** 2 + geoid**2]), _APPROXIMATED

    def _velocity(self, epoch: _Epoch, stamp: int) -> VelocitySample | None:
        rmc, vtg = epoch.sentences.get('RMC'), epoch.sentences.get('VTG')
        if rmc is not None:
            valid, knots, course = rmc.status == 'A', _number(rmc.spd), _number(rmc.cog)
        elif vtg is not None:
            knots, course = _number(vtg.sogn), _number(vtg.cogt)
            valid = getattr(vtg, 'posMode', 'A') not in ('N', 'E', 'M', 'S')
        else:
            return None
        speed = knots * KNOT
        if not valid or not math.isfinite(speed):
            return None
        if not 0.0 <= speed <= _FASTEST:
            self.rejected['speed that cannot be'] += 1
            return None
        variance = self._speed_sigma**2
        if math.isfinite(course):
            heading = math.radians(course)
            velocity = np.array([speed * math.cos(heading), speed * math.sin(heading), 0.0])
        elif speed <= _NO_COURSE:
            # Somewhere within this speed of standing still.
            velocity, variance = np.zeros(3), variance + speed**2
        else:
            self.rejected['no course'] += 1
            return None
        return VelocitySample(stamp, velocity, np.diag([variance, variance, _CLIMB**2]))


def _number(value: Any, missing: float = math.nan) -> float:
    """Return a field as a number, `missing` where it is empty or none."""
    try:
        return float(value) if value not in ('', None) else missing
    except (TypeError, ValueError):
        return missing


def _moment(time: Any) -> int | None:
    if not isinstance(time, datetime.time):
        return None
    seconds = time.hour * 3600 + time.minute * 60 + time.second
    return seconds * NANOSECONDS + time.microsecond * 1000


def _date(sentences: dict[str, Any]) -> int | None:
    """Return the day since 1970-01-01 that RMC or ZDA tells."""
    rmc, zda = sentences.get('RMC'), sentences.get('ZDA')
    if rmc is not None and isinstance(rmc.date, datetime.date):
        return calendar.timegm(rmc.date.timetuple()) // 86_400
    if zda is None:
        return None
    try:
        return (
            calendar.timegm(datetime.date(int(zda.year), int(zda.month), int(zda.day)).timetuple()) // 86_400
        )
    except (TypeError, ValueError):
        return None
