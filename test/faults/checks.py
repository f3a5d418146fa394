# SPDX-License-Identifier: Apache-2.0
"""What a case checks: the way back to an undisturbed run, and what a node says on /diagnostics."""

from __future__ import annotations

from typing import Any

from faults.graph import Graph
from faults.systems import index_at, recorded, undisturbed
from node_core.testing import Probe

# Of the messages that an estimator answers one by one, the share that may stay without an answer while a
# node runs free: it may hold back a few for the order of their stamps.
_UNANSWERED = 0.1
# Outputs in a row; who is silent for longer is not back yet.
_SILENCE = 10


def stamps_between(name: str, first: float, last: float) -> list[int]:
    """Return the stamps (ns) that an undisturbed run of system `name` answers between two bag times (s)."""
    rows = recorded(name).messages
    begin, end = (rows[min(index_at(name, s), len(rows) - 1)][1] for s in (first, last))
    return sorted(s for s in undisturbed(name) if begin <= s < end)


def back_after(graph: Graph, since: float, until: float) -> int:
    """Return after how many outputs that were due from `since` (s) on the graph was back, and stayed.

    Fails when it is not back by `until`: outside the tolerance, or silent.
    """
    system = graph.system
    due = stamps_between(system.name, since, until)
    assert due, f'no output is due between {since:g} s and {until:g} s'
    graph.probe.until(
        lambda: due[-1] in graph.outputs, 'the last output', process=graph.processes[system.main.name]
    )
    reference = undisturbed(system.name)
    good = [s in graph.outputs and _apart(graph, s, reference) <= system.tolerance for s in due]
    answered = [s in graph.outputs for s in due]
    bad = [i for i, (ok, there) in enumerate(zip(good, answered)) if there and not ok]
    count = max([_last_silence(answered), *(i + 1 for i in bad)])
    assert count < len(due), f'{system.output} is {_apart(graph, due[-1], reference):.3g} {system.unit} off'
    rest = answered[count:]
    silent = rest.count(False)
    assert silent <= _UNANSWERED * len(rest), f'{silent} of {len(rest)} outputs are missing'
    return count


def _last_silence(answered: list[bool]) -> int:
    """Return where the last long silence ends; leading silence counts, however short."""
    end = answered.index(True)
    silent = 0
    for i, there in enumerate(answered):
        if there and silent > _SILENCE:
            end = i
        silent = 0 if there else silent + 1
    return end


def _apart(graph: Graph, stamp: int, reference: dict[int, tuple[float, ...]]) -> float:
    return graph.system.distance(graph.outputs[stamp], reference[stamp])


def farthest(graph: Graph, since: float, until: float) -> float:
    """Return the largest distance to the undisturbed run between two bag times (s)."""
    reference = undisturbed(graph.system.name)
    due = stamps_between(graph.system.name, since, until)
    return max((_apart(graph, s, reference) for s in due if s in graph.outputs), default=0.0)


class Listener:
    """Everything that is said on /diagnostics."""

    def __init__(self, probe: Probe) -> None:
        self._probe = probe
        self._arrays = probe.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')

    def statuses(self, name: str) -> list[Any]:
        """Return what was said under `name` so far, oldest first."""
        return [s for array in self._arrays for s in array.status if s.name == name]

    def wait(self, name: str, condition: Any, what: str) -> Any:
        """Wait until a status of `name` fulfils `condition` and return it."""
        seen = 0

        def found() -> Any:
            nonlocal seen
            statuses = self.statuses(name)
            fresh, seen = statuses[seen:], len(statuses)
            return next((s for s in fresh if condition(s)), None)

        return self._probe.until(found, f'{what} of {name} on /diagnostics')

    def rejections(self, node: str, topic: str) -> str:
        """Wait until `node` reports rejected messages of `topic`; return the most frequent reason."""

        def reasons(status: Any) -> dict[str, int]:
            prefix = 'rejected: '
            return {
                v.key.removeprefix(prefix): int(v.value) for v in status.values if v.key.startswith(prefix)
            }

        status = self.wait(f'{node}: {topic}', reasons, 'a rejection')
        counted = reasons(status)
        return max(counted, key=lambda reason: counted[reason])


def values(status: Any) -> dict[str, str]:
    """Return the key-value pairs of a status."""
    return {v.key: v.value for v in status.values}
