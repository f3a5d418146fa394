# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core.linear import filter_series, propagate_covariance
from kalman_core.smoother import rts, smoother_step


def track(seed, steps=60, q=0.01):
    """A constant-acceleration track measured in position: (F, Q, H, R, truth, z)."""
    rng = np.random.default_rng(seed)
    dt = 0.1
    F = np.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    G = np.array([dt**3 / 6, dt**2 / 2, dt])
    Q = q * np.outer(G, G)
    truth = np.zeros((steps, 3))
    x = rng.standard_normal(3)
    for k in range(steps):
        x = F @ x + G * np.sqrt(q) * rng.standard_normal()
        truth[k] = x
    z = truth[:, :1] + 0.3 * rng.standard_normal((steps, 1))
    return F, Q, np.array([[1.0, 0.0, 0.0]]), np.array([[0.09]]), truth, z


def test_the_smoother_equals_filterpy_with_constant_matrices():
    rng = np.random.default_rng(1)
    F, _, H, R, _, z = track(0)
    A = rng.standard_normal((3, 3))
    Q = 0.01 * A @ A.T
    filtered = filter_series(np.zeros(3), np.eye(3), z, F, Q, H, R)
    got = rts(filtered, F, Q)
    oracle = KalmanFilter(dim_x=3, dim_z=1)
    oracle.F, oracle.Q = F, Q
    x, P, _, _ = oracle.rts_smoother(filtered.x, filtered.P)
    assert np.max(np.abs(got.x - x)) < 1e-12 * max(1.0, np.max(np.abs(x)))
    assert np.max(np.abs(got.P - P)) < 1e-12
    assert np.array_equal(got.x[-1], filtered.x[-1])
    assert np.array_equal(got.P[-1], filtered.P[-1])


def test_the_smoother_equals_filterpy_with_matrices_per_step():
    rng = np.random.default_rng(2)
    F, _, H, R, _, z = track(0, steps=30)
    Fs = np.array([F + 0.02 * rng.standard_normal((3, 3)) for _ in range(30)])
    Qs = np.array([np.diag(rng.uniform(0.01, 0.1, 3)) for _ in range(30)])
    filtered = filter_series(np.zeros(3), np.eye(3), z, Fs, Qs, H, R)
    got = rts(filtered, Fs, Qs)
    x, P, _, _ = KalmanFilter(dim_x=3, dim_z=1).rts_smoother(filtered.x, filtered.P, Fs, Qs)
    assert np.max(np.abs(got.x - x)) < 1e-12 * max(1.0, np.max(np.abs(x)))
    assert np.max(np.abs(got.P - P)) < 1e-12


def test_the_smoother_equals_the_least_squares_solution_over_all_data():
    """Smoothing is the joint Gaussian conditional: solved here as one dense system."""
    F, _, H, R, _, z = track(3, steps=6)
    Q = np.diag([1e-3, 2e-3, 3e-3])
    P0 = np.diag([1.0, 2.0, 3.0])
    steps, n = 6, 3
    mean, cov = [], np.zeros((steps * n, steps * n))
    P = P0
    for k in range(steps):
        P = F @ P @ F.T + Q
        mean.append(np.zeros(n))
        block = P
        for j in range(k, steps):
            cov[j * n : j * n + n, k * n : k * n + n] = block
            cov[k * n : k * n + n, j * n : j * n + n] = block.T
            block = F @ block
    Hs = np.kron(np.eye(steps), H)
    S = Hs @ cov @ Hs.T + np.kron(np.eye(steps), R)
    gain = cov @ Hs.T @ np.linalg.inv(S)
    x = (np.concatenate(mean) + gain @ z.ravel()).reshape(steps, n)
    joint = cov - gain @ Hs @ cov
    got = rts(filter_series(np.zeros(n), P0, z, F, Q, H, R), F, Q)
    assert np.allclose(got.x, x, atol=1e-10)
    for k in range(steps):
        assert np.allclose(got.P[k], joint[k * n : k * n + n, k * n : k * n + n], atol=1e-10)


def test_smoothing_lowers_error_and_keeps_the_covariance_honest():
    filtered_error, smoothed_error, nees = [], [], []
    for seed in range(20):
        F, Q, H, R, truth, z = track(seed)
        filtered = filter_series(np.zeros(3), np.eye(3), z, F, Q, H, R)
        smoothed = rts(filtered, F, Q)
        filtered_error.append(np.mean((filtered.x - truth)[:, 0] ** 2))
        smoothed_error.append(np.mean((smoothed.x - truth)[:, 0] ** 2))
        e = (smoothed.x - truth)[30]
        nees.append(e @ np.linalg.solve(smoothed.P[30], e))
    assert np.mean(smoothed_error) < 0.6 * np.mean(filtered_error)
    assert 1.9 < np.mean(nees) < 4.3  # 99 % band of 20 chi-square values with 3 degrees of freedom


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), log_q=st.floats(-16, 2), log_r=st.floats(-12, 2))
def test_smoothed_covariances_stay_symmetric_semidefinite_and_below_the_filtered(seed, log_q, log_r):
    F, Q, H, _, _, z = track(seed, steps=20, q=10.0**log_q)
    filtered = filter_series(np.zeros(3), np.eye(3), z, F, Q, H, np.array([[10.0**log_r]]))
    smoothed = rts(filtered, F, Q)
    assert np.isfinite(smoothed.x).all()
    for P, before in zip(smoothed.P, filtered.P):
        assert np.array_equal(P, P.T)
        sigma = np.sqrt(np.maximum(np.diag(P), 1e-300))
        assert np.linalg.eigvalsh(P / np.outer(sigma, sigma))[0] > -1e-9
        assert (np.diag(P) <= np.diag(before) * (1 + 1e-9)).all()


@pytest.mark.parametrize('place', [0, 2, 3])
def test_states_that_are_known_exactly_stay_known_and_harm_no_others(place):
    """A constant with zero variance and no process noise makes the predicted covariance singular."""
    F, Q, H, R, _, z = track(4)
    others = [i for i in range(4) if i != place]
    F4, Q4, H4, P0, x0 = np.eye(4), np.zeros((4, 4)), np.zeros((1, 4)), np.zeros((4, 4)), np.zeros(4)
    block = np.ix_(others, others)
    F4[block], Q4[block], H4[0, others], P0[block] = F, Q, H[0], np.eye(3)
    x0[place] = 7.0
    whole = rts(filter_series(x0, P0, z, F4, Q4, H4, R), F4, Q4)
    part = rts(filter_series(np.zeros(3), np.eye(3), z, F, Q, H, R), F, Q)
    assert (whole.x[:, place] == 7.0).all()
    assert (whole.P[:, place] == 0.0).all()
    assert np.allclose(whole.x[:, others], part.x, atol=1e-10)
    for P, expected in zip(whole.P, part.P):
        assert np.allclose(P[block], expected, atol=1e-10)


def test_control_inputs_are_smoothed_through_the_predicted_states():
    """Shifting all predictions by a known input shifts the smoothed states by the same motion."""
    F, Q, H, R, _, z = track(5, steps=30)
    plain = filter_series(np.zeros(3), np.eye(3), z, F, Q, H, R)
    smoothed = rts(plain, F, Q)
    offset = np.zeros((30, 3))
    moved = np.zeros(3)
    for k in range(30):
        moved = F @ moved + np.array([0.0, 0.0, 0.5])
        offset[k] = moved
    driven = plain._replace(x=plain.x + offset, x_predicted=plain.x_predicted + offset)
    assert np.allclose(rts(driven, F, Q).x, smoothed.x + offset, atol=1e-10)


def test_one_step_returns_the_correction_that_an_error_state_filter_injects():
    F, Q, H, R, _, z = track(6, steps=2)
    filtered = filter_series(np.zeros(3), np.eye(3), z, F, Q, H, R)
    whole = rts(filtered, F, Q)
    dx_next = filtered.x[1] - filtered.x_predicted[1]
    dx, P = smoother_step(filtered.P[0], F, Q, dx_next, filtered.P[1])
    assert np.array_equal(filtered.x[0] + dx, whole.x[0])
    assert np.array_equal(P, whole.P[0])


def test_without_new_information_nothing_is_corrected():
    F, Q, _, _, _, _ = track(7)
    P = np.diag([1.0, 0.5, 0.1])
    predicted = P.copy()
    propagate_covariance(predicted, F, Q)
    dx, smoothed = smoother_step(P, F, Q, np.zeros(3), predicted)
    assert (dx == 0.0).all()
    assert np.allclose(smoothed, P, atol=1e-14)


def test_the_smoother_leaves_its_input_alone():
    F, Q, H, R, _, z = track(8)
    filtered = filter_series(np.zeros(3), np.eye(3), z, F, Q, H, R)
    x, P = filtered.x.copy(), filtered.P.copy()
    rts(filtered, F, Q)
    assert np.array_equal(filtered.x, x)
    assert np.array_equal(filtered.P, P)


def test_a_single_step_is_its_own_smoothed_state():
    F, Q, H, R, _, z = track(9, steps=1)
    filtered = filter_series(np.zeros(3), np.eye(3), z, F, Q, H, R)
    assert rts(filtered, F, Q).x == pytest.approx(filtered.x)
