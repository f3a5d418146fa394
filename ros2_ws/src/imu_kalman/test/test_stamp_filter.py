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
