# SPDX-License-Identifier: Apache-2.0
"""The node around the MPU6050 driver."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from functools import cache
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from imu_kalman import sensor_codec as codec
from imu_kalman.fake_mpu6050 import moving_chip_bus
from imu_kalman.i2c import I2cBus, LinuxI2cBus, WrongChipError
from imu_kalman.mpu6050 import ImuReading, Mpu6050Driver
from imu_kalman.mpu6050_calibration import Refused
from imu_kalman.mpu6050_params import Mpu6050Params
from kalman_core.parameters import ParameterError
from node_core.diagnostics import ERROR, OK, WARN, status
from node_core.node import WorkspaceNode
from node_core.spin import EXIT_USAGE

_LEVELS = (OK, WARN, ERROR)


def bus_opener(params: Mpu6050Params) -> Callable[[], I2cBus]:
    """Return what opens the bus of `params`; raise ParameterError when it can never be opened here."""
    if params.bus == 'fake':
        # Made at the first contact: loading kernels must not use up the rest that its motion starts with.
        chip = cache(
            lambda: moving_chip_bus(params.address, params.fake_motion, params.fake_seed, time.monotonic_ns)
        )
        return lambda: chip().open()
    if importlib.util.find_spec('smbus2') is None:
        raise ParameterError(f"parameter 'bus' is {params.bus!r}: this needs the Python package smbus2")
    return lambda: LinuxI2cBus(params.bus)


class Mpu6050Node(WorkspaceNode):
    """Polls the chip and publishes what it gives; never ends on a bus fault."""

    def __init__(self) -> None:
        super().__init__('mpu6050_driver', Mpu6050Params)
        self.exit_code = 0
        self._params = params = self.parameters[Mpu6050Params]
        clock = self.get_clock()
        self.driver = Mpu6050Driver(
            params, bus_opener(params), lambda: clock.now().nanoseconds, time.monotonic_ns
        )
        imu, self._imu = self.publish_to(codec.IMU, 'imu/data_raw')
        temperature, self._temperature = self.publish_to(codec.TEMPERATURE, 'imu/temperature')
        self._publish_imu, self._publish_temperature = imu.publish, temperature.publish
        self._temperature.header.frame_id = params.frame_id
        self._variances: Any = None
        self._next_temperature = 0
        self._readings_before = 0
        self._reported_at = time.monotonic()
        self._said = ''
        self.create_service(Trigger, '~/calibrate', self._on_calibrate)
        self.create_timer(1.0 / params.polls_per_second, self._poll, clock=self.steady_clock)
        self.get_logger().info(
            f'{params.bus} address 0x{params.address:02x}, {params.sample_rate:g} Hz, {params.pacing}'
        )

    def _poll(self) -> None:
        try:
            readings = self.driver.poll()
        except WrongChipError as error:
            self.get_logger().fatal(f'{self._params.bus} {error}')
            self.exit_code = EXIT_USAGE
            self.context.try_shutdown()
            return
        if not readings:
            return
        variances = self.driver.variances
        if variances != self._variances:
            self._variances = variances
            codec.prepare_imu(self._imu, self._params.frame_id, variances.gyro, variances.accel)
        for reading in readings:
            codec.encode_imu(self._imu, reading.stamp, reading.gyro, reading.accel)
            self._publish_imu(self._imu)
        self._tell_temperature(readings[-1])

    def _tell_temperature(self, reading: ImuReading) -> None:
        now = time.monotonic_ns()
        rate = self._params.temperature_rate
        if rate > 0.0 and now >= self._next_temperature:
            codec.encode_temperature(self._temperature, reading.stamp, reading.temperature)
            self._publish_temperature(self._temperature)
            self._next_temperature = now + int(1e9 / rate)

    def _on_calibrate(self, _request: Any, response: Any) -> Any:
        result = self.driver.calibrate()
        response.success = not isinstance(result, Refused)
        if isinstance(result, Refused):
            response.message = f'refused: {result.reason}'
        else:
            bias = ', '.join(f'{b:.5f}' for b in result.bias)
            response.message = f'gyro bias ({bias}) rad/s, 1 sigma {result.variance**0.5:.2g}'
        self.get_logger().info(response.message)
        return response

    def diagnose(self) -> DiagnosticArray:
        """Report the driver's state; say on the console when it changes."""
        values = self.driver.diagnostics()
        level, text = _LEVELS[values.pop('level')], values.pop('message')
        now = time.monotonic()
        readings = self.driver.readings
        rate = (readings - self._readings_before) / max(now - self._reported_at, 1e-3)
        self._readings_before, self._reported_at = readings, now
        # The part before the colon is the state; what follows may change every second.
        state = text.partition(':')[0]
        if state != self._said:
            self._said = state
            self._say(level, text)
        name = self.get_fully_qualified_name().lstrip('/')
        return DiagnosticArray(status=[status(name, level, text, {'rate_hz': rate, **values})])

    def _say(self, level: bytes, text: str) -> None:
        # rclpy fixes the severity per calling line.
        logger = self.get_logger()
        if level == ERROR:
            logger.error(text)
        elif level == WARN:
            logger.warning(text)
        else:
            logger.info(text)

    def destroy_node(self) -> None:
        """Release the bus with the node."""
        self.driver.close()
        super().destroy_node()
