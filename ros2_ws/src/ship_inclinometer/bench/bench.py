# SPDX-License-Identifier: Apache-2.0
"""Rows of the issue's table, measured under the settings of BENCHMARKS.md."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from bag_tools.bench import Row
from kalman_core.consistency import chi2_band
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.simulation import scenario, simulate

sys.path.insert(0, str(Path(__file__).parent))
import attitude_bench as attitude
import roll_bench as roll
import service_bench as service

PACKAGE = 'ship_inclinometer'
_GNSS = AttitudeParams(antenna_lever_arm=attitude.ANTENNA)
_LEVER = AttitudeParams(imu_lever_arm=attitude.LEVER)
# smsfusion is a Python loop of some ten seconds a run: a few seeds tell its error well enough.
_PEER_SEEDS = 3
# Sample by sample through the streaming class, half a minute a run.
_STREAMED_SEEDS = 10
PERIODS = (4.0, 5.0, 6.3, 8.0, 10.0, 12.5, 16.0, 20.0, 25.0, 32.0, 40.0)


def row(name: str, value: float, unit: str, bar: float | None = None, **extra) -> Row:
    """Return a row of this package."""
    return Row(PACKAGE, name, float(value), unit, bar, **extra)


def measure(options) -> Iterable[Row]:
    """Yield all rows."""
    if options.still:
        count = options.seeds or (2 if options.quick else 50)
        seeds = range(count)
        yield from _sine(seeds)
        yield from _seas(seeds, options.quick)
        yield from _turns(seeds)
        yield from _consistency(seeds)
        yield from _start(seeds)
        yield from _roll(seeds)
        yield from _schedules(range(min(count, 5)))
        yield from service.sphere_rows()
    if options.live:
        yield from service.rows(options.quick)


def _sine(seeds: range) -> Iterator[Row]:
    score, *_ = attitude.measure_scenario('paper', seeds, AttitudeParams())
    total = score.total()
    low, raw = attitude.Score(), []
    gains, indices = [], []
    for seed in seeds[: max(len(seeds) // 5, 1)]:
        recording = simulate(scenario('paper'), seed)
        scored = recording.truth.t >= attitude.SETTLED
        low.add(attitude.low_pass_error(recording)[scored])
        rows = attitude.run_recording(recording, AttitudeParams()).rows
        errors = attitude.attitude_errors(recording, rows)
        truth = np.degrees(recording.truth.angles[scored, 0])
        estimate = errors.angles[scored, 0] + truth
        measured = attitude.raw_angles(recording)[scored, 0]
        gains.append(attitude.true_gain(measured, estimate, truth))
        indices.append(attitude.published_index(measured, estimate))
        raw.append(
            attitude.response(recording, errors.angles[:, 0] + np.degrees(recording.truth.angles[:, 0]))
        )
    paper, n = {'paper': 0.82}, len(seeds)
    low_total = low.total()
    peers = paper | {'low-pass 0.5 Hz': low_total['tilt']}
    yield row('paper sine: roll, pitch RMSE', total['tilt'], '°', 0.4, reference=peers, seeds=n)
    peers = {'paper': 1.8, 'low-pass 0.5 Hz': low_total['largest_tilt']}
    yield row('paper sine: roll, pitch maximum', total['largest_tilt'], '°', 0.8, reference=peers, seeds=n)
    yield row('paper sine: heading RMSE', total['heading'], '°', 0.85, reference={'paper': 0.85}, seeds=n)
    peers = {'paper': 2.15}
    yield row('paper sine: heading maximum', total['largest_heading'], '°', reference=peers, seeds=n)
    worst = max(raw, key=abs)
    yield row('paper sine: response, time of best correlation', worst, 's', 0.12, reference={'paper': 0.12})
    step = attitude.step_response(AttitudeParams())
    yield row('response, 63 % of a heel step', step, 's', 0.12, reference={'paper': 0.12})
    peers = {'paper': 24.0}
    yield row('paper sine: published SNR index (eq. 20)', np.mean(indices), 'dB', reference=peers)
    yield row(
        'paper sine: true gain', np.mean(gains), 'dB', better='higher', reference={'paper, by its RMSE': 5.7}
    )


def _seas(seeds: range, quick: bool) -> Iterator[Row]:
    low, plain, vru = attitude.Score(), attitude.Score(), attitude.Score()
    for seed in seeds[:1] if quick else seeds[:_PEER_SEEDS]:
        recording = simulate(scenario('beam'), seed)
        scored = recording.truth.t >= attitude.SETTLED
        low.add(attitude.low_pass_error(recording)[scored])
        plain.add(attitude.published_run(recording, AttitudeParams())[0][scored])
        error = attitude.smsfusion_error(recording)
        if error is not None:
            vru.add(error[scored])
    peers = {'low-pass 0.5 Hz': low.total()['tilt'], 'published filter': plain.total()['tilt']}
    if vru.rmse:
        peers['smsfusion VRU'] = vru.total()['tilt']
    for name in ('beam', 'swell', 'quartering', 'head', 'storm'):
        total = attitude.measure_scenario(name, seeds, AttitudeParams())[0].total()
        reference = peers if name == 'beam' else {}
        bars = (0.25, 0.5) if name != 'storm' else (None, None)
        label = f'{name} sea, no GNSS: roll, pitch'
        yield row(f'{label} RMSE', total['tilt'], '°', bars[0], reference=reference, seeds=len(seeds))
        yield row(f'{label} 95 %', total['within'], '°', bars[1], seeds=len(seeds))
    total = attitude.measure_scenario('beam', seeds, _LEVER)[0].total()
    yield row('beam sea, lever arm known: roll, pitch RMSE', total['tilt'], '°', 0.25, seeds=len(seeds))
    for bias in (5.0, 20.0):
        params = AttitudeParams(accelerometer_bias_sigma=bias)
        total = attitude.measure_scenario('beam', seeds, params, accelerometer_bias=bias)[0].total()
        name = f'beam sea, accelerometer bias {bias:g} mg: roll, pitch RMSE'
        yield row(name, total['tilt'], '°', seeds=len(seeds))


def _turns(seeds: range) -> Iterator[Row]:
    n = len(seeds)
    total = attitude.measure_scenario('turns_gnss', seeds, _GNSS)[0].total()
    yield row('turns, GNSS velocity: roll, pitch RMSE', total['tilt'], '°', 0.1, seeds=n)
    yield row('turns, GNSS velocity: roll, pitch 95 %', total['within'], '°', 0.2, seeds=n)
    yield row('turns, GNSS velocity: heading RMSE', total['heading'], '°', seeds=n)
    total = attitude.measure_scenario('turns', seeds, _LEVER, use_log=True)[0].total()
    yield row('turns, speed log: roll, pitch RMSE', total['tilt'], '°', 0.5, seeds=n)
    yield row('turns, speed log: roll, pitch 95 %', total['within'], '°', 0.5, seeds=n)
    yield row('turns, speed log: roll, pitch maximum', total['largest_tilt'], '°', seeds=n)
    total = attitude.measure_scenario('turns', seeds, AttitudeParams())[0].total()
    yield row('turns, no speed: roll, pitch RMSE', total['tilt'], '°', seeds=n)
    few = seeds[:_STREAMED_SEEDS]
    undeclared = max(attitude.over_seeds(service.undeclared_error, few))
    yield row('turns, no speed: largest error while declared valid', undeclared, '°', 1.0, seeds=len(few))


def _consistency(seeds: range) -> Iterator[Row]:
    n = len(seeds)
    for name, params in (('beam', AttitudeParams()), ('swell', AttitudeParams()), ('turns_gnss', _GNSS)):
        _, tilt, full, nis = attitude.measure_scenario(name, seeds, params)
        yield from _band(f'{name}: NEES of tilt', tilt, 2, n)
        yield from _band(f'{name}: NEES of attitude', full, 3, n)
        for source, values in nis.items():
            dof = {'position': 3, 'magnetometer': 1, 'gnss': 3}[source]
            yield from _band(f'{name}: NIS of {source}', dof * values, dof, n)


def _band(name: str, values: np.ndarray, dof: int, runs: int) -> Iterator[Row]:
    """Yield the mean per degree of freedom against both ends of the 95 % band of `runs` values."""
    low, high = chi2_band(0.95, dof, runs)
    mean = float(np.mean(values)) / dof
    yield row(f'{name}, under the upper end', mean, '', high / dof, seeds=runs)
    yield row(f'{name}, over the lower end', mean, '', low / dof, better='higher', seeds=runs)


def _start(seeds: range) -> Iterator[Row]:
    times = list(attitude.over_seeds(service.time_to_valid, seeds[:20]))
    yield row('start in motion, gyro bias 5 °/s: valid after', max(times), 's', 60.0, seeds=len(times))


def _roll(seeds: range) -> Iterator[Row]:
    shares, excesses, good, cycles = {}, [], 0, 0
    for sea in roll.SEAS:
        scores = list(attitude.over_seeds(functools.partial(roll.period_score, sea), seeds))
        shares[sea] = 100.0 * sum(s.good for s in scores) / sum(s.cycles for s in scores)
        good, cycles = good + sum(s.good for s in scores), cycles + sum(s.cycles for s in scores)
        excesses += [excess for s in scores for excess in s.excesses]
    name, n = 'roll period: cycles within max(5 %, 1 s)', len(seeds)
    yield row(name, 100.0 * good / cycles, '%', 98.0, better='higher', seeds=n)
    for (peak, natural), share in shares.items():
        label = f'{name}, Tp {peak:g} s, Tn {natural:g} s'
        yield row(label, share, '%', 98.0, better='higher', seeds=n)
    yield row('roll period: delay beyond T/4, 99 %', np.quantile(excesses, 0.99), 's', 1.0, seeds=n)
    yield row('roll period: delay beyond T/4, largest', max(excesses), 's', 1.0, seeds=n)
    yield row('roll period: error on pure sines of 4-40 s', roll.sine_error(PERIODS), 's', 0.1)


def _schedules(seeds: range) -> Iterator[Row]:
    """What the paper's multi-rate schedule costs in accuracy and saves in time, by its own filter."""
    every = AttitudeParams(published_interval=0.005, published_cutoff=100.0)
    instant = AttitudeParams(published_transition='instant')
    results = {}
    attitude.published_run(simulate(scenario('sine', duration=10.0), 0), every)
    for name, params in (
        ('5 Hz', AttitudeParams()),
        ('every sample', every),
        ('printed covariance', instant),
    ):
        score, elapsed = attitude.Score(), 0.0
        for seed in seeds:
            recording = simulate(scenario('sine'), seed)
            error, seconds = attitude.published_run(recording, params)
            score.add(error[recording.truth.t >= attitude.SETTLED])
            elapsed += seconds
        results[name] = (score.total()['tilt'], elapsed)
    for name, (error, _) in results.items():
        yield row(f'published filter on the sine, {name}: roll, pitch RMSE', error, '°', seeds=len(seeds))
    ratio = results['every sample'][1] / results['5 Hz'][1]
    yield row('published filter: time of every sample over 5 Hz', ratio, '')
