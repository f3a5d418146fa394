# SPDX-License-Identifier: Apache-2.0
"""What all command lines share: help, one line on errors, exit codes, a bar only for long work."""

import importlib

import pytest

from bag_tools import cli
from bag_tools.bag import BagError
from bag_tools.cli import Progress, guarded

TOOLS = ('offline', 'score', 'report', 'import_data', 'info', 'compare', 'nodes.play', 'nodes.record')


@pytest.mark.parametrize('tool', TOOLS)
def test_every_tool_explains_itself(tool, capsys):
    main = importlib.import_module(f'bag_tools.{tool}').main
    with pytest.raises(SystemExit) as end:
        main(['--help'])
    assert end.value.code == 0
    assert 'usage: ' in capsys.readouterr().out


@pytest.mark.parametrize('tool', TOOLS)
def test_missing_arguments_exit_with_2(tool):
    with pytest.raises(SystemExit) as end:
        importlib.import_module(f'bag_tools.{tool}').main([])
    assert end.value.code == 2


@pytest.mark.parametrize(
    ('error', 'code', 'line'),
    [
        (BagError('x.mcap: broken\n in two lines'), 2, 'tool: x.mcap: broken in two lines'),
        (PermissionError(13, 'Permission denied', '/x'), 2, 'tool: /x: Permission denied'),
        (KeyboardInterrupt(), 130, ''),
    ],
)
def test_errors_are_one_line_with_an_exit_code(capsys, error, code, line):
    def fail(_argv):
        raise error

    assert guarded('tool', fail, []) == code
    assert capsys.readouterr().err.strip() == line


def test_nodes_end_with_zero_on_ctrl_c():
    def fail(_argv):
        raise KeyboardInterrupt

    assert guarded('play', fail, [], interrupted=0) == 0


def test_faults_of_the_program_are_not_hidden():
    def fail(_argv):
        raise RuntimeError('a bug')

    with pytest.raises(RuntimeError):
        guarded('tool', fail, [])


def test_the_bar_shows_after_two_seconds_and_is_wiped(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(cli.time, 'monotonic', lambda: now[0])
    with Progress('work', 10.0, force=True) as progress:
        now[0] = 1.9
        progress.update(2.0)
        assert capsys.readouterr().err == ''
        now[0] = 4.0
        progress.update(5.0)
        shown = capsys.readouterr().err
        assert '50 %' in shown
        assert '4 s left' in shown
        now[0] = 4.1
        progress.update(6.0)
        assert capsys.readouterr().err == ''
    assert capsys.readouterr().err.endswith('\x1b[K')


def test_no_bar_where_nobody_looks(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(cli.time, 'monotonic', lambda: now[0])
    with Progress('work', 10.0) as progress:
        now[0] = 5.0
        progress.update(5.0)
    assert capsys.readouterr().err == ''
