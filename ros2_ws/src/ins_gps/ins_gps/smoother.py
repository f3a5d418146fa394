# SPDX-License-Identifier: Apache-2.0
"""Forward-backward smoothing of a loosely coupled run over the kernels of the filter.

The forward pass is the filter itself; it keeps, from one record to the next, the transition it used, the
prediction and the result. The backward pass is Rauch, Tung and Striebel's, on the error states.
Source: Rauch, Tung, Striebel (1965); Groves, 2nd ed., 3.4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from ins_gps import layout as at
from ins_gps.filter import NANOSECONDS, NavigationFilter
from ins_gps.params import FilterParams
from ins_gps.prediction import (
    COVARIANCE_STEP,
    advance_covariance,
    covariance_of,
    hold_to,
    imu_step,
    inject,
    transition,
)
from ins_gps.samples import ImuSample, PositionSample, VelocitySample
from kalman_core.smoother import smoother_step

_N = 15  # position ... gyro bias; a loose run has no clock
_HEAD_SIZE = at.GYR_BIAS + 3


@njit(cache=True, nogil=True)
def _advance(state, channels, config, sec, nsec, rate, force, step, total):
    """Apply IMU samples and multiply the transitions of the covariance steps into `total`."""
    Phi = np.empty((at.NAV_STATES, at.NAV_STATES))
    for i in range(len(sec)):
        imu_step(state, channels, config, rate[i], force[i], sec[i], nsec[i])
        if state[at.SPAN] >= step - 1e-9 or (i == len(sec) - 1 and state[at.SPAN] > 0.0):
            transition(state, Phi)
            total[:, :] = Phi @ total
            advance_covariance(state, channels, config)


@dataclass(frozen=True, slots=True)
class SmoothedRun:
    """Records (k,) in ns with filtered and smoothed solutions (k, 10) and their covariances (k, 9, 9)."""

    stamps: np.ndarray
    filtered: np.ndarray
    filtered_covariance: np.ndarray
    smoothed: np.ndarray
    smoothed_covariance: np.ndarray


class LooseSmoother:
    """Runs the filter with fixes and velocities and smooths it; `record` (s) is the spacing of the output."""

    def __init__(self, params: FilterParams, record: float = 0.5) -> None:
        self.navigation = NavigationFilter(params)
        self._step = params.covariance_step
        self._record = round(record * NANOSECONDS)
        self._config = self.navigation.config.copy()
        # The forward pass advances the covariance itself, to see each transition.
        self._config[COVARIANCE_STEP] = np.inf
        self.navigation.config[COVARIANCE_STEP] = np.inf

    def run(
        self,
        stamps: np.ndarray,
        rate: np.ndarray,
        force: np.ndarray,
        samples: Sequence[PositionSample | VelocitySample],
    ) -> SmoothedRun:
        """Return the run over IMU (n,), (n, 3), (n, 3) and samples in order of their stamps."""
        navigation = self.navigation
        start, index = 0, 0
        while index < len(samples) and not navigation.running:
            end = int(np.searchsorted(stamps, samples[index].stamp, side='right'))
            for i in range(start, end):
                navigation.imu(ImuSample(int(stamps[i]), rate[i], force[i]))
            start = end
            self._use(samples[index])
            index += 1
        if not navigation.running:
            raise ValueError('no position and attitude to start from in the whole run')
        return self._smooth(*self._forward(stamps[start:], rate[start:], force[start:], samples[index:]))

    def _use(self, sample: PositionSample | VelocitySample) -> None:
        if isinstance(sample, PositionSample):
            self.navigation.position(sample)
        else:
            self.navigation.velocity(sample)

    def _forward(self, stamps, rate, force, samples):
        navigation, state = self.navigation, self.navigation.state
        sec, nsec = (stamps // NANOSECONDS).astype(float), (stamps % NANOSECONDS).astype(float)
        times = {int(s.stamp) for s in samples} | set(range(int(stamps[0]), int(stamps[-1]), self._record))
        by_time: dict[int, list] = {}
        for sample in samples:
            by_time.setdefault(int(sample.stamp), []).append(sample)
        records = []
        done = 0
        for time in sorted(t for t in times if stamps[0] <= t <= stamps[-1]):
            end = int(np.searchsorted(stamps, time, side='right'))
            total = np.eye(at.NAV_STATES)
            _advance(
                state, navigation.channels, self._config, sec[done:end], nsec[done:end], rate[done:end],
                force[done:end], self._step, total,
            )  # fmt: skip
            done = end
            # The part of an interval up to the record, between two IMU samples.
            before = np.eye(at.NAV_STATES)
            self._hold(time, before)
            total = before @ total
            predicted = (state[:_HEAD_SIZE].copy(), navigation.covariance[:_N, :_N].copy())
            for sample in by_time.get(time, ()):
                self._use(sample)
            updated = (state[:_HEAD_SIZE].copy(), navigation.covariance[:_N, :_N].copy())
            records.append((time, total[:_N, :_N], predicted, updated))
        return (records,)

    def _hold(self, time: int, total: np.ndarray) -> None:
        state, channels = self.navigation.state, self.navigation.channels
        sec, nsec = divmod(time, NANOSECONDS)
        before = state[at.SEC] + 1e-9 * state[at.NSEC]
        if (sec - state[at.SEC]) + 1e-9 * (nsec - state[at.NSEC]) <= 0.0:
            return
        probe = state.copy()
        config = self._config
        # A copy shows the transition of the short step, which the real one then makes.
        w, f = state[at.RATE : at.RATE + 3], state[at.FORCE : at.FORCE + 3]
        raw = (w + state[at.GYR_BIAS : at.GYR_BIAS + 3], f + state[at.ACC_BIAS : at.ACC_BIAS + 3])
        imu_step(probe, channels, config, *raw, float(sec), float(nsec))
        if probe[at.SPAN] > 0.0 and before > 0.0:
            transition(probe, total)
        hold_to(state, channels, config, sec, nsec)

    def _smooth(self, records) -> SmoothedRun:
        count = len(records)
        filtered = np.array([r[3][0][at.NAVIGATION : at.NAVIGATION + 10] for r in records])
        covariances = np.array([r[3][1][:9, :9] for r in records])
        smoothed, smooth_covariances = filtered.copy(), covariances.copy()
        head, P = records[-1][3]
        for k in range(count - 2, -1, -1):
            _, phi, (predicted, P_predicted), _ = records[k + 1]
            own, P_own = records[k][3]
            Q = P_predicted - phi @ P_own @ phi.T
            dx, P = smoother_step(P_own, phi, 0.5 * (Q + Q.T), _difference(head, predicted), P)
            head = self._injected(own, dx)
            smoothed[k] = head[at.NAVIGATION : at.NAVIGATION + 10]
            smooth_covariances[k] = P[:9, :9]
        return SmoothedRun(
            np.array([r[0] for r in records]), filtered, covariances, smoothed, smooth_covariances
        )

    def _injected(self, head: np.ndarray, dx: np.ndarray) -> np.ndarray:
        work = np.zeros(at.state_size(1))
        work[:_HEAD_SIZE] = head
        full = np.zeros(len(covariance_of(work, 1)))
        full[:_N] = dx
        inject(work, 1, full)
        return work[:_HEAD_SIZE].copy()


def _difference(head: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the error (15,) that leads from `reference` to `head`."""
    from ins_gps.evaluation import error_of

    out = np.empty(_N)
    nav = slice(at.NAVIGATION, at.NAVIGATION + 10)
    out[:9] = error_of(reference[nav], head[nav])
    out[9:15] = head[at.ACC_BIAS : at.GYR_BIAS + 3] - reference[at.ACC_BIAS : at.GYR_BIAS + 3]
    return out
