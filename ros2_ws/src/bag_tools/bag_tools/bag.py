# SPDX-License-Identifier: Apache-2.0
"""Bags on top of rosbags: open with one clear error, write so that no partial file looks whole."""

from __future__ import annotations

import os
import shlex
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import (
    MessageDefinitionFormat,
    Nodetype,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bag_tools.cdr import decoder, encoder

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
SUFFIXES = {'.mcap': 'mcap', '.db3': 'sqlite3'}
ROS1_SUFFIX = '.bag'
COMPRESSIONS = ('none', 'zstd')
EXPECTED = 'expected a rosbag2 folder, .mcap or .db3 file'
# rosbag2 writes these for publishers that set no deadline, lifespan or lease.
_FOREVER = QosTime(9223372036, 854775807)


class BagError(Exception):
    """A bag, file or argument cannot be used; the text says which, what was wrong and what was expected."""


@cache
def jazzy() -> Typestore:
    """Return the message types of ROS 2 Jazzy (built on first use: it takes about 0.2 s)."""
    return get_typestore(Stores.ROS2_JAZZY)


def resolve(topic: str, node: str = '/', namespace: str = '/') -> str:
    """Return the fully qualified name of a relative, private (``~/x``) or absolute topic."""
    if topic.startswith('/'):
        return topic
    if topic.startswith('~/'):
        return f'/{node.strip("/")}/{topic[2:]}'
    return f'{namespace.rstrip("/")}/{topic}'


def reliable_qos(*, depth: int = 100, latched: bool = False) -> Qos:
    """Return a reliable QoS profile to store with a topic; `latched` is transient local, depth 1."""
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else depth,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


_ZEROS: dict[str, Any] = {'string': '', 'wstring': '', 'bool': False, 'float32': 0.0, 'float64': 0.0}
_DTYPES = {'char': 'uint8'}
# rosbags drops the defaults of message definitions; these are the ones other than zero.
_DEFAULTS = {('geometry_msgs/msg/Quaternion', 'w'): 1.0, ('sensor_msgs/msg/NavSatStatus', 'status'): -2}


def _zero_of(kind: Nodetype, detail: Any, store: Typestore) -> Any:
    if kind == Nodetype.BASE:
        return _ZEROS.get(detail[0], 0)
    if kind == Nodetype.NAME:
        return zeroed(detail, store)
    (element_kind, element), length = detail
    count = length if kind == Nodetype.ARRAY else 0
    if element_kind == Nodetype.BASE and element[0] not in ('string', 'wstring'):
        return np.zeros(count, dtype=_DTYPES.get(element[0], element[0]))
    return [_zero_of(element_kind, element, store) for _ in range(count)]


def zeroed(type_name: str, store: Typestore | None = None) -> Any:
    """Return a new message of `type_name` as its ROS constructor makes it: zeros, identity quaternions.

    Fixed arrays are numpy arrays of their length, sequences are empty. Raises BagError for unknown types.
    """
    store = store or jazzy()
    try:
        fields = store.fielddefs[type_name][1]
    except KeyError:
        raise BagError(f"message type '{type_name}' is unknown to ROS 2 Jazzy's common messages") from None
    values = [
        _DEFAULTS.get((type_name, name), _zero_of(kind, detail, store)) for name, (kind, detail) in fields
    ]
    return store.types[type_name](*values)


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: name, type, number of messages and the QoS profiles its publishers offered."""

    name: str
    type: str
    count: int
    qos: tuple[Qos, ...] = ()

    @property
    def latched(self) -> bool:
        """Whether a publisher offered transient local durability."""
        return any(q.durability == QosDurability.TRANSIENT_LOCAL for q in self.qos)


def _store_for(connections: Collection[Any]) -> Typestore:
    """Return Jazzy's types where the bag's definitions agree with them, else the bag's own."""
    store = jazzy()
    own: dict[str, Any] = {}
    differs = False
    for connection in connections:
        if connection.msgdef.format != MessageDefinitionFormat.MSG:
            continue
        known = connection.msgtype in store.fielddefs
        if known and connection.msgdef.data == store.generate_msgdef(connection.msgtype, 2)[0]:
            continue
        types = get_types_from_msg(connection.msgdef.data, connection.msgtype)
        own.update(types)
        differs = differs or any(
            name not in store.fielddefs or store.fielddefs[name][1] != fields[1]
            for name, fields in types.items()
        )
    if not differs:
        return store
    merged = get_typestore(Stores.EMPTY)
    merged.register({**{k: v for k, v in store.fielddefs.items() if k not in own}, **own})
    return merged


def _reason(error: BaseException) -> str:
    text = ' '.join(str(error).split()).rstrip('.')
    return text or type(error).__name__


def _locate(path: Path) -> Path:
    """Return what rosbags opens: a folder that lost its metadata.yaml is read through its only file."""
    if not path.exists():
        raise BagError(f'{path}: no such file or folder; {EXPECTED}')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        files = [f for f in sorted(path.iterdir()) if f.suffix in SUFFIXES]
        if len(files) != 1:
            raise BagError(f'{path}: no metadata.yaml in this folder; {EXPECTED}')
        return files[0]
    if path.is_file() and path.suffix == ROS1_SUFFIX:
        source, target = shlex.quote(str(path)), shlex.quote(path.stem)
        command = f'rosbags-convert --src {source} --dst {target} --dst-typestore ros2_jazzy'
        raise BagError(f'{path}: is a bag of ROS 1; convert it: {command}')
    if path.is_file() and path.suffix not in SUFFIXES:
        raise BagError(f'{path}: not a bag; {EXPECTED}')
    return path


def _check_complete(path: Path) -> None:
    """Raise BagError for an SQLite file shorter than its header says: SQLite itself reads zeros there.

    Source: SQLite database file format, section 1.3: page size at 16, change counter at 24, page count at
    28, and at 92 the change counter for which that count is valid.
    """
    for file in sorted(path.glob('*.db3')) if path.is_dir() else [path]:
        if file.suffix != '.db3':
            continue
        with file.open('rb') as opened:
            head = opened.read(100)
        if len(head) < 100 or not head.startswith(b'SQLite format 3\0'):
            raise BagError(f'{path}: not an SQLite file; {EXPECTED}')
        size = int.from_bytes(head[16:18], 'big')
        size = 65536 if size == 1 else size
        pages = int.from_bytes(head[28:32], 'big')
        if head[24:28] == head[92:96] and file.stat().st_size < pages * size:
            raise BagError(f'{path}: truncated: {file.stat().st_size} of {pages * size} bytes; {EXPECTED}')


class BagReader:
    """An open bag (mcap or sqlite3, compressed or not). A context manager.

    `topics` by name, `start` and `stop` (bag time, ns; `stop` lies after the last message), `count`.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._decoders: dict[str, Callable[[bytes], Any]] = {}
        self._encoders: dict[str, Callable[[Any], bytes]] = {}
        located = _locate(self.path)
        _check_complete(located)
        try:
            self._reader = Reader(located)
            self._reader.open()
        except Exception as error:  # rosbags lets struct, index and decoding errors of broken files through
            raise BagError(f'{self.path}: cannot be read as a bag ({_reason(error)}); {EXPECTED}') from error
        try:
            self._read_topics()
        except BaseException as error:
            self.close()
            if isinstance(error, BagError) or not isinstance(error, Exception):
                raise
            raise BagError(f'{self.path}: bad message definitions ({_reason(error)})') from error

    def _read_topics(self) -> None:
        reader = self._reader
        self.topics: dict[str, Topic] = {}
        for connection in reader.connections:
            seen = self.topics.get(connection.topic)
            if seen is not None and seen.type != connection.msgtype:
                raise BagError(
                    f"{self.path}: topic '{connection.topic}' has two types, {seen.type} and "
                    f'{connection.msgtype}; expected one'
                )
            count = connection.msgcount + (seen.count if seen else 0)
            qos = tuple(getattr(connection.ext, 'offered_qos_profiles', ()))
            self.topics[connection.topic] = Topic(
                connection.topic, connection.msgtype, count, (seen.qos if seen else ()) + qos
            )
        self.store = _store_for(reader.connections)
        self.count: int = reader.message_count
        self.start: int = reader.start_time if self.count else 0
        self.stop: int = reader.end_time if self.count else 0

    def topic(self, name: str) -> Topic:
        """Return the topic `name` (with or without the leading slash); raise BagError when it is absent."""
        found = self.topics.get(name) or self.topics.get(resolve(name))
        if found is None:
            known = ', '.join(sorted(self.topics)) or 'none'
            raise BagError(f"{self.path}: no topic '{name}'; the bag has: {known}")
        return found

    def messages(
        self, topics: Collection[str] | None = None, start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, bag time in ns, CDR bytes) in order of bag time, ties in order of writing.

        `topics` are full names (None: all); `start` is inclusive, `stop` exclusive (ns).
        """
        connections = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not connections or not self.count:
            return
        try:
            for connection, stamp, data in self._reader.messages(connections, start, stop):
                yield connection.topic, stamp, data
        except Exception as error:
            raise BagError(f'{self.path}: damaged message data ({_reason(error)})') from error

    def decode(self, data: bytes, type_name: str) -> Any:
        """Return the message object; raise BagError when the bytes are not one."""
        decode = self._decoders.get(type_name)
        if decode is None:
            decode = self._decoders[type_name] = decoder(self.store, type_name)
        try:
            return decode(data)
        except Exception as error:
            raise BagError(f'{self.path}: a {type_name} cannot be decoded ({_reason(error)})') from error

    def encode(self, message: Any, type_name: str) -> bytes:
        """Return the CDR bytes of a message object, padding zeroed."""
        encode = self._encoders.get(type_name)
        if encode is None:
            encode = self._encoders[type_name] = encoder(self.store, type_name)
        return encode(message)

    def close(self) -> None:
        """Close the bag."""
        if self._reader.is_open:
            self._reader.close()

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.close()


def _looks_like_bag(path: Path) -> bool:
    return path.suffix in SUFFIXES if path.is_file() else (path / 'metadata.yaml').exists()


def _words(error: OSError | sqlite3.Error) -> str:
    return getattr(error, 'strerror', None) or str(error)


class BagWriter:
    """Writes a bag under a temporary name beside `path` and renames it when all went well.

    `path` is a rosbag2 folder, or a single file when it ends in .mcap or .db3. `compression` 'zstd'
    compresses chunks (mcap) or messages (sqlite3). As a context manager it removes what it wrote when the
    body raises; with `salvage` what it took before stays under the temporary name. Raises BagError when
    `path` exists and `overwrite` is not set, and when the disk takes no more.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        storage: str | None = None,
        compression: str = 'none',
        overwrite: bool = False,
        salvage: bool = False,
    ) -> None:
        self.path = Path(path)
        self._salvage = salvage
        self._failed = False
        self._single = self.path.suffix in SUFFIXES
        storage = storage or SUFFIXES.get(self.path.suffix, 'mcap')
        if storage not in STORAGES:
            raise BagError(f"{self.path}: storage '{storage}' is unknown; expected mcap or sqlite3")
        if compression not in COMPRESSIONS:
            raise BagError(f"{self.path}: compression '{compression}' is unknown; expected none or zstd")
        if self._single and storage != SUFFIXES[self.path.suffix]:
            raise BagError(f'{self.path}: the suffix does not fit storage {storage}')
        if self._single and storage == 'sqlite3' and compression != 'none':
            raise BagError(f'{self.path}: a single .db3 file cannot be compressed; expected a folder name')
        if self.path.exists():
            if not overwrite:
                raise BagError(f'{self.path}: exists already; expected a new name (or --overwrite)')
            if not _looks_like_bag(self.path):
                raise BagError(f'{self.path}: is not a bag and is not overwritten; {EXPECTED}')
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(
                tempfile.mkdtemp(prefix=f'.{self.path.name}.', suffix='.partial', dir=self.path.parent)
            )
        except OSError as error:
            raise BagError(f'{self.path}: cannot be written ({error.strerror})') from error
        self._writer = Writer(
            self._folder / self.path.stem if self._single else self._folder / self.path.name,
            version=9,
            storage_plugin=STORAGES[storage],
        )
        if compression == 'zstd':
            mode = CompressionMode.STORAGE if storage == 'mcap' else CompressionMode.MESSAGE
            self._writer.set_compression(mode, CompressionFormat.ZSTD)
        try:
            self._writer.open()
        except (OSError, sqlite3.Error) as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            raise BagError(f'{self.path}: cannot be written ({_words(error)})') from error
        self._connections: dict[str, Any] = {}
        self._types: dict[str, str] = {}
        self._encoders: dict[str, Callable[[Any], bytes]] = {}
        self.counts: dict[str, int] = {}

    def add(
        self,
        topic: str,
        type_name: str,
        *,
        latched: bool = False,
        qos: Collection[Qos] = (),
        store: Typestore | None = None,
    ) -> None:
        """Declare `topic` (made fully qualified); a second declaration with the same type does nothing."""
        topic = resolve(topic)
        if topic in self._types:
            if self._types[topic] != type_name:
                raise BagError(
                    f"{self.path}: topic '{topic}' has two types, {self._types[topic]} and {type_name}"
                )
            return
        store = store or jazzy()
        if type_name not in store.fielddefs:
            raise BagError(f"{self.path}: message type '{type_name}' of topic '{topic}' is unknown")
        profiles = tuple(qos) or (reliable_qos(latched=latched),)
        self._connections[topic] = self._writer.add_connection(
            topic, type_name, typestore=store, offered_qos_profiles=profiles
        )
        self._types[topic] = type_name
        self._encoders[topic] = encoder(store, type_name)
        self.counts[topic] = 0

    def write(self, topic: str, stamp: int, message: Any) -> None:
        """Serialise and write `message` at bag time `stamp` (ns, not negative)."""
        self.write_raw(topic, stamp, self._encoders[topic](message))

    def write_raw(self, topic: str, stamp: int, data: bytes | memoryview) -> None:
        """Write CDR bytes at bag time `stamp` (ns, not negative)."""
        if stamp < 0:
            raise BagError(f"{self.path}: negative bag time {stamp} ns on topic '{topic}'")
        try:
            self._writer.write(self._connections[topic], stamp, data)
        except (OSError, sqlite3.Error) as error:
            raise self._full(error) from error
        self.counts[topic] += 1

    def _full(self, error: OSError | sqlite3.Error) -> BagError:
        self._failed = True
        kept = f'; {self._kept()}' if self._salvage else ''
        return BagError(f'{self.path}: {_words(error)}{kept}')

    def _kept(self) -> str:
        return f'what was written before is in {self._folder}'

    def _rescue(self, error: BaseException) -> None:
        """Finish what was written under the temporary name, and say so in `error`."""
        try:
            self._writer.close()
        except (OSError, sqlite3.Error) as full:
            raise self._full(full) from error
        if isinstance(error, BagError):
            raise BagError(f'{error}; {self._kept()}') from error
        error.add_note(self._kept())

    def close(self) -> None:
        """Finish the file and give it its name."""
        try:
            self._writer.close()
        except (OSError, sqlite3.Error) as error:
            failure = self._full(error)
            self.abort()
            raise failure from error
        source = self._writer.path
        if self._single:
            source = next(f for f in source.iterdir() if f.suffix == self.path.suffix)
        if self.path.is_dir():
            shutil.rmtree(self.path)
        os.replace(source, self.path)
        shutil.rmtree(self._folder)

    def abort(self) -> None:
        """Remove what was written, unless the disk is full and it is to be salvaged."""
        try:
            self._writer.abort()
        except (OSError, sqlite3.Error):
            # A full disk refuses the last buffer once more.
            if not self._failed:
                raise
        if not (self._failed and self._salvage):
            shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: object, error: BaseException | None, _trace: object) -> None:
        if error is None:
            self.close()
        elif self._salvage and not self._failed and any(self.counts.values()):
            self._rescue(error)
        else:
            self.abort()
