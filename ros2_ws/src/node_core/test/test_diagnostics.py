# SPDX-License-Identifier: Apache-2.0
"""What the reporter says of an input whose counts go up and down."""

import time

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from kalman_core.health import Tally
from node_core.diagnostics import InputState, Reporter
from node_core.ports import Input


def reporter(state=None):
    tally = Tally()
    state = state or InputState(Input('imu', 'sensor_msgs/msg/Imu', lambda message: message, 'take'))
    return tally, Reporter('filter', {'imu': state}, tally)


def said(reporter):
    own, imu = reporter.report({}).status
    return own, imu, {pair.key: pair.value for pair in imu.values}


def test_a_report_names_the_worst_reason_since_the_last_one():
    tally, r = reporter()
    for _ in range(5):
        tally.reject('imu', 'not finite')
    assert said(r)[1].message == '5 rejected, mostly: not finite'
    tally.reject('imu', 'late')
    _, imu, values = said(r)
    assert (imu.level, imu.message) == (DiagnosticStatus.WARN, '1 rejected, mostly: late')
    assert values['rejected'] == '6'
    assert said(r)[1].level == DiagnosticStatus.OK


def test_a_rejection_taken_back_after_its_report_is_no_news():
    tally, r = reporter()
    tally.reject('imu', 'late')
    assert said(r)[1].level == DiagnosticStatus.WARN
    tally.withdraw('imu', 'late')
    _, imu, values = said(r)
    assert (imu.level, values['rejected']) == (DiagnosticStatus.OK, '0')
    tally.reject('imu', 'late')
    assert said(r)[1].message == '1 rejected, mostly: late'


def test_restarts_are_counted_beyond_those_that_are_kept():
    tally, r = reporter()
    for number in range(1500):
        tally.restart(f'number {number}')
    own = {pair.key: pair.value for pair in said(r)[0].values}
    assert (own['restarts'], own['last_restart']) == ('1500', 'number 1499')


@pytest.mark.parametrize(
    ('arrivals', 'level', 'message'),
    [
        ([3] * 20, DiagnosticStatus.WARN, 'absent: no message for 60.0 s'),  # a stream
        ([1, 0, 2, 0, 1] * 5, DiagnosticStatus.OK, 'ok'),  # news now and then
        ([1], DiagnosticStatus.OK, 'ok'),  # told once
        ([], DiagnosticStatus.OK, 'ok'),  # never there
    ],
)
def test_only_an_optional_stream_that_has_ended_is_called_absent(arrivals, level, message):
    state = InputState(Input('imu', 'sensor_msgs/msg/Imu', lambda message: message, 'take'))
    _, r = reporter(state)
    for new in arrivals:
        state.count += new
        state.arrived = time.monotonic_ns()
        assert said(r)[1].level == DiagnosticStatus.OK
    state.arrived -= 60 * 10**9
    _, imu, _ = said(r)
    assert (imu.level, imu.message) == (level, message)
    state.count += 1
    state.arrived = time.monotonic_ns()
    assert said(r)[1].level == DiagnosticStatus.OK
