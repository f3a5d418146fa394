# SPDX-License-Identifier: Apache-2.0
"""Lock-step replay: a node says when it has processed a message, since DDS acknowledges only receipt.

Each node with the parameter ``lockstep`` publishes, after all outputs of a message, one line on TOPIC::

    <fully qualified node name> <fully qualified topic> <count>

`count` is the number of messages of this topic that the node has processed since it started.
"""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

TOPIC = '/lockstep/progress'
# Deep enough for every node of a graph to acknowledge several topics before the player reads.
QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


class Acknowledger:
    """Publishes the progress of one node."""

    def __init__(self, node: Node) -> None:
        self._name = node.get_fully_qualified_name()
        self._publisher = node.create_publisher(String, TOPIC, QOS)
        self._counts: dict[str, int] = {}
        self._line = String()

    def processed(self, topic: str) -> None:
        """Say that one more message of the fully qualified `topic` has been processed."""
        count = self._counts.get(topic, 0) + 1
        self._counts[topic] = count
        self._line.data = f'{self._name} {topic} {count}'
        self._publisher.publish(self._line)


def parse(line: str) -> tuple[str, str, int]:
    """Return (node, topic, count) of one progress line; raise ValueError when it is not one."""
    name, topic, count = line.split(' ')
    return name, topic, int(count)
