# SPDX-License-Identifier: Apache-2.0
"""Errors of attitudes against truth, as the recorded trials define them."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

PARTS = ('total', 'heading', 'inclination')


def errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return total, heading and inclination error (n, 3) in degrees of wxyz attitudes (n, 4)."""
    a, b = (Rotation.from_quat(quat, scalar_first=True) for quat in (found, true))
    d = np.abs((a * b.inv()).as_quat(scalar_first=True))
    total = 2 * np.arccos(np.clip(d[:, 0], 0, 1))
    heading = 2 * np.arctan2(d[:, 3], d[:, 0])
    inclination = 2 * np.arccos(np.clip(np.hypot(d[:, 0], d[:, 3]), 0, 1))
    return np.degrees(np.stack([total, heading, inclination], axis=1))


def rms(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the root mean square of `errors` (3,)."""
    return np.sqrt(np.mean(errors(found, true) ** 2, axis=0))


def best_time(work: Callable[[], object], repeats: int = 5) -> float:
    """Return the shortest time (s) of `work`: what other processes add is not its own."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)
