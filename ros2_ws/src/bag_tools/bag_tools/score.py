# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools score``: any estimate topic against any truth topic."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bag_tools.align import CONSTANTS, HEADING, MOUNTING, Solved, aligned, correlated_lag, solve
from bag_tools.bag import BagError
from bag_tools.cli import guarded
from bag_tools.errors import (
    at,
    attitude_errors,
    euler_angles,
    nees,
    quat_conjugate,
    quat_multiply,
    quaternions,
    rotation_matrices,
    rotation_vectors,
)
from bag_tools.series import Array, Series, read_series
from kalman_core.earth import ecef_from_geodetic_series, mat_ecef_from_enu

PERCENTILES = (50.0, 95.0, 99.0)
SOLVE_HELP = f'take out first what two devices need not agree on: {", ".join(CONSTANTS)}'
_DEGREES = 180.0 / math.pi
# What three numbers of a message mean when it says so; angles are none of these.
_OTHER_VECTORS = (
    'position', 'geodetic', 'linear_velocity', 'angular_velocity', 'linear_acceleration',
    'angular_acceleration', 'magnetic_field',
)  # fmt: skip
_NAMED = (*_OTHER_VECTORS, 'orientation')


@dataclass(frozen=True, slots=True)
class Statistics:
    """Errors of one component: `mean` is signed where the error is; the rest are of |error|.

    `nees` is the mean NEES per degree of freedom, 1 where errors are as large as the covariance says.
    """

    name: str
    unit: str
    rmse: float
    mean: float
    max: float
    percentiles: dict[str, float]
    nees: float | None = None


@dataclass(frozen=True, slots=True)
class Score:
    """One quantity of an estimate against truth. `nees` is the mean over time, `dof` what it should be.

    `solved` holds the constants between both devices that were taken out before.
    """

    role: str
    samples: int
    seconds: float
    components: list[Statistics]
    nees: float | None = None
    dof: int | None = None
    delay: float | None = None
    solved: Solved | None = None

    def component(self, name: str) -> Statistics:
        """Return the statistics of component `name`; raise KeyError."""
        return next(c for c in self.components if c.name == name)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A score with what it was made from, for plots: `errors` (n, k) and `sigmas` (n, k) or None.

    `times` (n,) s since the first truth; `estimate` and `truth` (n, k) hold what the plots show, in the
    unit of the statistics; `sigmas` (n, k) are the filter's own standard deviations. `labels` name the
    columns of estimate and truth, `error_labels` those of errors and sigmas: an orientation shows as roll,
    pitch and yaw, its error as a rotation vector.
    """

    score: Score
    times: Array
    estimate: Array
    truth: Array
    errors: Array
    labels: tuple[str, ...]
    unit: str
    sigmas: Array | None
    error_labels: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Window:
    """What counts: from `after` to `before` (s since the first truth), `where` true (stamps ns, values)."""

    after: float = 0.0
    before: float = math.inf
    where: tuple[NDArray[np.int64], NDArray[np.bool_]] | None = field(default=None)

    def mask(self, stamps: NDArray[np.int64], origin: int) -> NDArray[np.bool_]:
        """Return which stamps count; a `where` topic holds its value until its next message."""
        seconds = (stamps - origin) * 1e-9
        mask = (seconds >= self.after) & (seconds <= self.before)
        if self.where is not None:
            times, values = self.where
            index = np.searchsorted(times, stamps, side='right') - 1
            mask &= np.where(index >= 0, values[np.maximum(index, 0)], False)
        return mask


def _statistics(name: str, unit: str, errors: Array) -> Statistics:
    size = np.abs(errors)
    return Statistics(
        name,
        unit,
        rmse=float(np.sqrt(np.mean(errors * errors))),
        mean=float(np.mean(errors)),
        max=float(np.max(size)),
        percentiles={f'{p:g}': float(np.percentile(size, p)) for p in PERCENTILES},
    )


def _orientation(estimate: Series, truth: Array, keep: NDArray[np.bool_], frame: str) -> tuple:
    q, reference = estimate.values[keep], truth[keep]
    sizes = attitude_errors(q, reference)
    components = [_statistics(n, '°', e * _DEGREES) for n, e in sizes.items()]
    # q_truth = exp(error_n) q_estimate (world) or q_estimate exp(error_b) (body).
    inverse = quat_conjugate(q)
    turn = quat_multiply(reference, inverse) if frame == 'world' else quat_multiply(inverse, reference)
    errors = -rotation_vectors(turn)
    shown = (
        np.unwrap(euler_angles(q), axis=0) * _DEGREES,
        np.unwrap(euler_angles(reference), axis=0) * _DEGREES,
    )
    shown = (shown[0] - 360.0 * np.round((shown[0] - shown[1]) / 360.0), shown[1])
    axes = tuple(f'error about {frame} {axis}' for axis in 'xyz')
    return components, errors, shown, errors * _DEGREES, (('roll', 'pitch', 'yaw'), axes), '°', _DEGREES


def _plain(estimate: Series, truth: Array, keep: NDArray[np.bool_]) -> tuple:
    values, reference = estimate.values[keep], truth[keep]
    errors = values - reference
    components = [_statistics(n, estimate.unit, errors[:, i]) for i, n in enumerate(estimate.labels)]
    if errors.shape[1] > 1:
        components.append(_statistics('norm', estimate.unit, np.linalg.norm(errors, axis=1)))
    labels = (estimate.labels, tuple(f'{name}: error' for name in estimate.labels))
    return components, errors, (values, reference), errors, labels, estimate.unit, 1.0


def _mean(values: Array) -> float | None:
    """Return the mean of what is known, None where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else None


def _shares(
    estimate: Series, keep: NDArray[np.bool_], errors: Array, covariance: Array, frame: str
) -> dict[str, float]:
    """Return the mean NEES per degree of freedom of each component whose covariance is known.

    An attitude without a reference of heading may be honest about its inclination only.
    """
    axes = {name: [i] for i, name in enumerate(estimate.labels)}
    every = list(range(errors.shape[1]))
    if estimate.kind == 'orientation':
        axes = {'total': every, 'heading': [2], 'inclination': [0, 1]}
        if frame == 'body':
            turn = rotation_matrices(estimate.values[keep])
            errors = np.einsum('nij,nj->ni', turn, errors)
            covariance = turn @ covariance @ turn.transpose(0, 2, 1)
    elif len(every) > 1:
        axes['norm'] = every
    means = {name: _mean(nees(errors[:, i], covariance[:, i][:, :, i])) for name, i in axes.items()}
    return {name: mean / len(axes[name]) for name, mean in means.items() if mean is not None}


def evaluate(
    estimate: Series,
    truth: Series,
    window: Window | None = None,
    frame: str = 'world',
    constants: Collection[str] = (),
) -> Comparison:
    """Score one quantity. Orientations give total, heading and inclination errors in degrees.

    `frame` is that of the orientation covariance and error vector: 'world' (the workspace's convention) or
    'body'. `constants` names what is solved and taken out first, see `bag_tools.align`. Raises BagError when
    no sample of the estimate lies where truth is known and the window open.
    """
    if estimate.role == truth.role == 'geodetic':
        origin = truth.values[0]
        estimate, truth = _local(estimate, origin), _local(truth, origin)
    if estimate.kind != truth.kind or estimate.values.shape[1] != truth.values.shape[1]:
        raise BagError(f'{estimate.role} is a {estimate.kind}, the truth {truth.role} a {truth.kind}')
    first = int(truth.stamps[0])
    window = window or Window()
    counts = partial(window.mask, origin=first)
    solved = solve(estimate, truth, constants, counts) if constants else None
    if solved is not None:
        estimate = aligned(estimate, solved, frame)
    reference, known = at(truth, estimate.stamps)
    keep = known & counts(estimate.stamps)
    if not keep.any():
        raise BagError(f'{estimate.role}: no sample of the estimate lies where truth is known')
    parts = (
        _orientation(estimate, reference, keep, frame)
        if estimate.kind == 'orientation'
        else _plain(estimate, reference, keep)
    )
    components, errors, shown, shown_errors, (labels, error_labels), unit, factor = parts
    stamps = estimate.stamps[keep]
    mean_nees = dof = sigmas = None
    if estimate.covariance is not None:
        covariance = estimate.covariance[keep]
        mean_nees, dof = _mean(nees(errors, covariance)), errors.shape[1]
        shares = _shares(estimate, keep, errors, covariance, frame)
        components = [replace(c, nees=shares.get(c.name)) for c in components]
        sigmas = np.sqrt(np.einsum('nii->ni', covariance)) * factor
    score = Score(
        estimate.role,
        samples=int(keep.sum()),
        seconds=float(stamps[-1] - stamps[0]) * 1e-9,
        components=components,
        nees=mean_nees,
        dof=dof,
        delay=correlated_lag(estimate, truth, counts),
        solved=solved,
    )
    times = (stamps - first).astype(np.float64) * 1e-9
    return Comparison(score, times, shown[0], shown[1], shown_errors, labels, unit, sigmas, error_labels)


def _local(series: Series, origin: Array) -> Series:
    """Return geodetic positions (°, °, m) as east, north, up (m) from `origin`."""
    to_rad = np.array([1.0 / _DEGREES, 1.0 / _DEGREES, 1.0])
    ecef = ecef_from_geodetic_series(np.vstack([origin, series.values]) * to_rad)
    values = (ecef[1:] - ecef[0]) @ mat_ecef_from_enu(origin[0] / _DEGREES, origin[1] / _DEGREES)
    return replace(series, values=values, labels=('east', 'north', 'up'), unit='m')


def _as_orientation(series: Series) -> Series:
    """Take a vector for roll, pitch, yaw in rad."""
    return replace(
        series,
        role='orientation',
        kind='orientation',
        values=quaternions(series.values),
        labels=('w', 'x', 'y', 'z'),
        unit='rad',
        covariance=None,
    )


def _may_be_angles(series: Series) -> bool:
    """Return whether a series may be roll, pitch, yaw: three numbers whose message does not say otherwise."""
    return series.kind == 'vector' and series.values.shape[1] == 3 and series.role not in _OTHER_VECTORS


def pair(estimates: Sequence[Series], truths: Sequence[Series]) -> list[tuple[Series, Series]]:
    """Return the quantities that can be compared: equal roles first, else the first of equal shape.

    A three-vector against an orientation is taken for roll, pitch, yaw (rad). Two that messages name
    differently, such as a position and a speed, are not compared.
    """
    by_role = {t.role: t for t in truths}
    pairs = [(e, by_role[e.role]) for e in estimates if e.role in by_role]
    if pairs:
        return [(e, t) for e, t in pairs if e.kind == t.kind and e.values.shape[1] == t.values.shape[1]]
    for e in estimates:
        for t in truths:
            if _may_be_angles(e) and t.kind == 'orientation':
                return [(_as_orientation(e), t)]
            if e.kind == 'orientation' and _may_be_angles(t):
                return [(e, _as_orientation(t))]
            named = e.role in _NAMED and t.role in _NAMED
            if not named and e.kind == t.kind and e.values.shape[1] == t.values.shape[1]:
                return [(e, t)]
    return []


@dataclass(frozen=True, slots=True)
class Subject:
    """What to score: a topic of a bag, or one field of it."""

    bag: str | Path
    topic: str
    field: str | None = None


def read_window(after: float, before: float, where: Subject | None) -> Window:
    """Return the window; `where` names a Bool topic (or numeric field, true where not zero)."""
    if where is None:
        return Window(after, before)
    series = read_series(where.bag, where.topic, where.field)[0]
    return Window(after, before, (series.stamps, series.values[:, 0] != 0.0))


def score(
    estimate: Subject,
    truth: Subject,
    window: Window | None = None,
    frame: str = 'world',
    constants: Collection[str] = (),
) -> list[Comparison]:
    """Score every quantity that the two topics share; raise BagError when there is none."""
    pairs = pair(
        read_series(estimate.bag, estimate.topic, estimate.field),
        read_series(truth.bag, truth.topic, truth.field),
    )
    if not pairs:
        raise BagError(f"'{estimate.topic}' and '{truth.topic}' have no quantity in common; give field paths")
    if {MOUNTING, HEADING} & set(constants) and all(e.kind != 'orientation' for e, _ in pairs):
        raise BagError(
            f"'{estimate.topic}' has no orientation; mounting and heading are solved for those only"
        )
    return [evaluate(e, t, window, frame, constants) for e, t in pairs]


def to_text(comparisons: Sequence[Comparison]) -> str:
    """Return an aligned table, one line per component."""
    head = (
        *('quantity', 'component', 'RMSE', 'mean', 'max', *(f'{p:g} %' for p in PERCENTILES)),
        *('unit', 'NEES/dof'),
    )
    rows = [head]
    notes = []
    for c in comparisons:
        for s in c.score.components:
            numbers = (s.rmse, s.mean, s.max, *s.percentiles.values())
            share = '–' if s.nees is None else f'{s.nees:.3g}'
            rows.append((c.score.role, s.name, *(f'{n:.4g}' for n in numbers), s.unit, share))
        note = f'{c.score.role}: {c.score.samples} samples over {c.score.seconds:.1f} s'
        if c.score.nees is not None:
            note += f', mean NEES {c.score.nees:.3g} ({c.score.dof} expected)'
        if c.score.delay is not None:
            note += f', delay {c.score.delay * 1e3:.1f} ms'
        if c.score.solved is not None:
            note += f'; solved: {c.score.solved}'
        notes.append(note)
    widths = [max(len(r[i]) for r in rows) for i in range(len(head))]
    lines = []
    for row in rows:
        cells = (
            v.ljust(w) if i in (0, 1, len(head) - 2) else v.rjust(w)
            for i, (v, w) in enumerate(zip(row, widths))
        )
        lines.append('  '.join(cells).rstrip())
    return '\n'.join([*lines, '', *notes])


def to_json(comparisons: Sequence[Comparison]) -> str:
    """Return the scores as a JSON list; numbers that are not finite become null."""

    def clean(value: object) -> object:
        if isinstance(value, dict):
            return {k: clean(v) for k, v in value.items()}
        if isinstance(value, list):
            return [clean(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps([clean(asdict(c.score)) for c in comparisons], indent=1)


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog='score', description='Score an estimate topic against a truth topic.')
    p.add_argument('bag', help='bag with the estimate')
    p.add_argument('estimate', help='estimate topic')
    p.add_argument('truth', help='truth topic')
    p.add_argument('--truth-bag', help='bag with the truth, when it is another one')
    p.add_argument('--field', help='field path in the estimate, for example twist.twist.linear.x')
    p.add_argument('--truth-field', help='field path in the truth')
    p.add_argument('--after', type=float, default=0.0, help='s after the first truth from which to score')
    p.add_argument(
        '--before', type=float, default=math.inf, help='s after the first truth up to which to score'
    )
    p.add_argument('--where', help='Bool topic of the truth bag: score only while it is true')
    p.add_argument('--covariance-frame', choices=('world', 'body'), default='world')
    p.add_argument('--solve', nargs='+', choices=CONSTANTS, default=(), metavar='CONSTANT', help=SOLVE_HELP)
    p.add_argument('--json', action='store_true', help='JSON instead of a table')
    return p


def run(argv: list[str]) -> int:
    """Score as the command line says."""
    o = _parser().parse_args(argv)
    truth_bag = o.truth_bag or o.bag
    window = read_window(o.after, o.before, Subject(truth_bag, o.where) if o.where else None)
    results = score(
        Subject(o.bag, o.estimate, o.field),
        Subject(truth_bag, o.truth, o.truth_field),
        window,
        o.covariance_frame,
        o.solve,
    )
    print(to_json(results) if o.json else to_text(results))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('score', run, argv)


if __name__ == '__main__':
    sys.exit(main())
