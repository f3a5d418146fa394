# SPDX-License-Identifier: Apache-2.0
"""Chi-square gates: the NIS beyond which a measurement is taken for an outlier.

A gate is named by its degrees of freedom and by the probability that a good measurement is rejected:
``chi2_gate(2)`` is 13.8 and ``chi2_gate(3)`` 16.3 at the default 1e-3. Nothing here imports scipy.

Source: Abramowitz and Stegun, "Handbook of Mathematical Functions" (1964), 26.4.4 and 26.4.5.
"""

import math
from functools import lru_cache

import numpy as np

DEFAULT_PROBABILITY = 1e-3


def chi2_tail(value: float, dof: int) -> float:
    """Return the probability that a chi-square variable with `dof` (1, 2, …) exceeds `value`."""
    if value <= 0.0:
        return 1.0
    half = 0.5 * value
    if dof % 2:
        total = math.erfc(math.sqrt(half))
        term = 2.0 * math.sqrt(half / math.pi) * math.exp(-half)
        order = 1.5
    else:
        total = 0.0
        term = math.exp(-half)
        order = 1.0
    for _ in range(dof // 2):
        total += term
        term *= half / order
        order += 1.0
    return total


@lru_cache(maxsize=4096)
def chi2_gate(dof: int, probability: float = DEFAULT_PROBABILITY) -> float:
    """Return the limit that a chi-square variable with `dof` exceeds with `probability`.

    Raises ValueError unless dof is 1 … 200 and probability within 1e-30 … 1 (exclusive).
    """
    if not 1 <= dof <= 200:
        raise ValueError(f'dof is {dof}, allowed: 1 … 200')
    if not 1e-30 <= probability < 1.0:
        raise ValueError(f'probability is {probability}, allowed: 1e-30 … 1')
    low, high = 0.0, float(dof)
    while chi2_tail(high, dof) > probability:
        low, high = high, 2.0 * high
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return high
        if chi2_tail(middle, dof) > probability:
            low = middle
        else:
            high = middle


def chi2_gates(max_dof: int, probability: float = DEFAULT_PROBABILITY) -> np.ndarray:
    """Return a table (max_dof + 1,) for kernels: entry d is the gate of d degrees of freedom, 0 for none."""
    return np.array([0.0] + [chi2_gate(dof, probability) for dof in range(1, max_dof + 1)])


GATES = chi2_gates(16)
"""The gates of 1 … 16 degrees of freedom at 1e-3, indexed by dof; kernels may use it as a constant."""
