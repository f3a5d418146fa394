# SPDX-License-Identifier: Apache-2.0
"""A whole drive through the joint filter in one compiled loop over the streaming kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ev_velocity import velocity_memory as mem
from ev_velocity.params import VelocityParams
from ev_velocity.scenarios import PULSES, Drive
from ev_velocity.velocity import EPOCH, GPS_SIGMA_FLOOR, kernel_constants, start_memory
from ev_velocity.velocity_kernels import force_step, gear_step
from ev_velocity.velocity_memory import (
    MODELS,
    OUT_ACCELERATION,
    OUT_SPEED,
    OUT_SPEED_VARIANCE,
    N,
    X,
)
from ev_velocity.velocity_updates import count_step, gps_step, speed_step

FORCE, GPS, COUNT, SPEED, GEAR = range(5)


class Series(NamedTuple):
    """Result at every accelerometer sample."""

    speed: np.ndarray  # (n,) m/s
    variance: np.ndarray  # (n,)
    acceleration: np.ndarray  # (n,) m/s²
    states: np.ndarray  # (n, N)
    done: np.ndarray  # (events,) what each sample did, in event order
    memory: np.ndarray  # (SIZE,) at the end

    def learned(self) -> dict[str, float]:
        """Return wheel scale and slip as learned, by name of the parameter that starts them."""
        variances = self.memory[mem.P : mem.P + mem.N**2 : mem.N + 1]
        return {
            'scale': float(self.memory[X + mem.S]),
            'scale_sigma': math.sqrt(variances[mem.S]),
            'slip': max(float(self.memory[X + mem.C]), 0.0),
            'slip_sigma': math.sqrt(variances[mem.C]),
        }


@njit(cache=True, nogil=True)
def _run(m, constants, kinds, times, values, variances, out, states, done):
    h = np.zeros((MODELS, N + 1))
    k = 0
    for i in range(kinds.size):
        kind = kinds[i]
        if kind == FORCE:
            force_step(m, constants, values[i], times[i])
            out[k, 0] = m[OUT_SPEED]
            out[k, 1] = m[OUT_SPEED_VARIANCE]
            out[k, 2] = m[OUT_ACCELERATION]
            states[k, :] = m[X : X + N]
            k += 1
        elif kind == GPS:
            done[i] = gps_step(m, constants, values[i], variances[i], times[i], h)
        elif kind == COUNT:
            done[i] = count_step(m, constants, values[i], times[i], h)
        elif kind == GEAR:
            gear_step(m, constants, values[i], times[i])
        else:
            done[i] = speed_step(m, constants, values[i], variances[i], times[i], h)


def run_drive(params: VelocityParams, drive: Drive) -> Series:
    """Filter a simulated drive."""
    return run(
        params,
        (drive.t, drive.accelerometer),
        gps=(drive.gps_t, drive.gps_v),
        angle=(drive.wheel_t, drive.counts * (2.0 * math.pi / PULSES)),
        gps_sigma=drive.settings.gps_noise,
    )


def run(
    params: VelocityParams,
    force: tuple[np.ndarray, np.ndarray],
    gps: tuple[np.ndarray, np.ndarray] | None = None,
    angle: tuple[np.ndarray, np.ndarray] | None = None,
    wheel_speed: tuple[np.ndarray, np.ndarray] | None = None,
    gear: tuple[np.ndarray, np.ndarray] | None = None,
    gps_sigma: float | None = None,
    wheel_speed_sigma: float | None = None,
) -> Series:
    """Filter a drive given as (times in s, values) of each sensor; the sigmas (m/s) as messages give them."""
    per_radian = params.pulses_per_revolution / (2.0 * math.pi)
    streams = []
    for kind, stream in zip(range(5), (force, gps, angle, wheel_speed, gear)):
        if stream is not None:
            t, v = np.asarray(stream[0], dtype=np.float64), np.asarray(stream[1], dtype=np.float64)
            streams.append((np.full(t.size, kind), np.rint(t * 1e9), v * per_radian if kind == COUNT else v))
    kinds = np.concatenate([s[0] for s in streams])
    times = np.concatenate([s[1] for s in streams])
    values = np.concatenate([s[2] for s in streams])
    order = np.lexsort((kinds, times))
    kinds, times, values = kinds[order], times[order], values[order]
    times = times - times[0] + EPOCH
    sigma = params.gps_sigma if gps_sigma is None else max(gps_sigma, GPS_SIGMA_FLOOR)
    m = start_memory(params)
    n = int(np.count_nonzero(kinds == FORCE))
    out = np.zeros((n, 3))
    states = np.zeros((n, mem.N))
    done = np.zeros(kinds.size, dtype=np.int64)
    wheel_sigma = params.wheel_speed_sigma if wheel_speed_sigma is None else wheel_speed_sigma
    variances = np.where(kinds == SPEED, wheel_sigma * wheel_sigma, sigma * sigma)
    _run(m, kernel_constants(params), kinds, times, values, variances, out, states, done)
    return Series(out[:, 0], out[:, 1], out[:, 2], states, done, m)
