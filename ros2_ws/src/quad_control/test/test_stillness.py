# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from quad_control import stillness


def window(gyro, force, length=1.0, dt=0.005):
    w = np.zeros(stillness.SIZE)
    verdict = 0
    for g, f in zip(gyro, force):
        verdict = stillness.add(w, g, f, dt, length, 0.03, 0.5, 0.12)
        if verdict:
            break
    return verdict, w


def samples(seed=0, rate=0.0, shake=0.01, n=300):
    rng = np.random.default_rng(seed)
    return rate + shake * rng.standard_normal((n, 3)), 9.8 + 0.1 * rng.standard_normal((n, 3))


def test_a_still_second_gives_the_mean_and_spread_of_numpy():
    gyro, force = samples(rate=0.05)
    verdict, w = window(gyro, force)
    n = int(w[1])
    assert verdict == 1
    assert w[2:5] == pytest.approx(gyro[:n].mean(axis=0))
    assert stillness.force_spread(w) == pytest.approx(force[:n].std(axis=0, ddof=1).max())


@pytest.mark.parametrize('change', [{'shake': 0.05}, {'rate': 0.2}])
def test_shaking_or_turning_is_not_still(change):
    assert window(*samples(**change))[0] == 2


def test_a_shaken_accelerometer_is_not_still():
    gyro, force = samples()
    assert window(gyro, force * np.linspace(0.8, 1.2, 300)[:, None])[0] == 2


def test_too_few_samples_say_nothing():
    gyro, force = samples(n=6)
    assert window(gyro, force, length=1.0, dt=0.25)[0] == 2
