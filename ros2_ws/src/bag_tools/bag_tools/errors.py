# SPDX-License-Identifier: Apache-2.0
"""Errors of an estimate against truth: interpolation, attitude errors, NEES, delay. Pure numerics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from bag_tools.series import Array, Series, without_repeats

# A truth that pauses for longer than so many of its median steps is not interpolated across the pause.
_GAP_STEPS = 3.5
DELAY_SPAN = 2.0  # s, the largest delay looked for
# Below this share of the larger standard deviation a component carries no motion to correlate.
_STILL = 1e-6


def quat_multiply(p: Array, q: Array) -> Array:
    """Return the Hamilton products of (n, 4) wxyz quaternions."""
    pw, px, py, pz = p.T
    qw, qx, qy, qz = q.T
    return np.column_stack(
        (
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        )
    )


def quat_conjugate(q: Array) -> Array:
    """Return the conjugates of (n, 4) wxyz quaternions."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def rotation_vectors(q: Array) -> Array:
    """Return the (n, 3) rotation vectors (rad) of (n, 4) wxyz quaternions, angles up to π."""
    q = np.where(q[:, :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(sine, q[:, 0])
    scale = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-12)
    return q[:, 1:] * scale[:, None]


def euler_angles(q: Array) -> Array:
    """Return (n, 3) roll, pitch, yaw (rad, rotations about z, then y, then x) of (n, 4) wxyz quaternions."""
    w, x, y, z = q.T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack((roll, pitch, yaw))


def quaternions(euler: Array) -> Array:
    """Return (n, 4) wxyz quaternions of (n, 3) roll, pitch, yaw (rad)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(euler.T / 2.0), np.sin(euler.T / 2.0)
    return np.column_stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
    )


def attitude_errors(estimate: Array, truth: Array) -> dict[str, Array]:
    """Return total, heading and inclination errors (rad, not negative) of (n, 4) wxyz quaternions.

    d = estimate ⊗ conj(truth): total 2 acos|d₀|, heading 2 atan|d₃/d₀|, inclination 2 acos √(d₀² + d₃²),
    with the arc cosines written as arc tangents for small angles.
    Source: Laidig et al., BROAD, Data 6(7):72, 2021.
    """
    w, x, y, z = np.abs(quat_multiply(estimate, quat_conjugate(truth))).T
    return {
        'total': 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), w),
        'heading': 2.0 * np.arctan2(z, w),
        'inclination': 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)),
    }


def at(truth: Series, stamps: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
    """Return the truth at `stamps` and where it is known: not outside of it, nor in its pauses.

    Vectors are interpolated linearly, quaternions along the great circle; exact stamps give exact samples.
    """
    truth = without_repeats(truth)
    n = len(truth.stamps)
    after = np.clip(np.searchsorted(truth.stamps, stamps, side='left'), 0, n - 1)
    exact = truth.stamps[after] == stamps
    before = np.clip(after - 1, 0, n - 1)
    step = truth.stamps[after] - truth.stamps[before]
    limit = _GAP_STEPS * np.median(np.diff(truth.stamps)) if n > 1 else 0.0
    inside = (stamps > truth.stamps[0]) & (stamps < truth.stamps[-1]) & (step <= limit)
    share = np.where(exact, 1.0, (stamps - truth.stamps[before]) / np.maximum(step, 1))[:, None]
    a, b = truth.values[before], truth.values[after]
    if truth.kind != 'orientation':
        values = a + share * (b - a)
    else:
        dot = np.sum(a * b, axis=1, keepdims=True)
        b = np.where(dot < 0.0, -b, b)
        angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
        small = angle < 1e-6
        sine = np.where(small, 1.0, np.sin(angle))
        left = np.where(small, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
        right = np.where(small, share, np.sin(share * angle) / sine)
        values = left * a + right * b
        values /= np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(exact[:, None], truth.values[after], values), exact | inside


def nees(errors: Array, covariances: Array) -> Array:
    """Return the (n,) normalised estimation errors squared eᵀ P⁻¹ e; NaN where P is singular."""
    result = np.full(len(errors), np.nan)
    good = np.linalg.det(covariances) > 0.0
    solved = np.linalg.solve(covariances[good], errors[good][:, :, None])[:, :, 0]
    result[good] = np.sum(errors[good] * solved, axis=1)
    return result


def rotation_matrices(q: Array) -> Array:
    """Return the (n, 3, 3) rotation matrices of (n, 4) wxyz quaternions."""
    w, x, y, z = q.T
    rows = (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip
    return np.column_stack(rows).reshape(-1, 3, 3)


def _signal(values: Array, kind: str) -> Array:
    """Return what moves: the elements of the rotation matrix for quaternions, else the values themselves."""
    return rotation_matrices(values).reshape(-1, 9) if kind == 'orientation' else values


def _correlations(a: Array, b: Array, span: int) -> Array:
    """Return the normalised correlation of a[i + s] with b[i], s = -span … span, over what overlaps."""
    n = len(a)
    shifts = np.arange(-span, span + 1)
    overlap = n - np.abs(shifts)
    first_a, first_b = np.maximum(shifts, 0), np.maximum(-shifts, 0)
    total = np.zeros(len(shifts))
    power_a, power_b = np.zeros(len(shifts)), np.zeros(len(shifts))
    for x, y in zip(a.T, b.T):
        sums = [np.concatenate(([0.0], np.cumsum(v))) for v in (x, x * x, y, y * y)]
        mean_x, square_x = (s[first_a + overlap] - s[first_a] for s in sums[:2])
        mean_y, square_y = (s[first_b + overlap] - s[first_b] for s in sums[2:])
        cross = fftconvolve(x, y[::-1])[n - 1 + shifts]
        total += cross - mean_x * mean_y / overlap
        power_a += square_x - mean_x**2 / overlap
        power_b += square_y - mean_y**2 / overlap
    norm = np.sqrt(np.maximum(power_a * power_b, 0.0))
    return np.divide(total, norm, out=np.full(len(shifts), -1.0), where=norm > 0.0)


def delay(estimate: Array, truth: Array, step: float, kind: str = 'vector') -> float | None:
    """Return by how many seconds the estimate lags behind the truth, None where nothing moves.

    `estimate` and `truth` (n, d) are sampled alike every `step` s. The shift within ±2 s that maximises the
    normalised correlation over the samples both have, refined by a parabola through the three best points.
    """
    a, b = _signal(estimate, kind), _signal(truth, kind)
    n = len(a)
    span = min(int(DELAY_SPAN / step), n // 3)
    spread = np.sqrt(np.sum(np.var(b, axis=0)))
    if span < 1 or not spread > _STILL * max(1.0, float(np.max(np.abs(b)))):
        return None

    scores = _correlations(a - a.mean(axis=0), b - b.mean(axis=0), span)
    best = int(np.argmax(scores))
    if best in (0, len(scores) - 1):
        return None
    left, middle, right = scores[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    shift = best - span + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)
    return float(shift * step)
