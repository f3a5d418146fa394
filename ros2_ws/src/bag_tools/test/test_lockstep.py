# SPDX-License-Identifier: Apache-2.0
"""The player knows when the links between other nodes stand, which it cannot see itself."""

import time
from contextlib import ExitStack

import pytest
import rclpy
from std_msgs.msg import Int64, String

from bag_tools.nodes.lockstep import LockStep
from node_core.executor import DirectExecutor
from node_core.lockstep import LINKS, LINKS_QOS, TOPIC, Acknowledger, parse_links
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


def test_nodes_are_waited_for_until_they_are_complete_and_linked_both_ways(graph):
    (player, spin_player), (writer, spin_writer), (reader, spin_reader) = map(
        graph, ('player', 'writer', 'reader')
    )
    for node in (writer, reader):
        Acknowledger(node)
    writer.create_publisher(Int64, 'between', reliable(10))
    lockstep = LockStep(player, 1.0)

    def waiting():
        spin_player.spin_once(timeout_sec=0.01)
        lockstep.look(set())
        return lockstep.unmatched()

    def until(condition):
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, lockstep.unmatched()

    # Who loads kernels takes part already, and subscribes seconds later: it is spun only then.
    until(lambda: waiting() == "'/reader' is not complete")
    reader.create_subscription(Int64, 'between', lambda _: None, reliable(10))
    until(lambda: spin_reader.spin_once(timeout_sec=0.01) or waiting() == "'/writer' is not complete")

    def linked():
        spin_writer.spin_once(timeout_sec=0.01)
        spin_reader.spin_once(timeout_sec=0.01)
        return not waiting()

    until(linked)
    assert lockstep.followers()['/between'] == ('/reader',)
    says = writer.create_publisher(String, LINKS, LINKS_QOS)
    until(lambda: spin_player.spin_once(timeout_sec=0.01) or says.get_subscription_count())
    says.publish(String(data='/writer /between=0'))
    until(lambda: waiting() == "'/between' of '/writer' has 0 of 2 readers")
    says.publish(String(data='/writer /between=2'))
    says.publish(String(data='/reader </between=0'))
    until(lambda: waiting() == "'/reader' does not hear '/between' yet")


def test_a_node_that_is_not_known_by_its_name_is_waited_for(graph, monkeypatch):
    (player, spin_player), (reader, spin_reader) = map(graph, ('player', 'reader'))
    Acknowledger(reader)
    player.create_publisher(Int64, 'played', reliable(10))
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


def test_the_fewest_links_of_a_topic_that_stands_twice_count():
    line = '/node /a=2 /b=1 /a=0 </c=3 </a=1'
    assert parse_links(line) == ('/node', {'/a': 0, '/b': 1}, {'/c': 3, '/a': 1})
