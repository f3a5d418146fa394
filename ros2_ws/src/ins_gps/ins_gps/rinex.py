# SPDX-License-Identifier: Apache-2.0
"""RINEX 2 and 3 files of GPS and Galileo.

Navigation files go through georinex. Observation files have a small reader here: georinex drops the
loss-of-lock flags, truncates epochs to microseconds and merges one array per epoch, which takes seconds
per minute of data.
Source: IGS/RTCM, "RINEX version 3.04", tables A2-A8.
"""

from __future__ import annotations

import datetime
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ins_gps.constants import GALILEO, GPS, WEEK
from ins_gps.orbit import ephemeris_row

NANOSECONDS = 1_000_000_000
_GPS_EPOCH = datetime.datetime(1980, 1, 6)
_SYSTEMS = {'G': GPS, 'E': GALILEO}
# Observation codes by signal, in order of preference: tracked data and pilot before semi-codeless.
CODES = {
    ('G', 1): ('1C', '1X', '1L', '1S', '1P', '1W'),
    ('G', 2): ('2L', '2X', '2C', '2S', '2P', '2W'),
    ('G', 5): ('5X', '5Q', '5I'),
    ('E', 1): ('1C', '1X', '1B', '1A'),
    ('E', 5): ('5X', '5Q', '5I'),
    ('E', 7): ('7X', '7Q', '7I'),
}
# RINEX 2 has one letter per frequency; P2 and C2 are the same signal for a fix.
_CODES_V2 = {1: ('C1', 'P1'), 2: ('C2', 'P2'), 5: ('C5',)}
_END = ' \t\r\n\x1a'  # what may follow the last record; DOS programs end files with the last of these
# Flags of an epoch record: lines of the header's kind follow; slips that were taken out of the phases follow.
_EVENTS, _SLIPS = (2, 3, 4, 5), 6


class RinexError(ValueError):
    """A file is not what it should be; the message says which, where and what was expected."""


class RawEpoch(NamedTuple):
    """One epoch of one receiver.

    time: ns since 1980-01-06 on the receiver's clock. rows (m, 8): system, satellite, signal band
    (1, 2, 5, 7), pseudorange (m), carrier phase (cycles), Doppler (Hz, + approaching), C/N0 (dB-Hz),
    loss-of-lock indicator (bit 0: slip possible, bit 1: half cycle). NaN where not measured.
    """

    time: int
    rows: np.ndarray


@dataclass(frozen=True, slots=True)
class ObservationFile:
    """An observation file; `position` is the approximate ECEF position (m) of the header or NaN."""

    path: Path
    version: float
    position: np.ndarray
    epochs: list[RawEpoch] = field(repr=False)


@dataclass(frozen=True, slots=True)
class NavigationFile:
    """Ephemerides (k, COLUMNS) of `ins_gps.orbit` and the Klobuchar coefficients (8,), NaN if absent."""

    path: Path
    ephemerides: np.ndarray
    klobuchar: np.ndarray


def gps_nanoseconds(when: datetime.datetime, seconds: float) -> int:
    """Return ns since 1980-01-06 of a date to the minute and seconds."""
    minutes = int((when - _GPS_EPOCH).total_seconds())
    return minutes * NANOSECONDS + round(seconds * NANOSECONDS)


def _number(text: str) -> float:
    text = text.strip()
    return float(text) if text else np.nan


def _row(system: str, satellite: int, band: int, text: str, columns: tuple[int, ...]) -> list[float] | None:
    values = [np.nan] * 4
    lli = 0.0
    for slot, column in enumerate(columns):
        if column < 0:
            continue
        cell = text[16 * column : 16 * column + 16]
        value = _number(cell[:14])
        values[slot] = value if value != 0.0 else np.nan  # RINEX: zero or blank means not observed
        if slot == 1 and cell[14:15].strip():
            lli = float(int(cell[14]))
    if np.isnan(values[0]) and np.isnan(values[1]):
        return None
    return [_SYSTEMS[system], satellite, band, *values, lli]


def _columns_v3(system: str, types: list[str]) -> dict[int, tuple[int, ...]]:
    columns = {}
    for (letter, band), codes in CODES.items():
        if letter != system:
            continue
        for code in codes:
            if 'C' + code in types:
                names = [kind + code for kind in 'CLDS']
                columns[band] = tuple(types.index(n) if n in types else -1 for n in names)
                break
    return columns


def _columns_v2(types: list[str]) -> dict[int, tuple[int, ...]]:
    columns = {}
    for band, codes in _CODES_V2.items():
        for code in codes:
            if code in types:
                names = [code, f'L{band}', f'D{band}', f'S{band}']
                columns[band] = tuple(types.index(n) if n in types else -1 for n in names)
                break
    return columns


@dataclass(slots=True)
class _Header:
    version: float = 0.0
    types: dict[str, list[str]] = field(default_factory=dict)
    position: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))


def _read_header(path: Path, lines: list[str]) -> tuple[_Header, int]:
    header = _Header()
    system = ' '
    for number, line in enumerate(lines):
        label = line[60:].strip()
        if label == 'RINEX VERSION / TYPE':
            header.version = _number(line[:9])
            if line[20:21] != 'O' or not 2.0 <= header.version < 5.0:
                raise RinexError(f'{path}, line {number + 1}: expected a RINEX 2-4 observation file')
        elif label == 'SYS / # / OBS TYPES':
            if line[0] != ' ':
                system = line[0]
            header.types.setdefault(system, []).extend(line[7:60].split())
        elif label == '# / TYPES OF OBSERV':
            header.types.setdefault('G', []).extend(line[6:60].split())
        elif label == 'APPROX POSITION XYZ':
            header.position = np.array([float(v) for v in line[:60].split()])
        elif label == 'END OF HEADER':
            if not header.version:
                break
            return header, number + 1
    raise RinexError(f'{path}: expected a RINEX header with version and END OF HEADER')


def read_observations(path: str | Path, bands: tuple[int, ...] = (1,)) -> ObservationFile:
    """Read an observation file; only signals in `bands` (RINEX band numbers) are kept.

    Raises RinexError (file, line, what was expected). Epochs in which power failed are kept, event
    records are skipped.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding='ascii', errors='replace').rstrip(_END).splitlines()
    except OSError as error:
        raise RinexError(f'{path}: cannot be read ({error.strerror})') from error
    header, start = _read_header(path, lines)
    parse = _epochs_v3 if header.version >= 3.0 else _epochs_v2
    try:
        epochs = parse(lines, start, header, bands)
    except (ValueError, IndexError) as error:
        raise RinexError(f'{path}: malformed observation record ({error})') from error
    return ObservationFile(path, header.version, header.position, epochs)


def _stack(time: int, rows: list[list[float]]) -> RawEpoch:
    return RawEpoch(time, np.array(rows) if rows else np.empty((0, 8)))


def _epochs_v3(lines: list[str], start: int, header: _Header, bands: tuple[int, ...]) -> list[RawEpoch]:
    columns = {
        s: {b: c for b, c in _columns_v3(s, header.types.get(s, [])).items() if b in bands} for s in _SYSTEMS
    }
    epochs = []
    index = start
    while index < len(lines):
        line = lines[index]
        if not line.startswith('>'):
            raise ValueError(f'line {index + 1}: expected an epoch record, found {line[:20]!r}')
        flag, count = int(line[31]), int(line[32:35])
        body = lines[index + 1 : index + 1 + count]
        # Satellites that were cut out of a file by hand still count in its epoch records.
        early = next((i for i, text in enumerate(body) if text.startswith('>')), None)
        if early is not None:
            body, count = body[:early], early
        index += 1 + count
        if flag > 1:
            continue
        if len(body) < count:
            break  # the recording was cut off within this epoch
        y, mo, d, h, mi = (int(line[a:b]) for a, b in ((2, 6), (7, 9), (10, 12), (13, 15), (16, 18)))
        time = gps_nanoseconds(datetime.datetime(y, mo, d, h, mi), float(line[18:29]))
        rows = []
        for text in body:
            for band, cols in columns.get(text[0], {}).items():
                row = _row(text[0], int(text[1:3]), band, text[3:], cols)
                if row is not None:
                    rows.append(row)
        epochs.append(_stack(time, rows))
    return epochs


def _epochs_v2(lines: list[str], start: int, header: _Header, bands: tuple[int, ...]) -> list[RawEpoch]:
    types = header.types.get('G', [])
    columns = {b: c for b, c in _columns_v2(types).items() if b in bands}
    per_satellite = (len(types) + 4) // 5
    epochs = []
    index = start
    while index < len(lines):
        line = lines[index]
        flag, count = int(line[28]), int(line[29:32])
        if flag in _EVENTS:
            index += 1 + count
            continue
        y, mo, d, h, mi = (int(line[a : a + 3]) for a in (0, 3, 6, 9, 12))
        year = y + (1900 if y >= 80 else 2000)
        time = gps_nanoseconds(datetime.datetime(year, mo, d, h, mi), float(line[15:26]))
        name_lines = (count + 11) // 12
        names = ''.join(text[32:68].ljust(36) for text in lines[index : index + name_lines])
        index += name_lines
        if flag == _SLIPS:
            # Its records are laid out as observations, each as many lines long.
            index += count * per_satellite
            continue
        if index + count * per_satellite > len(lines):
            break  # the recording was cut off within this epoch
        rows = []
        for k in range(count):
            text = ''.join(t.ljust(80) for t in lines[index : index + per_satellite])
            index += per_satellite
            system = names[3 * k].strip() or 'G'
            if system not in _SYSTEMS:
                continue
            for band, cols in columns.items():
                row = _row(system, int(names[3 * k + 1 : 3 * k + 3]), band, text, cols)
                if row is not None:
                    rows.append(row)
        epochs.append(_stack(time, rows))
    return epochs


_GEORINEX_NAMES = {
    'af0': 'SVclockBias',
    'af1': 'SVclockDrift',
    'af2': 'SVclockDriftRate',
    'sqrt_a': 'sqrtA',
    'eccentricity': 'Eccentricity',
    'inclination': 'Io',
    'ascending_node': 'Omega0',
    'perigee': 'omega',
    'mean_anomaly': 'M0',
    'delta_n': 'DeltaN',
    'inclination_rate': 'IDOT',
    'node_rate': 'OmegaDot',
    'cuc': 'Cuc',
    'cus': 'Cus',
    'crc': 'Crc',
    'crs': 'Crs',
    'cic': 'Cic',
    'cis': 'Cis',
    'week_second': 'Toe',
    'health': 'health',
}


def read_navigation(path: str | Path) -> NavigationFile:
    """Read the GPS and Galileo ephemerides of a RINEX 2 or 3 navigation file; RinexError if it cannot."""
    # Imported on first use: half a second, which a live receiver's node need not pay.
    import georinex

    path = Path(path)
    if not path.is_file():
        raise RinexError(f'{path}: no such file, expected a RINEX navigation file')
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', FutureWarning)
            data = georinex.load(path, use={'G', 'E'})
    except Exception as error:  # georinex raises whatever its parsers meet
        raise RinexError(f'{path}: not a RINEX navigation file that georinex can read ({error})') from error
    if data.attrs.get('rinextype') != 'nav':
        raise RinexError(f'{path}: expected a RINEX navigation file')
    klobuchar = np.asarray(data.attrs.get('ionospheric_corr_GPS', np.full(8, np.nan)), dtype=float)
    if klobuchar.shape != (8,):
        klobuchar = np.full(8, np.nan)
    return NavigationFile(path, _ephemerides(data), klobuchar)


def _ephemerides(data) -> np.ndarray:
    times = data['time'].values.astype('datetime64[ns]').astype(np.int64)
    gps_epoch = np.datetime64(_GPS_EPOCH, 'ns').astype(np.int64)
    columns = {name: data[name].values for name in data.data_vars}
    rows = []
    for j, label in enumerate(data['sv'].values):
        letter = str(label)[0]
        if letter not in _SYSTEMS:
            continue
        for i in np.flatnonzero(np.isfinite(columns['sqrtA'][:, j])):
            cell = {name: float(values[i, j]) for name, values in columns.items()}
            row = _one_ephemeris(letter, int(str(label)[1:3]), (times[i] - gps_epoch) / NANOSECONDS, cell)
            if np.all(np.isfinite(row)):
                rows.append(row)
    return np.array(rows) if rows else np.empty((0, len(ephemeris_row())))


def _one_ephemeris(letter: str, satellite: int, toc: float, cell: dict[str, float]) -> np.ndarray:
    # The week of toe follows from toc; the week number in the file is modulo 1024 in some and GST in others.
    toe = toc + (cell['Toe'] - toc % WEEK + WEEK / 2) % WEEK - WEEK / 2
    values = {name: cell[source] for name, source in _GEORINEX_NAMES.items()}
    if letter == 'E':
        e5a, e5b = cell.get('BGDe5a', np.nan), cell.get('BGDe5b', np.nan)
        # Bit 8 of the data source: clock for E5a/E1 (F/NAV); else E5b/E1 (I/NAV).
        fnav = int(cell.get('DataSrc', 0) or 0) & 256
        delay = e5a if fnav else e5b
        if np.isfinite(e5a):
            values['delay_5'] = e5a
        # F/NAV does not broadcast the delay of E5b: converters write 0 for it.
        if np.isfinite(e5b) and not (fnav and e5b == 0.0):
            values['delay_7'] = e5b
        values['accuracy'], values['issue'] = cell.get('SISA', np.nan), cell.get('IODnav', 0.0)
    else:
        delay = cell.get('TGD', 0.0)
        values['accuracy'], values['issue'] = cell.get('SVacc', np.nan), cell.get('IODE', 0.0)
    values['group_delay'] = delay if np.isfinite(delay) else 0.0
    if not np.isfinite(values['accuracy']):
        values['accuracy'] = 0.0
    return ephemeris_row(system=_SYSTEMS[letter], satellite=satellite, toe=toe, toc=toc, **values)
