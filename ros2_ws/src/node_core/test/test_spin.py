# SPDX-License-Identifier: Apache-2.0
"""Command lines as users type them."""

import pytest

from node_core.spin import ros_arguments


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
