# SPDX-License-Identifier: Apache-2.0
"""All rows of the navigation package, under the settings of the scenario descriptions."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bag_tools.bench import Options, Row
from ins_gps.channels import (
    RATE_SLIP,
    REPORT_CODE,
    REPORT_CODE_W,
    REPORT_RATE,
    REPORT_RATE_W,
    ROW_CODE_REJECTED,
    ROW_DRIFTS,
)
from ins_gps.doctor import check_time, time_offset
from ins_gps.evaluation import (
    PRINTED,
    SETTLED,
    START_SIGMAS,
    SYSTEMS,
    ablation,
    evaluate,
    filter_params,
    paper_systems,
    start_wrong,
)
from ins_gps.params import FilterParams
from ins_gps.simulation import DGPS, Fault, Outage, Scenario
from ins_gps.simulation_gnss import simulate
from ins_gps.smoother import Smoother
from ins_gps.solution import error_of
from kalman_core.consistency import chi2_band
from kalman_core.gates import chi2_gate

sys.path.insert(0, str(Path(__file__).parent))
import lasting_fixes
import recorded
import speed

_PACKAGE = 'ins_gps'
_TRAJECTORIES = ('constant', 's_turns')


def _row(name: str, value: float, unit: str, bar=None, better='lower', reference=None, seeds=None) -> Row:
    return Row(_PACKAGE, name, float(value), unit, bar, better, reference or {}, seeds)


def _duration(options: Options) -> float:
    return 150.0 if options.quick else 500.0


def _seeds(options: Options, default: int) -> int:
    return options.seeds or (2 if options.quick else default)


def _paper(options: Options) -> Iterable[Row]:
    seeds = _seeds(options, 30)
    means = {name: [] for name in SYSTEMS}
    ordered = 0
    for seed in range(seeds):
        result = paper_systems(seed, _duration(options))
        now = [float(result[name].position.mean()) for name in SYSTEMS]
        ordered += now == sorted(now, reverse=True)
        for name, value in zip(SYSTEMS, now, strict=True):
            means[name].append(value)
        if seed == 0:
            ends = {name: result[name].position[-1] for name in SYSTEMS}
    for name in SYSTEMS:
        printed = {} if name == 'ins' else {'printed in the paper': PRINTED[name]}
        yield _row(
            f'paper table: {name}, mean error', np.mean(means[name]), 'm', reference=printed, seeds=seeds
        )
    yield _row(
        'paper table: ins, error at the end',
        ends['ins'],
        'm',
        reference={'printed in the paper': PRINTED['ins']},
    )
    yield _row(
        'paper table: seeds with INS > GPS > loose > tight > proposed',
        100.0 * ordered / seeds,
        '%',
        100.0,
        'higher',
        seeds=seeds,
    )


def _ablation(options: Options) -> Iterable[Row]:
    seeds = _seeds(options, 5)
    runs = [ablation(seed, _duration(options)) for seed in range(seeds)]
    for key in runs[0]:
        sa, dgps, mode, states = key
        name = f'ablation: SA {"on" if sa else "off"}, DGPS {"on" if dgps else "off"}, {mode}, {states}'
        yield _row(name, np.mean([run[key] for run in runs]), 'm', seeds=seeds)


def _accuracy(options: Options) -> Iterable[Row]:
    seeds = _seeds(options, 50)
    for white, bar in ((True, 0.12), (False, 1.5)):
        budget = replace(DGPS, white=white)
        word = 'white' if white else 'correlated'
        position, whole, velocity, fixes, position_nees, nees, instant = [], [], [], [], [], [], []
        for seed in range(seeds):
            scenario = Scenario(
                trajectory=_TRAJECTORIES[seed % 2], budget=budget, duration=_duration(options)
            )
            run = simulate(scenario, seed)
            result = evaluate(run, filter_params(budget), seed)
            late = result.after(SETTLED)
            position.append(result.position[late].mean())
            whole.append(result.position.mean())
            velocity.append(100.0 * result.velocity[late].mean())
            position_nees.append(result.nees(slice(0, 3))[late].mean())
            nees.append(result.nees()[late].mean())
            if seed < 5:
                fixes.append(evaluate(run, filter_params(budget, mode='gps'), seed).position.mean())
                published = filter_params(
                    budget,
                    mode='tight_tdcp',
                    states='published',
                    gyro_noise=2e-4,
                    accel_noise=0.02,
                    clock_walk=31.0,
                )
                instant.append(evaluate(run, published, seed).position[late].mean())
        reference = {
            'memoryless fix': float(np.mean(fixes)),
            '10 states, difference as rate': float(np.mean(instant)),
        }
        yield _row(
            f'{word} DGPS budget: mean error after 60 s',
            np.mean(position),
            'm',
            bar,
            reference=reference,
            seeds=seeds,
        )
        yield _row(f'{word} DGPS budget: mean error, start included', np.mean(whole), 'm', seeds=seeds)
        yield _row(f'{word} DGPS budget: mean velocity error', np.mean(velocity), 'cm/s', 0.5, seeds=seeds)
        for dof, values, what in ((3, position_nees, 'position'), (9, nees, 'all nine states')):
            low, high = chi2_band(0.95, dof, seeds)
            inside = float(low <= np.mean(values) <= high)
            yield _row(
                f'{word} budget: mean NEES of {what} in the 95 % band',
                inside,
                '',
                1.0,
                'higher',
                {'mean NEES': float(np.mean(values)), 'low': low, 'high': high},
                seeds,
            )


def _expected(covariances: Sequence[np.ndarray]) -> float:
    """Return the mean 3-D error (m) that position covariances (3, 3) stand for, by drawing from them."""
    rng = np.random.default_rng(0)
    zero = np.zeros(3)
    return float(
        np.mean([np.linalg.norm(rng.multivariate_normal(zero, P, 2000), axis=1) for P in covariances])
    )


def _outages(options: Options) -> Iterable[Row]:
    # The mean over 50 seeds has a standard error of a tenth of itself: where that decides, more seeds follow.
    for left, bar, more in ((3, 0.6, 0), (2, 2.5, 400), (1, None, 0), (0, 4.0, 0)):
        seeds = _seeds(options, 50)
        found = [_outage(left, seed) for seed in range(seeds)]
        end, back, within, said = zip(*found, strict=True)
        # The filter is told the true noise: what its covariance says is what can be attained.
        reference = {'expected by the covariance': _expected(said), 'standard error': _standard_error(end)}
        name = f'60 s with {left} satellites: mean error'
        yield _row(f'{name} at the end', np.mean(end), 'm', bar, reference=reference, seeds=seeds)
        yield _row(f'{name} from 10 s after', np.mean(back), 'm', 0.5, seeds=seeds)
        within_name = f'60 s with {left} satellites: within 3 sigma'
        yield _row(within_name, np.mean(within), '%', 99.0, 'higher', seeds=seeds)
        if more:
            seeds = _seeds(options, more)
            many = [*end, *(_outage(left, seed)[0] for seed in range(len(end), seeds))]
            reference = {'standard error': _standard_error(many)}
            yield _row(
                f'{name} at the end, {more} seeds', np.mean(many), 'm', bar, reference=reference, seeds=seeds
            )


def _outage(left: int, seed: int) -> tuple[float, float, float, np.ndarray]:
    """Lose all but `left` satellites; return errors (m) at the end and after, % within 3σ, covariance."""
    outages = (Outage(300.0, 360.0, left),)
    scenario = Scenario(trajectory=_TRAJECTORIES[seed % 2], budget=DGPS, outages=outages, duration=400.0)
    result = evaluate(simulate(scenario, seed), filter_params(DGPS), seed)
    k = int(np.searchsorted(result.times, 359.0))
    after = result.position[k + 10 :].mean()
    return result.position[k], after, 100.0 * result.within(), result.covariances[k][:3, :3]


def _standard_error(values: Sequence[float]) -> float:
    return float(np.std(values) / math.sqrt(len(values)))


def _late(scenario: Scenario, fault: Fault, params, seed: int, result) -> float:
    """Return how many epochs after it was significant a fault was excluded; infinite: never.

    Significant is the first epoch at which what the fault alone has done to its satellite's normalised
    innovations, summed in squares, passes the gate. It is the difference of two runs whose gates are shut.
    """
    slip = fault.kind == 'slip'
    pair = []
    for faults in ((), (fault,)):
        navigation_run = simulate(replace(scenario, faults=faults), seed)
        pair.append(evaluate(navigation_run, params, seed, gates=False).fates)
    column = 2 + (REPORT_RATE_W if slip else REPORT_CODE_W)
    state = 2 + (REPORT_RATE if slip else REPORT_CODE)
    refused = (RATE_SLIP,) if slip else (ROW_CODE_REJECTED, ROW_DRIFTS)
    limit, total = chi2_gate(1, params.gate_probability), 0.0
    significant = found = math.inf
    for k, (clean, faulty, seen) in enumerate(zip(*pair, result.fates, strict=True)):
        if result.times[k] < fault.start:
            continue
        mine = [fates[fates[:, 1] == fault.satellite][0] for fates in (clean, faulty, seen)]
        total += float(mine[1][column] - mine[0][column]) ** 2
        if total > limit:
            significant = min(significant, k)
        if mine[2][state] in refused:
            found = min(found, k)
    return max(0.0, found - significant) if math.isfinite(significant) else 0.0


def _faults(options: Options) -> Iterable[Row]:
    seeds = _seeds(options, 10)
    cases = (
        ('20 m jump', Fault('jump', 2, 120.0, 20.0)),
        ('ramp 0.5 m/s to 20 m', Fault('ramp', 2, 120.0, 0.5, 160.0)),
        ('ramp 2 m/s to 20 m', Fault('ramp', 2, 120.0, 2.0, 130.0)),
        ('ramp 0.2 m/s to 16 m', Fault('ramp', 2, 120.0, 0.2)),
        ('slip of one cycle', Fault('slip', 2, 120.0, 1.0)),
    )
    for white in (True, False):
        budget = replace(DGPS, white=white)
        for name, fault in cases:
            effects, delays, seen = [], [], 0
            for seed in range(seeds):
                scenario = Scenario(trajectory='s_turns', budget=budget, duration=200.0, imu_rate=50.0)
                params = filter_params(budget)
                clean = evaluate(simulate(scenario, seed), params, seed)
                result = evaluate(simulate(replace(scenario, faults=(fault,)), seed), params, seed)
                change = np.linalg.norm((result.errors - clean.errors)[:, :3], axis=1)
                effects.append(change.max())
                sensor = 'gnss/carrier' if fault.kind == 'slip' else 'gnss/code'
                tally, before = (e.navigation.tally.sensor(sensor).rejected for e in (result, clean))
                seen += sum(tally.values()) > sum(before.values())
                delays.append(_late(scenario, fault, params, seed, result))
            word = 'white' if white else 'correlated'
            # A ramp of 0.2 m/s hides in the multipath for long: a harder case, without a bar.
            bar = None if '0.2' in name else 0.3
            yield _row(f'{name}, {word}: largest effect', max(effects), 'm', bar, seeds=seeds)
            yield _row(
                f'{name}, {word}: detected within 2 epochs of significance',
                100.0 * np.mean(np.array(delays) <= 2),
                '%',
                None if bar is None else 100.0,
                'higher',
                {'mean epochs after it': float(np.mean(delays))},
                seeds,
            )
            yield _row(f'{name}, {word}: detected', 100.0 * seen / seeds, '%', 100.0, 'higher', seeds=seeds)


def _smoothing(options: Options) -> Iterable[Row]:
    seeds = _seeds(options, 50)
    for white in (True, False):
        budget, word = replace(DGPS, white=white), 'white' if white else 'correlated'
        filtered, smoothed, nees = [], [], []
        for seed in range(seeds):
            scenario = Scenario(
                trajectory=_TRAJECTORIES[seed % 2], budget=budget, outages=(Outage(100.0, 160.0, 0),),
                duration=220.0, imu_rate=50.0,
            )  # fmt: skip
            run = simulate(scenario, seed)
            smoother = Smoother(filter_params(budget))
            start_wrong(smoother.navigation, run, seed, START_SIGMAS)
            out = smoother.run(run.stamps[1:], run.rate, run.force, run.epochs)
            truth = run.truth[np.searchsorted(run.stamps, out.stamps)]
            inside = (out.stamps >= run.stamps[0] + 100 * 10**9) & (out.stamps < run.stamps[0] + 160 * 10**9)
            errors = [
                np.array([error_of(nav, at) for nav, at in zip(navs, truth, strict=True)])
                for navs in (out.filtered, out.smoothed)
            ]
            filtered.append(np.linalg.norm(errors[0][inside, :3], axis=1).mean())
            smoothed.append(np.linalg.norm(errors[1][inside, :3], axis=1).mean())
            whitened = np.linalg.solve(out.smoothed_covariance, errors[1][..., None])[..., 0]
            nees.append(np.einsum('ki,ki->k', errors[1], whitened).mean())
        yield _row(
            f'60 s without satellites, {word}, smoothed: mean error',
            np.mean(smoothed),
            'm',
            reference={'filtered': float(np.mean(filtered))},
            seeds=seeds,
        )
        low, high = chi2_band(0.95, 9, seeds)
        yield _row(
            f'{word} budget: mean NEES of the smoothed states in the 95 % band',
            float(low <= np.mean(nees) <= high),
            '',
            1.0,
            'higher',
            {'mean NEES': float(np.mean(nees)), 'low': low, 'high': high},
            seeds,
        )


def _doctor(options: Options) -> Iterable[Row]:
    seeds = _seeds(options, 10)
    named = 0
    for seed in range(seeds):
        run = simulate(Scenario(trajectory='s_turns', duration=120.0, gnss_offset=1.0), seed)
        stride = 100
        stamps = run.stamps[::stride] + 1_000_000_000
        velocity = run.truth[::stride, 3:6] + np.random.default_rng(seed).normal(0.0, 0.05, (len(stamps), 3))
        findings = check_time(run.stamps[1:], run.rate, stamps, velocity)
        offset, _ = time_offset(run.stamps[1:], run.rate, stamps, velocity)
        named += abs(offset - 1.0) < 0.1 and any(f.level == 'error' and 'late' in f.text for f in findings)
    yield _row('doctor: 1 s time offset named', 100.0 * named / seeds, '%', 100.0, 'higher', seeds=seeds)


def _recordings(options: Options) -> Iterable[Row]:
    root = recorded.data_folder()
    if root is None:
        return
    exact = recorded.spirent(root)
    yield _row('spirent_iono_none: code fix', 1e3 * exact['fix'], 'mm', 5.0)
    yield _row('spirent_iono_none: carrier-difference velocity', 1e3 * exact['velocity'], 'mm/s', 1.0)
    tight = recorded.spirent_tight(root, 0)
    yield _row('spirent_iono_none: tight with made IMU, mean error', 1e3 * tight['position'], 'mm')
    yield _row(
        'spirent_iono_none: tight with made IMU, within 3 sigma', 100.0 * tight['within'], '%', 99.0, 'higher'
    )
    fixed = recorded.static(root)
    ratio = fixed['doppler'] / fixed['carrier']
    yield _row(
        'matrtklib_static: carrier-difference velocity quieter than Doppler by', ratio, 'times', 5.0, 'higher'
    )
    yield _row(
        'matrtklib_static: DGPS, tight filter, mean error',
        fixed['dgps'],
        'm',
        0.3,
        reference={'memoryless fix': fixed['fix']},
    )
    walk = recorded.walk(root)
    yield _row('gnss_imu_walk_60s: horizontal', walk['horizontal'], 'm', 0.6)
    yield _row(
        'gnss_imu_walk_60s: 3-D mean',
        walk['position'],
        'm',
        1.5,
        reference={'corrected code alone': walk['code']},
    )
    yield _row('gnss_imu_walk_60s: carrier slips rejected', walk['slips'], '')
    drive = recorded.drive(root)
    told = recorded.drive(root, vibration=False)
    name = 'noise of the parameters alone'
    yield _row(
        'gnss_imu_drive: 60 s outages, mean end error', drive['end'], 'm', reference={name: told['end']}
    )
    yield _row(
        'gnss_imu_drive: NEES of position in them (3 expected)',
        drive['nees'],
        '',
        reference={name: told['nees']},
    )
    yield _row(
        'gnss_imu_drive: smoothing better by', drive['end'] / drive['smoothed'], 'times', 2.0, 'higher'
    )


def _speed(options: Options) -> Iterable[Row]:
    figures = speed.measure_speed(60.0 if options.quick else 300.0)
    yield _row(
        'offline, 100 Hz IMU + 1 Hz GNSS, full states',
        figures['times real time'],
        'x real time',
        300.0,
        'higher',
    )
    yield _row(
        'mechanisation faster than python-ins by', figures['pyins'] / figures['mechanisation'], 'times'
    )
    yield _row(
        'whole filter faster than a filterpy-style dense 18-state filter by',
        figures['filterpy'] / figures['own step'],
        'times',
    )


def _lasting_fixes(options: Options) -> Iterable[Row]:
    seeds = _seeds(options, 20)
    found = {
        f'loose, codes {word}': [lasting_fixes.own_fixes(budget, white, seeds) for white in (False, True)]
        for word, budget in lasting_fixes.BUDGETS.items()
    }
    found["gnss/fix, a receiver's positions alone, MEMS"] = [
        lasting_fixes.receiver_fixes(time, seeds) for time in (FilterParams().fix_time, 0.0)
    ]
    for name, (ours, white) in found.items():
        title = f'{name}, errors that last'
        yield _row(
            f'{title}: rms position error',
            ours.rms,
            'm',
            reference={'taken as white': white.rms},
            seeds=seeds,
        )
        yield _row(
            f'{title}: mean NEES of position (3 expected)',
            ours.nees,
            '',
            reference={'taken as white': white.nees},
            seeds=seeds,
        )


def measure(options: Options) -> Iterable[Row]:
    """Yield every row, the quick ones first."""
    clocked = (_speed,) if options.live else ()
    still = (
        (_recordings, _doctor, _faults, _outages, _smoothing, _lasting_fixes, _accuracy, _ablation, _paper)
        if options.still
        else ()
    )
    for part in clocked + still:
        yield from part(options)
