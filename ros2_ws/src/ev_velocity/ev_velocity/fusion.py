# SPDX-License-Identifier: Apache-2.0
"""The paper's fusion as a streaming estimator (002): multirate filters, phases, least-variance mean."""

from __future__ import annotations

import math
from statistics import median
from typing import Any

import numpy as np

from ev_velocity import fusion_kernels as kernels
from ev_velocity.params import FusionParams
from ev_velocity.phases import Phase
from ev_velocity.samples import (
    AngleSample,
    ForceSample,
    FusionEstimate,
    GearSample,
    GpsSample,
    PedalSample,
    SettledFusion,
    WheelRateSample,
    WheelSpeedSample,
)
from ev_velocity.velocity import (
    ANGLE,
    FORCE,
    GEAR,
    GPS,
    NAMES,
    OBD_SPEED,
    PEDALS,
    START_SPEED_SIGMA,
    WHEEL_RATES,
    WHEEL_SPEED,
    origin_of,
)
from kalman_core.event_time import EventTimeBuffer
from kalman_core.health import Tally

SECOND = 1_000_000_000
START_STEP = 0.002  # s, the paper's fast step, until two accelerometer samples have shown it
START_ACCEL_VARIANCE = 1.0  # (m/s²)²
FORCE_LIMIT = 60.0  # m/s²
SPEED_LIMIT = 150.0  # m/s


def kernel_constants(params: FusionParams) -> np.ndarray:
    """Return the array (CONSTANTS,) that the kernels take."""
    c = np.zeros(kernels.CONSTANTS)
    c[kernels.JERK_Q] = c[kernels.ACCEL_Q] = params.jerk_noise**2
    c[kernels.ACCEL_R] = params.accelerometer_noise**2
    c[kernels.WHEEL_R] = params.wheel_noise**2
    c[kernels.GPS_R] = params.gps_noise**2
    c[kernels.A_THRESHOLD] = params.acceleration_threshold
    c[kernels.PEDAL_THRESHOLD] = params.pedal_threshold
    c[kernels.CORRECTED] = float(params.variant == 'corrected')
    c[kernels.STALE] = params.stale_time
    for at, sigmas in (
        (kernels.SIGMA_WHEEL, params.sigma_wheel),
        (kernels.SIGMA_GPS, params.sigma_gps),
        (kernels.SIGMA_ACCEL, params.sigma_accelerometer),
    ):
        c[at : at + len(Phase)] = sigmas
    return c


class _Model:
    def __init__(self, params: FusionParams, tally: Tally) -> None:
        self._tally = tally
        self.origin: int | None = None
        self.prompt: FusionEstimate | None = None
        self.state = np.zeros(kernels.SIZE)
        self.configure(params)
        self.reset()

    def configure(self, params: FusionParams) -> None:
        self.params = params
        self._constants = kernel_constants(params)
        self._handlers = (
            self._force, self._gps, self._angle, self._wheel_speed, self._pedals, self._gear,
            self._wheel_speed, self._wheel_speed,
        )  # fmt: skip

    def reset(self) -> None:
        m = self.state
        m[:] = 0.0
        m[kernels.ACCEL_P] = START_ACCEL_VARIANCE
        m[kernels.PHASE] = Phase.COASTING
        m[kernels.STEP] = START_STEP
        m[kernels.VARIANCE] = START_SPEED_SIGMA**2
        m[kernels.ANGLE_TIME] = -1.0
        self.origin = None

    def apply(self, port: int, sample: Any) -> FusionEstimate | None:
        if self.origin is None:
            self.origin = origin_of(sample.stamp)
        self._tally.accept(NAMES[port], sample.stamp)
        return self._handlers[port](sample, float(sample.stamp - self.origin))

    def _force(self, sample: ForceSample, t: float) -> FusionEstimate:
        speed, variance = kernels.fuse_step(self.state, self._constants, sample.force, t)
        self.prompt = FusionEstimate(sample.stamp, speed, variance)
        return self.prompt

    def _signed(self, speed: float) -> float:
        return -speed if self.state[kernels.DIRECTION] < 0.0 else speed

    def _gps(self, sample: GpsSample, t: float) -> None:
        step = self.state[kernels.STEP]
        r = self._constants[kernels.GPS_R]
        kernels.multirate_sample(self.state, kernels.GPS, self._signed(sample.speed), r, t, step)

    def _angle(self, sample: AngleSample, t: float) -> None:
        m = self.state
        first = m[kernels.ANGLE_TIME] < 0.0
        angle = 0.0 if first else sample.angle - m[kernels.ANGLE]
        elapsed = (t - m[kernels.ANGLE_TIME]) * 1e-9
        # Some encoders count down in reverse; where one turns round, or began anew, it says no speed.
        turned = angle * m[kernels.ANGLE_SENSE] < 0.0
        plausible = abs(angle) * self.params.wheel_radius < SPEED_LIMIT * elapsed
        m[kernels.ANGLE] = sample.angle
        m[kernels.ANGLE_TIME] = t
        if first or not plausible:
            return
        if angle:
            m[kernels.ANGLE_SENSE] = math.copysign(1.0, angle)
        if not turned:
            self._wheel(abs(angle) / elapsed * self.params.wheel_radius, t)

    def _wheel_speed(self, sample: WheelSpeedSample, t: float) -> None:
        self._wheel(sample.speed, t)

    def _wheel(self, speed: float, t: float) -> None:
        z = self._signed(speed / (1.0 + self.params.wheel_scale))
        m = self.state
        r = self._constants[kernels.WHEEL_R]
        kernels.multirate_sample(m, kernels.WHEEL, z, r, t, m[kernels.STEP])

    def _pedals(self, sample: PedalSample, t: float) -> None:
        self.state[kernels.ACCELERATOR] = sample.accelerator
        self.state[kernels.BRAKE] = sample.brake

    def _gear(self, sample: GearSample, t: float) -> None:
        if sample.direction:
            self.state[kernels.DIRECTION] = sample.direction


class FusionEstimator:
    """Speed by the paper's fusion; handlers return None, one estimate or a list.

    `variant`: 'published' counts a slow sample N times and keeps the last phase where no printed rule
    applies; 'corrected' gives a slow sample the noise N·R, every input a phase, and a variance that bounds
    the error's however the errors hang together.
    """

    def __init__(self, params: FusionParams | None = None) -> None:
        params = params or FusionParams()
        self.tally = Tally()
        self._model = _Model(params, self.tally)
        self._settled_output = params.settled_output
        self._prompted = 0
        window = int(params.lag_window * SECOND)
        self._buffer = EventTimeBuffer(self._model, NAMES, self.tally, window=window)

    @property
    def state(self) -> np.ndarray:
        """Everything that changes while filtering; the layout is in `fusion_kernels`."""
        return self._model.state

    def set_params(self, params: FusionParams) -> None:
        """Take new live parameters without a restart."""
        self._model.configure(params)

    def reset(self) -> None:
        """Return to the initial state."""
        self._buffer.reset()
        self._prompted = 0

    def on_force(self, sample: ForceSample) -> Any:
        """Take the accelerometer: the fast sensor, at whose stamps the estimate goes out."""
        return self._feed(FORCE, sample, abs(sample.force) < FORCE_LIMIT)

    def on_gps(self, sample: GpsSample) -> Any:
        """Take a GPS speed."""
        return self._feed(GPS, sample, 0.0 <= sample.speed < SPEED_LIMIT)

    def on_angle(self, sample: AngleSample) -> Any:
        """Take a cumulative encoder angle; its difference is the wheel speed."""
        return self._feed(ANGLE, sample, abs(sample.angle) < 1e12)

    def on_wheel_speed(self, sample: WheelSpeedSample) -> Any:
        """Take a speed signal of the wheels; its magnitude counts."""
        return self._on_speed(WHEEL_SPEED, sample)

    def on_obd_speed(self, sample: WheelSpeedSample) -> Any:
        """Take the speed that OBD says; its magnitude counts."""
        return self._on_speed(OBD_SPEED, sample)

    def on_wheel_rates(self, sample: WheelRateSample) -> Any:
        """Take the turning rates of the wheels: their median counts."""
        rates = [abs(rate) for rate in sample.rates]
        speed = median(rates) * self._model.params.wheel_radius if rates else math.nan
        return self._on_speed(WHEEL_RATES, WheelSpeedSample(sample.stamp, speed))

    def _on_speed(self, port: int, sample: WheelSpeedSample) -> Any:
        sample = sample._replace(speed=abs(sample.speed))
        return self._feed(port, sample, sample.speed < SPEED_LIMIT)

    def on_pedals(self, sample: PedalSample) -> Any:
        """Take the pedals, which name the driving phase."""
        inside = 0.0 <= sample.accelerator <= 1.0 and 0.0 <= sample.brake <= 1.0
        return self._feed(PEDALS, sample, inside)

    def on_gear(self, sample: GearSample) -> Any:
        """Take the sense of travel that the gear selects."""
        return self._feed(GEAR, sample, True)

    def _feed(self, port: int, sample: Any, usable: bool) -> Any:
        if not usable:
            self.tally.reject(NAMES[port], 'not finite or out of range')
            return None
        prompt, settled = self._buffer.feed(port, sample)
        if port == FORCE:
            if prompt is None and sample.stamp > self._prompted:
                # Another sensor's newer sample came first, as from a busy executor: the output is due.
                last = self._model.prompt
                prompt = last if last is not None and last.stamp == sample.stamp else None
            if prompt is not None:
                self._prompted = sample.stamp
        if not settled or not self._settled_output:
            return prompt
        return [*([prompt] if prompt else []), *(SettledFusion(*estimate) for estimate in settled)]


def warm() -> None:
    """Compile or load every kernel."""
    for variant in ('published', 'corrected'):
        estimator = FusionEstimator(FusionParams(variant=variant))
        for stamp in (SECOND, 2 * SECOND, 3 * SECOND):
            estimator.on_gps(GpsSample(stamp, 1.0))
            estimator.on_wheel_speed(WheelSpeedSample(stamp, 1.0))
            estimator.on_force(ForceSample(stamp, 0.0))
