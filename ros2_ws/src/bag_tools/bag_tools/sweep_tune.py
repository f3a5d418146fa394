# SPDX-License-Identifier: Apache-2.0
"""Tuning on top of a sweep: differential evolution over parameter ranges.

Source: Storn and Price, "Differential evolution", Journal of Global Optimization 11 (1997), as scipy has
it. It needs no gradient (gates make objectives jump) and evaluates a generation at once, which workers
share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bag_tools.sweep_plan import Range

# Candidates per parameter and generation: scipy's 15 is for harder landscapes than two or three noises have.
_POPULATION = 6
_WORST = 1e12  # in place of inf, which differential evolution cannot rank


@dataclass(frozen=True, slots=True)
class Tuned:
    """The best parameters found, their objective, and that of the defaults; `evaluations` tried."""

    params: dict[str, float]
    value: float
    before: float
    evaluations: int


def tune(
    ranges: Sequence[Range],
    evaluate: Callable[[list[dict[str, Any]]], list[float]],
    evaluations: int,
    seed: int = 0,
) -> Tuned:
    """Minimise; `evaluate` gets a generation of parameter sets and returns their objectives.

    An empty set means the defaults. Stops after the generation that reaches `evaluations`.
    """
    from scipy.optimize import differential_evolution

    before = evaluate([{}])[0]
    population = max(_POPULATION * len(ranges), 5)
    best: tuple[float, dict[str, float]] = (np.inf, {})
    tried = 0

    def as_params(shares: NDArray[np.float64]) -> dict[str, float]:
        return {r.name: r.at(float(s)) for r, s in zip(ranges, shares)}

    def generation(_function: Callable, candidates: Any) -> list[float]:
        nonlocal best, tried
        sets = [as_params(np.asarray(c)) for c in candidates]
        values = evaluate(sets)
        tried += len(sets)
        for value, params in zip(values, sets):
            if value < best[0]:
                best = (value, params)
        return [value if np.isfinite(value) else _WORST for value in values]

    differential_evolution(
        lambda shares: 0.0,  # every evaluation goes through `workers`
        [(0.0, 1.0)] * len(ranges),
        maxiter=max(evaluations // population - 1, 0),
        popsize=_POPULATION,
        seed=seed,
        updating='deferred',
        workers=generation,
        polish=False,
        tol=1e-4,
    )
    return Tuned(best[1], best[0], before, tried)
