# SPDX-License-Identifier: Apache-2.0
"""Rows from recorded drives, where the recordings are there (ESTIMATOR_DATA)."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bag_tools.bench import Options, Row
from ev_velocity import fusion_batch, velocity_batch
from ev_velocity.can_frames import CanDecoder, load_dbc, replay
from ev_velocity.can_profiles import PROFILES
from ev_velocity.params import FusionParams, VelocityParams
from ev_velocity.recordings import read_can, read_kingston

PACKAGE = 'ev_velocity'
OFF = 1.0  # m/s
MULTIPATH = (755.0, 775.0)  # s
# Beside the wheels' spread: half the step of their signal and its noise.
MARGIN = 0.1  # m/s


def rows(options: Options) -> Iterator[Row]:
    """Measure the recordings; says on stderr which are missing."""
    data = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'ev'
    for name, measure in (('kingston_1800s', _kingston), ('toyota86_can', _toyota)):
        if (data / name).is_dir():
            yield from measure(data / name)
        else:
            print(f'{PACKAGE}: no recording {data / name}: its rows are left out', file=sys.stderr)


def longest(mask: np.ndarray, dt: float) -> float:
    """Return the longest run of True in seconds."""
    best = run = 0
    for value in mask:
        run = run + 1 if value else 0
        best = max(best, run)
    return best * dt


def _kingston(folder: Path) -> Iterator[Row]:
    drive = read_kingston(folder)
    joint = velocity_batch.run(VelocityParams(), drive.force, gps=drive.gps, wheel_speed=drive.obd)
    # One step of this accelerometer is as long as fifty of the paper's.
    fusion = FusionParams(sigma_accelerometer=tuple(50.0 * s for s in FusionParams().sigma_accelerometer))
    fused, _ = fusion_batch.run(fusion, drive.force, drive.gps, drive.obd)
    published, _ = fusion_batch.run(replace(fusion, variant='published'), drive.force, drive.gps, drive.obd)
    t, truth = drive.truth
    errors = {
        name: np.abs(np.interp(t, drive.force[0], speed) - truth)
        for name, speed in (('joint', joint.speed), ('published', published), ('corrected', fused))
    }
    raw = np.abs(np.interp(t, *drive.gps) - truth)

    def row(text: str, figure, bar: float | None, unit: str = 'm/s') -> Row:
        peers = {
            "the paper's fusion as published": figure(errors['published']),
            'corrected': figure(errors['corrected']),
            'GPS': figure(raw),
        }
        return Row(PACKAGE, f'kingston_1800s: {text}', figure(errors['joint']), unit, bar, 'lower', peers)

    yield row('causal RMSE', lambda e: float(np.sqrt(np.mean(e**2))), 0.14)
    yield row('99th percentile of the error', lambda e: float(np.percentile(e, 99)), 0.55)
    yield row('longest time more than 1 m/s off', lambda e: longest(e > OFF, 1.0), 3.0, 's')
    during = (t >= MULTIPATH[0]) & (t <= MULTIPATH[1])
    yield row('largest error through the multipath at 762 s', lambda e: float(e[during].max()), None)


def _toyota(folder: Path) -> Iterator[Row]:
    log, dbc = folder / 'can_sample.candump.log', folder / 'sample_can_spec.dbc'
    frames = list(replay(str(log)))
    decoder = CanDecoder(load_dbc(str(dbc)), PROFILES['toyota86'])
    start = time.process_time()
    for frame in frames:
        decoder.on_frame(*frame)
    busy = time.process_time() - start
    drive = read_can(log, dbc, 'toyota86')
    yield Row(PACKAGE, 'toyota86_can: time to decode over time recorded', busy / drive.duration, '', 1.0)
    t, wheels = drive.wheels
    median = np.median(wheels, axis=1)
    # This car's accelerometer resolves 0.15 m/s², its wheels 0.016 m/s.
    params = replace(VelocityParams(), accelerometer_noise=0.3, wheel_speed_sigma=0.05)
    result = velocity_batch.run(params, drive.force, wheel_speed=(t, median), gear=drive.gear)
    expected = result.acceleration[1:] * np.diff(drive.force[0])
    # A slow accelerometer lets ten steps of 2 ms out at a time.
    steps = np.diff(drive.force[0]) / 0.002
    step = np.abs(np.diff(result.speed) - expected) / np.maximum(steps, 1.0)
    yield Row(PACKAGE, 'toyota86_can: largest output step beyond a·dt, per 2 ms', step.max(), 'm/s', 0.015)
    # The log holds a stretch in reverse; wheels have no sign.
    speed = np.abs(np.interp(t, drive.force[0], result.speed))
    low, high = wheels.min(axis=1) - MARGIN, wheels.max(axis=1) + MARGIN
    share = np.mean((speed >= low) & (speed <= high))
    yield Row(
        PACKAGE, "toyota86_can: time within the wheels' spread ± 0.1 m/s", 100 * share, '%', None, 'higher'
    )
    outside = np.maximum(np.maximum(low - speed, speed - high), 0.0)
    yield Row(PACKAGE, "toyota86_can: furthest outside the wheels' spread", outside.max(), 'm/s')
