# SPDX-License-Identifier: Apache-2.0
"""Motions of the roll centre: waves, the paper's plain sine, and turns.

Spectra: DNV-RP-C205, section 3.5.5 (Pierson-Moskowitz, JONSWAP). Second-order roll, pitch and yaw: Perez,
"Ship Motion Control" (2005), chapter 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ship_inclinometer.simulation_params import SimulatorParams

GRAVITY = 9.80665
# Components above this frequency (Hz) hold under 0.1 % of a sea's energy for Tp > 4 s.
_HIGHEST_FREQUENCY = 0.8


@dataclass(frozen=True)
class Motion:
    """Motion of the roll centre; all (N, 3) in SI units, angles roll, pitch, yaw; vectors in ENU."""

    angles: np.ndarray
    angle_rates: np.ndarray
    angle_accelerations: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    speed: np.ndarray
    turn_rate: np.ndarray


def spectrum(params: SimulatorParams, frequency: np.ndarray) -> np.ndarray:
    """Return the elevation's one-sided spectrum [m²/Hz] at `frequency` [Hz] > 0."""
    ratio = frequency * params.peak_period
    base = ratio**-5.0 * np.exp(-1.25 * ratio**-4.0)
    if params.sea == 'jonswap':
        width = np.where(ratio <= 1.0, 0.07, 0.09)
        base = base * params.peak_enhancement ** np.exp(-0.5 * ((ratio - 1.0) / width) ** 2)
    # Scaled to the significant height by its sum rather than by the fitted constant.
    return base * (params.significant_height / 4.0) ** 2 / (np.sum(base) * (frequency[1] - frequency[0]))


def second_order(frequency: np.ndarray, period: float, damping: float) -> np.ndarray:
    """Return the complex answer at `frequency` [Hz] of a system with natural `period` [s] and `damping`."""
    ratio = frequency * period
    return 1.0 / (1.0 - ratio**2 + 2j * damping * ratio)


def sea_motion(params: SimulatorParams, t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Return the motion in an irregular long-crested sea that comes from `params.heading_to_sea`."""
    size = 1 << (len(t) - 1).bit_length()
    step = params.rate / size
    count = min(int(_HIGHEST_FREQUENCY / step), size // 2)
    frequency = step * np.arange(1, count + 1)
    draws = rng.standard_normal((count, 2)) @ [1.0, 1j]
    elevation = np.sqrt(spectrum(params, frequency) * step) * draws
    omega = 2.0 * math.pi * frequency
    slope = 1j * omega**2 / GRAVITY * elevation

    def series(amplitude: np.ndarray, derivative: int = 0) -> np.ndarray:
        bins = np.zeros(size // 2 + 1, complex)
        bins[1 : count + 1] = amplitude * (1j * omega) ** derivative
        return np.fft.irfft(bins, size)[: len(t)] * (size / 2)

    beam, along = (
        abs(math.sin(math.radians(params.heading_to_sea))),
        abs(math.cos(math.radians(params.heading_to_sea))),
    )
    roll = slope * second_order(frequency, params.roll_period, params.roll_damping)
    # Pitch and yaw lag the roll's slope by the sea's phase along the hull, drawn once per sea.
    phase = np.exp(1j * rng.uniform(0.0, 2.0 * math.pi, 2))
    pitch = slope * phase[0] * second_order(frequency, params.pitch_period, params.pitch_damping)
    yaw = slope * phase[1] * second_order(frequency, 1.5 * params.roll_period, 0.5)
    scaled = []
    for amplitude, largest in (
        (roll, params.largest_roll),
        (pitch, params.largest_pitch),
        (yaw, params.largest_yaw),
    ):
        peak = np.max(np.abs(series(amplitude)))
        scaled.append(amplitude * math.radians(largest) / peak)
    angles = [np.column_stack([series(a, d) for a in scaled]) for d in range(3)]
    angles[0][:, 0] += math.radians(params.list_angle)

    surge = (params.surge + (params.sway - params.surge) * along) * 1j * elevation
    sway = params.sway * beam * 1j * elevation
    displaced = (surge, sway, params.heave * elevation)
    velocity, acceleration = (np.column_stack([series(a, d) for a in displaced]) for d in (1, 2))
    zeros = np.zeros(len(t))
    return Motion(angles[0], angles[1], angles[2], velocity, acceleration, zeros, zeros)


def sine_motion(params: SimulatorParams, t: np.ndarray, rng: np.random.Generator) -> Motion:
    """Return the paper's plain sine: roll and sway in phase at `roll_period`, small pitch, yaw and heave."""
    phases = rng.uniform(0.0, 2.0 * math.pi, 3)
    omega = 2.0 * math.pi / params.roll_period
    # Pitch and yaw keep their own rhythm, so that no cross term cancels by chance.
    rows = (
        (params.largest_roll, omega, 0.0),
        (params.largest_pitch, 1.37 * omega, phases[0]),
        (params.largest_yaw, 0.31 * omega, phases[1]),
    )
    angles, rates, accelerations = (np.empty((len(t), 3)) for _ in range(3))
    for i, (amplitude, w, phase) in enumerate(rows):
        a = math.radians(amplitude)
        angles[:, i] = a * np.sin(w * t + phase)
        rates[:, i] = a * w * np.cos(w * t + phase)
        accelerations[:, i] = -a * w * w * np.sin(w * t + phase)
    angles[:, 0] += math.radians(params.list_angle)
    velocity, acceleration = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for i, (amplitude, phase) in ((1, (params.sway, 0.0)), (2, (params.heave, phases[2]))):
        velocity[:, i] = amplitude * omega * np.cos(omega * t + phase)
        acceleration[:, i] = -amplitude * omega**2 * np.sin(omega * t + phase)
    zeros = np.zeros(len(t))
    return Motion(angles, rates, accelerations, velocity, acceleration, zeros, zeros)


def tumble_motion(t: np.ndarray) -> Motion:
    """Return a sensor that is turned slowly by hand through all sides, at one place."""
    turning, nodding, walking = math.radians(20.0), 2.0 * math.pi / 97.0, math.radians(7.0)
    largest = math.radians(75.0)  # not 90°, where roll and yaw cannot be told apart
    zeros = np.zeros(len(t))
    angles = np.column_stack([turning * t, largest * np.sin(nodding * t), walking * t])
    nod = largest * nodding * np.cos(nodding * t)
    rates = np.column_stack([np.full(len(t), turning), nod, np.full(len(t), walking)])
    accelerations = np.column_stack([zeros, -largest * nodding**2 * np.sin(nodding * t), zeros])
    still = np.zeros((len(t), 3))
    return Motion(angles, rates, accelerations, still, still, zeros, zeros)


def manoeuvre(params: SimulatorParams, t: np.ndarray, motion: Motion) -> Motion:
    """Add course, speed and turns: the wave motion keeps its direction relative to the hull."""
    rate = np.zeros(len(t))
    duration = params.turn_angle / params.turn_rate if params.turn_rate > 0.0 else 0.0
    for sign, start in zip((1.0, -1.0), params.turn_starts):
        if start >= 0.0 and duration > 0.0:
            rise = _smooth((t - start) / params.turn_entry)
            fall = _smooth((t - start - duration) / params.turn_entry)
            rate += sign * math.radians(params.turn_rate) * (rise - fall)
    dt = 1.0 / params.rate
    slope = np.gradient(rate, dt)
    course = math.radians(90.0 - params.course) + np.concatenate(
        [[0.0], np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))]
    )
    # Outward heel follows the centripetal acceleration.
    heel = math.radians(params.turn_heel) / math.radians(params.turn_rate) if duration > 0.0 else 0.0
    added = np.column_stack([heel * rate, np.zeros(len(t)), course])
    added_rates = np.column_stack([heel * slope, np.zeros(len(t)), rate])
    added_accelerations = np.column_stack([heel * np.gradient(slope, dt), np.zeros(len(t)), slope])
    cosine, sine = np.cos(course), np.sin(course)

    def turned(vectors: np.ndarray) -> np.ndarray:
        x, y, z = vectors.T
        return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z])

    speed = np.full(len(t), params.speed)
    ahead = np.column_stack([cosine * speed, sine * speed, np.zeros(len(t))])
    inward = np.column_stack([-sine * speed * rate, cosine * speed * rate, np.zeros(len(t))])
    level = np.zeros(3)
    level[2] = 1.0
    coriolis = np.cross(level * rate[:, None], turned(motion.velocity))
    return replace(
        motion,
        angles=motion.angles + added,
        angle_rates=motion.angle_rates + added_rates,
        angle_accelerations=motion.angle_accelerations + added_accelerations,
        velocity=turned(motion.velocity) + ahead,
        acceleration=turned(motion.acceleration) + coriolis + inward,
        speed=speed,
        turn_rate=rate,
    )


def _smooth(x: np.ndarray) -> np.ndarray:
    """Return a step from 0 to 1 over 0 <= x <= 1 with two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0))
