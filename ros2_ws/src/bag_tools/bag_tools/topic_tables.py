# SPDX-License-Identifier: Apache-2.0
"""Numbers by field path out of a topic of a bag: what a mapping takes in the place of a table's columns."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bag_tools.bag import BagError, BagReader, Topic
from bag_tools.series import NANOSECONDS, walk
from bag_tools.tables import Table

# The column of every topic that no message holds: when the bag says that the message came.
BAG_TIME = 'bag_time'
# The numbers of a field that is a message of its own, in the order of a mapping's columns.
COMPONENTS = {'Vector3': 'xyz', 'Point': 'xyz', 'Point32': 'xyz', 'Quaternion': 'wxyz'}


def _is_time(value: Any) -> bool:
    return hasattr(value, 'nanosec')


def _numbers(value: Any) -> Any:
    """Return the number or numbers of a field; of a time or duration whole nanoseconds."""
    if _is_time(value):
        return value.sec * NANOSECONDS + value.nanosec
    components = COMPONENTS.get(type(value).__name__.split('__')[-1])
    return value if components is None else [getattr(value, c) for c in components]


def _column(values: list[Any], where: str) -> NDArray[Any]:
    try:
        array = np.array(values)
    except ValueError:
        raise BagError(f'{where} changes its length from message to message') from None
    if array.dtype.kind not in 'fiub' or array.ndim > 2:
        raise BagError(f'{where} is not a number, a vector or a list of numbers')
    if not array.size:
        raise BagError(f'{where} is empty')
    return array


def read_topic(reader: BagReader, topic: Topic, paths: Collection[str]) -> Table:
    """Return the fields of a topic at `paths`, a row per message, (n,) or (n, k), and the bag times.

    Whole numbers stay whole: a double holds no stamp in nanoseconds. Raises BagError for a field that is
    missing, changes its length or holds no numbers, and for a topic without messages.
    """
    name = Path(f'{reader.path}:{topic.name}')
    bag_times: list[int] = []
    values: dict[str, list[Any]] = {path: [] for path in paths if path != BAG_TIME}
    times = {BAG_TIME}
    for _, bag_time, data in reader.messages([topic.name]):
        message = reader.decode(data, topic.type)
        try:
            found = {path: walk(message, path) for path in values}
        except LookupError as error:
            where = f'{name}: message {len(bag_times)}'
            raise BagError(f"{where}: {topic.type} has no field '{error.args[0]}'") from None
        times.update(path for path, value in found.items() if _is_time(value))
        bag_times.append(bag_time)
        for path, value in found.items():
            values[path].append(_numbers(value))
    if not bag_times:
        raise BagError(f'{name}: has no messages')
    columns = {path: _column(rows, f"{name}: '{path}'") for path, rows in values.items()}
    return Table(name, {BAG_TIME: np.array(bag_times), **columns}, times=frozenset(times))
