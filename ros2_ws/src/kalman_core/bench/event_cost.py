# SPDX-License-Identifier: Apache-2.0
"""What the event-time buffer costs besides the model it drives."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from kalman_core.event_time import EventTimeBuffer
from kalman_core.health import Tally

STATE = 20  # elements
STEP = 2_000_000  # ns: 500 Hz
LATE = 100_000_000  # ns
START = 1_700_000_000_000_000_000  # ns


class Sample(NamedTuple):
    """A sample without content."""

    stamp: int


class Idle:
    """A model that does nothing: what is left is the buffer's own cost."""

    def __init__(self) -> None:
        self.state = np.zeros(STATE)

    def apply(self, port: int, sample: Sample) -> Sample:
        """Return the sample as its estimate."""
        return sample

    def reset(self) -> None:
        """Nothing to forget."""


def overhead(count: int, runs: int = 7) -> float:
    """Return the time (s) a sample in order takes besides the model, the least of several runs."""
    samples = [Sample(START + i * STEP) for i in range(count)]
    best = np.inf
    for _ in range(runs):
        model = Idle()
        feed, apply = EventTimeBuffer(model, ('fast', 'slow'), Tally()).feed, model.apply
        start = time.process_time()
        for sample in samples:
            feed(0, sample)
        middle = time.process_time()
        for sample in samples:
            apply(0, sample)
        best = min(best, (middle - start) - (time.process_time() - middle))
    return best / count


def late_cost(count: int) -> float:
    """Return the time (s) that one late sample takes, re-application of the 50 after it included."""
    buffer = EventTimeBuffer(Idle(), ('fast', 'slow'), Tally())
    total = 0.0
    for i in range(count):
        stamp = START + i * STEP
        buffer.feed(0, Sample(stamp))
        if i > LATE // STEP:
            start = time.process_time()
            buffer.feed(1, Sample(stamp - LATE + 1))
            total += time.process_time() - start
    return total / max(1, count - LATE // STEP - 1)
