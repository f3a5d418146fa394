# SPDX-License-Identifier: Apache-2.0
"""Numbers by column name out of CSV and npz files, with errors that say which file, line and column."""

from __future__ import annotations

import csv
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bag_tools.bag import BagError

# Every whole number of so many digits is a double; longer ones are stamps.
_DIGITS = 15
_LARGEST = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True)
class CsvFormat:
    """How a text table is written. `header` is True, or the column names of a file without a header line.

    `delimiter` 'whitespace' splits at runs of blanks; lines that start with `comment` are passed over.
    """

    delimiter: str = ','
    header: bool | list[str] = True
    skip: int = 0
    comment: str = '#'
    encoding: str = 'utf-8-sig'  # with or without a byte order mark


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of one file, each (n,) or (n, k); what is not as long as the rest is in `constants`.

    Whole numbers stay whole, since a double holds no Unix time in nanoseconds; `times` names the columns
    that are in nanoseconds, whatever a mapping says.
    """

    path: Path
    columns: dict[str, NDArray[Any]]
    constants: dict[str, float] = field(default_factory=dict)
    times: frozenset[str] = frozenset()

    def column(self, name: str) -> NDArray[Any]:
        """Return a column as (n, k); raise BagError naming what there is."""
        if name not in self.columns:
            raise BagError(f"{self.path}: no column '{name}'; the file has: {', '.join(self.columns)}")
        data = self.columns[name]
        return data[:, None] if data.ndim == 1 else data


def _number(text: str, path: Path, line: int, name: str) -> float | int:
    text = text.strip()
    if not text:
        return float('nan')
    try:
        return int(text) if len(text) > _DIGITS and text.isdecimal() else float(text)
    except ValueError:
        raise BagError(f"{path}: line {line}, column '{name}': '{text}' is not a number") from None


def read_csv(path: Path, style: CsvFormat, wanted: Collection[str]) -> Table:
    """Read the `wanted` columns of a text table; empty cells are NaN."""
    names: list[str] | None = None if style.header is True else list(style.header or [])
    rows: list[list[float | int]] = []
    picked: list[tuple[int, str]] = []
    try:
        with path.open(newline='', encoding=style.encoding) as file:
            for number, line in enumerate(file, start=1):
                text = line.strip()
                if number <= style.skip or not text or (style.comment and text.startswith(style.comment)):
                    continue
                # A tab at the end of a line stands for an empty cell.
                cells = (
                    text.split()
                    if style.delimiter == 'whitespace'
                    else next(csv.reader([line.rstrip('\r\n')], delimiter=style.delimiter))
                )
                if names is None:
                    names = [c.strip() for c in cells]
                    continue
                if not picked:
                    picked = _pick(path, names, wanted)
                if len(cells) != len(names):
                    raise BagError(f'{path}: line {number} has {len(cells)} columns, expected {len(names)}')
                rows.append([_number(cells[i], path, number, n) for i, n in picked])
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or 'is not text'
        raise BagError(f'{path}: cannot be read ({reason}); expected a CSV file') from error
    if not rows:
        raise BagError(f'{path}: has no rows')
    columns = {name: _column([row[i] for row in rows]) for i, (_, name) in enumerate(picked)}
    return Table(path, columns)


def _column(values: list[float | int]) -> NDArray[Any]:
    whole = all(isinstance(v, int) and v <= _LARGEST for v in values)
    return np.array(values, dtype=np.int64 if whole else np.float64)


def _pick(path: Path, names: list[str], wanted: Collection[str]) -> list[tuple[int, str]]:
    for name in wanted:
        if name not in names:
            raise BagError(f"{path}: no column '{name}'; the file has: {', '.join(names)}")
    return [(names.index(name), name) for name in dict.fromkeys(wanted)]


def read_npz(path: Path) -> Table:
    """Read all numeric arrays of an npz file; single numbers become constants."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # numpy and zipfile raise a dozen kinds for broken archives
        raise BagError(f'{path}: cannot be read ({error}); expected an npz file without objects') from error
    columns: dict[str, NDArray[Any]] = {}
    constants: dict[str, float] = {}
    for name, array in arrays.items():
        if array.dtype.kind not in 'fiub':
            continue
        if array.size == 1:
            constants[name] = float(array.reshape(()))
        elif array.ndim in (1, 2):
            columns[name] = array if array.dtype.kind in 'iu' else array.astype(np.float64)
    if not columns:
        raise BagError(f'{path}: has no numeric arrays')
    return Table(path, columns, constants)


def csv_format(options: Mapping[str, Any], where: str) -> CsvFormat:
    """Return the format from a mapping file's ``csv:`` section."""
    try:
        style = CsvFormat(**options)
    except TypeError:
        names = ', '.join(CsvFormat.__dataclass_fields__)
        raise BagError(f'{where}: csv: {options} is malformed; expected {names}') from None
    known = style.delimiter == 'whitespace' or (
        isinstance(style.delimiter, str) and len(style.delimiter) == 1
    )
    if not known:
        expected = 'one character ("\\t" for a tab, in double quotes) or whitespace'
        raise BagError(f"{where}: csv: delimiter is '{style.delimiter}', expected {expected}")
    return style
