# SPDX-License-Identifier: Apache-2.0
"""The attitude controller as a node: ports, a watchdog timer, services, parameters that follow a revert."""

from __future__ import annotations

import time
from typing import Any

from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from node_core.node import EstimatorNode, NodeParams
from quad_control.codec import AXES, CONTROLLER_PORTS
from quad_control.controller import AttitudeController
from quad_control.params import GAINS, ControllerParams

# The watchdog looks this often (s): one look notes an attitude, a later one finds it too old, so motors stop
# within imu_timeout (40 ms at most) and two looks of the last attitude, 50 ms.
_WATCH = 0.005


class AttitudeControllerNode(EstimatorNode):
    """Adds to the ports: ~/arm, ~/kill, ~/autotune_AXIS, ~/apply_proposal and the silence watchdog."""

    def __init__(self) -> None:
        super().__init__(CONTROLLER_PORTS)
        self._controller: AttitudeController = self.driver.estimator
        self.create_service(SetBool, '~/arm', self._on_arm)
        self.create_service(Trigger, '~/kill', self._on_kill)
        for axis in AXES[:3]:
            self.create_service(Trigger, f'~/autotune_{axis}', self._autotune(axis))
        self.create_service(Trigger, '~/apply_proposal', self._on_apply)
        # In lock-step time stands still between messages: silence then means nothing.
        self._lockstep = self.parameters[NodeParams].lockstep
        self.create_timer(_WATCH, self._watch, clock=self.steady_clock)

    def _send(self, estimates: list) -> None:
        for estimate in estimates:
            publish, encode, out = self._outputs[id(self._ports.outputs[type(estimate)])]
            encode(estimate, out)
            publish(out)
            text = getattr(estimate, 'text', '')
            if text:
                self.get_logger().info(f'{estimate.kind}: {text}')

    def _watch(self) -> None:
        if not self._lockstep:
            self._send(self._controller.on_tick(time.monotonic()))
        self._send(self._controller.said())
        self._follow_revert()

    def _follow_revert(self) -> None:
        """Bring the ROS parameters back to the gains that the controller has fallen back to."""
        flown, declared = self._controller.params, self.parameters[ControllerParams]
        if flown == declared:
            return
        changed = [name for name in GAINS if getattr(flown, name) != getattr(declared, name)]
        self.set_parameters_atomically(
            [Parameter(name, Parameter.Type.DOUBLE, getattr(flown, name)) for name in changed]
        )

    def _on_arm(self, request: Any, response: Any) -> Any:
        response.success, response.message = self._controller.arm(request.data)
        return response

    def _on_kill(self, _request: Any, response: Any) -> Any:
        response.success, response.message = True, self._controller.kill()
        return response

    def _autotune(self, axis: str) -> Any:
        def handle(_request: Any, response: Any) -> Any:
            refused = self._controller.autotune(axis)
            response.success = not refused
            response.message = refused or f'relay on {axis}'
            return response

        return handle

    def _on_apply(self, _request: Any, response: Any) -> Any:
        proposal = self._controller.tuning.proposal
        if proposal is None:
            response.success, response.message = False, 'no proposal: run an autotune first'
            return response
        result = self.set_parameters_atomically(
            [Parameter(name, Parameter.Type.DOUBLE, value) for name, value in proposal.items()]
        )
        response.success = result.successful
        response.message = result.reason or ', '.join(f'{k} {v:.4g}' for k, v in proposal.items())
        return response

    def _on_reset(self, request: Any, response: Any) -> Any:
        if self._controller.arming.flying:
            response.success, response.message = False, 'the craft is armed: disarm or kill first'
            return response
        return super()._on_reset(request, response)


def build_node() -> AttitudeControllerNode:
    """Return the node."""
    return AttitudeControllerNode()
