# SPDX-License-Identifier: Apache-2.0
"""Rigid body, rotors and battery of the simulated craft, as kernels over flat arrays.

State (22,): position of the centre of mass (ENU, m), velocity (m/s), quaternion ``q_nb``, body rates
(rad/s), rotor speeds (rad/s), gust (m/s), charge drawn (A s), battery voltage (V). Frame ``n`` is ENU.

Sources: Newton and Euler about the centre of mass (or the pivot of the stand); rotor drag across the rotor
axis after Leishman, Abeywardena, IEEE CSM 34(1), 2014; first-order gusts (Ornstein and Uhlenbeck).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from quad_control.craft import (
    PITCH_SIGN,
    ROLL_SIGN,
    YAW_SIGN,
    CraftParams,
    centre_of_mass,
    inertia_about,
    lever,
    total_mass,
)
from quad_control.params import GRAVITY

POSITION, VELOCITY, QUATERNION = slice(0, 3), slice(3, 6), slice(6, 10)
RATES, ROTORS, GUST = slice(10, 13), slice(13, 17), slice(17, 20)
CHARGE, VOLTAGE = 20, 21
STATE_SIZE = 22

# Ground contact as a spring and damper: natural frequency 60 rad/s, damping ratio 0.7, for any mass.
GROUND_STIFFNESS = 3600.0
_GROUND_DAMPING = 84.0
# Feet resist tilting and sliding on the ground: time constant 1/20 s while in contact.
_GROUND_FRICTION = 20.0
# LiPo open-circuit voltage per cell: 4.2 V full, 3.5 V at 5 % left, then steeply down.
_CELL_FULL, _CELL_LOW, _CELL_EMPTY, _KNEE = 4.2, 3.5, 3.0, 0.95


def pack(craft: CraftParams) -> np.ndarray:
    """Return the (64,) array of constants that the kernels read."""
    pivot = np.zeros(3)
    com = centre_of_mass(craft)
    inertia = inertia_about(craft, pivot if craft.pinned else com)
    p = np.zeros(64)
    p[0] = total_mass(craft)
    p[1:4] = com
    p[4] = craft.thrust_coefficient
    p[5] = craft.torque_coefficient
    p[6] = craft.rotor_max
    p[7] = craft.rotor_inertia
    p[8] = craft.motor_time
    p[9] = craft.motor_droop
    p[10] = craft.drag_linear
    p[11] = craft.drag_quadratic
    p[12] = craft.cells
    p[13] = craft.capacity * 3600.0
    p[14] = craft.battery_resistance
    p[15] = craft.power_efficiency
    p[16] = craft.avionics_power
    p[53] = craft.inflow_damping
    p[17] = 1.0 if craft.pinned else 0.0
    p[18] = craft.stand_friction
    p[19:22] = craft.wind
    p[22] = lever(craft)
    p[23:27] = ROLL_SIGN * p[22]
    p[27:31] = -PITCH_SIGN * p[22]
    p[31:35] = YAW_SIGN
    p[35:44] = inertia.ravel()
    p[44:53] = np.linalg.inv(inertia).ravel()
    return p


@njit(cache=True, nogil=True)
def open_circuit_voltage(used, cells):
    """Return the pack voltage (V) without load when the fraction `used` of the charge is gone."""
    if used <= _KNEE:
        return cells * (_CELL_FULL - (_CELL_FULL - _CELL_LOW) * used / _KNEE)
    left = min((used - _KNEE) / (1.0 - _KNEE), 1.0)
    return cells * (_CELL_LOW - (_CELL_LOW - _CELL_EMPTY) * left)


@njit(cache=True, nogil=True)
def rotor_target(duty, voltage, p):
    """Return the steady rotor speed (rad/s) for a duty 0…1 at the battery `voltage` (V)."""
    speed = p[6] * max(duty, 0.0) * voltage / (_CELL_FULL * p[12])
    droop = p[9] / p[6]
    if droop <= 0.0:
        return speed
    return (math.sqrt(1.0 + 4.0 * droop * speed * (1.0 + p[9])) - 1.0) / (2.0 * droop)


@njit(cache=True, nogil=True)
def _derivative(x, target, p, dx, force):
    """Write the time derivative of `x` into `dx` and the non-gravitational force, body axes, into `force`."""
    w, i, j, k = x[6], x[7], x[8], x[9]
    r00 = 1.0 - 2.0 * (j * j + k * k)
    r01 = 2.0 * (i * j - w * k)
    r02 = 2.0 * (i * k + w * j)
    r10 = 2.0 * (i * j + w * k)
    r11 = 1.0 - 2.0 * (i * i + k * k)
    r12 = 2.0 * (j * k - w * i)
    r20 = 2.0 * (i * k - w * j)
    r21 = 2.0 * (j * k + w * i)
    r22 = 1.0 - 2.0 * (i * i + j * j)
    wx, wy, wz = x[10], x[11], x[12]
    pinned = p[17] > 0.5
    mass = p[0]

    # Rotors: thrust along body z at (px, py), reaction torque about z.
    fz = 0.0
    tx, ty, tz = 0.0, 0.0, 0.0
    spin = 0.0
    for m in range(4):
        speed = x[13 + m]
        thrust = p[4] * speed * speed
        acceleration = (target[m] - speed) / p[8]
        dx[13 + m] = acceleration
        px, py = p[27 + m], p[23 + m]
        if not pinned:
            px -= p[1]
            py -= p[2]
        fz += thrust
        tx += py * thrust
        ty -= px * thrust
        # A rotor that pushes the body to +z yaw turns to -z itself.
        tz += p[31 + m] * (p[5] * speed * speed + p[7] * acceleration)
        spin -= p[31 + m] * p[7] * speed

    fx, fy = 0.0, 0.0
    if not pinned:
        ax = x[3] - p[19] - x[17]
        ay = x[4] - p[20] - x[18]
        az = x[5] - p[21] - x[19]
        bx = r00 * ax + r10 * ay + r20 * az
        by = r01 * ax + r11 * ay + r21 * az
        bz = r02 * ax + r12 * ay + r22 * az
        speed = math.sqrt(bx * bx + by * by + bz * bz)
        fx = -(p[10] + p[11] * speed) * bx
        fy = -(p[10] + p[11] * speed) * by
        fz -= (p[53] + p[11] * speed) * bz

    # Euler's equation with the rotors' angular momentum `spin` along z.
    hx = p[35] * wx + p[36] * wy + p[37] * wz
    hy = p[38] * wx + p[39] * wy + p[40] * wz
    hz = p[41] * wx + p[42] * wy + p[43] * wz + spin
    tx -= wy * hz - wz * hy
    ty -= wz * hx - wx * hz
    tz -= wx * hy - wy * hx

    if pinned:
        # Gravity at the centre of mass, which is off the pivot, and friction of the bearing.
        gx, gy, gz = -mass * GRAVITY * r20, -mass * GRAVITY * r21, -mass * GRAVITY * r22
        tx += p[2] * gz - p[3] * gy - p[18] * wx
        ty += p[3] * gx - p[1] * gz - p[18] * wy
        tz += p[1] * gy - p[2] * gx - p[18] * wz
        force[0] = mass * GRAVITY * r20
        force[1] = mass * GRAVITY * r21
        force[2] = mass * GRAVITY * r22
        for m in range(6):
            dx[m] = 0.0
    else:
        nx, ny, nz = 0.0, 0.0, 0.0
        if x[2] < 0.0:
            nz = max(mass * (-GROUND_STIFFNESS * x[2] - _GROUND_DAMPING * x[5]), 0.0)
            nx = -mass * _GROUND_FRICTION * x[3]
            ny = -mass * _GROUND_FRICTION * x[4]
            # Feet push the craft upright: torque along (body z) x (up), 400 rad^2/s^2 stiff.
            tx += p[35] * (400.0 * -r21 - 2.0 * _GROUND_FRICTION * wx)
            ty += p[39] * (400.0 * r20 - 2.0 * _GROUND_FRICTION * wy)
            tz -= p[43] * _GROUND_FRICTION * wz
        force[0] = fx + r00 * nx + r10 * ny + r20 * nz
        force[1] = fy + r01 * nx + r11 * ny + r21 * nz
        force[2] = fz + r02 * nx + r12 * ny + r22 * nz
        dx[0], dx[1], dx[2] = x[3], x[4], x[5]
        dx[3] = (r00 * force[0] + r01 * force[1] + r02 * force[2]) / mass
        dx[4] = (r10 * force[0] + r11 * force[1] + r12 * force[2]) / mass
        dx[5] = (r20 * force[0] + r21 * force[1] + r22 * force[2]) / mass - GRAVITY
    dx[6] = 0.5 * (-i * wx - j * wy - k * wz)
    dx[7] = 0.5 * (w * wx + j * wz - k * wy)
    dx[8] = 0.5 * (w * wy + k * wx - i * wz)
    dx[9] = 0.5 * (w * wz + i * wy - j * wx)
    dx[10] = p[44] * tx + p[45] * ty + p[46] * tz
    dx[11] = p[47] * tx + p[48] * ty + p[49] * tz
    dx[12] = p[50] * tx + p[51] * ty + p[52] * tz


@njit(cache=True, nogil=True)
def advance(x, duty, p, dt):
    """Advance the state `x` (22,) by `dt` (s) with constant motor duties (4,), in place.

    Fourth-order Runge-Kutta; gusts and battery are held over the step.
    """
    target = np.empty(4)
    for m in range(4):
        target[m] = rotor_target(duty[m], x[21], p)
    k1 = np.zeros(17)
    k2 = np.zeros(17)
    k3 = np.zeros(17)
    k4 = np.zeros(17)
    y = x.copy()
    force = np.empty(3)
    _derivative(x, target, p, k1, force)
    for m in range(17):
        y[m] = x[m] + 0.5 * dt * k1[m]
    _derivative(y, target, p, k2, force)
    for m in range(17):
        y[m] = x[m] + 0.5 * dt * k2[m]
    _derivative(y, target, p, k3, force)
    for m in range(17):
        y[m] = x[m] + dt * k3[m]
    _derivative(y, target, p, k4, force)
    for m in range(17):
        x[m] += dt / 6.0 * (k1[m] + 2.0 * k2[m] + 2.0 * k3[m] + k4[m])
    norm = math.sqrt(x[6] ** 2 + x[7] ** 2 + x[8] ** 2 + x[9] ** 2)
    for m in range(6, 10):
        x[m] /= norm
    power = p[16]
    for m in range(4):
        x[13 + m] = max(x[13 + m], 0.0)
        power += p[5] * x[13 + m] ** 3 / p[15]
    current = power / max(x[21], 1.0)
    x[20] = min(x[20] + current * dt, p[13])
    x[21] = open_circuit_voltage(x[20] / p[13], p[12]) - p[14] * current


@njit(cache=True, nogil=True)
def advance_gust(x, sigma, tau, dt, white):
    """Advance the gust (first-order, stationary `sigma` m/s, time `tau` s) with normal draws `white` (3,)."""
    decay = math.exp(-dt / tau)
    spread = sigma * math.sqrt(1.0 - decay * decay)
    for m in range(3):
        x[17 + m] = decay * x[17 + m] + spread * white[m]


@njit(cache=True, nogil=True)
def specific_force(x, p, arm, out):
    """Write specific force (m/s², body) into out[0:3] and angular acceleration (rad/s²) into out[3:6].

    The force is that at `arm` (3,) [m, body] from the point whose motion the state describes; the rotors are
    taken at their present speed.
    """
    target = np.empty(4)
    for m in range(4):
        target[m] = x[13 + m]
    dx = np.zeros(17)
    force = np.empty(3)
    _derivative(x, target, p, dx, force)
    for m in range(3):
        out[m] = force[m] / p[0]
        out[3 + m] = dx[10 + m]
    # Rigid body: Euler's acceleration and the centripetal one, w x (w x r) = w (w·r) - r (w·w).
    wx, wy, wz = x[10], x[11], x[12]
    along = wx * arm[0] + wy * arm[1] + wz * arm[2]
    square = wx * wx + wy * wy + wz * wz
    out[0] += dx[11] * arm[2] - dx[12] * arm[1] + wx * along - arm[0] * square
    out[1] += dx[12] * arm[0] - dx[10] * arm[2] + wy * along - arm[1] * square
    out[2] += dx[10] * arm[1] - dx[11] * arm[0] + wz * along - arm[2] * square
