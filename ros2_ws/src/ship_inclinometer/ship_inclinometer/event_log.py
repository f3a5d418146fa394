# SPDX-License-Identifier: Apache-2.0
"""Append-only event log on SQLite: what is confirmed survives `kill -9` and a power cut.

WAL with synchronous FULL syncs the log at every commit: `append` returns only when the event is on the
medium (https://www.sqlite.org/pragma.html#pragma_synchronous). Triggers forbid changing or deleting rows;
rotation starts a new file and keeps the old ones.
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import os
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_SCHEMA = """
CREATE TABLE IF NOT EXISTS event (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    stamp INTEGER NOT NULL,
    kind TEXT NOT NULL,
    who TEXT NOT NULL,
    text TEXT NOT NULL
);
CREATE TRIGGER IF NOT EXISTS event_keep BEFORE DELETE ON event
BEGIN SELECT RAISE(ABORT, 'the event log is append-only'); END;
CREATE TRIGGER IF NOT EXISTS event_fixed BEFORE UPDATE ON event
BEGIN SELECT RAISE(ABORT, 'the event log is append-only'); END;
"""
# Another process (Modbus bridge, display) may hold the write lock for one commit.
_BUSY_SECONDS = 5.0


class LogError(RuntimeError):
    """The event log cannot be opened or written; the message names the file."""


class Event(NamedTuple):
    """One event; `id` counts from 1 within a file, `stamp` in ns since 1970."""

    id: int
    stamp: int
    kind: str
    who: str
    text: str


class EventLog:
    """Append-only log at `path`; several processes may append to the same file."""

    def __init__(self, path: Path | str, max_events: int = 100_000, keep_files: int = 100) -> None:
        self.path = Path(path)
        self._max_events = max_events
        self._keep_files = keep_files
        self._lock = threading.Lock()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LogError(f'event log {self.path}: {error}') from error
        with self._among_processes():
            self._connection = self._open()
            self._inode = os.stat(self.path).st_ino

    def _open(self) -> sqlite3.Connection:
        try:
            connection = sqlite3.connect(
                self.path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False
            )
            connection.execute('PRAGMA journal_mode=WAL')
            connection.execute('PRAGMA synchronous=FULL')
            connection.executescript(_SCHEMA)
        except (OSError, sqlite3.Error) as error:
            raise LogError(f'event log {self.path}: {error}') from error
        return connection

    def append(self, stamp: int, kind: str, who: str, text: str) -> int:
        """Write one event and return its id once it is on the medium; raise LogError otherwise."""
        with self._lock, self._among_processes():
            try:
                self._follow_rotation()
                cursor = self._connection.execute(
                    'INSERT INTO event (stamp, kind, who, text) VALUES (?, ?, ?, ?)', (stamp, kind, who, text)
                )
            except (OSError, sqlite3.Error) as error:
                raise LogError(f'event log {self.path}: {error}') from error
            row = int(cursor.lastrowid or 0)
            if row >= self._max_events:
                self._rotate()
            return row

    @contextlib.contextmanager
    def _among_processes(self) -> Iterator[None]:
        """Hold off other processes: none may append to a file that is being rotated away."""
        try:
            file = self.path.with_name(f'{self.path.name}.lock').open('w')
        except OSError as error:
            raise LogError(f'event log {self.path}: {error}') from error
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError as error:
                raise LogError(f'event log {self.path}: {error}') from error
            yield

    def _follow_rotation(self) -> None:
        """Reopen the file if another process has rotated it away."""
        try:
            same = os.stat(self.path).st_ino == self._inode
        except FileNotFoundError:
            same = False
        if not same:
            self._connection.close()
            self._connection = self._open()
            self._inode = os.stat(self.path).st_ino

    def _rotate(self) -> None:
        """Start a new file; the full one is kept as NAME.1, the one before as NAME.2, and so on."""
        try:
            self._connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
            self._connection.close()
            for number in range(self._keep_files - 1, 0, -1):
                older = self._numbered(number)
                if older.exists():
                    os.replace(older, self._numbered(number + 1))
            os.replace(self.path, self._numbered(1))
        except (OSError, sqlite3.Error) as error:
            raise LogError(f'event log {self.path}: {error}') from error
        finally:
            self._connection = self._open()
            self._inode = os.stat(self.path).st_ino

    def _numbered(self, number: int) -> Path:
        return self.path.with_name(f'{self.path.name}.{number}')

    def events(self, limit: int | None = None) -> list[Event]:
        """Return the newest `limit` events of the current file, oldest first."""
        with self._lock:
            rows = self._connection.execute(
                'SELECT id, stamp, kind, who, text FROM event ORDER BY id DESC LIMIT ?',
                (-1 if limit is None else limit,),
            ).fetchall()
        return [Event(*row) for row in reversed(rows)]

    def export_csv(self, path: Path | str) -> int:
        """Write all events of the current file as CSV and return their number; never leaves a part."""
        events = self.events()
        target = Path(path)
        partial = target.with_name(f'.{target.name}.part')
        with partial.open('w', newline='', encoding='utf-8') as file:
            writer = csv.writer(file)
            writer.writerow(Event._fields)
            writer.writerows(events)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, target)
        return len(events)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()
