# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools import MAPPING SOURCE BAG``: CSV and npz files, and bags, to bags by a mapping."""

from __future__ import annotations

import argparse
import math
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bag_tools.bag import ROS1_SUFFIX, SUFFIXES, BagError, BagReader, BagWriter, resolve, zeroed
from bag_tools.cli import Progress, guarded
from bag_tools.mapping import FieldRule, Mapping, TopicRule, field_values, leaves, read_mapping, stamps_of
from bag_tools.registry import find_importer
from bag_tools.series import NANOSECONDS, Array, walk
from bag_tools.tables import Table, read_csv, read_npz
from bag_tools.topic_tables import read_topic

FOLDER = Path(__file__).parent / 'mappings'
_PROGRESS_STRIDE = 1024
_KINDS: dict[type, str] = {np.ndarray: 'the list of numbers', str: 'a text', int: 'a whole number'}
_FROM = "expected tables, or 'from: TOPIC' in each topic of {}"


@dataclass(slots=True)
class _Column:
    """The numbers of one topic, which rows of them are `kept`, and how to put one into its message."""

    path: Path
    topic: str
    type: str
    stamps: NDArray[np.int64]
    values: Array
    kept: NDArray[np.bool_]
    message: Any
    setters: list[Callable[[float], None]]

    def write(self, row: int, writer: BagWriter, bag_time: int) -> None:
        """Write the message of `row`; raise BagError when a number does not fit its field."""
        try:
            writer.write(self.topic, bag_time, self._fill(row))
        except (struct.error, OverflowError) as error:
            where = f"{self.path}: '{self.topic}' at {self.stamps[row] * 1e-9:.3f} s"
            raise BagError(f'{where}: {error}; a number does not fit its field') from None

    def _fill(self, row: int) -> Any:
        header = getattr(self.message, 'header', None)
        if header is not None:
            header.stamp.sec, header.stamp.nanosec = divmod(int(self.stamps[row]), NANOSECONDS)
        for setter, value in zip(self.setters, self.values[row].tolist()):
            setter(value)
        return self.message


def _setter(message: Any, parent: str, leaf: str | int) -> Callable[[float], None]:
    holder = walk(message, parent) if parent else message
    if isinstance(leaf, int):
        if isinstance(holder, np.ndarray) and holder.dtype.kind in 'iu':
            return lambda value: holder.__setitem__(leaf, _whole(value, int, f'[{leaf}]'))
        return lambda value: holder.__setitem__(leaf, value)
    kind = type(getattr(holder, leaf))
    if kind not in (int, bool, float):
        path = f'{parent}.{leaf}' if parent else leaf
        raise BagError(f"field '{path}' holds no number; a mapping sets it by 'set' or 'frame_id'")
    if kind in (int, bool):
        return lambda value: setattr(holder, leaf, _whole(value, kind, leaf))
    return lambda value: setattr(holder, leaf, value)


def _whole(value: float, kind: type, leaf: str) -> int | bool:
    if not math.isfinite(value):
        raise BagError(f"'{leaf}' is {value:g}, and its field holds whole numbers only; expected nan: skip")
    return round(value) if kind is int else bool(value)


def _grow(message: Any, rule: FieldRule, count: int) -> None:
    """Give a sequence field the length that the mapping fills."""
    target = walk(message, rule.path)
    if isinstance(target, np.ndarray) and not len(target):
        parent, _, name = rule.path.rpartition('.')
        setattr(walk(message, parent) if parent else message, name, np.zeros(count, dtype=target.dtype))


def _set_constant(message: Any, path: str, value: Any) -> None:
    """Set a field of any kind; raise BagError when `value` is of another kind."""
    current = walk(message, path)
    kind = type(current)
    try:
        if isinstance(current, np.ndarray):
            array = np.array(value, dtype=current.dtype)
            # What is empty in a new message may have any length.
            value = array if array.ndim == 1 and len(current) in (0, len(array)) else value
        elif isinstance(current, float | np.number) and not isinstance(value, bool):
            value = kind(value)
    except (TypeError, ValueError, OverflowError):
        pass
    if type(value) is not kind:
        raise BagError(
            f"set '{path}': {value!r} does not fit {_KINDS.get(kind, kind.__name__.split('__')[-1])}"
        )
    parent, _, name = path.rpartition('.')
    holder = walk(message, parent) if parent else message
    if name.endswith(']'):
        name, _, index = name[:-1].partition('[')
        getattr(holder, name)[int(index)] = value
    else:
        setattr(holder, name, value)


def _kept(rule: TopicRule, values: Array, table: Table) -> NDArray[np.bool_]:
    """Return which rows to write: without gaps in the data, and only changes where asked for."""
    finite = np.all(np.isfinite(values), axis=1)
    if rule.nan == 'error' and not finite.all():
        raise BagError(f"{table.path}: row {int(np.argmin(finite))}: a value of '{rule.topic}' is not finite")
    kept = finite if rule.nan == 'skip' else np.ones(len(values), dtype=np.bool_)
    if rule.changes and kept.any():
        kept[kept] = np.append(True, np.any(np.diff(values[kept], axis=0) != 0.0, axis=1))
    return kept


def _column(rule: TopicRule, table: Table) -> _Column:
    message = zeroed(rule.type)
    if rule.frame_id:
        message.header.frame_id = rule.frame_id
    for path, value in rule.constants.items():
        _set_constant(message, path, value)
    blocks, setters = [], []
    for field in rule.fields:
        block = field_values(field, table)
        _grow(message, field, block.shape[1])
        setters += [_setter(message, p, leaf) for p, leaf in leaves(field, message, block.shape[1])]
        blocks.append(block)
    lengths = {len(b) for b in blocks}
    if len(lengths) != 1:
        raise BagError(f"{table.path}: the columns of '{rule.topic}' differ in length: {sorted(lengths)}")
    values = np.hstack(blocks)
    stamps = stamps_of(rule, table)
    if len(stamps) != len(values):
        raise BagError(f"{table.path}: {len(stamps)} stamps for {len(values)} rows of '{rule.topic}'")
    kept = _kept(rule, values, table)
    return _Column(table.path, resolve(rule.topic), rule.type, stamps, values, kept, message, setters)


def _tables(mapping: Mapping, source: Path) -> dict[str | None, Table]:
    names: dict[str | None, Path] = {None: source}
    if (source / 'metadata.yaml').is_file() and not mapping.files:
        raise BagError(f'{source}: is a bag; {_FROM.format(mapping.path)}')
    if mapping.files:
        if not source.is_dir() and not any('*' in f or '{' in f for f in mapping.files.values()):
            raise BagError(
                f'{source}: is not a folder; expected one with {", ".join(mapping.files.values())}'
            )
        names = {key: _find(source, pattern) for key, pattern in mapping.files.items()}
    tables = {}
    for key, path in names.items():
        wanted = [c for t in mapping.topics if t.file == key for c in t.columns()]
        if not path.is_file():
            expected = 'an npz or CSV file' if key is None else f'the {key} table'
            raise BagError(f'{path}: no such file; expected {expected}')
        if path.suffix in (*SUFFIXES, ROS1_SUFFIX):
            raise BagError(f'{path}: is a bag; {_FROM.format(mapping.path)}')
        tables[key] = read_npz(path) if path.suffix == '.npz' else read_csv(path, mapping.csv, wanted)
    return tables


def _find(source: Path, pattern: str) -> Path:
    """Return ``source/pattern``; ``{stem}`` stands for the name of the source when it is no folder."""
    folder = source if source.is_dir() else source.parent
    return folder / pattern.replace('{stem}', source.name)


def import_tables(mapping: Mapping, source: Path, writer: BagWriter) -> None:
    """Write the topics of `mapping` from `source` (a file, or a folder of files) in order of their stamps."""
    tables = _tables(mapping, source)
    columns = [_column(rule, tables[rule.file]) for rule in mapping.topics]
    for column in columns:
        writer.add(column.topic, column.type)
    stamps = np.concatenate([c.stamps[c.kept] for c in columns])
    owners = np.concatenate([np.full(np.count_nonzero(c.kept), i) for i, c in enumerate(columns)])
    rows = np.concatenate([np.flatnonzero(c.kept) for c in columns])
    order = np.lexsort((rows, owners, stamps))
    with Progress('importing', len(order)) as progress:
        for done, k in enumerate(order):
            columns[owners[k]].write(int(rows[k]), writer, int(stamps[k]))
            if not done % _PROGRESS_STRIDE:
                progress.update(done)


def _columns_of_bag(mapping: Mapping, reader: BagReader) -> dict[str, list[_Column]]:
    """Return the columns by the topic that they are made from."""
    rules: dict[str, list[TopicRule]] = {}
    for rule in mapping.topics:
        rules.setdefault(reader.topic(rule.source or '').name, []).append(rule)
    columns = {}
    for name, group in rules.items():
        table = read_topic(reader, reader.topics[name], {c for rule in group for c in rule.columns()})
        columns[name] = [_column(rule, table) for rule in group]
    return columns


def _copies(mapping: Mapping, reader: BagReader) -> set[str]:
    written = {resolve(rule.topic) for rule in mapping.topics}
    if '*' in mapping.copy:
        return set(reader.topics) - written
    copies = {reader.topic(name).name for name in mapping.copy}
    if clash := copies & written:
        raise BagError(f"{mapping.path}: topic '{min(clash)}' cannot be copied, the mapping writes it")
    return copies


def import_bag(mapping: Mapping, source: Path, writer: BagWriter) -> None:
    """Write the topics of `mapping` from the bag `source`, with what it copies, in the order of that bag."""
    with BagReader(source) as reader:
        columns = _columns_of_bag(mapping, reader)
        copies = _copies(mapping, reader)
        for name in sorted(copies):
            topic = reader.topics[name]
            writer.add(name, topic.type, qos=topic.qos[:1], store=reader.store)
        for column in (c for group in columns.values() for c in group):
            writer.add(column.topic, column.type)
        row = dict.fromkeys(columns, 0)
        with Progress('importing', reader.stop - reader.start) as progress:
            for done, (name, bag_time, data) in enumerate(reader.messages({*columns, *copies})):
                if name in copies:
                    writer.write_raw(name, bag_time, data)
                for column in columns.get(name, ()):
                    if column.kept[row[name]]:
                        column.write(row[name], writer, bag_time)
                if name in row:
                    row[name] += 1
                if not done % _PROGRESS_STRIDE:
                    progress.update(bag_time - reader.start)


def importer(name: str) -> Callable[[Path, BagWriter], None]:
    """Return the importer `name`: a mapping file, a mapping of this package, or PACKAGE:NAME of another.

    A package offers importers as ``IMPORTERS = {'name': function(source, writer)}`` in ``PKG.importers``.
    """
    package, mark, entry = name.partition(':')
    if mark:
        return find_importer(package, entry)
    path = Path(name)
    if not path.exists() and path.suffix not in ('.yaml', '.yml'):
        path = FOLDER / f'{name}.yaml'
        if not path.exists():
            known = ', '.join(sorted(p.stem for p in FOLDER.glob('*.yaml')))
            raise BagError(
                f"mapping '{name}' is unknown; expected a .yaml file, PACKAGE:NAME or one of: {known}"
            )
    mapping = read_mapping(path)
    convert = import_bag if mapping.of_bag else import_tables
    return lambda source, writer: convert(mapping, source, writer)


def import_data(
    name: str, source: str | Path, bag: str | Path, *, compression: str = 'none', overwrite: bool = False
) -> dict[str, int]:
    """Import `source` to `bag` by the importer `name`; return the number of messages by topic."""
    convert = importer(name)
    source = Path(source)
    with BagWriter(bag, compression=compression, overwrite=overwrite) as writer:
        convert(source, writer)
        if not sum(writer.counts.values()):
            raise BagError(f'{source}: nothing could be imported')
    return writer.counts


def run(argv: list[str]) -> int:
    """Import as the command line says."""
    known = ', '.join(sorted(p.stem for p in FOLDER.glob('*.yaml')))
    p = argparse.ArgumentParser(prog='import', description='Import CSV and npz files, or a bag, to a bag.')
    p.add_argument('mapping', help=f'a mapping file, PACKAGE:NAME, or one of: {known}')
    p.add_argument('source', type=Path, help='the file, the folder with the files, or the bag to import')
    p.add_argument('bag', type=Path, help='bag to write: a folder name, or a .mcap or .db3 file')
    p.add_argument('--compression', choices=('none', 'zstd'), default='none')
    p.add_argument('--overwrite', action='store_true', help='replace an existing bag')
    o = p.parse_args(argv)
    counts = import_data(o.mapping, o.source, o.bag, compression=o.compression, overwrite=o.overwrite)
    for topic, count in counts.items():
        print(f'{count:8d}  {topic}')
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('import', run, argv)


if __name__ == '__main__':
    sys.exit(main())
