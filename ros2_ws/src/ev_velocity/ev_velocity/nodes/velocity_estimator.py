# SPDX-License-Identifier: Apache-2.0
"""The joint filter as a node; it keeps what it has learned of the wheels in its calibration file."""

import sys

from node_core.spin import run

SAVE_PERIOD = 60.0  # s: what a power cut may lose


def build():
    """Return the node; imports are here so that Ctrl-C while kernels load is clean too."""
    from ev_velocity import calibration
    from ev_velocity.codec import VELOCITY_PORTS
    from kalman_core.parameters import ParameterError
    from node_core.node import EstimatorNode

    class VelocityEstimatorNode(EstimatorNode):
        """The driver of the port table, and the calibration file."""

        def __init__(self):
            super().__init__(VELOCITY_PORTS)
            self.create_timer(SAVE_PERIOD, self._save, clock=self.steady_clock)

        def _save(self):
            try:
                calibration.save(self.driver.estimator)
            except (OSError, ParameterError) as error:
                self.get_logger().error(f'calibration_file not written: {error}')

        def destroy_node(self):
            self._save()
            super().destroy_node()

    return VelocityEstimatorNode()


def main() -> None:
    """Run the node until it is stopped."""
    sys.exit(run(build))
