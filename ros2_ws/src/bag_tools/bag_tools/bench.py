# SPDX-License-Identifier: Apache-2.0
"""Rows of the benchmark: one measured figure against its bar, with what peers reach in the same run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Options:
    """How much to measure: `seeds` overrides the number of seeds, `quick` asks for a smoke run."""

    seeds: int | None = None
    quick: bool = False


@dataclass(frozen=True, slots=True)
class Row:
    """One figure. `bar` is None for a figure that is reported without a bar."""

    package: str
    name: str
    value: float
    unit: str
    bar: float | None = None
    better: str = 'lower'
    reference: dict[str, float] = field(default_factory=dict)
    seeds: int | None = None

    @property
    def passed(self) -> bool:
        """Whether the bar is met; a value that is not finite never is."""
        if not math.isfinite(self.value):
            return False
        if self.bar is None:
            return True
        return self.value <= self.bar if self.better == 'lower' else self.value >= self.bar
