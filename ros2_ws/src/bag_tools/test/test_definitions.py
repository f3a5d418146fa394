# SPDX-License-Identifier: Apache-2.0
"""Types that rosbags does not know come from the installed packages."""

import os
import sys

import pytest

from bag_tools.bag import BagError, BagReader, BagWriter, jazzy, zeroed
from bag_tools.nodes.definitions import installed_store

GOALS = 'nav_msgs/msg/Goals'  # younger than the list in rosbags


@pytest.fixture(autouse=True)
def prefix(monkeypatch):
    """Find the wheels' packages where no setup file was sourced."""
    if 'AMENT_PREFIX_PATH' not in os.environ:
        monkeypatch.setenv('AMENT_PREFIX_PATH', sys.prefix)


def test_an_unknown_type_is_read_from_its_package_and_travels_in_the_bag(tmp_path):
    assert GOALS not in jazzy().fielddefs
    store = installed_store(GOALS)
    message, goal = zeroed(GOALS, store), zeroed('geometry_msgs/msg/PoseStamped', store)
    goal.pose.position.x = 4.5
    message.goals.append(goal)
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('goals', GOALS, store=store)
        bag.write('/goals', 5, message)
    with BagReader(tmp_path / 'bag') as reader:
        ((topic, _, data),) = reader.messages()
        assert reader.decode(data, reader.topics[topic].type).goals[0].pose.position.x == 4.5


def test_a_type_that_is_nowhere_is_named():
    with pytest.raises(BagError, match="'odd_msgs/msg/Odd' is not installed"):
        installed_store('odd_msgs/msg/Odd')
