# SPDX-License-Identifier: Apache-2.0
"""The filter over arrays: the same kernels as the streaming filter, in one jitted loop between epochs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from ins_gps import layout as at
from ins_gps.filter import MAX_STEP, NANOSECONDS, NavigationFilter
from ins_gps.plausibility import all_plausible
from ins_gps.prediction import imu_step
from ins_gps.samples import Corrections, GnssEpoch, ImuSample
from ins_gps.strapdown import NAV


@njit(cache=True, nogil=True)
def imu_series(state, channels, config, sec, nsec, rate, force, out):
    """Apply (N,) stamps and (N, 3) means of rate and force; out (N, NAV) is the solution after each."""
    for i in range(len(sec)):
        imu_step(state, channels, config, rate[i], force[i], sec[i], nsec[i])
        out[i] = state[at.NAVIGATION : at.NAVIGATION + NAV]


def advance(
    navigation: NavigationFilter, stamps: np.ndarray, rate: np.ndarray, force: np.ndarray, out: np.ndarray
) -> None:
    """Apply IMU means (N, 3) with stamps (N,) ns; out (N, NAV) is the solution after each, if there is one.

    One jitted loop where it can be; sample by sample where more than the mechanisation is asked for.
    """
    if not len(stamps):
        return
    s, params = navigation.state, navigation.params
    before = int(s[at.SEC]) * NANOSECONDS + int(s[at.NSEC])
    silent = max(int(stamps[0]) - before, int(np.diff(stamps).max(initial=0))) > MAX_STEP * NANOSECONDS
    constrained = params.zero_velocity or params.non_holonomic
    special = constrained or silent or params.mode == 'gps'
    if navigation.running and all_plausible(rate, force) and not special:
        sec, nsec = (stamps // NANOSECONDS).astype(float), (stamps % NANOSECONDS).astype(float)
        imu_series(s, navigation.channels, navigation.config, sec, nsec, rate, force, out)
        return
    for i in range(len(stamps)):
        navigation.imu(ImuSample(int(stamps[i]), rate[i], force[i]))
        if navigation.running:
            out[i] = navigation.nav


@dataclass(frozen=True, slots=True)
class History:
    """Solution after each GNSS epoch: stamps (k,), nav (k, NAV), covariance (k, 9, 9), biases (k, 6).

    fates: per epoch constellation and satellite (m, 2) beside the report (m, REPORT_WIDTH) of its rows.
    """

    stamps: np.ndarray
    nav: np.ndarray
    covariance: np.ndarray
    biases: np.ndarray
    imu_nav: np.ndarray
    fates: list[np.ndarray]


def run_batch(
    navigation: NavigationFilter,
    stamps: np.ndarray,
    rate: np.ndarray,
    force: np.ndarray,
    epochs: Sequence[GnssEpoch],
    corrections: Sequence[Corrections] = (),
) -> History:
    """Run over IMU means (N, 3) with stamps (N,) ns and over epochs, all in order of their stamps.

    A filter that is not yet running takes the IMU sample by sample until it starts. Corrections are used
    from their own stamp on. Equal stamps: IMU first, then corrections, then the epoch.
    """
    imu_nav = np.full((len(stamps), NAV), np.nan)
    records = []
    fates: list[np.ndarray] = []
    done, given = 0, 0
    ends = np.searchsorted(stamps, [epoch.stamp for epoch in epochs], side='right')
    for epoch, end in zip([*epochs, None], [*ends, len(stamps)], strict=True):
        part = slice(done, end)
        advance(navigation, stamps[part], rate[part], force[part], imu_nav[part])
        done = end
        if epoch is None:
            break
        while given < len(corrections) and corrections[given].stamp <= epoch.stamp:
            navigation.corrections(corrections[given])
            given += 1
        navigation.gnss(epoch)
        if navigation.running or navigation.coasting:
            state = navigation.state
            navigation.flush()
            fates.append(np.hstack([navigation.rows[:, :2], navigation.report]))
            records.append(
                (
                    epoch.stamp,
                    navigation.nav.copy(),
                    navigation.covariance[:9, :9].copy(),
                    state[at.ACC_BIAS : at.GYR_BIAS + 3].copy(),
                )
            )
    columns = list(zip(*records, strict=True)) if records else [[], [], [], []]
    return History(
        np.array(columns[0], dtype=np.int64),
        np.array(columns[1]).reshape(-1, NAV),
        np.array(columns[2]).reshape(-1, 9, 9),
        np.array(columns[3]).reshape(-1, 6),
        imu_nav,
        fates,
    )
