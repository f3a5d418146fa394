# SPDX-License-Identifier: Apache-2.0
"""The attitude filter's linear algebra against numerical derivatives, dense products and filterpy."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.spatial.transform import Rotation

from imu_kalman import attitude_layout as layout
from imu_kalman.attitude_block import clear_sums
from imu_kalman.attitude_kernel import strapdown
from imu_kalman.attitude_linear import inject, propagate, scalar_update, transition, turn, whole_turn
from imu_kalman.params import AttitudeParams

N = layout.N
STEPS, DT = 10, 0.005


@pytest.fixture
def samples():
    """Body rates, and specific forces that are gravity and a mild horizontal acceleration."""
    rng = np.random.default_rng(3)
    rates = np.array([0.8, -0.5, 0.6]) + 0.1 * rng.normal(size=(STEPS, 3))
    attitude = Rotation.from_euler('ZYX', [0.4, 0.2, -0.3])
    forces = np.empty((STEPS, 3))
    state = fresh(attitude.as_quat(scalar_first=True))
    for i in range(STEPS):
        strapdown(state, DT, *rates[i], 0.0, 0.0, 0.0)
        now = Rotation.from_quat(state[layout.Q : layout.Q + 4], scalar_first=True)
        forces[i] = now.inv().apply([0.2, -0.1, layout.GRAVITY_NORM])
    return attitude, rates, forces


def fresh(quat, bias=(0.0, 0.0, 0.0), velocity=(0.0, 0.0), position=(0.0, 0.0)):
    state = np.zeros(layout.STATE)
    state[layout.Q : layout.Q + 4] = quat
    state[layout.BIAS : layout.BIAS + 3] = bias
    state[layout.VEL : layout.VEL + 2] = velocity
    state[layout.POS : layout.POS + 2] = position
    return state


def run(state, rates, forces):
    clear_sums(state)
    for rate, force in zip(rates, forces):
        strapdown(state, DT, *rate, *force)
    return state


def disturbed(attitude, error):
    """The state whose truth is `error` away from the estimate `attitude`, at rest at the origin."""
    quat = (Rotation.from_rotvec(error[:3]) * attitude).as_quat(scalar_first=True)
    return fresh(quat, error[3:6], error[6:8], error[8:10])


def error_between(truth, estimate):
    """The error state of `estimate`: truth = exp(theta) * estimate, velocity and position turned with it."""
    rotation = Rotation.from_quat(truth[layout.Q : layout.Q + 4], scalar_first=True)
    other = Rotation.from_quat(estimate[layout.Q : layout.Q + 4], scalar_first=True)
    theta = (rotation * other.inv()).as_rotvec()
    out = [theta, truth[layout.BIAS : layout.BIAS + 3] - estimate[layout.BIAS : layout.BIAS + 3]]
    for first in (layout.VEL, layout.POS):
        turned = Rotation.from_rotvec([0, 0, theta[2]]).apply([*estimate[first : first + 2], 0.0])[:2]
        out.append(truth[first : first + 2] - turned)
    return np.concatenate(out)


def test_transition_is_the_derivative_of_the_strapdown(samples):
    attitude, rates, forces = samples
    nominal = run(disturbed(attitude, np.zeros(N)), rates, forces)
    phi = np.empty((N, N))
    transition(nominal, phi)
    numeric = np.empty((N, N))
    step = 1e-5
    for j in range(N):
        error = np.zeros(N)
        error[j] = step
        ahead = error_between(run(disturbed(attitude, error), rates, forces), nominal)
        error[j] = -step
        behind = error_between(run(disturbed(attitude, error), rates, forces), nominal)
        numeric[:, j] = (ahead - behind) / (2 * step)
    # What the model leaves out is the horizontal acceleration (0.2 m/s²) beside gravity, over 0.05 s, and
    # how the attitude turns within the block where the bias acts through it.
    np.testing.assert_allclose(numeric[:6], phi[:6], atol=2e-4)
    np.testing.assert_allclose(numeric[6:8, :3], phi[6:8, :3], atol=0.25 * STEPS * DT)
    np.testing.assert_allclose(numeric[6:8, 3:], phi[6:8, 3:], atol=2.5e-3)
    np.testing.assert_allclose(numeric[8:], phi[8:], atol=1.2e-3)


def spd(rng):
    root = rng.normal(size=(N, N))
    return root @ root.T + 0.1 * np.eye(N)


def test_propagation_is_the_dense_product_with_process_noise(samples):
    attitude, rates, forces = samples
    state = run(disturbed(attitude, np.zeros(N)), rates, forces)
    par = layout.pack(AttitudeParams())
    work = np.zeros((layout.WORK, N, N))
    cov = spd(np.random.default_rng(1))
    phi = np.empty((N, N))
    transition(state, phi)
    span = STEPS * DT
    attitude_noise = par[layout.GYRO_PSD] * span + par[layout.SCALE_PSD] * state[layout.RATE2]
    noise = np.diag(
        [attitude_noise] * 3
        + [par[layout.BIAS_PSD] * span] * 3
        + [par[layout.ACC_PSD] * span] * 2
        + [0.0] * 2
    )
    expected = phi @ cov @ phi.T + noise
    propagate(state, par, work, cov)
    np.testing.assert_allclose(cov, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(cov, cov.T)


def test_full_update_equals_filterpy():
    rng = np.random.default_rng(2)
    cov = 1e-4 * spd(rng)
    h = rng.normal(size=N)
    reference = KalmanFilter(dim_x=N, dim_z=1)
    reference.x = np.zeros((N, 1))
    reference.P = cov.copy()
    reference.H = h[None]
    reference.R *= 0.3
    reference.update(0.02)
    state, work = fresh([1, 0, 0, 0]), np.zeros((layout.WORK, N, N))
    variance = scalar_update(state, cov, work, h, 0.02, 0.3, False)
    assert variance == pytest.approx(reference.S[0, 0], abs=1e-12)
    np.testing.assert_allclose(cov, reference.P, rtol=0, atol=1e-12)
    correction = work[layout.VECTORS, layout.CORRECTION]
    np.testing.assert_allclose(correction, reference.x[:, 0], rtol=0, atol=1e-12)


def test_considered_update_has_the_covariance_of_its_own_gain():
    rng = np.random.default_rng(5)
    cov, h = 1e-4 * spd(rng), rng.normal(size=N)
    before = cov.copy()
    state, work = fresh([1, 0, 0, 0]), np.zeros((layout.WORK, N, N))
    scalar_update(state, cov, work, h, 0.02, 0.3, True)
    gain = before @ h / (h @ before @ h + 0.3)
    gain[[0, 1, 6, 7, 8, 9]] = 0.0
    left = np.eye(N) - np.outer(gain, h)
    np.testing.assert_allclose(cov, left @ before @ left.T + 0.3 * np.outer(gain, gain), rtol=0, atol=1e-12)
    np.testing.assert_allclose(work[layout.VECTORS, layout.CORRECTION], 0.02 * gain, rtol=0, atol=1e-12)


def test_turns_are_exact_at_any_angle():
    rng = np.random.default_rng(6)
    for size in (1e-9, 1e-3, 1.0, 3.0):
        first, rotvec = Rotation.random(rng=rng), rng.normal(size=3)
        rotvec *= size / np.linalg.norm(rotvec)
        state = fresh(first.as_quat(scalar_first=True))
        turn(state, *rotvec)
        found = Rotation.from_quat(state[layout.Q : layout.Q + 4], scalar_first=True)
        assert (found * (Rotation.from_rotvec(rotvec) * first).inv()).magnitude() < 1e-12
        out = np.zeros(3)
        whole_turn(state, first.as_quat(scalar_first=True), out)
        np.testing.assert_allclose(out, rotvec, atol=1e-12)


def test_a_heading_correction_turns_velocity_and_position_with_it():
    state = fresh([1, 0, 0, 0], velocity=(1.0, 0.0), position=(0.0, 2.0))
    work = np.zeros((layout.WORK, N, N))
    work[layout.VECTORS, layout.GAIN, 2] = np.pi / 2
    inject(state, work, 1.0)
    np.testing.assert_allclose(state[layout.VEL : layout.POS + 2], [0, 1, -2, 0], atol=1e-12)
