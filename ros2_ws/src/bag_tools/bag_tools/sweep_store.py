# SPDX-License-Identifier: Apache-2.0
"""Results of a sweep on disk: one small file per finished run, and one Parquet table of all of them.

A run's file appears whole or not at all, so that a sweep that was killed goes on where it was.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bag_tools.bag import BagError
from bag_tools.sweep_plan import Task
from bag_tools.sweep_task import Row

TABLE = 'results.parquet'
_ROWS = 'rows'


class Store:
    """The folder of one sweep."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._rows = folder / _ROWS
        try:
            self._rows.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BagError(f'{folder}: cannot be written ({error.strerror})') from error
        self._known: dict[str, Row] = {}

    def get(self, task: Task) -> Row | None:
        """Return the row of `task` if it has been run."""
        key = task.key
        if key not in self._known:
            path = self._rows / f'{key}.json'
            if not path.exists():
                return None
            try:
                self._known[key] = json.loads(path.read_text(encoding='utf-8'))
            except ValueError:
                raise BagError(f'{path}: is damaged; remove it to run that task again') from None
        return self._known[key]

    def put(self, row: Row) -> None:
        """Keep `row`; a reader or a crash never sees half of it."""
        path = self._rows / f'{row["key"]}.json'
        temporary = path.with_suffix('.tmp')
        temporary.write_text(json.dumps(row), encoding='utf-8')
        os.replace(temporary, path)
        self._known[row['key']] = row

    def write_table(self, tasks: Sequence[Task]) -> Path:
        """Write the rows of `tasks`, in their order, as one Parquet file and return its path."""
        import pyarrow
        from pyarrow import parquet

        rows = [row for task in tasks if (row := self.get(task)) is not None]
        columns = dict.fromkeys(name for row in rows for name in row)
        table = pyarrow.table({name: _column([row.get(name) for row in rows]) for name in columns})
        path = self.folder / TABLE
        temporary = path.with_suffix('.tmp')
        parquet.write_table(table, temporary)
        os.replace(temporary, path)
        return path


def _column(values: list[Any]) -> list[Any]:
    """Return a column of one type: whole numbers among floats become floats, mixtures become text."""
    kinds = {type(v) for v in values if v is not None}
    if kinds == {int, float}:
        return [None if v is None else float(v) for v in values]
    if len(kinds) > 1:
        return [None if v is None else json.dumps(v) for v in values]
    return values
