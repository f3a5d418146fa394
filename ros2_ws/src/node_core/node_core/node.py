# SPDX-License-Identifier: Apache-2.0
"""Node bases: WorkspaceNode for every node, EstimatorNode for what is declared as a table of ports."""

from __future__ import annotations

import heapq
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from kalman_core.parameters import parameter
from node_core.diagnostics import InputState, Reporter, Timings
from node_core.driver import EstimatorDriver
from node_core.lockstep import Acknowledger
from node_core.message_types import message_class
from node_core.ports import Input, Output, Ports
from node_core.ros_parameters import NodeParameters
from node_core.spin import leave_at_once

DIAGNOSTICS_PERIOD = 1.0  # s, the rate that diagnostic_aggregator expects
# A clock that goes back by more than this is a bag that loops, not a correction by NTP.
_BACKWARD_JUMP = -0.5  # s
# How often an estimator looks for a backlog: far below any lag window, and too seldom to cost anything.
_BACKLOG_INTERVAL = 20_000_000  # ns

# Compiled kernels load in some tenths of a second; what takes longer is most likely a compilation.
_LOADING = 1.0  # s
_COMPILING = 'preparing kernels; the first start compiles them'


@dataclass(frozen=True, slots=True)
class NodeParams:
    """Parameters that every node has."""

    lockstep: bool = parameter(False, 'acknowledge every processed message, for lock-step replay')
    queue_depth: int = parameter(
        200, 'messages held per topic when the node is busy', unit='messages', minimum=1, maximum=100_000
    )


def reliable(depth: int, *, latched: bool = False) -> QoSProfile:
    """Return a reliable profile: what a filter wants, and compatible with every subscriber."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class WorkspaceNode(Node):
    """A node with parameters from dataclasses, diagnostics at 1 Hz and subscriptions that match any QoS.

    `classes` are the parameter dataclasses; ``self.parameters[Class]`` is the current instance. Subclasses
    override `diagnose` and may call `watch` for inputs whose health is reported.
    """

    def __init__(self, name: str, *classes: type, **kwargs: Any) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **kwargs)
        leave_at_once(self.destroy_node)
        self.parameters = NodeParameters(self, NodeParams, *classes)
        common = self.parameters[NodeParams]
        self.queue_depth: int = common.queue_depth
        self._acknowledger = Acknowledger(self) if common.lockstep else None
        self._downgrades: list[Callable[[], None]] = []
        self._subscribed: dict[str, Subscription] = {}
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        # Diagnostics must go on while simulated time stands still.
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DIAGNOSTICS_PERIOD, self._tick, clock=self.steady_clock)

    def publish_to(self, type_name: str, topic: str, *, latched: bool = False) -> tuple[Any, Any]:
        """Return (publisher, preallocated message) for `topic`."""
        cls = message_class(type_name)
        depth = 1 if latched else self.queue_depth
        return self.create_publisher(cls, topic, reliable(depth, latched=latched)), cls()

    def listen(
        self, type_name: str, topic: str, callback: Callable[[Any], None], *, latched: bool = False
    ) -> None:
        """Subscribe reliably, or as best effort once a publisher turns out to offer no more.

        After `callback` the message is acknowledged when lock-step replay asks for it.
        """
        cls = message_class(type_name)
        acknowledger = self._acknowledger
        if acknowledger is not None:
            resolved = self.resolve_topic_name(topic)
            inner = callback

            def callback(message: Any) -> None:
                inner(message)
                acknowledger.processed(resolved)

        qos = reliable(self.queue_depth, latched=latched)

        def downgrade() -> None:
            self.destroy_subscription(subscription)
            best_effort = QoSProfile(depth=self.queue_depth, reliability=ReliabilityPolicy.BEST_EFFORT)
            self._subscribed[topic] = self.create_subscription(cls, topic, callback, best_effort)
            self.get_logger().info(f"'{topic}': a publisher offers best effort only; subscribed so")

        def incompatible(_event: Any) -> None:
            # The subscription cannot be destroyed from its own event: the next tick does it.
            if downgrade not in self._downgrades:
                self._downgrades.append(downgrade)

        events = SubscriptionEventCallbacks(incompatible_qos=incompatible)
        subscription = self.create_subscription(cls, topic, callback, qos, event_callbacks=events)
        self._subscribed[topic] = subscription

    def _tick(self) -> None:
        for downgrade in self._downgrades:
            downgrade()
        self._downgrades.clear()
        array = self.diagnose()
        if array is not None:
            array.header.stamp = self.get_clock().now().to_msg()
            self._diagnostics.publish(array)

    def diagnose(self) -> DiagnosticArray | None:
        """Return what is to be said on /diagnostics, once a second."""
        return None


class EstimatorNode(WorkspaceNode):
    """The live driver of an estimator: everything is derived from its table of ports."""

    def __init__(self, ports: Ports, name: str | None = None, **kwargs: Any) -> None:
        super().__init__(name or ports.name, ports.params, **kwargs)
        patience = threading.Timer(_LOADING, self.get_logger().info, (_COMPILING,))
        patience.daemon = True
        patience.start()
        try:
            if ports.warm is not None:
                ports.warm()
            self.driver = EstimatorDriver(ports, self.parameters[ports.params])
        finally:
            patience.cancel()
        self._ports = ports
        self._outputs = {id(o): self._publisher_of(o) for o in ports.outputs.values()}
        self._states = {port.topic: InputState(port) for port in ports.inputs}
        self._reporter = Reporter(
            self.get_fully_qualified_name().lstrip('/'), self._states, self.driver.tally
        )
        self._restarts_logged = 0
        self.parameters.on_change(self._parameters_changed)
        self.create_service(Trigger, '~/reset', self._on_reset)
        # Kept: the clock holds only a bare pointer to the handle, and calls into freed memory without it.
        self._jump_handle = self.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(seconds=_BACKWARD_JUMP), on_clock_change=False
            ),
            post_callback=self._on_time_jump,
        )
        self._steps = {port.topic: self._feed(port) for port in ports.inputs}
        self._backlog_sought = 0
        for port in ports.inputs:
            self.listen(port.type, port.topic, self._receive(port.topic))

    def _publisher_of(self, output: Output) -> tuple[Any, Any, Any]:
        publisher, message = self.publish_to(output.type, output.topic, latched=output.latched)
        return publisher.publish, output.encode, message

    def _receive(self, topic: str) -> Callable[[Any], None]:
        """Return the callback of `topic`: its step, after older messages that wait on other topics.

        The executor takes one message per topic and turn. After a stall a 1 Hz sensor would so overtake a
        200 Hz one by the whole backlog, which a filter has to take for a jump of the clock. In lock-step at
        most one message is under way.
        """
        step = self._steps[topic]
        if self._acknowledger is not None or len(self._steps) == 1:
            return step
        clock = time.monotonic_ns

        def callback(message: Any) -> None:
            if clock() - self._backlog_sought < _BACKLOG_INTERVAL:
                step(message)
                return
            for _, waiting_topic, waiting in heapq.merge(
                *(self._waiting(other, message if other == topic else None) for other in self._steps),
                key=lambda entry: entry[0],
            ):
                self._steps[waiting_topic](waiting)
            self._backlog_sought = clock()

        return callback

    def _waiting(self, topic: str, message: Any) -> Iterator[tuple[tuple[int, int], str, Any]]:
        """Yield (stamp, topic, message) of what waits on `topic`, after `message` if one is taken already."""
        subscription = self._subscribed[topic]
        for _ in range(self.queue_depth):
            if message is not None:
                stamp = message.header.stamp
                yield (stamp.sec, stamp.nanosec), topic, message
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            message = taken[0]

    def _feed(self, port: Input) -> Callable[[Any], None]:
        feed = self.driver.feed
        outputs = self._outputs
        state = self._states[port.topic]
        timings: Timings = self._reporter.timings
        clock = time.monotonic_ns

        def callback(message: Any) -> None:
            start = clock()
            for output, estimate in feed(port, message):
                publish, encode, out = outputs[id(output)]
                encode(estimate, out)
                publish(out)
            end = clock()
            state.count += 1
            state.arrived = end
            timings.add(end - start)

        return callback

    def _parameters_changed(self) -> None:
        params = self.parameters[self._ports.params]
        self.driver.estimator.set_params(params)
        self.get_logger().info('parameters changed')

    def _on_reset(self, _request: Any, response: Any) -> Any:
        self.driver.reset()
        self.get_logger().info('reset by service')
        response.success = True
        response.message = 'estimator restarted'
        return response

    def _on_time_jump(self, jump: TimeJump) -> None:
        seconds = jump.delta.nanoseconds * 1e-9
        self.driver.tally.restart(f'clock jumped back by {-seconds:.3f} s')
        self.driver.reset()

    def diagnose(self) -> DiagnosticArray:
        """Report every input, the estimator's own values and the processing time."""
        tally = self.driver.tally
        for reason in tally.restarts[self._restarts_logged :]:
            self.get_logger().warning(f'estimator restarted: {reason}')
        self._restarts_logged = len(tally.restarts)
        own = getattr(self.driver.estimator, 'diagnostics', None)
        return self._reporter.report(own() if own is not None else {})
