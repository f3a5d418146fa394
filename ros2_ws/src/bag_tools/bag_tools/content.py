# SPDX-License-Identifier: Apache-2.0
"""Content of bags as decoded fields: hash, equality to the last bit, first difference.

Serialised bytes are no measure: DDS leaves padding uninitialised. Decoding and serialising again with
rosbags zeroes it, so the canonical bytes are a bijection of the decoded fields (NaN payloads and the sign
of zero included).
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bag_tools.bag import BagReader

_FLOAT64 = 8  # sensor_msgs/PointField.FLOAT64
# What depends on the machine and the moment, not on the data.
VOLATILE_TOPICS = frozenset(
    {'/diagnostics', '/clock', '/rosout', '/parameter_events', '/lockstep/progress', '/lockstep/links'}
)


def canonical(reader: BagReader, data: bytes, type_name: str) -> bytes:
    """Return the bytes that stand for the decoded fields of one message."""
    return reader.encode(reader.decode(data, type_name), type_name)


def topic_hashes(reader: BagReader, topics: Collection[str] | None = None) -> dict[str, str]:
    """Return, by topic, a SHA-256 over type, bag times and decoded fields."""
    names = sorted(reader.topics if topics is None else topics)
    sums = {name: hashlib.sha256(reader.topics[name].type.encode()) for name in names}
    for topic, stamp, data in reader.messages(names):
        digest = sums[topic]
        digest.update(stamp.to_bytes(8, 'little'))
        digest.update(canonical(reader, data, reader.topics[topic].type))
    return {name: digest.hexdigest() for name, digest in sums.items()}


def content_hash(path: str | Path, topics: Collection[str] | None = None) -> str:
    """Return one hash over all topics: equal for equal content in any storage or compression."""
    with BagReader(path) as reader:
        return combined(topic_hashes(reader, topics))


def combined(hashes: dict[str, str]) -> str:
    """Return one hash from the hashes of the topics."""
    lines = '\n'.join(f'{name} {digest}' for name, digest in sorted(hashes.items()))
    return hashlib.sha256(lines.encode()).hexdigest()


def flatten(value: Any, path: str = '') -> Iterator[tuple[str, Any]]:
    """Yield (field path, leaf value) of a decoded message, numpy arrays element by element."""
    if is_dataclass(value):
        for field in fields(value):
            if field.default is MISSING:  # rosbags' classes carry the message's constants as defaults
                yield from flatten(getattr(value, field.name), f'{path}.{field.name}' if path else field.name)
    elif isinstance(value, np.ndarray | list | tuple):
        for index, element in enumerate(value):
            yield from flatten(element, f'{path}[{index}]')
    else:
        yield path, value


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return np.float64(a).tobytes() == np.float64(b).tobytes()
    return type(a) is type(b) and a == b


def first_difference(a: Any, b: Any) -> str:
    """Return 'field: a != b' of the first differing field of two decoded messages, '' when there is none."""
    fields_a, fields_b = list(flatten(a)), list(flatten(b))
    for (name_a, value_a), (name_b, value_b) in zip(fields_a, fields_b):
        if name_a != name_b:
            return f'{name_a} against {name_b}: different lengths'
        if not _same(value_a, value_b):
            return f'{name_a}: {value_a!r} != {value_b!r}'
    return '' if len(fields_a) == len(fields_b) else 'different lengths'


@dataclass(frozen=True, slots=True)
class TopicComparison:
    """One topic in two bags: message counts, and the first difference in words ('' when equal)."""

    topic: str
    count_a: int
    count_b: int
    difference: str
    largest: float = 0.0

    @property
    def equal(self) -> bool:
        """Whether the topic has equal content in both bags."""
        return not self.difference


def _cloud_values(message: Any) -> NDArray[np.float64] | None:
    """Return the numbers of a PointCloud2 that holds nothing but float64, else None."""
    fields = getattr(message, 'fields', None)
    if fields is None or not hasattr(message, 'point_step') or any(f.datatype != _FLOAT64 for f in fields):
        return None
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    return data.view(np.float64) if data.size % 8 == 0 else None


def _largest(a: Any, b: Any) -> float:
    """Return the largest absolute difference of numeric fields, inf when anything else differs."""
    worst = 0.0
    cloud_a, cloud_b = _cloud_values(a), _cloud_values(b)
    if cloud_a is not None and cloud_b is not None and cloud_a.shape == cloud_b.shape:
        # The bytes of a number say nothing about how far it is from another.
        unlike = np.isnan(cloud_a) != np.isnan(cloud_b)
        worst = float('inf') if unlike.any() else float(np.nanmax(np.abs(cloud_a - cloud_b), initial=0.0))
        b = replace(b, data=a.data)
    for (name_a, x), (name_b, y) in zip(flatten(a), flatten(b)):
        if name_a != name_b:
            return float('inf')
        if _same(x, y):
            continue
        numeric = isinstance(x, int | float | np.number) and isinstance(y, int | float | np.number)
        if not numeric:
            return float('inf')
        gap = abs(float(x) - float(y))
        worst = max(worst, gap if gap == gap else float('inf'))
    return worst


def _read(reader: BagReader, name: str) -> list[tuple[int, bytes]]:
    return [(stamp, data) for _, stamp, data in reader.messages([name])]


def _compare_messages(
    reader_a: BagReader, reader_b: BagReader, name: str, *, stamps: bool, tolerance: float
) -> TopicComparison:
    type_a, type_b = reader_a.topics[name].type, reader_b.topics[name].type
    list_a, list_b = _read(reader_a, name), _read(reader_b, name)
    counts = (name, len(list_a), len(list_b))
    if type_a != type_b:
        return TopicComparison(*counts, f'type {type_a} != {type_b}', float('inf'))
    first, largest = '', 0.0
    for index, ((stamp_a, data_a), (stamp_b, data_b)) in enumerate(zip(list_a, list_b)):
        if stamps and stamp_a != stamp_b:
            return TopicComparison(*counts, f'message {index}: bag time {stamp_a} != {stamp_b}', largest)
        if canonical(reader_a, data_a, type_a) == canonical(reader_b, data_b, type_b):
            continue
        a, b = reader_a.decode(data_a, type_a), reader_b.decode(data_b, type_b)
        gap = _largest(a, b)
        largest = max(largest, gap)
        # -0.0 against 0.0 differs in bits, by nothing in value.
        if not first and (gap > tolerance or tolerance == 0.0):
            first = f'message {index}: {first_difference(a, b)}'
    if not first and len(list_a) != len(list_b):
        first = f'{len(list_a)} != {len(list_b)} messages'
    return TopicComparison(*counts, first, largest)


def compare(
    path_a: str | Path,
    path_b: str | Path,
    topics: Collection[str] | None = None,
    *,
    stamps: bool = False,
    tolerance: float = 0.0,
) -> list[TopicComparison]:
    """Compare two bags topic by topic, messages in order of bag time.

    Without `topics`, all topics of either bag but those that depend on the moment (VOLATILE_TOPICS).
    `stamps` compares bag times too; `tolerance` allows numbers to differ by so much (for other machines).
    """
    with BagReader(path_a) as a, BagReader(path_b) as b:
        if topics is None:
            names = sorted((set(a.topics) | set(b.topics)) - VOLATILE_TOPICS)
        else:
            names = [(a.topics.get(t) or b.topics.get(t) or a.topic(t)).name for t in topics]
        result = []
        for name in names:
            if name in a.topics and name in b.topics:
                result.append(_compare_messages(a, b, name, stamps=stamps, tolerance=tolerance))
                continue
            count_a = a.topics[name].count if name in a.topics else 0
            count_b = b.topics[name].count if name in b.topics else 0
            where = path_a if name not in a.topics else path_b
            result.append(TopicComparison(name, count_a, count_b, f'not in {where}', float('inf')))
        return result
