# SPDX-License-Identifier: Apache-2.0
"""Fixed-interval smoothing of any run of the filter: the filter's own kernels forwards, then backwards.

The forward pass is the filter on a state that also carries a frozen copy of its own errors at the last
anchor (an epoch, or one of a grid where none comes). The kernels keep the copy's covariance with the current
errors through everything they do: prediction, updates, new clones, new satellites, cleared errors. So at the
next anchor the filter itself says what the measurements since have changed at the last one and how the two
are correlated, and the backward pass needs no model of what happened in between:

    x_k|N = x_k|k+1 + C (x_k+1|N − x_k+1|k+1),   C = Cov(x_k, x_k+1 | k+1) P_k+1⁻¹
    P_k|N = P_k|k+1 − C P_k+1 Cᵀ + C P_k+1|N Cᵀ

Source: Rauch, Tung, Striebel (1965) in the form of a one-step smoothed estimate; Särkkä, "Bayesian
Filtering and Smoothing" (2013), 8.2; Roumeliotis and Burdick (2002) for the cloned state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from ins_gps import layout as at
from ins_gps.batch import advance
from ins_gps.filter import NANOSECONDS, NavigationFilter
from ins_gps.params import FilterParams
from ins_gps.prediction import covariance_of, hold_to, signatures_of
from ins_gps.samples import Corrections, GnssEpoch, PositionSample, VelocitySample
from ins_gps.solution import displaced, error_of
from ins_gps.strapdown import NAV
from kalman_core.parameters import ParameterError

Aid = GnssEpoch | Corrections | PositionSample | VelocitySample

_CLONES = at.CHANNEL - at.CLONE
# Added to the correlation matrix that is inverted: what rounding leaves of it is not information.
_RIDGES = (1e-13, 1e-11, 1e-9)


@njit(cache=True, nogil=True)
def _freeze(state, channels):
    """Make the frozen copy one of the errors as they are now."""
    P = covariance_of(state, channels)
    own = at.CHANNEL + at.PER_CHANNEL * channels
    copies = P.shape[0] - own
    for i in range(copies):
        source = i if i < at.CLONE else i + _CLONES
        for k in range(own):
            P[own + i, k] = P[source, k]
            P[k, own + i] = P[source, k]
    for i in range(copies):
        source = i if i < at.CLONE else i + _CLONES
        for k in range(copies):
            P[own + k, own + i] = P[own + k, source]
    F = signatures_of(state, channels)
    for i in range(copies):
        F[:, own + i] = F[:, i if i < at.CLONE else i + _CLONES]
    state[len(state) - copies :] = 0.0


@njit(cache=True, nogil=True)
def _spread(seconds, nav, start, end, first, last, out):
    """Move solutions nav (n, NAV) at `seconds` (n,) by errors (9,) interpolated from `start` to `end`."""
    span = max(end - start, 1e-9)
    for i in range(len(seconds)):
        share = min(1.0, max(0.0, (seconds[i] - start) / span))
        out[i] = displaced(nav[i], -(first + share * (last - first)))


@dataclass(frozen=True, slots=True)
class SmoothedRun:
    """A smoothed run.

    At the anchors `stamps` (k,) ns: filtered and smoothed solutions (k, NAV) with covariances (k, 9, 9) and
    the smoothed biases (k, 6). At the IMU's stamps `imu_stamps` (n,): the smoothed solution (n, NAV).
    """

    stamps: np.ndarray
    filtered: np.ndarray
    filtered_covariance: np.ndarray
    smoothed: np.ndarray
    smoothed_covariance: np.ndarray
    biases: np.ndarray
    imu_stamps: np.ndarray
    imu_smoothed: np.ndarray
    navigation: NavigationFilter

    def covariance_at(self, stamp: int) -> np.ndarray:
        """Return the smoothed covariance (9, 9) at a stamp, linear between the anchors around it."""
        right = int(np.clip(np.searchsorted(self.stamps, stamp), 1, max(len(self.stamps) - 1, 1)))
        if len(self.stamps) == 1:
            return self.smoothed_covariance[0]
        left = right - 1
        share = (stamp - self.stamps[left]) / max(self.stamps[right] - self.stamps[left], 1)
        share = min(1.0, max(0.0, float(share)))
        return (1.0 - share) * self.smoothed_covariance[left] + share * self.smoothed_covariance[right]


@dataclass(slots=True)
class _Anchor:
    """One anchor; `gain` None: nothing after it says anything of it (the filter started anew)."""

    stamp: int
    predicted: np.ndarray  # (NAV,) just before its measurements
    filtered: np.ndarray  # (NAV,)
    covariance: np.ndarray  # (9, 9)
    biases: np.ndarray  # (6,)
    done: int  # IMU samples used so far
    own: np.ndarray  # indices of the errors that exist
    step: np.ndarray  # what the next anchor's measurements change, of `own`
    spread: np.ndarray  # P_k|k+1 − C P_k+1 Cᵀ, or P_k where there is no gain
    gain: np.ndarray | None = None  # (own, own of the next)


class Smoother:
    """Runs the filter over IMU and aids of any kind and smooths it.

    interval: s between anchors where no aid comes, so that the covariance is known through outages.
    """

    def __init__(self, params: FilterParams, interval: float = 1.0) -> None:
        if params.mode == 'gps':
            raise ParameterError("parameter 'mode' is gps, which has no memory that could be smoothed")
        self.navigation = NavigationFilter(params, copies=at.copied_states(params.channels))
        self._interval = round(interval * NANOSECONDS)

    def run(
        self, stamps: np.ndarray, rate: np.ndarray, force: np.ndarray, aids: Sequence[Aid]
    ) -> SmoothedRun:
        """Return the run over IMU means (n,) ns, (n, 3), (n, 3) and aids, both in order of their stamps.

        The filter starts by itself unless `navigation.initialise` was called. Raises ValueError if it never
        does.
        """
        imu_nav = np.full((len(stamps), NAV), np.nan)
        anchors = self._forward(stamps, rate, force, aids, imu_nav)
        if not anchors:
            raise ValueError('no position and attitude to start from in the whole run')
        return self._backward(anchors, stamps, imu_nav)

    def _forward(self, stamps, rate, force, aids, imu_nav) -> list[_Anchor]:
        navigation = self.navigation
        anchors: list[_Anchor] = []
        done = given = 0
        while given < len(aids) or done < len(stamps):
            aid = int(aids[given].stamp) if given < len(aids) else None
            time = self._next(stamps, done, aid, anchors)
            end = int(np.searchsorted(stamps, time, side='right'))
            chunk = slice(done, end)
            advance(navigation, stamps[chunk], rate[chunk], force[chunk], imu_nav[chunk])
            done = end
            if navigation.running:
                sec, nsec = divmod(time, NANOSECONDS)
                hold_to(navigation.state, navigation.channels, navigation.config, sec, nsec)
            predicted = navigation.nav.copy()
            while given < len(aids) and aids[given].stamp <= time:
                self._use(aids[given])
                given += 1
            navigation.flush()
            if not navigation.running:
                continue
            self._link(anchors, time, predicted, done)
        return anchors

    def _next(self, stamps, done: int, aid: int | None, anchors: list[_Anchor]) -> int:
        """Return the time (ns) of the next anchor: the next aid, or an IMU sample if none comes soon."""
        last = int(stamps[-1])
        if not anchors:
            return aid if aid is not None else last
        index = int(np.searchsorted(stamps, anchors[-1].stamp + self._interval))
        grid = int(stamps[max(index, done)]) if max(index, done) < len(stamps) else last
        if aid is None:
            return max(grid, anchors[-1].stamp)
        return min(grid, aid) if grid > anchors[-1].stamp else aid

    def _use(self, aid: Aid) -> None:
        navigation = self.navigation
        if isinstance(aid, GnssEpoch):
            navigation.gnss(aid)
        elif isinstance(aid, Corrections):
            navigation.corrections(aid)
        elif isinstance(aid, PositionSample):
            navigation.position(aid)
        else:
            navigation.velocity(aid)

    def _link(self, anchors: list[_Anchor], time: int, predicted, done: int) -> None:
        """Append the anchor of the present state and tie the last one to it."""
        navigation = self.navigation
        state, channels = navigation.state, navigation.channels
        P = navigation.covariance
        own = np.r_[0 : at.CLONE, at.CHANNEL : at.error_states(channels)]
        exist = own[np.diag(P)[own] > 0.0]
        count = len(own)
        frozen = len(P) - count
        # A filter that started anew has forgotten the copy.
        if anchors and P[frozen, frozen] > 0.0:
            last = anchors[-1]
            step = state[len(state) - count :]
            index = np.searchsorted(own, last.own)
            cross = P[np.ix_(frozen + index, exist)]
            P_last = P[np.ix_(frozen + index, frozen + index)]
            last.gain = _gain(cross, P[np.ix_(exist, exist)])
            spread = P_last - last.gain @ cross.T
            last.spread = 0.5 * (spread + spread.T)
            last.step = step[index].copy()
        _freeze(state, channels)
        anchors.append(
            _Anchor(
                time,
                predicted,
                navigation.nav.copy(),
                P[:9, :9].copy(),
                state[at.ACC_BIAS : at.GYR_BIAS + 3].copy(),
                done,
                exist,
                np.zeros(len(exist)),
                P[np.ix_(exist, exist)].copy(),
            )
        )

    def _backward(self, anchors: list[_Anchor], stamps, imu_nav) -> SmoothedRun:
        count = len(anchors)
        size = at.error_states(self.navigation.channels)
        changes = np.zeros((count, 15))
        covariances = np.empty((count, 9, 9))
        smoothed = np.empty((count, NAV))
        later, P = np.zeros(0), np.zeros((0, 0))
        for k in range(count - 1, -1, -1):
            anchor = anchors[k]
            change, spread = anchor.step, anchor.spread
            if anchor.gain is not None:
                change = change + anchor.gain @ later
                spread = spread + anchor.gain @ P @ anchor.gain.T
            later, P = change, spread
            whole, whole_P = np.zeros(size), np.zeros((size, size))
            whole[anchor.own] = change
            whole_P[np.ix_(anchor.own, anchor.own)] = spread
            changes[k], covariances[k] = whole[:15], whole_P[:9, :9]
            smoothed[k] = displaced(anchor.filtered, -changes[k, :9])
            if k + 1 < count and anchor.gain is not None:
                right = error_of(anchors[k + 1].predicted, smoothed[k + 1])
                part = slice(anchor.done, anchors[k + 1].done)
                seconds = (stamps[part] - anchor.stamp) * 1e-9
                span = (anchors[k + 1].stamp - anchor.stamp) * 1e-9
                _spread(seconds, imu_nav[part].copy(), 0.0, span, changes[k, :9], right, imu_nav[part])
        there = np.isfinite(imu_nav[:, 0])
        there[: anchors[0].done] = False
        return SmoothedRun(
            np.array([a.stamp for a in anchors], dtype=np.int64),
            np.array([a.filtered for a in anchors]),
            np.array([a.covariance for a in anchors]),
            smoothed,
            covariances,
            np.array([a.biases for a in anchors]) + changes[:, 9:15],
            stamps[there],
            imu_nav[there],
            self.navigation,
        )


def _gain(cross: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return ``cross P⁻¹``; P (m, m) may be singular to rounding."""
    scale = np.sqrt(np.diag(P))
    correlation = P / np.outer(scale, scale)
    for ridge in _RIDGES:
        try:
            factor = cho_factor(correlation + ridge * np.eye(len(P)), lower=True, check_finite=False)
        except LinAlgError:
            continue
        return cho_solve(factor, (cross / scale).T, check_finite=False).T / scale
    return np.zeros_like(cross)
