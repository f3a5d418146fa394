# SPDX-License-Identifier: Apache-2.0
"""Mapping files: which columns of a table, or fields of a bag, become which fields of which messages.

::

    text: what the data is, where it comes from
    files: {imu: imu.csv}            # for a folder with several files; leave out for a single file
    csv: {delimiter: ',', header: true, skip: 0, comment: '#'}
    topics:
      - topic: imu/data_raw
        type: sensor_msgs/msg/Imu
        file: imu                    # which of `files`
        stamp: {column: t, unit: s, offset: 0.0}     # or {rate: 100.0} or {rate: name of a constant}
        frame_id: imu
        nan: skip                    # skip the row (default), error, or keep
        changes: false               # true: only rows that differ from the row before
        set: {'orientation_covariance[0]': -1.0}
        fields:
          angular_velocity: {columns: [wx, wy, wz], unit: deg/s, scale: [1, -1, -1]}
          linear_acceleration.x: {column: ax, unit: g}
          orientation: {euler: [roll, pitch, heading], unit: deg, scale: [1, -1, -1], add: [0, 0, 90]}

A field takes one `column`, or as many `columns` as it has components (x, y, z of a vector; w, x, y, z of a
quaternion; the elements of an array), or `euler` angles (roll, pitch, yaw). `columns` may name one
two-dimensional array. Each number becomes (number · scale + add) · unit in SI.

Out of a bag the columns are field paths of the topic that `from` names::

    copy: [truth/orientation]        # topics to take along as they are ('*': all that is not written)
    topics:
      - topic: imu/data_raw
        from: /sensor/imu
        type: sensor_msgs/msg/Imu
        stamp: {column: bag_time}    # when the bag says it came; or header.stamp, or any other field
        fields:
          angular_velocity: {columns: angular_velocity, scale: [1, -1, -1]}
          linear_acceleration: {columns: linear_acceleration, unit: g, scale: [1, -1, -1]}

A vector, a quaternion (w, x, y, z) or a list is as many columns as it has numbers. A time or duration
counts in nanoseconds, also without a unit, and is exact as a stamp. The messages keep their order and
their bag times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from bag_tools.bag import BagError, zeroed
from bag_tools.errors import quaternions
from bag_tools.rosargs import load_yaml
from bag_tools.series import NANOSECONDS, Array, walk
from bag_tools.tables import CsvFormat, Table, csv_format
from bag_tools.topic_tables import BAG_TIME, COMPONENTS

_DEGREE = math.pi / 180.0
STANDARD_GRAVITY = 9.80665  # m/s², by definition
# One of the unit in SI.
UNITS: dict[str, float] = {
    '': 1.0, 'rad': 1.0, 'deg': _DEGREE, 'rad/s': 1.0, 'deg/s': _DEGREE, 'deg/h': _DEGREE / 3600.0,
    'm/s^2': 1.0, 'g': STANDARD_GRAVITY, 'mg': STANDARD_GRAVITY * 1e-3,
    'T': 1.0, 'uT': 1e-6, 'gauss': 1e-4, 'mgauss': 1e-7,
    'm': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'km': 1e3,
    'm/s': 1.0, 'km/h': 1.0 / 3.6, 'kn': 1852.0 / 3600.0, 'mph': 0.44704,
    's': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9,
    'Pa': 1.0, 'hPa': 100.0, 'degC': 1.0, 'percent': 0.01,
}  # fmt: skip
NAN_RULES = ('skip', 'error', 'keep')
_LAST = 9.2e9  # s: all that nanoseconds in 64 bits hold


@dataclass(frozen=True, slots=True)
class FieldRule:
    """One field of a message and the columns it is made from; `scale` and `add` hold for each column."""

    path: str
    columns: tuple[str, ...]
    index: int | None
    factor: float
    scale: tuple[float, ...]
    add: tuple[float, ...]
    euler: bool


@dataclass(frozen=True, slots=True)
class TopicRule:
    """One topic: its stamps come from a column, or from a rate (Hz, or the name of a constant).

    Its numbers come from `file`, or from the topic `source` of a bag.
    """

    topic: str
    type: str
    file: str | None
    source: str | None
    stamp_column: str | None
    stamp_factor: float
    rate: float | str | None
    offset: float
    frame_id: str
    nan: str
    changes: bool
    constants: dict[str, Any]
    fields: tuple[FieldRule, ...]

    def columns(self) -> list[str]:
        """Return the columns that this topic needs."""
        names = [c for f in self.fields for c in f.columns]
        return names if self.stamp_column is None else [self.stamp_column, *names]


@dataclass(frozen=True, slots=True)
class Mapping:
    """A whole mapping file; `copy` are the topics of a bag that are taken along as they are."""

    path: Path
    text: str
    files: dict[str, str]
    csv: CsvFormat
    topics: tuple[TopicRule, ...] = field(default=())
    copy: tuple[str, ...] = ()

    @property
    def of_bag(self) -> bool:
        """Whether the mapping reads a bag."""
        return self.topics[0].source is not None


def _only(body: Any, allowed: set[str], where: str) -> dict[str, Any]:
    if not isinstance(body, dict):
        raise BagError(f'{where}: expected a mapping with {", ".join(sorted(allowed))}')
    if unknown := sorted(set(body) - allowed):
        raise BagError(f"{where}: unknown key '{unknown[0]}'; known: {', '.join(sorted(allowed))}")
    return body


def _named(body: Any, where: str) -> dict[str, Any]:
    if not isinstance(body, dict):
        raise BagError(f'{where}: expected a mapping of names')
    return {str(key): value for key, value in body.items()}


def _factor(unit: Any, where: str) -> float:
    if not isinstance(unit, str) or unit not in UNITS:
        raise BagError(f"{where}: unit '{unit}' is unknown; known: {', '.join(u for u in UNITS if u)}")
    return UNITS[unit]


def _numbers(value: Any, where: str) -> tuple[float, ...]:
    values = value if isinstance(value, list) else [value]
    if not values or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        raise BagError(f'{where}: {value!r} is not a number or list of numbers')
    return tuple(float(v) for v in values)


def _field_rule(path: str, body: Any, where: str) -> FieldRule:
    keys = {'column', 'columns', 'euler', 'index', 'unit', 'scale', 'add'}
    body = _only({'column': body} if isinstance(body, str) else body, keys, where)
    sources = [k for k in ('column', 'columns', 'euler') if k in body]
    if len(sources) != 1:
        raise BagError(f'{where}: expected exactly one of column, columns, euler')
    names = body[sources[0]]
    names = names if isinstance(names, list) else [names]
    index = body.get('index')
    if index is not None and type(index) is not int:
        raise BagError(f'{where}: index is {index!r}, expected a whole number')
    return FieldRule(
        path,
        tuple(str(n) for n in names),
        index,
        _factor(body.get('unit', ''), where),
        _numbers(body.get('scale', 1.0), where),
        _numbers(body.get('add', 0.0), where),
        sources[0] == 'euler',
    )


def _topic_rule(body: Any, where: str) -> TopicRule:
    keys = {'topic', 'from', 'type', 'file', 'stamp', 'frame_id', 'nan', 'changes', 'set', 'fields'}
    body = _only(body, keys, where)
    for key in ('topic', 'type', 'stamp', 'fields'):
        if key not in body:
            raise BagError(f"{where}: '{key}' is missing")
    where = f"{where} '{body['topic']}'"
    stamp = _only(body['stamp'], {'column', 'unit', 'offset', 'rate'}, f'{where} stamp')
    if ('column' in stamp) == ('rate' in stamp):
        raise BagError(f'{where} stamp: expected either column or rate')
    offset = _numbers(stamp.get('offset', 0.0), f'{where} stamp')[0]
    if not abs(offset) <= _LAST:
        raise BagError(f'{where} stamp: offset is {offset:g} s, allowed: within {_LAST:g}')
    nan = body.get('nan', 'skip')
    if nan not in NAN_RULES:
        raise BagError(f"{where}: nan is '{nan}', expected {' | '.join(NAN_RULES)}")
    rate = stamp.get('rate')
    if not isinstance(rate, int | float | str | None):
        raise BagError(f'{where} stamp: rate is {rate!r}, expected a number of Hz or the name of a constant')
    fields = _named(body['fields'], f'{where} fields')
    if not fields:
        raise BagError(f'{where} fields: expected at least one field')
    rule = TopicRule(
        topic=str(body['topic']),
        type=str(body['type']),
        file=body.get('file'),
        source=None if body.get('from') is None else str(body['from']),
        stamp_column=None if stamp.get('column') is None else str(stamp['column']),
        stamp_factor=_factor(stamp.get('unit', 's'), f'{where} stamp'),
        rate=rate,
        offset=offset,
        frame_id=str(body.get('frame_id', '')),
        nan=nan,
        changes=bool(body.get('changes', False)),
        constants=_named(body.get('set') or {}, f'{where} set'),
        fields=tuple(_field_rule(p, b, f'{where} field {p}') for p, b in fields.items()),
    )
    template = zeroed(rule.type)
    if rule.frame_id and not hasattr(template, 'header'):
        raise BagError(f'{where}: {rule.type} has no header for a frame_id')
    for path in [*rule.constants, *(f.path for f in rule.fields)]:
        try:
            walk(template, path)
        except LookupError:
            raise BagError(f"{where}: {rule.type} has no field '{path}'") from None
    return rule


def read_mapping(path: Path) -> Mapping:
    """Read and check a mapping file; raise BagError that names the file, the entry and what was expected."""
    try:
        document = load_yaml(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise BagError(f'{path}: cannot be read ({error.strerror}); expected a mapping file') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BagError(f'{path}: is not YAML ({" ".join(str(error).split())})') from None
    document = _only(document, {'text', 'files', 'csv', 'copy', 'topics'}, str(path))
    topics = document.get('topics')
    if not isinstance(topics, list) or not topics:
        raise BagError(f"{path}: 'topics' is missing; expected a list")
    copy = document.get('copy') or []
    copy = copy if isinstance(copy, list) else [copy]
    mapping = Mapping(
        path,
        str(document.get('text', '')),
        {k: str(v) for k, v in _named(document.get('files') or {}, f'{path}: files').items()},
        csv_format(document.get('csv') or {}, str(path)),
        tuple(_topic_rule(t, f'{path}: topic') for t in topics),
        tuple(str(name) for name in copy),
    )
    _check_sources(mapping)
    return mapping


def _check_sources(mapping: Mapping) -> None:
    """Raise BagError unless all topics read from a bag, or all from tables that exist."""
    path = mapping.path
    for rule in mapping.topics:
        if (rule.source is not None) != mapping.of_bag:
            raise BagError(f"{path}: topic '{rule.topic}': expected 'from' in all topics (a bag) or in none")
    if mapping.of_bag:
        for key, used in (
            ('files', mapping.files),
            ('file', any(rule.file is not None for rule in mapping.topics)),
        ):
            if used:
                raise BagError(f"{path}: '{key}' is for tables, 'from' is for bags; expected one of the two")
        return
    if mapping.copy:
        raise BagError(f"{path}: 'copy' is for bags; expected 'from' in the topics")
    for rule in mapping.topics:
        if (rule.file is None) == bool(mapping.files) or (rule.file and rule.file not in mapping.files):
            raise BagError(
                f"{path}: topic '{rule.topic}': file is {rule.file!r}, expected one of {list(mapping.files)}"
            )


def _clock(name: str, factor: float, table: Table) -> NDArray[np.int64]:
    """Return the stamps (ns) that a column holds; whole numbers never pass through a double."""
    where = f"{table.path}: the stamp '{name}'"
    column = table.column(name)
    if column.shape[1] != 1:
        raise BagError(f'{where} has {column.shape[1]} numbers, expected one')
    data = column[:, 0]
    if name in table.times:
        if factor not in (1.0, UNITS['ns']):
            raise BagError(f'{where} is a time; expected no unit')
        if not data.any():
            raise BagError(f'{where} is zero throughout, which says that none was set; expected {BAG_TIME}')
        factor = UNITS['ns']
    if not np.all(np.isfinite(data)):
        row = int(np.argmin(np.isfinite(data)))
        raise BagError(f"{table.path}: row {row}: the stamp '{name}' is not finite")
    seconds = data * factor
    if np.max(np.abs(seconds)) > _LAST:
        raise BagError(f'{where} reaches {np.max(np.abs(seconds)):.3g} s; expected another unit')
    step = round(factor * NANOSECONDS)
    if data.dtype.kind in 'iu' and step and math.isclose(step, factor * NANOSECONDS):
        return data.astype(np.int64) * step
    whole = np.floor(seconds)
    # Whole seconds apart from the fraction: Unix times fill the mantissa of a double.
    return whole.astype(np.int64) * NANOSECONDS + np.rint((seconds - whole) * NANOSECONDS).astype(np.int64)


def stamps_of(rule: TopicRule, table: Table) -> NDArray[np.int64]:
    """Return the stamps (ns) of all rows of `table`."""
    if rule.stamp_column is not None:
        stamps = _clock(rule.stamp_column, rule.stamp_factor, table)
    else:
        rate = table.constants.get(rule.rate, 0.0) if isinstance(rule.rate, str) else float(rule.rate or 0.0)
        if not rate > 0.0:
            raise BagError(f"{table.path}: rate '{rule.rate}' is {rate:g} Hz, expected > 0")
        rows = len(next(iter(table.columns.values())))
        stamps = np.rint(np.arange(rows) * (NANOSECONDS / rate)).astype(np.int64)
    stamps = stamps + round(rule.offset * NANOSECONDS)
    if stamps.min() < 0:
        raise BagError(
            f"{table.path}: stamps of '{rule.topic}' begin at {stamps.min() * 1e-9:.3f} s; add an offset"
        )
    return stamps


def _spread(values: tuple[float, ...], count: int, rule: FieldRule) -> Array:
    if len(values) not in (1, count):
        raise BagError(f"field '{rule.path}': {len(values)} factors for {count} columns")
    return np.array(values if len(values) == count else values * count)


def field_values(rule: FieldRule, table: Table) -> Array:
    """Return the (n, k) SI numbers of one field."""
    data = np.hstack([table.column(name) for name in rule.columns])
    if rule.index is not None:
        if not 0 <= rule.index < data.shape[1]:
            raise BagError(
                f"{table.path}: field '{rule.path}': index {rule.index} of {data.shape[1]} columns"
            )
        data = data[:, [rule.index]]
    count = data.shape[1]
    data = (data * _spread(rule.scale, count, rule) + _spread(rule.add, count, rule)) * rule.factor
    if not rule.euler:
        return data
    if count != 3:
        raise BagError(f"{table.path}: field '{rule.path}': euler takes 3 columns, got {count}")
    return quaternions(data)


def leaves(rule: FieldRule, template: Any, count: int) -> list[tuple[str, str | int]]:
    """Return where `count` numbers go: (path of the parent, attribute or index)."""
    target = walk(template, rule.path)
    kind = type(target).__name__.split('__')[-1]
    if kind in COMPONENTS:
        names: list[tuple[str, str | int]] = [(rule.path, c) for c in COMPONENTS[kind]]
    elif isinstance(target, np.ndarray):
        names = [(rule.path, i) for i in range(len(target) or count)]
    elif rule.path.endswith(']'):
        parent, _, index = rule.path[:-1].rpartition('[')
        names = [(parent, int(index))]
    else:
        parent, _, name = rule.path.rpartition('.')
        names = [(parent, name)]
    if len(names) != count:
        raise BagError(f"field '{rule.path}' has {len(names)} components, the mapping gives {count}")
    return names
