# SPDX-License-Identifier: Apache-2.0
"""The base of drivers as a process."""

import os
import time
from pathlib import Path

import pytest

from node_core.testing import Process, probe

STRING = 'std_msgs/msg/String'
SCRIPT = Path(__file__).parent / 'byte_reader.py'
SECOND = 10**9
LONG = 600  # s: discovery on a loaded machine


def start(**params):
    return Process.script(SCRIPT, params=params)


@pytest.fixture
def graph():
    with probe() as p:
        yield p


def recording(path, count, step):
    path.write_text(''.join(f'{SECOND + i * step} {i}\n' for i in range(count)))
    return path


def test_a_recording_starts_with_its_audience_and_loses_nothing(graph, tmp_path):
    path = recording(tmp_path / 'lines', 150, SECOND // 100)
    process = start(source=path, wait_for_subscribers=LONG, replay_rate=0.0)
    with process:
        # The node is there before anybody listens.
        graph.wait_for_publisher('lines', process)
        lines = graph.collect(STRING, 'lines')
        graph.until_over(process)
        assert process.wait() == 0, process.output
        assert process.output.count('wait_for_subscribers') == 1
        assert "'/lines'" in process.output
        assert '150 x line' in process.output
    assert [m.data.split()[-1:] for m in lines] == [[str(i)] for i in range(150)]


def test_a_recording_without_audience_waits_as_long_as_it_is_told(graph, tmp_path):
    path = recording(tmp_path / 'lines', 3, 1)
    with start(source=path, wait_for_subscribers=0.0) as process:
        assert process.wait() == 0
        assert 'wait_for_subscribers' not in process.output
    with start(source=path, wait_for_subscribers=0.2) as process:
        assert process.wait() == 0
        assert process.output.count('wait_for_subscribers') == 1


def test_a_recording_takes_its_own_time_but_not_over_a_leap(graph, tmp_path):
    path = tmp_path / 'lines'
    path.write_text(''.join(f'{s * SECOND} x\n' for s in (100, 101, 102, 100_000, 50, 51)))
    begin = time.monotonic()
    with start(source=path, wait_for_subscribers=0.0, replay_rate=2.0) as process:
        assert process.wait() == 0, process.output
    assert time.monotonic() - begin >= 1.5


def test_a_lost_port_is_said_once_and_opened_again(graph, tmp_path):
    lines = graph.collect(STRING, 'lines')
    diagnostics = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    master, slave = os.openpty()
    port = Path(tmp_path / 'ttyTEST')
    port.symlink_to(os.ttyname(slave))

    def feed():
        os.write(master, b'hello\n')
        return len(lines) > 3

    def error(words):
        return any(s.level == b'\x02' and words in s.message for d in diagnostics for s in d.status)

    with start(source=port, reconnect_time=0.05) as process:
        graph.until(feed, 'lines of the port', process=process)
        # Silence is said too; its words grow with time but are printed once.
        graph.until(lambda: error('no line for 4 s'), 'an error about silence', process=process)
        assert process.output.count('no line for') == 1
        lines.clear()
        graph.until(feed, 'lines again', process=process)
        os.close(slave)
        os.close(master)
        port.unlink()
        graph.until(lambda: 'lost' in process.output, 'a warning on the terminal', process=process)
        graph.until(lambda: error('ttyTEST'), 'an error that names the port', process=process)
        master, slave = os.openpty()
        port.symlink_to(os.ttyname(slave))
        lines.clear()
        graph.until(feed, 'lines of the new port', process=process)
        assert process.stop() == 0, process.output
        assert process.output.count(f'{port}: lost') == 1
        assert process.output.count(f'{port}: open') == 2
    os.close(slave)
    os.close(master)


def test_a_fault_of_the_program_ends_the_node_with_its_traceback(tmp_path):
    path = tmp_path / 'lines'
    path.write_text('fault\n')
    with start(source=path, wait_for_subscribers=0.0) as process:
        assert process.wait() == 1
        assert 'RuntimeError: a fault of the program' in process.output


@pytest.mark.parametrize(
    ('source', 'words'),
    [
        ('/nowhere/lines', "'source': /nowhere/lines: cannot be read"),
        ("''", "'source' is empty"),
        ('ntrip://me:secret@host', "'source': expected ntrip://"),
    ],
)
def test_a_source_that_cannot_be_is_one_line_and_exit_code_2(source, words):
    with start(source=source) as process:
        assert process.wait() == 2
        (line,) = [line for line in process.output.splitlines() if line.strip()]
        assert words in line
        assert 'secret' not in line


def test_ctrl_c_while_a_recording_waits_is_clean(graph, tmp_path):
    path = recording(tmp_path / 'lines', 3, 1)
    with start(source=path, wait_for_subscribers=LONG) as process:
        graph.until(lambda: 'wait_for_subscribers' in process.output, 'the wait', process=process)
        assert process.stop() == 0
        assert 'Traceback' not in process.output
