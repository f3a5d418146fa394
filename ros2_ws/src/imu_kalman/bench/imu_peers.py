# SPDX-License-Identifier: Apache-2.0
"""Peers of the attitude filter behind one call: arrays in, (n, 4) wxyz body to ENU (magnetic north) out."""

from __future__ import annotations

import math

import numpy as np

# Standard gravity (m/s²): imufusion takes forces in g.
_GRAVITY = 9.80665


def vqf(gyr: np.ndarray, acc: np.ndarray, mag: np.ndarray, rate: float) -> np.ndarray:
    """VQF (C++), default parameters."""
    from vqf import VQF

    return VQF(1.0 / rate).updateBatch(gyr, acc, mag)['quat9D']


def offline_vqf(gyr: np.ndarray, acc: np.ndarray, mag: np.ndarray, rate: float) -> np.ndarray:
    """VQF's acausal variant (C++), default parameters."""
    from vqf import offlineVQF

    return offlineVQF(gyr, acc, mag, 1.0 / rate)['quat9D']


def imufusion(gyr: np.ndarray, acc: np.ndarray, mag: np.ndarray, rate: float) -> np.ndarray:
    """x-io Fusion with the settings its own example recommends, turned from its north-west-up to ENU."""
    import imufusion as fusion

    ahrs = fusion.Ahrs()
    ahrs.set_settings(
        fusion.AhrsSettings(
            sample_rate=rate,
            convention=fusion.CONVENTION_NWU,
            gain=0.5,
            gyroscope_range=2000,
            acceleration_rejection=10,
            magnetic_rejection=10,
            rejection_timeout=5.0,
        )
    )
    out = np.empty((len(gyr), 4))
    for i, (w, f, m) in enumerate(zip(np.degrees(gyr), acc / _GRAVITY, mag)):
        ahrs.update(w, f, m)
        out[i] = ahrs.get_quaternion()
    return _north_to_enu(out)


def ahrs_madgwick(gyr: np.ndarray, acc: np.ndarray, mag: np.ndarray, rate: float) -> np.ndarray:
    """Madgwick's filter as `ahrs` ships it, default gain, turned from x north to ENU."""
    from ahrs.filters import Madgwick

    return _north_to_enu(Madgwick(gyr=gyr, acc=acc, mag=mag, frequency=rate).Q)


def qmt_basic_vqf(gyr: np.ndarray, acc: np.ndarray, mag: np.ndarray, rate: float) -> np.ndarray:
    """The basic VQF as `qmt` offers it (its own native filters do not load beside NumPy 2)."""
    import qmt

    return qmt.oriEstBasicVQF(gyr, acc, mag, params={'Ts': 1.0 / rate})


def _north_to_enu(quat: np.ndarray) -> np.ndarray:
    """Turn attitudes whose x is north (rows wxyz) into attitudes whose y is north."""
    w, x, y, z = quat.T
    root = math.sqrt(0.5)
    return root * np.stack([w - z, x - y, x + y, w + z], axis=1)


CAUSAL = {
    'VQF': vqf,
    'imufusion': imufusion,
    'ahrs Madgwick': ahrs_madgwick,
    'qmt BasicVQF': qmt_basic_vqf,
}
