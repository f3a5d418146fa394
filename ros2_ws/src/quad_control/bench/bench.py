# SPDX-License-Identifier: Apache-2.0
"""Every row of the package's table: the 10 degree test, tuning, mixer, faults, recorded and live flights."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator

import flights
import numpy as np
import spread
import synthetic
from rotorpy_plant import RotorpyPlant

from bag_tools.bench import Options, Row
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import CraftParams, benchmark_craft, benchmark_imu, max_thrust
from quad_control.endurance import Endurance, battery_for
from quad_control.fault_injection import FASTEST_SINK, SINKING, STATED, inject, lose_link_climbing
from quad_control.flight import FlightLog, StepResult, constant_pilot, fly, step_result
from quad_control.linear_plant import LinearPlant, documented_plant, rate_plant
from quad_control.mixer import mix, pulses_from_thrust
from quad_control.params import GAINS, GRAVITY, AttitudeParams, ControllerParams
from quad_control.tuning import (
    PidGains,
    Ultimate,
    ultimate_by_experiment,
    ultimate_by_relay,
    ziegler_nichols,
)

PACKAGE = 'quad_control'
PUBLISHED = PidGains(0.46, 9.58, 0.0043)
_SEEDS, _QUICK = 50, 2
# A craft that never settles has no settling time: rows print this many seconds, the length of the test.
_NEVER = 8.0
_LOOP_GAINS = [f'{axis}_rate_{part}' for axis in ('roll', 'pitch', 'yaw') for part in ('p', 'i', 'd')]


def measure(options: Options) -> Iterable[Row]:
    """Yield every row."""
    if options.still:
        seeds = range(options.seeds or (_QUICK if options.quick else _SEEDS))
        yield from _documented(seeds)
        yield from _stand(seeds)
        yield from _rotorpy(seeds)
        yield from _spread(seeds)
        yield from _recorded()
        yield from _autotune()
        yield from _revert(seeds)
        yield from _mixer(seeds)
        yield from _faults(seeds)
        yield from _climbing(seeds)
        yield from _endurance()
    if options.live:
        yield from _live(options.quick)


def _row(name: str, value: float, unit: str, bar: float | None = None, **rest) -> Row:
    return Row(PACKAGE, name, float(value), unit, bar, **rest)


def _settling(results: list[StepResult]) -> float:
    worst = max(r.settling for r in results)
    return worst if math.isfinite(worst) else _NEVER


def _documented(seeds: range) -> Iterator[Row]:
    """Compare published, Ziegler-Nichols and cascade gains on the plant that has the published Ku and Tu."""
    gains = {'published': PUBLISHED, 'Ziegler-Nichols': ziegler_nichols(Ultimate(0.9, 0.08))}
    bare = {name: [synthetic.measured_test(g, s) for s in seeds] for name, g in gains.items()}
    filtered = {name: [synthetic.documented_test(g, s) for s in seeds] for name, g in gains.items()}
    cascade = [synthetic.documented_test(synthetic.servo_cascade(), s) for s in seeds]
    n = len(seeds)
    yield _row(
        'documented plant: published gains, settling (paper: 2-3 s)',
        _settling(bare['published']),
        's',
        3.0,
        reference={'Ziegler-Nichols': _settling(bare['Ziegler-Nichols']), 'cascade': _settling(cascade)},
        seeds=n,
    )
    yield _row(
        'documented plant: published gains, overshoot',
        max(r.overshoot for r in bare['published']),
        '°',
        reference={
            'Ziegler-Nichols': max(r.overshoot for r in bare['Ziegler-Nichols']),
            'cascade': max(r.overshoot for r in cascade),
        },
        seeds=n,
    )
    yield _row(
        "documented plant: published gains behind the paper's filter, settled share",
        np.mean([math.isfinite(r.settling) for r in filtered['published']]),
        '',
        reference={'cascade': float(np.mean([math.isfinite(r.settling) for r in cascade]))},
        better='higher',
        seeds=n,
    )


def _stand(seeds: range) -> Iterator[Row]:
    found = [synthetic.body_test(s, pinned=True) for s in seeds]
    n = len(seeds)
    few = list(seeds)[:5]
    published = [synthetic.body_test(s, pinned=True, name='published', controller='published') for s in few]
    yield _row(
        'stand: cascade settling',
        _settling(found),
        's',
        0.3,
        reference={'published gains and filter': _settling(published)},
        seeds=n,
    )
    yield _row('stand: cascade overshoot', max(r.overshoot for r in found), '°', 0.5, seeds=n)
    corrected = {
        where: _settling([synthetic.body_test(s, pinned=where == 'stand', name='corrected') for s in few])
        for where in ('stand', 'free flight')
    }
    yield _row(
        'stand: cascade behind the corrected filter, settling',
        corrected['stand'],
        's',
        reference={'the same in free flight (8 = never)': corrected['free flight']},
        seeds=len(few),
    )


def rotorpy_flight(seed: int, payload: float = 0.0, gain: float = 1.0, seconds: float = 3.0) -> FlightLog:
    """Fly the benchmark's 10 degree test on rotorpy, estimator in the loop, one set of gains."""
    plant = RotorpyPlant(benchmark_craft(payload), benchmark_imu(), roll=math.radians(10.0), seed=seed)
    params = ControllerParams()
    params = dataclasses.replace(params, **{name: gain * getattr(params, name) for name in _LOOP_GAINS})
    attitude, controller = AttitudeFilter(AttitudeParams()), AttitudeController(params)
    attitude.start(plant.quaternion)
    controller.start_flying(tuple(plant.quaternion), plant.hover_fraction)
    return fly(plant, attitude, controller, seconds, constant_pilot(plant.hover_fraction))


def _step_of(log: FlightLog) -> StepResult:
    return step_result(log.time, log.truth[:, 0])


def _rotorpy(seeds: range) -> Iterator[Row]:
    found = [_step_of(rotorpy_flight(s)) for s in seeds]
    n = len(seeds)
    yield _row('rotorpy free flight: settling', _settling(found), 's', 0.35, seeds=n)
    yield _row('rotorpy free flight: overshoot', max(r.overshoot for r in found), '°', 0.5, seeds=n)
    residual = float(np.sqrt(np.mean([r.residual**2 for r in found])))
    worst = max(r.residual for r in found)
    yield _row(
        'rotorpy free flight: residual', residual, '° RMS', 0.05, reference={'worst seed': worst}, seeds=n
    )
    few = list(seeds)[:10]
    for payload in (0.0, 1.0, 3.2):
        found = [_step_of(rotorpy_flight(s, payload=payload)) for s in few]
        yield _row(f'payload {payload:g} kg: settling', _settling(found), 's', 0.4, seeds=len(few))
    for gain in (0.5, 0.71, 1.41, 2.0):
        found = [_step_of(rotorpy_flight(s, gain=gain)) for s in few]
        yield _row(f'loop gain x {gain:g}: settling', _settling(found), 's', 0.6, seeds=len(few))


def _spread(seeds: range) -> Iterator[Row]:
    crafts = range(2 * len(seeds))
    share = 100.0 * float(np.mean([spread.succeeds(s) for s in crafts]))
    yield _row(
        'random crafts, batteries, IMUs and rates: settle in 0.6 s, overshoot to 2 degrees',
        share,
        '%',
        95.0,
        better='higher',
        seeds=len(crafts),
    )


def _recorded() -> Iterator[Row]:
    where = flights.folder()
    if where is None:
        return
    own = {
        name: flights.mean_over_flights(lambda r, name=name: flights.own(r, name), where)
        for name in ('gyro_driven', 'corrected', 'published')
    }
    vqf = flights.mean_over_flights(flights.vqf, where)
    for index, (measure_name, bar) in enumerate((('RMSE', 2.5), ('mean absolute', None))):
        yield _row(
            f'recorded flights H1-H5: roll and pitch error, {measure_name}',
            own['gyro_driven'][index],
            '°',
            bar,
            reference={
                'published': own['published'][index],
                'corrected': own['corrected'][index],
                'VQF': vqf[index],
            },
        )


def _autotune() -> Iterator[Row]:
    plants = (documented_plant(), rate_plant(722.0), LinearPlant(50.0, 0.05, 0.01, lag2=0.004))
    worst = {'gain': 0.0, 'period': 0.0}
    for plant in plants:
        gain, period = plant.ultimate()
        for found in (ultimate_by_experiment(plant), ultimate_by_relay(plant)):
            worst['gain'] = max(worst['gain'], abs(found.gain / gain - 1.0))
            worst['period'] = max(worst['period'], abs(found.period / period - 1.0))
    yield _row('autotune: worst error of Ku, three plants', 100.0 * worst['gain'], '%', 10.0)
    yield _row('autotune: worst error of Tu, three plants', 100.0 * worst['period'], '%', 10.0)
    found = ultimate_by_experiment(documented_plant())
    yield _row('documented plant: Ku by the experiment', found.gain, '', reference={'paper': 0.9})
    yield _row('documented plant: Tu by the experiment', found.period, 's', reference={'paper': 0.08})


def _revert(seeds: range) -> Iterator[Row]:
    """Give random gains that make the loop swing; the share of flights that come back on their own."""
    few = list(seeds)[:20]
    back = 0
    for seed in few:
        rng = np.random.default_rng(seed)
        plant = RotorpyPlant(benchmark_craft(), benchmark_imu(), roll=0.0, seed=seed)
        attitude, controller = AttitudeFilter(), AttitudeController()
        attitude.start(plant.quaternion)
        controller.start_flying(tuple(plant.quaternion), plant.hover_fraction)
        wild = {'roll_rate_p': rng.uniform(0.35, 0.8), 'roll_rate_d': rng.uniform(0.0, 0.001)}
        before = {name: getattr(controller.params, name) for name in GAINS}

        def meddle(t: float, controller=controller, wild=wild) -> None:
            if abs(t - 0.5) < 1e-9:
                controller.set_params(dataclasses.replace(controller.params, **wild))

        log = fly(plant, attitude, controller, 4.0, constant_pilot(plant.hover_fraction), meddle=meddle)
        reverted = any(e.kind == 'trial' and e.text.startswith('reverted') for e in log.events)
        same = before == {name: getattr(controller.params, name) for name in GAINS}
        back += reverted and same and bool(np.degrees(np.abs(log.truth[-100:, :2])).max() < 1.0)
    yield _row(
        'gains that swing are reverted, level within 3.5 s',
        back / len(few),
        '',
        1.0,
        better='higher',
        seeds=len(few),
    )


def _mixer(seeds: range) -> Iterator[Row]:
    """Count violations over random demands: pulses outside 1000-2000 µs, roll or pitch not kept."""
    rng = np.random.default_rng(0)
    thrust, achieved, pulses = np.zeros(4), np.zeros(4), np.zeros(4)
    wrong = 0
    n = 2000 * len(seeds)
    for roll, pitch, yaw, throttle in rng.uniform((-2, -2, -2, -1), (2, 2, 2, 2), (n, 4)):
        mix(roll, pitch, yaw, throttle, 0.006, 1.0, thrust, achieved)
        pulses_from_thrust(thrust, 1.0, 0.9, 1000.0, 2000.0, pulses)
        wrong += not (pulses.min() >= 1000.0 and pulses.max() <= 2000.0)
        if 2.0 * (abs(roll) + abs(pitch)) <= 0.994:
            wrong += abs(achieved[0] - roll) + abs(achieved[1] - pitch) > 1e-9
    yield _row('mixer: violations over random demands', wrong, '', 0.0, seeds=n)


def _faults(seeds: range) -> Iterator[Row]:
    few = list(seeds)[:10]
    ended = 0
    for fault, limit in STATED.items():
        found = [inject(fault, s) for s in few]
        ended += sum(r.well_ended and r.seconds <= limit for r in found)
        worst = max(r.seconds for r in found)
        yield _row(f'{fault}: to idle or descent', 1e3 * worst, 'ms', 1e3 * limit, seeds=len(few))
    share = 100.0 * ended / (len(few) * len(STATED))
    yield _row('injected faults that end well in time', share, '%', 100.0, better='higher', seeds=len(few))


def _climbing(seeds: range) -> Iterator[Row]:
    """Lose the link in a climb that no sensor measures, with thrusts that are not what was expected."""
    few = list(seeds)[:10]
    name = 'link lost in a climb of 2 m/s, no height, thrust x 0.85, 1, 1.15, 0 and 3.2 kg'
    found = [
        lose_link_climbing(seed, scale, payload)
        for seed in few
        for scale in (0.85, 1.0, 1.15)
        for payload in (0.0, 3.2)
    ]
    sinking, fastest = (max(values) for values in zip(*found))
    yield _row(f'{name}: to sinking', min(sinking, _NEVER), 's', SINKING, seeds=len(few))
    yield _row(f'{name}: fastest sink', min(fastest, _NEVER), 'm/s', FASTEST_SINK, seeds=len(few))


def _endurance() -> Iterator[Row]:
    heaviest = 4.0 * max_thrust(CraftParams()) / GRAVITY / 1.5
    yield _row('hover time without payload (paper: 18 min)', Endurance().minutes, 'min')
    loaded = Endurance(payload=3.2)
    yield _row('hover time with 3.2 kg (paper: 18 min)', loaded.minutes, 'min')
    best = Endurance(bare_mass=1.2, payload=3.2, energy_density=180.0, figure_of_merit=0.7, efficiency=0.85)
    battery = max(0.0, min(heaviest - best.bare_mass - best.payload, 2.0 * (best.bare_mass + best.payload)))
    best = dataclasses.replace(best, battery_mass=battery)
    yield _row('hover time with 3.2 kg, best figures, largest battery that still flies', best.minutes, 'min')
    yield _row('battery for 18 min without payload', battery_for(18.0, Endurance(), heaviest), 'kg')


def _live(quick: bool) -> Iterator[Row]:
    from live import CALM, fly_live, kill_live

    for rate in (200.0, 500.0):
        flown = fly_live(rate, 10.0 if quick else 600.0)
        name = f'live processes at {rate:g} Hz'
        yield _row(f'{name}: in to out, p99', flown.p99, 'ms', 3.0, reference={'p50': flown.p50})
        yield _row(f'{name}: lost samples', flown.lost, '', 0.0)
        stable = flown.seconds if flown.tilt < CALM and not flown.crashed else 0.0
        yield _row(f'{name}: stable flight', stable, 's', 10.0 if quick else 600.0, better='higher')
    limit = 1e3 * STATED['controller killed']
    yield _row('live processes: controller killed, to idle pulses', 1e3 * kill_live(), 'ms', limit)
