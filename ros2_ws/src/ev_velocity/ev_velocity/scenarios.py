# SPDX-License-Identifier: Apache-2.0
"""Named, seeded drives: the settings behind the synthetic figures of this package.

A `Drive` is truth and sensor streams as arrays; times are seconds from the start of the drive. Which signs
the constant errors take, where on the hill the drive starts and where the encoder's teeth stand is drawn
from the seed; sizes are those of the settings.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

RATE = 500.0  # Hz, accelerometer and output
DURATION = 60.0  # s
WHEEL_RADIUS = 0.285  # m, nominal rolling radius
PULSES = 36  # per wheel revolution
PULSE = 2.0 * np.pi * WHEEL_RADIUS / PULSES  # m of road per count at the nominal radius
GRAVITY = 9.80665  # m/s²
JERK_TIME = 0.3  # s, over which the acceleration changes from one phase to the next

# (acceleration m/s², duration s); the last phase brakes to standstill and stays there.
GOOD_ROAD = ((2.0, 6.0), (0.0, 9.0), (-2.2, 2.5), (0.0, 12.0), (1.2, 5.0), (0.0, 8.0), (-2.4, 60.0))
OIL_PATCH = ((1.6, 5.0), (0.0, 35.0), (-2.0, 60.0))


@dataclass(frozen=True, slots=True)
class Settings:
    """Sizes of everything that disturbs the sensors of a drive."""

    phases: tuple[tuple[float, float], ...] = GOOD_ROAD
    gps_rate: float = 10.0  # Hz; 0 is no GPS
    gps_delay: float = 0.15  # s, from validity to stamp
    gps_noise: float = 0.05  # m/s
    outage: tuple[float, float] = (0.0, 0.0)  # s, no GPS between
    multipath: tuple[float, float, float] = (0.0, 0.0, 0.0)  # from s, to s, offset m/s
    wheel_rate: float = 10.0  # Hz
    radius_error: float = 0.01  # relative, sign from the seed
    slip_per_acceleration: float = 0.004  # relative wheel excess per m/s²
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # at s, for s, wheel excess m/s
    bias: float = 0.10  # m/s², sign from the seed
    pitch_gain: float = 0.03  # share of the acceleration that pitch adds to the reading
    grade: float = 0.015  # rise per metre, amplitude
    grade_length: float = 250.0  # m
    accelerometer_noise: float = 0.15  # m/s² per sample
    ripple: float = 0.08  # m/s², amplitude of the drive's ripple
    ripple_frequency: float = 2.0  # Hz


@dataclass(frozen=True, slots=True)
class Drive:
    """Truth at `t` (500 Hz) and the sensor streams; the GPS speed was valid `gps_delay` before its stamp."""

    settings: Settings
    t: np.ndarray  # (n,) s
    v: np.ndarray  # (n,) m/s, truth
    a: np.ndarray  # (n,) m/s², truth
    accelerometer: np.ndarray  # (n,) m/s², specific force along the car
    wheel_speed: np.ndarray  # (n,) m/s, circumference speed at the nominal radius, truth of the wheel
    wheel_t: np.ndarray  # (m,) s
    counts: np.ndarray  # (m,) cumulative encoder counts
    gps_t: np.ndarray  # (k,) s, stamps
    gps_v: np.ndarray  # (k,) m/s
    accelerator: np.ndarray  # (n,) 0…1
    brake: np.ndarray  # (n,) 0…1
    radius_error: float  # signed
    spin: tuple[float, float] = field(default=(0.0, 0.0))  # s, from and to


def acceleration_profile(phases: tuple[tuple[float, float], ...], t: np.ndarray) -> np.ndarray:
    """Return the driver's acceleration (m/s²) at `t`: constant phases joined by ramps of JERK_TIME."""
    a = np.zeros_like(t)
    previous, start = 0.0, 0.0
    for value, duration in phases:
        ramp = np.clip((t - start) / JERK_TIME, 0.0, 1.0)
        inside = t >= start
        a[inside] = (previous + (value - previous) * ramp)[inside]
        previous, start = value, start + duration
    return a


def _motion(settings: Settings, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Integrate the profile; the car stops when the last phase has braked it to zero."""
    a = acceleration_profile(settings.phases, t)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    a = a + settings.ripple * np.sin(2.0 * np.pi * settings.ripple_frequency * t + phase)
    # The ripple starts at an arbitrary phase: it must not drive the car backwards in the first moments.
    v = np.maximum(np.concatenate(([0.0], np.cumsum(a[1:]) / RATE)), 0.0)
    last = sum(duration for _, duration in settings.phases[:-1])
    stopped = np.flatnonzero((t > last) & (v <= 0.0))
    if stopped.size:
        v[stopped[0] :] = 0.0
    return v, np.concatenate(([0.0], np.diff(v) * RATE))


def _spin_excess(settings: Settings, t: np.ndarray, at: float) -> np.ndarray:
    """Return the wheel's excess speed (m/s) on the patch: half a sine."""
    _, duration, excess = settings.spin
    inside = (t >= at) & (t <= at + duration)
    return np.where(inside, excess * np.sin(np.pi * (t - at) / max(duration, 1e-9)), 0.0)


def _gps(settings: Settings, t: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> tuple:
    if settings.gps_rate <= 0.0:
        return np.empty(0), np.empty(0)
    step = round(RATE / settings.gps_rate)
    index = np.arange(rng.integers(0, step), t.size, step)
    stamps = t[index]
    # A receiver gives the length of a velocity: never negative.
    speed = np.abs(
        np.interp(stamps - settings.gps_delay, t, v) + settings.gps_noise * rng.standard_normal(index.size)
    )
    begin, end, offset = settings.multipath
    speed = speed + np.where((stamps >= begin) & (stamps < end), offset, 0.0)
    begin, end = settings.outage
    keep = (stamps < begin) | (stamps >= end)
    return stamps[keep], speed[keep]


def observe(
    settings: Settings,
    seed: int,
    t: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    distance: np.ndarray,
    wheel: np.ndarray,
    grade: np.ndarray,
    accelerator: np.ndarray,
    brake: np.ndarray,
    car: int | None = None,
) -> Drive:
    """Return what the sensors of `settings` see of a motion (all (n,), SI).

    `wheel` is the circumference speed with all slip but that per acceleration, of a wheel of the nominal
    radius; `grade` is added to the road's own. Two drives of one `car` have the same wheels.
    """
    rng = np.random.default_rng(seed)
    wheels = np.random.default_rng((seed if car is None else car, 1))
    radius_error = settings.radius_error * wheels.choice((-1.0, 1.0))
    bias = settings.bias * rng.choice((-1.0, 1.0))
    hill_phase = rng.uniform(0.0, 2.0 * np.pi)
    tooth = rng.uniform(0.0, 1.0)
    grade = grade + settings.grade * np.sin(2.0 * np.pi * distance / settings.grade_length + hill_phase)
    accelerometer = (
        a * (1.0 + settings.pitch_gain)
        + bias
        + GRAVITY * np.sin(np.arctan(grade))
        + settings.accelerometer_noise * rng.standard_normal(t.size)
    )
    spin_at = settings.spin[0] + rng.uniform(-0.5, 0.5)
    wheel = wheel * (1.0 + settings.slip_per_acceleration * a) / (1.0 + radius_error)
    if settings.spin[1] > 0.0:
        wheel = wheel + _spin_excess(settings, t, spin_at)
    step = round(RATE / settings.wheel_rate)
    counts = np.floor(np.cumsum(wheel) / RATE / PULSE + tooth)[::step]
    gps_t, gps_v = _gps(settings, t, v, rng)
    return Drive(
        settings, t, v, a, accelerometer, wheel, t[::step], counts, gps_t, gps_v, accelerator, brake,
        radius_error, (spin_at, spin_at + settings.spin[1]),
    )  # fmt: skip


def simulate(settings: Settings, seed: int, duration: float = DURATION, car: int | None = None) -> Drive:
    """Return one drive of `duration` s under `settings`; two drives of one `car` have the same wheels."""
    t = np.arange(round(duration * RATE) + 1) / RATE
    v, a = _motion(settings, t, np.random.default_rng((seed, 2)))
    distance = np.cumsum(v) / RATE
    planned = acceleration_profile(settings.phases, t)
    moving = v > 0.0
    holding = moving & (np.abs(planned) <= 0.15)
    accelerator = np.where(planned > 0.15, 0.15 + 0.2 * planned, np.where(holding, 0.10, 0.0))
    brake = np.where((planned < -0.5) & moving, np.minimum(1.0, -0.15 * planned), 0.0)
    return observe(settings, seed, t, v, a, distance, v, np.zeros(t.size), accelerator, brake, car)


_OIL = Settings(phases=OIL_PATCH, spin=(20.0, 0.4, 6.0))
SCENARIOS: dict[str, Settings] = {
    'good_road_10hz': Settings(),
    'good_road_1hz': Settings(gps_rate=1.0),
    'good_road_10hz_no_delay': Settings(gps_delay=0.0),
    'good_road_1hz_no_delay': Settings(gps_rate=1.0, gps_delay=0.0),
    'oil_patch_10hz': _OIL,
    'oil_patch_1hz': replace(_OIL, gps_rate=1.0),
    'no_gps': Settings(gps_rate=0.0),
    'gps_outage': Settings(outage=(22.0, 37.0)),
    'multipath': Settings(multipath=(20.0, 27.0, 5.8)),
}


def scenario(name: str, seed: int, car: int | None = None) -> Drive:
    """Return the drive of scenario `name`; raises KeyError with the known names."""
    if name not in SCENARIOS:
        raise KeyError(f"unknown scenario '{name}'; known: {', '.join(SCENARIOS)}")
    return simulate(SCENARIOS[name], seed, car=car)
