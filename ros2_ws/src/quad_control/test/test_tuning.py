# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from scipy.signal import cont2discrete

from quad_control.linear_plant import LinearPlant, LinearSimulation, documented_plant, margins, rate_plant
from quad_control.tuning import (
    PidGains,
    RelayTest,
    Ultimate,
    cascade_for,
    identify_rate_plant,
    period_of,
    pid_margins,
    plant_from_ultimate,
    ultimate_by_experiment,
    ultimate_by_relay,
    ziegler_nichols,
)

PLANTS = [documented_plant(), rate_plant(722.0), LinearPlant(50.0, 0.05, 0.01, lag2=0.004)]


def exact_ultimate(plant):
    """Ultimate point of the sampled loop: poles of the closed discrete system, no frequency response."""
    a = np.array([[0.0, 1.0], [0.0, -1.0 / plant.lag]])
    b = np.array([[0.0], [plant.gain / plant.lag]])
    fine = 2.5e-4
    ad, bd, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), fine)
    n = round(plant.delay / fine)

    def radius(gain):
        # State: y, y', the last n inputs; one control period of held input, then the new one.
        size = 2 + n
        step = np.zeros((size, size))
        step[:2, :2] = ad
        step[:2, -1:] = bd
        for i in range(n - 1):
            step[3 + i, 2 + i] = 1.0
        held = np.eye(size + 1)
        one = np.zeros((size + 1, size + 1))
        one[:size, :size] = step
        one[2, size] = 1.0
        one[size, size] = 1.0
        for _ in range(round(plant.period / fine)):
            held = one @ held
        feedback = np.eye(size + 1)
        feedback[size] = 0.0
        feedback[size, 0] = -gain
        values = np.linalg.eigvals(held @ feedback)
        worst = values[np.argmax(np.abs(values))]
        return abs(worst), abs(np.angle(worst))

    low, high = 1e-4, 1e4
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if radius(middle)[0] < 1.0 else (low, middle)
    return high, 2.0 * math.pi * plant.period / radius(high)[1]


def test_ziegler_nichols_gives_the_papers_numbers():
    gains = ziegler_nichols(Ultimate(0.9, 0.08))
    assert (gains.kp, gains.ki, gains.kd) == pytest.approx((0.54, 13.5, 0.0054))


def test_the_experiment_on_the_documented_plant_gives_the_published_ultimate_point():
    u = ultimate_by_experiment(documented_plant())
    assert (u.gain, u.period) == pytest.approx((0.9, 0.08), rel=0.02)


@pytest.mark.parametrize('plant', PLANTS[:2])
def test_theory_agrees_with_the_poles_of_the_sampled_loop(plant):
    assert plant.ultimate() == pytest.approx(exact_ultimate(plant), rel=0.02)


@pytest.mark.parametrize('plant', PLANTS)
def test_both_experiments_are_within_ten_percent_of_theory(plant):
    theory = plant.ultimate()
    for u in (ultimate_by_experiment(plant), ultimate_by_relay(plant)):
        assert (u.gain, u.period) == pytest.approx(theory, rel=0.1)


def test_hysteresis_finds_a_point_before_180_degrees_and_the_same_plant():
    plant = rate_plant(722.0)
    u = ultimate_by_relay(plant, amplitude=0.03, hysteresis=0.05)
    assert u.lead > 0.1
    found = plant_from_ultimate(u, plant.delay)
    assert found.gain == pytest.approx(plant.gain, rel=0.1)
    assert found.lag == pytest.approx(plant.lag, rel=0.15)


def test_a_relay_without_an_answer_says_so():
    relay = RelayTest(0.1, 0.01)
    for _ in range(1000):
        relay.output(0.5, 0.005)
    assert relay.failed
    assert relay.result is None


def test_a_plant_found_from_its_ultimate_point_has_that_point():
    plant = plant_from_ultimate(Ultimate(0.2, 0.1), delay=0.005)
    assert plant.ultimate() == pytest.approx((0.2, 0.1), rel=1e-6)


def test_margins_of_an_integrator_with_delay_by_hand():
    # 1/s e^(-0.1 s): crossover 1, phase margin pi/2 - 0.1, gain margin (pi/2)/0.1.
    m = margins(lambda w: np.exp(-0.1j * w) / (1j * w))
    assert m.crossover == pytest.approx(1.0, rel=0.01)
    assert m.phase == pytest.approx(math.pi / 2 - 0.1, abs=0.01)
    assert m.gain == pytest.approx(math.pi / 2 / 0.1, rel=0.01)


def test_published_gains_have_thin_margins_on_the_documented_plant_and_the_cascade_wide_ones():
    published = pid_margins(documented_plant(), PidGains(0.46, 9.58, 0.0043))
    assert math.radians(18.0) <= published.phase <= math.radians(30.0)
    cascade = cascade_for(rate_plant(722.0)).margins
    assert cascade.phase > math.radians(55.0)
    assert cascade.gain > 4.0


@pytest.mark.parametrize(
    'plant', [rate_plant(722.0), rate_plant(300.0, motor_time=0.05), rate_plant(722.0, delay=0.01)]
)
def test_identification_finds_the_plant_that_made_the_log(plant):
    rng = np.random.default_rng(0)
    simulation = LinearSimulation(plant)
    demand = 0.02 * np.sign(np.sin(np.arange(600) * 0.1)) + 0.005 * rng.standard_normal(600)
    rate = np.empty(600)
    for i, u in enumerate(demand):
        rate[i] = simulation.output
        simulation.advance(u)
    found = identify_rate_plant(demand, rate + 0.01 * rng.standard_normal(600), plant.period)
    assert found.plant.gain == pytest.approx(plant.gain, rel=0.05)
    assert found.plant.lag == pytest.approx(plant.lag, rel=0.1)
    assert found.plant.delay == pytest.approx(plant.delay, abs=1e-3)
    assert found.fit > 0.98


@pytest.mark.parametrize(
    ('demand', 'rate', 'word'),
    [(np.zeros(10), np.zeros(10), 'at least'), (np.zeros(400), np.ones(400), 'no excitation')],
)
def test_a_log_that_shows_nothing_is_refused(demand, rate, word):
    with pytest.raises(ValueError, match=word):
        identify_rate_plant(demand, rate, 0.005)


def test_the_period_of_a_sine_is_found_between_samples():
    t = np.arange(400) * 0.005
    assert period_of(np.sin(2.0 * math.pi * t / 0.0873), 0.005) == pytest.approx(0.0873, rel=1e-3)


def test_a_loop_that_no_gain_makes_oscillate_is_refused():
    with pytest.raises(ValueError, match='no gain up to 1e4'):
        ultimate_by_experiment(LinearPlant(1e-9, 0.05, 0.005))
