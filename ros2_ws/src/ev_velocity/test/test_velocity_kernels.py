# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from ev_velocity import velocity_memory as mem
from ev_velocity.params import VelocityParams
from ev_velocity.velocity import EPOCH, kernel_constants, start_memory
from ev_velocity.velocity_bank import SPREAD, combine, correct, covariance_of, mix, place, state_of
from ev_velocity.velocity_kernels import delayed_row, force_at, force_step, let_out, predict
from ev_velocity.velocity_updates import count_step, gps_step

T0 = float(EPOCH)
CONSTANTS = kernel_constants(VelocityParams())


def moving(speed=8.0, force=0.7, seconds=2.0, rate=500.0):
    """A memory that has driven for a while, with a full covariance."""
    m = start_memory(VelocityParams())
    place(m, mem.V, speed)
    rng = np.random.default_rng(5)
    root = 0.02 * rng.standard_normal((mem.N, mem.N))
    for j in range(mem.MODELS):
        covariance_of(m, j)[:] = root @ root.T + np.diag(np.full(mem.N, 1e-4))
    combine(m)
    force_step(m, CONSTANTS, force, T0)
    for i in range(1, round(seconds * rate) + 1):
        force_step(m, CONSTANTS, force + 0.3 * np.sin(0.01 * i), T0 + round(i * 1e9 / rate))
    return m


def state(m):
    return m[mem.X : mem.X + mem.N].copy()


def covariance(m):
    return m[mem.P : mem.P + mem.N**2].reshape(mem.N, mem.N).copy()


def alone(m, index=1):
    """Make all filters of the bank, and so the estimate, that of `index`."""
    for j in range(mem.MODELS):
        state_of(m, j)[:] = state_of(m, index)
        covariance_of(m, j)[:] = covariance_of(m, index)
    combine(m)
    return m


def numerical(function, m, step=1e-6):
    """Return d function(m) / dx by central differences."""
    columns = []
    for i in range(mem.N):
        values = []
        for sign in (1.0, -1.0):
            moved = m.copy()
            place(moved, i, state(m)[i] + sign * step)
            combine(moved)
            values.append(np.atleast_1d(function(moved)))
        columns.append((values[0] - values[1]) / (2.0 * step))
    return np.array(columns).T


def test_prediction_of_the_covariance_is_that_of_a_linear_filter():
    m = alone(moving())
    m[mem.MIXED_AT] = state(m)[mem.D]
    before = covariance(m)
    t = m[mem.TIME] + 2e6

    def advanced(memory):
        memory = memory.copy()
        predict(memory, CONSTANTS, t)
        return state_of(memory, 1).copy()

    oracle = KalmanFilter(dim_x=mem.N, dim_z=1)
    oracle.P = before
    oracle.F = numerical(advanced, m)
    oracle.Q = np.zeros((mem.N, mem.N))
    oracle.predict()
    predict(m, CONSTANTS, t)
    params = VelocityParams()
    for j in range(mem.MODELS):
        added = covariance_of(m, j) - oracle.P
        off = added - np.diag(np.diag(added))
        # The distance rolled also depends on how bias and gain change the slip, which the filter leaves out.
        assert np.abs(off).max() < 1e-4 * np.abs(oracle.P).max()
        for i in (mem.V, mem.B, mem.K, mem.S, mem.C, mem.TG):
            assert np.abs(off[i, : mem.W]).max() < 1e-10
        dt, speed = 2e-3, state(m)[mem.V]
        assert added[mem.V, mem.V] == pytest.approx(params.accelerometer_noise**2 * dt, rel=1e-3)
        grade = (params.grade_noise * SPREAD[j]) ** 2 * speed
        assert added[mem.B, mem.B] == pytest.approx((params.bias_noise**2 + grade) * dt, rel=1e-3)


def test_between_two_blocks_speed_and_variance_are_those_of_a_full_step():
    m = moving()
    predict(m, CONSTANTS, m[mem.TIME])
    for i in range(1, 6):
        force_step(m, CONSTANTS, 0.2 * i, m[mem.TIME] + 2e6)
    full = m.copy()
    predict(full, CONSTANTS, full[mem.TIME])
    let_out(full, CONSTANTS, 0.0)
    assert m[mem.HELD] > 0.0
    assert m[mem.X + mem.V] == pytest.approx(full[mem.X + mem.V], abs=1e-12)
    assert m[mem.X + mem.D] == pytest.approx(full[mem.X + mem.D], abs=1e-4)
    assert m[mem.OUT_SPEED] == pytest.approx(full[mem.OUT_SPEED], abs=1e-12)
    # What gain and speed have in common is left out between blocks.
    assert m[mem.OUT_SPEED_VARIANCE] == pytest.approx(full[mem.OUT_SPEED_VARIANCE], rel=2e-3)


@pytest.mark.parametrize('index', [mem.TG, mem.TS])
def test_the_row_of_a_delayed_speed_is_its_derivative(index):
    m = alone(moving())
    place(m, index, 0.153)
    combine(m)
    h = np.zeros(mem.N)
    delayed_row(m, state_of(m, 1), index, h)
    scratch = np.zeros(mem.N)
    np.testing.assert_allclose(
        h, numerical(lambda other: delayed_row(other, state_of(other, 1), index, scratch), m)[0], atol=2e-4
    )


@pytest.mark.parametrize('delay', [0.0, 0.004, 0.15, 0.37, 1.0])
def test_a_delayed_speed_is_what_the_filter_said_then(delay):
    m = start_memory(VelocityParams())
    place(m, mem.V, 6.0)
    place(m, mem.B, 0.2)
    combine(m)
    force_step(m, CONSTANTS, 0.5, T0)
    speeds = {0: 6.0}
    for i in range(1, 1001):
        force_step(m, CONSTANTS, 0.5 + np.sin(0.02 * i), T0 + i * 2e6)
        speeds[i] = m[mem.X + mem.V]
    place(m, mem.TG, delay)
    combine(m)
    predict(m, CONSTANTS, m[mem.TIME])
    then = delayed_row(m, state_of(m, 1), mem.TG, np.zeros(mem.N))
    # The ring is linear over 10 ms: jerk of 10 m/s³ · (0.01 s)²/8.
    assert then == pytest.approx(speeds[1000 - round(delay / 0.002)], abs=2e-4)


def test_before_the_ring_the_car_is_taken_to_have_had_no_acceleration():
    m = moving(seconds=0.5)
    oldest, _ = force_at(m, T0 + 1e7)
    older, force = force_at(m, T0 - 1e9)
    assert force == m[mem.X + mem.B]
    assert older == pytest.approx(oldest - m[mem.X + mem.B] * 1.01, abs=0.05)


def measured(m, h, residual):
    """What a measurement with row `h` and one `residual` for all gives to the bank."""
    return np.tile(np.append(h, residual), (mem.MODELS, 1))


def test_a_correction_is_that_of_an_independent_filter():
    m = alone(moving())
    h = np.random.default_rng(1).standard_normal(mem.N)
    oracle = KalmanFilter(dim_x=mem.N, dim_z=1)
    oracle.x, oracle.P = state(m)[:, None], covariance(m)
    oracle.H, oracle.R = h[None, :], np.array([[0.03]])
    oracle.update(h @ state(m) + 1e-3)
    correct(m, measured(m, h, 1e-3), 0.03, np.inf, False, 0.0)
    np.testing.assert_allclose(state(m), oracle.x[:, 0], atol=1e-12)
    np.testing.assert_allclose(covariance(m), oracle.P, atol=1e-12)


def test_a_scale_that_is_only_considered_stays_and_stays_counted():
    m = alone(moving())
    before, cov = state(m), covariance(m)
    h = np.zeros(mem.N)
    h[[mem.V, mem.S]] = 1.0, 8.0
    correct(m, measured(m, h, 0.1), 0.03, np.inf, True, 0.0)
    assert state(m)[mem.S] == before[mem.S]
    assert covariance(m)[mem.S, mem.S] == pytest.approx(cov[mem.S, mem.S], abs=1e-15)
    assert abs(state(m)[mem.V] - before[mem.V]) > 1e-4


def test_the_estimate_is_the_mixture_of_the_bank():
    m = moving()
    rng = np.random.default_rng(3)
    weights = rng.dirichlet(np.ones(mem.MODELS))
    m[mem.WEIGHTS : mem.WEIGHTS + mem.MODELS] = weights
    states = rng.standard_normal((mem.MODELS, mem.N))
    for j in range(mem.MODELS):
        state_of(m, j)[:] = states[j]
    covs = [covariance_of(m, j).copy() for j in range(mem.MODELS)]
    combine(m)
    mean = weights @ states
    spread = sum(w * (c + np.outer(x - mean, x - mean)) for w, c, x in zip(weights, covs, states))
    np.testing.assert_allclose(state(m), mean, atol=1e-12)
    np.testing.assert_allclose(covariance(m), spread, atol=1e-12)


def test_mixing_leaves_the_mixture_as_it_is():
    m = moving()
    rng = np.random.default_rng(4)
    m[mem.WEIGHTS : mem.WEIGHTS + mem.MODELS] = mem.PRIOR
    for j in range(mem.MODELS):
        state_of(m, j)[:] += rng.standard_normal(mem.N)
    combine(m)
    before = m[mem.X : mem.BANK].copy()
    m[mem.MIXED_AT] = state(m)[mem.D] - 40.0
    spread = np.ptp([state_of(m, j)[mem.B] for j in range(mem.MODELS)])
    mix(m)
    combine(m)
    np.testing.assert_allclose(m[mem.X : mem.BANK], before, atol=1e-10)
    assert np.ptp([state_of(m, j)[mem.B] for j in range(mem.MODELS)]) < spread


def test_the_filter_whose_forecast_comes_true_gains_weight():
    m = moving()
    rows = np.zeros((mem.MODELS, mem.N + 1))
    rows[:, mem.V] = 1.0
    rows[:, mem.N] = (0.3, 0.0, 0.3, 0.3)
    before = m[mem.WEIGHTS + 1]
    correct(m, rows, 1e-4, np.inf, False, 0.0)
    assert m[mem.WEIGHTS + 1] > before
    assert m[mem.WEIGHTS : mem.WEIGHTS + mem.MODELS].sum() == pytest.approx(1.0)


def test_a_correction_reaches_the_output_in_small_steps_and_wholly():
    m = moving()
    let_out(m, CONSTANTS, 1.0)
    before = m[mem.OUT_SPEED]
    h = np.zeros(mem.N)
    h[mem.V] = 1.0
    correct(m, measured(m, h, 0.5), 1e-9, np.inf, False, 0.0)
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
    predict(m, CONSTANTS, m[mem.TIME])
    before = state(m)
    t = m[mem.TIME]
    assert gps_step(m, CONSTANTS, 0.06, 0.05**2, t, np.zeros((mem.MODELS, mem.N + 1))) == mem.SKIPPED
    np.testing.assert_array_equal(state(m), before)


def test_a_count_is_used_when_the_next_has_confirmed_it():
    m = moving(speed=8.0, force=0.0, seconds=0.2)
    rows = np.zeros((mem.MODELS, mem.N + 1))
    teeth = 8.0 * 0.1 / CONSTANTS[mem.TOOTH]
    assert count_step(m, CONSTANTS, 0.0, T0 + 0.2e9, rows) == mem.STARTED
    used = []
    for i in range(1, 4):
        predict(m, CONSTANTS, T0 + 0.2e9 + i * 1e8)
        before = covariance(m)[mem.V, mem.V]
        assert count_step(m, CONSTANTS, np.floor(i * teeth), T0 + 0.2e9 + i * 1e8, rows) == mem.USED
        used.append(covariance(m)[mem.V, mem.V] < before)
    assert used == [False, True, True]
    assert count_step(m, CONSTANTS, np.floor(4 * teeth) + 12.0, T0 + 0.6e9, rows) == mem.REFUSED
    assert m[mem.PENDING] == 0.0
    assert m[mem.SLIP] > 0.3
