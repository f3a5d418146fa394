# SPDX-License-Identifier: Apache-2.0
"""The node graph as it runs: who publishes what to whom, of which type, how often."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from bag_tools.bag import BagReader
from node_core.testing import Probe

# What every node has; drawn, it would hide what the graph does.
_COMMON = ('/diagnostics', '/rosout', '/parameter_events', '/lockstep/progress', '/lockstep/links', '/clock')


@dataclass(frozen=True, slots=True)
class TopicEdge:
    """A topic with its publishers and subscribers (names of nodes); `rate` in Hz, None while unknown."""

    name: str
    type: str
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    rate: float | None = None


@dataclass(frozen=True, slots=True)
class Graph:
    """The nodes and topics of one moment, both sorted by name."""

    nodes: tuple[str, ...]
    topics: tuple[TopicEdge, ...]

    def with_rates(self, rates: Mapping[str, float]) -> Graph:
        """Return the graph with the rates (Hz) that are known of its topics."""
        return replace(self, topics=tuple(replace(t, rate=rates.get(t.name, t.rate)) for t in self.topics))


def seen_by(probe: Probe) -> Graph:
    """Return what `probe` has discovered, itself, hidden nodes and common topics left out."""
    node = probe.node
    own = node.get_name()
    names = [n for n, _ in node.get_node_names_and_namespaces() if n != own and not n.startswith('_')]
    topics = []
    for topic, types in node.get_topic_names_and_types():
        if topic in _COMMON or any(part.startswith('_') for part in topic.split('/')):
            continue
        publishers = {i.node_name for i in node.get_publishers_info_by_topic(topic)} - {own}
        subscribers = {i.node_name for i in node.get_subscriptions_info_by_topic(topic)} - {own}
        if publishers:
            topics.append(TopicEdge(topic, types[0], tuple(sorted(publishers)), tuple(sorted(subscribers))))
    return Graph(tuple(sorted(set(names))), tuple(sorted(topics, key=lambda t: t.name)))


@dataclass
class Watch:
    """Looks at a running graph whenever it is called; `graph` is the fullest that was seen.

    The graph is taken as a whole: while nodes come and go it has fewer connections than while it works.
    """

    probe: Probe
    graph: Graph = field(default_factory=lambda: Graph((), ()))

    def __call__(self) -> None:
        """Look once."""
        self.probe.spin()
        now = seen_by(self.probe)
        if _size(now) >= _size(self.graph):
            self.graph = now


def _size(graph: Graph) -> tuple[int, int]:
    ends = sum(len(t.publishers) + len(t.subscribers) for t in graph.topics)
    return len(graph.nodes), ends


def replay_rates(played: Path, recorded: Path) -> dict[str, float]:
    """Return messages per second of the played bag's time, by topic: a replay runs at a pace of its own."""
    rates = {}
    with BagReader(played) as source, BagReader(recorded) as sink:
        seconds = (source.stop - source.start) * 1e-9
        for topic in (*source.topics.values(), *sink.topics.values()):
            if topic.count and seconds > 0.0:
                rates[topic.name] = topic.count / seconds
    return rates


def without_lockstep(graph: Graph) -> Graph:
    """Return the graph without what lock-step adds: the player listens to all that its messages cause."""
    topics = (
        replace(t, subscribers=tuple(n for n in t.subscribers if n != 'player' or t.publishers == (n,)))
        for t in graph.topics
    )
    return replace(graph, topics=tuple(topics))
