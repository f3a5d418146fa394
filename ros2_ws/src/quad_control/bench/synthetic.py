# SPDX-License-Identifier: Apache-2.0
"""The 10 degree test on plants of this project: the documented linear one, and the stand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quad_control import loops
from quad_control.attitude_filter import AttitudeFilter
from quad_control.attitude_published import ANGLE_PRIOR, RATE_PRIOR, printed_q11, step
from quad_control.controller import AttitudeController
from quad_control.craft import benchmark_craft, benchmark_imu, hover_fraction
from quad_control.flight import StepResult, constant_pilot, fly, step_result
from quad_control.linear_plant import LinearSimulation, documented_plant
from quad_control.params import AttitudeParams, ControllerParams
from quad_control.simulation import QuadSimulator
from quad_control.tuning import PidGains

START = math.radians(10.0)
# The paper's Gaussian noise of its 10 degree test.
NOISE = math.radians(0.05)
_DT = 0.005
# Beyond any rate of a craft (rad/s): nothing is stopped for it.
_ANY_RATE = 100.0


@dataclass(frozen=True)
class ServoCascade:
    """Cascade for the documented plant, whose input moves the rate without integrating it.

    Pole cancellation: the rate PI's zero on the plant's lag, crossover at 0.27 rad of delay; angle gain a
    quarter of it.
    """

    angle_p: float
    rate_p: float
    rate_i: float


def servo_cascade() -> ServoCascade:
    """Return the cascade gains of the documented plant."""
    plant = documented_plant()
    crossover = 0.27 / (plant.delay + 0.5 * plant.period)
    return ServoCascade(crossover / 4.0, crossover * plant.lag / plant.gain, crossover / plant.gain)


def documented_test(gains: PidGains | ServoCascade, seed: int, seconds: float = 8.0) -> StepResult:
    """Run the 10 degree test on the documented plant: noisy angle, the paper's Kalman filter, a controller.

    The PID runs on the filtered angle as the paper has it. The cascade takes its rate from a gyro with the
    benchmark's noise, 0.005 °/s/√Hz.
    """
    rng = np.random.default_rng(seed)
    plant = LinearSimulation(documented_plant(), start=START)
    n = round(seconds / _DT)
    y = np.empty(n)
    x, covariance = np.array([START, 0.0]), np.diag([ANGLE_PRIOR, RATE_PRIOR])
    q11 = printed_q11(0.8, _DT, True)
    state = np.zeros(loops.AXIS_SIZE)
    gyro_noise = math.radians(0.005) * math.sqrt(1.0 / _DT)
    for i in range(n):
        y[i] = plant.output
        if abs(y[i]) > 10.0:
            y[i:] = y[i]
            break
        measured = y[i] + NOISE * rng.standard_normal()
        rate = plant.rate + gyro_noise * rng.standard_normal()
        if isinstance(gains, PidGains):
            step(x, covariance, _DT, 0.8, q11, measured, 8e-4, 0.0, 0.0)
            u = loops.published_step(state, -x[0], gains.kp, gains.ki, gains.kd, 1.0, _DT)
        else:
            step(x, covariance, _DT, 0.8, q11, measured, 8e-4, rate, gyro_noise**2)
            target = -gains.angle_p * x[0]
            u = loops.rate_step(
                state, rate, target, gains.rate_p, gains.rate_i, 0.0, 1.0, 1e3, 0.0, 0.0, 0.0, 3.0, _DT
            )
        plant.advance(u)
    return step_result(np.arange(n) * _DT, y)


def measured_test(gains: PidGains, seed: int, seconds: float = 8.0) -> StepResult:
    """Run the same test with the PID on the noisy angle itself, without the filter's lag."""
    rng = np.random.default_rng(seed)
    plant = LinearSimulation(documented_plant(), start=START)
    n = round(seconds / _DT)
    y = np.empty(n)
    state = np.zeros(loops.AXIS_SIZE)
    for i in range(n):
        y[i] = plant.output
        measured = y[i] + NOISE * rng.standard_normal()
        plant.advance(loops.published_step(state, -measured, gains.kp, gains.ki, gains.kd, 1.0, _DT))
    return step_result(np.arange(n) * _DT, y)


def body_test(
    seed: int, *, pinned: bool, payload: float = 0.0, name: str = 'gyro_driven', controller: str = 'cascade'
) -> StepResult:
    """Run the 10 degree test on the rigid body with the estimator in the loop.

    On the stand the accelerometer's noise is such that its angle has the paper's 0.05°, in free flight it
    is the benchmark's 1 m/s² of vibration.
    """
    errors = benchmark_imu(white_vibration=NOISE * 9.80665 if pinned else 1.0)
    craft = benchmark_craft(payload, pinned=pinned)
    plant = QuadSimulator(craft, errors, seed=seed, roll=START, height=20.0, hovering=True)
    attitude = AttitudeFilter(AttitudeParams(filter=name))
    attitude.start(plant.x[6:10].copy())
    # The published filter's rates are too uncertain to fly on; here it shall show what it does all the same.
    trust = ControllerParams().max_rate_sigma if name == 'gyro_driven' else _ANY_RATE
    flown = AttitudeController(
        ControllerParams(controller=controller, guard_gain_changes=False, max_rate_sigma=trust)
    )
    hover = hover_fraction(craft)
    flown.start_flying(tuple(plant.x[6:10]), hover)
    log = fly(plant, attitude, flown, 4.0, constant_pilot(hover))
    return step_result(log.time, log.truth[:, 0])
