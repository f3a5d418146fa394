# SPDX-License-Identifier: Apache-2.0
"""Calibration of magnetometer and accelerometer by ellipsoid, of the gyro by rest, and the ship swing.

The model is ``true = matrix @ (raw - offset)`` with a symmetric matrix, so that a field of constant norm is
a sphere. Fit: algebraic start (Li and Griffiths, "Least squares ellipsoid specific fitting", 2004, without
the specific constraint), then the norm's residuals by robust least squares. The fit refuses poor coverage
of the sphere and says what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.optimize import least_squares

# The sphere is cut into this many cells (bands of latitude times sectors); a fit needs this share of them.
_BANDS, _SECTORS = 4, 8
_NEEDED = 0.7
_FEWEST = 100
# A fit that leaves more than this share of the norm is no ellipsoid of one field.
_LARGEST_SPREAD = 0.05


class CalibrationError(ValueError):
    """The data do not allow a calibration; the message says what is missing."""


@dataclass(frozen=True)
class Calibration:
    """``true = matrix @ (raw - offset)``; spread: robust deviation of the norm over its median."""

    matrix: np.ndarray
    offset: np.ndarray
    norm: float
    spread: float
    coverage: float

    def apply(self, raw: np.ndarray) -> np.ndarray:
        """Return calibrated vectors for raw ones (..., 3)."""
        return (np.asarray(raw) - self.offset) @ self.matrix.T


def coverage(directions: np.ndarray) -> tuple[float, list[str]]:
    """Return the share of cells of the sphere that hold unit vectors (N, 3), and names of the empty sides."""
    band = np.minimum(((directions[:, 2] + 1.0) / 2.0 * _BANDS).astype(int), _BANDS - 1)
    angle = np.arctan2(directions[:, 1], directions[:, 0]) + math.pi
    sector = np.minimum((angle / (2.0 * math.pi) * _SECTORS).astype(int), _SECTORS - 1)
    filled = np.zeros((_BANDS, _SECTORS), bool)
    filled[band, sector] = True
    missing = []
    # Half a right angle around each axis, and at least one direction in fifty.
    for axis, name in enumerate('xyz'):
        for sign, word in ((1.0, '+'), (-1.0, '-')):
            share = np.mean(sign * directions[:, axis] > math.cos(math.radians(45.0)))
            if share < 0.02:
                missing.append(f'{word}{name}')
    return float(np.mean(filled)), missing


def fit_ellipsoid(raw: np.ndarray, norm: float | None = None) -> Calibration:
    """Fit raw vectors (N, 3) of a field of constant norm; raise CalibrationError when they do not allow it.

    `norm` is the field's true norm (accelerometer: 9.80665 m/s²); without it the mean radius is kept.
    """
    raw = np.asarray(raw, dtype=np.float64)
    if raw.ndim != 2 or raw.shape[1] != 3:
        raise CalibrationError(f'vectors have shape {raw.shape}, expected (N, 3)')
    raw = raw[np.all(np.isfinite(raw), axis=1)]
    if len(raw) < _FEWEST:
        raise CalibrationError(f'{len(raw)} usable vectors, expected at least {_FEWEST}')
    offset, matrix = _algebraic(raw)
    radius = float(np.mean(np.linalg.norm((raw - offset) @ matrix.T, axis=1)))
    matrix = matrix / radius
    offset, matrix = _refine(raw, offset, matrix)
    unit = (raw - offset) @ matrix.T
    lengths = np.linalg.norm(unit, axis=1)
    share, missing = coverage(unit / lengths[:, None])
    if missing or share < _NEEDED:
        faults = []
        if share < _NEEDED:
            faults.append(
                f'only {100 * share:.0f} % of the sphere is covered, expected {100 * _NEEDED:.0f} %'
            )
        if missing:
            faults.append(f'hardly any data towards {", ".join(missing)}')
        raise CalibrationError('; '.join(faults) + ': turn the sensor through all sides')
    # By the median: a spike is no reason to refuse.
    spread = 1.4826 * float(np.median(np.abs(lengths / np.median(lengths) - 1.0)))
    if spread > _LARGEST_SPREAD:
        raise CalibrationError(
            f'the norm still spreads by {100 * spread:.1f} % after the fit, expected under '
            f'{100 * _LARGEST_SPREAD:.0f} %: the field was not constant'
        )
    target = norm if norm is not None else float(np.cbrt(1.0 / np.linalg.det(matrix)))
    return Calibration(matrix * target, offset, target, spread, share)


def _algebraic(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (offset, matrix) of the quadric of least squares."""
    centre = np.mean(raw, axis=0)
    scale = float(np.max(np.std(raw, axis=0)))
    if not scale > 0.0:
        raise CalibrationError('all vectors are equal')
    x, y, z = ((raw - centre) / scale).T
    design = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z])
    p, _, rank, _ = np.linalg.lstsq(design, np.ones(len(x)), rcond=1e-10)
    if rank < 9:
        raise CalibrationError('the vectors lie in a plane or on a cone: turn the sensor through all sides')
    quadric = np.array([[p[0], p[3], p[4]], [p[3], p[1], p[5]], [p[4], p[5], p[2]]])
    try:
        middle = -np.linalg.solve(quadric, p[6:])
    except np.linalg.LinAlgError:
        raise CalibrationError('the vectors lie on no ellipsoid') from None
    level = 1.0 + middle @ quadric @ middle
    values, vectors = np.linalg.eigh(quadric / level)
    if np.min(values) <= 0.0:
        raise CalibrationError('the vectors lie on no ellipsoid: turn the sensor through all sides')
    matrix = vectors @ np.diag(np.sqrt(values)) @ vectors.T / scale
    return centre + scale * middle, matrix


def _refine(raw: np.ndarray, offset: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the norm's residuals; a soft loss keeps spikes from bending the ellipsoid."""
    scale = 1.0 / float(np.mean(np.diag(matrix)))
    rows, columns = np.triu_indices(3)
    start = np.concatenate([offset / scale, matrix[rows, columns] * scale])

    def unpack(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        symmetric = np.zeros((3, 3))
        symmetric[rows, columns] = p[3:]
        symmetric[columns, rows] = p[3:]
        return p[:3] * scale, symmetric / scale

    def residuals(p: np.ndarray) -> np.ndarray:
        shift, symmetric = unpack(p)
        return np.linalg.norm((raw - shift) @ symmetric.T, axis=1) - 1.0

    # The soft knee stands at three deviations of the start's residuals.
    knee = max(3.0 * float(np.median(np.abs(residuals(start)))), 1e-6)
    return unpack(least_squares(residuals, start, loss='soft_l1', f_scale=knee).x)


def gyro_bias(rates: np.ndarray, largest_deviation: float = math.radians(0.5)) -> np.ndarray:
    """Return the mean of rates (N, 3) [rad/s] taken at rest; raise CalibrationError if it was none."""
    rates = np.asarray(rates, dtype=np.float64)
    rates = rates[np.all(np.isfinite(rates), axis=1)]
    if len(rates) < _FEWEST:
        raise CalibrationError(f'{len(rates)} usable rates, expected at least {_FEWEST}')
    # Means of tenths: noise averages out, motion does not.
    means = np.array([np.mean(part, axis=0) for part in np.array_split(rates, 10)])
    moved = float(np.max(np.ptp(means, axis=0)))
    if moved > largest_deviation:
        raise CalibrationError(
            f'the rate changed by {math.degrees(moved):.2f} °/s, expected under '
            f'{math.degrees(largest_deviation):.2f} °/s: the sensor was not at rest'
        )
    return np.mean(rates, axis=0)


def swing(headings: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return the deviation coefficients A, B, C, D, E [rad] of a ship swing (N,) in rad.

    deviation = A + B sin h + C cos h + D sin 2h + E cos 2h (Bowditch, "American Practical Navigator",
    chapter 8). Raises CalibrationError when the headings leave a gap of more than 60°.
    """
    headings = np.asarray(headings, dtype=np.float64) % (2.0 * math.pi)
    if len(headings) < 8:
        raise CalibrationError(f'{len(headings)} headings, expected at least 8 (every 45°)')
    ordered = np.sort(headings)
    gaps = np.diff(np.concatenate([ordered, [ordered[0] + 2.0 * math.pi]]))
    widest = int(np.argmax(gaps))
    if gaps[widest] > math.radians(60.0):
        raise CalibrationError(
            f'no heading between {math.degrees(ordered[widest]):.0f}° and '
            f'{math.degrees(ordered[widest] + gaps[widest]) % 360.0:.0f}°: swing through all headings'
        )
    design = np.column_stack(
        [
            np.ones(len(headings)),
            np.sin(headings),
            np.cos(headings),
            np.sin(2.0 * headings),
            np.cos(2.0 * headings),
        ]
    )
    return np.linalg.lstsq(design, np.asarray(deviations, dtype=np.float64), rcond=None)[0]


def write_yaml(path: Path, node: str, values: Mapping[str, Any]) -> None:
    """Write parameters of `node` as a ROS parameter file that the estimator loads; whole or not at all."""
    plain = {n: [float(x) for x in v] if isinstance(v, list | tuple) else v for n, v in values.items()}
    partial = path.with_name(f'.{path.name}.part')
    text = yaml.safe_dump({node: {'ros__parameters': plain}}, default_flow_style=None, sort_keys=False)
    partial.write_text(text, encoding='utf-8')
    partial.replace(path)
