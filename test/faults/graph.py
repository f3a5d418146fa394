# SPDX-License-Identifier: Apache-2.0
"""A live graph of processes under test: started, fed message by message, broken, watched.

In lock-step a message goes in when every node that is alive has processed the one before, so a case is the
same on any machine. Nodes that have to run free (what happens after a stall is a matter of queues) are fed
in chunks smaller than their queues, each followed by a barrier.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from rcl_interfaces.srv import GetParameters
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

import faults.relay
from bag_tools.nodes.lockstep import LockStep
from faults.systems import IMU_TOPIC, NodeSpec, System, index_at, recorded, stamp_or_none
from node_core.message_types import message_class
from node_core.messages import NANOSECONDS
from node_core.node import reliable
from node_core.testing import TIMEOUT, Probe, Process, executable, ros_arguments

# Far below the 200 messages that a node's queue holds, of the fast sensor and all others together.
_CHUNK = 25  # messages
# Links between two other processes cannot be seen from here: the graph must have been at rest so long.
_CALM = 0.25  # s
_LOOK = 0.1  # s
# Lost messages are sent again every 3 s by default.
_ACKED_WITHIN = Duration(seconds=60)
# The first start of a node after a change compiles its kernels, which takes minutes on a busy machine.
_LINKED_WITHIN = 900.0  # s
_RELAY_NODE = '/fault_relay'
_FAULTY = '/faulty' + IMU_TOPIC


class Following(LockStep):
    """The lock-step of the player, which forgets nodes that were killed: DDS takes 20 s to notice."""

    def __init__(self, node: Any, timeout: float) -> None:
        super().__init__(node, timeout)
        self.dead: set[str] = set()

    def members(self) -> frozenset[str]:
        """Return the full names of the nodes that take part and are alive."""
        return super().members() - self.dead


class Graph:
    """The processes of one system, below a namespace if asked; a context manager that ends them all.

    `outputs` maps the stamp (ns) of the compared output to its latest value; `heard` counts all of them.
    """

    def __init__(
        self,
        system: System,
        probe: Probe,
        *,
        lockstep: bool = True,
        namespace: str = '',
        relay: tuple[str, int, int] | None = None,
        sim_time: bool = False,
        qos: QoSProfile | None = None,
    ) -> None:
        self.system = system
        self.probe = probe
        self.processes: dict[str, Process] = {}
        self.outputs: dict[int, tuple[float, ...]] = {}
        self.heard = 0
        self.position = 0
        self.stopped = ''
        self._source = recorded(system.name)
        self._qos = qos or reliable(1000)
        self._lockstep = lockstep
        self._namespace = namespace.strip('/')
        self._relay = relay
        self._sim_time = sim_time
        self._stack = ExitStack()
        self._endpoints: dict[str, set[bytes]] = {}
        self._following = Following(probe.node, TIMEOUT) if lockstep else None
        self._publishers: dict[str, Any] = {}
        self._killed: set[str] = set()
        self._broken: list[str] = []
        self._clock: Any = None

    # --- names -----------------------------------------------------------------------------------

    def full(self, name: str) -> str:
        """Return the full name of a node or topic of this graph."""
        prefix = f'/{self._namespace}' if self._namespace else ''
        return f'{prefix}/{name.lstrip("/")}'

    def spec(self, name: str) -> NodeSpec:
        """Return the node `name`."""
        return next(n for n in self.system.nodes if n.name == name)

    # --- processes -------------------------------------------------------------------------------

    def __enter__(self) -> Graph:
        kind = message_class(self.system.output_type)
        self._output = self.probe.node.create_subscription(
            kind, self.full(self.system.output), self._on_output, reliable(10_000)
        )
        for node in self.system.nodes:
            self.start(node.name)
        if self._relay is not None:
            self._start_relay(*self._relay)
        for topic, type_name in self._source.types.items():
            target = _FAULTY if self._relay and topic == IMU_TOPIC else self.full(topic)
            self._publishers[topic] = self.probe.node.create_publisher(
                message_class(type_name), target, self._qos
            )
        self.wait_until_linked()
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _tb: TracebackType | None
    ) -> None:
        self._stack.close()
        self.probe.node.destroy_subscription(self._output)
        for publisher in self._publishers.values():
            self.probe.node.destroy_publisher(publisher)

    def start(self, name: str) -> Process:
        """Start (or restart) the node `name`; `wait_until_linked` says when it takes part."""
        self.processes[name] = self._stack.enter_context(self._process(self.spec(name)))
        self._killed.discard(name)
        if self._following is not None:
            self._following.dead.discard(self.full(name))
        return self.processes[name]

    @contextmanager
    def twin(self, name: str) -> Iterator[Process]:
        """Yield a second process of the node `name`, of the same name, linked."""
        full = self.full(name)
        there = self._subscriptions_of(full)
        with self._process(self.spec(name)) as process:
            more = len(self.spec(name).inputs)
            self.probe.until(
                lambda: len(self._subscriptions_of(full) - there) >= more, f'a second {name}', process=process
            )
            yield process

    def _process(self, node: NodeSpec) -> Process:
        params: dict[str, Any] = {**node.params, 'lockstep': self._lockstep}
        if self._sim_time:
            params['use_sim_time'] = True
        extra = ['-r', f'__ns:=/{self._namespace}'] if self._namespace else []
        return Process(
            [
                executable(node.package, node.executable),
                *ros_arguments(params, dict(node.remaps), node.name),
                *extra,
            ]
        )

    def _start_relay(self, fault: str, first: int, last: int) -> None:
        arguments = [fault, str(first), str(last), '0', _FAULTY, self.full(IMU_TOPIC)]
        process = Process.script(Path(faults.relay.__file__), *arguments, params={'lockstep': self._lockstep})
        self.processes['fault_relay'] = self._stack.enter_context(process)

    def kill(self, name: str) -> None:
        """End a node by SIGKILL; nothing waits for it any more."""
        self.processes[name].send(signal.SIGKILL)
        self.processes[name].wait()
        self._killed.add(name)
        self._endpoints[name] = self._subscriptions_of(self.full(name))
        if self._following is not None:
            self._following.dead.add(self.full(name))
            self._look()

    def stop(self) -> None:
        """End all nodes as Ctrl-C does; fail when one ends with another code than 0."""
        for name, process in self.processes.items():
            code = process.stop()
            assert code == 0, f'{name} ended with {code}:\n{process.output}'
            assert 'Traceback' not in process.output, f'{name}:\n{process.output}'

    def check_alive(self) -> None:
        """Fail with what a node has printed when it is gone."""
        for name, process in self.processes.items():
            assert name in self._killed or process.running, f'{name} ended by itself:\n{process.output}'
        assert not self._broken, self._broken[0]

    # --- links -----------------------------------------------------------------------------------

    def _subscriptions_of(self, full_name: str) -> set[bytes]:
        found = set()
        for topic, _ in self.probe.node.get_topic_names_and_types():
            for info in self.probe.node.get_subscriptions_info_by_topic(topic):
                if f'{info.node_namespace.rstrip("/")}/{info.node_name}' == full_name:
                    found.add(bytes(info.endpoint_gid))
        return found

    def _missing(self) -> str:
        for node in self.system.nodes:
            new = self._subscriptions_of(self.full(node.name)) - self._endpoints.get(node.name, set())
            if len(new) < len(node.inputs):
                return f'{node.name} subscribes to {len(new)} of {len(node.inputs)} topics'
        if self._following is not None:
            self._look()
            wanted = {self.full(n.name) for n in self.system.nodes}
            wanted |= {_RELAY_NODE} if self._relay else set()
            if missing := wanted - self._following.members():
                return f'{min(missing)} is not in lock-step'
            if unmatched := self._following.unmatched():
                return unmatched
        for publisher in self._publishers.values():
            if publisher.get_subscription_count() < self.probe.node.count_subscribers(publisher.topic_name):
                return f'a subscriber of {publisher.topic_name}'
        return '' if self._output.get_publisher_count() else 'the compared output'

    def _look(self) -> None:
        assert self._following is not None
        self._following.look({p.topic_name for p in self._publishers.values()})

    def wait_until_linked(self) -> None:
        """Wait until every node is there, matched, and the graph at rest; then count anew."""
        calm, seen = time.monotonic(), None
        end = time.monotonic() + _LINKED_WITHIN
        while True:
            self.check_alive()
            missing = self._missing()
            state = (
                missing,
                tuple(p.get_subscription_count() for p in self._publishers.values()),
                self._following.followers() if self._following else None,
            )
            if state != seen:
                calm, seen = time.monotonic(), state
            if not missing and time.monotonic() - calm > _CALM:
                break
            if time.monotonic() > end:
                said = '\n'.join(p.output for p in self.processes.values())
                raise AssertionError(f'the graph is not complete: {missing}\n{said}')
            self.probe.spin(_LOOK)
        if self._following is not None:
            self._following.begin()

    # --- messages --------------------------------------------------------------------------------

    def _on_output(self, message: Any) -> None:
        self.heard += 1
        value = self.system.value(message)
        stamp = stamp_or_none(message)
        if stamp is None or not all(math.isfinite(v) for v in value):
            self._broken.append(f'{self.system.output}: {value} at stamp {stamp}')
            return
        self.outputs[stamp] = value

    def publish(self, topic: str, data: bytes) -> None:
        """Publish one message; in lock-step wait until the graph has processed it."""
        publisher = self._publishers[topic]
        publisher.publish(data)
        if self._following is not None:
            self._following.published(publisher.topic_name)
            self._following.wait(self.probe.spin)

    def feed(self, seconds: float) -> None:
        """Go on in the bag to `seconds` after its start."""
        self.feed_rows(index_at(self.system.name, seconds))

    def feed_rows(self, end: int, each: Callable[[int], None] | None = None) -> None:
        """Go on in the bag to message number `end`; `each(number)` is called after every message."""
        pending: list[str] = []
        while self.position < end:
            topic, _, data = self._source.messages[self.position]
            self.publish(topic, data)
            if each is not None:
                each(self.position)
            self.position += 1
            if self._following is None:
                pending.append(topic)
                if len(pending) >= _CHUNK or self.position == end:
                    self.barrier(len(pending))
                    pending.clear()
        self.check_alive()

    def skip(self, seconds: float) -> None:
        """Leave out messages up to `seconds` after the start of the bag."""
        self.position = index_at(self.system.name, seconds)

    def burst(self, count: int) -> None:
        """Publish the next `count` messages at once, without waiting for anybody; then until all is quiet.

        What the network lost is sent again after seconds, and all that follows of its topic waits for it: a
        bag that goes on at once, faster than any sensor, would be over before.
        """
        for topic, _, data in self._source.messages[self.position : self.position + count]:
            self._publishers[topic].publish(data)
        self.position += count
        for topic, publisher in self._publishers.items():
            assert publisher.wait_for_all_acked(_ACKED_WITHIN), f'{topic}: not acknowledged'
        self.barrier(count)

    def tick(self, seconds: float) -> None:
        """Publish /clock at `seconds` after the start of the bag and wait until every node has it."""
        if self._clock is None:
            self._clock = self.probe.publisher('rosgraph_msgs/msg/Clock', '/clock', match=len(self.processes))
        message = Clock()
        now = self._source.messages[0][1] + round(seconds * NANOSECONDS)
        message.clock.sec, message.clock.nanosec = divmod(now, NANOSECONDS)
        self._clock.publish(message)
        self.barrier(2)

    def barrier(self, messages: int) -> None:
        """Return when nodes that run free have handled their last `messages` messages.

        An executor takes one message of each topic and one request of each service per turn: the answer to
        the n-th request comes after n messages.
        """
        for name in self.processes:
            if name in ('fault_relay', self.stopped) or not self.processes[name].running:
                continue
            client = self.probe.node.create_client(GetParameters, f'{self.full(name)}/get_parameters')
            try:
                self.probe.until(client.service_is_ready, f'services of {name}', process=self.processes[name])
                for _ in range(messages):
                    future = client.call_async(GetParameters.Request(names=['lockstep']))
                    self.probe.until(future.done, f'an answer of {name}', process=self.processes[name])
            finally:
                self.probe.node.destroy_client(client)
