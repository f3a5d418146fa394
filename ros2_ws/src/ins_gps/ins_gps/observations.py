# SPDX-License-Identifier: Apache-2.0
"""Raw receiver epochs and broadcast ephemerides to the rows of `gnss/observations`."""

from __future__ import annotations

import math
from collections import deque
from statistics import median

import numpy as np

from ins_gps.atmosphere import klobuchar, saastamoinen
from ins_gps.channels import wavelength
from ins_gps.constants import GPS_EPOCH_UNIX, SPEED_OF_LIGHT, WAVELENGTH_L1
from ins_gps.fix import OK, solve_position
from ins_gps.orbit import (
    azimuth_elevation,
    other_band_clock,
    range_and_rate,
    satellite_at_reception,
    select_ephemeris,
)
from ins_gps.rinex import RawEpoch
from ins_gps.samples import OBS, OBSERVATION_COLUMNS, GnssEpoch
from kalman_core.earth import geodetic_from_ecef

NANOSECONDS = 1_000_000_000
# Klobuchar coefficients (IS-GPS-200 form) of a quiet mid-latitude day, where a file brings none: half of
# the delay at best, like any broadcast model.
DEFAULT_KLOBUCHAR = np.array([1.2e-8, 1.5e-8, -6.0e-8, -6.0e-8, 9.6e4, 8.2e4, -6.6e4, -2.6e5])
_LOST = 1.5  # intervals without a signal after which its lock starts anew


class EpochBuilder:
    """Turns epochs of one receiver into `GnssEpoch`s, in order of time.

    `ephemerides` (k, COLUMNS) may grow while a live receiver decodes them. `atmosphere` off leaves the
    modelled delays NaN. `leap` (s) is subtracted from GPS time for stamps in UTC.
    """

    def __init__(
        self,
        ephemerides: np.ndarray,
        coefficients: np.ndarray | None = None,
        *,
        atmosphere: bool = True,
        leap: int = 0,
    ) -> None:
        self.ephemerides = ephemerides
        self._klobuchar = DEFAULT_KLOBUCHAR
        self.use_klobuchar(coefficients)
        self._atmosphere = atmosphere
        self.leap = leap
        self._locks: dict[tuple[int, int, int], tuple[float, float]] = {}
        self._intervals: deque[float] = deque(maxlen=5)
        self._last: float | None = None
        self.position: np.ndarray | None = None
        self.missing: set[tuple[int, int]] = set()

    def use_klobuchar(self, coefficients: np.ndarray | None) -> None:
        """Take broadcast coefficients (8,) from now on; None or NaN: go on with those in use."""
        if coefficients is not None and np.isfinite(coefficients).all():
            self._klobuchar = np.asarray(coefficients, dtype=float)

    def build(self, raw: RawEpoch) -> GnssEpoch:
        """Return the epoch with satellite states, modelled delays and lock times."""
        time = raw.time / NANOSECONDS
        if self._last is not None and time > self._last:
            self._intervals.append(time - self._last)
        self._last = time
        rows = np.full((len(raw.rows), OBSERVATION_COLUMNS), np.nan)
        rows[:, :7] = raw.rows[:, :7]
        lost = _LOST * median(self._intervals or [math.inf])
        for row, source in zip(rows, raw.rows, strict=True):
            row[OBS['slip']] = float(int(source[7]) & 1)
            row[OBS['lock_time']] = self._lock(row, time, lost)
            self._orbit(row, time)
        if self._atmosphere:
            self._delays(rows, time)
        stamp = raw.time + (GPS_EPOCH_UNIX - self.leap) * NANOSECONDS
        return GnssEpoch(stamp, rows)

    def _lock(self, row: np.ndarray, time: float, lost: float) -> float:
        key = (int(row[0]), int(row[1]), int(row[2]))
        if not math.isfinite(row[4]):
            self._locks.pop(key, None)
            return 0.0
        since, last = self._locks.get(key, (time, time))
        if row[OBS['slip']] > 0.0 or time - last > lost:
            since = time
        self._locks[key] = (since, time)
        return time - since

    def _orbit(self, row: np.ndarray, time: float) -> None:
        if not math.isfinite(row[3]):
            return
        index = select_ephemeris(self.ephemerides, int(row[0]), int(row[1]), time)
        if index < 0:
            self.missing.add((int(row[0]), int(row[1])))
            return
        eph = self.ephemerides[index]
        satellite_at_reception(eph, time, row[3], row[9:17])
        row[15] += other_band_clock(eph, row[2], (wavelength(row[2]) / WAVELENGTH_L1) ** 2)

    def _delays(self, rows: np.ndarray, time: float) -> None:
        usable = (rows[:, 2] == 1.0) & np.isfinite(rows[:, [3, 9]]).all(axis=1)
        if usable.sum() >= 4:
            part = rows[usable]
            ranges = part[:, 3] + SPEED_OF_LIGHT * part[:, 15]
            fix = solve_position(part[:, 9:15], ranges, np.full(len(part), 5.0), part[:, 0], self.position)
            if fix.status == OK:
                self.position = fix.position
        if self.position is None:
            return
        lat, lon, height = geodetic_from_ecef(self.position)
        los, zero = np.empty(3), np.zeros(3)
        for row in rows:
            if not math.isfinite(row[9]):
                continue
            range_and_rate(row[9:15], self.position, zero, los)
            azimuth, elevation = azimuth_elevation(los, lat, lon)
            if elevation <= 0.0:
                continue
            ratio = (wavelength(row[2]) / WAVELENGTH_L1) ** 2
            row[17] = ratio * klobuchar(self._klobuchar, lat, lon, azimuth, elevation, time)
            row[18] = saastamoinen(lat, height, elevation)
