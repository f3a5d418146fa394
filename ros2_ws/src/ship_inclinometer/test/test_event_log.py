# SPDX-License-Identifier: Apache-2.0
import csv
import multiprocessing
import shutil
import signal
import sqlite3
import subprocess
import sys

import pytest

from ship_inclinometer.event_log import EventLog, LogError

WRITER = """
import sys
from ship_inclinometer.event_log import EventLog
log = EventLog(sys.argv[1])
n = 0
while True:
    print(log.append(n, 'mark', 'test', 'x' * 50), flush=True)
    n += 1
"""


def test_nothing_confirmed_is_lost_when_the_writer_is_killed(tmp_path):
    path, confirmed = tmp_path / 'events.db', set()
    for lines in (1, 2, 7, 30, 90):
        process = subprocess.Popen([sys.executable, '-c', WRITER, str(path)], stdout=subprocess.PIPE)
        confirmed |= {int(process.stdout.readline()) for _ in range(lines)}
        process.send_signal(signal.SIGKILL)
        confirmed |= {int(line) for line in process.stdout.read().splitlines(True) if line.endswith(b'\n')}
        process.wait()
        log = EventLog(path)
        assert confirmed <= {event.id for event in log.events()}
        log.close()


def test_every_commit_is_synced(tmp_path):
    log = EventLog(tmp_path / 'e.db')
    assert log._connection.execute('PRAGMA journal_mode').fetchone()[0] == 'wal'
    assert log._connection.execute('PRAGMA synchronous').fetchone()[0] == 2


def test_events_cannot_be_changed_or_deleted(tmp_path):
    log = EventLog(tmp_path / 'e.db')
    log.append(1, 'alarm', 'a', 'b')
    for statement in ('DELETE FROM event', "UPDATE event SET text = 'c'"):
        with pytest.raises(sqlite3.IntegrityError, match='append-only'):
            log._connection.execute(statement)


def _append(path, name):
    log = EventLog(path, max_events=40)
    for n in range(60):
        log.append(n, 'mark', name, str(n))


def test_several_processes_share_a_file_over_its_rotation(tmp_path):
    path = tmp_path / 'e.db'
    EventLog(path).close()
    context = multiprocessing.get_context('spawn')
    workers = [context.Process(target=_append, args=(path, name)) for name in 'ab']
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    seen = []
    for file in [path, *tmp_path.glob('e.db.*')]:
        if file.name.endswith(('-wal', '-shm', '.lock')):
            continue
        log = EventLog(file)
        seen += [(event.who, event.text) for event in log.events()]
        log.close()
    assert len(seen) == len(set(seen)) == 120


def test_rotation_keeps_the_old_file(tmp_path):
    log = EventLog(tmp_path / 'e.db', max_events=3)
    for n in range(7):
        log.append(n, 'mark', 'a', str(n))
    assert [e.text for e in log.events()] == ['6']
    assert [e.text for e in EventLog(tmp_path / 'e.db.1').events()] == ['3', '4', '5']
    assert [e.text for e in EventLog(tmp_path / 'e.db.2').events()] == ['0', '1', '2']


def test_export_is_csv_with_a_header(tmp_path):
    log = EventLog(tmp_path / 'e.db')
    log.append(5, 'alarm', 'monitor', 'heel, 21.0 "deg"')
    assert log.export_csv(tmp_path / 'e.csv') == 1
    with (tmp_path / 'e.csv').open(newline='') as file:
        rows = list(csv.reader(file))
    assert rows == [
        ['id', 'stamp', 'kind', 'who', 'text'],
        ['1', '5', 'alarm', 'monitor', 'heel, 21.0 "deg"'],
    ]


def test_a_file_that_is_no_log_is_named(tmp_path):
    path = tmp_path / 'e.db'
    path.write_text('not a database' * 100)
    with pytest.raises(LogError, match=r'e\.db'):
        EventLog(path)


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(LogError, match=r'file/e\.db'):
        EventLog(tmp_path / 'file' / 'e.db')


def test_a_log_that_was_removed_is_begun_anew_and_one_that_broke_says_so(tmp_path):
    path = tmp_path / 'e.db'
    log = EventLog(path)
    log.append(1, 'mark', 'a', 'b')
    path.unlink()
    assert log.append(2, 'mark', 'a', 'c') == 1
    log._connection.execute('DROP TABLE event')
    with pytest.raises(LogError, match=r'e\.db: no such table'):
        log.append(3, 'mark', 'a', 'd')


def test_a_folder_that_is_gone_is_one_error_of_the_log(tmp_path):
    log = EventLog(tmp_path / 'logs' / 'e.db')
    log.append(1, 'mark', 'a', 'b')
    shutil.rmtree(tmp_path / 'logs')
    with pytest.raises(LogError, match=r'e\.db'):
        log.append(2, 'mark', 'a', 'c')
