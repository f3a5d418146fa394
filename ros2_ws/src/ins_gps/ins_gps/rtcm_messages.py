# SPDX-License-Identifier: Apache-2.0
"""RTCM 3 messages as pyrtcm reads them to rows: MSM4-MSM7, ephemerides 1019, 1045 and 1046, positions.

Source: RTCM 10403.3, tables 3.4-1, 3.5-71 … 3.5-91, 3.5-21 and 3.5-105 f. Phase ranges grow with range as
pseudoranges do; a phase-range rate is that of the range, so that the Doppler shift is −rate/λ.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ins_gps.broadcast import galileo_accuracy, gps_accuracy, is_orbit, near
from ins_gps.channels import wavelength
from ins_gps.constants import GALILEO, GPS, SPEED_OF_LIGHT, SYSTEM_LETTERS, WEEK
from ins_gps.orbit import ephemeris_row
from ins_gps.rinex import CODES

MSM_SYSTEMS = {'107': GPS, '109': GALILEO}
MSM_KINDS = '4567'
_MILLISECOND = SPEED_OF_LIGHT * 1e-3  # m
_PI = 3.1415926535898  # value the interface documents prescribe for semicircles
_GALILEO_WEEK = 1024  # GPS week of Galileo's week 0
_GROUND = (6.34e6, 6.4e6)  # m from the Earth's centre
_LARGEST = {GPS: 32, GALILEO: 36}  # satellite numbers
# What stands for "not available"; fine values of both resolutions have the same one.
_NO_RANGE = 255  # ms
_NO_CODE, _NO_PHASE = -(2.0**-10), -(2.0**-8)  # ms
_NO_RATE, _NO_FINE_RATE = -8192, -1.6384  # m/s


class Cell(NamedTuple):
    """One signal of a satellite; NaN where not available.

    row: as in `RawEpoch` without the loss-of-lock indicator. lock: the phase has been tracked for at least
    lock[0] and less than lock[1] (s). half: its ambiguity may be off by half a cycle.
    """

    row: tuple[float, ...]
    code: str
    lock: tuple[float, float]
    half: bool


class Msm(NamedTuple):
    """Observations of one constellation; `tow` in ms; `more` of the same epoch will follow."""

    station: int
    tow: int
    more: bool
    cells: list[Cell]


def lock_coarse(indicator: int) -> tuple[float, float]:
    """Return the bounds (s) of the lock time of DF402."""
    low = 0.0 if indicator == 0 else 2.0 ** (indicator + 4) * 1e-3
    return low, math.inf if indicator >= 15 else 2.0 ** (indicator + 5) * 1e-3


def lock_fine(indicator: int) -> tuple[float, float]:
    """Return the bounds (s) of the lock time of DF407; of a reserved value: nothing is known."""
    if indicator > 704:
        return 0.0, math.inf
    step = 0 if indicator < 64 else (indicator - 32) // 32
    low = 2**step * (indicator - 32 * step)
    return low * 1e-3, math.inf if indicator == 704 else (low + 2**step) * 1e-3


def read_msm(message: Any) -> Msm:
    """Return the observations of an MSM4, 5, 6 or 7 of GPS or Galileo.

    Of several signals in one band the preferred one is taken, in the order of `rinex.CODES`. ValueError for
    a time that no week has.
    """
    system = MSM_SYSTEMS[message.identity[:3]]
    tow = message.DF004 if system == GPS else message.DF248
    if tow >= WEEK * 1000:
        raise ValueError('time of week')
    satellites = {getattr(message, f'PRN_{i:02d}'): i for i in range(1, message.NSat + 1)}
    best: dict[tuple[int, int], tuple[int, Cell]] = {}
    for i in range(1, message.NCell + 1):
        name, code = getattr(message, f'CELLPRN_{i:02d}'), getattr(message, f'CELLSIG_{i:02d}')
        if not name.isdigit() or not code[:1].isdigit() or not 1 <= int(name) <= _LARGEST[system]:
            continue
        codes = CODES.get((SYSTEM_LETTERS[system], int(code[0])), ())
        if code not in codes:
            continue
        cell = _cell(message, i, satellites[name], system, int(name), code)
        key, rank = (int(name), int(code[0])), codes.index(code)
        if cell is not None and (key not in best or rank < best[key][0]):
            best[key] = rank, cell
    return Msm(message.DF003, tow, bool(message.DF393), [cell for _, cell in best.values()])


def _cell(message: Any, i: int, satellite: int, system: int, number: int, code: str) -> Cell | None:
    def satellite_field(name: str) -> Any:
        return getattr(message, f'{name}_{satellite:02d}')

    def cell_field(name: str) -> Any:
        return getattr(message, f'{name}_{i:02d}')

    kind, band = message.identity[3], int(code[0])
    fine = kind in '67'
    if satellite_field('DF397') == _NO_RANGE:
        return None
    rough = satellite_field('DF397') + satellite_field('DF398')
    code_part, phase_part = cell_field('DF405' if fine else 'DF400'), cell_field('DF406' if fine else 'DF401')
    pseudorange = math.nan if code_part == _NO_CODE else (rough + code_part) * _MILLISECOND
    phase = math.nan if phase_part == _NO_PHASE else (rough + phase_part) * _MILLISECOND / wavelength(band)
    if math.isnan(pseudorange) and math.isnan(phase):
        return None
    doppler = math.nan
    if kind in '57':
        rate, fine_rate = satellite_field('DF399'), cell_field('DF404')
        if rate != _NO_RATE and abs(fine_rate - _NO_FINE_RATE) > 1e-9:
            doppler = -(rate + fine_rate) / wavelength(band)
    cn0 = float(cell_field('DF408' if fine else 'DF403'))
    lock = lock_fine(cell_field('DF407')) if fine else lock_coarse(cell_field('DF402'))
    row = (system, number, band, pseudorange, phase, doppler, cn0 if cn0 > 0.0 else math.nan)
    return Cell(row, code, lock, bool(cell_field('DF420')))


class BroadcastEphemeris(NamedTuple):
    """An ephemeris whose week is not resolved: week as sent, modulo `cycle`; fields of `ephemeris_row`."""

    system: int
    satellite: int
    week: int
    cycle: int
    clock: str  # message that its clock belongs to: lnav, inav, fnav
    values: dict[str, float]

    def row(self, time: float) -> np.ndarray | None:
        """Return the row of `ins_gps.orbit` near `time` (GPS s), None for one that is no orbit."""
        values = dict(self.values)
        if not is_orbit(values['sqrt_a'], values['eccentricity']):
            return None
        values['toe'], values['toc'] = near(values['week_second'], time), near(values['toc'], time)
        return ephemeris_row(system=self.system, satellite=self.satellite, **values)


# Field of `ephemeris_row` by the numbers of 1019 and of 1045/1046, and whether it is in semicircles.
_ELEMENTS = {
    'inclination_rate': ('DF079', 'DF292', True), 'toc': ('DF081', 'DF293', False),
    'af2': ('DF082', 'DF294', False), 'af1': ('DF083', 'DF295', False), 'af0': ('DF084', 'DF296', False),
    'crs': ('DF086', 'DF297', False), 'delta_n': ('DF087', 'DF298', True),
    'mean_anomaly': ('DF088', 'DF299', True), 'cuc': ('DF089', 'DF300', False),
    'eccentricity': ('DF090', 'DF301', False), 'cus': ('DF091', 'DF302', False),
    'sqrt_a': ('DF092', 'DF303', False), 'week_second': ('DF093', 'DF304', False),
    'cic': ('DF094', 'DF305', False), 'ascending_node': ('DF095', 'DF306', True),
    'cis': ('DF096', 'DF307', False), 'inclination': ('DF097', 'DF308', True),
    'crc': ('DF098', 'DF309', False), 'perigee': ('DF099', 'DF310', True),
    'node_rate': ('DF100', 'DF311', True),
}  # fmt: skip


def read_ephemeris(message: Any) -> BroadcastEphemeris:
    """Return the ephemeris of a 1019, 1045 or 1046; ValueError for a satellite number that is none."""
    gps = message.identity == '1019'
    system, satellite = (GPS, message.DF009) if gps else (GALILEO, message.DF252)
    if not 1 <= satellite <= _LARGEST[system]:
        raise ValueError('satellite number')
    values = {
        name: getattr(message, first if gps else second) * (_PI if angle else 1.0)
        for name, (first, second, angle) in _ELEMENTS.items()
    }
    if gps:
        values |= {'group_delay': message.DF101, 'health': message.DF102, 'issue': message.DF071}
        values['accuracy'] = gps_accuracy(message.DF077)
        return BroadcastEphemeris(GPS, satellite, message.DF076, 1024, 'lnav', values)
    values['issue'] = message.DF290
    # Health in RINEX's bits: data validity and status of E1-B, E5a, E5b from the lowest on.
    if message.identity == '1046':
        values['accuracy'] = galileo_accuracy(message.DF286)
        values['group_delay'] = values['delay_7'] = message.DF313
        values['delay_5'] = message.DF312
        values['health'] = message.DF316 << 7 | message.DF317 << 6 | message.DF287 << 1 | message.DF288
        clock = 'inav'
    else:
        values['accuracy'] = galileo_accuracy(message.DF291)
        values['group_delay'] = message.DF312
        values['health'] = message.DF314 << 4 | message.DF315 << 3
        clock = 'fnav'
    return BroadcastEphemeris(GALILEO, satellite, message.DF289 + _GALILEO_WEEK, 4096, clock, values)


def read_position(message: Any) -> np.ndarray:
    """Return the antenna's reference point (3,), ECEF m, of a 1005 or 1006; ValueError off the ground."""
    position = np.array([message.DF025, message.DF026, message.DF027], dtype=float)
    if not _GROUND[0] < float(np.linalg.norm(position)) < _GROUND[1]:
        raise ValueError('not on the ground')
    return position
