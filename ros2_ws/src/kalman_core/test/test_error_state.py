# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
import scipy.linalg
from filterpy.common import van_loan_discretization
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kalman_core import error_state, rotation

SEEDS = st.integers(0, 2**32 - 1)


def system(seed, n=5):
    rng = np.random.default_rng(seed)
    G = rng.standard_normal((n, 2))
    return rng.standard_normal((n, n)), G


def exp(rotvec):
    return Rotation.from_rotvec(rotvec)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, dt=st.floats(1e-4, 1.0))
def test_discretisation_equals_filterpys_van_loan_and_the_matrix_exponential(seed, dt):
    F, G = system(seed)
    Phi, Qd = error_state.discretise(F, G @ G.T, dt)
    expected_phi, expected_q = van_loan_discretization(F, G, dt)
    assert np.max(np.abs(Phi - scipy.linalg.expm(F * dt))) < 1e-12 * np.max(np.abs(Phi))
    assert np.max(np.abs(Phi - expected_phi)) < 1e-12 * np.max(np.abs(Phi))
    # Van Loan's own form loses digits as exp(-F dt) grows.
    assert np.max(np.abs(Qd - expected_q)) < 1e-11 * np.max(np.abs(Qd))


def test_discretisation_of_a_double_integrator_has_its_closed_form():
    dt, q = 0.3, 2.0
    Phi, Qd = error_state.discretise(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, q]), dt)
    assert np.allclose(Phi, [[1.0, dt], [0.0, 1.0]], atol=1e-16)
    assert np.allclose(Qd, q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), rtol=1e-14)


@pytest.mark.parametrize('dt', [1e-3, 1.0, 300.0])
def test_discretisation_of_a_first_order_process_has_its_closed_form_at_any_step(dt):
    tau, q = 5.0, 0.7
    Phi, Qd = error_state.discretise(np.array([[-1.0 / tau]]), np.array([[q]]), dt)
    assert Phi[0, 0] == pytest.approx(math.exp(-dt / tau), rel=1e-12)
    assert Qd[0, 0] == pytest.approx(-0.5 * q * tau * math.expm1(-2.0 * dt / tau), rel=1e-13)


def test_two_steps_equal_one_of_twice_the_length():
    F, G = system(1)
    W = G @ G.T
    Phi1, Q1 = error_state.discretise(F, W, 0.2)
    Phi2, Q2 = error_state.discretise(F, W, 0.4)
    assert np.allclose(Phi1 @ Phi1, Phi2, rtol=1e-12)
    assert np.allclose(Phi1 @ Q1 @ Phi1.T + Q1, Q2, rtol=1e-12)


def test_a_step_of_no_length_changes_nothing():
    F, G = system(2)
    for discretise in (error_state.discretise, error_state.discretise_second_order):
        Phi, Qd = discretise(F, G @ G.T, 0.0)
        assert np.array_equal(Phi, np.eye(5))
        assert not Qd.any()


def test_the_cheap_discretisation_has_an_error_of_third_order_and_stays_semidefinite():
    F, G = system(3)
    W = G @ G.T
    errors = []
    for dt in (0.02, 0.01):
        Phi, Qd = error_state.discretise_second_order(F, W, dt)
        exact_phi, exact_q = error_state.discretise(F, W, dt)
        errors.append((np.max(np.abs(Phi - exact_phi)), np.max(np.abs(Qd - exact_q))))
    assert errors[0][0] / errors[1][0] == pytest.approx(8.0, rel=0.1)
    assert errors[0][1] / errors[1][1] == pytest.approx(8.0, rel=0.1)
    assert np.array_equal(Qd, Qd.T)
    large = error_state.discretise_second_order(F, W, 3.0)[1]
    assert np.linalg.eigvalsh(large)[0] > -1e-12 * np.max(large)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 0.9e-3, 1.1e-3, 0.5, 3.0])
def test_the_left_jacobian_equals_numerical_derivatives_of_scipys_exponential(angle):
    v = angle * np.array([0.36, -0.48, 0.8])
    numeric = error_state.numerical_jacobian(lambda d: (exp(v + d) * exp(v).inv()).as_rotvec(), np.zeros(3))
    assert np.allclose(error_state.left_jacobian(v), numeric, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_the_left_jacobian_is_the_rotation_times_the_right_one(seed):
    v = np.random.default_rng(seed).uniform(-2.0, 2.0, 3)
    right = error_state.left_jacobian(-v)
    assert np.allclose(error_state.left_jacobian(v), exp(v).as_matrix() @ right, atol=1e-14)
    assert np.allclose(right, error_state.left_jacobian(v).T, atol=1e-14)


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_injected_errors_multiply_from_the_side_of_their_frame(seed):
    rng = np.random.default_rng(seed)
    base, error = exp(rng.uniform(-3, 3, 3)), rng.uniform(-1, 1, 3)
    q = base.as_quat(scalar_first=True)
    level = error_state.inject_attitude(q, error)
    body = error_state.inject_attitude_body(q, error)
    for got, expected in ((level, exp(error) * base), (body, base * exp(error))):
        assert (Rotation.from_quat(got, scalar_first=True) * expected.inv()).magnitude() < 1e-14
        assert np.linalg.norm(got) == pytest.approx(1.0, abs=1e-15)
    # The same physical error seen from the other frame.
    assert np.allclose(body, error_state.inject_attitude(q, rotation.quat_rotate(q, error)), atol=1e-14)


@pytest.mark.parametrize('start', [0, 2])
def test_reset_moves_the_covariance_by_the_derivative_of_the_remaining_error(start):
    rng = np.random.default_rng(4)
    A = rng.standard_normal((6, 6))
    P = A @ A.T
    error = np.array([0.3, -0.2, 0.5])

    def remaining(x):
        out = x.copy()
        part = slice(start, start + 3)
        out[part] = (exp(x[part]) * exp(error).inv()).as_rotvec()
        return out

    at = np.zeros(6)
    at[start : start + 3] = error
    G = error_state.numerical_jacobian(remaining, at)
    got = P.copy()
    error_state.reset_covariance(got, error, start)
    assert np.allclose(got, G @ P @ G.T, atol=1e-7)
    assert np.array_equal(got, got.T)


def test_reset_for_a_body_frame_error_takes_the_negative_error():
    rng = np.random.default_rng(5)
    A = rng.standard_normal((3, 3))
    P = A @ A.T
    error = np.array([0.3, -0.2, 0.5])
    G = error_state.numerical_jacobian(lambda x: (exp(error).inv() * exp(x)).as_rotvec(), error)
    got = P.copy()
    error_state.reset_covariance(got, -error, 0)
    assert np.allclose(got, G @ P @ G.T, atol=1e-7)


def test_resetting_by_no_error_changes_nothing():
    P = np.diag([1.0, 2.0, 3.0, 4.0])
    before = P.copy()
    error_state.reset_covariance(P, np.zeros(3), 1)
    assert np.array_equal(P, before)


def test_numerical_jacobians_have_the_shape_of_the_function_and_its_slope():
    jacobian = error_state.numerical_jacobian(lambda x: np.array([x[0] * x[1], math.sin(x[1])]), [2.0, 0.5])
    assert np.allclose(jacobian, [[0.5, 2.0], [0.0, math.cos(0.5)]], atol=1e-9)
    gradient = error_state.numerical_jacobian(lambda x: x @ x, np.array([1.0, -2.0, 3.0]))
    assert gradient.shape == (1, 3)
    assert np.allclose(gradient, [[2.0, -4.0, 6.0]], atol=1e-8)
    coarse = error_state.numerical_jacobian(lambda x: x**3, np.array([1.0]), step=0.1)
    assert coarse[0, 0] == pytest.approx(3.01)
