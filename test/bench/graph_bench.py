# SPDX-License-Identifier: Apache-2.0
"""Whole graphs at their full rate against the same graphs of bare relays: processor time, latency, loss.

Every node is a process of its own. The same bag is fed to both at the rates of real sensors, faster than its
stamps where the fixture was thinned out; what a relay listens to, says and how often is learned from the real
graph. Simulators are left out: a machine has sensors instead.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from workspace_harness.domain import own_domain
from workspace_harness.make_bags import root

from bag_tools.bag import BagReader
from bag_tools.bench import Options, Row
from node_core.live_bench import cpu_seconds
from node_core.message_types import message_class
from node_core.node import reliable
from node_core.testing import Probe, Process, probe

PACKAGE = 'workspace_harness'
_SECONDS, _QUICK_SECONDS = 30.0, 3.0
_WARM = 6.0  # s, not measured: kernels settle, and the ship's filter speaks after 20 s of its bag
_TRIGGER = '/imu/data_raw'
_RELAY = Path(__file__).with_name('relay_node.py')
_STAMP = struct.Struct('<4xiI')  # CDR: encapsulation, then sec and nanosec of the leading header
# What every node has.
_COMMON = ('/rosout', '/parameter_events', '/diagnostics', '/clock')


@dataclass(frozen=True)
class System:
    """A graph: its nodes with their parameters, the bag and how much faster than recorded it is fed.

    `ends` are the topics at the ends of its chains, which have an output for every sample of the IMU.
    """

    package: str
    nodes: Mapping[str, dict[str, Any]]
    bag: str
    speed: float
    rate: int  # Hz
    ends: tuple[str, ...]


def _systems(folder: Path) -> Iterator[System]:
    yield System('imu_kalman', {'attitude_estimator': {}}, 'imu_hand_held', 5.0, 500, ('/imu/data',))
    log = {'event_log': str(folder / 'events.db')}
    ship = {'attitude_estimator': {}, 'roll_analysis': {}, 'alarm_monitor': log}
    yield System('ship_inclinometer', ship, 'ship_turn_gnss', 4.0, 200, ('/imu/data',))
    car = {'velocity_estimator': {}, 'fusion_estimator': {}}
    yield System('ev_velocity', car, 'ev_good_road', 1.0, 500, ('/vehicle/velocity', '/fusion/velocity'))
    yield System('ins_gps', {'ins_gps_estimator': {}}, 'gnss_paper', 5.0, 100, ('/odometry',))
    quad = {'attitude_filter': {}, 'attitude_controller': {}}
    yield System('quad_control', quad, 'quad_free_10deg', 1.0, 200, ('/motors/command',))


@dataclass
class _Node:
    """What a node listens to and says (topic → type)."""

    inputs: dict[str, str] = field(default_factory=dict)
    outputs: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Figures:
    """Load of all nodes (1 is a core), 99 % latency (s), samples without output, messages by topic."""

    load: float
    p99: float
    lost: int
    counts: Counter[str]


def _ends(eye: Probe, names: Iterable[str]) -> dict[str, _Node]:
    """Return what the nodes listen to and say; raise AssertionError when one never appears."""
    found = {}
    for name in names:
        eye.until(lambda name=name: name in eye.node.get_node_names(), f'node {name}')
        eye.until(lambda name=name: eye.node.get_subscriber_names_and_types_by_node(name, '/'), 'its inputs')
        asked = (
            eye.node.get_subscriber_names_and_types_by_node(name, '/'),
            eye.node.get_publisher_names_and_types_by_node(name, '/'),
        )
        found[name] = _Node(*({t: k[0] for t, k in pairs if t not in _COMMON} for pairs in asked))
    return found


def _feed(
    system: System, eye: Probe, nodes: dict[str, _Node], processes: list[Process], seconds: float
) -> Figures:
    made = {t: k for node in nodes.values() for t, k in node.outputs.items()}
    heard = {t for node in nodes.values() for t in node.inputs}
    counts: Counter[str] = Counter()
    sent: dict[int, int] = {}
    arrived: dict[str, dict[int, int]] = {topic: {} for topic in system.ends}

    def listen(topic: str) -> Any:
        def callback(data: bytes) -> None:
            counts[topic] += bool(sent)
            if topic in arrived:
                sec, nanosec = _STAMP.unpack_from(data)
                arrived[topic][sec * 1_000_000_000 + nanosec] = time.monotonic_ns()

        return callback

    for topic, kind in made.items():
        eye.node.create_subscription(message_class(kind), topic, listen(topic), reliable(10_000), raw=True)
    with BagReader(root() / 'bags' / f'{system.bag}.mcap') as reader:
        topics = sorted(heard & set(reader.topics) - set(made))
        publishers = {t: eye.publisher(reader.topics[t].type, t) for t in topics}
        stop = reader.start + round((seconds + _WARM) * system.speed * 1e9)
        messages = list(reader.messages(topics, stop=stop))
    for topic in system.ends:
        eye.wait_for_publisher(topic)
    base, start = messages[0][1], time.monotonic_ns()
    spent, begun = [0.0] * len(processes), 0
    for topic, stamp, data in messages:
        due = start + round((stamp - base) / system.speed)
        while (left := due - time.monotonic_ns()) > 0:
            eye.spin(left * 1e-9)
        if not begun and due - start >= _WARM * 1e9:
            spent, begun = [cpu_seconds(p.pid) for p in processes], due
        counts[topic] += bool(begun)
        if begun and topic == _TRIGGER:
            sec, nanosec = _STAMP.unpack_from(data)
            sent[sec * 1_000_000_000 + nanosec] = time.monotonic_ns()
        publishers[topic].publish(bytes(data))
    used = sum(cpu_seconds(p.pid) for p in processes) - sum(spent)
    elapsed = (time.monotonic_ns() - begun) * 1e-9
    last = max(sent)
    eye.until(lambda: all(last in a for a in arrived.values()), 'the last output', process=processes[0])
    delays = [1e-9 * (a[s] - t) for a in arrived.values() for s, t in sent.items() if s in a]
    p99 = float(np.percentile(delays, 99.0))
    lost = len(sent) * len(arrived) - len(delays)
    return Figures(used / elapsed, p99, lost, counts)


def _real(system: System, seconds: float) -> tuple[Figures, dict[str, _Node]]:
    with own_domain(), ExitStack() as stack:
        processes = [
            stack.enter_context(Process.node(system.package, name, params=params))
            for name, params in system.nodes.items()
        ]
        eye = stack.enter_context(probe('graph_bench'))
        nodes = _ends(eye, system.nodes)
        return _feed(system, eye, nodes, processes, seconds), nodes


def _spec(node: _Node, counts: Counter[str]) -> dict[str, Any]:
    trigger = max(node.inputs, key=lambda t: counts[t])
    outputs = {
        t: (kind, max(1, round(counts[trigger] / counts[t]))) for t, kind in node.outputs.items() if counts[t]
    }
    return {'inputs': node.inputs, 'trigger': trigger, 'outputs': outputs}


def _bare(system: System, nodes: dict[str, _Node], counts: Counter[str], seconds: float) -> Figures:
    with own_domain(), ExitStack() as stack:
        processes = [
            stack.enter_context(Process([sys.executable, str(_RELAY), name, json.dumps(_spec(node, counts))]))
            for name, node in nodes.items()
        ]
        eye = stack.enter_context(probe('graph_bench'))
        return _feed(system, eye, _ends(eye, nodes), processes, seconds)


def measure(options: Options) -> Iterable[Row]:
    """Yield three rows per system."""
    if not options.live:
        return
    seconds = _QUICK_SECONDS if options.quick else _SECONDS
    with tempfile.TemporaryDirectory() as folder:
        for system in _systems(Path(folder)):
            ours, nodes = _real(system, seconds)
            bare = _bare(system, nodes, ours.counts, seconds)
            name = f'graph of {system.package} at {system.rate} Hz'
            yield Row(
                PACKAGE,
                f'{name}: load',
                100 * ours.load,
                '% of a core',
                reference={'relays': 100 * bare.load},
            )
            yield Row(
                PACKAGE, f'{name}: latency p99', 1e3 * ours.p99, 'ms', reference={'relays': 1e3 * bare.p99}
            )
            reference = {'relays': float(bare.lost)}
            yield Row(PACKAGE, f'{name}: samples lost', ours.lost, 'samples', bar=0, reference=reference)
