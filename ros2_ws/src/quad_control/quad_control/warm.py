# SPDX-License-Identifier: Apache-2.0
"""Loads every compiled kernel of the flying path, so that no first sample waits for a compiler."""

from __future__ import annotations

from dataclasses import replace

from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import benchmark_craft, benchmark_imu, hover_fraction
from quad_control.flight import constant_pilot, fly
from quad_control.params import AttitudeParams, ControllerParams
from quad_control.simulation import QuadSimulator

# A still window of 0.1 s and some samples more.
_SECONDS = 0.15
_PERIOD = 0.005  # s


def warm() -> None:
    """Fly a few samples with every filter and controller."""
    craft = benchmark_craft()
    params = ControllerParams()
    for name in ('published', 'corrected'):
        for controller in ('published', 'cascade'):
            plant = QuadSimulator(craft, benchmark_imu(white_vibration=0.0), hovering=True, height=5.0)
            attitude = AttitudeFilter(AttitudeParams(filter=name, calibration_time=0.1))
            flown = AttitudeController(replace(params, controller=controller, notch_frequency=40.0))
            flown.start_flying((1.0, 0.0, 0.0, 0.0), hover_fraction(craft))
            fly(plant, attitude, flown, _SECONDS, constant_pilot(hover_fraction(craft)))
            flown.kill()
            fly(plant, attitude, flown, 2.0 * _PERIOD, constant_pilot(0.0))
