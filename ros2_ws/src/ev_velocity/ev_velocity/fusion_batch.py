# SPDX-License-Identifier: Apache-2.0
"""A whole drive through the paper's fusion in one compiled loop over the streaming kernels."""

from __future__ import annotations

import numpy as np
from numba import njit

from ev_velocity.fusion import FusionEstimator, kernel_constants
from ev_velocity.fusion_kernels import (
    ACCELERATOR,
    BRAKE,
    GPS,
    GPS_R,
    SPEED,
    STEP,
    VARIANCE,
    WHEEL,
    WHEEL_R,
    fuse_step,
    multirate_sample,
)
from ev_velocity.params import FusionParams
from ev_velocity.scenarios import PULSE, Drive

# Order of sensors with equal stamps, as the event-time buffer has it.
_FORCE, _GPS, _WHEEL, _PEDALS = range(4)


@njit(cache=True, nogil=True)
def _run(m, constants, kinds, times, values, second, out):
    k = 0
    for i in range(kinds.size):
        kind = kinds[i]
        if kind == _FORCE:
            fuse_step(m, constants, values[i], times[i])
            out[k, 0] = m[SPEED]
            out[k, 1] = m[VARIANCE]
            k += 1
        elif kind == _GPS:
            multirate_sample(m, GPS, values[i], constants[GPS_R], times[i], m[STEP])
        elif kind == _WHEEL:
            multirate_sample(m, WHEEL, values[i], constants[WHEEL_R], times[i], m[STEP])
        else:
            m[ACCELERATOR] = values[i]
            m[BRAKE] = second[i]


def run(
    params: FusionParams,
    force: tuple[np.ndarray, np.ndarray],
    gps: tuple[np.ndarray, np.ndarray],
    wheel: tuple[np.ndarray, np.ndarray],
    pedals: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return speed (n,) and variance (n,) at every accelerometer sample; streams as (times in s, values)."""
    streams = [(_FORCE, *force), (_GPS, *gps), (_WHEEL, wheel[0], wheel[1] / (1.0 + params.wheel_scale))]
    if pedals is not None:
        streams.append((_PEDALS, pedals[0], pedals[1]))
    kinds = np.concatenate([np.full(len(t), kind) for kind, t, _ in streams])
    times = np.concatenate([np.rint(np.asarray(t) * 1e9) for _, t, _ in streams])
    values = np.concatenate([np.asarray(v, dtype=np.float64) for _, _, v in streams])
    second = np.zeros(kinds.size)
    if pedals is not None:
        second[kinds == _PEDALS] = pedals[2]
    order = np.lexsort((kinds, times))
    out = np.zeros((len(force[0]), 2))
    start = FusionEstimator(params).state
    _run(
        start,
        kernel_constants(params),
        kinds[order],
        times[order] - times.min(),
        values[order],
        second[order],
        out,
    )
    return out[:, 0], out[:, 1]


def run_drive(params: FusionParams, drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Fuse a simulated drive."""
    speed = np.diff(drive.counts) * PULSE * drive.settings.wheel_rate
    every = 10  # pedals at 50 Hz, as on the car's bus
    return run(
        params,
        (drive.t, drive.accelerometer),
        (drive.gps_t, drive.gps_v),
        (drive.wheel_t[1:], speed),
        (drive.t[::every], drive.accelerator[::every], drive.brake[::every]),
    )
