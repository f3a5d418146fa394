# SPDX-License-Identifier: Apache-2.0
"""The recorder's node.

In lock-step (`--lockstep`) the recorder is a node like any other: it acknowledges each message after it has
written it, and the player waits for that before it publishes the next one, so no queue can overflow and no
output is lost. It joins (publishes on the progress topic) only once every named topic has its publisher
matched; ``play --wait-for /recorder`` waits for exactly that.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.typesys.store import Typestore

from bag_tools.bag import BagError, BagWriter, jazzy, reliable_qos
from bag_tools.nodes.definitions import installed_store
from bag_tools.record import RecordOptions, StopRule, has_header, header_stamp
from node_core.executor import DirectExecutor
from node_core.lockstep import LINKS, TOPIC, Acknowledger
from node_core.message_types import message_class

# Deep enough for ten seconds of a 1 kHz topic while the disk stalls.
_DEPTH = 10_000
_POLL = 0.1  # s
_GRAPH_PERIOD = 0.5  # s, how often --all looks for new topics


class Recorder(Node):
    """Writes the serialised messages of its topics to a bag."""

    def __init__(self, options: RecordOptions, writer: BagWriter) -> None:
        super().__init__('recorder')
        self._options = options
        self._writer = writer
        self._wanted = [self.resolve_topic_name(t) for t in options.topics]
        self._subscriptions_by_topic: dict[str, Any] = {}
        self._receivers: dict[str, Callable[[bytes], None]] = {}
        self._acknowledger: Acknowledger | None = None
        self._skipped: set[str] = set()
        self.rule = StopRule(options, time.monotonic())

    def look(self) -> list[str]:
        """Subscribe to what is there by now; return the named topics that are still missing."""
        types = dict(self.get_topic_names_and_types())
        names = self._wanted or sorted(set(types) - {TOPIC, LINKS})
        for topic in names:
            # A publisher may be known before the type list that was read holds its topic.
            known = topic in types and self.count_publishers(topic) > 0
            if known and topic not in self._subscriptions_by_topic:
                self._subscribe(topic, types[topic][0])
        return [t for t in self._wanted if not self._matched(t)]

    def _matched(self, topic: str) -> bool:
        subscription = self._subscriptions_by_topic.get(topic)
        return subscription is not None and subscription.get_publisher_count() > 0

    def join(self) -> None:
        """Take part in lock-step from now on."""
        if self._options.lockstep:
            self._acknowledger = Acknowledger(self)

    def _subscribe(self, topic: str, type_name: str) -> None:
        try:
            cls = message_class(type_name)
            store = self._store_of(type_name)
        except (LookupError, BagError) as error:
            if self._wanted:
                raise BagError(f"topic '{topic}' cannot be recorded: {error}") from error
            if topic not in self._skipped:
                self._skipped.add(topic)
                self.get_logger().warning(f"topic '{topic}' is left out: {error}")
            return
        offered = [i.qos_profile for i in self.get_publishers_info_by_topic(topic)]
        best_effort = any(q.reliability == ReliabilityPolicy.BEST_EFFORT for q in offered)
        latched = bool(offered) and all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offered)
        qos = QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._writer.add(topic, type_name, qos=(reliable_qos(latched=latched),), store=store)
        self._receivers[topic] = self._receiver(topic, has_header(type_name, store))
        self._subscriptions_by_topic[topic] = self.create_subscription(
            cls, topic, self._receivers[topic], qos, raw=True
        )

    @staticmethod
    def _store_of(type_name: str) -> Typestore:
        return jazzy() if type_name in jazzy().fielddefs else installed_store(type_name)

    def _receiver(self, topic: str, headed: bool) -> Callable[[bytes], None]:
        from_header = headed and self._options.stamp == 'header'

        def receive(data: bytes) -> None:
            received = self.get_clock().now().nanoseconds
            self._writer.write_raw(topic, header_stamp(data, received) if from_header else received, data)
            self.rule.received(time.monotonic())
            if self._acknowledger is not None:
                self._acknowledger.processed(topic)

        return receive

    def drain(self) -> None:
        """Write what has been received but not taken yet."""
        for topic, subscription in self._subscriptions_by_topic.items():
            receive = self._receivers[topic]
            handle = subscription.handle
            with handle:
                while (taken := handle.take_message(subscription.msg_type, True)) is not None:
                    receive(taken[0])


def _wait_for_topics(node: Recorder, executor: DirectExecutor, options: RecordOptions, stop: list) -> None:
    deadline = time.monotonic() + options.wait_timeout
    while (missing := node.look()) and not stop:
        if time.monotonic() > deadline:
            raise BagError(f"nobody publishes '{missing[0]}' within {options.wait_timeout:g} s")
        executor.spin_once(timeout_sec=_POLL)


def record(node: Recorder, options: RecordOptions, stop: list) -> None:
    """Record until `stop` is filled (by a signal) or the options' rule says so."""
    executor = DirectExecutor()
    executor.add_node(node)
    try:
        _record(node, executor, options, stop)
    finally:
        executor.shutdown()


def _record(node: Recorder, executor: DirectExecutor, options: RecordOptions, stop: list) -> None:
    _wait_for_topics(node, executor, options, stop)
    node.join()
    node.rule.begin(time.monotonic())
    node.get_logger().info('recording' if not options.topics else f'recording {" ".join(options.topics)}')
    looked = time.monotonic()
    while not stop and not node.rule.done(time.monotonic()):
        executor.spin_once(timeout_sec=_POLL)
        if not options.topics and time.monotonic() - looked > _GRAPH_PERIOD:
            node.look()
            looked = time.monotonic()
    node.drain()
