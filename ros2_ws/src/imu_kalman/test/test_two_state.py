# SPDX-License-Identifier: Apache-2.0
"""The two-state kernels against the printed listing, filterpy and a known steady state."""

import math

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.stats import chi2

from imu_kalman.angle import AngleFilter
from imu_kalman.params import TwoStateParams
from imu_kalman.samples import ImuSample
from imu_kalman.two_state import filter_axis, step_corrected, step_published

DT, Q_ANGLE, Q_BIAS, R = 0.01, 0.005, 0.003, 0.03


class Listing:
    """The listing of paper 004, statement by statement, in Python floats (double precision)."""

    def __init__(self):
        self.bias = self.angle = 0.0
        self.p00 = self.p01 = self.p10 = self.p11 = 0.0

    def __call__(self, new_angle, new_rate, dt=DT):
        rate = new_rate - self.bias
        self.angle += dt * rate
        self.p00 += dt * (dt * self.p11 - self.p10 - self.p01 + Q_ANGLE)
        self.p01 -= dt * self.p11
        self.p10 -= dt * self.p11
        self.p11 += Q_BIAS * dt
        s = self.p00 + R
        self.k0 = self.p00 / s
        self.k1 = self.p10 / s
        y = new_angle - self.angle
        self.angle += self.k0 * y
        self.bias += self.k1 * y
        self.p00 -= self.k0 * self.p00
        self.p01 -= self.k0 * self.p01
        self.p10 -= self.k1 * self.p00
        self.p11 -= self.k1 * self.p01
        return self.angle


@pytest.fixture
def inputs():
    rng = np.random.default_rng(4)
    t = np.arange(3000) * DT
    return 0.4 * np.sin(t) + 0.1 * rng.normal(size=t.size), 0.4 * np.cos(t) + 0.3 + 0.02 * rng.normal(
        size=t.size
    )


def test_published_step_is_the_listing_to_the_last_bit(inputs):
    angles, rates = inputs
    listing, axis = Listing(), np.zeros(6)
    for angle, rate in zip(angles.tolist(), rates.tolist()):
        listing(angle, rate)
        step_published(axis, rate, angle, DT, Q_ANGLE, Q_BIAS, R)
        state = (listing.angle, listing.bias, listing.p00, listing.p01, listing.p10, listing.p11)
        assert tuple(axis) == state


def test_published_estimator_is_the_listing_to_the_last_bit_from_messages(inputs):
    angles, rates = inputs
    listing = Listing()
    estimator = AngleFilter(TwoStateParams(variant='published', start='zero', bias_sigma=0.0))
    for i, (angle, rate) in enumerate(zip(angles.tolist(), rates.tolist())):
        acc = (0.0, 9.81 * math.sin(angle), 9.81 * math.cos(angle))
        sample = ImuSample(10**9 + 10_000_000 * i, (rate, 0.0, 0.0), acc)
        _, rpy = estimator.on_imu(sample)
        if i == 0:
            continue  # The first sample starts the filter: nothing has elapsed that could be predicted over.
        expected = listing(math.atan2(acc[1], acc[2]), rate)
        assert rpy.angles[0] == expected


@pytest.mark.parametrize('published', [True, False])
def test_array_loop_equals_single_steps(inputs, published):
    angles, rates = inputs
    axis, other = np.zeros(6), np.zeros(6)
    out = filter_axis(axis, rates, angles, DT, Q_ANGLE, Q_BIAS, R, published)
    step = step_published if published else step_corrected
    for i in range(rates.size):
        step(other, rates[i], angles[i], DT, Q_ANGLE, Q_BIAS, R)
        np.testing.assert_array_equal(out[i], other[:2])
    np.testing.assert_array_equal(axis, other)


def test_corrected_step_equals_filterpy_over_uneven_intervals(inputs):
    angles, rates = inputs
    rng = np.random.default_rng(1)
    reference = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    reference.x = np.zeros((2, 1))
    reference.P = np.diag([0.1, 0.02])
    reference.H = np.array([[1.0, 0.0]])
    reference.R *= R
    axis = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.02])
    for angle, rate in zip(angles, rates):
        dt = rng.uniform(0.002, 0.05)
        reference.F = np.array([[1.0, -dt], [0.0, 1.0]])
        reference.B = np.array([[dt], [0.0]])
        reference.Q = np.diag([Q_ANGLE, Q_BIAS]) * dt
        reference.predict(u=np.array([[rate]]))
        reference.update(angle)
        innovation, variance = step_corrected(axis, rate, angle, dt, Q_ANGLE, Q_BIAS, R)
        np.testing.assert_allclose(axis[:2], reference.x[:, 0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(axis[2:].reshape(2, 2), reference.P, rtol=0, atol=1e-12)
        assert innovation == pytest.approx(reference.y[0, 0], abs=1e-12)
        assert variance == pytest.approx(reference.S[0, 0], abs=1e-12)


def test_steady_state_shows_what_the_erratum_costs():
    published, corrected = np.zeros(6), np.zeros(6)
    for _ in range(5000):
        before_p, before_c = published.copy(), corrected.copy()
        step_published(published, 0.0, 0.0, DT, Q_ANGLE, Q_BIAS, R)
        step_corrected(corrected, 0.0, 0.0, DT, Q_ANGLE, Q_BIAS, R)
    np.testing.assert_allclose(published, before_p, atol=1e-15)
    np.testing.assert_allclose(corrected, before_c, atol=1e-15)

    def gains(axis):
        after = axis.copy()
        angle, bias = after[:2]
        step = step_published if axis is published else step_corrected
        y, _ = step(after, 0.0, 1.0, DT, Q_ANGLE, Q_BIAS, R)
        return (after[0] - angle) / y, (after[1] - bias) / y

    np.testing.assert_allclose(gains(published), (0.046974, -0.032393), atol=5e-7)
    np.testing.assert_allclose(gains(corrected), (0.046815, -0.030874), atol=5e-7)
    assert corrected[3] == corrected[4] == pytest.approx(-0.00092621, abs=5e-9)
    assert abs(published[3] - published[4]) > 1e-5


def test_error_is_what_the_covariance_says():
    runs, steps = 100, 300
    rng = np.random.default_rng(8)
    nees = []
    for _ in range(runs):
        axis = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.02])
        angle, bias = rng.normal(size=2) * np.sqrt([0.1, 0.02])
        for _ in range(steps):
            rate = rng.uniform(-0.5, 0.5)
            angle += rate * DT + np.sqrt(Q_ANGLE * DT) * rng.normal()
            measured_rate = rate + bias
            bias += np.sqrt(Q_BIAS * DT) * rng.normal()
            step_corrected(axis, measured_rate, angle + np.sqrt(R) * rng.normal(), DT, Q_ANGLE, Q_BIAS, R)
        error = np.array([axis[0] - angle, axis[1] - bias])
        nees.append(error @ np.linalg.solve(axis[2:].reshape(2, 2), error))
    low, high = chi2.ppf((0.025, 0.975), 2 * runs) / runs
    assert low < np.mean(nees) < high


def test_innovation_takes_the_short_way_round():
    axis = np.array([3.1, 0.0, 1.0, 0.0, 0.0, 0.0])
    innovation, _ = step_corrected(axis, 0.0, -3.1, DT, 0.0, 0.0, 1.0)
    assert innovation == pytest.approx(2 * np.pi - 6.2)
    assert -np.pi <= axis[0] < np.pi
