# SPDX-License-Identifier: Apache-2.0
"""Errors of position fixes that last from one fix to the next, as states of the filter.

Atmosphere, orbits and multipath keep for a minute or more. Taken as white, they let the filter be sure of a
place that all fixes have in common; weighted down for it, the fixes no longer show how the craft moves. As
first-order errors in NED beside the position they do neither.

Source: Groves, 2nd ed., 3.4.3 (states for time-correlated measurement noise).
"""

from __future__ import annotations

import math

import numpy as np

from ins_gps.layout import FIX, FIX_ERROR, FIX_SPREAD, POS
from ins_gps.params import FilterParams
from ins_gps.prediction import covariance_of, signatures_of
from ins_gps.samples import GROUND_CORRECTIONS

# Share of a fix's variance and correlation time (s) of each of at most two errors, the fast one first.
Lasting = tuple[tuple[float, float], ...]
# A fix whose variance is so many times another's is another kind of solution, with errors of its own.
_OTHER_SOLUTION = 4.0
# Rounding of a fix (height in cm) and motion between its epoch and its stamp are new each time.
_LEAST_WHITE = 0.01


def errors_elsewhere(status: int, params: FilterParams) -> Lasting:
    """Return what lasts of the errors of a fix from elsewhere, by its NavSatStatus."""
    if status >= GROUND_CORRECTIONS or not params.fix_time > 0.0:
        return ()
    return ((1.0 - params.fix_white, params.fix_time),)


def age_errors(state, channels: int, covariance: np.ndarray, since: float, lasting: Lasting) -> np.ndarray:
    """Bring the lasting errors to a fix `since` s after the last (0: first); return its white covariance.

    covariance: (3, 3) m² NED of the fix, all its errors together.
    """
    P, signatures = covariance_of(state, channels), signatures_of(state, channels)
    spread, before = float(np.trace(covariance)), state[FIX_SPREAD]
    same = since > 0.0 and before < spread * _OTHER_SOLUTION and spread < before * _OTHER_SOLUTION
    state[FIX_SPREAD] = spread
    white = 1.0
    for k in range(2):
        share, time = lasting[k] if k < len(lasting) else (0.0, 1.0)
        decay = math.exp(-since / time) if same else 0.0
        own = slice(FIX + 3 * k, FIX + 3 * k + 3)
        P[own] *= decay
        P[:, own] *= decay
        P[own, own] += (1.0 - decay * decay) * share * covariance
        signatures[:, own] *= decay
        state[FIX_ERROR + 3 * k : FIX_ERROR + 3 * k + 3] *= decay
        white -= share
    return max(white, _LEAST_WHITE) * covariance


def start_errors(state, channels: int, covariance: np.ndarray, lasting: Lasting) -> None:
    """Begin the lasting errors with a fix that has just become the position, `covariance` included."""
    P = covariance_of(state, channels)
    age_errors(state, channels, covariance, 0.0, lasting)
    for k, (share, _) in enumerate(lasting):
        own = slice(FIX + 3 * k, FIX + 3 * k + 3)
        # What the fix errs by, the position errs by the other way.
        P[own, POS : POS + 3] = P[POS : POS + 3, own] = -share * covariance


def add_rows(state, H: np.ndarray, nu: np.ndarray) -> None:
    """Let the innovation nu (3,) and derivative H (3, n) of a fix see its lasting errors, in place."""
    for k in range(3):
        H[k, FIX + k] = H[k, FIX + 3 + k] = 1.0
        nu[k] -= state[FIX_ERROR + k] + state[FIX_ERROR + 3 + k]
