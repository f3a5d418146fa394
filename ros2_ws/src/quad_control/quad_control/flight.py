# SPDX-License-Identifier: Apache-2.0
"""Closed loop without ROS: a plant, the attitude filter and the controller, one sample at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kalman_core.rotation import euler_from_quat
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.samples import Attitude, Event, ImuSample, MotorCommand, Setpoint


class FlyingPlant(Protocol):
    """What can be flown: the own simulator, or another one behind an adapter."""

    @property
    def stamp(self) -> int:
        """Stamp of this instant (ns)."""
        ...

    @property
    def euler(self) -> tuple[float, float, float]:
        """True roll, pitch, yaw (rad)."""
        ...

    def sense(self) -> ImuSample:
        """Measure now."""
        ...

    def advance(self, pulses) -> None:
        """Fly one sample period with these pulses (µs)."""
        ...


@dataclass(frozen=True)
class FlightLog:
    """Arrays over time (n,): s, true and estimated roll, pitch, yaw (n, 3) rad, pulses (n, 4) µs."""

    time: np.ndarray
    truth: np.ndarray
    estimate: np.ndarray
    rate: np.ndarray
    demand: np.ndarray
    pulses: np.ndarray
    events: list[Event]


def fly(
    plant: FlyingPlant,
    attitude: AttitudeFilter,
    controller: AttitudeController,
    seconds: float,
    pilot: Callable[[float], Setpoint | None],
    period: float = 0.005,
    meddle: Callable[[float], None] | None = None,
) -> FlightLog:
    """Fly `seconds`; `pilot(time)` gives a setpoint or None, `meddle(time)` may change anything first."""
    n = round(seconds / period)
    time = np.arange(n) * period
    truth, estimate, rate = np.empty((n, 3)), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    pulses, demand = np.full((n, 4), np.nan), np.full((n, 3), np.nan)
    events: list[Event] = []
    for i in range(n):
        if meddle is not None:
            meddle(float(time[i]))
        truth[i] = plant.euler
        setpoint = pilot(float(time[i]))
        if setpoint is not None:
            controller.on_setpoint(setpoint)
        command = None
        for item in attitude.on_imu(plant.sense()) or []:
            if type(item) is not Attitude:
                continue
            estimate[i], rate[i] = _euler(item), item.rate
            for out in controller.on_attitude(item) or []:
                if isinstance(out, MotorCommand):
                    command = out.pulses
                elif isinstance(out, Event):
                    events.append(out)
        demand[i] = controller.last_demand
        if command is not None:
            pulses[i] = command
        plant.advance(command)
    return FlightLog(time, truth, estimate, rate, demand, pulses, events)


def _euler(item: Attitude) -> tuple[float, float, float]:
    return euler_from_quat(np.array(item.quaternion))


def constant_pilot(throttle: float, roll: float = 0.0, pitch: float = 0.0) -> Callable[[float], Setpoint]:
    """Return a pilot who keeps one demand, armed."""

    def pilot(time: float) -> Setpoint:
        return Setpoint(1 + round(time * 1e9), roll, pitch, 0.0, throttle, True)

    return pilot


@dataclass(frozen=True)
class StepResult:
    """Settling time (s), overshoot (°), RMS after settling (°) of a return to zero."""

    settling: float
    overshoot: float
    residual: float


def step_result(time: np.ndarray, angle: np.ndarray, band: float = np.radians(0.5)) -> StepResult:
    """Return how `angle` (rad) came from its start to zero.

    Settled is the last time outside ±`band`; NaN or a last sample outside counts as never (inf).
    Overshoot is the largest excursion to the other side. The residual starts 0.5 s after settling.
    """
    if not np.all(np.isfinite(angle)):
        return StepResult(np.inf, np.inf, np.inf)
    outside = np.flatnonzero(np.abs(angle) > band)
    overshoot = float(np.degrees(max(0.0, np.max(-np.sign(angle[0]) * angle))))
    if len(outside) and outside[-1] == len(angle) - 1:
        return StepResult(np.inf, overshoot, np.inf)
    settling = float(time[outside[-1] + 1]) if len(outside) else 0.0
    rest = angle[time >= settling + 0.5]
    residual = float(np.degrees(np.sqrt(np.mean(rest**2)))) if len(rest) else np.nan
    return StepResult(settling, overshoot, residual)
