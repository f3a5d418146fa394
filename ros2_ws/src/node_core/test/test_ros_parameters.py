# SPDX-License-Identifier: Apache-2.0
"""Parameters that are set together change together."""

from dataclasses import dataclass

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from kalman_core.parameters import parameter
from node_core.ros_parameters import NodeParameters


@dataclass(frozen=True)
class Gains:
    """Two floats and a switch."""

    first: float = parameter(0.0, 'first', minimum=0.0, maximum=9.0, live=True)
    second: float = parameter(0.0, 'second', live=True)
    switch: bool = parameter(False, 'switch', live=True)


@pytest.fixture
def node():
    rclpy.init()
    node = Node('gains', automatically_declare_parameters_from_overrides=True)
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_whole_numbers_among_parameters_set_together_lose_none_of_the_others(node):
    parameters, told = NodeParameters(node, Gains), []
    parameters.on_change(lambda: told.append(parameters[Gains]))
    changes = [Parameter('first', value=1), Parameter('second', value=0.5), Parameter('switch', value=True)]
    assert node.set_parameters_atomically(changes).successful
    assert told == [Gains(1.0, 0.5, True)]
    stored = [node.get_parameter(name).value for name in ('first', 'second', 'switch')]
    assert stored == [1.0, 0.5, True]
    assert type(stored[0]) is float


def test_one_bad_value_among_several_changes_nothing(node):
    parameters, told = NodeParameters(node, Gains), []
    parameters.on_change(lambda: told.append(parameters[Gains]))
    changes = [Parameter('second', value=2), Parameter('first', value=10)]
    assert not node.set_parameters_atomically(changes).successful
    assert (parameters[Gains], told) == (Gains(), [])
