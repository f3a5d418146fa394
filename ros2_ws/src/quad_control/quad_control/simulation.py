# SPDX-License-Identifier: Apache-2.0
"""The simulated craft with its sensors: pulses in, IMU, range, battery and truth out. Seeded, no ROS."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from kalman_core.rotation import euler_from_quat, quat_from_euler
from quad_control import plant
from quad_control.craft import CraftParams, ImuErrorParams, centre_of_mass, total_mass
from quad_control.params import GRAVITY
from quad_control.samples import BatterySample, ImuSample, RangeSample, Truth

NANOSECONDS = 1_000_000_000
# Longest integration step (s): 1/24 of the shortest time constant (30 ms motor).
_MAX_STEP = 1.25e-3
# Stamps start here, since a zero stamp means "not set" in ROS.
START_STAMP = NANOSECONDS
# MPU6050 register map: 65.5 LSB/(°/s) at ±500 °/s, 4096 LSB/g at ±8 g.
_GYRO_STEP, _GYRO_RANGE = math.radians(1.0 / 65.5), math.radians(500.0)
_ACCELEROMETER_STEP, _ACCELEROMETER_RANGE = GRAVITY / 4096.0, 8.0 * GRAVITY
# Range finder and battery gauge noise (estimates for a laser range finder and a 10-bit divider).
_RANGE_NOISE, _VOLTAGE_NOISE = 0.01, 0.02


class ImuModel:
    """Turns true rates and specific force into what the sensor says."""

    def __init__(self, errors: ImuErrorParams, rate: float, hover_speed: float, seed: int) -> None:
        self._errors = errors
        self._root_rate = math.sqrt(rate)
        self._hover_speed = hover_speed
        self._rng = np.random.default_rng([seed, 1])
        self.gyro_bias = errors.gyro_bias * self._rng.standard_normal(3)
        self.accelerometer_bias = errors.accelerometer_bias * self._rng.standard_normal(3)
        self._gyro_matrix = np.eye(3) + errors.misalignment * self._rng.standard_normal((3, 3))
        self._accelerometer_matrix = np.eye(3) + errors.misalignment * self._rng.standard_normal((3, 3))
        # One direction and phase of vibration per motor and axis.
        self._direction = self._rng.standard_normal((3, 4)) / math.sqrt(3.0)
        self._phase = self._rng.uniform(0.0, 2.0 * math.pi, 4)

    def turn(self, rotors: np.ndarray, dt: float) -> None:
        """Advance the phase of the rotor vibration by `dt` (s)."""
        self._phase = np.mod(self._phase + rotors * dt, 2.0 * math.pi)

    def sense(self, stamp: int, rates: np.ndarray, force: np.ndarray, rotors: np.ndarray) -> ImuSample:
        """Return one sample for true body rates (rad/s), specific force (m/s²) and rotor speeds (rad/s)."""
        e = self._errors
        draw = self._rng.standard_normal(12)
        self.gyro_bias = self.gyro_bias + e.gyro_walk / self._root_rate * draw[9:12]
        level = (rotors / self._hover_speed) ** 2
        shake = self._direction @ (level * np.sin(self._phase))
        gyro = self._gyro_matrix @ rates + self.gyro_bias
        gyro = gyro + e.gyro_noise * self._root_rate * draw[0:3] + e.gyro_vibration * shake
        force = self._accelerometer_matrix @ force + self.accelerometer_bias
        force = force + e.accelerometer_noise * self._root_rate * draw[3:6] + e.rotor_vibration * shake
        force = force + e.white_vibration * float(level.mean()) * draw[6:9]
        if e.quantise:
            gyro = np.clip(np.round(gyro / _GYRO_STEP) * _GYRO_STEP, -_GYRO_RANGE, _GYRO_RANGE)
            force = np.round(force / _ACCELEROMETER_STEP) * _ACCELEROMETER_STEP
            force = np.clip(force, -_ACCELEROMETER_RANGE, _ACCELEROMETER_RANGE)
        return ImuSample(
            stamp,
            (float(gyro[0]), float(gyro[1]), float(gyro[2])),
            (float(force[0]), float(force[1]), float(force[2])),
        )


class QuadSimulator:
    """One craft. `sense()` measures now, `advance(pulses)` flies one sample period with a new command."""

    def __init__(
        self,
        craft: CraftParams,
        errors: ImuErrorParams,
        *,
        rate: float = 200.0,
        seed: int = 0,
        roll: float = 0.0,
        pitch: float = 0.0,
        height: float = 0.0,
        hovering: bool = False,
    ) -> None:
        self.craft = craft
        self.p = plant.pack(craft)
        self.x = np.zeros(plant.STATE_SIZE)
        self.x[plant.QUATERNION] = quat_from_euler(roll, pitch, 0.0)
        # On the ground the feet are pressed in by the weight: no bounce at start.
        self.x[2] = height if height > 0.0 or craft.pinned else -GRAVITY / plant.GROUND_STIFFNESS
        self.x[plant.VOLTAGE] = plant.open_circuit_voltage(0.0, float(craft.cells))
        self.hover_speed = math.sqrt(total_mass(craft) * GRAVITY / (4.0 * craft.thrust_coefficient))
        duty = 0.0
        if hovering:
            self.x[plant.ROTORS] = self.hover_speed
            duty = self.duty_for(self.hover_speed)
        self.imu = ImuModel(errors, rate, self.hover_speed, seed)
        self._rng = np.random.default_rng([seed, 2])
        self._period = 1.0 / rate
        self._steps = math.ceil(self._period / _MAX_STEP)
        self._tick = 0
        self._duty = np.full(4, duty)
        self._pending: deque[tuple[float, np.ndarray]] = deque()
        self._imu_offset = np.asarray(craft.imu_position) - (0.0 if craft.pinned else centre_of_mass(craft))

    def duty_for(self, speed: float) -> float:
        """Return the duty that holds the rotor `speed` (rad/s) at the present battery voltage."""
        c = self.craft
        loaded = (speed + c.motor_droop * speed**2 / c.rotor_max) / (1.0 + c.motor_droop) / c.rotor_max
        return float(loaded * plant.open_circuit_voltage(0.0, float(c.cells)) / self.x[plant.VOLTAGE])

    @property
    def time(self) -> float:
        """Simulated time since start (s)."""
        return self._tick * self._period

    @property
    def stamp(self) -> int:
        """Stamp of the present sample (ns)."""
        return START_STAMP + round(self._tick * self._period * NANOSECONDS)

    @property
    def euler(self) -> tuple[float, float, float]:
        """True roll, pitch, yaw (rad)."""
        return euler_from_quat(self.x[plant.QUATERNION])

    def sense(self) -> ImuSample:
        """Return the IMU sample of this instant. Call once per period: noise is drawn."""
        out = np.empty(6)
        plant.specific_force(self.x, self.p, self._imu_offset, out)
        return self.imu.sense(self.stamp, self.x[plant.RATES], out[:3], self.x[plant.ROTORS])

    def range(self) -> RangeSample:
        """Return the height over ground that a down-looking range finder corrects for tilt (m)."""
        return RangeSample(
            self.stamp, max(0.0, float(self.x[2] + _RANGE_NOISE * self._rng.standard_normal()))
        )

    def battery(self) -> BatterySample:
        """Return the battery voltage (V)."""
        noise = _VOLTAGE_NOISE * self._rng.standard_normal()
        return BatterySample(self.stamp, float(self.x[plant.VOLTAGE] + noise))

    def truth(self) -> Truth:
        """Return the true state of this instant."""
        x = [float(v) for v in self.x]
        return Truth(
            self.stamp,
            (x[0], x[1], x[2]),
            (x[3], x[4], x[5]),
            (x[6], x[7], x[8], x[9]),
            (x[10], x[11], x[12]),
            (x[13], x[14], x[15], x[16]),
        )

    def advance(self, pulses: Sequence[float] | None) -> None:
        """Fly one sample period; `pulses` (µs) were commanded now, None keeps the last command.

        Raises ValueError for a pulse that is not finite: a real ESC would not get one.
        """
        if pulses is not None:
            duty = (np.asarray(pulses, dtype=float) - 1000.0) / 1000.0
            if duty.shape != (4,) or not np.all(np.isfinite(duty)):
                raise ValueError(f'pulses are {pulses}, expected four finite numbers (us)')
            self._pending.append((self.time + self.craft.command_delay, np.clip(duty, 0.0, 1.0)))
        dt = self._period / self._steps
        gusty = self.craft.gust > 0.0
        for step in range(self._steps):
            now = self.time + step * dt
            # Half a step of tolerance: a delay of exactly one period must not slip to the next step.
            while self._pending and self._pending[0][0] <= now + 0.5 * dt:
                self._duty = self._pending.popleft()[1]
            if gusty:
                white = self._rng.standard_normal(3)
                plant.advance_gust(self.x, self.craft.gust, self.craft.gust_time, dt, white)
            plant.advance(self.x, self._duty, self.p, dt)
        self.imu.turn(self.x[plant.ROTORS], self._period)
        self._tick += 1
