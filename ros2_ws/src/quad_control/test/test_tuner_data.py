# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import pytest

from quad_control.tuner_data import TunerData


def event(text):
    return SimpleNamespace(data=text)


@pytest.mark.parametrize(
    ('events', 'by'),
    [
        ([], 'elsewhere'),
        (['trial: roll_rate_p for 4 s', 'trial: reverted: roll oscillates'], 'trial'),
        (['proposal: roll: Ku 0.1, Tu 0.1 s -> roll_rate_p 0.03838, roll_rate_d 0.001'], 'autotune'),
        (['proposal: roll: Ku 0.1, Tu 0.1 s -> roll_rate_p 0.05, roll_rate_d 0.001'], 'elsewhere'),
    ],
)
def test_the_history_names_where_a_change_came_from(events, by):
    data = TunerData()
    for text in events:
        data.on_event(event(text))
    data.changed_elsewhere({'roll_rate_p': 0.0383804, 'controller': 'cascade'})
    assert data.history.entries == [{'by': by, 'changes': {'roll_rate_p': [0.06, 0.0383804]}}]


def test_the_echo_of_a_change_by_the_page_is_no_change_from_elsewhere():
    data = TunerData()
    data.expect({'roll_rate_p': 0.07})
    data.changed_elsewhere({'roll_rate_p': 0.07})
    assert data.history.entries == []
    assert next(g.value for g in data.gains() if g.name == 'roll_rate_p') == 0.07


def test_a_trial_is_shown_while_it_runs():
    data = TunerData()
    data.on_event(event('trial: roll_rate_p for 4 s'))
    assert data.state()['trial'] == 'on trial: roll_rate_p for 4 s'
    data.on_event(event('trial: kept'))
    assert data.state()['trial'] == ''


def stamped(seconds, **fields):
    stamp = SimpleNamespace(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), **fields)


def report(seconds, roll=0.1):
    return stamped(seconds, position=[0.0, 0.0, 0.0], velocity=[roll, 0.2, 0.0])


def test_a_report_becomes_one_sample_of_setpoint_filtered_and_raw_angle_and_pulses():
    data = TunerData()
    data.on_report(report(1.0))
    data.on_raw(SimpleNamespace(vector=SimpleNamespace(x=0.3, y=0.4)))
    data.on_motors(SimpleNamespace(position=[1100.0, 1200.0, 1300.0, 1400.04]))
    data.on_report(report(1.02))
    counter, samples = data.samples(0)
    assert counter == 2
    # Before the first raw angle the filtered one stands in for it.
    assert samples[0] == [1.0, [0.0, 0.0], [0.1, 0.2], [0.1, 0.2], [1000.0] * 4]
    assert samples[1] == [1.02, [0.0, 0.0], [0.1, 0.2], [0.3, 0.4], [1100.0, 1200.0, 1300.0, 1400.0]]
    assert data.samples(1)[1] == samples[1:]


def test_the_plot_is_thinned_to_100_hz_and_the_rate_is_of_all():
    data = TunerData()
    for i in range(200):
        data.on_report(report(1.0 + i / 400))
    assert data.samples(0)[0] == pytest.approx(50, abs=1)
    assert data.state()['rate'] == pytest.approx(400.0)


def test_time_that_jumps_back_starts_rate_and_plot_anew():
    data = TunerData()
    data.on_report(report(100.0))
    data.on_report(report(1.0))
    assert data.state()['rate'] is None
    data.on_report(report(1.02))
    assert data.samples(0)[0] == 3


def test_battery_and_arming_are_shown_and_a_voltage_that_is_none_is_not():
    data = TunerData()
    data.on_battery(SimpleNamespace(voltage=24.5))
    data.on_arming(event('armed'))
    assert (data.state()['voltage'], data.state()['arming']) == (24.5, 'armed')
    data.on_battery(SimpleNamespace(voltage=float('nan')))
    assert data.state()['voltage'] is None
