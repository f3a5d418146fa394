# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from scipy.signal import freqz

from quad_control import loops

DT = 0.005
OFF = {'weight': 1.0, 'limit': 1.0, 'd_cutoff': 0.0, 'cutoff': 0.0, 'notch_hz': 0.0, 'notch_q': 3.0}


def step(s, rate, target, kp=0.0, ki=0.0, kd=0.0, **changes):
    o = {**OFF, **changes}
    return loops.rate_step(
        s, rate, target, kp, ki, kd, o['weight'], o['limit'], o['d_cutoff'], o['cutoff'], o['notch_hz'],
        o['notch_q'], DT,
    )  # fmt: skip


def state():
    return np.zeros(loops.AXIS_SIZE)


def test_a_step_of_the_setpoint_does_not_kick_the_derivative():
    s = state()
    step(s, 0.0, 0.0, kd=1.0)
    assert step(s, 0.0, 5.0, kd=1.0) == 0.0


def test_the_derivative_brakes_a_growing_rate():
    s = state()
    step(s, 0.0, 0.0, kd=0.1)
    assert step(s, 0.01, 0.0, kd=0.1) == pytest.approx(-0.1 * 0.01 / DT)


def test_the_setpoint_weight_acts_on_the_proportional_term_only():
    assert step(state(), 0.0, 2.0, kp=0.5, weight=0.3) == pytest.approx(0.3)
    assert step(state(), 0.0, 2.0, ki=1.0, weight=0.3) == pytest.approx(2.0 * DT)


def test_a_change_of_the_integral_gain_moves_nothing():
    s = state()
    for _ in range(100):
        before = step(s, 0.0, 0.1, ki=0.5)
    assert step(s, 0.1, 0.1, ki=5.0) == pytest.approx(before)


def test_the_integral_stops_at_its_limit_and_leaves_it_at_once():
    s = state()
    for _ in range(5000):
        step(s, 0.0, 1.0, ki=1.0, limit=0.2)
    assert s[loops.INTEGRAL] == pytest.approx(0.2)
    step(s, 0.0, -1.0, ki=1.0, limit=0.2)
    assert s[loops.INTEGRAL] < 0.2


def test_no_windup_while_the_mixer_gives_less_than_asked():
    s = state()
    for _ in range(1000):
        demand = step(s, 0.0, 1.0, kp=1.0, ki=1.0)
        loops.unwind(s, demand, 0.5)
    assert s[loops.INTEGRAL] == pytest.approx(0.0, abs=1e-12)
    demand = step(s, 0.0, -1.0, kp=1.0, ki=1.0)
    loops.unwind(s, demand, -0.5)
    assert s[loops.INTEGRAL] == pytest.approx(0.0, abs=1e-12)


def test_integration_back_from_a_limit_is_never_taken_away():
    s = state()
    s[loops.INTEGRAL] = 0.9
    demand = step(s, 0.0, -1.0, kp=0.01, ki=1.0)
    loops.unwind(s, demand, 0.5)
    assert s[loops.INTEGRAL] == pytest.approx(0.9 - DT)


@pytest.mark.parametrize('frequency', [5.0, 40.0, 43.0, 80.0])
def test_the_notch_has_the_response_of_its_transfer_function(frequency):
    w0, q = 2.0 * math.pi * 40.0 * DT, 3.0
    alpha = math.sin(w0) / (2.0 * q)
    b = [1.0, -2.0 * math.cos(w0), 1.0]
    a = [1.0 + alpha, -2.0 * math.cos(w0), 1.0 - alpha]
    _, expected = freqz(b, a, worN=[2.0 * math.pi * frequency * DT])
    s = state()
    t = np.arange(4000) * DT
    y = np.array([loops.notch(s, math.sin(2.0 * math.pi * frequency * x), 40.0, q, DT) for x in t])
    assert np.sqrt(2.0 * np.mean(y[2000:] ** 2)) == pytest.approx(abs(expected[0]), abs=0.01)


def test_a_notch_beyond_nyquist_is_off():
    assert loops.notch(state(), 0.7, 95.0, 3.0, DT) == 0.7


def test_the_published_pid_is_equation_1_summed_by_hand():
    s, errors = state(), [0.1, 0.3, -0.2]
    out = [loops.published_step(s, e, 0.46, 9.58, 0.0043, 2.0, DT) for e in errors]
    integral = 9.58 * DT * sum(errors)
    assert out[-1] == pytest.approx(2.0 * (0.46 * -0.2 + integral + 0.0043 * (-0.2 - 0.3) / DT))
