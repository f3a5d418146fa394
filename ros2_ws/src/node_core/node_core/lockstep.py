# SPDX-License-Identifier: Apache-2.0
"""Lock-step replay: a node says when it has processed a message, since DDS acknowledges only receipt.

Each node with the parameter ``lockstep`` publishes, after all outputs of a message, one line on TOPIC::

    <fully qualified node name> <fully qualified topic> <count>

`count` is the number of messages of this topic that the node has processed since it started.

What a node publishes before DDS has matched it with a reader is lost to that reader, and only the node itself
can tell: on LINKS it says, whenever that changes, how many readers each of its topics is matched with, and
how many writers each topic (after a "<") that it hears::

    <fully qualified node name> <fully qualified topic>=<matched readers> … <<topic>=<matched writers> …

Its first line says that it is complete: a node answers for nothing before it spins.
"""

from __future__ import annotations

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

TOPIC = '/lockstep/progress'
# Deep enough for every node of a graph to acknowledge several topics before the player reads.
QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

LINKS = '/lockstep/links'
# The latest line of every node is for whoever comes later, too.
LINKS_QOS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_LINKS_PERIOD = 0.1  # s
_HEARD = '<'  # no topic name holds it


class Acknowledger:
    """Publishes the progress and the links of one node."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name()
        self._links = node.create_publisher(String, LINKS, LINKS_QOS)
        self._linked = ''
        # Simulated time may stand still before the first message.
        node.create_timer(_LINKS_PERIOD, self._tell_links, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._publisher = node.create_publisher(String, TOPIC, QOS)
        self._counts: dict[str, int] = {}
        self._line = String()

    def processed(self, topic: str) -> None:
        """Say that one more message of the fully qualified `topic` has been processed."""
        count = self._counts.get(topic, 0) + 1
        self._counts[topic] = count
        self._line.data = f'{self._name} {topic} {count}'
        self._publisher.publish(self._line)

    def _tell_links(self) -> None:
        told = [f'{p.topic_name}={p.get_subscription_count()}' for p in self._node.publishers]
        heard = [f'{_HEARD}{s.topic_name}={s.get_publisher_count()}' for s in self._node.subscriptions]
        line = ' '.join([self._name, *told, *heard])
        if line != self._linked:
            self._linked = line
            self._links.publish(String(data=line))


def parse(line: str) -> tuple[str, str, int]:
    """Return (node, topic, count) of one progress line; raise ValueError when it is not one."""
    name, topic, count = line.split(' ')
    return name, topic, int(count)


def parse_links(line: str) -> tuple[str, dict[str, int], dict[str, int]]:
    """Return (node, {topic: matched readers}, {topic heard: matched writers}) of one line of LINKS.

    Of a topic that stands twice, the fewest.
    """
    name, *pairs = line.split(' ')
    told: dict[str, int] = {}
    heard: dict[str, int] = {}
    for pair in pairs:
        topic, count = pair.rsplit('=', 1)
        links = heard if topic.startswith(_HEARD) else told
        topic = topic.removeprefix(_HEARD)
        links[topic] = min(int(count), links.get(topic, int(count)))
    return name, told, heard
