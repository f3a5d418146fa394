# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from kalman_core.health import Tally


def test_accepted_samples_are_counted_by_sensor_with_their_last_stamp():
    tally = Tally()
    tally.accept('gyro', 10)
    tally.accept('gyro', 20)
    tally.accept('mag', 15)
    assert (tally.sensor('gyro').accepted, tally.sensor('gyro').last_stamp) == (2, 20)
    assert tally.sensor('mag').accepted == 1
    assert tally.sensor('gyro').nis is None
    assert tally.sensor('gyro').gate is None


def test_a_sensor_never_heard_of_has_empty_counts():
    fresh = Tally().sensor('gps')
    assert (fresh.accepted, fresh.rejected, fresh.nis, fresh.last_stamp) == (0, {}, None, None)


def test_rejected_samples_are_counted_by_reason():
    tally = Tally()
    for reason in ('gate', 'gate', 'not finite'):
        tally.reject('mag', reason)
    assert tally.sensor('mag').rejected == {'gate': 2, 'not finite': 1}
    assert tally.sensor('mag').accepted == 0


def test_a_withdrawn_rejection_leaves_no_trace():
    tally = Tally()
    for _ in range(3):
        tally.reject('mag', 'gate')
    tally.withdraw('mag', 'gate')
    assert dict(tally.sensor('mag').rejected) == {'gate': 2}
    tally.withdraw('mag', 'gate')
    tally.withdraw('mag', 'gate')
    assert dict(tally.sensor('mag').rejected) == {}
    tally.withdraw('mag', 'gate')  # a reset in between may have cleared the counts
    assert dict(tally.sensor('mag').rejected) == {}


def test_the_reported_nis_is_a_mean_over_about_fifty_updates():
    tally = Tally()
    tally.accept('mag', 1, nis=8.0, gate=13.8)
    assert tally.sensor('mag').nis == 8.0
    tally.accept('mag', 2, nis=3.0, gate=16.3)
    assert tally.sensor('mag').nis == pytest.approx(8.0 - 0.02 * 5.0)
    assert tally.sensor('mag').gate == 16.3
    tally.accept('mag', 3)
    assert tally.sensor('mag').nis == pytest.approx(7.9)
    for stamp in range(500):
        tally.accept('mag', stamp, nis=2.0, gate=13.8)
    assert tally.sensor('mag').nis == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_a_nis_that_is_not_finite_does_not_spoil_the_mean_for_ever(bad):
    tally = Tally()
    tally.accept('mag', 1, nis=bad, gate=1.0)
    tally.accept('mag', 2, nis=2.0, gate=1.0)
    tally.accept('mag', 3, nis=bad, gate=1.0)
    assert tally.sensor('mag').nis == 2.0
    assert tally.sensor('mag').accepted == 3


def test_while_muted_nothing_is_counted():
    tally = Tally()
    tally.muted = True
    tally.accept('gyro', 1, nis=1.0, gate=1.0)
    tally.reject('gyro', 'gate')
    assert tally.sensor('gyro').accepted == 0
    assert not tally.sensor('gyro').rejected
    tally.muted = False
    tally.accept('gyro', 2)
    assert tally.sensor('gyro').accepted == 1


def test_restarts_are_kept_in_order_and_bounded():
    tally = Tally()
    tally.restart('time jumped back by 3.000 s')
    tally.restart('diverged')
    assert tally.restarts == ['time jumped back by 3.000 s', 'diverged']
    for i in range(2000):
        tally.restart(str(i))
    assert tally.restart_count == 2002
    assert len(tally.restarts) == 1000
    assert tally.restarts[-1] == '1999'
    assert tally.restarts[0] == 'time jumped back by 3.000 s'
