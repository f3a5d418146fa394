# SPDX-License-Identifier: Apache-2.0
"""Event-time processing: samples are applied in order of their stamps whatever their order of arrival.

A late sample within the window rolls the model back and re-applies what followed, so the state and the
settled estimates do not depend on the order of arrival. Beyond the window it is dropped and counted.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from kalman_core.health import Tally

NANOSECONDS = 1_000_000_000
TOO_OLD = 'older than the lag window'
AHEAD = 'stamp ahead of time'
DUPLICATE = 'duplicate stamp'

# Consecutive samples outside the time window, none inside in between, before the clock is believed to have
# jumped. One wild stamp must not restart a filter; a bag loop must, within 0.1 s at 100 Hz.
_JUMP_CONFIRMATIONS = 10
# The same without the sensor that is usually the busiest: a burst of old samples from a slow one (a radio
# link that recovers) is no jump of the clock, but a busy sensor that died must not block the others for ever.
_JUMP_CONFIRMATIONS_ALONE = 100
# Settled entries are dropped from the front of the lists in blocks, which keeps appending O(1).
_COMPACT = 256


class Model(Protocol):
    """What the buffer drives."""

    @property
    def state(self) -> np.ndarray:
        """The flat array that holds everything that changes while filtering."""
        ...

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
        # Parallel columns in order of key; entries before `_head` are settled.
        self._keys: list[tuple[int, int]] = []
        self._samples: list[Any] = []
        self._before: list[np.ndarray] = []
        self._estimates: list[Any] = []
        self._head = 0
        self._newest: int | None = None
        # Stamps below the floor are settled and closed; it is `window` behind the newest stamp.
        self._floor = 0
        self._busiest: int | None = None
        self._outside: list[tuple[int, Any]] = []

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

        A sample that arrives late has a prompt estimate only if no newer one is out yet.
        """
        stamp = sample.stamp
        newest = self._newest
        if newest is None:
            self._floor = stamp - self._window
        elif stamp > newest + self._max_gap or stamp < self._floor:
            return self._feed_outside(port, sample)
        if self._outside:
            self._clear_outside(port)
        key = (stamp, port)
        keys = self._keys
        if not keys or key > keys[-1]:
            before = self._model.state.copy()
            estimate = self._model.apply(port, sample)
            keys.append(key)
            self._samples.append(sample)
            self._before.append(before)
            self._estimates.append(estimate)
            self._newest = stamp
            return estimate, self._settle(stamp)
        index = bisect_left(keys, key, self._head)
        if keys[index] == key:
            self._tally.reject(self._names[port], DUPLICATE)
            return None, []
        # The newest stamp is unchanged, and nothing within the window of it is settled.
        return self._insert(index, key, sample), []

    def _insert(self, index: int, key: tuple[int, int], sample: Any) -> Any:
        """Roll back to `index`, use the late sample there and re-apply all that follow it.

        Returns its estimate, or None if one of those that follow has an estimate too.
        """
        model = self._model
        before = self._before[index]
        model.state[:] = before
        # The late sample itself is counted; those after it were counted when they came.
        prompt = model.apply(key[1], sample)
        self._keys.insert(index, key)
        self._samples.insert(index, sample)
        self._before.insert(index, before)
        self._estimates.insert(index, prompt)
        muted, self._tally.muted = self._tally.muted, True
        try:
            for i in range(index + 1, len(self._keys)):
                self._before[i] = model.state.copy()
                self._estimates[i] = estimate = model.apply(self._keys[i][1], self._samples[i])
                if estimate is not None:
                    prompt = None
        finally:
            self._tally.muted = muted
        return prompt

    def _settle(self, newest: int) -> list[Any]:
        """Move the floor to `window` behind `newest` and return the estimates that fell below it."""
        floor = newest - self._window
        settled: list[Any] = []
        if floor <= self._floor:
            return settled
        self._floor = floor
        head = self._head
        keys = self._keys
        while keys[head][0] < floor:
            if self._estimates[head] is not None:
                settled.append(self._estimates[head])
            head += 1
        if head > _COMPACT:
            self._busiest = self._busiest_port()
            # One settled entry stays: `_undo_leap` asks what came before the first open one.
            for column in (keys, self._samples, self._before, self._estimates):
                del column[: head - 1]
            head = 1
        self._head = head
        return settled

    def _busiest_port(self) -> int:
        return Counter(port for _, port in self._keys).most_common(1)[0][0]

    def _known_busiest(self) -> int:
        return self._busiest_port() if self._busiest is None else self._busiest

    def _clear_outside(self, port: int) -> None:
        """Drop what was set aside: a sample of `port` inside the window shows that the clock still runs.

        Unless `port` is a slow sensor and others are set aside: then its own clock may be the wrong one.
        """
        if port == self._known_busiest() or any(port == other for other, _ in self._outside):
            self._outside.clear()

    def _feed_outside(self, port: int, sample: Any) -> tuple[Any, list[Any]]:
        """Set aside a sample outside the window; once enough agree that the clock has jumped, use them."""
        stamp = sample.stamp
        self._tally.reject(self._names[port], self._reason(stamp))
        outside = self._outside
        if outside and abs(stamp - outside[-1][1].stamp) > self._window + self._max_gap:
            outside.clear()
        outside.append((port, sample))
        busiest = self._known_busiest()
        together = any(other == busiest for other, _ in outside)
        if len(outside) < (_JUMP_CONFIRMATIONS if together else _JUMP_CONFIRMATIONS_ALONE):
            return None, []
        for other, earlier in outside:
            self._tally.withdraw(self._names[other], self._reason(earlier.stamp))
        if not self._undo_leap(outside[0][1].stamp):
            self._restart(stamp)
        prompt, settled = None, []
        self._outside = []
        for other, earlier in outside:
            prompt, more = self.feed(other, earlier)
            settled += more
        return prompt, settled

    def _reason(self, stamp: int) -> str:
        return TOO_OLD if stamp < self._floor else AHEAD

    def _restart(self, stamp: int) -> None:
        assert self._newest is not None
        seconds = (stamp - self._newest) / NANOSECONDS
        reason = f'time jumped {"back" if seconds < 0.0 else "forward"} by {abs(seconds):.3f} s'
        self._tally.restart(reason)
        self.reset()
        if self._on_restart is not None:
            self._on_restart(reason)

    def _undo_leap(self, stamp: int) -> bool:
        """Take back the samples whose stamps had leapt ahead, if the clock is back where it was before them.

        `stamp` is the first of those that contradict them. What was settled because of the leap stays so.
        """
        keys = self._keys
        first = bisect_left(keys, (stamp + self._window + 1, 0))
        if not 0 < first < len(keys):
            return False
        base = keys[first - 1][0]
        if keys[first][0] - base <= self._window:
            return False
        for _, port in keys[first:]:
            self._tally.reject(self._names[port], AHEAD)
        self._model.state[:] = self._before[first]
        for column in (keys, self._samples, self._before, self._estimates):
            del column[first:]
        self._head = first
        self._newest = base
        self._floor = base + 1
        return True
