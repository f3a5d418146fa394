# SPDX-License-Identifier: Apache-2.0
"""Typed samples that the estimators take and typed estimates that they give; stamps in ns, SI units."""

from __future__ import annotations

from typing import NamedTuple

from ev_velocity.phases import Phase


class ForceSample(NamedTuple):
    """Specific force along the car (x forward), m/s²: the mean over the interval that ends at `stamp`."""

    stamp: int
    force: float


class GpsSample(NamedTuple):
    """GPS speed over ground, m/s, never negative; `variance` (m/s)², 0 where the receiver gives none."""

    stamp: int
    speed: float
    variance: float = 0.0


class AngleSample(NamedTuple):
    """Cumulative angle of a wheel encoder, rad, in steps of its teeth."""

    stamp: int
    angle: float


class WheelSpeedSample(NamedTuple):
    """Speed that the wheels or the speedometer say, m/s; `variance` (m/s)², 0 where nobody gives one."""

    stamp: int
    speed: float
    variance: float = 0.0


class WheelRateSample(NamedTuple):
    """Turning rates of one or more wheels, rad/s."""

    stamp: int
    rates: tuple[float, ...]


class PedalSample(NamedTuple):
    """Accelerator and brake pedal, 0…1."""

    stamp: int
    accelerator: float
    brake: float


class GearSample(NamedTuple):
    """Sense of travel that the gear selects: 1 forward, −1 reverse, 0 neutral or unknown: the last stays."""

    stamp: int
    direction: int


class SpeedEstimate(NamedTuple):
    """Speed along the car, m/s, and its variance: the prompt output of the joint filter."""

    stamp: int
    speed: float
    variance: float


class SettledSpeed(NamedTuple):
    """The same once everything within the lag window is in."""

    stamp: int
    speed: float
    variance: float


class AccelerationEstimate(NamedTuple):
    """Acceleration along the car without bias, grade and pitch, m/s², and its variance."""

    stamp: int
    acceleration: float
    variance: float


class SlipEstimate(NamedTuple):
    """Slip ratio (v_wheel − v)/max(|v_wheel|, |v|), driving phase, and whether the wheel is refused."""

    stamp: int
    slip: float
    phase: Phase
    slipping: bool


class RoadEstimate(NamedTuple):
    """Distance along the road, m, and speed, with variances."""

    stamp: int
    distance: float
    distance_variance: float
    speed: float
    speed_variance: float


class ConstantsEstimate(NamedTuple):
    """What the filter has learned, and the standard deviations, in the order of CONSTANT_NAMES."""

    stamp: int
    values: tuple[float, ...]
    sigmas: tuple[float, ...]


CONSTANT_NAMES = (
    'bias', 'pitch_gain', 'wheel_scale', 'wheel_slip', 'gps_delay', 'wheel_delay', 'speed_delay',
)  # fmt: skip


class FusionEstimate(NamedTuple):
    """Speed, m/s, by the paper's fusion, and its variance: as printed if published, else a bound."""

    stamp: int
    speed: float
    variance: float


class SettledFusion(NamedTuple):
    """The same once everything within the lag window is in."""

    stamp: int
    speed: float
    variance: float
