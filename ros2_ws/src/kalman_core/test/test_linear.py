# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import scipy.linalg
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core import linear
from kalman_core.gates import chi2_gate

SEEDS = st.integers(0, 2**32 - 1)


def spd(rng, n, decades=1.0):
    """A random covariance whose standard deviations span `decades` powers of ten."""
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    scale = 10.0 ** rng.uniform(-decades, decades, n)
    return basis @ np.diag(scale) @ basis.T


def model(seed, n=5, m=2):
    """A random filter: x, P, F, Q, H, R, z."""
    rng = np.random.default_rng(seed)
    F = np.eye(n) + 0.3 * rng.standard_normal((n, n))
    F[rng.random((n, n)) < 0.3] = 0.0
    H = rng.standard_normal((m, n))
    H[rng.random((m, n)) < 0.3] = 0.0
    return rng.standard_normal(n), spd(rng, n), F, spd(rng, n), H, spd(rng, m), rng.standard_normal(m)


def oracle(x, P, F, Q, H, R):
    filter_ = KalmanFilter(dim_x=x.size, dim_z=H.shape[0])
    filter_.x, filter_.P, filter_.F, filter_.Q, filter_.H, filter_.R = x.copy(), P.copy(), F, Q, H, R
    return filter_


def assert_equal(actual, expected):
    """To 1e-12 of the largest entry."""
    assert np.max(np.abs(actual - expected)) <= 1e-12 * max(1.0, np.max(np.abs(expected)))


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_predict_equals_filterpy(seed):
    x, P, F, Q, H, R, _ = model(seed)
    expected = oracle(x, P, F, Q, H, R)
    expected.predict()
    linear.predict(x, P, F, Q)
    assert_equal(x, expected.x)
    assert_equal(P, expected.P)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, m=st.integers(1, 4))
def test_update_equals_filterpy_with_its_innovation_s_and_mahalanobis_distance(seed, m):
    x, P, F, Q, H, R, z = model(seed, m=m)
    expected = oracle(x, P, F, Q, H, R)
    expected.update(z)
    assert_equal(linear.innovation_covariance(P, H, R), expected.S)
    innovation, S, nis = linear.update(x, P, z, H, R)
    assert_equal(x, expected.x)
    assert_equal(P, expected.P)
    assert_equal(innovation, expected.y)
    assert_equal(S, expected.S)
    assert nis == pytest.approx(expected.mahalanobis**2, rel=1e-10)
    assert nis == pytest.approx(linear.normalized_square(innovation, S), rel=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_a_scalar_update_equals_filterpy(seed):
    x, P, F, Q, H, R, z = model(seed, m=1)
    expected = oracle(x, P, F, Q, H, R)
    expected.update(z)
    innovation, s, nis = linear.update_scalar(x, P, z[0], H[0], R[0, 0])
    assert_equal(x, expected.x)
    assert_equal(P, expected.P)
    assert innovation == pytest.approx(expected.y[0], abs=1e-12)
    assert s == pytest.approx(expected.S[0, 0], rel=1e-12)
    assert nis == pytest.approx(expected.y[0] ** 2 / expected.S[0, 0], rel=1e-11)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_sequential_scalar_updates_equal_the_vector_update(seed):
    x, P, F, Q, H, R, z = model(seed, m=3)
    R = np.diag(np.diag(R))
    expected = oracle(x, P, F, Q, H, R)
    expected.update(z)
    innovations, variances, nis = linear.correct_sequential(x, P, z - H @ x, H, np.diag(R).copy())
    assert_equal(x, expected.x)
    assert_equal(P, expected.P)
    assert nis == pytest.approx(innovations**2 / variances)
    assert nis.sum() == pytest.approx(expected.mahalanobis**2, rel=1e-9)
    # The first component sees the prior, so its innovation is that of the vector.
    assert innovations[0] == pytest.approx(expected.y[0], abs=1e-12)
    assert variances[0] == pytest.approx(expected.S[0, 0], rel=1e-12)


def test_a_correction_with_an_innovation_equals_an_update_with_the_measurement():
    x, P, _, _, H, R, z = model(3)
    x2, P2 = x.copy(), P.copy()
    S, nis = linear.correct(x2, P2, z - H @ x, H, R)
    _, S1, nis1 = linear.update(x, P, z, H, R)
    assert np.allclose(x, x2, atol=1e-14)
    assert np.array_equal(P, P2)
    assert np.array_equal(S, S1)
    assert nis == pytest.approx(nis1, rel=1e-12)


def test_a_series_equals_filterpy_step_by_step():
    x, P, F, Q, H, R, _ = model(5)
    F *= 0.9 / np.max(np.abs(np.linalg.eigvals(F)))
    z = np.random.default_rng(6).standard_normal((50, 2))
    expected = oracle(x, P, F, Q, H, R)
    got = linear.filter_series(x, P, z, F, Q, H, R)
    for k in range(50):
        expected.predict()
        assert_equal(got.x_predicted[k], expected.x)
        expected.update(z[k])
        assert_equal(got.x[k], expected.x)
        assert_equal(got.P[k], expected.P)
        assert_equal(got.innovation[k], expected.y)
        assert_equal(got.S[k], expected.S)
        assert got.nis[k] == pytest.approx(expected.mahalanobis**2, rel=1e-9)


def test_a_series_takes_matrices_per_step():
    x, P, F, Q, H, R, _ = model(7)
    rng = np.random.default_rng(8)
    z = rng.standard_normal((6, 2))
    Fs = np.array([F + 0.1 * k * np.eye(5) for k in range(6)])
    Qs = np.array([Q * (1 + k) for k in range(6)])
    got = linear.filter_series(x, P, z, Fs, Qs, H, R)
    for k in range(6):
        linear.predict(x, P, Fs[k], Qs[k])
        linear.update(x, P, z[k], H, R)
        assert np.array_equal(got.x[k], x)
        assert np.array_equal(got.P[k], P)


def test_a_series_leaves_its_inputs_alone_and_steps_over_missing_rows():
    x, P, F, Q, H, R, _ = model(9)
    x0, P0 = x.copy(), P.copy()
    z = np.full((3, 2), np.nan)
    got = linear.filter_series(x, P, z, F, Q, H, R)
    assert np.array_equal(x, x0)
    assert np.array_equal(P, P0)
    assert np.array_equal(got.x, got.x_predicted)
    assert np.isnan(got.nis).all()
    assert np.isfinite(got.P).all()


def test_a_series_applies_its_gate():
    x, P, F, Q, H, R, _ = model(10)
    z = np.zeros((20, 2))
    z[10] = 1e6
    got = linear.filter_series(x, P, z, F * 0.5, Q, H, R, gate=chi2_gate(2))
    assert got.nis[10] > 1e6
    assert np.array_equal(got.x[10], got.x_predicted[10])
    assert not np.array_equal(got.x[11], got.x_predicted[11])


def test_constant_velocity_tracking_has_the_closed_form_steady_state():
    """The alpha-beta filter's gain, Bar-Shalom 6.5.3: an oracle that no filter code made."""
    dt, sigma_a, sigma_z = 0.1, 2.0, 0.5
    index = sigma_a * dt**2 / sigma_z
    r = (4.0 + index - math.sqrt(8.0 * index + index**2)) / 4.0
    alpha, beta = 1.0 - r**2, 2.0 * (2.0 - (1.0 - r**2)) - 4.0 * math.sqrt(r**2)
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = Q_discrete_white_noise(2, dt, sigma_a**2)
    got = linear.filter_series(np.zeros(2), np.eye(2), np.zeros((400, 1)), F, Q, [[1.0, 0.0]], [[sigma_z**2]])
    P = got.P[-1]
    assert P[0, 0] / sigma_z**2 == pytest.approx(alpha, rel=1e-9)
    assert P[0, 1] / sigma_z**2 * dt == pytest.approx(beta, rel=1e-9)


@pytest.mark.parametrize('scalar', [False, True])
def test_the_gate_bounds_the_nis_that_is_used(scalar):
    x, P, _, _, H, R, z = model(11, m=1)
    nis = linear.update(x.copy(), P.copy(), z, H, R)[2]

    def moved(gate):
        x1, P1 = x.copy(), P.copy()
        if scalar:
            linear.update_scalar(x1, P1, z[0], H[0], R[0, 0], gate)
        else:
            linear.update(x1, P1, z, H, R, gate)
        assert np.array_equal(x1, x) == np.array_equal(P1, P)
        return not np.array_equal(x1, x)

    assert moved(nis * (1 + 1e-9))
    assert not moved(nis * (1 - 1e-9))
    assert not moved(0.0)


def test_a_sequential_gate_judges_each_component_alone():
    x, P, _, _, H, R, z = model(12, m=3)
    r = np.diag(R).copy()
    innovation = z - H @ x
    innovation[1] = 1e4
    x1, P1 = x.copy(), P.copy()
    _, _, nis = linear.correct_sequential(x1, P1, innovation, H, r, chi2_gate(1, 1e-6))
    assert nis[1] > chi2_gate(1, 1e-6) > max(nis[0], nis[2])
    keep = [0, 2]
    linear.correct_sequential(x, P, innovation[keep], H[keep], r[keep])
    assert np.allclose(x, x1, atol=1e-12)
    assert np.allclose(P, P1, atol=1e-12)


@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_never_reaches_the_state(bad):
    x, P, _, _, H, R, z = model(13)
    x0, P0 = x.copy(), P.copy()
    z[1] = bad
    assert not math.isfinite(linear.update(x, P, z, H, R)[2])
    assert not math.isfinite(linear.update_scalar(x, P, bad, H[0], 1.0)[2])
    assert not math.isfinite(linear.correct_scalar(x, P, 1.0, H[0], bad)[1])
    assert math.isnan(linear.correct(x, P, np.ones(2), H, R * bad)[1])
    assert np.array_equal(x, x0)
    assert np.array_equal(P, P0)


def test_an_innovation_covariance_that_is_not_positive_definite_is_refused():
    x, P, _, _, H, R, z = model(14)
    x0, P0 = x.copy(), P.copy()
    assert math.isnan(linear.update(x, P, z, H, -1e6 * R)[2])
    assert math.isnan(linear.update_scalar(x, P, z[0], H[0], -1e6)[2])
    assert math.isnan(linear.update_scalar(x, P * 0.0, z[0], H[0], 0.0)[2])
    assert math.isnan(linear.normalized_square(z, np.array([[1.0, 2.0], [2.0, 1.0]])))
    assert np.array_equal(x, x0)
    assert np.array_equal(P, P0)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, log_ratio=st.floats(-11, 1), decades=st.floats(1, 6), scalar=st.booleans())
def test_covariances_stay_symmetric_and_semidefinite_under_ill_conditioning(seed, log_ratio, decades, scalar):
    """R is down to 1e-11 of H P Hᵀ, P spans up to 12 decades, three of five states get no process noise."""
    rng = np.random.default_rng(seed)
    n = 5
    x, P = np.zeros(n), spd(rng, n, decades)
    P = 0.5 * (P + P.T)
    H = rng.standard_normal((2, n))
    F = np.eye(n) + np.diag(np.full(n - 1, 0.01), 1)
    Q = np.zeros((n, n))
    Q[-1, -1] = 1e-12
    r = 10.0 ** max(log_ratio, -9.0 if scalar else -11.0) * np.diag(H @ P @ H.T)
    largest = np.linalg.eigvalsh(P)[-1]
    for _ in range(30):
        linear.predict(x, P, F, Q)
        if scalar:
            linear.correct_sequential(x, P, rng.standard_normal(2), H, r)
        else:
            linear.correct(x, P, rng.standard_normal(2), H, np.diag(r))
        assert np.array_equal(P, P.T)
        assert (np.diag(P) > 0.0).all()
        assert np.linalg.eigvalsh(P)[0] >= -1e-12 * largest


def test_a_nearly_exact_measurement_of_a_nearly_unknown_state_keeps_its_variance():
    """Here ``P - K S Kᵀ`` cancels to zero or below; the Joseph form returns r."""
    for r in (1e-6, 1e-12):
        P = np.array([[1e10, 9.9e9], [9.9e9, 1e10]])
        linear.update_scalar(np.zeros(2), P, 1.0, np.array([1.0, 0.0]), r)
        assert P[0, 0] == pytest.approx(r, rel=1e-3)
        assert P[1, 1] == pytest.approx(1e10 * (1.0 - 0.99**2), rel=1e-9)
        P = np.array([[1e10, 9.9e9], [9.9e9, 1e10]])
        linear.update(np.zeros(2), P, np.ones(1), np.array([[1.0, 0.0]]), np.array([[r]]))
        assert P[0, 0] == pytest.approx(r, rel=1e-3)


def test_the_covariance_may_be_any_view_of_the_flat_state():
    x, P, F, Q, *_ = model(15)
    state = np.concatenate((x, P.ravel()))
    linear.predict(state[:5], state[5:].reshape(5, 5), F, Q)
    linear.predict(x, P, F, Q)
    assert np.array_equal(state, np.concatenate((x, P.ravel())))
    big = np.zeros((7, 7))
    big[1:6, 1:6] = P
    linear.propagate_covariance(big[1:6, 1:6], F, Q)
    linear.propagate_covariance(P, F, Q)
    assert np.array_equal(big[1:6, 1:6], P)
    assert big[0].sum() == big[6].sum() == 0.0


def test_symmetrize_takes_the_mean_of_both_halves():
    P = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    expected = 0.5 * (P + P.T)
    linear.symmetrize(P)
    assert np.array_equal(P, expected)


@settings(max_examples=10, deadline=None)
@given(seed=SEEDS, n=st.integers(1, 6))
def test_cholesky_and_its_solution_equal_scipy(seed, n):
    rng = np.random.default_rng(seed)
    S = spd(rng, n)
    L = np.full((n, n), 9.0)
    assert linear.cholesky(S, L)
    assert_equal(np.tril(L), scipy.linalg.cholesky(S, lower=True))
    assert np.array_equal(L, np.tril(L))
    B = rng.standard_normal((n, 3))
    expected = np.linalg.solve(S, B)
    linear.cholesky_solve(L, B)
    assert np.max(np.abs(B - expected)) <= 1e-10 * np.max(np.abs(expected))


@pytest.mark.parametrize('entry', [0.0, -1.0, np.nan, np.inf])
def test_cholesky_refuses_what_is_not_positive_definite(entry):
    for i in range(3):
        S = np.eye(3)
        S[i, i] = entry
        assert not linear.cholesky(S, np.zeros((3, 3)))


def test_entries_of_exactly_one_count_as_much_as_all_others():
    """Zeros are skipped by the kernels; ones, which real models are full of, must not be."""
    F = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0]])
    H = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    x, P, Q, R = np.array([1.0, 2.0, 3.0]), np.eye(3), np.eye(3), np.eye(2)
    expected = oracle(x, P, F, Q, H, R)
    expected.predict()
    linear.predict(x, P, F, Q)
    assert_equal(x, expected.x)
    assert_equal(P, expected.P)
    expected.update(np.ones(2))
    linear.update(x, P, np.ones(2), H, R)
    assert_equal(x, expected.x)
    assert_equal(P, expected.P)
    L = np.tril(np.ones((3, 3)))
    B = np.arange(6.0).reshape(3, 2)
    solution = np.linalg.solve(L @ L.T, B)
    linear.cholesky_solve(L, B)
    assert_equal(B, solution)


def test_a_zero_on_the_diagonal_drops_its_component_from_the_solution():
    L = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 3.0]])
    B = np.array([[4.0], [5.0], [6.0]])
    keep = [0, 2]
    part = L[np.ix_(keep, keep)]
    expected = np.linalg.solve(part @ part.T, B[keep])
    linear.cholesky_solve(L, B)
    assert B[1, 0] == 0.0
    assert np.allclose(B[keep], expected, atol=1e-15)
