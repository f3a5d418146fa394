# SPDX-License-Identifier: Apache-2.0
"""CDR decoders and encoders made for one message type, about three times as fast as rosbags' own.

rosbags reads field by field. Here the fields between two strings or sequences are read by one struct, for
their places are known once the first of them is aligned. The objects are rosbags' classes, the bytes those
of rosbags; whatever is not plain (big endian, damaged, wide strings) is left to rosbags itself.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

_FORMATS = {
    'bool': ('?', 1),
    'byte': ('b', 1),
    'char': ('B', 1),
    'int8': ('b', 1),
    'uint8': ('B', 1),
    'int16': ('h', 2),
    'uint16': ('H', 2),
    'int32': ('i', 4),
    'uint32': ('I', 4),
    'int64': ('q', 8),
    'uint64': ('Q', 8),
    'float32': ('f', 4),
    'float64': ('d', 8),
}
_DTYPES = {'char': 'uint8'}
_LITTLE = b'\x00\x01'


class _Unsupported(Exception):
    """A type has a field that only rosbags handles."""


class _Writer(ABC):
    """Collects the source of one function, and the struct that is being filled.

    `known` and `offset`: the position is `offset` modulo `known`, as far as that is known when compiling.
    """

    def __init__(self, name: str, store: Typestore, namespace: dict[str, Any]) -> None:
        self.store = store
        self.namespace = namespace
        self.name = name
        self.lines: list[str] = []
        self.indent = ' '
        self.names = 0
        self.known, self.offset = 8, 0
        self.format = ''
        self.size = 0
        self.targets: list[str] = []
        self.after: list[str] = []

    def fresh(self, prefix: str = 'v') -> str:
        self.names += 1
        return f'{prefix}{self.names}'

    def emit(self, line: str) -> None:
        self.lines.append(self.indent + line)

    def constant(self, value: Any) -> str:
        name = f'{self.name}_c{len(self.namespace)}'
        self.namespace[name] = value
        return name

    def place(self, size: int) -> None:
        """Align to `size`, inside the current struct where the place is known."""
        if self.known < size:
            self.flush()
            # Alignment counts from the end of the four bytes of encapsulation.
            self.emit(f'p = ((p - 4 + {size - 1}) & -{size}) + 4')
            self.known, self.offset = size, 0
        elif padding := -self.offset % size:
            self.add(f'{padding}x', padding)

    def add(self, piece: str, size: int) -> None:
        self.format += piece
        self.size += size
        self.offset = (self.offset + size) % self.known

    @abstractmethod
    def flush(self) -> None:
        """Emit the lines of the pieces gathered so far."""


class _Decoder(_Writer):
    def flush(self) -> None:
        if self.size:
            unpack = self.constant(struct.Struct('<' + self.format).unpack_from)
            left = ', '.join(self.targets) + (',' if self.targets else '')
            self.emit(f'{left} = {unpack}(d, p)' if left else f'{unpack}(d, p)')
            for line in self.after:
                self.emit(line)
            self.emit(f'p += {self.size}')
        self.format, self.size, self.targets, self.after = '', 0, [], []

    def message(self, type_name: str) -> str:
        """Emit the reading of one message and return the expression that builds it."""
        values = [self.field(kind, detail) for _, (kind, detail) in self.store.fielddefs[type_name][1]]
        cls = self.constant(self.store.types[type_name])
        return f'{cls}({", ".join(values)})'

    def field(self, kind: Nodetype, detail: Any) -> str:
        if kind == Nodetype.NAME:
            return self.message(detail)
        if kind == Nodetype.BASE:
            return self.base(detail[0])
        (element_kind, element), length = detail
        if kind == Nodetype.ARRAY:
            if element_kind == Nodetype.NAME:
                return f'[{", ".join(self.message(element) for _ in range(length))}]'
            return self.array(element[0], length)
        return self.sequence(element_kind, element)

    def base(self, name: str) -> str:
        if name == 'string':
            return self.string()
        piece, size = _FORMATS[name] if name in _FORMATS else self.refuse()
        self.place(size)
        self.add(piece, size)
        self.targets.append(self.fresh())
        return self.targets[-1]

    def refuse(self) -> Any:
        raise _Unsupported

    def string(self) -> str:
        length, value = self.base('uint32'), self.fresh()
        self.flush()
        self.emit(f'e = p + {length}')
        # Truncated, or without the zero at the end: rosbags finds the words for it.
        self.emit(f'if not {length} or d[e - 1]: raise ValueError')
        self.emit(f"{value} = str(d[p:e - 1], 'utf-8')")
        self.emit('p = e')
        self.known, self.offset = 1, 0
        return value

    def array(self, name: str, length: int) -> str:
        _, size = _FORMATS[name] if name in _FORMATS else self.refuse()
        self.place(size)
        value, dtype = self.fresh(), self.constant(np.dtype(_DTYPES.get(name, name)))
        self.after.append(f'{value} = frombuffer(d, {dtype}, {length}, p + {self.size})')
        self.add(f'{length * size}x', length * size)
        return value

    def sequence(self, kind: Nodetype, element: Any) -> str:
        count, value = self.base('uint32'), self.fresh()
        self.flush()
        if kind == Nodetype.BASE and element[0] in _FORMATS:
            _, size = _FORMATS[element[0]]
            dtype = self.constant(np.dtype(_DTYPES.get(element[0], element[0])))
            if size > 4:
                self.emit(f'if {count}: p = ((p + 3) & -8) + 4')
            self.emit(f'{value} = frombuffer(d, {dtype}, {count}, p) if {count} else {dtype}_empty')
            self.namespace[f'{dtype}_empty'] = np.zeros(0, self.namespace[dtype])
            self.emit(f'p += {count} * {size}')
            self.known, self.offset = min(size, 4), 0
            return value
        self.emit(f'if {count} > len(d): raise ValueError')
        self.emit(f'{value} = []')
        self.emit(f'for _ in range({count}):')
        self.indent += ' '
        self.known, self.offset = 1, 0
        item = self.message(element) if kind == Nodetype.NAME else self.base(element[0])
        self.flush()
        self.emit(f'{value}.append({item})')
        self.indent = self.indent[:-1]
        self.known, self.offset = 1, 0
        return value


class _Encoder(_Writer):
    def flush(self) -> None:
        if self.size:
            pack = self.constant(struct.Struct('<' + self.format).pack)
            self.emit(f'o.append({pack}({", ".join(self.targets)}))')
            self.emit(f'p += {self.size}')
        self.format, self.size, self.targets = '', 0, []

    def place(self, size: int) -> None:
        if self.known < size:
            self.flush()
            self.emit(f'n = (4 - p) & {size - 1}')
            self.emit('o.append(zeros[n])')
            self.emit('p += n')
            self.known, self.offset = size, 0
        else:
            super().place(size)

    def message(self, type_name: str, source: str) -> None:
        for name, (kind, detail) in self.store.fielddefs[type_name][1]:
            self.field(kind, detail, f'{source}.{name}')

    def field(self, kind: Nodetype, detail: Any, source: str) -> None:
        if kind == Nodetype.NAME:
            self.message(detail, self.held(source))
        elif kind == Nodetype.BASE:
            self.base(detail[0], source)
        else:
            (element_kind, element), length = detail
            if kind == Nodetype.SEQUENCE:
                self.sequence(element_kind, element, self.held(source))
            elif element_kind == Nodetype.NAME:
                held = self.held(source)
                self.emit(f'if len({held}) != {length}: raise ValueError')
                for index in range(length):
                    self.message(element, self.held(f'{held}[{index}]'))
            else:
                self.array(element[0], length, source)

    def held(self, source: str) -> str:
        name = self.fresh()
        self.emit(f'{name} = {source}')
        return name

    def base(self, name: str, source: str) -> None:
        if name == 'string':
            value = self.held(f'{source}.encode()')
            self.base('uint32', f'len({value}) + 1')
            self.flush()
            self.emit(f'o.append({value})')
            self.emit("o.append(b'\\0')")
            self.emit(f'p += len({value}) + 1')
            self.known, self.offset = 1, 0
            return
        if name not in _FORMATS:
            raise _Unsupported
        piece, size = _FORMATS[name]
        self.place(size)
        self.add(piece, size)
        self.targets.append(source)

    def array(self, name: str, length: int, source: str) -> None:
        if name not in _FORMATS:
            raise _Unsupported
        _, size = _FORMATS[name]
        self.place(size)
        value = self.held(f'{source}.tobytes()')
        # A struct would cut or fill silently.
        self.emit(f'if len({value}) != {length * size}: raise ValueError')
        self.add(f'{length * size}s', length * size)
        self.targets.append(value)

    def sequence(self, kind: Nodetype, element: Any, held: str) -> None:
        self.base('uint32', f'len({held})')
        self.flush()
        if kind == Nodetype.BASE and element[0] in _FORMATS:
            _, size = _FORMATS[element[0]]
            if size > 4:
                self.emit(f'if len({held}):')
                for line in ('n = (4 - p) & 7', 'o.append(zeros[n])', 'p += n'):
                    self.emit(' ' + line)
            value = self.held(f'{held}.tobytes()')
            self.emit(f'if len({value}) != len({held}) * {size}: raise ValueError')
            self.emit(f'o.append({value})')
            self.emit(f'p += len({value})')
            self.known, self.offset = min(size, 4), 0
            return
        item = self.fresh()
        self.emit(f'for {item} in {held}:')
        self.indent += ' '
        self.known, self.offset = 1, 0
        if kind == Nodetype.NAME:
            self.message(element, item)
        else:
            self.base(element[0], item)
        self.flush()
        self.indent = self.indent[:-1]
        self.known, self.offset = 1, 0


def _compile(lines: list[str], namespace: dict[str, Any], name: str) -> Callable[[Any], Any]:
    exec('\n'.join(lines), namespace)
    return namespace[name]


def decoder(store: Typestore, type_name: str) -> Callable[[bytes], Any]:
    """Return a function from CDR bytes to a message; it raises what ``store.deserialize_cdr`` raises."""
    namespace: dict[str, Any] = {'frombuffer': np.frombuffer}
    writer = _Decoder('decode', store, namespace)
    try:
        built = writer.message(type_name)
    except _Unsupported:
        return lambda data: store.deserialize_cdr(data, type_name)
    writer.flush()
    body = ['def decode(d):', ' p = 4', *writer.lines, f' return {built}, p']
    decode = _compile(body, namespace, 'decode')

    def fast(data: bytes) -> Any:
        if data[:2] == _LITTLE:
            try:
                message, end = decode(data)
                # Serialised data may end with up to three bytes of padding.
                if end <= len(data) <= end + 3:
                    return message
            except (struct.error, ValueError, IndexError):
                pass  # rosbags decides, and says what is wrong
        return store.deserialize_cdr(data, type_name)

    return fast


def encoder(store: Typestore, type_name: str) -> Callable[[Any], bytes]:
    """Return a function from a message to CDR bytes, equal to those of ``store.serialize_cdr``."""
    namespace: dict[str, Any] = {'zeros': [bytes(n) for n in range(8)], 'start': b'\x00\x01\x00\x00'}
    writer = _Encoder('encode', store, namespace)
    try:
        writer.message(type_name, 'm')
    except _Unsupported:
        return lambda message: bytes(store.serialize_cdr(message, type_name))
    writer.flush()
    body = ['def encode(m):', ' o = [start]', ' p = 4', *writer.lines, " return b''.join(o)"]
    encode = _compile(body, namespace, 'encode')

    def fast(message: Any) -> bytes:
        try:
            return encode(message)
        except (struct.error, ValueError, TypeError, AttributeError):
            return bytes(store.serialize_cdr(message, type_name))  # rosbags says what is wrong

    return fast
