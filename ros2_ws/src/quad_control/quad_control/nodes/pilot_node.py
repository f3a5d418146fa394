# SPDX-License-Identifier: Apache-2.0
"""A pilot made of parameters: publishes the sticks that `ros2 param set`, the page or a mission ask for."""

from __future__ import annotations

from typing import Any

from std_msgs.msg import String

from node_core.node import WorkspaceNode, reliable
from quad_control import codec
from quad_control.attitude_error import heading
from quad_control.pilot import Pilot, PilotParams
from quad_control.samples import RangeSample


class PilotNode(WorkspaceNode):
    """Publishes `setpoint` at a fixed rate."""

    def __init__(self) -> None:
        super().__init__('pilot', PilotParams)
        self._pilot = Pilot(self.parameters[PilotParams])
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
        self._pilot.height = RangeSample(0, message.range).height

    def _on_truth(self, message: Any) -> None:
        pilot, pose, twist = self._pilot, message.pose.pose, message.twist.twist
        q, linear = pose.orientation, twist.linear
        pilot.position = (pose.position.x, pose.position.y, pose.position.z)
        pilot.velocity = (linear.x, linear.y, linear.z)
        pilot.yaw = heading((q.w, q.x, q.y, q.z))

    def _on_arming(self, message: Any) -> None:
        self._pilot.state = message.data

    def _step(self) -> None:
        setpoint = self._pilot.step(self.get_clock().now().nanoseconds)
        if setpoint is None:
            return
        codec.encode_setpoint(setpoint, self._message)
        self._publish(self._message)


def build_node() -> PilotNode:
    """Return the node."""
    return PilotNode()
