# SPDX-License-Identifier: Apache-2.0
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'bench'))
import roll_bench as bench

from ship_inclinometer.roll_analysis import (
    NO_ROLL,
    NOT_VALID,
    ROLLING,
    RollAnalysis,
    RollCycle,
    RollState,
    vertex,
)
from ship_inclinometer.roll_params import RollParams
from ship_inclinometer.samples import INVALID, Angles, Validity

START = 10**18


def sample(t, heel, pitch=0.0):
    zeros = (0.0, 0.0, 0.0)
    return Angles(START + round(t * 1e9), '', (math.radians(heel), math.radians(pitch), 0.0), zeros, zeros, 0)


def run(t, heel, params=None, pitch=None):
    analysis = RollAnalysis(params)
    out = []
    for i, time in enumerate(t):
        out += analysis.on_angles(sample(time, heel[i], 0.0 if pitch is None else pitch[i]))
    return analysis, out


def states(out):
    return [e for e in out if isinstance(e, RollState)]


def test_98_percent_of_the_cycles_of_irregular_seas_are_within_tolerance():
    scores = [bench.period_score(sea, seed) for sea in bench.SEAS for seed in range(2)]
    assert sum(s.good for s in scores) >= 0.98 * sum(s.cycles for s in scores)
    assert max(excess for s in scores for excess in s.excesses) <= 1.0


def test_noise_does_not_choose_between_two_tops_of_one_half_cycle():
    # Two tops 3 s apart, the later one 0.05° lower; 0.1° of noise on each sample alone would often turn that.
    t = np.arange(0.0, 12.0, 0.2)
    heel = (
        4.0 * np.sin(math.pi * t / 12.0) + 0.8 * np.cos(2.0 * math.pi * (t - 4.5) / 3.0) - 0.011 * (t - 4.5)
    )
    clean, _ = vertex(t, heel)
    rng = np.random.default_rng(0)
    found = np.array([vertex(t, heel + 0.1 * rng.standard_normal(len(t)))[0] for _ in range(200)])
    assert np.mean(np.abs(found - clean) < 1.0) > 0.8


def test_pure_sines_are_within_a_tenth_of_a_second():
    assert bench.sine_error((4.0, 7.3, 12.0, 21.0, 40.0)) < 0.1


@pytest.mark.parametrize('rate', [5.0, 20.0, 100.0])
def test_the_period_does_not_depend_on_the_rate(rate):
    t = np.arange(0.0, 120.0, 1.0 / rate)
    _, out = run(t, 8.0 * np.sin(2 * math.pi * t / 11.0) + 3.0)
    assert states(out)[-1].period == pytest.approx(11.0, abs=0.05)


def test_amplitudes_are_heel_to_each_side_and_peaks_are_held_until_reset():
    t = np.arange(0.0, 200.0, 0.2)
    envelope = np.where(t < 100.0, 10.0, 5.0)
    analysis, out = run(t, envelope * np.sin(2 * math.pi * t / 10.0) + 2.0)
    last = states(out)[-1]
    assert math.degrees(last.amplitude_starboard) == pytest.approx(7.0, abs=0.1)
    assert math.degrees(last.amplitude_port) == pytest.approx(3.0, abs=0.1)
    assert math.degrees(last.peak_starboard) == pytest.approx(12.0, abs=0.1)
    assert math.degrees(last.peak_port) == pytest.approx(8.0, abs=0.1)
    analysis.reset_peaks(START + 200 * 10**9)
    after = analysis.on_angles(sample(200.2, 1.0))
    assert math.degrees(after[-1].peak_starboard) == pytest.approx(1.0)


def test_a_ship_that_lies_still_does_not_roll_and_has_no_period():
    t = np.arange(0.0, 120.0, 0.2)
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(t))
    last = states(run(t, 4.0 + noise)[1])[-1]
    assert last.status == NO_ROLL
    assert math.isnan(last.period)


def test_rolling_that_dies_out_ends_as_no_roll():
    t = np.arange(0.0, 300.0, 0.2)
    heel = 8.0 * np.exp(-t / 20.0) * np.sin(2 * math.pi * t / 12.0)
    result = states(run(t, heel)[1])
    assert result[150].status == ROLLING
    assert result[-1].status == NO_ROLL


def test_sides_are_not_mixed():
    t = np.arange(0.0, 100.0, 0.2)
    _, out = run(t, 10.0 * np.sin(2 * math.pi * t / 10.0))
    cycles = [e for e in out if isinstance(e, RollCycle)]
    for cycle in cycles[4:]:
        assert np.sign(cycle.heel) == cycle.side
        phase = cycle.time / 10.0 % 1.0
        assert phase == pytest.approx(0.25 if cycle.side > 0 else 0.75, abs=0.01)


def test_mirrored_heel_gives_mirrored_amplitudes():
    t, heel = bench.heel_of_sea(9.0, 12.0, 1, 300.0)
    first, second = states(run(t, heel)[1])[-1], states(run(t, -heel)[1])[-1]
    assert first.amplitude_port == pytest.approx(second.amplitude_starboard, abs=1e-9)
    assert first.period == pytest.approx(second.period, abs=1e-9)


def test_an_invalid_attitude_is_marked():
    analysis = RollAnalysis()
    analysis.on_validity(Validity(START, INVALID, 'aligning', False, (0.0, 0.0, 0.0)))
    assert analysis.on_angles(sample(1.0, 1.0))[-1].status == NOT_VALID


def test_synchronous_roll_is_warned_of():
    t = np.arange(0.0, 400.0, 0.2)
    heel, pitch = 12.0 * np.sin(2 * math.pi * t / 12.0), 2.0 * np.sin(2 * math.pi * t / 12.0 + 1.0)
    assert states(run(t, heel, RollParams(natural_period=12.0), pitch)[1])[-1].synchronous
    assert not states(run(t, heel, RollParams(natural_period=16.0), pitch)[1])[-1].synchronous


def test_parametric_roll_is_warned_of_while_it_grows():
    t = np.arange(0.0, 260.0, 0.2)
    heel = np.minimum(1.0 * np.exp(np.maximum(t - 150.0, 0.0) / 40.0), 30.0) * np.sin(2 * math.pi * t / 20.0)
    pitch = 3.0 * np.sin(2 * math.pi * t / 10.0)
    assert any(s.parametric for s in states(run(t, heel, None, pitch)[1]))
    steady = 12.0 * np.sin(2 * math.pi * t / 20.0)
    assert not any(s.parametric for s in states(run(t, steady, None, pitch)[1])[100:])


def test_time_that_goes_back_and_gaps_restart_it():
    t = np.arange(0.0, 60.0, 0.2)
    analysis, _ = run(t, 5.0 * np.sin(t))
    for n in range(10):
        analysis.on_angles(sample(n * 0.2, 1.0))
    assert any('back' in reason for reason in analysis.tally.restarts)
    analysis.on_angles(sample(100.0, 1.0))
    assert any('no heel' in reason for reason in analysis.tally.restarts)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(-3, 20), st.sampled_from([0.0, 5.0, -5.0, 90.0, math.nan, math.inf])),
        max_size=150,
    )
)
def test_it_takes_whatever_comes(steps):
    analysis, t = RollAnalysis(), 1000.0
    for step, heel in steps:
        t += 0.1 * step
        angle = heel if not math.isfinite(heel) else math.radians(heel)
        zeros = (0.0, 0.0, 0.0)
        for estimate in analysis.on_angles(
            Angles(START + round(t * 1e9), '', (angle, 0.0, 0.0), zeros, zeros, 0)
        ):
            if isinstance(estimate, RollState):
                assert math.isfinite(estimate.heel)


def test_after_a_change_of_list_a_smaller_roll_is_told_and_the_larger_one_forgotten():
    t = np.arange(0.0, 400.0, 0.2)
    for list_angle in (1.0, 3.0, -3.0):
        heel = np.where(t < 150.0, 4.0, 1.0) * np.sin(2 * math.pi * t / 9.0) + list_angle * (t > 150.0)
        last = states(run(t, heel)[1])[-1]
        assert last.status == ROLLING
        assert last.period == pytest.approx(9.0, abs=0.1)
        assert math.degrees(last.mean_heel) == pytest.approx(list_angle, abs=0.2)
        assert math.degrees(last.amplitude_starboard) == pytest.approx(max(list_angle + 1.0, 0.0), abs=0.2)
        assert math.degrees(last.amplitude_port) == pytest.approx(max(1.0 - list_angle, 0.0), abs=0.2)


def test_no_maximum_is_shown_for_longer_than_the_longest_period():
    t = np.arange(0.0, 250.0, 0.2)
    heel = np.where(t < 150.0, 4.0, 0.7) * np.sin(2 * math.pi * t / 9.0) + 3.0 * (t > 150.0)
    shown = states(run(t, heel)[1])
    late = [s for s in shown if (s.stamp - START) * 1e-9 > 150.0 + 2.0 * 45.0]
    assert all(not s.amplitude_port > math.radians(1.0) for s in late)
