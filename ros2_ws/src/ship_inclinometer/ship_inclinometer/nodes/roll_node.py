# SPDX-License-Identifier: Apache-2.0
"""The node around the roll analysis: peak hold is reset by a service or by ship/command."""

from __future__ import annotations

from typing import Any

from std_srvs.srv import Trigger

from node_core.node import EstimatorNode
from ship_inclinometer import topics
from ship_inclinometer.codec import ROLL_PORTS


class RollNode(EstimatorNode):
    """Estimator node of ROLL_PORTS."""

    def __init__(self) -> None:
        super().__init__(ROLL_PORTS)
        self.create_service(Trigger, '~/reset_peaks', self._on_reset_peaks)
        self.listen('std_msgs/msg/String', topics.COMMAND, self._on_command)

    def _reset_peaks(self) -> None:
        self.driver.estimator.reset_peaks(self.get_clock().now().nanoseconds)

    def _on_command(self, message: Any) -> None:
        if message.data.split(' ')[0] == 'peak_reset':
            self._reset_peaks()

    def _on_reset_peaks(self, _request: Any, response: Any) -> Any:
        self._reset_peaks()
        response.success = True
        response.message = 'peak hold started anew'
        return response
