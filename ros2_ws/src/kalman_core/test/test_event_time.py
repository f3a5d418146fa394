# SPDX-License-Identifier: Apache-2.0
import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core.event_time import AHEAD, DUPLICATE, TOO_OLD, EventTimeBuffer
from kalman_core.health import Tally

MS = 1_000_000
SECOND = 1000 * MS
START = 1_700_000_000 * SECOND
FAST, SLOW = 0, 1


class Sample(NamedTuple):
    stamp: int
    value: float


class Estimate(NamedTuple):
    stamp: int
    value: float


class Recursion:
    """A model whose state depends on every sample, its order and its time step, in all bits."""

    def __init__(self, tally=None):
        self.state = np.zeros(3)
        self.tally = tally
        self.applied = 0
        self.reset()

    def reset(self):
        self.state[:] = (0.3, -0.2, 0.0)

    def apply(self, port, sample):
        self.applied += 1
        if not math.isfinite(sample.value):
            raise ArithmeticError('this model cannot take it')
        dt = (sample.stamp - START) * 1e-9 - self.state[2]
        self.state[0] = math.cos(3.0 * self.state[0] + dt) + sample.value
        self.state[1] = 0.9 * self.state[1] + (1.0 + port) * math.sin(3.0 * self.state[0] + self.state[1])
        self.state[2] += dt
        if self.tally is not None:
            self.tally.accept(('fast', 'slow')[port], sample.stamp)
        return Estimate(sample.stamp, self.state[1]) if port == FAST else None


def make(**options):
    tally = Tally()
    model = Recursion(tally)
    return EventTimeBuffer(model, ('fast', 'slow'), tally, **options), model, tally


def feed_all(buffer, stream):
    prompt, settled = [], []
    for port, sample in stream:
        now, later = buffer.feed(port, sample)
        if now is not None:
            prompt.append(now)
        settled += later
    return prompt, settled


def stream(count, start=START, seed=0, step=10 * MS, slow_every=7):
    """A fast sensor every `step` and a slow one, some with the very stamp of a fast sample."""
    rng = np.random.default_rng(seed)
    out = []
    for i in range(count):
        stamp = start + i * step
        out.append((FAST, Sample(stamp, rng.standard_normal())))
        if i % slow_every == slow_every - 1:
            offset = 0 if i % 2 else int(rng.integers(1, step))
            out.append((SLOW, Sample(stamp + offset, rng.standard_normal())))
    return out


def reference(samples):
    """What the model says when it gets the samples in order, with no buffer."""
    model = Recursion()
    estimates = [model.apply(port, sample) for port, sample in samples]
    return model.state, [estimate for estimate in estimates if estimate is not None]


def rejected(tally, name):
    return dict(tally.sensor(name).rejected)


def test_in_order_every_prompt_estimate_is_out_at_once_and_settles_a_window_later():
    buffer, model, _ = make(window=100 * MS)
    samples = stream(40)
    state, estimates = reference(samples)
    prompt, settled = feed_all(buffer, samples)
    assert prompt == estimates
    assert np.array_equal(model.state, state)
    horizon = samples[-1][1].stamp - 100 * MS
    assert settled == [estimate for estimate in estimates if estimate.stamp < horizon]
    assert buffer.newest == samples[-1][1].stamp


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), window_ms=st.integers(0, 300))
def test_any_order_of_arrival_within_the_window_gives_the_same_state_and_settled_estimates(seed, window_ms):
    samples = stream(120, seed=seed)
    window = window_ms * MS
    delays = np.random.default_rng(seed).integers(0, window + 1, len(samples))
    arrival = sorted(range(len(samples)), key=lambda i: samples[i][1].stamp + delays[i])
    state, estimates = reference(samples)
    buffer, model, tally = make(window=window)
    _, settled = feed_all(buffer, [samples[i] for i in arrival])
    assert model.state.tobytes() == state.tobytes()
    horizon = samples[-1][1].stamp - window
    assert settled == [estimate for estimate in estimates if estimate.stamp < horizon]
    assert tally.sensor('fast').accepted + tally.sensor('slow').accepted == len(samples)
    assert not tally.sensor('fast').rejected
    assert not tally.sensor('slow').rejected


def test_equal_stamps_are_ordered_by_port_whoever_arrives_first():
    fast, slow = (FAST, Sample(START, 0.1)), (SLOW, Sample(START, 0.7))
    states = []
    for order in ((fast, slow), (slow, fast)):
        buffer, model, _ = make()
        feed_all(buffer, order)
        states.append(model.state.tobytes())
    assert states[0] == states[1] == reference([fast, slow])[0].tobytes()


@pytest.mark.parametrize('behind', [0, 3 * MS])
def test_a_late_sample_has_a_prompt_estimate_as_long_as_no_newer_one_is_out(behind):
    """A slow sensor that overtakes the fast one of the same instant must not silence it."""
    buffer, _, _ = make()
    feed_all(buffer, stream(20, slow_every=1000))
    stamp = START + 200 * MS
    assert buffer.feed(SLOW, Sample(stamp, 0.5)) == (None, [])
    prompt, _ = buffer.feed(FAST, Sample(stamp - behind, 0.25))
    expected = reference([*stream(20, slow_every=1000), (FAST, Sample(stamp - behind, 0.25))])[1][-1]
    assert prompt == expected
    assert buffer.feed(FAST, Sample(stamp - behind - 1, 0.25)) == (None, [])


def test_a_sample_exactly_the_window_old_is_used_and_one_nanosecond_older_is_dropped():
    for age, used in ((100 * MS, 1), (100 * MS + 1, 0)):
        buffer, _, tally = make(window=100 * MS)
        feed_all(buffer, stream(30, slow_every=1000))
        assert buffer.feed(SLOW, Sample(buffer.newest - age, 1.0)) == (None, [])
        assert tally.sensor('slow').accepted == used
        assert rejected(tally, 'slow') == ({} if used else {TOO_OLD: 1})


def test_duplicates_are_dropped_and_counted_in_order_and_late():
    buffer, model, tally = make(window=SECOND)
    samples = stream(30)
    state, _ = reference(samples)
    for port, sample in samples:
        buffer.feed(port, sample)
        buffer.feed(port, Sample(sample.stamp, 99.0))
    for port, sample in samples:
        buffer.feed(port, Sample(sample.stamp, -99.0))
    assert np.array_equal(model.state, state)
    assert rejected(tally, 'fast') == {DUPLICATE: 60}


def test_a_sample_that_arrives_late_is_counted_once_and_those_after_it_not_again():
    buffer, model, tally = make()
    samples = stream(40)
    late = samples.pop(20)
    feed_all(buffer, [*samples, late])
    assert model.applied > len(samples) + 10
    assert tally.sensor('fast').accepted + tally.sensor('slow').accepted == len(samples) + 1
    assert not tally.muted


@pytest.mark.parametrize('offset', [11 * SECOND, 10**6 * SECOND, -600 * MS, -(10**6) * SECOND])
def test_wild_stamps_outside_the_window_are_dropped_and_counted(offset):
    buffer, model, tally = make()
    samples = stream(300)
    state, estimates = reference(samples)
    settled = []
    for i, (port, sample) in enumerate(samples):
        settled += buffer.feed(port, sample)[1]
        if i % 9 == 8:  # up to nine in a row are no jump
            for _ in range(min(i // 30, 9)):
                assert buffer.feed(FAST, Sample(sample.stamp + offset, 5.0)) == (None, [])
    assert np.array_equal(model.state, state)
    assert settled == estimates[: len(settled)]
    assert list(rejected(tally, 'fast')) == [AHEAD if offset > 0 else TOO_OLD]
    assert tally.restarts == []


@pytest.mark.parametrize('port', [FAST, SLOW])
@pytest.mark.parametrize('offset', [600 * MS, 9 * SECOND])
@pytest.mark.parametrize('count', [20, 3000])
def test_a_stamp_that_leaps_ahead_by_less_than_the_gap_is_taken_back_without_loss(port, offset, count):
    buffer, model, tally = make()
    before, after = stream(count), stream(100, start=START + count * 10 * MS, seed=1)
    feed_all(buffer, before)
    buffer.feed(port, Sample(before[-1][1].stamp + offset, 5.0))
    prompt, settled = feed_all(buffer, after)
    samples = before + after
    state, estimates = reference(samples)
    assert np.array_equal(model.state, state)
    assert prompt[-1] == estimates[-1]
    # What was before the leap settled at once; what came after it settles as always.
    horizon = samples[-1][1].stamp - SECOND // 2
    assert settled == [e for e in estimates if after[0][1].stamp <= e.stamp < horizon]
    assert len(prompt) >= 100 - 9
    assert tally.restarts == []
    assert rejected(tally, ('fast', 'slow')[port]) == {AHEAD: 1}


def test_after_a_leap_was_taken_back_what_it_settled_stays_settled():
    buffer, _, tally = make(window=100 * MS)
    before = stream(50, slow_every=1000)
    late = before.pop(45)
    _, settled = feed_all(buffer, before)
    settled += buffer.feed(FAST, Sample(before[-1][1].stamp + SECOND, 5.0))[1]
    after = stream(50, start=START + 500 * MS, slow_every=1000)
    settled += feed_all(buffer, [*after[:12], late, *after[12:]])[1]
    stamps = [estimate.stamp for estimate in settled]
    assert stamps == sorted(set(stamps))
    assert rejected(tally, 'fast') == {AHEAD: 1, TOO_OLD: 1}


def test_after_a_leap_was_taken_back_the_stamp_before_it_is_closed_and_the_next_is_open():
    buffer, model, tally = make()
    before = [*stream(20, slow_every=1000), (SLOW, Sample(START + 195 * MS, 0.5))]
    feed_all(buffer, before)
    base = buffer.newest
    buffer.feed(FAST, Sample(base + SECOND, 5.0))
    after = [(FAST, Sample(base, 0.1)), (FAST, Sample(base + 1, 0.2))]
    after += [(FAST, Sample(base + i * 10 * MS, 0.3)) for i in range(1, 12)]
    feed_all(buffer, after)
    assert np.array_equal(model.state, reference(before + after[1:])[0])
    assert rejected(tally, 'fast') == {AHEAD: 1, TOO_OLD: 1}


@pytest.mark.parametrize(
    'jump', [-600 * MS, -SECOND, -3 * SECOND, -(10**6) * SECOND, 11 * SECOND, 10**6 * SECOND]
)
def test_a_jump_of_the_clock_restarts_after_ten_samples_and_loses_none(jump):
    reasons = []
    buffer, model, tally = make(on_restart=reasons.append)
    first = stream(500)
    feed_all(buffer, first)
    second = stream(200, start=first[-1][1].stamp + jump, seed=2)
    for port, sample in second[:9]:
        assert buffer.feed(port, sample) == (None, [])
    assert reasons == []
    prompt, settled = feed_all(buffer, second[9:])
    state, estimates = reference(second)
    assert np.array_equal(model.state, state)
    assert prompt == estimates[-len(prompt) :]
    assert settled == estimates[: len(settled)]
    assert len(settled) == 149
    word = 'back' if jump < 0 else 'forward'
    assert reasons == tally.restarts == [reasons[0]]
    assert reasons[0].startswith(f'time jumped {word} by ')
    assert rejected(tally, 'fast') == rejected(tally, 'slow') == {}
    assert tally.sensor('fast').accepted + tally.sensor('slow').accepted == len(first) + len(second)


def test_the_reason_of_a_restart_says_how_far_the_clock_jumped():
    buffer, _, tally = make()
    buffer.feed(FAST, Sample(START + 100 * SECOND, 0.0))
    feed_all(buffer, [(FAST, Sample(START + i, 0.0)) for i in range(10)])
    assert tally.restarts == ['time jumped back by 100.000 s']


def test_a_wild_first_stamp_costs_ten_samples_of_patience_and_no_data():
    for wild in (START + 3600 * SECOND, START + 3 * SECOND, 1):
        buffer, model, tally = make()
        samples = stream(100)
        feed_all(buffer, [(FAST, Sample(wild, 7.0)), *samples])
        assert np.array_equal(model.state, reference(samples)[0])
        assert tally.restart_count == 1


def test_scattered_wild_stamps_never_add_up_to_a_jump():
    buffer, _, tally = make()
    feed_all(buffer, stream(50))
    for i in range(100):
        buffer.feed(FAST, Sample(START + (100 + 50 * i) * SECOND, 0.0))
    assert tally.restarts == []
    assert rejected(tally, 'fast') == {AHEAD: 100}


def test_a_burst_of_old_samples_from_a_slow_sensor_is_no_jump():
    buffer, model, tally = make()
    samples = stream(600)
    state, _ = reference(samples)
    feed_all(buffer, samples[:500])
    feed_all(buffer, [(SLOW, Sample(START - 60 * SECOND + i * SECOND, 0.0)) for i in range(50)])
    feed_all(buffer, samples[500:])
    assert np.array_equal(model.state, state)
    assert rejected(tally, 'slow') == {TOO_OLD: 50}
    assert tally.restarts == []


def test_a_busy_sensor_that_died_does_not_block_a_jump_of_the_others_for_ever():
    buffer, _, tally = make()
    feed_all(buffer, stream(600))
    slow = [(SLOW, Sample(START - 60 * SECOND + i * 100 * MS, 0.0)) for i in range(150)]
    feed_all(buffer, slow)
    assert tally.restart_count == 1
    assert buffer.newest == slow[-1][1].stamp


def test_a_slow_sensor_whose_clock_runs_ahead_does_not_lock_out_the_busy_one():
    buffer, model, tally = make()
    samples = stream(1000, slow_every=10**6)
    used = feed_all(buffer, samples[:100])[0]
    for i, item in enumerate(samples[100:]):
        used += feed_all(buffer, [item])[0]
        if i % 8 == 0:
            buffer.feed(SLOW, Sample(item[1].stamp + 3 * SECOND, 0.0))
    assert tally.restarts == []
    assert rejected(tally, 'fast').get(TOO_OLD, 0) < 20
    assert used[-1].stamp > samples[-20][1].stamp
    assert model.state[2] < 10.0 + 3.1


def test_a_time_gap_up_to_the_limit_is_stepped_over():
    buffer, model, tally = make(max_gap=10 * SECOND)
    samples = [*stream(10), (FAST, Sample(START + 90 * MS + 10 * SECOND, 0.4))]
    feed_all(buffer, samples)
    assert np.array_equal(model.state, reference(samples)[0])
    assert not tally.sensor('fast').rejected


def test_reset_forgets_everything():
    buffer, model, _ = make()
    feed_all(buffer, stream(50))
    buffer.reset()
    assert buffer.newest is None
    samples = stream(40, start=START - 1000 * SECOND)
    feed_all(buffer, samples)
    assert np.array_equal(model.state, reference(samples)[0])


def test_a_model_that_raises_leaves_the_buffer_usable():
    buffer, model, _ = make()
    samples = stream(60)
    feed_all(buffer, samples[:30])
    with pytest.raises(ArithmeticError):
        buffer.feed(FAST, Sample(buffer.newest + 1, math.nan))
    feed_all(buffer, samples[30:])
    assert np.array_equal(model.state, reference(samples)[0])


def test_memory_stays_bounded_over_a_million_samples():
    class Constant:
        state = np.zeros(1)

        def apply(self, port, sample):
            return sample

        def reset(self):
            pass

    buffer = EventTimeBuffer(Constant(), ('fast', 'slow'), Tally(), window=500 * MS)
    settled = 0
    for i in range(1_000_000):
        settled += len(buffer.feed(FAST, Sample(START + i * 2 * MS, 0.0))[1])
        if i % 50_000 == 0:
            buffer.feed(SLOW, Sample(START - SECOND, 0.0))
    assert settled == 1_000_000 - 251
    for column in (buffer._keys, buffer._samples, buffer._before, buffer._estimates):
        assert len(column) < 251 + 2 * 256
    assert len(buffer._outside) <= 1
