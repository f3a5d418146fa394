# SPDX-License-Identifier: Apache-2.0
"""A bare rclpy node in place of a real one: the same topics at the same rates, and nothing computed.

``python relay_node.py NAME SPEC``; SPEC is JSON: ``inputs`` {topic: type}, ``trigger`` the input that causes
the outputs, ``outputs`` {topic: [type, every so many triggers]}.
"""

import json
import sys
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from node_core.message_types import message_class
from node_core.node import reliable


def main():
    """Relay until told to stop."""
    name, spec = sys.argv[1], json.loads(sys.argv[2])
    rclpy.init()
    node = Node(name)
    outputs = []
    for topic, (type_name, every) in spec['outputs'].items():
        message = message_class(type_name)()
        outputs.append((every, message, node.create_publisher(type(message), topic, reliable(200)).publish))
    count = 0

    def trigger(received):
        nonlocal count
        for every, message, publish in outputs:
            if count % every == 0:
                if hasattr(message, 'header'):
                    message.header.stamp = received.header.stamp
                publish(message)
        count += 1

    for topic, type_name in spec['inputs'].items():
        callback = trigger if topic == spec['trigger'] else (lambda _message: None)
        node.create_subscription(message_class(type_name), topic, callback, reliable(200))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == '__main__':
    main()
