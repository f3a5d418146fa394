# SPDX-License-Identifier: Apache-2.0
import math

from quad_control.params import TrialParams
from quad_control.trial import Trial

DT = 0.005


def outcome(rate_error, angle_error=lambda t: 0.0, saturated=lambda t: False, seconds=5.0):
    trial = Trial(TrialParams(), 0.0, {})
    for i in range(round(seconds / DT)):
        t = (i + 1) * DT
        verdict = trial.watch(t, DT, (rate_error(t), 0.0, 0.0), (angle_error(t), 0.0, 0.0), saturated(t))
        if verdict:
            return t, verdict
    return None, ''


def test_a_quiet_loop_is_kept_after_its_time():
    t, verdict = outcome(lambda t: 0.05 * math.sin(40.0 * t))
    assert verdict == 'kept'
    assert abs(t - 4.0) < 0.01


def test_an_oscillation_is_reverted_within_three_periods_and_a_half():
    for hertz in (3.0, 10.0, 25.0):
        t, verdict = outcome(lambda t, f=hertz: 2.0 * math.sin(2.0 * math.pi * f * t))
        assert verdict == 'reverted: roll oscillates'
        assert t < 3.6 / hertz + 2 * DT


def test_a_manoeuvre_is_no_oscillation():
    _, verdict = outcome(lambda t: 3.0 * math.sin(2.0 * math.pi * 0.8 * t))
    assert verdict == 'kept'


def test_a_large_angle_or_a_saturated_mixer_ends_the_trial_at_once():
    assert 'angle error' in outcome(lambda t: 0.0, angle_error=lambda t: 0.7)[1]
    t, verdict = outcome(lambda t: 0.0, saturated=lambda t: True)
    assert verdict == 'reverted: the mixer saturates'
    assert t < 0.6
