# SPDX-License-Identifier: Apache-2.0
"""The attitude filter over arrays: the kernels of the streaming estimator in one compiled loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from imu_kalman.attitude_kernel import attitude_cov, carried, inertial_step, magnetic_step
from imu_kalman.attitude_layout import BIAS, MIN_FIELD, PHASE, STATE, WORK, N, pack
from imu_kalman.params import AttitudeParams
from kalman_core.event_time import NANOSECONDS


class AttitudeArrays(NamedTuple):
    """Attitude at every inertial sample; rows before the filter has started are NaN.

    `orientation` (n, 4): wxyz, body to local level (ENU, y towards magnetic north); `covariance` (n, 6):
    upper triangle xx, xy, xz, yy, yz, zz of the attitude error about local-level axes (rad²); `bias`
    (n, 3): gyro bias (rad/s).
    """

    orientation: np.ndarray
    covariance: np.ndarray
    bias: np.ndarray


class Recording(NamedTuple):
    """Samples as the kernels take them: stamps split exactly, unusable rows marked, fields counted.

    `field_end[i]` is the number of field samples that come before inertial row i + 1.
    """

    sec: np.ndarray
    nanosec: np.ndarray
    gyr: np.ndarray
    acc: np.ndarray
    usable: np.ndarray
    mag: np.ndarray
    mag_sec: np.ndarray
    mag_nanosec: np.ndarray
    mag_usable: np.ndarray
    field_end: np.ndarray


def _within(rows: np.ndarray, limit: float) -> np.ndarray:
    # Written so that NaN fails it.
    x, y, z = np.abs(rows).T
    return (x <= limit) & (y <= limit) & (z <= limit)


def _alive(rows: np.ndarray, least: float, limit: float) -> np.ndarray:
    return _within(rows, limit) & (np.abs(rows) > least).any(axis=1)


def _in_order(stamp: np.ndarray) -> np.ndarray:
    fresh = np.ones(len(stamp), dtype=np.bool_)
    if len(stamp) > 1:
        fresh[1:] = stamp[1:] > np.maximum.accumulate(stamp)[:-1]
    return fresh


def _split(stamp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    sec, nanosec = np.divmod(stamp, NANOSECONDS)
    return sec.astype(float), nanosec.astype(float)


def prepare(
    params: AttitudeParams,
    stamp: np.ndarray,
    gyr: np.ndarray,
    acc: np.ndarray,
    mag: np.ndarray | None,
    mag_stamp: np.ndarray | None,
) -> Recording:
    """Check shapes and mark the rows that the streaming estimator would reject.

    Raises ValueError, which says the array and its expected shape.
    """
    stamp = np.ascontiguousarray(stamp, dtype=np.int64)
    n = len(stamp)
    if mag is None:
        mag, mag_stamp = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    elif mag_stamp is None:
        mag_stamp = stamp
    else:
        mag_stamp = np.asarray(mag_stamp, dtype=np.int64)
    arrays = []
    for name, rows, count in (('gyr', gyr, n), ('acc', acc, n), ('mag', mag, len(mag_stamp))):
        array = np.ascontiguousarray(rows, dtype=float)
        if array.shape != (count, 3):
            raise ValueError(f'{name} has shape {array.shape}, expected ({count}, 3)')
        arrays.append(array)
    gyr, acc, mag = arrays
    usable = _in_order(stamp) & _within(gyr, params.max_rate) & _alive(acc, 0.0, params.max_force)
    mag_usable = _in_order(mag_stamp) & _alive(mag, MIN_FIELD, params.max_field)
    sec, nanosec = _split(stamp)
    if mag_stamp is stamp:
        mag_sec, mag_nanosec = sec, nanosec
        field_end = np.arange(1, n + 1)
    else:
        mag_sec, mag_nanosec = _split(mag_stamp)
        # A field sample belongs after the last inertial sample that is not younger.
        order = np.maximum.accumulate(stamp) if n else stamp
        field_end = np.searchsorted(mag_stamp, np.append(order[1:], np.iinfo(np.int64).max)[:n], 'left')
    return Recording(sec, nanosec, gyr, acc, usable, mag, mag_sec, mag_nanosec, mag_usable, field_end)


@njit(cache=True, nogil=True)
def write_estimate(state, par, i, orientation, covariance, bias):
    """Store the present estimate as row `i`; `covariance` and `bias` may have no rows."""
    if state[PHASE] == 0.0:
        orientation[i] = np.nan
        return
    carried(state, par, orientation[i])
    if covariance.shape[0] > 0:
        k = 0
        for a in range(3):
            for b in range(a, 3):
                covariance[i, k] = attitude_cov(state, par, a, b)
                k += 1
        for a in range(3):
            bias[i, a] = state[BIAS + a]


@njit(cache=True, nogil=True)
def feed_fields(state, par, data, first, last):
    """Hand the field samples first … last - 1 to the filter; returns `last`."""
    for j in range(first, last):
        if data.mag_usable[j]:
            magnetic_step(
                state,
                par,
                data.mag_sec[j],
                data.mag_nanosec[j],
                data.mag[j, 0],
                data.mag[j, 1],
                data.mag[j, 2],
            )
    return last


@njit(cache=True, nogil=True)
def feed_inertial(state, par, work, data, i):
    """Hand inertial row `i` to the filter; returns the code of the step."""
    gyr = data.gyr
    acc = data.acc
    return inertial_step(
        state,
        par,
        work,
        data.sec[i],
        data.nanosec[i],
        gyr[i, 0],
        gyr[i, 1],
        gyr[i, 2],
        acc[i, 0],
        acc[i, 1],
        acc[i, 2],
    )


@njit(cache=True, nogil=True)
def filter_arrays(state, par, data, orientation, covariance, bias):
    """Run the filter from `state` over a Recording; fills (n, 4), and unless empty (n, 6) and (n, 3)."""
    work = np.zeros((WORK, N, N))
    field = 0
    for i in range(data.gyr.shape[0]):
        if data.usable[i]:
            feed_inertial(state, par, work, data, i)
        write_estimate(state, par, i, orientation, covariance, bias)
        field = feed_fields(state, par, data, field, data.field_end[i])


def filter_batch(
    stamp: np.ndarray,
    gyr: np.ndarray,
    acc: np.ndarray,
    mag: np.ndarray | None = None,
    *,
    mag_stamp: np.ndarray | None = None,
    params: AttitudeParams | None = None,
    covariance: bool = True,
    state: np.ndarray | None = None,
) -> AttitudeArrays:
    """Estimate attitude causally at every inertial sample, bit for bit as the streaming estimator does.

    `stamp` (n,) int ns; `gyr` (n, 3) rad/s; `acc` (n, 3) m/s² specific force; `mag` (m, 3) T, at `mag_stamp`
    (m,) or at the inertial stamps. Rows the streaming estimator rejects repeat the last estimate. Without
    `covariance` the last two results have no rows. `state` (STATE,), zeros to begin with, is where filtering
    starts from and holds where it ended. Raises ValueError for arrays of the wrong shape.
    """
    params = params if params is not None else AttitudeParams()
    data = prepare(params, stamp, gyr, acc, mag, mag_stamp)
    n = len(data.gyr)
    rows = n if covariance else 0
    out = AttitudeArrays(np.empty((n, 4)), np.full((rows, 6), np.nan), np.full((rows, 3), np.nan))
    filter_arrays(np.zeros(STATE) if state is None else state, pack(params), data, *out)
    return out
