# SPDX-License-Identifier: Apache-2.0
"""A short-lived node, and `ros2 node` and `ros2 service`."""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
import yaml
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from ros2_standin.text import message_class, set_fields

# Discovery is done when nothing new has been heard for this long (s) since the first foreign node: there is
# no daemon that would know the graph already. An empty graph is believed after the limit.
_QUIET = 1.5
_LIMIT = 5.0


@contextmanager
def temporary_node() -> Iterator[Node]:
    """Yield a hidden node that has discovered the graph; ExternalShutdownException after Ctrl-C."""
    rclpy.init()
    node = Node(f'_ros2cli_{os.getpid()}', start_parameter_services=False, enable_rosout=False)
    try:
        _discover(node)
        yield node
    except RuntimeError as error:
        # rclpy may be about to wait, or to look at the graph, when Ctrl-C ends its context.
        if rclpy.ok():
            raise
        raise ExternalShutdownException from error
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _discover(node: Node) -> None:
    start = changed = time.monotonic()
    seen: tuple = ()
    alone = len(node.get_node_names())
    while time.monotonic() - start < _LIMIT:
        rclpy.spin_once(node, timeout_sec=0.05)
        now = (tuple(node.get_node_names_and_namespaces()), tuple(map(str, node.get_topic_names_and_types())))
        if now != seen:
            seen, changed = now, time.monotonic()
        if len(now[0]) > alone and time.monotonic() - changed > _QUIET:
            return


def node_names(node: Node) -> list[str]:
    """Return the fully qualified names of all visible nodes."""
    names = [f'{space.rstrip("/")}/{name}' for name, space in node.get_node_names_and_namespaces()]
    return sorted(name for name in names if not hidden(name))


def split_name(name: str) -> tuple[str, str]:
    """Return (name, namespace) of a fully qualified node name."""
    space, _, base = ('/' + name.lstrip('/')).rpartition('/')
    return base, space or '/'


def node_list(node: Node, _arguments) -> int:
    """Print the running nodes."""
    for name in node_names(node):
        print(name)
    return 0


def node_info(node: Node, arguments) -> int:
    """Print the topics and services of one node."""
    name = '/' + arguments.node.lstrip('/')
    if name not in node_names(node):
        print(f"Unable to find node '{name}'", file=sys.stderr)
        return 1
    print(name)
    base, space = split_name(name)
    sections = (
        ('Subscribers', node.get_subscriber_names_and_types_by_node),
        ('Publishers', node.get_publisher_names_and_types_by_node),
        ('Service Servers', node.get_service_names_and_types_by_node),
    )
    for title, query in sections:
        print(f'  {title}:')
        for topic, types in sorted(query(base, space)):
            print(f'    {topic}: {", ".join(types)}')
    return 0


def hidden(name: str) -> bool:
    """Return whether a topic, service or node is kept out of listings: a part of its name begins with _."""
    return any(part.startswith('_') for part in name.split('/'))


def service_list(node: Node, arguments) -> int:
    """Print the services, the stand-in's own and other hidden ones left out."""
    for name, types in sorted(node.get_service_names_and_types()):
        if hidden(name):
            continue
        print(f'{name} [{", ".join(types)}]' if arguments.show_types else name)
    return 0


def call(node: Node, cls, name: str, request, timeout: float = 5.0):
    """Return the response of a service, or None when it does not answer."""
    client = node.create_client(cls, name)
    if not client.wait_for_service(timeout_sec=timeout):
        return None
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=timeout)
    return future.result()


def _wait_for(node: Node, name: str) -> None:
    """Wait until somebody offers the service, as `ros2 service call` does."""
    told = False
    while rclpy.ok() and name not in dict(node.get_service_names_and_types()):
        if not told:
            print('waiting for service to become available...', flush=True)
            told = True
        rclpy.spin_once(node, timeout_sec=0.1)


def service_call(node: Node, arguments) -> int:
    """Call a service and print its response."""
    cls = message_class(arguments.type)
    request = cls.Request()
    set_fields(request, yaml.safe_load(arguments.values) or {})
    _wait_for(node, node.resolve_service_name(arguments.service))
    print(f'requester: making request: {request!r}\n')
    response = call(node, cls, arguments.service, request)
    if response is None:
        print(f"service '{arguments.service}' does not answer", file=sys.stderr)
        return 1
    print(f'response:\n{response!r}')
    return 0
