# SPDX-License-Identifier: Apache-2.0
"""The player knows when the links between other nodes stand, which it cannot see itself."""

import time
from contextlib import ExitStack

import pytest
import rclpy
from std_msgs.msg import Int64

from bag_tools.nodes.lockstep import LockStep
from node_core.executor import DirectExecutor
from node_core.lockstep import TOPIC, Acknowledger, parse_links
from node_core.node import reliable
from node_core.testing import TIMEOUT


@pytest.fixture
def graph():
    """Yield a function that makes a node with an executor of its own."""
    context = rclpy.Context()
    rclpy.init(context=context)
    with ExitStack() as stack:

        def make(name):
            node = rclpy.create_node(name, context=context)
            executor = DirectExecutor(context=context)
            executor.add_node(node)
            stack.callback(node.destroy_node)
            stack.callback(executor.shutdown)
            return node, executor

        yield make
    context.try_shutdown()


def test_a_topic_between_nodes_waits_until_its_publisher_has_matched_every_reader(graph):
    (player, spin_player), (writer, spin_writer), (reader, _) = map(graph, ('player', 'writer', 'reader'))
    for node in (writer, reader):
        Acknowledger(node)
    writer.create_publisher(Int64, 'between', reliable(10))
    reader.create_subscription(Int64, 'between', lambda _: None, reliable(10))
    lockstep = LockStep(player, 1.0)

    def waiting():
        spin_player.spin_once(timeout_sec=0.01)
        lockstep.look(set())
        return lockstep.unmatched()

    def until(condition):
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, lockstep.unmatched()

    # The writer is not spun: its readers may be matched, but it has not said so.
    until(lambda: waiting() == "'/between' of '/writer' has 0 of 2 readers")
    until(lambda: spin_writer.spin_once(timeout_sec=0.01) or not waiting())
    assert lockstep.followers()['/between'] == ('/reader',)


def test_a_node_that_is_not_known_by_its_name_is_waited_for(graph, monkeypatch):
    (player, spin_player), (reader, spin_reader) = map(graph, ('player', 'reader'))
    Acknowledger(reader)
    reader.create_subscription(Int64, 'played', lambda _: None, reliable(10))
    lockstep = LockStep(player, 1.0)
    known = player.get_publishers_info_by_topic

    def nameless(topic):
        infos = known(topic)
        for info in infos:
            info.node_namespace, info.node_name = '_NODE_NAMESPACE_UNKNOWN_', '_NODE_NAME_UNKNOWN_'
        return infos

    def said(expected):
        end = time.monotonic() + TIMEOUT
        while True:
            spin_player.spin_once(timeout_sec=0.01)
            spin_reader.spin_once(timeout_sec=0.01)
            lockstep.look({'/played'})
            if lockstep.unmatched() == expected and known(TOPIC):
                return lockstep.members()
            assert time.monotonic() < end, lockstep.unmatched()

    monkeypatch.setattr(player, 'get_publishers_info_by_topic', nameless)
    assert said('a node is not known by its name yet') == frozenset()
    monkeypatch.undo()
    assert said('') == {'/reader'}


def test_the_fewest_readers_of_a_topic_published_twice_count():
    assert parse_links('/node /a=2 /b=1 /a=0') == ('/node', {'/a': 0, '/b': 1})
