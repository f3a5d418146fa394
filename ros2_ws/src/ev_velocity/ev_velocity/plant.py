# SPDX-License-Identifier: Apache-2.0
"""Longitudinal dynamics of a small electric car with two axles and tyre slip.

States: speed v, distance x of the front axle, speed of each axle's wheels. The tyre force is Fz·μ·f(κ)
with the slip κ = (ω·R − v)/max(|v|, |ω·R|, floor) and f(κ) = sin(C·atan(B·κ)) (Pacejka, Tyre and Vehicle
Dynamics, without curvature). The data are those of a Mitsubishi i-MiEV as its maker gives them; inertias,
brake and tyre figures are estimates for a car of its class.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

GRAVITY = 9.80665
SUBSTEPS = 8  # of 0.25 ms in 2 ms: the wheel at rest is stiff
SLIP_FLOOR = 2.0  # m/s, below which the slip is linear in the speed difference


@dataclass(frozen=True, slots=True)
class Car:
    """Data of the car."""

    mass: float = 1155.0  # kg: 1080 and a driver
    radius: float = 0.285  # m
    wheelbase: float = 2.55  # m
    front_share: float = 0.45  # of the weight
    drag_area: float = 0.74  # m², Cd·A
    rolling: float = 0.011  # share of the weight
    motor_torque: float = 180.0  # N·m
    motor_power: float = 47e3  # W
    gear_ratio: float = 7.065
    regeneration: float = 25.0  # N·m at the motor while coasting
    brake_torque: float = 3600.0  # N·m of all wheels at full pedal
    brake_front: float = 0.65
    wheel_inertia: float = 1.4  # kg·m², one axle
    motor_inertia: float = 1.3  # kg·m², seen at the driven axle
    all_wheels_driven: bool = False
    tyre_b: float = 14.0
    tyre_c: float = 1.5

    def array(self) -> np.ndarray:
        """Return the numbers that the kernel takes."""
        return np.array(
            [
                self.mass, self.radius, self.wheelbase, self.front_share,
                0.5 * 1.2 * self.drag_area, self.rolling,
                self.motor_torque, self.motor_power, self.gear_ratio, self.regeneration,
                self.brake_torque, self.brake_front, self.wheel_inertia, self.motor_inertia,
                float(self.all_wheels_driven), self.tyre_b, self.tyre_c,
            ]
        )  # fmt: skip


@njit(cache=True, nogil=True)
def tyre_force(load, friction, wheel, speed, b, c):
    """Return the force (N) of an axle with `load` (N): wheel circumference speed and car speed in m/s."""
    slip = (wheel - speed) / max(abs(speed), abs(wheel), SLIP_FLOOR)
    return load * friction * math.sin(c * math.atan(b * slip))


@njit(cache=True, nogil=True)
def _friction_at(x, patches):
    """Return the friction coefficient at `x` (m); a patch is (from, to, coefficient), the last one counts."""
    value = 1.0
    for i in range(patches.shape[0]):
        if patches[i, 0] <= x < patches[i, 1]:
            value = patches[i, 2]
    return value


@njit(cache=True, nogil=True)
def _grade_at(x, hills):
    """Return the grade (rise per metre) at `x` (m); a hill is (from, to, grade) with ramps of 10 m."""
    value = 0.0
    for i in range(hills.shape[0]):
        up = min(max((x - hills[i, 0]) / 10.0, 0.0), 1.0)
        down = min(max((hills[i, 1] - x) / 10.0, 0.0), 1.0)
        value += hills[i, 2] * min(up, down)
    return value


@njit(cache=True, nogil=True)
def _braked(rate, torque, brake, inertia, dt):
    """Advance a wheel rate (rad/s); a brake stops a wheel but never turns it."""
    free = rate + dt * torque / inertia
    stop = dt * brake / inertia
    if abs(free) <= stop:
        return 0.0
    return free - math.copysign(stop, free)


@njit(cache=True, nogil=True)
def drive(car, targets, limits, patches, hills, abs_slip, dt):
    """Let a driver follow `targets` (n,) m/s with two pedals.

    `limits` (2,): largest accelerator and brake; `abs_slip` > 0 releases the brakes of an axle beyond that
    slip. Returns (n, 8): v, a, x, front and rear wheel speed (m/s), accelerator, brake, grade.
    """
    mass, radius, wheelbase, front_share, drag, rolling = car[0], car[1], car[2], car[3], car[4], car[5]
    out = np.zeros((targets.size, 8))
    h = dt / SUBSTEPS
    v = x = front = rear = integral = 0.0
    accelerator = brake = 0.0
    for k in range(targets.size):
        error = targets[k] - v
        ahead = targets[min(k + 150, targets.size - 1)] - targets[k]  # 0.3 s
        integral = min(max(integral + 0.05 * dt * error, -0.3), 0.3)
        wish = 0.35 * error + 0.18 * ahead / 0.3 + integral
        standing = targets[k] <= 0.0 and v < 0.3
        # A foot moves in about 0.1 s.
        pressed = min(max(wish, 0.0), limits[0]) if not standing else 0.0
        braked = min(max(-wish - 0.05, 0.0), limits[1]) if not standing else 0.3
        accelerator += dt / 0.1 * (pressed - accelerator)
        brake += dt / 0.1 * (braked - brake)
        accelerator = accelerator if accelerator > 1e-3 else 0.0
        brake = brake if brake > 1e-3 else 0.0
        grade = _grade_at(x, hills)
        before = v
        for _ in range(SUBSTEPS):
            motor = max(abs(rear) / radius * car[8], 1.0)
            torque = min(car[6], car[7] / motor) * accelerator
            if accelerator == 0.0 and v > 1.0:
                torque = -car[9]
            torque *= car[8]
            weight = mass * GRAVITY
            front_load = weight * front_share
            rear_load = weight - front_load
            force_f = tyre_force(front_load, _friction_at(x, patches), front, v, car[15], car[16])
            force_r = tyre_force(rear_load, _friction_at(x - wheelbase, patches), rear, v, car[15], car[16])
            brake_f = car[10] * brake * car[11]
            brake_r = car[10] * brake * (1.0 - car[11])
            if abs_slip > 0.0 and v > 2.0:
                brake_f *= 0.0 if (v - front) / v > abs_slip else 1.0
                brake_r *= 0.0 if (v - rear) / v > abs_slip else 1.0
            torque_f = 0.5 * torque * car[14]
            torque_r = torque - torque_f
            inertia_f = car[12] + car[13] * car[14]
            front = radius * _braked(front / radius, torque_f - force_f * radius, brake_f, inertia_f, h)
            rear = radius * _braked(rear / radius, torque_r - force_r * radius, brake_r, car[12] + car[13], h)
            resistance = drag * v * abs(v) + (rolling * weight if v > 0.0 else 0.0)
            slope = weight * grade / math.sqrt(1.0 + grade * grade)
            v += h * (force_f + force_r - resistance - slope) / mass
            if v < 0.0:
                # The driver stands on the brake.
                v = front = rear = 0.0
            x += h * v
        out[k, 0] = v
        out[k, 1] = (v - before) / dt
        out[k, 2] = x
        out[k, 3] = front
        out[k, 4] = rear
        out[k, 5] = accelerator
        out[k, 6] = brake
        out[k, 7] = grade
    return out
