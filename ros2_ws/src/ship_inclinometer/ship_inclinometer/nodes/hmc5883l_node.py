# SPDX-License-Identifier: Apache-2.0
"""The node around the HMC5883L driver."""

from __future__ import annotations

import importlib.util
import time
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray

from imu_kalman.fake_bus import FakeBus
from imu_kalman.i2c import LinuxI2cBus, WrongChipError
from kalman_core.parameters import ParameterError
from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.messages import set3, set_stamp
from node_core.node import WorkspaceNode
from node_core.spin import EXIT_USAGE
from ship_inclinometer import topics
from ship_inclinometer.codec import FIELD
from ship_inclinometer.fake_hmc5883l import FakeHmc5883l
from ship_inclinometer.hmc5883l import ADDRESS, Hmc5883lDriver, SelfTestError
from ship_inclinometer.hmc5883l_params import Hmc5883lParams

_LEVELS = (OK, WARN, ERROR)
# Field (T) that a simulated chip lies in: 48 µT, dip 55°, bow to north.
_FAKE_FIELD = np.array([27.5e-6, 0.0, -39.3e-6])


class Hmc5883lNode(WorkspaceNode):
    """Polls the chip and publishes imu/mag; never ends on a bus fault."""

    def __init__(self) -> None:
        super().__init__('hmc5883l_driver', Hmc5883lParams)
        self.exit_code = 0
        self._said = ''
        self._params: Hmc5883lParams = self.parameters[Hmc5883lParams]
        clock = self.get_clock()
        self.driver = Hmc5883lDriver(
            self._params, self._opener(), lambda: clock.now().nanoseconds, time.monotonic_ns
        )
        self._publisher, self._message = self.publish_to(FIELD, topics.MAG)
        self._message.header.frame_id = self._params.frame_id
        self.create_timer(self.driver.poll_period, self._poll, clock=self.steady_clock)

    def _opener(self) -> Any:
        if self._params.bus == 'fake':
            chip = FakeHmc5883l(lambda _seconds: _FAKE_FIELD, start=time.monotonic_ns())
            return FakeBus({ADDRESS: chip}, time.monotonic_ns).open
        if importlib.util.find_spec('smbus2') is None:
            raise ParameterError(
                f"parameter 'bus' is {self._params.bus!r}: this needs the Python package smbus2"
            )
        return lambda: LinuxI2cBus(self._params.bus)

    def _poll(self) -> None:
        try:
            readings = self.driver.poll()
        except (WrongChipError, SelfTestError) as error:
            self.get_logger().fatal(f'{self._params.bus} {error}')
            self.exit_code = EXIT_USAGE
            self.context.try_shutdown()
            return
        for reading in readings:
            set_stamp(self._message.header, reading.stamp)
            set3(self._message.magnetic_field, reading.field)
            self._message.magnetic_field_covariance = np.diag([self.driver.variance] * 3).ravel()
            self._publisher.publish(self._message)

    def diagnose(self) -> DiagnosticArray:
        """Report the driver's state."""
        values = self.driver.diagnostics()
        level, text = _LEVELS[values.pop('level')], values.pop('message')
        if text != self._said:
            # A call site of rclpy's logger keeps its severity.
            if level == OK or not self._said:
                self.get_logger().info(f'{self._params.bus}: {text}')
            else:
                self.get_logger().warning(f'{self._params.bus}: {text}')
            self._said = text
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, level, text, values)])

    def destroy_node(self) -> None:
        """Release the bus with the node."""
        self.driver.close()
        super().destroy_node()
