# SPDX-License-Identifier: Apache-2.0
"""rotorpy's Multirotor behind the interface of `quad_control.flight`: a plant that nobody here wrote."""

from __future__ import annotations

import numpy as np
from rotorpy.vehicles.multirotor import Multirotor

from kalman_core.rotation import euler_from_quat, quat_from_euler
from quad_control.craft import YAW_SIGN, CraftParams, ImuErrorParams, lever
from quad_control.simulation import START_STAMP, ImuModel

# Gravity inside rotorpy, m/s².
GRAVITY = 9.81
_FASTEST, _SLOWEST = 1500.0, 80.0


class RotorpyPlant:
    """Hovering with a roll angle at start; duty is rotor speed, one sample of command delay."""

    def __init__(
        self, craft: CraftParams, errors: ImuErrorParams, *, roll: float, seed: int, rate: float = 200.0
    ) -> None:
        d = lever(craft)
        self.hover_speed = float(np.sqrt(craft.mass * GRAVITY / (4.0 * craft.thrust_coefficient)))
        positions = ((d, d, 0.0), (d, -d, 0.0), (-d, d, 0.0), (-d, -d, 0.0))
        params = {
            'mass': craft.mass,
            'Ixx': craft.inertia[0],
            'Iyy': craft.inertia[1],
            'Izz': craft.inertia[2],
            'Ixy': 0.0,
            'Ixz': 0.0,
            'Iyz': 0.0,
            'num_rotors': 4,
            'rotor_pos': {f'r{i + 1}': np.array(p) for i, p in enumerate(positions)},
            'rotor_directions': YAW_SIGN.copy(),
            'rotor_speed_min': _SLOWEST,
            'rotor_speed_max': _FASTEST,
            'k_eta': craft.thrust_coefficient,
            'k_m': craft.torque_coefficient,
            'tau_m': craft.motor_time,
        }
        q = quat_from_euler(roll, 0.0, 0.0)
        self._state = {
            'x': np.zeros(3),
            'v': np.zeros(3),
            'q': np.array([q[1], q[2], q[3], q[0]]),
            'w': np.zeros(3),
            'wind': np.zeros(3),
            'rotor_speeds': np.full(4, self.hover_speed),
        }
        self._craft = Multirotor(params, initial_state=self._state)
        self._imu = ImuModel(errors, rate, self.hover_speed, seed)
        self._period = 1.0 / rate
        self._tick = 0
        self._waiting = np.full(4, self.hover_speed)

    @property
    def hover_fraction(self) -> float:
        """Thrust fraction per motor at hover."""
        return (self.hover_speed / _FASTEST) ** 2

    @property
    def stamp(self) -> int:
        """Stamp of this instant (ns)."""
        return START_STAMP + round(self._tick * self._period * 1e9)

    @property
    def quaternion(self) -> np.ndarray:
        """True ``q_nb`` (wxyz)."""
        x, y, z, w = self._state['q']
        return np.array([w, x, y, z])

    @property
    def euler(self) -> tuple[float, float, float]:
        """True roll, pitch, yaw (rad)."""
        return euler_from_quat(self.quaternion)

    def sense(self):
        """Return the IMU sample of this instant."""
        state = self._state
        force, _ = self._craft.compute_body_wrench(state['w'], state['rotor_speeds'], np.zeros(3))
        return self._imu.sense(self.stamp, state['w'], force / self._craft.mass, state['rotor_speeds'])

    def advance(self, pulses) -> None:
        """Fly one period with the command before this one: the delay of one sample."""
        self._state = self._craft.step(self._state, {'cmd_motor_speeds': self._waiting}, self._period)
        if pulses is not None:
            self._waiting = _FASTEST * (np.asarray(pulses) - 1000.0) / 1000.0
        self._tick += 1
