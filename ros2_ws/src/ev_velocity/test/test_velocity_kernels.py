# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from ev_velocity import velocity_memory as mem
from ev_velocity.params import VelocityParams
from ev_velocity.velocity import EPOCH, kernel_constants, start_memory
from ev_velocity.velocity_kernels import correct, delayed_row, force_at, force_step, let_out, predict
from ev_velocity.velocity_updates import count_step, gps_step

T0 = float(EPOCH)
CONSTANTS = kernel_constants(VelocityParams())


def moving(speed=8.0, force=0.7, seconds=2.0, rate=500.0):
    """A memory that has driven for a while, with a full covariance."""
    m = start_memory(VelocityParams())
    m[mem.X + mem.V] = speed
    force_step(m, CONSTANTS, force, T0)
    rng = np.random.default_rng(5)
    root = 0.02 * rng.standard_normal((mem.N, mem.N))
    cov = m[mem.P : mem.P + mem.N**2].reshape(mem.N, mem.N)
    cov[:] = root @ root.T + np.diag(np.full(mem.N, 1e-4))
    for i in range(1, round(seconds * rate) + 1):
        force_step(m, CONSTANTS, force + 0.3 * np.sin(0.01 * i), T0 + round(i * 1e9 / rate))
    return m


def state(m):
    return m[mem.X : mem.X + mem.N].copy()


def covariance(m):
    return m[mem.P : mem.P + mem.N**2].reshape(mem.N, mem.N).copy()


def numerical(function, m, step=1e-6):
    """Return d function(m) / dx by central differences."""
    columns = []
    for i in range(mem.N):
        values = []
        for sign in (1.0, -1.0):
            moved = m.copy()
            moved[mem.X + i] += sign * step
            values.append(np.atleast_1d(function(moved)))
        columns.append((values[0] - values[1]) / (2.0 * step))
    return np.array(columns).T


def test_prediction_of_the_covariance_is_that_of_a_linear_filter():
    m = moving()
    before = covariance(m)
    t = m[mem.TIME] + 2e6

    def advance(memory):
        memory = memory.copy()
        predict(memory, CONSTANTS, t)
        return state(memory)

    jacobian = numerical(advance, m)
    oracle = KalmanFilter(dim_x=mem.N, dim_z=1)
    oracle.P = before
    oracle.F = jacobian
    oracle.Q = np.zeros((mem.N, mem.N))
    oracle.predict()
    predict(m, CONSTANTS, t)
    added = covariance(m) - oracle.P
    off = added - np.diag(np.diag(added))
    # Distances also depend on bias and gain to second order in dt, which the filter leaves out.
    assert np.abs(off).max() < 1e-3 * np.abs(oracle.P).max()
    for i in (mem.V, mem.B, mem.K, mem.S, mem.C, mem.TG):
        assert np.abs(off[i, : mem.W]).max() < 1e-10
    dt, speed = 2e-3, state(m)[mem.V]
    params = VelocityParams()
    surprise = max(1.0, m[mem.SURPRISE]) ** 2
    assert added[mem.V, mem.V] == pytest.approx(params.accelerometer_noise**2 * dt, rel=1e-3)
    bias = (params.bias_noise**2 + params.grade_noise**2 * speed * surprise) * dt
    assert added[mem.B, mem.B] == pytest.approx(bias, rel=1e-3)


@pytest.mark.parametrize('index', [mem.TG, mem.TW])
def test_the_row_of_a_delayed_speed_is_its_derivative(index):
    m = moving()
    m[mem.X + index] = 0.153
    h = np.zeros(mem.N)
    delayed_row(m, index, h)
    scratch = np.zeros(mem.N)
    np.testing.assert_allclose(
        h, numerical(lambda memory: delayed_row(memory, index, scratch), m)[0], atol=2e-4
    )


@pytest.mark.parametrize('delay', [0.0, 0.004, 0.15, 0.37, 1.0])
def test_a_delayed_speed_is_what_the_filter_said_then(delay):
    m = start_memory(VelocityParams())
    m[mem.X + mem.V] = 6.0
    m[mem.X + mem.B] = 0.2
    force_step(m, CONSTANTS, 0.5, T0)
    speeds = {0: 6.0}
    for i in range(1, 1001):
        force_step(m, CONSTANTS, 0.5 + np.sin(0.02 * i), T0 + i * 2e6)
        speeds[i] = m[mem.X + mem.V]
    m[mem.X + mem.TG] = delay
    then = delayed_row(m, mem.TG, np.zeros(mem.N))
    # The ring is linear over 10 ms: jerk of 10 m/s³ · (0.01 s)²/8.
    assert then == pytest.approx(speeds[1000 - round(delay / 0.002)], abs=2e-4)


def test_before_the_ring_the_car_is_taken_to_have_had_no_acceleration():
    m = moving(seconds=0.5)
    oldest, _ = force_at(m, T0 + 1e7)
    older, force = force_at(m, T0 - 1e9)
    assert force == m[mem.X + mem.B]
    assert older == pytest.approx(oldest - m[mem.X + mem.B] * 1.01, abs=0.05)


def test_a_correction_is_that_of_an_independent_filter():
    m = moving()
    h = np.random.default_rng(1).standard_normal(mem.N)
    oracle = KalmanFilter(dim_x=mem.N, dim_z=1)
    oracle.x, oracle.P = state(m)[:, None], covariance(m)
    oracle.H, oracle.R = h[None, :], np.array([[0.03]])
    oracle.update(h @ state(m) + 1e-3)
    correct(m, 1e-3, h, 0.03, np.inf)
    np.testing.assert_allclose(state(m), oracle.x[:, 0], atol=1e-12)
    np.testing.assert_allclose(covariance(m), oracle.P, atol=1e-12)


def test_a_correction_reaches_the_output_in_small_steps_and_wholly():
    m = moving()
    let_out(m, CONSTANTS, 1.0)
    before = m[mem.OUT_SPEED]
    h = np.zeros(mem.N)
    h[mem.V] = 1.0
    correct(m, 0.5, h, 1e-9, np.inf)
    target = m[mem.X + mem.V]
    assert target - before > 0.4
    steps = []
    for _ in range(200):
        last = m[mem.OUT_SPEED]
        let_out(m, CONSTANTS, 0.002)
        steps.append(m[mem.OUT_SPEED] - last)
    assert max(steps) <= VelocityParams().bleed_step + 1e-12
    assert m[mem.OUT_SPEED] == pytest.approx(target, abs=1e-4)


def test_a_standing_receiver_says_nothing_about_sign_or_size():
    m = moving(speed=0.0, force=0.0, seconds=0.01)
    before = state(m)
    t = m[mem.TIME]
    assert gps_step(m, CONSTANTS, 0.06, 0.05**2, t, np.zeros(mem.N)) == mem.SKIPPED
    np.testing.assert_array_equal(state(m), before)


def test_a_count_is_used_when_the_next_has_confirmed_it():
    m = moving(speed=8.0, force=0.0, seconds=0.2)
    h = np.zeros(mem.N)
    teeth = 8.0 * 0.1 / CONSTANTS[mem.TOOTH]
    assert count_step(m, CONSTANTS, 0.0, T0 + 0.2e9, h) == mem.STARTED
    used = []
    for i in range(1, 4):
        predict(m, CONSTANTS, T0 + 0.2e9 + i * 1e8)
        before = covariance(m)[mem.V, mem.V]
        assert count_step(m, CONSTANTS, np.floor(i * teeth), T0 + 0.2e9 + i * 1e8, h) == mem.USED
        used.append(covariance(m)[mem.V, mem.V] < before)
    assert used == [False, True, True]
    assert count_step(m, CONSTANTS, np.floor(4 * teeth) + 12.0, T0 + 0.6e9, h) == mem.REFUSED
    assert m[mem.PENDING] == 0.0
    assert m[mem.SLIP] > 0.3
