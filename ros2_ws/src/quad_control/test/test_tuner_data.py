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
