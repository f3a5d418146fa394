# SPDX-License-Identifier: Apache-2.0
"""The figures of the papers, remade from this run, beside what the papers print."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bag_tools.figures import Line, Panel
from bag_tools.score import Comparison
from bag_tools.series import Array, Series, read_series

if TYPE_CHECKING:
    from workspace_harness.run import Result

Row = tuple[str, str, str, str]
# quantity, printed in the paper, the paper's method here, this workspace
HEAD = ('quantity', 'printed in the paper', "the paper's method here", 'this workspace')


@dataclass(frozen=True, slots=True)
class PaperFigures:
    """What one paper shows: a sentence, panels, and rows of HEAD."""

    text: str
    panels: Sequence[Panel]
    rows: Sequence[Row]


def _of(results: Sequence[Result], bag: str) -> dict[str, Comparison]:
    return {r.entry.label: r.comparison for r in results if r.job.bag.stem == bag}


def _bag(results: Sequence[Result], bag: str) -> Path:
    return next(r.job.bag for r in results if r.job.bag.stem == bag)


def _role(bag: Path, topic: str, role: str) -> Series:
    return next(s for s in read_series(bag, topic) if s.role == role)


def _accelerometer_angles(bag: Path, origin: int) -> tuple[Array, Array]:
    """Return seconds since `origin` (ns) and roll, pitch (n, 2) in degrees from specific force alone."""
    force = _role(bag, '/imu/data_raw', 'linear_acceleration')
    x, y, z = force.values.T
    angles = np.column_stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))])
    return force.seconds(origin), np.degrees(angles)


def _between(x: Array, y: Array, begin: float, end: float) -> tuple[Array, Array]:
    keep = (x >= begin) & (x <= end)
    return x[keep], y[keep]


def _at(times: Array, x: Array, y: Array) -> Array:
    return np.interp(times, x, y)


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _angle_errors(c: Comparison, i: int) -> Array:
    """Return the error of roll, pitch or yaw (°) of a comparison, wrapped."""
    return (c.estimate[:, i] - c.truth[:, i] + 180.0) % 360.0 - 180.0


def _rmse_max(error: Array) -> str:
    return f'{_rms(error):.2f} / {np.max(np.abs(error)):.2f}°'


def _angle_panels(bag: Path, own: Comparison, name: str, window: tuple[float, float]) -> list[Panel]:
    origin = int(_role(bag, '/truth/orientation', 'orientation').stamps[0])
    seconds, raw = _accelerometer_angles(bag, origin)
    panels = []
    for i, label in enumerate(('roll', 'pitch')):
        lines = [
            Line(name, *_between(own.times, own.estimate[:, i], *window), 's0'),
            Line('accelerometer', *_between(seconds, raw[:, i], *window), 's1'),
            Line('truth', *_between(own.times, own.truth[:, i], *window), 'truth'),
        ]
        panels.append(Panel(f'{label} before and after filtering', '°', lines))
    return panels


def angle_filter(results: Sequence[Result]) -> PaperFigures:
    """Paper 004: the angle of the accelerometer and the Kalman-filtered one."""
    name = 'imu_hand_held'
    found, bag = _of(results, name), _bag(results, name)
    own, published, best = found['corrected'], found['published'], found['attitude']
    origin = int(_role(bag, '/truth/orientation', 'orientation').stamps[0])
    seconds, raw = _accelerometer_angles(bag, origin)
    rows = []
    for i, label in enumerate(('roll', 'pitch')):
        alone = _at(own.times, seconds, raw[:, i]) - own.truth[:, i]
        here = _rmse_max(_angle_errors(best, i))
        rows += [
            (
                f'{label}, RMSE / max: accelerometer alone',
                '–',
                _rmse_max((alone + 180.0) % 360.0 - 180.0),
                '–',
            ),
            (f'{label}, RMSE / max: as published', '–', _rmse_max(_angle_errors(published, i)), here),
            (f'{label}, RMSE / max: corrected', '–', _rmse_max(_angle_errors(own, i)), here),
        ]
    text = 'The paper shows the filtered angle and prints no errors. Bag imu_hand_held.'
    return PaperFigures(text, _angle_panels(bag, own, 'two-state', (10.0, 30.0)), rows)


def inclinometer(results: Sequence[Result]) -> PaperFigures:
    """Paper 001: roll and pitch before and after filtering; its table of the sea trial."""
    name = 'ship_beam_sea'
    found, bag = _of(results, name), _bag(results, name)
    # Sea trial, Hs 1 to 3 m: RMSE / max in degrees.
    printed = {'roll': '0.81 / 2.10°', 'pitch': '0.82 / 2.20°', 'heading': '0.89 / 2.15°'}
    rows = [
        (
            f'{label}, RMSE / max in a beam sea',
            text,
            _rmse_max(_angle_errors(found['published'], i)),
            _rmse_max(_angle_errors(found['full'], i)),
        )
        for i, (label, text) in enumerate(printed.items())
    ]
    text = "The paper's sea trial beside a simulated irregular beam sea (bag ship_beam_sea), without GNSS."
    return PaperFigures(text, _angle_panels(bag, found['full'], 'filtered', (60.0, 120.0)), rows)


def _encoder_speed(bag: Path, origin: int) -> tuple[Array, Array]:
    """Return seconds and wheel speed (m/s), each over the interval that it is the mean of."""
    from ev_velocity.params import VelocityParams

    angle = read_series(bag, '/wheel/encoder', 'position[0]')[0]
    seconds = angle.seconds(origin)
    speed = np.diff(angle.values[:, 0]) / np.diff(seconds) * VelocityParams().wheel_radius
    return seconds[1:], speed


def _held(times: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Return a slow signal at `times` as a sensor gives it: constant until its next sample."""
    return times, y[np.maximum(np.searchsorted(x, times, side='right') - 1, 0)]


def _speed_panel(
    results: Sequence[Result], name: str, title: str, window: tuple[float, float]
) -> tuple[Panel, dict[str, Comparison]]:
    found, bag = _of(results, name), _bag(results, name)
    origin = int(read_series(bag, '/truth/velocity', 'twist.linear')[0].stamps[0])
    gps = read_series(bag, '/gps/speed', 'twist.twist.linear.x')[0]
    joint = found['joint']
    lines = [
        Line('joint 500 Hz', *_between(joint.times, joint.estimate[:, 0], *window), 's0'),
        Line('encoder', *_between(*_held(joint.times, *_encoder_speed(bag, origin)), *window), 's1'),
        Line('GPS', *_between(*_held(joint.times, gps.seconds(origin), gps.values[:, 0]), *window), 's2'),
        Line('fusion', *_between(found['fusion'].times, found['fusion'].estimate[:, 0], *window), 's3'),
        Line('truth', *_between(joint.times, joint.truth[:, 0], *window), 'truth'),
    ]
    return Panel(title, 'm/s', lines), found


def electric_car(results: Sequence[Result]) -> PaperFigures:
    """Paper 002: encoder and GPS raised to 500 Hz, and the patch of low grip."""
    raised, good = _speed_panel(results, 'ev_good_road', 'encoder and GPS raised to 500 Hz', (3.0, 6.0))
    bag = _bag(results, 'ev_oil_patch')
    truth = read_series(bag, '/truth/velocity', 'twist.linear')[0]
    seconds, wheel = _encoder_speed(bag, int(truth.stamps[0]))
    slip = wheel - _at(seconds, truth.seconds(), truth.values[:, 0])
    middle = float(seconds[np.argmax(slip)])
    patch, oil = _speed_panel(results, 'ev_oil_patch', 'the oil patch', (middle - 1.5, middle + 2.0))
    rows = [
        ('good road: RMSE', '–', *(f'{_rms(good[n].errors[:, 0]):.3f} m/s' for n in ('published', 'joint'))),
        ('oil patch: the wheel runs ahead by', '8 to 14 m/s, 0.4 s', f'{np.max(slip):.1f} m/s', ''),
        (
            'oil patch: largest error of the speed',
            'does not follow',
            *(f'{np.max(np.abs(oil[n].errors[:, 0])):.2f} m/s' for n in ('published', 'joint')),
        ),
    ]
    return PaperFigures(
        'Bags ev_good_road and ev_oil_patch; the GPS is late by 0.15 s.', [raised, patch], rows
    )


def navigation(results: Sequence[Result]) -> PaperFigures:
    """Paper 003, figures 5 to 9 and table 4: the position error of five systems."""
    from ins_gps.evaluation import PRINTED, paper_systems

    runs = paper_systems(0)
    names = {'ins': 'INS', 'gps': 'GPS', 'loose': 'loose', 'tight': 'tight', 'proposed': 'proposed'}
    lines = [
        Line(names[key], run.times, np.maximum(run.position, 1e-3), f's{i}')
        for i, (key, run) in enumerate(runs.items())
    ]
    rows = [
        (
            f'{names[key]}: {"error at 500 s" if key == "ins" else "mean 3-D error"}',
            f'{PRINTED[key]:.4g} m',
            f'{run.position[-1] if key == "ins" else run.position.mean():.4g} m',
            '',
        )
        for key, run in runs.items()
    ]
    own = _of(results, 'gnss_paper')
    if 'proposed' in own:
        mean = float(np.mean(np.linalg.norm(own['proposed'].errors, axis=1)))
        rows[-1] = (*rows[-1][:3], f'{mean:.2f} m (bag gnss_paper, all states)')
    text = (
        'One seed of the simulation of table 4: INS, GPS, loose and tight without DGPS and with selective '
        "availability, the proposed system with DGPS; the paper's ten states."
    )
    return PaperFigures(text, [Panel('3-D position error of the five systems', 'm', lines, log=True)], rows)


def _recovery(kp: float, ki: float, kd: float, seconds: float = 3.0) -> tuple[Array, Array]:
    """Return s and angle (rad) of the paper's test on the documented plant: 0.05° of noise, one PID."""
    from quad_control import loops
    from quad_control.linear_plant import LinearSimulation, documented_plant

    rng = np.random.default_rng(0)
    period, noise = 0.005, math.radians(0.05)
    plant = LinearSimulation(documented_plant(), start=math.radians(10.0))
    state = np.zeros(loops.AXIS_SIZE)
    angle = np.empty(round(seconds / period))
    for i in range(len(angle)):
        angle[i] = plant.output
        measured = angle[i] + noise * rng.standard_normal()
        plant.advance(loops.published_step(state, -measured, kp, ki, kd, 1.0, period))
    return np.arange(len(angle)) * period, angle


def quadcopter(results: Sequence[Result]) -> PaperFigures:
    """Paper 000: from 10 degrees to level."""
    from quad_control.flight import step_result

    # Gains of the paper: set by hand, and by Ziegler and Nichols from Ku = 0.9, Tu = 0.08 s.
    tests = {'by hand': (0.46, 9.58, 0.0043), 'Ziegler–Nichols': (0.54, 13.5, 0.0054)}
    lines, settled = [], {}
    for i, (name, gains) in enumerate(tests.items(), 1):
        seconds, angle = _recovery(*gains)
        lines.append(Line(name, seconds, np.degrees(angle), f's{i}'))
        settled[name] = step_result(seconds, angle)
    flights = {}
    for bag, name, color in (
        ('quad_stand_10deg', 'cascade, stand', 's0'),
        ('quad_free_10deg', 'cascade, air', 's3'),
    ):
        found = _of(results, bag)
        if not found:
            continue
        path = _bag(results, bag)
        attitude = _role(path, '/truth/odometry', 'orientation')
        w, x, y, z = attitude.values.T
        roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        begin = _release(attitude.seconds(), roll)
        times, roll = attitude.seconds() - begin, roll
        keep = (times >= 0.0) & (times <= 3.0)
        lines.append(Line(name, times[keep], np.degrees(roll[keep]), color))
        flights[name] = step_result(times[keep], roll[keep])
    cascade = flights.get('cascade, stand')
    own = (f'{cascade.settling:.2f} s', f'{cascade.overshoot:.2f}°') if cascade is not None else ('–', '–')
    hand = settled['by hand']
    rows = [
        ('from 10° to within 0.5°', '2 to 3 s', f'{hand.settling:.2f} s', own[0]),
        ('overshoot', '–', f'{hand.overshoot:.1f}°', own[1]),
        ('the same, gains by Ziegler and Nichols', '–', f'{settled["Ziegler–Nichols"].settling:.2f} s', ''),
    ]
    text = (
        "The paper's gains on the plant that has its Ku and Tu, angle measured with 0.05° of noise; "
        'the cascade on the rigid body of the bags.'
    )
    return PaperFigures(text, [Panel('10° recovery', '°', lines, zero=True)], rows)


def _release(seconds: Array, roll: Array) -> float:
    """Return the time (s) at which the craft, held at 10 degrees, begins to turn level."""
    moving = np.flatnonzero(np.abs(roll) < np.max(np.abs(roll)) - math.radians(0.3))
    after = moving[seconds[moving] > seconds[np.argmax(np.abs(roll))]]
    return float(seconds[after[0] - 1]) if len(after) else 0.0


FIGURES: Mapping[str, tuple[str, Callable[[Sequence[Result]], PaperFigures]]] = {
    'imu_kalman': ('imu_hand_held', angle_filter),
    'ship_inclinometer': ('ship_beam_sea', inclinometer),
    'ev_velocity': ('ev_oil_patch', electric_car),
    'ins_gps': ('gnss_paper', navigation),
    'quad_control': ('quad_stand_10deg', quadcopter),
}
