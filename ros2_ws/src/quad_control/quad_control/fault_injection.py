# SPDX-License-Identifier: Apache-2.0
"""Faults injected into a flight, and how long it takes until the motors idle or the craft descends."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from imu_kalman.fake_bus import FakeBus, ManualClock
from quad_control.arming import DESCENT, STOPPED
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import CraftParams, ImuErrorParams, hover_fraction
from quad_control.fake_pca9685 import FakePca9685
from quad_control.flight import fly
from quad_control.params import ControllerParams, EscParams
from quad_control.pca9685 import Pca9685Driver
from quad_control.samples import Attitude, BatterySample, ImuSample, MotorCommand, Setpoint
from quad_control.simulation import QuadSimulator

_STEP = 0.005
_HEIGHT = 6.0
# A descent is one when it ends on the ground within this time (s), slower than this (m/s), this level (rad).
_LANDING_TIME, _LANDING_SPEED, _LEVEL = 35.0, 2.5, 0.35
_DESCENT_TIME = 30.0
# The second of two faults comes this much (s) after the first, in the descent.
_LATER = 2.0

STATED = {
    'IMU stops': 0.05,
    'IMU says NaN': 0.05,
    'IMU frozen': 0.05,
    'gyro beyond its range': 0.05,
    'link lost': 0.55,
    'battery low': 3.0,
    'link lost, no range': 0.55,
    'link lost on a low battery': 0.55,
    'link lost, then IMU stops': 0.05,
    'controller killed': 0.065,
}
"""Longest time (s) from each fault to idle motors or the begin of the descent."""
SINKING, FASTEST_SINK = 3.0, 2.5
"""A descent without height that began in a climb sinks after this time (s), no faster than this (m/s)."""


@dataclass(frozen=True)
class Reaction:
    """Time (s) to idle or descent (inf = never), and whether the end was as it should be."""

    seconds: float
    well_ended: bool


def inject(fault: str, seed: int) -> Reaction:
    """Fly in gusts, inject `fault` (a key of STATED) at a random instant and watch the reaction."""
    rng = np.random.default_rng([seed, sum(fault.encode())])
    at = 3.0 + 2.0 * rng.random()
    if fault == 'controller killed':
        return _killed(seed)
    flight = _Flight(seed)
    while flight.time < at:
        flight.step()
    if fault == 'link lost, then IMU stops':
        later = flight.time + _LATER
        while flight.time < later:
            flight.step(link=False)
        return _stop(flight, _drop, link=False)
    if fault in _SPOILT:
        return _stop(flight, _SPOILT[fault]())
    return _descent(
        flight, link='link lost' not in fault, low='low' in fault, ranged=fault != 'link lost, no range'
    )


class _Flight:
    def __init__(self, seed: int) -> None:
        craft = CraftParams(gust=0.5)
        self.plant = QuadSimulator(craft, ImuErrorParams(), seed=seed, height=_HEIGHT, hovering=True)
        self.attitude = AttitudeFilter()
        self.attitude.start(self.plant.x[6:10].copy(), self.plant.imu.gyro_bias)
        # Without a range the time alone ends a descent.
        self.controller = AttitudeController(ControllerParams(descent_time=_DESCENT_TIME))
        self.hover = hover_fraction(craft)
        self.controller.start_flying((1.0, 0.0, 0.0, 0.0), self.hover)
        self.pulses: tuple = (1400.0,) * 4
        self.steps = 0

    @property
    def time(self) -> float:
        return self.steps * _STEP

    def step(
        self,
        spoil: Callable[[ImuSample], ImuSample | None] | None = None,
        link: bool = True,
        low: bool = False,
        ranged: bool = True,
    ) -> None:
        """Fly one sample; the sensors and the pilot answer as told."""
        c, plant = self.controller, self.plant
        if ranged and self.steps % 10 == 0:
            c.on_range(plant.range())
        if self.steps % 40 == 0:
            battery = plant.battery()
            c.on_battery(BatterySample(battery.stamp, 18.5) if low else battery)
        if link and self.steps % 4 == 0:
            c.on_setpoint(Setpoint(plant.stamp, 0.0, 0.0, 0.0, self.hover, True, True))
        sample: ImuSample | None = plant.sense()
        if spoil is not None and sample is not None:
            sample = spoil(sample)
        out: list = []
        if sample is not None:
            for item in self.attitude.on_imu(sample) or []:
                if type(item) is Attitude:
                    out += c.on_attitude(item) or []
        out += c.on_tick(self.time)
        for item in out:
            if isinstance(item, MotorCommand):
                self.pulses = item.pulses
        # An ESC keeps the last pulse it was given.
        plant.advance(self.pulses)
        self.steps += 1


def _stop(flight: _Flight, spoil: Callable[[ImuSample], ImuSample | None], link: bool = True) -> Reaction:
    begin = flight.time
    while flight.time < begin + 1.0:
        flight.step(spoil, link=link)
        if flight.controller.arming.mode == STOPPED and max(flight.pulses) <= 1000.0:
            return Reaction(flight.time - begin, True)
    return Reaction(math.inf, False)


def _descent(flight: _Flight, link: bool, low: bool, ranged: bool) -> Reaction:
    begin = flight.time
    reacted = math.inf
    fastest = tilt = 0.0
    while flight.time < begin + _LANDING_TIME:
        flight.step(link=link, low=low, ranged=ranged)
        mode = flight.controller.arming.mode
        if mode == DESCENT and reacted == math.inf:
            reacted = flight.time - begin
        if mode == STOPPED:
            landed = flight.plant.x[2] < 0.3
            return Reaction(reacted, landed and fastest < _LANDING_SPEED and tilt < _LEVEL)
        fastest = max(fastest, -float(flight.plant.x[5]))
        roll, pitch, _ = flight.plant.euler
        tilt = max(tilt, abs(roll), abs(pitch))
    return Reaction(reacted, False)


class Descent(NamedTuple):
    """Time (s) from its beginning after which it only sinks, inf = never; fastest sink (m/s)."""

    sinking: float
    fastest: float


def lose_link_climbing(
    seed: int, scale: float = 1.0, payload: float = 0.0, climbing: float = 10.0
) -> Descent:
    """Take off in gusts without any height sensor, climb at 2 m/s for `climbing` (s), lose the link.

    `scale` is the true thrust per expected thrust, `payload` in kg. Watches the first 12 s of the descent.
    """
    expected = CraftParams(payload=payload)
    craft = replace(expected, gust=0.5, thrust_coefficient=scale * expected.thrust_coefficient)
    plant = QuadSimulator(craft, ImuErrorParams(), seed=seed)
    controller = AttitudeController()
    lost = 8.0 + climbing
    trim = hover_fraction(craft)
    rates = []

    def pilot(time: float) -> Setpoint | None:
        nonlocal trim
        if round(time / _STEP) % 40 == 0:
            controller.on_battery(plant.battery())
        climb = float(plant.x[5])
        if controller.arming.mode == DESCENT:
            rates.append(climb)
        if time < 3.0:
            return Setpoint(plant.stamp, 0.0, 0.0, 0.0, 0.0, time > 2.0)
        if time >= lost:
            return None
        # A pilot who sees the climb: slow integral, fast proportion.
        error = (1.0 if time < 5.0 else 0.0 if time < 8.0 else 2.0) - climb
        trim += 0.02 * _STEP * error
        return Setpoint(plant.stamp, 0.0, 0.0, 0.0, trim + 0.05 * error, True)

    fly(plant, AttitudeFilter(), controller, lost + 12.5, pilot)
    descent = np.array(rates)
    rising = np.flatnonzero(descent >= 0.0)
    if not len(descent) or (len(rising) and rising[-1] == len(descent) - 1):
        return Descent(math.inf, math.inf)
    return Descent((rising[-1] + 1) * _STEP if len(rising) else 0.0, -float(descent.min()))


def _killed(seed: int) -> Reaction:
    """The commands cease: what does the PWM chip give to the motors?"""

    params = replace(EscParams(), bus='fake')
    clock = ManualClock()
    chip = FakePca9685()
    driver = Pca9685Driver(params, FakeBus({params.address: chip}, clock).open, clock)
    poll = round(params.watchdog / 5.0 * 1e9)
    phase = int(np.random.default_rng([seed, 7]).integers(1, poll))
    for _ in range(400):
        driver.command((1400.0,) * 4)
        clock.advance(_STEP * 1e9)
    clock.advance(phase)
    begin = clock()
    while clock() - begin < 1e9:
        driver.poll()
        pulses = [chip.pulse(int(c), clock()) for c in params.channels]
        # The chip's oscillator and 12 bits move a pulse by less than one count of 0.6 µs.
        if all(p is not None and p <= params.pulse_idle + 1.0 for p in pulses):
            return Reaction((clock() - begin + phase) * 1e-9, True)
        clock.advance(poll)
    return Reaction(math.inf, False)


def _drop(_sample: ImuSample) -> None:
    return None


def _not_a_number(sample: ImuSample) -> ImuSample:
    return sample._replace(rate=(math.nan, 0.0, 0.0))


def _wild(sample: ImuSample) -> ImuSample:
    return sample._replace(rate=(1e4, 0.0, 0.0))


class _Frozen:
    """Repeats the first sample it sees under new stamps."""

    def __init__(self) -> None:
        self._first: ImuSample | None = None

    def __call__(self, sample: ImuSample) -> ImuSample:
        self._first = self._first or sample
        return self._first._replace(stamp=sample.stamp)


_SPOILT: dict[str, Callable[[], Callable[[ImuSample], ImuSample | None]]] = {
    'IMU stops': lambda: _drop,
    'IMU says NaN': lambda: _not_a_number,
    'gyro beyond its range': lambda: _wild,
    'IMU frozen': _Frozen,
}
