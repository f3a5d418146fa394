# SPDX-License-Identifier: Apache-2.0
"""The joint filter as a streaming estimator: samples in, prompt and settled estimates out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from ev_velocity import velocity_memory as mem
from ev_velocity.params import VelocityParams
from ev_velocity.phases import Phase, classify
from ev_velocity.samples import (
    CONSTANT_NAMES,
    AccelerationEstimate,
    AngleSample,
    ConstantsEstimate,
    ForceSample,
    GearSample,
    GpsSample,
    PedalSample,
    RoadEstimate,
    SettledSpeed,
    SlipEstimate,
    SpeedEstimate,
    WheelRateSample,
    WheelSpeedSample,
)
from ev_velocity.velocity_bank import SPEED_LIMIT
from ev_velocity.velocity_kernels import (
    ACCELERATION_DUE,
    CONSTANTS_DUE,
    ROAD_DUE,
    direction_of,
    force_step,
    gear_step,
    let_out,
    report,
)
from ev_velocity.velocity_updates import count_step, gps_step, speed_step
from kalman_core.event_time import EventTimeBuffer
from kalman_core.health import Tally

SECOND = 1_000_000_000
# Stamps are kept relative to an origin that does not depend on which sample came first; 13 days in ns keep
# late ones positive and all of them exact in a double.
EPOCH = 2**50
START_SPEED_SIGMA = 30.0  # m/s: a car on a road
# What the wheel may turn out to be after it was refused for the lock-out time: another tyre, low pressure.
REOPENED_SCALE_SIGMA = 0.05
# Beyond this, or SPEED_LIMIT, a sample is a fault of the sensor, not of the road.
FORCE_LIMIT = 60.0  # m/s²
# A receiver that claims less than this (m/s) has not counted its own correlated errors.
GPS_SIGMA_FLOOR = 0.02
PHASE_THRESHOLD = 0.15  # m/s², the paper's e_x

FORCE, GPS, ANGLE, WHEEL_SPEED, PEDALS, GEAR, WHEEL_RATES, OBD_SPEED = range(8)
# Diagnostics count by topic.
NAMES = (
    'imu/data_raw', 'gps/speed', 'wheel/encoder', 'vehicle/speed', 'vehicle/pedals', 'vehicle/gear',
    'wheel/states', 'obd/speed',
)  # fmt: skip
# Parameters that a calibration file holds.
CALIBRATED = ('scale', 'scale_sigma', 'slip', 'slip_sigma')
REFUSAL = 'gate'
REFUSAL_OF_WHEEL = 'gate (slip)'
_LEARNED = (mem.B, mem.K, mem.S, mem.C, mem.TG, mem.TW, mem.TS)


def origin_of(stamp: int) -> int:
    """Return the origin (ns) of the kernel's times for a drive whose first sample has `stamp`."""
    return (stamp // EPOCH - 1) * EPOCH


def kernel_constants(params: VelocityParams) -> np.ndarray:
    """Return the array (CONSTANTS,) that the kernels take."""
    c = np.zeros(mem.CONSTANTS)
    values = {
        mem.Q_SPEED: params.accelerometer_noise**2,
        mem.Q_BIAS: params.bias_noise**2,
        mem.Q_GRADE: params.grade_noise**2,
        mem.Q_WHEEL: params.wheel_noise**2,
        mem.Q_DELAY: params.delay_noise**2,
        mem.Q_SCALE: params.scale_noise**2,
        mem.GATE: params.gate,
        mem.TOOTH: 2.0 * math.pi * params.wheel_radius / params.pulses_per_revolution,
        mem.WHEEL_CORRELATION: params.wheel_speed_correlation * SECOND,
        mem.STILL_VARIANCE: params.still_sigma**2,
        mem.STILL_TIME: params.still_time * SECOND,
        mem.STILL_SPEED: params.still_speed,
        mem.LOCKOUT: params.lockout_time * SECOND,
        mem.Q_COAST: params.coast_noise**2,
        mem.BLEED_TIME: params.bleed_time,
        mem.BLEED_STEP: params.bleed_step,
        mem.P0_SCALE: max(params.scale_sigma, REOPENED_SCALE_SIGMA) ** 2,
        mem.P0_SLIP: params.slip_sigma**2,
        mem.MAX_GAP: params.max_gap,
        mem.JERK: params.jerk,
        mem.GPS_DELAY_VARIANCE: params.gps_delay_sigma**2,
        mem.ACCELERATION_PERIOD: SECOND / params.acceleration_rate,
        mem.SPEED_DELAY_VARIANCE: params.speed_delay_sigma**2,
    }
    for index, value in values.items():
        c[index] = value
    return c


def start_memory(params: VelocityParams) -> np.ndarray:
    """Return the memory (SIZE,) before the first sample."""
    x = np.zeros(mem.N)
    sigma = np.zeros(mem.N)
    sigma[mem.V] = START_SPEED_SIGMA
    sigma[mem.B] = params.bias_sigma
    x[mem.K], sigma[mem.K] = params.pitch_gain, params.pitch_gain_sigma
    x[mem.S], sigma[mem.S] = params.scale, params.scale_sigma
    x[mem.C], sigma[mem.C] = params.slip, params.slip_sigma
    x[mem.TG], sigma[mem.TG] = params.gps_delay, params.gps_delay_sigma
    x[mem.TW], sigma[mem.TW] = params.wheel_delay, params.wheel_delay_sigma
    x[mem.TS], sigma[mem.TS] = params.speed_delay, params.speed_delay_sigma
    return mem.fresh(x, sigma**2)


class _Model:
    """What the event-time buffer rolls back: one flat array and pure kernels on it."""

    def __init__(self, params: VelocityParams, tally: Tally) -> None:
        self._scratch = np.zeros((mem.MODELS, mem.N + 1))
        self._tally = tally
        self.origin: int | None = None
        self.prompt: list = []
        self.configure(params)
        self.state = start_memory(params)

    def configure(self, params: VelocityParams) -> None:
        self.params = params
        self._constants = kernel_constants(params)
        self._counts_per_radian = params.pulses_per_revolution / (2.0 * math.pi)
        self._handlers: tuple[Callable[[Any, float], Any], ...] = (
            self._force, self._gps, self._angle, self._wheel_speed, self._pedals, self._gear,
            partial(self._wheel_speed, port=WHEEL_RATES), partial(self._wheel_speed, port=OBD_SPEED),
        )  # fmt: skip

    def reset(self) -> None:
        self.state[:] = start_memory(self.params)
        self.origin = None

    def apply(self, port: int, sample: Any) -> Any:
        if self.origin is None:
            self.origin = origin_of(sample.stamp)
        return self._handlers[port](sample, float(sample.stamp - self.origin))

    def _force(self, sample: ForceSample, t: float) -> list:
        outputs = force_step(self.state, self._constants, sample.force, t)
        self._tally.accept(NAMES[FORCE], sample.stamp)
        self.prompt = self._estimates(sample.stamp, outputs)
        return self.prompt

    def prompt_of(self, stamp: int) -> list | None:
        """Return the estimates of the accelerometer sample of `stamp` if it was the last one applied."""
        return self.prompt if self.prompt and self.prompt[0].stamp == stamp else None

    def _estimates(self, stamp: int, outputs: tuple) -> list:
        speed, variance, acceleration, acceleration_variance, due = outputs
        estimates: list = [SpeedEstimate(stamp, speed, variance)]
        if due:
            if due & ACCELERATION_DUE:
                estimates.append(AccelerationEstimate(stamp, acceleration, acceleration_variance))
            if due & ROAD_DUE:
                m = self.state
                d = mem.P + mem.D * (mem.N + 1)
                estimates.append(RoadEstimate(stamp, float(m[mem.X + mem.D]), float(m[d]), speed, variance))
            if due & CONSTANTS_DUE:
                estimates.append(self.constants(stamp))
        return estimates

    def constants(self, stamp: int) -> ConstantsEstimate:
        m = self.state
        diagonal = np.sqrt(np.maximum(m[mem.P : mem.P + mem.N**2 : mem.N + 1], 0.0))
        return ConstantsEstimate(
            stamp,
            tuple(float(m[mem.X + i]) for i in _LEARNED),
            tuple(float(diagonal[i]) for i in _LEARNED),
        )

    def _gps(self, sample: GpsSample, t: float) -> Any:
        sigma = self.params.gps_sigma
        variance = max(sample.variance, GPS_SIGMA_FLOOR**2) if sample.variance > 0.0 else sigma * sigma
        done = gps_step(self.state, self._constants, sample.speed, variance, t, self._scratch)
        self._book(GPS, sample.stamp, done)
        return self._silent(sample.stamp, t)

    def _angle(self, sample: AngleSample, t: float) -> Any:
        count = sample.angle * self._counts_per_radian
        done = count_step(self.state, self._constants, count, t, self._scratch)
        self._book(ANGLE, sample.stamp, done)
        return [self._slip(sample.stamp, done), *self._silent(sample.stamp, t)]

    def _wheel_speed(self, sample: WheelSpeedSample, t: float, port: int = WHEEL_SPEED) -> Any:
        sigma = self.params.wheel_speed_sigma
        variance = sample.variance if sample.variance > 0.0 else sigma * sigma
        done = speed_step(self.state, self._constants, sample.speed, variance, t, self._scratch)
        self._book(port, sample.stamp, done)
        return [self._slip(sample.stamp, done), *self._silent(sample.stamp, t)]

    def _pedals(self, sample: PedalSample, t: float) -> None:
        self.state[mem.ACCELERATOR] = sample.accelerator
        self.state[mem.BRAKE] = sample.brake
        self._tally.accept(NAMES[PEDALS], sample.stamp)

    def _gear(self, sample: GearSample, t: float) -> None:
        gear_step(self.state, self._constants, float(sample.direction), t)
        self._tally.accept(NAMES[GEAR], sample.stamp)

    def _slip(self, stamp: int, done: int) -> SlipEstimate:
        m = self.state
        direction = direction_of(m)
        phase = classify(
            m[mem.ACCELERATOR], m[mem.BRAKE], m[mem.OUT_ACCELERATION], direction, PHASE_THRESHOLD
        )
        return SlipEstimate(stamp, float(m[mem.SLIP]), Phase(phase), done == mem.REFUSED)

    def _silent(self, stamp: int, t: float) -> list:
        """Give the speed at another sensor's sample while the accelerometer is silent."""
        m = self.state
        if m[mem.FORCE_TIME] >= 0.0 and (t - m[mem.FORCE_TIME]) * 1e-9 <= self.params.max_gap:
            return []
        let_out(m, self._constants, self.params.bleed_time)
        return self._estimates(stamp, report(m, self._constants, t))

    def _book(self, port: int, stamp: int, done: int) -> None:
        name = NAMES[port]
        tally = self._tally
        if done == mem.REFUSED:
            tally.reject(name, REFUSAL if port == GPS else REFUSAL_OF_WHEEL)
            return
        if done == mem.REOPENED and not tally.muted:
            what = 'speed anchored anew' if port == GPS else 'scale learned anew'
            tally.restart(f'{name} refused for too long: {what}')
        nis = float(self.state[mem.NIS])
        tally.accept(name, stamp, nis if nis >= 0.0 else None, self.params.gate)


class VelocityEstimator:
    """Longitudinal speed of a car from accelerometer, wheels, GPS speed, pedals and gear.

    Handlers return None or a list of estimates. Samples may come in any order within `lag_window`.
    """

    def __init__(self, params: VelocityParams | None = None) -> None:
        params = params or VelocityParams()
        self.tally = Tally()
        self._model = _Model(params, self.tally)
        self._settled_output = params.settled_output
        self._prompted = 0
        self._buffer = EventTimeBuffer(self._model, NAMES, self.tally, window=int(params.lag_window * SECOND))

    @property
    def state(self) -> np.ndarray:
        """Everything that changes while filtering (SIZE,); the layout is in `velocity_memory`."""
        return self._model.state

    @property
    def params(self) -> VelocityParams:
        """The parameters in force."""
        return self._model.params

    def set_params(self, params: VelocityParams) -> None:
        """Take new live parameters without a restart; start values have their effect at the next reset.

        What a calibration file keeps stays as it was at the start: the node's own parameters lack it.
        """
        if params.calibration_file:
            params = replace(params, **{name: getattr(self.params, name) for name in CALIBRATED})
        self._model.configure(params)

    def reset(self) -> None:
        """Return to the initial state."""
        self._buffer.reset()
        self._prompted = 0

    def learned(self) -> dict[str, float]:
        """Return wheel scale and slip as learned, by name of the parameter that starts them."""
        learned = self._model.constants(0)
        values = dict(zip(CONSTANT_NAMES, learned.values))
        sigmas = dict(zip(CONSTANT_NAMES, learned.sigmas))
        return {
            'scale': values['wheel_scale'],
            'scale_sigma': sigmas['wheel_scale'],
            'slip': max(values['wheel_slip'], 0.0),
            'slip_sigma': sigmas['wheel_slip'],
        }

    def diagnostics(self) -> dict[str, float]:
        """Return what the filter has learned, and how much its innovations exceed their covariance."""
        learned = self._model.constants(0)
        return dict(zip(CONSTANT_NAMES, learned.values))

    def on_force(self, sample: ForceSample) -> list | None:
        """Take the accelerometer: the fast sensor, at whose stamps the estimate goes out."""
        if not abs(sample.force) < FORCE_LIMIT:
            self.tally.reject(NAMES[FORCE], 'not finite or beyond 60 m/s²')
            return None
        return self._feed(FORCE, sample)

    def on_gps(self, sample: GpsSample) -> list | None:
        """Take a GPS speed."""
        if not 0.0 <= sample.speed < SPEED_LIMIT or not sample.variance < math.inf:
            self.tally.reject(NAMES[GPS], 'speed or variance out of range')
            return None
        return self._feed(GPS, sample)

    def on_angle(self, sample: AngleSample) -> list | None:
        """Take a cumulative encoder angle."""
        if not abs(sample.angle) < 1e12:
            self.tally.reject(NAMES[ANGLE], 'not finite')
            return None
        return self._feed(ANGLE, sample)

    def on_wheel_speed(self, sample: WheelSpeedSample) -> list | None:
        """Take a speed signal of the wheels; its magnitude counts."""
        return self._on_speed(WHEEL_SPEED, sample)

    def on_obd_speed(self, sample: WheelSpeedSample) -> list | None:
        """Take the speed that OBD says; its magnitude counts."""
        return self._on_speed(OBD_SPEED, sample)

    def on_wheel_rates(self, sample: WheelRateSample) -> list | None:
        """Take the turning rates of the wheels: their median counts, so that one wheel may slip."""
        rates = [abs(rate) for rate in sample.rates]
        speed = median(rates) * self.params.wheel_radius if rates else math.nan
        return self._on_speed(WHEEL_RATES, WheelSpeedSample(sample.stamp, speed))

    def _on_speed(self, port: int, sample: WheelSpeedSample) -> list | None:
        if not abs(sample.speed) < SPEED_LIMIT or sample.variance == math.inf:
            self.tally.reject(NAMES[port], 'not finite or out of range')
            return None
        return self._feed(port, sample._replace(speed=abs(sample.speed)))

    def on_pedals(self, sample: PedalSample) -> list | None:
        """Take the pedals, which name the driving phase."""
        if not (0.0 <= sample.accelerator <= 1.0 and 0.0 <= sample.brake <= 1.0):
            self.tally.reject(NAMES[PEDALS], 'outside 0…1')
            return None
        return self._feed(PEDALS, sample)

    def on_gear(self, sample: GearSample) -> list | None:
        """Take the sense of travel that the gear selects."""
        return self._feed(GEAR, sample)

    def _feed(self, port: int, sample: Any) -> list | None:
        prompt, settled = self._buffer.feed(port, sample)
        if port == FORCE:
            if prompt is None and sample.stamp > self._prompted:
                # Another sensor's newer sample came first, as from a busy executor: the output is due.
                prompt = self._model.prompt_of(sample.stamp)
            if prompt is not None:
                self._prompted = sample.stamp
        if not settled or not self._settled_output:
            return prompt
        out = list(prompt) if prompt else []
        for estimates in settled:
            out.extend(SettledSpeed(*e) for e in estimates if type(e) is SpeedEstimate)
        return out


def warm() -> None:
    """Compile or load every kernel."""
    estimator = VelocityEstimator()
    for stamp in (SECOND, 2 * SECOND):
        estimator.on_gps(GpsSample(stamp, 1.0))
        estimator.on_angle(AngleSample(stamp, 0.0))
        estimator.on_wheel_speed(WheelSpeedSample(stamp, 1.0))
        estimator.on_gear(GearSample(stamp, 1))
        estimator.on_force(ForceSample(stamp, 0.0))
