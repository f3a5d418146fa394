# SPDX-License-Identifier: Apache-2.0
"""An RTCM 3 stream to epochs and base positions.

Source: RTCM 10403.3; the messages' fields are in `rtcm_messages`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
from pyrtcm import RTCMMessage
from pyrtcm.exceptions import RTCMMessageError, RTCMParseError, RTCMStreamError, RTCMTypeError

from ins_gps.broadcast import near
from ins_gps.constants import GALILEO, GPS_EPOCH_UNIX, WEEK
from ins_gps.live_epochs import LiveEpochs
from ins_gps.orbit import COLUMN
from ins_gps.rinex import NANOSECONDS, RawEpoch
from ins_gps.rtcm_messages import (
    MSM_KINDS,
    MSM_SYSTEMS,
    BroadcastEphemeris,
    Cell,
    Msm,
    read_ephemeris,
    read_msm,
    read_position,
)
from ins_gps.samples import GnssEpoch, ReceiverFix
from kalman_core.earth import geodetic_from_ecef
from node_core.byte_frames import RTCM, MessageCutter

_UNREADABLE = (RTCMMessageError, RTCMParseError, RTCMStreamError, RTCMTypeError)
_EPHEMERIDES, _POSITIONS = ('1019', '1045', '1046'), ('1005', '1006')
# MSM of any constellation: the bit that says whether more of the epoch follows stands behind message number,
# station and time.
_MSM_NUMBERS = range(1071, 1138)
_MORE_BIT = 54
_HEADER = 3  # bytes before the payload
_PIVOT = 2400  # GPS week in 2026, by which weeks 1888 (2016) to 2911 (2035) are told apart
# One ephemeris of another week is a stale one that a caster still repeats; so many say that time leapt.
_LEAP_VOTES = 4
# The message does not tell how well a base was surveyed.
_BASE_SIGMA = 0.05  # m
_APPROXIMATED = 1  # NavSatFix.COVARIANCE_TYPE_APPROXIMATED


class LockWatch:
    """Slips from lock times: a phase whose lock cannot have lasted since it was seen last."""

    def __init__(self) -> None:
        self._seen: dict[tuple[float, ...], tuple[float, float, str]] = {}

    def slipped(self, cell: Cell, time: float) -> bool:
        """Return whether the phase of a cell, seen at `time` (s), may have slipped since it was seen last."""
        key, (low, high) = cell.row[:3], cell.lock
        before = self._seen.get(key)
        self._seen[key] = time, low, cell.code
        if before is None or low == 0.0:
            return low == 0.0
        # Another signal of the band has another ambiguity.
        return cell.code != before[2] or high <= before[1] + time - before[0]

    def reset(self) -> None:
        """Forget all phases."""
        self._seen.clear()


class RtcmDecoder:
    """Bytes in, `GnssEpoch` and, for 1005 and 1006, `ReceiverFix` of the base out; nothing is raised.

    An epoch is what MSM4-MSM7 of GPS and Galileo say of one time, given when the multiple-message bit says
    that it is complete, or when the next begins. Its week follows from the ephemerides: epochs before the
    first are refused. GPS sends its week modulo 1024: the cycle nearest to `week` is taken
    (0: 2016 to 2035), until a Galileo ephemeris tells it. `utc`: stamps in UTC, `leap` (s) before GPS.
    """

    def __init__(
        self,
        bands: tuple[int, ...] = (1,),
        *,
        atmosphere: bool = True,
        utc: bool = True,
        leap: int = 18,
        week: int = 0,
    ) -> None:
        self.accepted: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self._messages = MessageCutter(self.rejected, RTCM)
        self._bands, self._atmosphere = bands, atmosphere
        self._leap = leap if utc else 0
        self._pivot = week or _PIVOT
        self._locks = LockWatch()
        self._epochs = LiveEpochs(self.rejected, self._locks.reset, atmosphere=atmosphere)
        self._time: float | None = None  # GPS s of the last epoch
        self._waiting: list[tuple[int, BroadcastEphemeris]] = []  # with their weeks, until there is a time
        self._votes = 0
        self._inav: dict[int, float] = {}
        self._station: int | None = None
        self._tow: int | None = None
        self._cells: list[Cell] = []
        self._base: np.ndarray | None = None

    @property
    def left_out(self) -> Counter[str]:
        """Signals without ephemeris or code."""
        return self._epochs.left_out

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of satellites without ephemeris in the last epoch."""
        return self._epochs.missing

    @property
    def ephemerides(self) -> np.ndarray:
        """Rows of `ins_gps.orbit`."""
        return self._epochs.broadcast.ephemerides

    def feed(self, data: bytes) -> Iterator[GnssEpoch | ReceiverFix]:
        """Yield what `data` completes."""
        for message in self._messages.feed(data):
            yield from self._take(message[_HEADER:-3])

    def rest(self) -> Iterator[GnssEpoch]:
        """Yield an epoch whose end was not said, at the end of a recording."""
        yield from self._finish()

    def _take(self, payload: bytes) -> Iterator[GnssEpoch | ReceiverFix]:
        if len(payload) < 2:
            return  # casters send empty messages to keep a connection alive
        number = payload[0] << 4 | payload[1] >> 4
        kind = str(number)
        parsed = self._parse(kind, payload)
        if isinstance(parsed, Msm):
            yield from self._observe(parsed)
        elif isinstance(parsed, BroadcastEphemeris):
            self._learn(parsed)
        elif parsed is not None:
            self._base = parsed
        if number in _MSM_NUMBERS and not _bit(payload, _MORE_BIT):
            yield from self._finish()
        yield from self._position()

    def _parse(self, kind: str, payload: bytes) -> Msm | BroadcastEphemeris | np.ndarray | None:
        self.accepted[kind] += 1
        observed = kind[:3] in MSM_SYSTEMS and kind[3] in MSM_KINDS
        if not observed and kind not in _EPHEMERIDES and kind not in _POSITIONS:
            return None
        try:
            message = RTCMMessage(payload=payload)
            if observed:
                return read_msm(message)
            return read_ephemeris(message) if kind in _EPHEMERIDES else read_position(message)
        except (*_UNREADABLE, AttributeError, ValueError, OverflowError):
            # A payload that is shorter than its layout ends in any of these.
            self.accepted[kind] -= 1
            self.rejected[f'{kind}: unreadable'] += 1
            return None

    def _observe(self, msm: Msm) -> Iterator[GnssEpoch]:
        if msm.station != self._station:
            if self._station is not None:
                self.rejected['station changed'] += 1
            self._station = msm.station
            self._locks.reset()
        if self._tow is not None and msm.tow != self._tow:
            self.accepted['epoch without a last message'] += 1
            yield from self._finish()
        self._tow = msm.tow
        self._cells += msm.cells

    def _finish(self) -> Iterator[GnssEpoch]:
        tow, cells = self._tow, self._cells
        self._tow, self._cells = None, []
        if tow is None:
            return
        self._resolve(tow * 1e-3)
        if self._time is None:
            self.rejected['epoch: week unknown, no ephemeris yet'] += 1
            return
        week = round((self._time - tow * 1e-3) / WEEK)
        time = (week * WEEK * 1000 + tow) * (NANOSECONDS // 1000)
        if not self._epochs.is_new(time):
            return
        rows: dict[tuple[float, ...], list[float]] = {}
        locks = []
        for cell in cells:
            key = cell.row[:3]
            if cell.row[2] in self._bands and key not in rows:
                tracked = math.isfinite(cell.row[4])
                slip = tracked and self._locks.slipped(cell, time / NANOSECONDS)
                rows[key] = [*cell.row, float(slip) + (2.0 if cell.half else 0.0)]
                locks.append(cell.lock[0])
        raw = RawEpoch(time, np.array(list(rows.values())) if rows else np.empty((0, 8)))
        self.accepted['epoch'] += 1
        yield self._epochs.finish(raw, np.array(locks), self._leap)

    def _resolve(self, tow: float) -> None:
        """Find the time of an epoch from its second of the week, and store what waited for a time."""
        if self._time is not None:
            self._time = near(tow, self._time)
        elif self._waiting:
            (week, _), *_ = Counter(week for week, _ in self._waiting).most_common(1)
            self._time = week * WEEK + tow
            for _, ephemeris in self._waiting:
                self._store(ephemeris, self._time)
            self._waiting.clear()

    def _learn(self, ephemeris: BroadcastEphemeris) -> None:
        week = ephemeris.week + ephemeris.cycle * round((self._pivot - ephemeris.week) / ephemeris.cycle)
        if ephemeris.system == GALILEO:
            self._pivot = week
        # An ephemeris is of this week, or of the one before or after where it turns.
        if self._time is None:
            self._waiting.append((week, ephemeris))
        elif abs(week - self._time / WEEK + 0.5) <= 1.5:
            self._votes = 0
            self._store(ephemeris, self._time)
        else:
            self.rejected['ephemeris of another week'] += 1
            self._votes += 1
            if self._votes >= _LEAP_VOTES:
                self._leap_in_time()

    def _leap_in_time(self) -> None:
        self.rejected['week changed'] += 1
        self._time, self._votes = None, 0
        self._inav.clear()
        self._locks.reset()
        self._epochs = LiveEpochs(self.rejected, self._locks.reset, atmosphere=self._atmosphere)

    def _store(self, ephemeris: BroadcastEphemeris, time: float) -> None:
        row = ephemeris.row(time)
        if row is None or not math.isfinite(row.sum()):
            self.rejected['ephemeris of no orbit'] += 1
            return
        toe, number = float(row[COLUMN['toe']]), ephemeris.satellite
        # The clock of F/NAV is that of E5a: where I/NAV comes too, mixing them makes steps.
        if ephemeris.clock == 'inav':
            self._inav[number] = toe
        elif ephemeris.clock == 'fnav' and self._inav.get(number, -math.inf) >= toe:
            return
        store = self._epochs.broadcast
        # Casters repeat ephemerides every few seconds.
        if not (store.ephemerides == row).all(axis=1).any():
            store.store(row)

    def _position(self) -> Iterator[ReceiverFix]:
        """Yield the base's position once there is a time to stamp it with."""
        if self._base is None or self._time is None:
            return
        stamp = round(self._time * NANOSECONDS) + (GPS_EPOCH_UNIX - self._leap) * NANOSECONDS
        geodetic = np.array(geodetic_from_ecef(self._base))
        self._base = None
        yield ReceiverFix(stamp, geodetic, _BASE_SIGMA**2 * np.eye(3), 0, _APPROXIMATED)


def _bit(payload: bytes, position: int) -> bool:
    return len(payload) * 8 > position and bool(payload[position // 8] >> (7 - position % 8) & 1)
