# SPDX-License-Identifier: Apache-2.0
"""Replays a bag through live node processes and records what they say; the same offline, and the comparison.

Every process is its own: player, recorder and one per estimator. Lock-step makes the outputs those of the
offline runner to the last bit.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import TimeoutExpired
from typing import Any

from std_srvs.srv import Trigger

from bag_tools.bag import BagReader, BagWriter
from bag_tools.content import compare
from bag_tools.offline import OfflineResult, offline
from bag_tools.registry import find_ports
from node_core.testing import Process
from workspace_harness.graph import Watch

# The first start of a node after a change compiles its kernels, which takes a minute on a busy machine.
_START_LIMIT = 300  # s
_START_TIMEOUT = ('--wait-timeout', str(_START_LIMIT))
_POLL = 0.5  # s
_NAMES_TIMEOUT = 10.0  # s


class ReplayError(RuntimeError):
    """A process of the graph failed; the message holds what it printed."""


@dataclass(frozen=True)
class Estimator:
    """One estimator node in the graph; its outputs are published below `space` to keep several apart."""

    package: str
    name: str
    space: str
    params: dict[str, Any] = field(default_factory=dict)

    @property
    def node(self) -> str:
        """The node's name in the graph."""
        return f'{self.space}_node'

    @property
    def inputs(self) -> list[str]:
        """Topics that the node listens to."""
        return [f'/{port.topic}' for port in find_ports(self.package, self.name).inputs]

    @property
    def outputs(self) -> dict[str, str]:
        """Output topics as declared → as published."""
        ports = find_ports(self.package, self.name)
        return {o.topic: f'{self.space}/{o.topic}' for o in ports.outputs.values()}


def live(
    bag: Path,
    estimators: list[Estimator],
    out: Path,
    *,
    rate: float | None = None,
    lockstep: bool = True,
    progress: bool = False,
    composed: bool = False,
    watch: Watch | None = None,
    timeout: float = 1800.0,
) -> None:
    """Play `bag` through `estimators` as processes and record all their outputs into `out`.

    `rate` None is as fast as possible. With `composed` all estimators share one process. `watch` looks
    before the bag begins, now and then while it plays, and at the end until it has seen all. Raises
    ReplayError when a process ends with another code than 0; all processes are gone afterwards in any case.
    """
    topics = [f'/{topic}' for e in estimators for topic in e.outputs.values()]
    pace = ['--fast'] if rate is None else ['--rate', str(rate)]
    step = ['--lockstep'] if lockstep else []
    with ExitStack() as stack:
        started = [_composed(estimators, lockstep)] if composed else _separate(estimators, lockstep)
        nodes = [stack.enter_context(process) for process in started]
        recorder = stack.enter_context(
            Process.node('bag_tools', 'record', str(out), *topics, *step, *_START_TIMEOUT, '--overwrite')
        )
        with BagReader(bag) as reader:
            # Truth and the like need not travel through the graph.
            played = sorted({t for e in estimators for t in e.inputs} & set(reader.topics))
        waited = ['/recorder', *(f'/{e.name if composed else e.node}' for e in estimators)]
        player = stack.enter_context(
            Process.node(
                'bag_tools',
                'play',
                str(bag),
                *pace,
                *step,
                *_START_TIMEOUT,
                '--topics',
                *played,
                '--wait-for',
                *waited,
                *([] if progress else ['--quiet']),
                *([] if watch is None else ['--start-paused']),
                inherit_stderr=progress,
            )
        )
        if watch is not None:
            _resume_once_seen(player, watch, played, waited)
        code = _wait_for_player(player, [recorder, *nodes], timeout, watch)
        if code != 0:
            said = '\n'.join(p.output for p in (player, recorder, *nodes))
            raise ReplayError(f'{bag.name}: the player ended with {code}:\n{said}')
        _look_around(watch)
        # The recorder first: it drains what is in flight while the estimators are still there.
        for process in (recorder, *nodes):
            if process.stop() != 0:
                raise ReplayError(f'{bag.name}: {process.argv[0]} failed:\n{process.output}')


def _separate(estimators: list[Estimator], lockstep: bool) -> list[Process]:
    return [
        Process.node(
            e.package, e.name, params={**e.params, 'lockstep': lockstep}, remaps=e.outputs, name=e.node
        )
        for e in estimators
    ]


def _composed(estimators: list[Estimator], lockstep: bool) -> Process:
    """Return one process with all estimators, each under its own name: no name may come twice."""
    own = {f'{e.name}:{key}': value for e in estimators for key, value in e.params.items()}
    remaps = {f'{e.name}:{topic}': target for e in estimators for topic, target in e.outputs.items()}
    names = [f'{e.package}/{e.name}' for e in estimators]
    return Process.node('node_core', 'compose', *names, params={**own, 'lockstep': lockstep}, remaps=remaps)


def _resume_once_seen(player: Process, watch: Watch, topics: list[str], others: list[str]) -> None:
    """Let a paused player go once it is seen with its `topics` and `others`: it may be over before."""
    names = [name.lstrip('/') for name in others]
    client = watch.probe.node.create_client(Trigger, '/player/resume')
    try:
        if not _until(player, watch, client.service_is_ready, _START_LIMIT):
            return  # its exit code says why
        _until(player, watch, lambda: watch.sees('player', topics, names), _NAMES_TIMEOUT)
        _until(player, watch, client.call_async(Trigger.Request()).done, _START_LIMIT)
    finally:
        watch.probe.node.destroy_client(client)


def _until(player: Process, watch: Watch, condition: Callable[[], bool], limit: float) -> bool:
    """Look around until `condition` holds, for `limit` s at most and while the player lives."""
    deadline = time.monotonic() + limit
    while not (held := condition()) and player.running and time.monotonic() < deadline:
        watch()
    return held


def _wait_for_player(player: Process, others: list[Process], timeout: float, watch: Watch | None) -> int:
    """Return the player's exit code; raise ReplayError as soon as another process is gone before it."""
    deadline = time.monotonic() + timeout
    while True:
        try:
            return player.wait(_POLL)
        except TimeoutExpired:
            if watch is not None:
                watch()
        for process in others:
            if not process.running:
                raise ReplayError(f'{" ".join(process.argv)} ended by itself:\n{process.output}')
        if time.monotonic() > deadline:
            raise ReplayError(f'the player is not done within {timeout:g} s:\n{player.output}')


def _look_around(watch: Watch | None) -> None:
    """Call `watch` until it has seen all: a short replay may be over before its nodes are known by name."""
    deadline = time.monotonic() + _NAMES_TIMEOUT
    while watch is not None and not watch() and time.monotonic() < deadline:
        pass


def offline_all(bag: Path, estimators: list[Estimator], folder: Path) -> dict[str, OfflineResult]:
    """Run the same estimators without DDS, one bag each in `folder`; results by space."""
    return {
        e.space: offline(
            find_ports(e.package, e.name),
            e.params,
            bag,
            folder / f'{e.space}.mcap',
            remaps=e.outputs,
            overwrite=True,
        )
        for e in estimators
    }


def cut(bag: Path, seconds: float, out: Path) -> Path:
    """Write the first `seconds` of `bag` to `out` and return it, or return the bag if it is no longer."""
    with BagReader(bag) as reader:
        if reader.stop - reader.start <= seconds * 1e9:
            return bag
        end = reader.start + round(seconds * 1e9)
        with BagWriter(out, compression='zstd', overwrite=True) as writer:
            for topic in reader.topics.values():
                writer.add(topic.name, topic.type, qos=topic.qos[:1], store=reader.store)
            for name, stamp, data in reader.messages(stop=end):
                writer.write_raw(name, stamp, data)
    return out


def differences(live_bag: Path, offline_folder: Path, estimators: list[Estimator]) -> list[str]:
    """Return one line per output topic whose decoded fields differ between the live and the offline bag."""
    found = []
    for e in estimators:
        topics = [f'/{topic}' for topic in e.outputs.values()]
        for result in compare(live_bag, offline_folder / f'{e.space}.mcap', topics):
            if not result.equal:
                found.append(f'{result.topic}: {result.difference}')
    return found
