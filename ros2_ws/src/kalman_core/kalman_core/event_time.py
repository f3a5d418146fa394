# SPDX-License-Identifier: Apache-2.0
"""Event-time processing: samples are applied in order of their stamps whatever their order of arrival.

A late sample within the window rolls the model back and re-applies what followed, so the state and the
settled estimates do not depend on the order of arrival. Beyond the window it is dropped and counted.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from kalman_core.health import Tally

NANOSECONDS = 1_000_000_000
# Consecutive samples outside the time window, none inside in between, before the clock is believed to have
# jumped. One wild stamp must not restart a filter; a bag loop must, within 0.1 s at 100 Hz.
_JUMP_CONFIRMATIONS = 10
# Settled entries are dropped from the front of the lists in blocks, which keeps appending O(1).
_COMPACT = 256


class Model(Protocol):
    """What the buffer drives: everything that changes while filtering is in the flat array `state`."""

    state: np.ndarray

    def apply(self, port: int, sample: Any) -> Any:
        """Advance `state` to the sample's stamp, use it, and return an estimate or None."""
        ...

    def reset(self) -> None:
        """Return to the initial state, in place."""
        ...


class EventTimeBuffer:
    """Applies samples to a model in event-time order and hands out prompt and settled estimates.

    `window` (ns) is the largest delay of arrival that is repaired; `max_gap` (ns) is the largest step
    forward that one sample alone may take. Equal stamps are ordered by port; a second sample of one port
    with the same stamp is a duplicate. `names[port]` is the sensor's name in `tally`.
    """

    def __init__(
        self,
        model: Model,
        names: tuple[str, ...],
        tally: Tally,
        window: int = NANOSECONDS // 2,
        max_gap: int = 10 * NANOSECONDS,
        on_restart: Callable[[str], None] | None = None,
    ) -> None:
        self._model = model
        self._names = names
        self._tally = tally
        self._window = window
        self._max_gap = max_gap
        self._on_restart = on_restart
        self.clear()

    def clear(self) -> None:
        """Forget all samples; the model is left alone."""
        self._keys: list[tuple[int, int]] = []
        self._samples: list[Any] = []
        self._before: list[np.ndarray] = []
        self._estimates: list[Any] = []
        self._head = 0
        self._newest: int | None = None
        self._outside = 0
        self._outside_stamp = 0

    @property
    def newest(self) -> int | None:
        """The largest stamp (ns) seen and believed, or None."""
        return self._newest

    def reset(self) -> None:
        """Forget all samples and return the model to its initial state."""
        self.clear()
        self._model.reset()

    def feed(self, port: int, sample: Any) -> tuple[Any, list[Any]]:
        """Take one sample; return its prompt estimate (or None) and the estimates settled by it.

        A sample that arrives late has no prompt estimate: a newer one is already out.
        """
        stamp = sample.stamp
        newest = self._newest
        if newest is None:
            self._newest = newest = stamp
        elif stamp > newest + self._max_gap or stamp < newest - self._window:
            if not self._jumped(port, stamp, newest):
                return None, []
            newest = stamp
        self._outside = 0
        key = (stamp, port)
        keys = self._keys
        if not keys or key > keys[-1]:
            estimate = self._append(key, sample)
            self._newest = stamp
            return estimate, self._settle(stamp)
        index = bisect_left(keys, key, self._head)
        if keys[index] == key:
            self._tally.reject(self._names[port], 'duplicate stamp')
            return None, []
        self._insert(index, key, sample)
        # The newest stamp is unchanged, and nothing within the window of it is settled: nothing to hand out.
        return None, []

    def _append(self, key: tuple[int, int], sample: Any) -> Any:
        self._keys.append(key)
        self._samples.append(sample)
        self._before.append(self._model.state.copy())
        estimate = self._model.apply(key[1], sample)
        self._estimates.append(estimate)
        return estimate

    def _insert(self, index: int, key: tuple[int, int], sample: Any) -> None:
        model = self._model
        model.state[:] = self._before[index]
        self._keys.insert(index, key)
        self._samples.insert(index, sample)
        self._before.insert(index, self._before[index])
        self._estimates.insert(index, None)
        # The late sample itself is counted; those after it were counted when they came.
        self._estimates[index] = model.apply(key[1], sample)
        muted, self._tally.muted = self._tally.muted, True
        for i in range(index + 1, len(self._keys)):
            self._before[i] = model.state.copy()
            self._estimates[i] = model.apply(self._keys[i][1], self._samples[i])
        self._tally.muted = muted

    def _settle(self, newest: int) -> list[Any]:
        horizon = newest - self._window
        settled = []
        head = self._head
        keys = self._keys
        while keys[head][0] < horizon:
            if self._estimates[head] is not None:
                settled.append(self._estimates[head])
            head += 1
        self._head = head
        if head > _COMPACT:
            for column in (self._keys, self._samples, self._before, self._estimates):
                del column[:head]
            self._head = 0
        return settled

    def _jumped(self, port: int, stamp: int, newest: int) -> bool:
        """Count a sample outside the window; restart and return True when the clock itself has jumped."""
        late = stamp < newest
        self._tally.reject(self._names[port], 'older than the lag window' if late else 'stamp ahead of time')
        consistent = abs(stamp - self._outside_stamp) <= self._window + self._max_gap
        self._outside = self._outside + 1 if self._outside and consistent else 1
        self._outside_stamp = stamp
        if self._outside < _JUMP_CONFIRMATIONS:
            return False
        seconds = abs(stamp - newest) / NANOSECONDS
        reason = f'time jumped {"back" if late else "forward"} by {seconds:.3f} s'
        self._tally.restart(reason)
        self.reset()
        self._newest = stamp
        if self._on_restart is not None:
            self._on_restart(reason)
        return True
