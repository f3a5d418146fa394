# SPDX-License-Identifier: Apache-2.0
"""`ros2 topic`."""

import itertools
import statistics
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ros2_standin.graph import hidden
from ros2_standin.text import message_class, to_yaml


def topic_list(node: Node, arguments) -> int:
    """Print the topics."""
    for name, types in sorted(node.get_topic_names_and_types()):
        if hidden(name):
            continue
        print(f'{name} [{", ".join(types)}]' if arguments.show_types else name)
    return 0


def topic_info(node: Node, arguments) -> int:
    """Print type and number of publishers and subscribers."""
    topic = node.resolve_topic_name(arguments.topic)
    types = dict(node.get_topic_names_and_types()).get(topic)
    if types is None:
        print(f"Unknown topic '{topic}'", file=sys.stderr)
        return 1
    print(f'Type: {", ".join(types)}')
    print(f'Publisher count: {node.count_publishers(topic)}')
    print(f'Subscription count: {node.count_subscribers(topic)}')
    return 0


def _type_of(node: Node, topic: str) -> str | None:
    while rclpy.ok():
        types = dict(node.get_topic_names_and_types()).get(topic)
        if types:
            return types[0]
        rclpy.spin_once(node, timeout_sec=0.1)
    return None


def _profile(node: Node, topic: str) -> QoSProfile:
    """Match what is offered, as `ros2 topic echo` does."""
    offers = [info.qos_profile for info in node.get_publishers_info_by_topic(topic)]
    reliable = bool(offers) and all(o.reliability == ReliabilityPolicy.RELIABLE for o in offers)
    latched = bool(offers) and all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
    return QoSProfile(
        depth=1000,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def topic_echo(node: Node, arguments) -> int:
    """Print messages as YAML documents."""
    topic = node.resolve_topic_name(arguments.topic)
    name = arguments.type or _type_of(node, topic)
    if name is None:
        return 0
    printed = []

    def show(message) -> None:
        value = message
        for part in (arguments.field or '').split('.'):
            value = getattr(value, part) if part else value
        print(f'{to_yaml(value)}---', flush=True)
        printed.append(1)

    node.create_subscription(message_class(name), topic, show, _profile(node, topic))
    while rclpy.ok() and not (arguments.once and printed):
        rclpy.spin_once(node, timeout_sec=0.1)
    return 0


def topic_hz(node: Node, arguments) -> int:
    """Print the rate once a second."""
    topic = node.resolve_topic_name(arguments.topic)
    name = _type_of(node, topic)
    if name is None:
        return 0
    arrivals: list[float] = []
    node.create_subscription(
        message_class(name),
        topic,
        lambda _: arrivals.append(time.monotonic()),
        _profile(node, topic),
        raw=True,
    )
    printed = time.monotonic()
    while rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0.1)
        now = time.monotonic()
        if now - printed < 1.0:
            continue
        printed = now
        del arrivals[: -arguments.window]
        gaps = [b - a for a, b in itertools.pairwise(arrivals)]
        if not gaps:
            print('no new messages', flush=True)
            continue
        mean = statistics.fmean(gaps)
        print(f'average rate: {1.0 / mean:.3f}')
        print(
            f'\tmin: {min(gaps):.3f}s max: {max(gaps):.3f}s std dev: {statistics.pstdev(gaps):.5f}s '
            f'window: {len(arrivals)}',
            flush=True,
        )
    return 0
