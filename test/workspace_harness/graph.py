# SPDX-License-Identifier: Apache-2.0
"""The node graph as it runs: who publishes what to whom, of which type, how often."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from bag_tools.bag import BagReader
from node_core.testing import Probe

# What every node has; drawn, it would hide what the graph does.
_COMMON = ('/diagnostics', '/rosout', '/parameter_events', '/lockstep/progress', '/lockstep/links', '/clock')

NAMELESS = '_NODE_NAME_UNKNOWN_'  # of rmw
_LOOK = 0.05  # s


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
    """Return what `probe` has discovered, itself, hidden nodes and common topics left out.

    A topic's ends come before the names of their nodes: until then they are called NAMELESS.
    """
    node = probe.node
    own = node.get_name()
    names = [n for n, _ in node.get_node_names_and_namespaces() if n != own and not n.startswith('_')]
    topics = []
    for topic, types in node.get_topic_names_and_types():
        if topic in _COMMON or any(part.startswith('_') for part in topic.split('/')):
            continue
        publishers = {i.node_name for i in node.get_publishers_info_by_topic(topic)} - {own}
        subscribers = {i.node_name for i in node.get_subscriptions_info_by_topic(topic)} - {own}
        topics.append(TopicEdge(topic, types[0], tuple(sorted(publishers)), tuple(sorted(subscribers))))
    return Graph(tuple(sorted(set(names))), tuple(sorted(topics, key=lambda t: t.name)))


@dataclass
class Watch:
    """Looks at a running graph whenever it is called, and keeps all that it sees, those gone included."""

    probe: Probe
    seen: Graph = field(default_factory=lambda: Graph((), ()))

    @property
    def graph(self) -> Graph:
        """What was seen, without topics that nobody published."""
        return replace(self.seen, topics=tuple(t for t in self.seen.topics if t.publishers))

    def sees(self, player: str, topics: Collection[str], others: Collection[str]) -> bool:
        """Return whether `player` is known by name as publisher of all `topics`, and `others` as any ends."""
        ends = {name for t in self.seen.topics for name in (*t.publishers, *t.subscribers)}
        played = {t.name for t in self.seen.topics if player in t.publishers and t.subscribers}
        return set(topics) <= played and set(others) <= ends

    def __call__(self) -> bool:
        """Look once, for some time; return whether all ends of topics had names."""
        self.probe.spin(_LOOK)
        now = seen_by(self.probe)
        self.seen = _merged(self.seen, now)
        return not any(NAMELESS in (*t.publishers, *t.subscribers) for t in now.topics)


def _merged(graph: Graph, other: Graph) -> Graph:
    topics = {t.name: t for t in graph.topics}
    for new in other.topics:
        old = topics.get(new.name, new)
        publishers = {*old.publishers, *new.publishers} - {NAMELESS}
        subscribers = {*old.subscribers, *new.subscribers} - {NAMELESS}
        topics[new.name] = replace(
            new, publishers=tuple(sorted(publishers)), subscribers=tuple(sorted(subscribers))
        )
    return Graph(tuple(sorted({*graph.nodes, *other.nodes})), tuple(topics[name] for name in sorted(topics)))


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
