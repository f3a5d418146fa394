# SPDX-License-Identifier: Apache-2.0
"""The paper's filter behind `schedule: published`."""

import math

import numpy as np
import pytest

from kalman_core.rotation import euler_from_quat, matrix_from_quat, quat_from_euler, quat_multiply
from ship_inclinometer import published_kernels as k
from ship_inclinometer.attitude_estimator import AttitudeEstimator
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.samples import (
    DEGRADED,
    Attitude,
    ImuSample,
    MagSample,
    SpeedSample,
    Validity,
    VelocitySample,
)

START = 10**18
STEP = 5_000_000  # 200 Hz
DIP = math.radians(55.0)
GRAVITY = 9.80665


def published(**params):
    return AttitudeEstimator(AttitudeParams(schedule='published', **params))


def moored(seconds, angles=(0.1, -0.05, 0.7), bias=(0.0, 0.0, 0.0), noise=0.0, field=True, seed=0):
    """Samples of a craft that does not move: IMU at 200 Hz, field at 20 Hz."""
    rng = np.random.default_rng(seed)
    down = matrix_from_quat(quat_from_euler(*angles)).T
    force = down @ np.array([0.0, 0.0, GRAVITY])
    north = down @ (45e-6 * np.array([0.0, math.cos(DIP), -math.sin(DIP)]))
    for i in range(round(seconds * 200)):
        stamp = START + i * STEP
        if field and i % 10 == 0:
            yield MagSample(stamp, tuple(north + noise * 45e-6 * rng.standard_normal(3)))
        yield ImuSample(stamp, tuple(bias), tuple(force + noise * GRAVITY * rng.standard_normal(3)))


def run(estimator, samples):
    out = []
    for sample in samples:
        out += (estimator.on_mag if isinstance(sample, MagSample) else estimator.on_imu)(sample) or []
    return out


def attitudes(out):
    return [e for e in out if isinstance(e, Attitude)]


@pytest.mark.parametrize('angles', [(0.0, 0.0, 0.0), (0.3, -0.2, 2.5), (-0.6, 0.1, -1.0)])
def test_a_moored_ship_shows_its_angles_after_one_second_and_not_before(angles):
    out = attitudes(run(published(), moored(3.0, angles)))
    assert 1.0 <= (out[0].stamp - START) / 1e9 < 1.01
    assert euler_from_quat(out[-1].q) == pytest.approx(angles, abs=1e-4)


def test_declination_turns_the_heading_to_true_north():
    east = published(declination=10.0)
    _, _, yaw = euler_from_quat(attitudes(run(east, moored(3.0)))[-1].q)
    assert yaw == pytest.approx(0.7 - math.radians(10.0), abs=1e-4)


@pytest.mark.parametrize('transition', ['step', 'instant'])
def test_the_gyro_bias_is_learned_and_taken_from_the_rate(transition):
    bias = (0.01, -0.02, 0.015)
    out = attitudes(run(published(published_transition=transition), moored(120.0, bias=bias)))
    assert out[-1].rate == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert euler_from_quat(out[-1].q) == pytest.approx((0.1, -0.05, 0.7), abs=5e-3)


def test_it_updates_at_5_hz_and_says_so_by_its_nis():
    estimator = published()
    run(estimator, moored(11.0))
    seen = estimator.tally.sensor('imu/data_raw')
    assert seen.accepted == 2200
    assert seen.nis is not None


def test_the_error_of_white_noise_is_what_the_covariance_says_or_less():
    # The low-pass at 5 Hz takes more than half of white noise away; the model of the print does not know.
    nees = []
    for seed in range(20):
        a = attitudes(run(published(), moored(20.0, noise=0.05, seed=seed)))[-1]
        error = quat_multiply(a.q, quat_from_euler(0.1, -0.05, 0.7) * np.array([1.0, -1.0, -1.0, -1.0]))
        vector = 2.0 * error[1:] * np.sign(error[0])
        nees.append(vector @ np.linalg.solve(a.covariance, vector))
    assert 0.01 < np.mean(nees) < 3.0


def test_without_a_field_the_heading_is_declared_unknown():
    out = run(published(valid_sigma=30.0), moored(5.0, field=False))
    assert math.sqrt(attitudes(out)[-1].covariance[2, 2]) > 3.0
    last = [e for e in out if isinstance(e, Validity)][-1]
    assert (last.validity, last.reason, last.heading_valid) == (DEGRADED, 'no magnetic heading', False)


def test_it_never_claims_more_than_degraded():
    out = run(published(valid_sigma=30.0), moored(30.0))
    last = [e for e in out if isinstance(e, Validity)][-1]
    assert (last.validity, last.reason, last.heading_valid) == (DEGRADED, 'sway not modelled', True)
    assert published().diagnostics()['message'] == 'aligning'


def test_a_gap_starts_it_anew_and_is_told():
    estimator = published()
    samples = list(moored(10.0))
    later = [s._replace(stamp=s.stamp + 12 * 10**9) for s in samples]
    run(estimator, samples)
    out = attitudes(run(estimator, later))
    assert any('no IMU sample for' in text for text in estimator.tally.restarts)
    assert (out[0].stamp - later[0].stamp) / 1e9 >= 1.0


def test_a_state_that_is_not_finite_starts_it_anew():
    estimator = published()
    samples = list(moored(10.0))
    run(estimator, samples[:1000])
    estimator.state[k.BIAS] = math.nan
    out = attitudes(run(estimator, samples[1000:]))
    assert 'not finite' in estimator.tally.restarts
    assert euler_from_quat(out[-1].q) == pytest.approx((0.1, -0.05, 0.7), abs=1e-3)


def test_speeds_are_refused_by_name():
    estimator = published()
    run(estimator, moored(2.0))
    stamp = START + 2 * 10**9
    estimator.on_gnss(VelocitySample(stamp, (1.0, 0.0, 0.0), (0.01,) * 3))
    estimator.on_log(SpeedSample(stamp, 1.0))
    for name in ('gnss/velocity', 'log/speed'):
        assert estimator.tally.sensor(name).rejected == {'not used by the published schedule': 1}


def test_a_field_that_has_ceased_steers_nothing_any_more():
    estimator = published()
    samples = [s for s in moored(60.0) if isinstance(s, ImuSample) or s.stamp < START + 20 * 10**9]
    # Alongside, but turned by hand after the magnetometer has died: 0.1 rad/s about the vertical for 20 s.
    up = np.array(matrix_from_quat(quat_from_euler(0.1, -0.05, 0.7))[2])
    turned = [
        s._replace(gyro=tuple(0.1 * up))
        if isinstance(s, ImuSample) and 30 < (s.stamp - START) / 1e9 <= 50
        else s
        for s in samples
    ]
    out = attitudes(run(estimator, turned))
    before = next(a for a in out if a.stamp >= START + 20 * 10**9)
    _, _, yaw = euler_from_quat(out[-1].q)
    assert math.remainder(yaw - 2.7, 2.0 * math.pi) == pytest.approx(0.0, abs=0.2)
    assert out[-1].covariance[2, 2] > before.covariance[2, 2]
    assert out[-1].rate == pytest.approx((0.0, 0.0, 0.0), abs=5e-3)
