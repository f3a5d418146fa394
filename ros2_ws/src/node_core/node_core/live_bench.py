# SPDX-License-Identifier: Apache-2.0
"""Measures a node as a process: CPU per message, latency from input to output, loss.

The same feed goes to the node and to a bare rclpy node that republishes the message, one after the other in
one run: the ratio of their CPU times says what the estimator costs, whatever the machine.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from node_core.message_types import message_class
from node_core.messages import set_stamp, stamp_of
from node_core.testing import Probe, Process, probe

_TICKS = os.sysconf('SC_CLK_TCK')


@dataclass(frozen=True, slots=True)
class Feed:
    """One input: `fill(message, index)` writes a sample; it is published `every` ticks of the fast clock."""

    type: str
    topic: str
    fill: Callable[[Any, int], None]
    every: int = 1


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """CPU seconds per fast input message, latencies (s) and the number of outputs that never came."""

    cpu: float
    latency_p50: float
    latency_p99: float
    lost: int
    sent: int


def cpu_seconds(pid: int) -> float:
    """Return user and system time (s) that a process has used."""
    with open(f'/proc/{pid}/stat') as file:
        fields = file.read().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def measure(
    process: Process, feeds: list[Feed], output: tuple[str, str], rate: float, count: int
) -> LiveFigures:
    """Feed a running node at `rate` (Hz) with `count` ticks; its outputs are matched by header stamp."""
    with probe('live_bench') as p:
        arrivals: dict[int, int] = {}
        type_name, topic = output

        def arrived(message: Any) -> None:
            arrivals[stamp_of(message)] = time.monotonic_ns()

        from node_core.node import reliable

        p.node.create_subscription(message_class(type_name), topic, arrived, reliable(10_000))
        publishers = [p.publisher(f.type, f.topic, process=process) for f in feeds]
        p.wait_for_publisher(topic, process)
        return _drive(p, process, feeds, publishers, arrivals, rate, count)


def _drive(
    p: Probe,
    process: Process,
    feeds: list[Feed],
    publishers: list[Any],
    arrivals: dict[int, int],
    rate: float,
    count: int,
) -> LiveFigures:
    messages = [message_class(f.type)() for f in feeds]
    period = round(1e9 / rate)
    base = time.time_ns()
    # The first second is not measured: discovery may not be complete and kernels settle.
    warm = round(rate)
    sent: dict[int, int] = {}
    start = time.monotonic_ns()
    cpu = 0.0
    for index in range(warm + count):
        if index == warm:
            cpu = cpu_seconds(process.pid)
        due = start + index * period
        while (left := due - time.monotonic_ns()) > 0:
            p.spin(left * 1e-9)
        stamp = base + index * period
        for feed, publisher, message in zip(feeds, publishers, messages):
            if index % feed.every == 0:
                set_stamp(message.header, stamp)
                feed.fill(message, index)
                if feed is feeds[0] and index >= warm:
                    sent[stamp] = time.monotonic_ns()
                publisher.publish(message)
    used = cpu_seconds(process.pid) - cpu
    last = base + (warm + count - 1) * period
    p.until(lambda: last in arrivals, 'the last output', process=process)
    delays = np.array([arrivals[s] - t for s, t in sent.items() if s in arrivals]) * 1e-9
    p50, p99 = np.percentile(delays, (50.0, 99.0))
    return LiveFigures(used / count, float(p50), float(p99), len(sent) - len(delays), len(sent))


RELAY = """
import sys
import rclpy
from rclpy.node import Node
from rclpy.executors import ExternalShutdownException
from node_core.message_types import message_class
from node_core.node import reliable

rclpy.init()
node = Node('bare_relay')
inputs = [pair.split('=') for pair in sys.argv[2:]]
publish = node.create_publisher(message_class(inputs[0][1]), sys.argv[1], reliable(200)).publish
for i, (topic, name) in enumerate(inputs):
    callback = publish if i == 0 else (lambda _: None)
    node.create_subscription(message_class(name), topic, callback, reliable(200))
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
"""


def bare_relay(feeds: list[Feed], topic: str) -> Process:
    """Start a bare rclpy node that listens to the same topics and republishes the first one."""
    import sys

    return Process([sys.executable, '-c', RELAY, topic, *(f'{f.topic}={f.type}' for f in feeds)])


def compare(
    start: Callable[[], Process], feeds: list[Feed], output: tuple[str, str], rate: float, count: int
) -> tuple[LiveFigures, LiveFigures]:
    """Return the figures of the node and of the bare relay, measured one after the other."""
    with start() as process:
        ours = measure(process, feeds, output, rate, count)
    with bare_relay(feeds, 'live_bench/relayed') as process:
        bare = measure(process, feeds, (feeds[0].type, 'live_bench/relayed'), rate, count)
    return ours, bare
