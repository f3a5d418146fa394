# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from kalman_core.parameters import ParameterError, build
from ship_inclinometer.alarms import AlarmMonitor, quantities
from ship_inclinometer.bridge_params import AlarmParams
from ship_inclinometer.marine import Picture
from ship_inclinometer.modbus_map import SETTINGS
from ship_inclinometer.roll_analysis import NO_ROLL, ROLLING
from ship_inclinometer.samples import VALID, Angles

DEFAULTS = {s.name: s.default for s in SETTINGS}
SECOND = 10**9


def run(monitor, heels, step=0.1, start=0):
    events = []
    for n, heel in enumerate(heels):
        events += monitor.update(start + SECOND + round(n * step * SECOND), {'heel': heel})
    return events


def kinds(events, name='heel_warning'):
    return [e.kind for e in events if e.name == name]


def test_an_alarm_comes_after_its_delay_and_not_before():
    monitor = AlarmMonitor(DEFAULTS)
    assert run(monitor, [11.0] * 20) == []
    events = run(monitor, [11.0] * 3, start=2 * SECOND)
    assert kinds(events) == ['alarm']
    assert 'heel' in events[0].text


def test_a_short_excursion_raises_nothing_and_starts_the_delay_anew():
    monitor = AlarmMonitor(DEFAULTS)
    assert run(monitor, [11.0] * 19 + [9.0] + [11.0] * 19) == []


def test_both_sides_count():
    assert kinds(run(AlarmMonitor(DEFAULTS), [-25.0] * 30)) == ['alarm']


def test_chatter_at_the_threshold_gives_one_alarm():
    heels = [11.0] * 25 + [9.5, 10.2] * 50
    assert kinds(run(AlarmMonitor(DEFAULTS), heels)) == ['alarm']


def test_an_ended_alarm_stays_until_it_is_acknowledged_when_latching():
    for latching in (True, False):
        monitor = AlarmMonitor(DEFAULTS, latching)
        events = run(monitor, [11.0] * 25 + [0.0])
        assert kinds(events) == ['alarm', 'end']
        state = monitor.states['heel_warning']
        assert not state.active
        assert state.shown is latching
        assert len(monitor.acknowledge()) == int(latching)
        assert not state.shown


def test_acknowledging_one_leaves_the_other():
    monitor = AlarmMonitor(DEFAULTS)
    run(monitor, [25.0] * 30)
    assert [e.name for e in monitor.acknowledge('heel_alarm')] == ['heel_alarm']
    assert not monitor.states['heel_warning'].acknowledged


def test_silence_lasts_its_time_and_is_broken_by_a_new_alarm():
    monitor = AlarmMonitor(DEFAULTS)
    run(monitor, [11.0] * 25)
    now = 5 * SECOND
    assert monitor.sounding(now)
    monitor.silence(now)
    assert not monitor.sounding(now + 29 * SECOND)
    assert monitor.sounding(now + 31 * SECOND)
    monitor.silence(now + 32 * SECOND)
    run(monitor, [25.0] * 25, start=now + 33 * SECOND)
    assert monitor.sounding(now + 36 * SECOND)


def test_unknown_neither_raises_nor_ends():
    monitor = AlarmMonitor(DEFAULTS)
    run(monitor, [11.0] * 25)
    assert run(monitor, [math.nan] * 50, start=4 * SECOND) == []
    assert monitor.states['heel_warning'].active


def test_the_stop_flag_suspends_alarms_and_is_said():
    monitor = AlarmMonitor(DEFAULTS)
    run(monitor, [11.0] * 25)
    monitor.stopped = True
    assert run(monitor, [30.0] * 100, start=10 * SECOND) == []
    assert not monitor.sounding(20 * SECOND)
    assert monitor.numbers(20 * SECOND)['stop_flag'] == 1.0
    monitor.stopped = False
    assert kinds(run(monitor, [30.0] * 30, start=30 * SECOND), 'heel_alarm') == ['alarm']


def test_only_time_seen_over_the_threshold_counts_towards_the_delay():
    monitor = AlarmMonitor(DEFAULTS)
    assert run(monitor, [30.0]) == []
    assert run(monitor, [math.nan] * 10, start=SECOND) == []
    assert run(monitor, [30.0], start=600 * SECOND) == []
    # An attitude that comes and goes cannot put the alarm off for ever.
    assert 'alarm' in kinds(run(monitor, [30.0, 30.0, math.nan] * 30, start=601 * SECOND), 'heel_alarm')


@pytest.mark.parametrize('step', [-3600, -600])
def test_a_clock_that_goes_back_costs_no_more_than_one_judgement(step):
    monitor = AlarmMonitor(DEFAULTS)
    run(monitor, [30.0] * 10, start=7200 * SECOND)
    events = run(monitor, [30.0] * 12, start=(7201 + step) * SECOND)
    assert kinds(events, 'heel_alarm') == ['alarm']
    now = (7210 + step) * SECOND
    monitor.silence(now)
    assert not monitor.sounding(now - 3600 * SECOND)
    assert monitor.sounding(now - 3600 * SECOND + 31 * SECOND)


def test_a_hysteresis_over_its_threshold_is_refused_and_an_alarm_ends_all_the_same():
    for lowest in ('heel_warning', 'roll_alarm', 'pitch_alarm'):
        with pytest.raises(ParameterError, match=r"'hysteresis' is 6 .*the lowest is 5 "):
            build(AlarmParams, {lowest: 5.0, 'hysteresis': 6.0})
    monitor = AlarmMonitor({**DEFAULTS, 'heel_warning': 5.0, 'hysteresis': 6.0})
    assert kinds(run(monitor, [5.5] * 25 + [4.9] * 5 + [2.0])) == ['alarm', 'end']


def rolled(stamp, status, amplitude):
    picture = Picture(validity=VALID)
    picture.take_angles(Angles(stamp, '', (0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, VALID))
    numbers = {'status': status, 'amplitude_port': math.radians(amplitude), 'amplitude_starboard': math.nan}
    picture.take_roll(stamp, numbers | {'synchronous_warning': 0.0, 'parametric_warning': 0.0})
    return picture


def test_the_roll_alarm_ends_with_the_rolling():
    monitor, now = AlarmMonitor(DEFAULTS), 1000 * SECOND
    events = []
    for n in range(60):
        status, amplitude = (ROLLING, 17.0) if n < 30 else (NO_ROLL, math.nan)
        stamp = now + n * SECOND // 10
        events += monitor.update(stamp, quantities(rolled(stamp, status, amplitude), stamp, True))
    assert kinds(events, 'roll_alarm') == ['alarm', 'end']


def test_a_roll_analysis_that_falls_silent_is_a_fault_and_its_last_words_are_not_judged():
    picture, now = rolled(1000 * SECOND, ROLLING, 17.0), 1000 * SECOND
    before = quantities(picture, now, True)
    assert before['amplitude'] == pytest.approx(17.0)
    assert (before['resonance'], before['sensor_fault']) == (0.0, 0.0)
    picture.stamp = later = now + 4 * SECOND
    after = quantities(picture, later, True)
    assert math.isnan(after['amplitude'])
    assert math.isnan(after['resonance'])
    assert after['heel'] == 0.0
    assert after['sensor_fault'] == 1.0


def test_a_missing_attitude_is_a_fault_once_the_start_is_over():
    assert math.isnan(quantities(Picture(), SECOND, False)['sensor_fault'])
    assert quantities(Picture(), SECOND, True)['sensor_fault'] == 1.0
