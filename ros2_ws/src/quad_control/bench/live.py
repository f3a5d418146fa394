# SPDX-License-Identifier: Apache-2.0
"""The attitude loop through live processes: simulator → filter → controller → simulator, in lock-step."""

from __future__ import annotations

import math
from dataclasses import dataclass

# Tilt that no calm hover reaches (rad).
CALM = math.radians(15.0)


@dataclass(frozen=True)
class LiveFlight:
    """Simulated time (s), in-to-out p50 and p99 (ms), lost answers, largest tilt (rad), last height (m)."""

    seconds: float
    p50: float
    p99: float
    lost: int
    tilt: float
    height: float
