# SPDX-License-Identifier: Apache-2.0
"""Navigation messages as broadcast, GPS LNAV and Galileo I/NAV, to rows of `ins_gps.orbit`.

Sources: IS-GPS-200N section 20.3.3 and figure 20-1; Galileo OS SIS ICD 2.1 section 4.3.5.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ins_gps.constants import GALILEO, GPS, WEEK
from ins_gps.orbit import COLUMN, COLUMNS, ephemeris_row

# Value both interface documents prescribe for semicircles.
_PI = 3.1415926535898
_LNAV_BITS = 240  # ten words without their parity
_INAV_BITS = 128  # 112 of the even page, 16 of the odd
_LNAV_PREAMBLE = 0x8B
# The ionosphere's page 18 of subframe 4, by the identifier that stands in place of a satellite number.
_IONOSPHERE_PAGE = 56
_KEPT = 2  # issues kept per satellite: the one in use and the one before


class _Cell(NamedTuple):
    part: int  # subframe or word type
    start: int
    length: int
    signed: bool
    scale: float


def _unsigned(word: int, size: int, start: int, length: int) -> int:
    return (word >> (size - start - length)) & ((1 << length) - 1)


def _value(word: int, size: int, cell: _Cell) -> float:
    number = _unsigned(word, size, cell.start, cell.length)
    if cell.signed and number >> (cell.length - 1):
        number -= 1 << cell.length
    return number * cell.scale


_ANGLE = 2.0**-31 * _PI
_LNAV = {
    'group_delay': _Cell(1, 160, 8, True, 2.0**-31),
    'toc': _Cell(1, 176, 16, False, 16.0),
    'af2': _Cell(1, 192, 8, True, 2.0**-55),
    'af1': _Cell(1, 200, 16, True, 2.0**-43),
    'af0': _Cell(1, 216, 22, True, 2.0**-31),
    'health': _Cell(1, 64, 6, False, 1.0),
    'accuracy': _Cell(1, 60, 4, False, 1.0),
    'issue': _Cell(2, 48, 8, False, 1.0),
    'crs': _Cell(2, 56, 16, True, 2.0**-5),
    'delta_n': _Cell(2, 72, 16, True, 2.0**-43 * _PI),
    'mean_anomaly': _Cell(2, 88, 32, True, _ANGLE),
    'cuc': _Cell(2, 120, 16, True, 2.0**-29),
    'eccentricity': _Cell(2, 136, 32, False, 2.0**-33),
    'cus': _Cell(2, 168, 16, True, 2.0**-29),
    'sqrt_a': _Cell(2, 184, 32, False, 2.0**-19),
    'week_second': _Cell(2, 216, 16, False, 16.0),
    'cic': _Cell(3, 48, 16, True, 2.0**-29),
    'ascending_node': _Cell(3, 64, 32, True, _ANGLE),
    'cis': _Cell(3, 96, 16, True, 2.0**-29),
    'inclination': _Cell(3, 112, 32, True, _ANGLE),
    'crc': _Cell(3, 144, 16, True, 2.0**-5),
    'perigee': _Cell(3, 160, 32, True, _ANGLE),
    'node_rate': _Cell(3, 192, 24, True, 2.0**-43 * _PI),
    'inclination_rate': _Cell(3, 224, 14, True, 2.0**-43 * _PI),
}
# Low byte of IODC, and IODE of subframes 2 and 3: equal when the three belong together.
_LNAV_ISSUES = ((1, 168, 8), (2, 48, 8), (3, 216, 8))
_INAV = {
    'issue': _Cell(1, 6, 10, False, 1.0),
    'week_second': _Cell(1, 16, 14, False, 60.0),
    'mean_anomaly': _Cell(1, 30, 32, True, _ANGLE),
    'eccentricity': _Cell(1, 62, 32, False, 2.0**-33),
    'sqrt_a': _Cell(1, 94, 32, False, 2.0**-19),
    'ascending_node': _Cell(2, 16, 32, True, _ANGLE),
    'inclination': _Cell(2, 48, 32, True, _ANGLE),
    'perigee': _Cell(2, 80, 32, True, _ANGLE),
    'inclination_rate': _Cell(2, 112, 14, True, 2.0**-43 * _PI),
    'node_rate': _Cell(3, 16, 24, True, 2.0**-43 * _PI),
    'delta_n': _Cell(3, 40, 16, True, 2.0**-43 * _PI),
    'cuc': _Cell(3, 56, 16, True, 2.0**-29),
    'cus': _Cell(3, 72, 16, True, 2.0**-29),
    'crc': _Cell(3, 88, 16, True, 2.0**-5),
    'crs': _Cell(3, 104, 16, True, 2.0**-5),
    'accuracy': _Cell(3, 120, 8, False, 1.0),
    'cic': _Cell(4, 22, 16, True, 2.0**-29),
    'cis': _Cell(4, 38, 16, True, 2.0**-29),
    'toc': _Cell(4, 54, 14, False, 60.0),
    'af0': _Cell(4, 68, 31, True, 2.0**-34),
    'af1': _Cell(4, 99, 21, True, 2.0**-46),
    'af2': _Cell(4, 120, 6, True, 2.0**-59),
    'delay_5': _Cell(5, 47, 10, True, 2.0**-32),
    'delay_7': _Cell(5, 57, 10, True, 2.0**-32),
}
_INAV_ISSUES = tuple((word, 6, 10) for word in (1, 2, 3, 4))
_IONOSPHERE = tuple(
    _Cell(4, 56 + 8 * i, 8, True, 2.0**power) for i, power in enumerate((-30, -27, -24, -24, 11, 14, 16, 16))
)


def lnav_subframe(words: list[int]) -> int | None:
    """Return the 240 data bits of ten 30-bit LNAV words (right aligned), None if they are no subframe."""
    if len(words) != 10 or words[0] >> 22 & 0xFF != _LNAV_PREAMBLE:
        return None
    bits = 0
    for word in words:
        bits = bits << 24 | word >> 6 & 0xFFFFFF
    return bits


def inav_word(words: list[int]) -> int | None:
    """Return the 128 bits of an I/NAV word from a pair of pages in eight 32-bit words.

    None unless the first four are a nominal even page and the last four a nominal odd page.
    """
    if len(words) < 8 or words[0] >> 30 != 0b00 or words[4] >> 30 != 0b10:
        return None
    even = words[0] << 96 | words[1] << 64 | words[2] << 32 | words[3]
    return _unsigned(even, 128, 2, 112) << 16 | _unsigned(words[4], 32, 2, 16)


def gps_accuracy(index: float) -> float:
    """Return metres of a URA index (IS-GPS-200N 20.3.3.3.1.3, nominal values); 15: 0, unknown."""
    if index >= 15:
        return 0.0
    return round(2.0 ** (1.0 + index / 2.0), 1) if index <= 6 else 2.0 ** (index - 2.0)


def galileo_accuracy(index: float) -> float:
    """Return metres of a SISA index (OS SIS ICD table 91); above 125: 0, unknown."""
    steps = ((50, 0.0, 0.01, 0), (75, 0.5, 0.02, 50), (100, 1.0, 0.04, 75), (126, 2.0, 0.16, 100))
    for end, start, step, first in steps:
        if index < end:
            return start + (index - first) * step
    return 0.0


def _galileo_health(word: int) -> float:
    """Return the RINEX health bits of E1-B and E5b from word type 5."""
    e5b, e1b = _unsigned(word, 128, 67, 2), _unsigned(word, 128, 69, 2)
    e5b_data, e1b_data = _unsigned(word, 128, 71, 1), _unsigned(word, 128, 72, 1)
    return float(e5b << 7 | e5b_data << 6 | e1b << 1 | e1b_data)


def near(second: float, time: float) -> float:
    """Return the GPS time nearest to `time` at this second of the week."""
    return time + (second - time % WEEK + WEEK / 2) % WEEK - WEEK / 2


def is_orbit(sqrt_a: float, eccentricity: float) -> bool:
    """Return whether these can be of a GNSS satellite; zeros of one that is being set up are not."""
    return sqrt_a >= 4000.0 and eccentricity <= 0.5


class BroadcastStore:
    """Collects navigation messages and makes ephemerides of complete sets.

    `ephemerides` (k, COLUMNS) is replaced, never changed in place; `klobuchar` (8,) is NaN until broadcast.
    """

    def __init__(self) -> None:
        self.ephemerides = np.empty((0, COLUMNS))
        self.klobuchar = np.full(8, np.nan)
        self._parts: dict[tuple[int, int], dict[int, int]] = {}
        self._pending: set[tuple[int, int]] = set()

    def add_lnav(self, satellite: int, words: list[int]) -> bool:
        """Take one GPS subframe; False if it is none."""
        bits = lnav_subframe(words)
        if bits is None:
            return False
        number = _unsigned(bits, _LNAV_BITS, 43, 3)
        body = bits & ((1 << 192) - 1)  # without the time of week, which changes each time
        if number == 4 and _unsigned(body, _LNAV_BITS, 50, 6) == _IONOSPHERE_PAGE:
            self.klobuchar = np.array([_value(body, _LNAV_BITS, cell) for cell in _IONOSPHERE])
        elif number in (1, 2, 3):
            self._keep((GPS, satellite), number, body)
        return True

    def add_inav(self, satellite: int, words: list[int]) -> bool:
        """Take one Galileo I/NAV page pair; False if it is none."""
        bits = inav_word(words)
        if bits is None:
            return False
        number = _unsigned(bits, _INAV_BITS, 0, 6)
        if 1 <= number <= 5:
            self._keep((GALILEO, satellite), number, bits)
        return True

    def _keep(self, key: tuple[int, int], number: int, bits: int) -> None:
        parts = self._parts.setdefault(key, {})
        if parts.get(number) != bits:
            parts[number] = bits
            self._pending.add(key)

    def update(self, time: float) -> None:
        """Make ephemerides of what came since the last call; `time` (GPS s) tells the week."""
        for key in self._pending:
            row = _assemble(key, self._parts[key], time)
            if row is not None:
                self.store(row)
        self._pending.clear()

    def store(self, row: np.ndarray) -> None:
        """Take an ephemeris (COLUMNS,) in place of the oldest kept one of its satellite."""
        same = (self.ephemerides[:, 0] == row[0]) & (self.ephemerides[:, 1] == row[1])
        others, own = self.ephemerides[~same], self.ephemerides[same]
        toe, issue = COLUMN['toe'], COLUMN['issue']
        own = own[(own[:, toe] != row[toe]) | (own[:, issue] != row[issue])]
        self.ephemerides = np.vstack([others, own[1 - _KEPT :], row])


def _assemble(key: tuple[int, int], parts: dict[int, int], time: float) -> np.ndarray | None:
    system, satellite = key
    gps = system == GPS
    size, cells, issues = (_LNAV_BITS, _LNAV, _LNAV_ISSUES) if gps else (_INAV_BITS, _INAV, _INAV_ISSUES)
    if any(cell.part not in parts for cell in cells.values()):
        return None
    if len({_unsigned(parts[part], size, start, length) for part, start, length in issues}) > 1:
        return None  # an upload is under way
    values = {name: _value(parts[cell.part], size, cell) for name, cell in cells.items()}
    if not is_orbit(values['sqrt_a'], values['eccentricity']):
        return None
    values['accuracy'] = (gps_accuracy if gps else galileo_accuracy)(values['accuracy'])
    if not gps:
        values['health'] = _galileo_health(parts[5])
        values['group_delay'] = values['delay_7']  # the clock of I/NAV is that of E1 and E5b
    values['toc'] = near(values['toc'], time)
    values['toe'] = near(values['week_second'], time)
    row = ephemeris_row(system=system, satellite=satellite, **values)
    return row if math.isfinite(row.sum()) else None
