# SPDX-License-Identifier: Apache-2.0
"""The ESC driver as a node: motor commands to the pulses of a PCA9685, and to idle when they cease."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from imu_kalman.fake_bus import FakeBus
from imu_kalman.i2c import I2cBus, LinuxI2cBus
from kalman_core.parameters import ParameterError
from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.node import WorkspaceNode
from node_core.ports import BadMessage
from quad_control import codec
from quad_control.fake_pca9685 import FakePca9685
from quad_control.params import EscParams
from quad_control.pca9685 import Pca9685Driver

# The driver is polled this often per watchdog time, so that a silence ends at most a fifth late.
_POLLS = 5.0
_LEVELS = (OK, WARN, ERROR)


def bus_opener(params: EscParams) -> Callable[[], I2cBus]:
    """Return what opens the bus of `params`; raise ParameterError when it can never be opened here."""
    if params.bus == 'fake':
        return FakeBus({params.address: FakePca9685()}, time.monotonic_ns).open
    if importlib.util.find_spec('smbus2') is None:
        raise ParameterError(f"parameter 'bus' is {params.bus!r}: this needs the Python package smbus2")
    return lambda: LinuxI2cBus(params.bus)


class EscDriverNode(WorkspaceNode):
    """Passes pulses on, says on `esc/pulses` what the motors get, never ends on a bus fault."""

    def __init__(self) -> None:
        super().__init__('esc_driver', EscParams)
        params = self.parameters[EscParams]
        self.driver = Pca9685Driver(params, bus_opener(params), time.monotonic_ns)
        self._rejected = self._fault = ''
        publisher, self._message = self.publish_to(codec.JOINTS, 'esc/pulses')
        self._publish = publisher.publish
        self._said: tuple = ()
        self.listen(codec.JOINTS, 'motors/command', self._on_command)
        self.create_timer(params.watchdog / _POLLS, self._poll, clock=self.steady_clock)
        self.get_logger().info(f'{params.bus} address 0x{params.address:02x}, {params.frequency:g} Hz')

    def _on_command(self, message: Any) -> None:
        try:
            _, pulses = codec.decode_motors(message)
        except BadMessage as error:
            self._rejected = str(error)
            self.driver.rejected += 1
            return
        self.driver.command(pulses)
        self._report()

    def _poll(self) -> None:
        self.driver.poll()
        self._report()
        fault = '' if self.driver.running else self.driver.link.last_fault
        if fault and fault != self._fault:
            self.get_logger().error(f'no contact with the PWM chip: {fault}')
        elif self._fault and not fault:
            self.get_logger().info('the PWM chip answers')
        self._fault = fault

    def _report(self) -> None:
        """Publish the pulses when they have changed."""
        pulses = self.driver.pulses
        if pulses == self._said:
            return
        self._said = pulses
        codec.encode_pulses(self.get_clock().now().nanoseconds, pulses, self._message)
        self._publish(self._message)

    def diagnose(self) -> DiagnosticArray:
        """Report the chip, the pulses and what was rejected."""
        values = self.driver.diagnostics()
        level, text = values.pop('level'), values.pop('message')
        if self._rejected:
            values['last_rejection'] = self._rejected
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, _LEVELS[level], text, values)])

    def destroy_node(self) -> None:
        """Stop the pulses, then the node."""
        self.driver.close()
        super().destroy_node()


def build_node() -> EscDriverNode:
    """Return the node."""
    return EscDriverNode()
