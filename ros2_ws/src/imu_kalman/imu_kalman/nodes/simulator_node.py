# SPDX-License-Identifier: Apache-2.0
"""The node that publishes a simulated inertial and magnetic sensor and its true orientation."""

from __future__ import annotations

import math
import time

from diagnostic_msgs.msg import DiagnosticArray

from imu_kalman import sensor_codec as codec
from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation import BLOCK, ImuSimulator
from node_core.diagnostics import OK, WARN, status
from node_core.node import WorkspaceNode

# After a longer pause of the machine old samples are left out: nobody waits for them.
_LONGEST_BURST = 1.0  # s


class ImuSimulatorNode(WorkspaceNode):
    """Every sample has its own deadline on the steady clock, so that the rate cannot drift."""

    def __init__(self) -> None:
        super().__init__('imu_simulator', SimulatorParams)
        self._params = params = self.parameters[SimulatorParams]
        # Taken together: the stamp of a sample is the moment it is due.
        self._started = time.monotonic_ns()
        start = self.get_clock().now().nanoseconds or time.time_ns()
        self._simulator = ImuSimulator(params, start)
        imu, self._imu = self.publish_to(codec.IMU, 'imu/data_raw')
        mag, self._mag = self.publish_to(codec.MAGNETIC_FIELD, 'imu/mag')
        truth, self._truth = self.publish_to(codec.QUATERNION, 'truth/orientation')
        self._publish_imu, self._publish_mag, self._publish_truth = imu.publish, mag.publish, truth.publish
        variances = self._simulator.variances
        codec.prepare_imu(self._imu, params.frame_id, variances.gyro, variances.accel)
        codec.prepare_mag(self._mag, params.frame_id, variances.mag)
        self._truth.header.frame_id = params.world_frame
        self._load()
        self._done = 0
        self._skipped = 0
        self._skipped_before = 0
        self._latest = 0.0
        self.create_timer(1.0 / params.rate, self._publish_due, clock=self.steady_clock)
        self.get_logger().info(f"'{params.motion}' at {params.rate:g} Hz, seed {params.seed}")

    def _load(self) -> None:
        block = self._simulator.take(BLOCK)
        # Python numbers: reading single elements of numpy arrays costs more than publishing.
        self._columns = [
            field.tolist() for field in (block.stamp, block.gyro, block.accel, block.mag, block.quaternion)
        ]
        self._row = 0

    def _publish_due(self) -> None:
        elapsed = (time.monotonic_ns() - self._started) * 1e-9
        rate = self._params.rate
        due = math.floor(elapsed * rate) + 1 - self._done
        if due <= 0:
            return
        self._latest = max(self._latest, elapsed - self._done / rate)
        skip = max(0, due - math.ceil(_LONGEST_BURST * rate))
        for index in range(due):
            if self._row == BLOCK:
                self._load()
            if index >= skip:
                self._publish(self._row)
            self._row += 1
        self._done += due
        self._skipped += skip

    def _publish(self, row: int) -> None:
        stamps, gyro, accel, mag, quaternion = self._columns
        stamp = stamps[row]
        codec.encode_imu(self._imu, stamp, gyro[row], accel[row])
        self._publish_imu(self._imu)
        if math.isfinite(mag[row][0]):
            codec.encode_mag(self._mag, stamp, mag[row])
            self._publish_mag(self._mag)
        codec.encode_orientation(self._truth, stamp, quaternion[row])
        self._publish_truth(self._truth)

    def diagnose(self) -> DiagnosticArray:
        """Report what was published, and by how much the latest sample was late."""
        skipped = self._skipped - self._skipped_before
        self._skipped_before = self._skipped
        level = WARN if skipped else OK
        text = f'{skipped} samples left out: the machine was busy or asleep' if skipped else 'ok'
        values = {'samples': self._done, 'skipped': self._skipped, 'latest_s': self._latest}
        self._latest = 0.0
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, level, text, values)])
