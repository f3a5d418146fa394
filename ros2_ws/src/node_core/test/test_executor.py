# SPDX-License-Identifier: Apache-2.0
"""The executor does for a node what rclpy's own does."""

import contextlib
import threading

import pytest
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from node_core.executor import DirectExecutor
from node_core.node import reliable
from node_core.testing import TIMEOUT


class Done(Exception):
    """Ends a spin from a callback."""


@pytest.fixture
def node():
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('spun', context=context)
    node.create_timer(TIMEOUT, lambda: pytest.fail('gave up waiting'))
    yield node
    node.destroy_node()
    context.try_shutdown()


def spin(node):
    executor = DirectExecutor(context=node.context)
    executor.add_node(node)
    try:
        with pytest.raises(Done):
            executor.spin()
    finally:
        executor.shutdown()


def looped(node, callback):
    """Subscribe to what the node itself publishes; return the publisher."""
    publisher = node.create_publisher(Int64, 'count', reliable(10))
    node.create_subscription(Int64, 'count', callback, reliable(10))
    return publisher


def once(node, action):
    """Run `action` in the node's spin."""
    timer = node.create_timer(0.01, lambda: (timer.cancel(), action()))


def test_messages_come_once_each_and_in_order(node):
    received = []

    def next_number(message):
        received.append(message.data)
        if len(received) == 500:
            raise Done
        publisher.publish(Int64(data=message.data + 1))

    publisher = looped(node, next_number)
    once(node, lambda: publisher.publish(Int64(data=0)))
    spin(node)
    assert received == list(range(500))


def test_a_timer_goes_on_while_messages_never_stop(node):
    publisher = looped(node, lambda message: publisher.publish(message))
    once(node, lambda: publisher.publish(Int64()))
    ticks = []

    def tick():
        ticks.append(1)
        if len(ticks) == 5:
            raise Done

    node.create_timer(0.02, tick)
    spin(node)


def test_a_cancelled_timer_is_silent(node):
    def both():
        first.cancel()
        second.cancel()
        ran.append(1)

    ran = []
    # Both are due in the same turn; the first to run stops the other.
    first = node.create_timer(0.01, both)
    second = node.create_timer(0.01, both)

    def end():
        raise Done

    node.create_timer(0.2, end)
    spin(node)
    assert ran == [1]


def test_a_callback_may_destroy_and_make_what_is_waited_for(node):
    def replace(_message):
        node.destroy_subscription(subscription)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(Int64, 'after', end, latched)
        node.create_publisher(Int64, 'after', latched).publish(Int64(data=7))

    def end(message):
        assert message.data == 7
        raise Done

    subscription = node.create_subscription(Int64, 'before', replace, reliable(10))
    publisher = node.create_publisher(Int64, 'before', reliable(10))
    once(node, lambda: publisher.publish(Int64()))
    spin(node)


def test_services_clients_and_tasks_are_served(node):
    def serve(_request, response):
        response.message = 'served'
        return response

    def end(future):
        assert future.result().message == 'served'
        raise Done

    node.create_service(Trigger, 'serve', serve)
    client = node.create_client(Trigger, 'serve')

    def call():
        if client.service_is_ready():
            ready.cancel()
            client.call_async(Trigger.Request()).add_done_callback(end)

    ready = node.create_timer(0.01, call)
    spin(node)


def test_a_coroutine_callback_is_awaited(node):
    async def end(message):
        assert message.data == 3
        raise Done

    publisher = looped(node, end)
    once(node, lambda: publisher.publish(Int64(data=3)))
    spin(node)


def test_a_shutdown_from_elsewhere_ends_the_spin(node):
    executor = DirectExecutor(context=node.context)
    executor.add_node(node)
    once(node, lambda: threading.Thread(target=node.context.try_shutdown).start())
    # rclpy's own says so only when it happens within a wait.
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()
    assert not node.context.ok()
