# SPDX-License-Identifier: Apache-2.0
"""Rows from simulated drives: error, largest error in a slip, delay, smoothness, consistency."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bag_tools.bench import Options, Row
from ev_velocity import fusion_batch, velocity_batch
from ev_velocity import velocity_memory as mem
from ev_velocity.calibration import AGEING_SIGMA
from ev_velocity.params import FusionParams, VelocityParams
from ev_velocity.scenarios import SCENARIOS, Drive, scenario, simulate
from ev_velocity.simulation import COURSES, drive_course

PACKAGE = 'ev_velocity'
SEEDS = 50
QUICK_SEEDS = 4
# The start of a drive, where the speed is not known yet, is no matter of consistency.
START = 1.0  # s
AFTER_SLIP = 0.5  # s, in which the largest error is still looked for
DELAYS = (0.0, 0.05, 0.15, 0.3)  # s
DELAY_KNOWN_AT = 30.0  # s
_DELAY_BAR = 0.02  # s, whatever the rate of the GPS

# Scenario, what the row says, bar.
ERRORS = (
    ('good_road_10hz', 'good road, GPS 10 Hz late by 0.15 s: RMSE', 0.03),
    ('good_road_1hz', 'good road, GPS 1 Hz late by 0.15 s: RMSE', 0.055),
    ('good_road_10hz_no_delay', 'good road, GPS 10 Hz without delay: RMSE', None),
    ('good_road_1hz_no_delay', 'good road, GPS 1 Hz without delay: RMSE', None),
    ('oil_patch_10hz', 'oil patch, GPS 10 Hz: RMSE', None),
    ('oil_patch_1hz', 'oil patch, GPS 1 Hz: RMSE', None),
    ('no_gps', 'no GPS, scale stored from one drive before: RMSE', 0.05),
    ('gps_outage', 'GPS outage of 15 s: RMSE within it', 0.05),
    ('multipath', 'GPS multipath of 5.8 m/s for 7 s: RMSE', None),
)
SLIPS = (('oil_patch_10hz', '10 Hz', 0.10), ('oil_patch_1hz', '1 Hz', 0.13))


@dataclass(slots=True)
class _Sums:
    """What one scenario gives over its seeds; mean squares and largest values by estimator."""

    square: dict[str, float]
    slip: dict[str, float]
    nees: dict[str, float]
    step: float = 0.0
    unbled: float = 0.0


def _params_of(name: str, seed: int) -> tuple[VelocityParams, FusionParams, Drive]:
    """Return parameters and drive; without GPS the scale comes from an earlier drive of the same car."""
    if name != 'no_gps':
        return VelocityParams(), FusionParams(), scenario(name, seed)
    before = velocity_batch.run_drive(VelocityParams(), scenario('good_road_10hz', seed + 10_000, car=seed))
    learned = before.learned()
    learned['scale_sigma'] = (learned['scale_sigma'] ** 2 + AGEING_SIGMA**2) ** 0.5
    return (
        replace(VelocityParams(), **learned),
        FusionParams(wheel_scale=learned['scale']),
        scenario(name, seed, car=seed),
    )


def _window(drive: Drive) -> np.ndarray:
    """Return where the error counts: within the outage where there is one, else everywhere."""
    begin, end = drive.settings.outage
    return (drive.t >= begin) & (drive.t < end) if end > begin else np.ones(drive.t.size, dtype=bool)


def _measure(name: str, seeds: int) -> _Sums:
    labels = ('joint', 'published', 'fusion')
    sums = _Sums(*(dict.fromkeys(labels, 0.0) for _ in range(3)))
    for seed in range(seeds):
        params, fusion, drive = _params_of(name, seed)
        result = velocity_batch.run_drive(params, drive)
        found = {
            'joint': (result.speed, result.variance),
            'published': fusion_batch.run_drive(replace(fusion, variant='published'), drive),
            'fusion': fusion_batch.run_drive(fusion, drive),
        }
        window = _window(drive)
        slip = (drive.t >= drive.spin[0]) & (drive.t <= drive.spin[1] + AFTER_SLIP)
        late = drive.t > START
        for label, (speed, variance) in found.items():
            error = speed - drive.v
            sums.square[label] += np.mean(error[window] ** 2) / seeds
            sums.slip[label] = max(sums.slip[label], np.abs(error[slip]).max(initial=0.0))
            sums.nees[label] += np.mean(error[late] ** 2 / variance[late]) / seeds
        step = np.diff(result.speed) - drive.a[1:] * np.diff(drive.t)
        sums.step = max(sums.step, np.abs(step).max())
        unbled = velocity_batch.run_drive(replace(params, bleed_time=1e-3, bleed_step=10.0), drive)
        sums.unbled += np.mean((unbled.speed - drive.v)[window] ** 2) / seeds
    return sums


def rows(options: Options) -> Iterator[Row]:
    """Measure every simulated scenario."""
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    found = {name: _measure(name, seeds) for name in SCENARIOS}
    for name, text, bar in ERRORS:
        square = found[name].square
        peers = {
            "the paper's fusion as published": square['published'] ** 0.5,
            'corrected': square['fusion'] ** 0.5,
        }
        yield Row(PACKAGE, text, square['joint'] ** 0.5, 'm/s', bar, 'lower', peers, seeds)
    no_gps = found['no_gps'].square
    ratio = (no_gps['joint'] / min(no_gps['published'], no_gps['fusion'])) ** 0.5
    yield Row(PACKAGE, "no GPS: RMSE over that of the paper's fusion", ratio, '', 1.0, seeds=seeds)
    worst = max(
        (sums.square['joint'] / min(sums.square['published'], sums.square['fusion'])) ** 0.5
        for sums in found.values()
    )
    yield Row(
        PACKAGE, "largest RMSE over that of the paper's fusion, any scenario", worst, '', 1.0, seeds=seeds
    )
    for name, rate, bar in SLIPS:
        slip = found[name].slip
        peers = {"the paper's fusion as published": slip['published'], 'corrected': slip['fusion']}
        text = f'oil patch, GPS {rate}: largest error during slip, worst seed'
        yield Row(PACKAGE, text, slip['joint'], 'm/s', bar, 'lower', peers, seeds)
    yield from _delay_rows(seeds)
    step = max(sums.step for sums in found.values())
    yield Row(PACKAGE, 'largest output step beyond a·dt, any scenario', step, 'm/s', 0.015, seeds=seeds)
    paid = max(s.square['joint'] / s.unbled for s in found.values()) ** 0.5 - 1.0
    yield Row(PACKAGE, 'RMSE paid for smoothness, any scenario', 100.0 * paid, '%', 3.0, seeds=seeds)
    for name, sums in found.items():
        nees = sums.nees['joint']
        text = f'{name}: |mean NEES − 1|'
        yield Row(PACKAGE, text, abs(nees - 1.0), '', 0.2, 'lower', {'mean NEES': nees}, seeds)
    for name, rate in (('good_road_10hz', '10 Hz'), ('good_road_1hz', '1 Hz')):
        nees = found[name].nees
        text = f"good road, GPS {rate} late by 0.15 s: mean NEES of the paper's fusion, corrected"
        yield Row(PACKAGE, text, nees['fusion'], '', 1.2, 'lower', {'as published': nees['published']}, seeds)
    yield from _course_rows(seeds)


def known_speed_delay(drive: Drive) -> tuple[float, float]:
    """Return the likeliest delay (s) of a drive's GPS, were the true speed known, and its Cramér–Rao σ (s).

    Nobody who has to estimate the speed too can do better on average.
    """
    settings = drive.settings
    acceleration = np.interp(drive.gps_t - settings.gps_delay, drive.t, drive.a)
    delays = np.arange(-0.2, 0.6, 5e-4)
    said = np.abs(np.interp(drive.gps_t[:, None] - delays, drive.t, drive.v))
    likeliest = delays[np.argmin(np.sum((said - drive.gps_v[:, None]) ** 2, axis=0))]
    return float(likeliest), settings.gps_noise / float(np.sqrt(np.sum(acceleration**2)))


def _delay_rows(seeds: int) -> Iterator[Row]:
    for rate in (10.0, 1.0):
        ours, known, bounds = [], [], []
        for delay in DELAYS:
            for seed in range(seeds):
                settings = replace(SCENARIOS['good_road_10hz'], gps_rate=rate, gps_delay=delay)
                drive = simulate(settings, seed, DELAY_KNOWN_AT)
                result = velocity_batch.run_drive(VelocityParams(), drive)
                ours.append(result.states[-1, mem.TG] - delay)
                likeliest, bound = known_speed_delay(drive)
                known.append(likeliest - delay)
                bounds.append(bound)
        worst = {'likeliest delay, were the speed known': float(np.max(np.abs(known)))}
        text = f'unknown delay of 0 … {max(DELAYS):g} s, GPS {rate:g} Hz: error after 30 s'
        value = float(np.max(np.abs(ours)))
        yield Row(PACKAGE, f'{text}, worst seed', value, 's', _DELAY_BAR, 'lower', worst, seeds)
        peers = {
            'likeliest delay, were the speed known': _rms(known),
            'Cramér–Rao bound, were the speed known': _rms(bounds),
        }
        yield Row(PACKAGE, f'{text}, RMS', _rms(ours), 's', None, 'lower', peers, seeds)


def _course_rows(seeds: int) -> Iterator[Row]:
    """Measure error and consistency on the plant's courses, whose slip and grade no filter model knows."""
    for name, course in COURSES.items():
        square, nees = [], []
        for seed in range(seeds):
            drive = drive_course(course, seed)
            result = velocity_batch.run_drive(VelocityParams(), drive)
            error = result.speed - drive.v
            late = drive.t > START
            square.append(np.mean(error**2))
            nees.append(np.mean(error[late] ** 2 / result.variance[late]))
        mean = float(np.mean(nees))
        peers = {'mean NEES': mean, 'RMSE in m/s': float(np.mean(square)) ** 0.5}
        yield Row(PACKAGE, f'{name}: |mean NEES − 1|', abs(mean - 1.0), '', 0.2, 'lower', peers, seeds)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
