# SPDX-License-Identifier: Apache-2.0
"""Epochs of a receiver whose ephemerides come over the same stream."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from ins_gps.broadcast import BroadcastStore
from ins_gps.constants import SYSTEM_LETTERS
from ins_gps.observations import EpochBuilder
from ins_gps.rinex import NANOSECONDS, RawEpoch
from ins_gps.samples import OBS, GnssEpoch


class LiveEpochs:
    """Turns raw epochs into `GnssEpoch`s with what has been broadcast so far.

    A signal whose satellite's position is not known, for want of ephemeris or code, has no row and counts
    in `left_out`; `missing` names those without ephemeris in the last epoch. `restart` is called when time
    goes back.
    """

    def __init__(self, rejected: Counter[str], restart: Callable[[], None], *, atmosphere: bool) -> None:
        self.rejected = rejected
        self.left_out: Counter[str] = Counter()
        self.missing: tuple[str, ...] = ()
        self.broadcast = BroadcastStore()
        self._restart, self._atmosphere = restart, atmosphere
        self._last = 0
        self._builder = self._new_builder()

    def _new_builder(self) -> EpochBuilder:
        return EpochBuilder(self.broadcast.ephemerides, atmosphere=self._atmosphere)

    def is_new(self, time: int) -> bool:
        """Return whether an epoch at `time` (ns since 1980-01-06) is none that was there before."""
        if time == self._last:
            self.rejected['epoch: repeated'] += 1
            return False
        if time < self._last:
            self.rejected['time went back'] += 1
            self._restart()
            self._builder = self._new_builder()
        self._last = time
        return True

    def finish(self, raw: RawEpoch, locks: np.ndarray, leap: int) -> GnssEpoch:
        """Return the epoch with satellite states; `locks` (s) are the receiver's lock times of the rows.

        `leap` (s) is subtracted for the stamp.
        """
        self.broadcast.update(raw.time / NANOSECONDS)
        builder = self._builder
        builder.ephemerides = self.broadcast.ephemerides
        builder.use_klobuchar(self.broadcast.klobuchar)
        builder.leap = leap
        epoch = builder.build(raw)
        rows = epoch.rows
        # The receiver has watched the lock longer than this stream, but may count only so far.
        lock = OBS['lock_time']
        tracked = np.isfinite(rows[:, OBS['carrier_phase']])
        rows[tracked, lock] = np.maximum(rows[tracked, lock], locks[tracked])
        known = np.isfinite(rows[:, OBS['satellite_x']])
        coded = np.isfinite(rows[:, OBS['pseudorange']])
        without = rows[~known & coded]
        names = {f'{SYSTEM_LETTERS[int(row[0])]}{int(row[1]):02d}' for row in without}
        self.missing = tuple(sorted(names))
        if len(without):
            self.left_out['without ephemeris'] += len(without)
        if not coded.all():
            self.left_out['without code'] += int((~coded).sum())
        return GnssEpoch(epoch.stamp, rows[known])
