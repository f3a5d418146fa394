# SPDX-License-Identifier: Apache-2.0
"""A u-blox byte stream to epochs and fixes: RXM-RAWX, RXM-SFRBX and NAV-PVT.

Source: u-blox, "F9 HPG 1.32 interface description" (UBX-22008968), sections 3.15.9, 3.17.5 and 3.17.9.
"""

from __future__ import annotations

import datetime
import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
from pyubx2 import VALNONE, UBXReader
from pyubx2 import exceptions as ubx_errors

from ins_gps.constants import GALILEO, GPS, WEEK
from ins_gps.live_epochs import LiveEpochs
from ins_gps.rinex import NANOSECONDS, RawEpoch
from ins_gps.samples import GnssEpoch, ReceiverFix
from node_core.byte_frames import UBX, MessageCutter

_HEAD, _TAIL = 6, 2  # bytes of a frame before and after its payload
_PVT, _SFRBX, _RAWX = b'\x01\x07', b'\x02\x13', b'\x02\x15'
_UNREADABLE = (
    ubx_errors.UBXParseError,
    ubx_errors.UBXMessageError,
    ubx_errors.UBXTypeError,
    ubx_errors.UBXStreamError,
)

_RAWX_HEAD = np.dtype(
    [('tow', '<f8'), ('week', '<u2'), ('leap', 'i1'), ('count', 'u1'), ('status', 'u1'), ('_', 'V3')]
)
_RAWX_CELL = np.dtype(
    [
        ('pseudorange', '<f8'), ('phase', '<f8'), ('doppler', '<f4'),
        ('system', 'u1'), ('satellite', 'u1'), ('signal', 'u1'), ('channel', 'u1'),
        ('lock', '<u2'), ('cn0', 'u1'), ('code_sigma', 'u1'), ('phase_sigma', 'u1'),
        ('doppler_sigma', 'u1'), ('tracking', 'u1'), ('_', 'u1'),
    ]
)  # fmt: skip
_LEAP_KNOWN, _CLOCK_RESET = 1, 2  # bits of the head's status
_CODE_VALID, _PHASE_VALID, _HALF_RESOLVED, _HALF_SUBTRACTED = 1, 2, 4, 8  # bits of `tracking`
_SYSTEMS = {0: GPS, 2: GALILEO}
_LARGEST = {GPS: 32, GALILEO: 36}  # satellite numbers
_BANDS = {
    (GPS, 0): 1, (GPS, 3): 2, (GPS, 4): 2, (GPS, 6): 5, (GPS, 7): 5,
    (GALILEO, 0): 1, (GALILEO, 1): 1, (GALILEO, 3): 5, (GALILEO, 4): 5, (GALILEO, 5): 7, (GALILEO, 6): 7,
}  # fmt: skip
_FARTHEST = 1e8  # m, three times a real pseudorange: beyond, the clock or the cell is broken
_INAV_SIGNALS = (1, 5)  # E1-B and E5b-I
_MILLISECOND = 1e-3  # s, resolution of the lock time
_FIX_TYPES = (2, 3, 4)  # 2-D, 3-D, with dead reckoning
_UNIX = datetime.datetime(1970, 1, 1)


class RawxReader:
    """RXM-RAWX payloads to `RawEpoch`s, with slips from lock times and half cycles.

    Read with a dtype and not by pyubx2, whose attribute per cell costs a hundred times as much at 20 Hz.
    `leap` (s) is GPS minus UTC once the receiver knows it; `locks` (s) belong to the rows of the last epoch.
    """

    def __init__(self, bands: tuple[int, ...] = (1,)) -> None:
        self._bands = bands
        self._phases: dict[tuple[int, int, int], tuple[float, float, int]] = {}
        self.leap: int | None = None
        self.locks = np.empty(0)

    def read(self, payload: bytes) -> RawEpoch | str:
        """Return the epoch, or why there is none."""
        if len(payload) < _RAWX_HEAD.itemsize:
            return 'length'
        head = np.frombuffer(payload, _RAWX_HEAD, 1)[0]
        if len(payload) != _RAWX_HEAD.itemsize + int(head['count']) * _RAWX_CELL.itemsize:
            return 'length'
        tow, week, status = float(head['tow']), int(head['week']), int(head['status'])
        if week == 0 or not 0.0 <= tow < WEEK:
            return 'time unknown'
        if status & _LEAP_KNOWN:
            self.leap = int(head['leap'])
        time = week * WEEK * NANOSECONDS + round(tow * NANOSECONDS)
        rows: dict[tuple[int, int, int], list[float]] = {}
        locks: dict[tuple[int, int, int], float] = {}
        for cell in np.frombuffer(payload, _RAWX_CELL, offset=_RAWX_HEAD.itemsize).tolist():
            row = self._row(cell, time * 1e-9, bool(status & _CLOCK_RESET))
            if row is None:
                continue
            key = (int(row[0]), int(row[1]), int(row[2]))
            if key not in rows or math.isnan(rows[key][3]):
                rows[key], locks[key] = row, cell[7] * _MILLISECOND
        self.locks = np.array(list(locks.values()))
        return RawEpoch(time, np.array(list(rows.values())) if rows else np.empty((0, 8)))

    def _row(self, cell: tuple, time: float, reset: bool) -> list[float] | None:
        code, phase, doppler, gnss, satellite, signal, _, lock, cn0, *_, tracking, _ = cell
        system = _SYSTEMS.get(gnss)
        if system is None or not 1 <= satellite <= _LARGEST[system]:
            return None
        band = _BANDS.get((system, signal))
        if band is None or band not in self._bands:
            return None
        code = code if tracking & _CODE_VALID and 0.0 < code < _FARTHEST else math.nan
        phase = phase if tracking & _PHASE_VALID and math.isfinite(phase) and phase != 0.0 else math.nan
        if math.isnan(code) and math.isnan(phase):
            return None
        loss = 0.0
        if math.isfinite(phase):
            half = tracking & _HALF_SUBTRACTED
            slip = self._slipped((system, satellite, band), time, lock * _MILLISECOND, half) or reset
            loss = float(slip) + (0.0 if tracking & _HALF_RESOLVED else 2.0)
        doppler = doppler if math.isfinite(doppler) else math.nan
        return [system, satellite, band, code, phase, doppler, float(cn0) if cn0 else math.nan, loss]

    def _slipped(self, key: tuple[int, int, int], time: float, lock: float, half: int) -> bool:
        """Return whether lock began after this phase was last seen, or half a cycle came or went."""
        before = self._phases.get(key)
        self._phases[key] = (time, lock, half)
        if lock == 0.0 or before is None:
            return lock == 0.0
        elapsed = time - before[0]
        saturated = lock >= before[1] and lock > 60.0  # the counter stops at 64.5 s
        return lock < before[1] or (not saturated and lock + _MILLISECOND < elapsed) or half != before[2]

    def reset(self) -> None:
        """Forget the phases, after a jump of time."""
        self._phases.clear()


class UbloxDecoder:
    """Bytes in, `GnssEpoch` and `ReceiverFix` out, in the order of the stream; nothing is raised.

    `accepted` and `rejected` count messages, the latter by reason, `left_out` signals. `utc`: stamps in UTC,
    with the receiver's leap seconds or, until it knows them, `leap`; else GPS time.
    """

    def __init__(
        self, bands: tuple[int, ...] = (1,), *, atmosphere: bool = True, utc: bool = True, leap: int = 18
    ) -> None:
        self.accepted: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self._messages = MessageCutter(self.rejected, UBX)
        self._rawx = RawxReader(bands)
        self._epochs = LiveEpochs(self.rejected, self._rawx.reset, atmosphere=atmosphere)
        self.broadcast, self.left_out = self._epochs.broadcast, self._epochs.left_out
        self._utc, self._leap = utc, leap

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of satellites without ephemeris in the last epoch."""
        return self._epochs.missing

    @property
    def leap_seconds(self) -> int:
        """GPS minus UTC, s."""
        return self._leap if self._rawx.leap is None else self._rawx.leap

    def feed(self, data: bytes) -> Iterator[GnssEpoch | ReceiverFix]:
        """Yield what `data` completes."""
        for frame in self._messages.feed(data):
            kind = frame[2:4]
            sample: GnssEpoch | ReceiverFix | None = None
            if kind == _RAWX:
                sample = self._epoch(frame)
            elif kind in (_SFRBX, _PVT):
                sample = self._parsed(frame)
            if sample is not None:
                yield sample

    def _parsed(self, frame: bytes) -> ReceiverFix | None:
        try:
            message = UBXReader.parse(frame, validate=VALNONE)
            if message.identity == 'NAV-PVT':
                return self._fix(message)
            self._subframe(message)
        except (*_UNREADABLE, AttributeError, ValueError, OverflowError):
            # A payload that is shorter than its layout lacks attributes; a date may not exist.
            self.rejected['unreadable message'] += 1
        return None

    def _subframe(self, message) -> None:
        words = [getattr(message, f'dwrd_{i:02d}') for i in range(1, message.numWords + 1)]
        system, satellite = _SYSTEMS.get(message.gnssId), message.svId
        if system == GPS and message.sigId == 0 and 1 <= satellite <= _LARGEST[GPS]:
            good = self.broadcast.add_lnav(satellite, words)
        elif system == GALILEO and message.sigId in _INAV_SIGNALS and 1 <= satellite <= _LARGEST[GALILEO]:
            good = self.broadcast.add_inav(satellite, words)
        else:
            return  # a message that carries no ephemeris used here
        if good:
            self.accepted['navigation message'] += 1
        else:
            self.rejected['navigation message'] += 1

    def _fix(self, message) -> ReceiverFix | None:
        if not (message.validDate and message.validTime):
            self.rejected['fix without time'] += 1
            return None
        minute = datetime.datetime(message.year, message.month, message.day, message.hour, message.min)
        seconds = round((minute - _UNIX).total_seconds()) + message.second
        stamp = seconds * NANOSECONDS + message.nano
        if not self._utc:
            stamp += self.leap_seconds * NANOSECONDS
        status = -1
        if message.gnssFixOk and message.fixType in _FIX_TYPES:
            status = 2 if message.diffSoln else 0
        # mm; hAcc bounds the error along either horizontal axis. Never 0: a covariance has to be positive.
        horizontal, vertical = max(message.hAcc, 1) * 1e-3, max(message.vAcc, 1) * 1e-3
        geodetic = np.array([math.radians(message.lat), math.radians(message.lon), message.height * 1e-3])
        self.accepted['fix'] += 1
        return ReceiverFix(stamp, geodetic, np.diag([horizontal**2, horizontal**2, vertical**2]), status)

    def _epoch(self, frame: bytes) -> GnssEpoch | None:
        raw = self._rawx.read(frame[_HEAD:-_TAIL])
        if isinstance(raw, str):
            self.rejected[f'epoch: {raw}'] += 1
            return None
        if not self._epochs.is_new(raw.time):
            return None
        self.accepted['epoch'] += 1
        return self._epochs.finish(raw, self._rawx.locks, self.leap_seconds if self._utc else 0)
