# SPDX-License-Identifier: Apache-2.0
"""DGPS base: observations at a known position to corrections of pseudorange and range rate.

A correction is what must be added to a rover's pseudorange: it takes out satellite clock, orbit and
atmosphere, not the models' share alone. The base's own clock is removed as the median residual after the
atmosphere models, so that corrected and uncorrected satellites may be mixed.
Source: RTCM 10402.3, message type 1; paper 003 section 2.3.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ins_gps.channels import wavelength
from ins_gps.constants import SPEED_OF_LIGHT
from ins_gps.fix import OK, solve_position
from ins_gps.orbit import azimuth_elevation, range_and_rate
from ins_gps.params import BaseParams
from ins_gps.samples import Corrections, GnssEpoch, PositionSample
from kalman_core.earth import ecef_from_geodetic, geodetic_from_ecef
from kalman_core.health import Tally
from kalman_core.parameters import ParameterError

NANOSECONDS = 1_000_000_000
_SMOOTHING_GAP = 5.0  # s without an epoch after which carrier smoothing begins anew
_SLOTS = 80
_WARN, _ERROR = b'\x01', b'\x02'  # DiagnosticStatus
_OLDER = 10  # epochs in order among themselves, but not newer than the last: time has gone back
_MOVED = 0.01  # m, ten times what 1005 and NavSatFix resolve


class DgpsBase:
    """Makes corrections from epochs of a receiver at a known position.

    Codes are smoothed by their carrier (Hatch filter of `smoothing` s). The base's own fix is compared
    with the configured position: if they differ by more than `position_limit` over `position_epochs` epochs
    the position is wrong, nothing is sent, and diagnostics say by how much. ParameterError where no position
    is given and none is asked for on a topic.
    """

    def __init__(self, params: BaseParams) -> None:
        self.params = params
        self.tally = Tally()
        if params.position_source == 'parameter' and not any(params.position):
            raise ParameterError(
                "parameter 'position' is 0, 0, 0, expected latitude °, longitude ° and height m of the "
                "antenna; or set 'position_source' to 'topic' to take it from base/position"
            )
        # Everything that changes: per satellite phase (m), smoothed code (m), count, last correction; then
        # stamp (s), stamp (s) of the last epoch that was not newer, mean offset of the own fix (3) and its
        # count; position (ECEF, m), 0 if not known; count of epochs that were not newer.
        self.state = np.zeros(4 * _SLOTS + 10)
        self.wrong_position: float | None = None
        self._take_parameter()

    @property
    def position(self) -> np.ndarray:
        """Position of the antenna (3,), ECEF m; zeros while it is not known."""
        return self.state[4 * _SLOTS + 6 : 4 * _SLOTS + 9]

    def _take_parameter(self) -> None:
        if self.params.position_source == 'parameter':
            lat, lon, height = self.params.position
            self.position[:] = ecef_from_geodetic(math.radians(lat), math.radians(lon), height)

    def reset(self) -> None:
        """Start anew."""
        self.state[:] = 0.0
        self.wrong_position = None
        self._take_parameter()

    def on_position(self, sample: PositionSample) -> None:
        """Take the position from a topic, if asked to; one that moved starts anew."""
        if self.params.position_source != 'topic':
            return
        position = ecef_from_geodetic(*sample.geodetic)
        if float(np.linalg.norm(position - self.position)) > _MOVED:
            self.reset()
            self.position[:] = position
        self.tally.accept('base/position', sample.stamp)

    def on_gnss(self, epoch: GnssEpoch) -> Corrections | None:
        """Return the corrections of one epoch, or None."""
        rows = epoch.rows
        good = (rows[:, 2] == 1.0) & np.isfinite(rows[:, [3, 9, 10, 11, 15]]).all(axis=1)
        good &= ((rows[:, 0] == 0.0) | (rows[:, 0] == 1.0)) & (rows[:, 1] >= 1.0) & (rows[:, 1] < 40.0)
        rows = rows[good]
        table, tail = self.state[: 4 * _SLOTS].reshape(_SLOTS, 4), self.state[4 * _SLOTS :]
        now = epoch.stamp / NANOSECONDS
        if tail[0] and now <= tail[0] and not self._went_back(now, table, tail):
            self.tally.reject('base/observations', 'not newer than the last epoch')
            return None
        dt = now - tail[0] if tail[0] else math.inf
        tail[9] = 0.0
        if not self.position.any():
            self.tally.reject('base/observations', 'base position not known yet')
            return None
        residuals, above = self._residuals(rows)
        rows, residuals = rows[above], residuals[above]
        if len(rows) < 4 or not self._position_fits(rows, tail):
            self.tally.reject(
                'base/observations', 'wrong base position' if len(rows) >= 4 else 'fewer than 4 satellites'
            )
            tail[0] = now
            return None
        ranges = self._smooth(rows, residuals, table, dt)
        out = np.empty((len(rows), 5))
        slots = (rows[:, 0] * 40 + rows[:, 1]).astype(int)
        out[:, :2] = rows[:, :2]
        out[:, 2] = -ranges
        rates = np.array([self._rate(row) for row in rows])
        if np.isfinite(rates).any():
            rates -= np.nanmedian(rates)
        # Atmosphere changes by millimetres a second: what a Doppler shows of it is its own noise.
        out[:, 3] = np.where(np.abs(rates) > self.params.rate_threshold, -rates, 0.0)
        out[:, 4] = 0.0
        table[slots, 3] = out[:, 2]
        tail[0] = now
        self.tally.accept('base/observations', epoch.stamp)
        return Corrections(epoch.stamp, out)

    def _went_back(self, now: float, table: np.ndarray, tail: np.ndarray) -> bool:
        """Whether so many epochs were older than the last that it was the last that was wrong: start anew."""
        tail[9] = tail[9] + 1.0 if now > tail[1] else 1.0
        tail[1] = now
        if tail[9] < _OLDER:
            return False
        table[:] = 0.0
        tail[0] = 0.0
        self.tally.restart(f'{_OLDER} epochs not newer than the last: smoothing starts anew')
        return True

    def _residuals(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return code minus geometry (m), base clock removed, and which satellites are above the mask."""
        lat, lon, _ = geodetic_from_ecef(self.position)
        los, zero = np.empty(3), np.zeros(3)
        raw, modelled, above = np.empty(len(rows)), np.empty(len(rows)), np.ones(len(rows), bool)
        for i, row in enumerate(rows):
            distance, _ = range_and_rate(row[9:15], self.position, zero, los)
            above[i] = azimuth_elevation(los, lat, lon)[1] >= self.params.elevation_mask
            raw[i] = row[3] + SPEED_OF_LIGHT * row[15] - distance
            modelled[i] = raw[i] - np.nansum(row[17:19])
        clocks = {}
        for system in (0.0, 1.0):
            mine = above & (rows[:, 0] == system)
            clocks[system] = float(np.median(modelled[mine])) if mine.any() else 0.0
        # Galileo's own median would swallow the rover's inter-system bias: one clock for both.
        clock = clocks[0.0] if (above & (rows[:, 0] == 0.0)).any() else clocks[1.0]
        return raw - clock, above

    def _position_fits(self, rows: np.ndarray, tail: np.ndarray) -> bool:
        p = self.params
        ranges = rows[:, 3] + SPEED_OF_LIGHT * rows[:, 15] - np.nansum(rows[:, 17:19], axis=1)
        fix = solve_position(rows[:, 9:15], ranges, np.full(len(rows), 3.0), rows[:, 0], self.position)
        if fix.status != OK:
            return True
        count = min(tail[5] + 1.0, float(p.position_epochs))
        tail[2:5] += (fix.position - self.position - tail[2:5]) / count
        tail[5] = count
        offset = float(np.linalg.norm(tail[2:5]))
        self.wrong_position = offset if count >= p.position_epochs and offset > p.position_limit else None
        return self.wrong_position is None

    def _smooth(self, rows: np.ndarray, residuals: np.ndarray, table: np.ndarray, dt: float) -> np.ndarray:
        out = residuals.copy()
        phases = np.array([row[4] * wavelength(row[2]) for row in rows])
        geometry = rows[:, 3] - residuals
        for i, row in enumerate(rows):
            slot = table[int(row[0]) * 40 + int(row[1])]
            # Phase minus geometry and clock moves only with atmosphere and ambiguity.
            phase = phases[i] - geometry[i]
            usable = math.isfinite(phase) and slot[2] > 0.0 and dt < _SMOOTHING_GAP and not row[8] > 0.0
            expected = slot[1] + phase - slot[0]
            if usable and abs(residuals[i] - expected) < self.params.slip_limit:
                count = min(slot[2] + 1.0, max(1.0, self.params.smoothing / dt))
                out[i] = expected + (residuals[i] - expected) / count
                slot[2] = count
            else:
                slot[2] = 1.0
            slot[0], slot[1] = (phase, out[i]) if math.isfinite(phase) else (0.0, 0.0)
            if not math.isfinite(phase):
                slot[2] = 0.0
        return out

    def _rate(self, row: np.ndarray) -> float:
        if not math.isfinite(row[5]):
            return math.nan
        predicted = range_and_rate(row[9:15], self.position, np.zeros(3), np.empty(3))[1]
        return -row[5] * wavelength(row[2]) + SPEED_OF_LIGHT * row[16] - predicted

    def diagnostics(self) -> dict[str, Any]:
        """Return whether the configured position fits what the receiver measures."""
        offset = float(np.linalg.norm(self.state[4 * _SLOTS + 2 : 4 * _SLOTS + 5]))
        values: dict[str, Any] = {'offset of own fix (m)': offset}
        if not self.position.any():
            values['level'], values['message'] = _WARN, 'waits for a position on base/position'
        if self.wrong_position is not None:
            values['level'] = _ERROR
            values['message'] = f'base position is wrong by about {self.wrong_position:.0f} m'
        return values
