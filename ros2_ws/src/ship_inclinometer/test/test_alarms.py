# SPDX-License-Identifier: Apache-2.0
import math

from ship_inclinometer.alarms import AlarmMonitor
from ship_inclinometer.modbus_map import SETTINGS

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
        assert len(monitor.acknowledge(5 * SECOND)) == int(latching)
        assert not state.shown


def test_acknowledging_one_leaves_the_other():
    monitor = AlarmMonitor(DEFAULTS)
    run(monitor, [25.0] * 30)
    assert [e.name for e in monitor.acknowledge(9 * SECOND, 'heel_alarm')] == ['heel_alarm']
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
