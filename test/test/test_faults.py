# SPDX-License-Identifier: Apache-2.0
"""The injector, and a short campaign: the estimator is killed, corrupted and stopped."""

import math
from types import SimpleNamespace

import pytest
from faults.campaign import Outcome, table
from faults.cases import cases, short_cases
from faults.relay import CORRUPTIONS, FAULTS, Injector


def message(number):
    vector = {'x': 0.1, 'y': 0.2, 'z': 9.8}
    return SimpleNamespace(
        number=number,
        header=SimpleNamespace(stamp=SimpleNamespace(sec=number + 1, nanosec=0)),
        angular_velocity=SimpleNamespace(**vector),
        linear_acceleration=SimpleNamespace(**vector),
    )


def sent(fault, count=100, first=20, last=60):
    injector = Injector(fault, first, last, seed=3)
    return [m for number in range(count) for m in injector(message(number))]


@pytest.mark.parametrize('fault', FAULTS)
def test_messages_outside_the_window_pass_unchanged_and_the_same_each_time(fault):
    numbers = [m.number for m in sent(fault)]
    assert numbers == [m.number for m in sent(fault)]
    assert numbers[:20] == list(range(20))
    assert numbers[-40:] == list(range(60, 100))


@pytest.mark.parametrize('fault', ['delay', 'reorder'])
def test_what_is_held_back_comes(fault):
    numbers = [m.number for m in sent(fault)]
    assert sorted(numbers) == list(range(100))


def test_order_is_lost_only_by_reordering():
    assert [m.number for m in sent('reorder')] != list(range(100))
    assert [m.number for m in sent('delay')] == list(range(100))


def test_drop_duplicate_and_silence_count():
    assert 20 < 100 - len(sent('silence')) <= 40
    assert 5 <= 100 - len(sent('drop')) <= 20
    assert len(sent('duplicate')) == 140


@pytest.mark.parametrize('fault', CORRUPTIONS)
def test_one_message_in_three_is_corrupted(fault):
    def numbers(m):
        rate, force = m.angular_velocity, m.linear_acceleration
        values = (m.header.stamp.sec - m.number, rate.x, rate.y, rate.z, force.x, force.y, force.z)
        return [repr(v) for v in values]

    changed = [m.number for m in sent(fault) if numbers(m) != numbers(message(m.number))]
    assert changed == [n for n in range(20, 60) if n % 3 == 0]
    assert math.isnan(sent('nan')[21].angular_velocity.x)


def test_an_unknown_fault_is_named():
    with pytest.raises(ValueError, match='no_such'):
        Injector('no_such', 0, 1)


def test_the_campaign_is_large_and_every_case_states_its_result():
    all_cases = cases()
    assert len(all_cases) >= 60
    assert len({c.name for c in all_cases}) == len(all_cases)
    assert all(len(c.stated) > 10 for c in all_cases)


def test_the_table_counts_what_held():
    first, second = cases()[:2]
    text = table([Outcome(first, True, 'fine'), Outcome(second, False, 'a | b\nc')])
    assert '1 of 2 cases held' in text
    assert 'NO | a \\| b c |' in text


@pytest.mark.parametrize('case', short_cases(), ids=lambda c: c.name)
def test_fault(case, tmp_path):
    assert case.run(tmp_path)
