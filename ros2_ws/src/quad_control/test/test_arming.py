# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from quad_control.arming import ARMED, DESCENT, DISARMED, STOPPED, Arming, Checks
from quad_control.arming import SIZE as ARMING_SIZE
from quad_control.params import ArmingParams

GOOD = Checks(10.0, 0.0, 0.0, 0.01, 0.0, 0.0, True, 24.0)


def machine():
    return Arming(ArmingParams(), np.zeros(ARMING_SIZE))


def armed():
    m = machine()
    m.tick(GOOD._replace(switch=False))
    assert m.tick(GOOD) == 'armed'
    return m


def test_a_switch_that_was_never_off_does_not_arm():
    m = machine()
    for _ in range(10):
        m.tick(GOOD)
    assert m.mode == DISARMED


@pytest.mark.parametrize(
    ('change', 'word'),
    [
        ({'rate_sigma': 0.06}, 'bias'),
        ({'rate_sigma': math.nan}, 'bias'),
        ({'tilt': 0.3}, 'tilt'),
        ({'throttle': 0.2}, 'throttle'),
        ({'voltage': 19.0}, 'battery'),
        ({'attitude_age': 0.1}, 'stale'),
    ],
)
def test_arming_is_refused_with_the_reason(change, word):
    m = machine()
    m.tick(GOOD._replace(switch=False))
    text = m.tick(GOOD._replace(**change))
    assert text.startswith('refused')
    assert word in text
    assert m.mode == DISARMED


def test_without_a_setpoint_nothing_arms():
    m = machine()
    assert m.request(True, GOOD._replace(setpoint_age=9.0)) == 'refused: no setpoint'


@pytest.mark.parametrize('change', [{'attitude_age': 0.045}, {'rate_sigma': 5.0}, {'rate_sigma': math.nan}])
def test_lost_attitude_stops_the_motors(change):
    m = armed()
    m.tick(GOOD._replace(**change))
    assert m.mode == STOPPED


def test_a_lost_link_descends_and_a_link_that_is_back_flies_on():
    m = armed()
    assert 'no setpoint' in m.tick(GOOD._replace(setpoint_age=0.6))
    assert m.mode == DESCENT
    assert m.tick(GOOD) == 'armed: link is back'


def test_a_low_battery_descends_after_its_hold_time_and_stays_so():
    m = armed()
    low = GOOD._replace(voltage=19.0)
    m.tick(low)
    assert m.mode == ARMED
    m.tick(low._replace(time=11.1))
    assert m.mode == DESCENT
    m.tick(GOOD._replace(time=11.2))
    assert m.mode == DESCENT


def test_a_short_dip_of_the_voltage_is_forgiven():
    m = armed()
    m.tick(GOOD._replace(voltage=19.0))
    m.tick(GOOD._replace(time=10.5))
    m.tick(GOOD._replace(voltage=19.0, time=11.2))
    assert m.mode == ARMED


def test_a_descent_ends_when_it_has_not_been_seen_to_sink_for_its_time():
    limit = ArmingParams().descent_time
    m = armed()
    lost = GOOD._replace(setpoint_age=0.6)
    m.tick(lost)
    m.tick(lost._replace(time=10.0 + limit, sinking=True))
    m.tick(lost._replace(time=9.0 + 2.0 * limit))
    assert m.mode == DESCENT
    m.tick(lost._replace(time=11.0 + 2.0 * limit))
    assert m.mode == STOPPED


def test_after_a_stop_only_the_switch_leads_back_over_disarmed():
    m = armed()
    m.kill(10.0)
    m.tick(GOOD)
    assert m.mode == STOPPED
    m.tick(GOOD._replace(switch=False))
    assert m.mode == DISARMED
    m.tick(GOOD)
    assert m.mode == ARMED


def test_a_lost_link_says_nothing_about_the_switch():
    m = armed()
    m.tick(GOOD._replace(setpoint_age=0.6, switch=False))
    assert m.mode == DESCENT
