# SPDX-License-Identifier: Apache-2.0
"""A node that gets Ctrl-C at the worst place: while rclpy converts the third message it takes."""

import signal
import sys
from itertools import count

from node_core.spin import run


def build():
    """Make a node that hears itself."""
    from rclpy.node import Node
    from std_msgs.msg import String

    node = Node('interrupted')
    said = String()
    numbers = count()
    publisher = node.create_publisher(String, 'word', 10)
    node.create_subscription(String, 'word', lambda message: print(message.data, flush=True), 10)

    def say():
        said.data = str(next(numbers))
        publisher.publish(said)

    node.create_timer(0.01, say)
    made, convert = [], String.__init__

    def interrupted(self, *args, **fields):
        made.append(self)
        if len(made) == 3:
            signal.raise_signal(signal.SIGINT)
        convert(self, *args, **fields)

    String.__init__ = interrupted
    return node


if __name__ == '__main__':
    sys.exit(run(build))
