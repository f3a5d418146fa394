# SPDX-License-Identifier: Apache-2.0
import pynmeagps
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ship_inclinometer.alarms import RULES
from ship_inclinometer.alerts import AlertReporter, Command
from ship_inclinometer.nmea import sentence

NOW = 1_767_225_600_120_000_000
SECOND = 10**9
NAMES = [rule.name for rule in RULES]


def alarms(*standing, unacknowledged=(), sounding=True):
    out = {name: float(name in standing) for name in NAMES}
    out |= {f'{name}_unacknowledged': float(name in unacknowledged) for name in NAMES}
    return out | {'sounding': float(sounding)}


def parsed(lines, kind):
    messages = [pynmeagps.NMEAReader.parse(line.encode(), validate=pynmeagps.VALCKSUM) for line in lines]
    return [m for m in messages if m.msgID == kind]


def acn(identifier=10001, instance='1', command='A', manufacturer='ABC', flag='C'):
    return sentence('CA', 'ACN', '000010.00', manufacturer, str(identifier), instance, command, flag)


def test_an_alert_goes_through_its_states_with_rising_revisions():
    reporter, told = AlertReporter('II', 'ABC'), []
    name = 'heel_warning'
    scenes = (
        alarms(name, unacknowledged=[name]),
        alarms(name, unacknowledged=[name], sounding=False),
        alarms(name),
        alarms(),
        alarms(name, unacknowledged=[name]),
        alarms(unacknowledged=[name]),
    )
    for n, numbers in enumerate(scenes):
        told += parsed(reporter.sentences(NOW + n * SECOND, numbers), 'ALF')
    assert [m.alertstate for m in told] == ['V', 'S', 'A', 'N', 'V', 'U']
    assert [m.revisionctr for m in told] == ['1', '2', '3', '4', '1', '2']
    assert [m.alertinst for m in told] == ['1', '1', '1', '1', '2', '2']
    assert {(m.alertid, m.mfrcode, m.alertpriority, m.alertcat) for m in told} == {('10001', 'ABC', 'W', 'B')}
    assert str(told[0].timelastchange).startswith('00:00:00.12')


def test_the_list_holds_what_stands_and_is_repeated():
    reporter = AlertReporter('II', 'ABC')
    lists = parsed(reporter.sentences(NOW, alarms(*NAMES, unacknowledged=NAMES)), 'ALC')
    assert [m.numSen for m in lists] == [3, 3, 3]
    assert sum(m.numAlerts for m in lists) == len(NAMES)
    assert parsed(reporter.sentences(NOW + 29 * SECOND, alarms(*NAMES, unacknowledged=NAMES)), 'ALC') == []
    assert (
        len(parsed(reporter.sentences(NOW + 31 * SECOND, alarms(*NAMES, unacknowledged=NAMES)), 'ALC')) == 3
    )


def test_no_alert_is_an_empty_list_and_no_monitor_changes_nothing():
    reporter = AlertReporter('II', 'ABC')
    (only,) = parsed(reporter.sentences(NOW, alarms()), 'ALC')
    assert only.numAlerts == 0
    reporter.sentences(NOW + SECOND, alarms('heel_alarm', unacknowledged=['heel_alarm']))
    assert reporter.sentences(NOW + 2 * SECOND, {}) == []


def test_every_sentence_fits_82_characters():
    reporter = AlertReporter('II', 'ABC')
    for alert in reporter._alerts.values():
        alert.instance, alert.revision = 999998, 97
    lines = reporter.sentences(NOW, alarms(*NAMES, unacknowledged=NAMES))
    assert len(lines) == 9
    assert max(map(len, lines)) <= 82


def test_commands_are_carried_out_answered_or_refused():
    reporter = AlertReporter('II', 'ABC')
    reporter.sentences(NOW, alarms('heel_warning', unacknowledged=['heel_warning']))
    assert reporter.take(acn(), NOW) == (Command('acknowledge', 'heel_warning'), [])
    assert reporter.take(acn(instance=''), NOW)[0] == Command('acknowledge', 'heel_warning')
    assert reporter.take(acn(command='S'), NOW)[0] == Command('silence', 'heel_warning')
    assert parsed(reporter.take(acn(command='Q'), NOW)[1], 'ALF')[0].alertid == '10001'
    for refused in (acn(command='O'), acn(instance='7'), acn(identifier=10002), acn(command='X')):
        command, answers = reporter.take(refused, NOW)
        assert command is None
        assert len(parsed(answers, 'ARC')) == 1


@pytest.mark.parametrize(
    'line',
    [
        '', '$', '*', acn().replace('A,C', 'A,A'), acn(flag='A'), acn(manufacturer='XYZ'), acn(identifier=9),
        '$CAACN,1*00', acn()[:-6], sentence('CA', 'HBT', '60', 'A', '1'),
    ],
)  # fmt: skip
def test_what_is_no_command_for_us_is_passed_over(line):
    assert AlertReporter('II', 'ABC').take(line, NOW) == (None, [])


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=100))
def test_no_line_raises(line):
    assert AlertReporter('II', 'ABC').take(line, NOW) == (None, [])


def test_a_monitor_that_falls_silent_is_an_alert_and_ends_none():
    reporter = AlertReporter('II', 'ABC')
    reporter.sentences(NOW, alarms('heel_alarm', unacknowledged=['heel_alarm']))
    lines = reporter.sentences(NOW + SECOND, None)
    (lost,) = parsed(lines, 'ALF')
    assert (lost.alertid, lost.alertstate, lost.alertpriority) == ('10007', 'V', 'A')
    (listed,) = parsed(lines, 'ALC')
    assert listed.numAlerts == 2
    # Nobody is there to acknowledge the heel alarm; that the monitor is lost can be acknowledged.
    command, answers = reporter.take(acn(10002), NOW)
    assert command is None
    assert len(parsed(answers, 'ARC')) == 1
    assert reporter.take(acn(10007), NOW) == (None, [])
    assert len(parsed(reporter.take(acn(10007, command='S'), NOW)[1], 'ARC')) == 1
    (known,) = parsed(reporter.sentences(NOW + 2 * SECOND, None), 'ALF')
    assert known.alertstate == 'A'
    assert reporter.sentences(NOW + 3 * SECOND, None) == []
    back = parsed(reporter.sentences(NOW + 4 * SECOND, alarms()), 'ALF')
    assert [(m.alertid, m.alertstate) for m in back] == [('10002', 'N'), ('10007', 'N')]
    again = parsed(reporter.sentences(NOW + 5 * SECOND, None), 'ALF')
    assert [(m.alertid, m.alertstate) for m in again] == [('10007', 'V')]
