# SPDX-License-Identifier: Apache-2.0
"""Command lines as users type them; Ctrl-C."""

from pathlib import Path

import pytest

from node_core.spin import missing_params_file, ros_arguments
from node_core.testing import Process, parameter_text


@pytest.mark.parametrize(
    ('given', 'expected'),
    [
        (['n', '-p', 'a:=1'], ['n', '--ros-args', '-p', 'a:=1']),
        (['n', 'x', '--params-file', 'f'], ['n', 'x', '--ros-args', '--params-file', 'f']),
        (['n', '--ros-args', '-p', 'a:=1'], ['n', '--ros-args', '-p', 'a:=1']),
        (['n', 'file'], ['n', 'file']),
    ],
)
def test_ros_flags_work_without_the_ros_args_marker(given, expected):
    assert ros_arguments(given) == expected


@pytest.mark.parametrize(
    ('value', 'text'),
    [(True, 'true'), (2, '2'), (5e-06, '5.0e-06'), (0.5, '0.5'), ((0.0, 1e-9), '[0.0, 1.0e-09]'), ('a', 'a')],
)
def test_parameter_values_are_written_as_rcl_reads_them(value, text):
    assert parameter_text(value) == text


def test_a_missing_parameter_file_is_named(tmp_path):
    there = tmp_path / 'there.yaml'
    there.write_text('')
    gone = str(tmp_path / 'gone.yaml')
    assert missing_params_file(['n', '--ros-args', '--params-file', str(there)]) is None
    assert missing_params_file(['n', '--params-file', str(there), '--params-file', gone]) == gone


def test_ctrl_c_within_a_call_of_ros_loses_no_message():
    # An exception of the handler would become "Unable to convert call argument" there.
    with Process.script(Path(__file__).parent / 'interrupted_node.py') as node:
        assert node.wait() == 0, node.output
        first, *others = [int(number) for number in node.output.split()]
    # The one that was converted when the signal came is the third.
    assert others[:2] == [first + 1, first + 2]


def test_ctrl_c_while_kernels_load_ends_the_node_at_once():
    # What the handler raises within a call from C is printed as "Exception ignored", and lost.
    with Process.script(Path(__file__).parent / 'interrupted_start.py') as node:
        assert node.wait() == 0
        assert node.output == 'loading\n'
