# SPDX-License-Identifier: Apache-2.0
"""What became of each satellite's measurements, in words: for the counts and for diagnostics."""

from __future__ import annotations

import numpy as np

from ins_gps import channels as ch
from kalman_core.health import Tally

_REFUSED = {
    ch.ROW_CODE_REJECTED: 'innovation gate',
    ch.ROW_LOW: 'below the elevation mask',
    ch.ROW_NO_ORBIT: 'no ephemeris',
    ch.ROW_DRIFTS: 'drifts away',
}
_CODE_WORDS = {
    ch.ROW_USED: 'used',
    ch.ROW_CODE_REJECTED: 'gated',
    ch.ROW_LOW: 'low',
    ch.ROW_NO_ORBIT: 'no orbit',
    ch.ROW_DRIFTS: 'drifts',
}
_RATE_WORDS = {
    ch.RATE_USED: 'carrier',
    ch.RATE_SLIP: 'slip',
    ch.RATE_NEW: 'new',
    ch.RATE_DOPPLER: 'doppler',
    ch.RATE_NONE: 'no rate',
}


def count_rows(tally: Tally, stamp: int, report: np.ndarray, gate: float) -> None:
    """Count the fates of one epoch's rows: report (m, REPORT_WIDTH)."""
    for code, rate, code_w, rate_w, _ in report:
        if code == ch.ROW_USED:
            tally.accept('gnss/code', stamp, code_w**2, gate)
        elif code in _REFUSED:
            tally.reject('gnss/code', _REFUSED[int(code)])
        if rate == ch.RATE_USED:
            tally.accept('gnss/carrier', stamp, rate_w**2, gate)
        elif rate == ch.RATE_DOPPLER:
            tally.accept('gnss/doppler', stamp, rate_w**2, gate)
        elif rate == ch.RATE_SLIP:
            tally.reject('gnss/carrier', 'cycle slip')


def fate_of(report: np.ndarray) -> str:
    """Return one row's fate (REPORT_WIDTH,) with its residuals in σ."""
    code = _CODE_WORDS.get(int(report[ch.REPORT_CODE]), 'not used')
    rate = _RATE_WORDS[int(report[ch.REPORT_RATE])]
    return f'{code} {report[ch.REPORT_CODE_W]:+.1f} σ, {rate} {report[ch.REPORT_RATE_W]:+.1f} σ'
