# SPDX-License-Identifier: Apache-2.0
"""The player's side of lock-step: one message in flight through the whole graph.

For every topic that lock-step nodes subscribe to, the player counts what is published, be it by itself or
by another lock-step node, and goes on when each subscriber has acknowledged as many. A chain of nodes and
a recorder are thereby waited for as well as the first estimator. Topics between nodes are counted by a
subscription of the player's own: a node acknowledges after it has published, on one participant whose
packets arrive in order, so with one message in flight the outputs are here before the acknowledgement.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from std_msgs.msg import String

from bag_tools.bag import BagError
from node_core import lockstep
from node_core.message_types import message_class

_DEPTH = 1000
# What rmw calls the node of an endpoint until it has learned its name.
_NAMELESS = '_NODE_NAME_UNKNOWN_'


def _full_name(info: Any) -> str:
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


class LockStep:
    """Counts messages and acknowledgements by (node, topic)."""

    def __init__(self, node: Node, timeout: float) -> None:
        self._node = node
        self._timeout = timeout
        self._name = node.get_fully_qualified_name()
        self._followers: dict[str, tuple[str, ...]] = {}
        self._expected: dict[tuple[str, str], int] = {}
        self._acknowledged: dict[tuple[str, str], int] = {}
        self._between: dict[str, Any] = {}
        self._links: dict[str, dict[str, int]] = {}
        self._heard: dict[str, dict[str, int]] = {}
        self._members: frozenset[str] = frozenset()
        node.create_subscription(String, lockstep.LINKS, self._on_links, lockstep.LINKS_QOS)
        self._progress = node.create_subscription(String, lockstep.TOPIC, self._on_progress, lockstep.QOS)

    def members(self) -> frozenset[str]:
        """Return the full names of the nodes that take part."""
        infos = self._node.get_publishers_info_by_topic(lockstep.TOPIC)
        return frozenset(_full_name(i) for i in infos if i.node_name != _NAMELESS) - {self._name}

    def look(self, own_topics: set[str]) -> None:
        """Find who follows what by now; `own_topics` are the player's. Call again when the graph changes."""
        members = self.members()
        # A line may come before its node is known by name: only what is gone is forgotten.
        for name in self._members - members:
            self._links.pop(name, None)
            self._heard.pop(name, None)
        self._members = members
        for topic in sorted(own_topics):
            self._follow(topic)
        for topic, types in self._node.get_topic_names_and_types():
            writers = {_full_name(i) for i in self._node.get_publishers_info_by_topic(topic)}
            if topic not in own_topics and topic != lockstep.TOPIC and writers & self._members:
                self._follow(topic)
                if self._followers[topic] and topic not in self._between:
                    self._count_between(topic, types[0])

    def _follow(self, topic: str) -> None:
        readers = {_full_name(i) for i in self._node.get_subscriptions_info_by_topic(topic)}
        self._followers[topic] = tuple(sorted(readers & self._members))

    def _count_between(self, topic: str, type_name: str) -> None:
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)

        def count(_data: bytes) -> None:
            self.published(topic)

        try:
            cls = message_class(type_name)
        except LookupError as error:
            raise BagError(f"lock-step: topic '{topic}' between nodes cannot be followed: {error}") from error
        self._between[topic] = self._node.create_subscription(cls, topic, count, qos, raw=True)

    def followers(self) -> dict[str, tuple[str, ...]]:
        """Return the full names of the nodes that acknowledge, by topic."""
        return dict(self._followers)

    def unmatched(self) -> str:
        """Return which topic is not yet linked everywhere, '' when all are."""
        if self._progress.get_publisher_count() < len(self._members):
            return f"'{lockstep.TOPIC}' is not linked to every node"
        ends = self._node.get_publishers_info_by_topic(lockstep.TOPIC)
        for topic in self._followers:
            ends += self._node.get_subscriptions_info_by_topic(topic)
        if any(end.node_name == _NAMELESS for end in ends):
            return 'a node is not known by its name yet'
        if unlinked := self._deaf():
            return unlinked
        for topic, subscription in self._between.items():
            if not subscription.get_publisher_count():
                return f"'{topic}' has no publisher"
            for writer in self._node.get_publishers_info_by_topic(topic):
                name = _full_name(writer)
                if name not in self._members:
                    continue
                readers = self._readers(topic, writer.qos_profile)
                linked = self._links.get(name, {}).get(topic, 0)
                if linked < readers:
                    return f"'{topic}' of '{name}' has {linked} of {readers} readers"
        return ''

    def _deaf(self) -> str:
        """Return who is not complete, or does not hear yet what it subscribes to; '' when all do."""
        for name in sorted(self._members):
            if name not in self._heard:
                return f"'{name}' is not complete"
            for topic, writers in self._heard[name].items():
                if topic not in self._followers:
                    continue
                if name not in self._followers[topic]:
                    return f"'{name}' is not known to hear '{topic}'"
                if not writers:
                    return f"'{name}' does not hear '{topic}' yet"
        return ''

    def _readers(self, topic: str, offered: QoSProfile) -> int:
        """Return how many known subscriptions take what is offered."""
        infos = self._node.get_subscriptions_info_by_topic(topic)
        checks = (qos_check_compatible(offered, info.qos_profile)[0] for info in infos)
        return sum(check != QoSCompatibility.ERROR for check in checks)

    def _on_links(self, line: String) -> None:
        name, told, heard = lockstep.parse_links(line.data)
        self._links[name], self._heard[name] = told, heard

    def begin(self) -> None:
        """Count from now on: what came before the first message has nothing to do with it."""
        self._acknowledged.clear()
        self._expected.clear()

    def published(self, topic: str) -> None:
        """Expect one more acknowledgement from every node that follows `topic`."""
        for name in self._followers.get(topic, ()):
            key = (name, topic)
            self._expected[key] = self._expected.get(key, 0) + 1

    def _on_progress(self, line: String) -> None:
        name, topic, _ = lockstep.parse(line.data)
        key = (name, topic)
        self._acknowledged[key] = self._acknowledged.get(key, 0) + 1

    def _take_between(self) -> None:
        for topic, subscription in self._between.items():
            with subscription.handle:
                while subscription.handle.take_message(subscription.msg_type, True) is not None:
                    self.published(topic)

    def _behind(self) -> tuple[str, str] | None:
        for key, expected in self._expected.items():
            if self._acknowledged.get(key, 0) < expected:
                return key
        return None

    def wait(self, spin_for: Callable[[float], None]) -> None:
        """Return when everything published is processed; raise BagError naming who is behind.

        `spin_for` serves callbacks until something happened or so many seconds are over.
        """
        deadline = time.monotonic() + self._timeout
        while True:
            behind = self._behind()
            if behind is None:
                self._take_between()
                if self._behind() is None:
                    return
                continue
            if time.monotonic() > deadline:
                name, topic = behind
                gone = '' if name in self.members() else ' (the node is gone)'
                raise BagError(
                    f"lock-step: node '{name}' has not processed a message of '{topic}' within "
                    f'{self._timeout:g} s{gone}'
                )
            spin_for(0.1)
