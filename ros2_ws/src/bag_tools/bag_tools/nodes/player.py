# SPDX-License-Identifier: Apache-2.0
"""The player's node: publishers, services, /clock, waiting for subscribers."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import QosReliability
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from bag_tools.bag import BagError, BagReader, Topic
from bag_tools.nodes.lockstep import LockStep
from bag_tools.play import NANOSECONDS, Pace, Playlist, PlayOptions, clock_ticks
from node_core.executor import DirectExecutor
from node_core.message_types import message_class

# Graph changes are waited for; this only bounds how late a change without an event is seen.
_POLL = 0.05  # s
# Discovery brings a node's endpoints within milliseconds of each other: start only after this much quiet.
_SETTLED = 0.25  # s
# Without lock-step, published messages between two looks at the services.
_BURST = 50
_FLUSH_TIMEOUT = 10.0  # s


def profile(topic: Topic, depth: int, *, reliable: bool) -> QoSProfile:
    """Return the QoS for `topic`: durability and reliability as recorded, never shallower than `depth`."""
    best_effort = bool(topic.qos) and all(q.reliability == QosReliability.BEST_EFFORT for q in topic.qos)
    return QoSProfile(
        depth=max([depth, *(q.depth for q in topic.qos if 0 < q.depth < 100_000)]),
        reliability=(
            ReliabilityPolicy.BEST_EFFORT if best_effort and not reliable else ReliabilityPolicy.RELIABLE
        ),
        durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
    )


class Player(Node):
    """Publishes the messages of one bag as its options say."""

    def __init__(self, reader: BagReader, options: PlayOptions) -> None:
        super().__init__('player')
        self._options = options
        self._playlist = Playlist(reader, options)
        self._executor = DirectExecutor()
        self._executor.add_node(self)
        self._paused = options.paused
        self._steps = 0
        self._pace = Pace(options.rate)
        self._clock_time: int | None = None
        self.played = 0
        # Before the publishers: nodes that know these then know whom to tell of their progress.
        self._lockstep = LockStep(self, options.step_timeout) if options.lockstep else None
        try:
            self._publishers_by_topic = {
                name: self.create_publisher(
                    message_class(reader.topics[name].type),
                    target,
                    profile(reader.topics[name], options.depth, reliable=options.lockstep),
                )
                for name, target in self._playlist.topics.items()
            }
        except LookupError as error:
            raise BagError(f'{reader.path}: {error}; leave the topic out with --exclude') from error
        self._clock_publisher = (
            self.create_publisher(Clock, '/clock', 10) if options.clock is not None else None
        )
        self.create_service(Trigger, '~/pause', self._service(self._pause, 'paused'))
        self.create_service(Trigger, '~/resume', self._service(self._resume, 'playing'))
        self.create_service(Trigger, '~/step', self._service(self._step, 'one message'))

    def _service(self, act: Callable[[], None], text: str) -> Callable[[Any, Any], Any]:
        def respond(_request: Any, response: Any) -> Any:
            act()
            response.success, response.message = True, text
            return response

        return respond

    def _pause(self) -> None:
        self._paused = True

    def _resume(self) -> None:
        self._paused = False

    def _step(self) -> None:
        self._paused = True
        self._steps += 1

    def spin_for(self, seconds: float) -> None:
        """Serve services and acknowledgements until something happened or `seconds` are over."""
        if not self.context.ok():
            raise ExternalShutdownException
        self._executor.spin_once(timeout_sec=max(seconds, 0.0))

    def destroy_node(self) -> None:
        """Let go of what is waited for, then close."""
        self._executor.shutdown()
        super().destroy_node()

    def wait_for_subscribers(self) -> None:
        """Wait until what `wait_for` names, or else any subscriber, is matched and the graph is at rest."""
        deadline = time.monotonic() + self._options.wait_timeout
        calm_since, seen = time.monotonic(), None
        while True:
            if self._lockstep is not None:
                self._lockstep.look({p.topic_name for p in self._publishers_by_topic.values()})
            missing = self._missing()
            now = time.monotonic()
            state = self._graph_state()
            if state != seen:
                calm_since, seen = now, state
            if not missing and now - calm_since >= _SETTLED:
                return
            if now >= deadline:
                raise BagError(
                    f'no subscriber within {self._options.wait_timeout:g} s: {missing or "graph changes"}'
                )
            self.spin_for(_POLL)

    def start(self) -> None:
        """Wait for subscribers as the options say, and find who takes part in lock-step."""
        if self._options.wait or self._lockstep is not None:
            self.wait_for_subscribers()
        if self._lockstep is not None:
            self._lockstep.begin()

    def _graph_state(self) -> tuple[Any, ...]:
        publishers = self._publishers_by_topic.values()
        counts = tuple((p.get_subscription_count(), self.count_subscribers(p.topic_name)) for p in publishers)
        return (*counts, self._lockstep.followers() if self._lockstep else None)

    def _missing(self) -> str:
        """Return what has still to be matched, '' when nothing is missing."""
        by_name = {p.topic_name: p for p in self._publishers_by_topic.values()}
        for name, publisher in by_name.items():
            if publisher.get_subscription_count() < self.count_subscribers(name):
                return f"a subscriber of '{name}' is not matched yet (does its QoS fit?)"
        for wanted in self._options.wait_for:
            topic = by_name.get(wanted if wanted.startswith('/') else f'/{wanted}')
            if topic is not None:
                if not topic.get_subscription_count():
                    return f"nobody subscribes to '{wanted}'"
            elif self._lockstep is not None:
                if wanted not in self._lockstep.members():
                    return f"node '{wanted}' is not there or not in lock-step"
            elif wanted not in {f'{ns.rstrip("/")}/{n}' for n, ns in self.get_node_names_and_namespaces()}:
                return f"node '{wanted}' is not there"
        if not any(p.get_subscription_count() for p in by_name.values()):
            return 'nobody subscribes to ' + ', '.join(sorted(by_name))
        if self._lockstep is not None:
            if not self._lockstep.members():
                return 'no node runs in lock-step (-p lockstep:=true)'
            if waiting := self._lockstep.unmatched():
                return waiting
        return ''

    def play(self, progress: Callable[[float], None]) -> None:
        """Play to the end (for ever with `loop`); `progress` gets the share of the bag that is played."""
        span = max(self._playlist.end - self._playlist.begin, 1)
        while True:
            self._clock_time = None
            self._pace.restart(time.monotonic(), self._playlist.begin)
            for topic, _, data in self._playlist.latched():
                self._publish(topic, data)
            for topic, stamp, data in self._playlist:
                self._await_turn(stamp)
                self._publish(topic, data)
                progress((stamp - self._playlist.begin) / span)
            if not self._options.loop:
                break
        if self._lockstep is None:
            self._flush()

    def _await_turn(self, stamp: int) -> None:
        self._hold_while_paused(stamp)
        if self._clock_publisher is not None:
            for tick in clock_ticks(self._clock_time, stamp, self._options.clock or 0.0):
                self._sleep_until(tick)
                self._tick(self._clock_publisher, tick)
        self._sleep_until(stamp)

    def _hold_while_paused(self, stamp: int) -> None:
        if self._paused:
            while self._paused and not self._steps:
                self.spin_for(_POLL)
            self._steps = max(self._steps - 1, 0)
            self._pace.restart(time.monotonic(), stamp)

    def _sleep_until(self, stamp: int) -> None:
        due = self._pace.due(stamp)
        while (left := due - time.monotonic()) > 0.0:
            self.spin_for(min(left, _POLL))
            if self._paused:
                self._hold_while_paused(stamp)
                return

    def _tick(self, publisher: Publisher, stamp: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(stamp, NANOSECONDS)
        self._clock_time = stamp
        publisher.publish(message)

    def _publish(self, topic: str, data: bytes) -> None:
        publisher = self._publishers_by_topic[topic]
        publisher.publish(bytes(data))
        self.played += 1
        if self._lockstep is not None:
            self._lockstep.published(publisher.topic_name)
            self._lockstep.wait(self.spin_for)
        elif not self.played % _BURST:
            self.spin_for(0.0)

    def _flush(self) -> None:
        """Wait, ten seconds at most, until every matched reader has received what was published.

        Once at the end only: Fast DDS asks for acknowledgements every three seconds, so this is no means to
        hold the player back.
        """
        deadline = time.monotonic() + _FLUSH_TIMEOUT
        for publisher in self._publishers_by_topic.values():
            if publisher.get_subscription_count():
                publisher.wait_for_all_acked(Duration(seconds=max(deadline - time.monotonic(), 0.0)))
