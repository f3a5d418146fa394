# SPDX-License-Identifier: Apache-2.0
"""The step that the live node and the offline runner share: message in, (output, estimate) pairs out."""

from __future__ import annotations

from typing import Any

from kalman_core.health import Tally
from node_core.ports import BadMessage, Input, Output, Ports


class EstimatorDriver:
    """Owns one estimator and feeds it decoded messages.

    An estimator may offer ``tally`` (kalman_core.health.Tally); otherwise one is made, so that rejected
    messages are counted in any case.
    """

    def __init__(self, ports: Ports, params: Any) -> None:
        self.ports = ports
        self.estimator = ports.estimator(params)
        tally = getattr(self.estimator, 'tally', None)
        self.tally: Tally = tally if tally is not None else Tally()
        self._handlers = {p.topic: getattr(self.estimator, p.handler) for p in ports.inputs}

    def feed(self, port: Input, message: Any) -> list[tuple[Output, Any]]:
        """Decode `message`, hand it to the estimator and return what is to be published, in order."""
        try:
            sample = port.decode(message)
        except BadMessage as error:
            self.tally.reject(port.topic, str(error))
            return []
        result = self._handlers[port.topic](sample)
        if result is None:
            return []
        outputs = self.ports.outputs
        if type(result) is list:
            return [(outputs[type(estimate)], estimate) for estimate in result]
        return [(outputs[type(result)], result)]

    def reset(self) -> None:
        """Return the estimator to its initial state."""
        self.estimator.reset()
