# SPDX-License-Identifier: Apache-2.0
"""The noise that the IMU's samples show: found where it is, and not found where there is none."""

from dataclasses import replace

import numpy as np
import pytest

from ins_gps import layout as at
from ins_gps.evaluation import evaluate, filter_params
from ins_gps.simulation import DGPS, Outage, Scenario
from ins_gps.simulation_gnss import simulate
from ins_gps.vibration import measure_noise, noise_density

RATE = 100.0  # Hz
GYRO, ACCEL = 1e-4**2, 2e-3**2  # (rad/s)²/Hz, (m/s²)²/Hz
STILL = np.array([0.0, 0.0, -9.8])


def densities(rate, force, *, step=1.0 / RATE, state=None, start=0):
    """Return the six densities after samples (n, 3), (n, 3) at `step` (s)."""
    state = np.zeros(at.HEAD) if state is None else state
    for k in range(len(rate)):
        sec, nsec = divmod(round((start + k) * step * 1e9), 1_000_000_000)
        measure_noise(state, rate[k], force[k], sec, nsec, GYRO, ACCEL, 0.1)
    return state[at.NOISE_PSD : at.NOISE_PSD + 6].copy()


def samples(seconds, rate=0.0, force=0.0, seed=0):
    """Return samples of a craft at rest with white noise of the densities' roots `rate` and `force`."""
    n = round(seconds * RATE)
    noise = np.random.default_rng(seed).standard_normal((2, n, 3)) * RATE**0.5
    return rate * noise[0], STILL + force * noise[1]


@pytest.mark.parametrize('step', [1 / 200.0, 1 / RATE, 1 / 20.0])
def test_white_noise_has_its_density_at_any_rate(step):
    scale = (RATE * step) ** -0.5
    rate, force = samples(60.0, 3e-3 * scale, 5e-2 * scale)
    found = densities(rate, force, step=step)
    np.testing.assert_allclose(found[:3], 3e-3**2, rtol=0.35)
    np.testing.assert_allclose(found[3:], 5e-2**2, rtol=0.35)


def test_motion_is_not_noise():
    t = np.arange(0.0, 30.0, 1.0 / RATE)
    swing = np.sin(2.0 * np.pi * 1.0 * t)[:, None] * np.ones(3)
    assert (densities(1.0 * swing, STILL + 3.0 * swing) < [*[GYRO] * 3, *[ACCEL] * 3]).all()


def test_each_axis_has_its_own():
    rate, force = samples(40.0, 1e-4, 2e-3)
    rate[:, 1] *= 50.0
    found = densities(rate, force)
    assert found[1] > 1000.0 * GYRO
    assert (found[[0, 2]] < 2.0 * GYRO).all()
    east = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # heading 90°
    state, out = np.zeros(at.HEAD), np.empty((3, 3))
    state[at.NOISE_PSD : at.NOISE_PSD + 6] = found
    noise_density(state, 0, GYRO, 1.0, east, out)
    np.testing.assert_allclose(np.diag(out), np.maximum(found[[1, 0, 2]], GYRO))
    noise_density(state, 0, GYRO, 0.0, east, out)
    np.testing.assert_allclose(out, GYRO * np.eye(3), atol=1e-20)


def test_a_jolt_or_a_glitch_is_no_noise_and_vibration_is_noticed_within_seconds():
    rate, force = samples(30.0, 1e-4, 2e-3)
    force[-10] += 100.0
    assert (densities(rate, force)[3:] < 2.0 * ACCEL).all()
    state = np.zeros(at.HEAD)
    densities(*samples(30.0, 1e-4, 2e-3), state=state)
    shaken = densities(*samples(10.0, 3e-3, 5e-2, seed=1), state=state, start=round(30.0 * RATE))
    assert (shaken > 0.5 * np.array([*[3e-3**2] * 3, *[5e-2**2] * 3])).all()


def test_samples_around_a_gap_are_not_differenced():
    state = np.zeros(at.HEAD)
    before = densities(*samples(30.0, 1e-4, 2e-3), state=state)
    rate, force = samples(0.03, 1e-4, 2e-3)
    after = densities(rate + 5.0, force + 50.0, state=state, start=round(40.0 * RATE))
    np.testing.assert_array_equal(after, before)


def shaken_run(seed, factor):
    """Return a run through an outage whose IMU has `factor` times the noise that the filter is told."""
    scenario = Scenario(
        trajectory='s_turns', duration=150.0, imu_rate=RATE, outages=(Outage(100.0, 150.0, 0),)
    )
    noisy = replace(
        scenario.imu,
        gyro_noise=factor * scenario.imu.gyro_noise,
        accel_noise=factor * scenario.imu.accel_noise,
    )
    return simulate(replace(scenario, imu=noisy), seed), filter_params(DGPS, scenario.imu)


def test_the_covariance_of_a_shaken_imu_is_honest_and_that_of_a_quiet_one_unchanged():
    told, found = [], []
    for seed in range(6):
        run, params = shaken_run(1000 + seed, 30.0)
        for out, vibration in ((told, False), (found, True)):
            result = evaluate(run, replace(params, vibration=vibration), seed)
            out.append(result.nees()[result.after(60.0)].mean())
    assert np.mean(told) > 30.0
    assert 6.0 < np.mean(found) < 12.0
    run, params = shaken_run(1000, 1.0)
    sigma = [
        np.sqrt(np.diag(evaluate(run, replace(params, vibration=v), 0).covariances[-1]))
        for v in (False, True)
    ]
    np.testing.assert_allclose(sigma[1], sigma[0], rtol=0.1)
