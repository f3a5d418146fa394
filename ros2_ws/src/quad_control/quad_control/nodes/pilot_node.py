# SPDX-License-Identifier: Apache-2.0
"""A pilot made of parameters: publishes the sticks that `ros2 param set`, the page or a mission ask for."""

from __future__ import annotations

import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String

from node_core.diagnostics import OK, WARN, status
from node_core.node import WorkspaceNode, reliable
from quad_control import codec
from quad_control.attitude_error import heading
from quad_control.pilot import Pilot, PilotParams

# A range finder that says nothing for this long (s) sees no ground; generous, so that a simulator on a busy
# machine is not taken for one.
_SILENT = 2.0


class PilotNode(WorkspaceNode):
    """Publishes `setpoint` at a fixed rate."""

    def __init__(self) -> None:
        super().__init__('pilot', PilotParams)
        self._pilot = Pilot(self.parameters[PilotParams])
        self._pilot.height = None
        self._seen = -math.inf
        self._said = ''
        self.parameters.on_change(self._changed)
        publisher, self._message = self.publish_to(codec.JOINTS, 'setpoint')
        self._publish = publisher.publish
        self.listen(codec.RANGE, 'range', self._on_range)
        self.listen(codec.ODOMETRY, 'truth/odometry', self._on_truth)
        self.create_subscription(String, 'arming/state', self._on_arming, reliable(1, latched=True))
        self.create_timer(1.0 / self._pilot.params.rate, self._step, clock=self.steady_clock)

    def _changed(self) -> None:
        self._pilot.params = self.parameters[PilotParams]

    def _on_range(self, message: Any) -> None:
        self._seen = self._now()
        self._pilot.on_range(message.range, message.min_range, message.max_range)

    def _on_truth(self, message: Any) -> None:
        pilot, pose, twist = self._pilot, message.pose.pose, message.twist.twist
        q, linear = pose.orientation, twist.linear
        pilot.position = (pose.position.x, pose.position.y, pose.position.z)
        pilot.velocity = (linear.x, linear.y, linear.z)
        pilot.yaw = heading((q.w, q.x, q.y, q.z))

    def _on_arming(self, message: Any) -> None:
        self._pilot.state = message.data

    def _now(self) -> float:
        return self.steady_clock.now().nanoseconds * 1e-9

    def _step(self) -> None:
        if self._now() - self._seen > _SILENT:
            self._pilot.height = None
        setpoint = self._pilot.step(self.get_clock().now().nanoseconds)
        if setpoint is None:
            return
        codec.encode_setpoint(setpoint, self._message)
        self._publish(self._message)

    def diagnose(self) -> DiagnosticArray:
        """Report the mission, and warn when it does not do what it is told."""
        pilot = self._pilot
        trouble = pilot.trouble
        if trouble and trouble != self._said:
            self.get_logger().warning(trouble)
        self._said = trouble
        values = {'mission': pilot.params.mission, 'arming': pilot.state, 'target_m': pilot.target}
        name = self.get_fully_qualified_name().lstrip('/')
        level = WARN if trouble else OK
        return DiagnosticArray(status=[status(name, level, trouble or 'ok', values)])


def build_node() -> PilotNode:
    """Return the node."""
    return PilotNode()
