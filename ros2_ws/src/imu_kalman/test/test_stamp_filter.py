# SPDX-License-Identifier: Apache-2.0
"""When samples were taken, though only the times of reading them are known."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mpu6050_rig import SECOND

from imu_kalman.stamp_filter import StampFilter


@settings(max_examples=25, deadline=None)
@given(
    counts=st.lists(st.integers(1, 40), min_size=2, max_size=40),
    error=st.floats(-0.02, 0.02),
    seed=st.integers(0, 1000),
)
def test_stamps_increase_and_lie_in_the_past(counts, error, seed):
    rng = np.random.default_rng(seed)
    period = 0.005
    real = period * (1.0 + error)
    stamps, filter_, newest = [], StampFilter(period), 10.0
    for count in counts:
        newest += count * real
        look = newest + rng.uniform(0.0, real)
        got = filter_.update(count, int((look - filter_.period) * 1e9), int(look * 1e9))
        assert len(got) == count
        stamps += got
        assert got[-1] <= look * 1e9 + 0.5e9 * period
    assert (np.diff(stamps) > 0).all()
    assert filter_.restarts == 0


def run(filter_, now, count, period=10_000_000):
    for _ in range(count):
        now += period
        stamps = filter_.update(1, now - period, now)
    return now, stamps


def test_a_clock_set_back_while_samples_were_lost_leaves_no_stamp_in_the_future():
    filter_ = StampFilter(0.01)
    now, _ = run(filter_, 5000 * SECOND, 100)
    filter_.reset()
    now, stamps = run(filter_, now - 3600 * SECOND, 1)
    assert filter_.restarts == 1
    assert stamps[-1] <= now
    _, stamps = run(filter_, now, 100)
    assert filter_.restarts == 1


def test_lost_samples_alone_restart_nothing():
    filter_ = StampFilter(0.01)
    now, before = run(filter_, 5000 * SECOND, 100)
    for _ in range(10):
        filter_.reset()
        now, stamps = run(filter_, now, 3)
        assert stamps[-1] > before[-1]
        before = stamps
    assert filter_.restarts == 0


def test_a_chip_that_warms_up_stays_within_what_the_stamps_say_of_themselves():
    rng, filter_, errors = np.random.default_rng(0), StampFilter(0.005), []
    real, taken, now = 0.00505, 0.0, 0.0
    for _ in range(12_000):
        now, count = now + 0.01 + rng.uniform(0.0, 2e-5), 0
        while taken + real <= now:
            taken, count = taken + real, count + 1
            if now > 60.0:
                real += 0.005 * 1e-4 * 0.005 / 60.0  # 1e-4 in a minute
        if count:
            look = 10 * SECOND + int(now * SECOND)
            stamps = filter_.update(count, look - int(filter_.period * SECOND), look)
            errors.append(stamps[-1] / SECOND - 10.0 - taken)
    assert abs(np.mean(errors[-3000:])) < filter_.sigma


def test_a_stepped_clock_restarts_the_stamps_and_is_counted():
    period, filter_ = 0.01, StampFilter(0.01)
    now = 50 * SECOND
    for _ in range(100):
        now += 10_000_000
        filter_.update(1, now - 10_000_000, now)
    assert filter_.restarts == 0
    now -= 20 * SECOND
    stamps = filter_.update(1, now - 10_000_000, now)
    assert filter_.restarts == 1
    assert abs(stamps[0] - now) <= period * SECOND
