# SPDX-License-Identifier: Apache-2.0
"""The Modbus register map: what stands at which address, as data.

Addresses are those on the wire (from 0). Registers of more than one word are high word first, words high
byte first. Unknown values: int16 0x8000, uint16 0xFFFF, float32 NaN.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from pymodbus.simulator import DataType, SimData, SimDevice

MAP_VERSION = 2
# To find out the word order of a PLC: these must read as printed.
CHECK_UINT32 = 0x12345678
CHECK_FLOAT32 = 1234.5
UNKNOWN_INT16, UNKNOWN_UINT16 = 0x8000, 0xFFFF
_LARGEST_FLOAT32 = 3.4028234e38


@dataclass(frozen=True, slots=True)
class Field:
    """One value of the input block: `scale` units per count for integers; `turn`: it begins anew there."""

    name: str
    kind: str
    unit: str
    scale: float
    text: str
    turn: float = 0.0


def _measured() -> tuple[Field, ...]:
    names = (
        ('roll', 'i16', '°', 0.01, 'heel, positive to starboard'),
        ('pitch', 'i16', '°', 0.01, 'trim, positive bow up'),
        ('heading', 'u16', '°', 0.01, 'clockwise from north', 360.0),
        ('roll_period', 'u16', 's', 0.01, 'between the last two maxima on the same side'),
        ('amplitude_port', 'u16', '°', 0.01, 'last maximum to port'),
        ('amplitude_starboard', 'u16', '°', 0.01, 'last maximum to starboard'),
        ('peak_port', 'u16', '°', 0.01, 'largest heel to port since the reset'),
        ('peak_starboard', 'u16', '°', 0.01, 'largest heel to starboard since the reset'),
        ('roll_rate', 'i16', '°/s', 0.01, 'positive to starboard'),
        ('pitch_rate', 'i16', '°/s', 0.01, 'positive bow up'),
        ('turn_rate', 'i16', '°/min', 0.1, 'positive to starboard'),
        ('sigma_roll', 'u16', '°', 0.001, '1σ of roll'),
        ('sigma_pitch', 'u16', '°', 0.001, '1σ of pitch'),
        ('sigma_heading', 'u16', '°', 0.001, '1σ of heading'),
    )
    return tuple(Field(*row) for row in names)


MEASURED = _measured()
INPUT_FIELDS: tuple[Field, ...] = (
    Field('map_version', 'u16', '', 1.0, 'version of this map'),
    Field('status', 'u16', '', 1.0, 'bit n is discrete input n'),
    Field('sequence', 'u16', '', 1.0, 'counts updates, repeated as the last register'),
    Field('utc_seconds', 'u32', 's', 1.0, 'since 1970'),
    Field('utc_milliseconds', 'u16', 'ms', 1.0, ''),
    Field('age', 'u16', 'ms', 1.0, 'since the measurement'),
    *MEASURED,
    *(Field(f'{f.name}_float', 'f32', f.unit, 1.0, f'{f.text}, float32', f.turn) for f in MEASURED),
    Field('check_uint32', 'u32', '', 1.0, 'always 0x12345678'),
    Field('check_float32', 'f32', '', 1.0, 'always 1234.5'),
    Field('status_more', 'u16', '', 1.0, 'bit n is discrete input 16 + n'),
    Field('sequence_copy', 'u16', '', 1.0, 'equals `sequence` unless a read was torn'),
)
_WORDS = {'i16': 1, 'u16': 1, 'u32': 2, 'f32': 2}


def _addresses() -> dict[str, int]:
    address, out = 0, {}
    for field in INPUT_FIELDS:
        out[field.name] = address
        address += _WORDS[field.kind]
    return out


INPUT_ADDRESS = _addresses()
INPUT_COUNT = sum(_WORDS[f.kind] for f in INPUT_FIELDS)

DISCRETE = (
    'valid',
    'degraded',
    'invalid',
    'heading_valid',
    'rolling',
    'no_roll',
    'alarm_active',
    'alarm_unacknowledged',
    'heel_warning',
    'heel_alarm',
    'roll_alarm',
    'pitch_alarm',
    'resonance_warning',
    'sensor_alarm',
    'stop_flag',
    'unlocked',
    'alarms_unknown',
    'roll_unknown',
)
COILS = ('acknowledge', 'peak_reset', 'log_mark', 'stop_set', 'stop_clear')


@dataclass(frozen=True, slots=True)
class Setting:
    """One holding register that holds a setting; limits in its unit."""

    name: str
    unit: str
    scale: float
    low: float
    high: float
    default: float
    text: str


SETTINGS = (
    Setting('heel_warning', '°', 0.1, 1.0, 60.0, 10.0, 'heel that warns'),
    Setting('heel_alarm', '°', 0.1, 1.0, 80.0, 20.0, 'heel that alarms'),
    Setting('roll_alarm', '°', 0.1, 1.0, 60.0, 15.0, 'roll amplitude that alarms'),
    Setting('pitch_alarm', '°', 0.1, 1.0, 45.0, 8.0, 'trim that alarms'),
    Setting('hysteresis', '°', 0.1, 0.1, 10.0, 1.0, 'return below a threshold that ends an alarm'),
    Setting('alarm_delay', 's', 0.1, 0.0, 600.0, 2.0, 'time above a threshold before an alarm'),
    Setting('silence_time', 's', 1.0, 0.0, 3600.0, 30.0, 'time for which silence lasts'),
    Setting('roll_offset', '°', 0.01, -10.0, 10.0, 0.0, 'added to heel'),
    Setting('pitch_offset', '°', 0.01, -10.0, 10.0, 0.0, 'added to trim'),
    Setting('heading_offset', '°', 0.01, -180.0, 180.0, 0.0, 'added to heading'),
    Setting('display_filter', 's', 0.01, 0.0, 5.0, 0.0, 'time constant of the displayed heel'),
)
# An alarm ends by the hysteresis below its threshold, which therefore must be the smaller one.
THRESHOLDS = ('heel_warning', 'heel_alarm', 'roll_alarm', 'pitch_alarm')
UNLOCK, SAVE, SETTINGS_CRC, REMAINING = 0, 1, 2, 3
FIRST_SETTING = 10
SAVE_COMMAND = 0x5A5A
HOLDING = {UNLOCK, SAVE, SETTINGS_CRC, REMAINING} | {FIRST_SETTING + i for i in range(len(SETTINGS))}
WRITABLE = HOLDING - {SETTINGS_CRC, REMAINING}


def encode_field(field: Field, value: float) -> list[int]:
    """Return the words of one value; out of range counts as unknown."""
    if field.kind == 'f32':
        if not abs(value) < _LARGEST_FLOAT32:
            value = math.nan
        (single,) = struct.unpack('>f', struct.pack('>f', value))
        # Rounded to 32 bits, a heading just under 360 has become 360.
        high, low = struct.unpack('>HH', struct.pack('>f', single % field.turn if field.turn else single))
        return [high, low]
    if field.kind == 'u32':
        high, low = divmod(int(value) & 0xFFFFFFFF, 0x10000)
        return [high, low]
    signed = field.kind == 'i16'
    if not math.isfinite(value):
        return [UNKNOWN_INT16 if signed else UNKNOWN_UINT16]
    count = round(value / field.scale)
    if field.turn:
        count %= round(field.turn / field.scale)
    if signed:
        return [count & 0xFFFF] if -0x7FFF <= count <= 0x7FFF else [UNKNOWN_INT16]
    return [count] if 0 <= count < 0xFFFF or (field.scale == 1.0 and count == 0xFFFF) else [UNKNOWN_UINT16]


def input_words(values: Mapping[str, float]) -> list[int]:
    """Return the input block; `values` by name of the fields, measured ones once (floats are copied)."""
    words: list[int] = []
    for field in INPUT_FIELDS:
        if field.name == 'sequence_copy':
            value: float = values['sequence']
        elif field.name == 'map_version':
            value = MAP_VERSION
        elif field.name == 'check_uint32':
            value = CHECK_UINT32
        elif field.name == 'check_float32':
            value = CHECK_FLOAT32
        else:
            value = values.get(field.name.removesuffix('_float'), math.nan)
        words += encode_field(field, value)
    return words


def setting_to_word(setting: Setting, value: float) -> int:
    """Return the register of a setting; negative values in two's complement."""
    return round(value / setting.scale) & 0xFFFF


def word_to_setting(setting: Setting, word: int) -> float:
    """Return the value of a register; raise ValueError when it is out of the setting's limits."""
    count = word - 0x10000 if setting.low < 0.0 and word >= 0x8000 else word
    value = count * setting.scale
    slack = 0.5 * setting.scale
    if not setting.low - slack < value < setting.high + slack:
        limits = f'{setting.low:g} … {setting.high:g} {setting.unit}'
        raise ValueError(f'{setting.name} = {value:g}, allowed: {limits}')
    return round(value, 6)


def build_device(unit: int) -> SimDevice:
    """Return the pymodbus device with the four separate blocks of this map."""
    bits = DataType.BITS
    registers = DataType.REGISTERS
    holding = [SimData(a, values=0, datatype=registers) for a in sorted(HOLDING)]
    return SimDevice(
        unit,
        (
            [SimData(0, values=[False] * 16, datatype=bits)],
            [SimData(0, values=[False] * len(DISCRETE), datatype=bits)],
            holding,
            [SimData(0, values=[0] * INPUT_COUNT, datatype=registers)],
        ),
    )


def map_markdown() -> str:
    """Return the map as tables for the README."""
    lines = ['| input register | name | type | unit | step | |', '|---|---|---|---|---|---|']
    for field in INPUT_FIELDS:
        step = f'{field.scale:g}' if field.kind in ('i16', 'u16') and field.unit else '–'
        lines.append(
            f'| {INPUT_ADDRESS[field.name]} | {field.name} | {field.kind} | {field.unit or "–"} | {step} '
            f'| {field.text} |'
        )
    lines += [
        '',
        '| holding register | name | unit | step | allowed | default | |',
        '|---|---|---|---|---|---|---|',
    ]
    lines += [
        f'| {UNLOCK} | unlock | – | – | key | 0 | the key opens writing for a time; reads 0 |',
        f'| {SAVE} | save | – | – | 0x{SAVE_COMMAND:04X} | 0 | writes the settings to the medium; reads 0 |',
        f'| {SETTINGS_CRC} | settings_crc | – | – | read only | | CRC-16 of the saved settings |',
        f'| {REMAINING} | unlocked_for | s | 1 | read only | 0 | time until writing locks again |',
    ]
    for i, s in enumerate(SETTINGS):
        lines.append(
            f'| {FIRST_SETTING + i} | {s.name} | {s.unit} | {s.scale:g} | {s.low:g} … {s.high:g} '
            f'| {s.default:g} | {s.text} |'
        )
    lines += ['', '| discrete input | | coil (reads 0, acts on 1) | |', '|---|---|---|---|']
    for i, name in enumerate(DISCRETE):
        coil = f'{i} | {COILS[i]}' if i < len(COILS) else '|'
        lines.append(f'| {i} | {name} | {coil} |')
    return '\n'.join(lines)
