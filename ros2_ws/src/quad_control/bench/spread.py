# SPDX-License-Identifier: Apache-2.0
"""One set of gains on crafts, batteries, sensors and sample rates drawn at random."""

from __future__ import annotations

import math

import numpy as np

from quad_control import plant
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import CraftParams, ImuErrorParams, hover_fraction
from quad_control.flight import constant_pilot, fly, step_result
from quad_control.params import AttitudeParams
from quad_control.simulation import QuadSimulator

# Settled is within this band (rad), wider than the 10 degree test's: there are gusts and a sensor bias here.
BAND = math.radians(1.0)
# A flight succeeds when it settles within this time (s) and swings over by no more than this (°).
SETTLING, OVERSHOOT = 0.6, 2.0
# What a still second leaves of the gyro bias, per axis (rad/s).
_BIAS_LEFT = 1e-3


def craft_of(rng: np.random.Generator) -> tuple[CraftParams, ImuErrorParams, float, float]:
    """Return a craft, its IMU, the sample rate (Hz) and the share of the battery that is used up."""
    inertia = 0.022 * math.exp(rng.uniform(math.log(0.7), math.log(1.5)))
    craft = CraftParams(
        mass=rng.uniform(1.5, 5.2),
        inertia=(inertia, inertia * rng.uniform(0.8, 1.25), 1.73 * inertia),
        motor_time=rng.uniform(0.015, 0.05),
        command_delay=rng.uniform(0.0, 0.01),
        thrust_coefficient=1.11e-5 * rng.uniform(0.8, 1.2),
        battery_resistance=rng.uniform(0.01, 0.04),
        gust=rng.uniform(0.0, 0.7),
    )
    errors = ImuErrorParams(
        gyro_noise=8.7e-5 * rng.uniform(1.0, 5.0),
        gyro_vibration=rng.uniform(0.0, 0.03),
        white_vibration=rng.uniform(0.0, 2.0),
        rotor_vibration=rng.uniform(0.0, 2.0),
        accelerometer_bias=0.03,
    )
    return craft, errors, float(rng.choice([100.0, 200.0, 500.0])), rng.uniform(0.0, 0.85)


def succeeds(seed: int) -> bool:
    """Fly the 10 degree test on a random craft in free flight."""
    rng = np.random.default_rng([seed, 11])
    craft, errors, rate, used = craft_of(rng)
    flown = QuadSimulator(
        craft, errors, rate=rate, seed=seed, roll=math.radians(10.0), height=30.0, hovering=True
    )
    flown.x[plant.CHARGE] = used * 3600.0 * craft.capacity
    flown.x[plant.VOLTAGE] = plant.open_circuit_voltage(used, float(craft.cells))
    attitude, controller = AttitudeFilter(AttitudeParams(period=1.0 / rate)), AttitudeController()
    bias = flown.imu.gyro_bias + _BIAS_LEFT * rng.standard_normal(3)
    attitude.start(flown.x[plant.QUATERNION].copy(), bias, tilt=BAND, bias_sigma=2e-3)
    hover = hover_fraction(craft)
    controller.start_flying((1.0, 0.0, 0.0, 0.0), hover)
    log = fly(
        flown,
        attitude,
        controller,
        2.5,
        constant_pilot(hover),
        period=1.0 / rate,
        meddle=lambda _time: controller.on_battery(flown.battery()),
    )
    found = step_result(log.time, log.truth[:, 0], BAND)
    return found.settling <= SETTLING and found.overshoot <= OVERSHOOT
