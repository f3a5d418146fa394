# SPDX-License-Identifier: Apache-2.0
import errno
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_kalman.fake_bus import FakeBus, ManualClock
from imu_kalman.i2c import WrongChipError
from kalman_core.parameters import ParameterError, build
from ship_inclinometer.fake_hmc5883l import FakeHmc5883l
from ship_inclinometer.hmc5883l import Hmc5883lDriver, SelfTestError
from ship_inclinometer.hmc5883l_params import GAINS, RANGES, Hmc5883lParams

SECOND = 1_000_000_000
FIELD = np.array([20e-6, -5e-6, 40e-6])


class Rig:
    """A driver on a fake chip, in time that passes only here."""

    def __init__(self, field=None, chip=None, **params):
        self.clock = ManualClock()
        self.chip = FakeHmc5883l(field or (lambda t: FIELD), start=self.clock(), **(chip or {}))
        self.bus = FakeBus({0x1E: self.chip}, self.clock, spend=self.clock.advance)
        self.params = build(Hmc5883lParams, params)
        self.driver = Hmc5883lDriver(self.params, self.bus.open, self.clock)

    def run(self, seconds):
        readings = []
        due, end = self.clock(), self.clock() + seconds * SECOND
        while due < end:
            due += SECOND * self.driver.poll_period
            self.clock.advance(max(0, due - self.clock()))
            readings += self.driver.poll()
        return readings


def fields(readings):
    return np.array([r.field for r in readings])


# ---- the fake chip, by the register map ----


@pytest.fixture
def chip():
    return FakeHmc5883l(lambda t: FIELD, noise=0.0)


def test_registers_after_power_up(chip):
    assert chip.read(0, 3, 0) == bytes([0x10, 0x20, 0x01])
    assert chip.read(10, 3, 0) == b'H43'
    assert chip.read(9, 1, 0)[0] & 1 == 0


def test_the_pointer_goes_round_the_data_and_back_to_the_start(chip):
    chip.write(2, b'\x01', 0)
    data = chip.read(3, 12, 20_000_000)
    assert data[:6] == data[6:]
    assert chip.read(12, 2, 20_000_000) == b'3\x10'


@pytest.mark.parametrize('gain', range(8))
def test_counts_follow_the_gain_from_the_second_measurement(chip, gain):
    chip.write(1, bytes([gain << 5]), 0)
    readings = []
    for i in range(2):
        chip.write(2, b'\x01', i * SECOND)
        readings.append(np.frombuffer(chip.read(3, 6, i * SECOND + 10_000_000), '>i2'))
    gauss = FIELD[[0, 2, 1]] * 1e4
    np.testing.assert_array_equal(readings[0], np.rint(gauss * GAINS[1]))
    np.testing.assert_array_equal(readings[1], np.rint(gauss * GAINS[gain]))


def test_a_single_measurement_takes_its_time_and_ends_idle(chip):
    chip.write(2, b'\x01', 0)
    assert chip.read(9, 1, 5_000_000)[0] & 1 == 0
    assert chip.read(9, 1, 6_000_000)[0] & 1 == 1
    assert chip.read(2, 1, 7_000_000)[0] & 2


def test_a_partial_read_locks_the_data_until_the_rest_is_read():
    chip = FakeHmc5883l(lambda t: np.array([t, t, t]) * 1e-5, noise=0.0)
    chip.write(0, b'\x18\x20\x00', 0)  # 75 Hz, continuous
    chip.read(3, 2, SECOND)
    assert chip.read(9, 1, SECOND)[0] & 2
    before = bytes(chip.registers[3:9])
    chip.read(9, 1, 2 * SECOND)
    assert bytes(chip.registers[3:9]) == before
    chip.read(5, 4, 2 * SECOND)
    assert chip.read(9, 1, 3 * SECOND)[0] & 2 == 0
    assert bytes(chip.registers[3:9]) != before


def test_reading_the_mode_locks_the_data():
    chip = FakeHmc5883l(lambda t: FIELD)
    chip.read(2, 1, 0)
    assert chip.read(9, 1, 0)[0] & 2


def test_too_much_field_reads_as_overflow():
    chip = FakeHmc5883l(lambda t: np.array([300e-6, 0.0, 0.0]), noise=0.0)
    chip.write(2, b'\x01', 0)
    assert np.frombuffer(chip.read(3, 6, SECOND), '>i2')[0] == -4096


# ---- the driver ----


def test_readings_are_the_field_in_tesla_at_the_rate():
    rig = Rig()
    readings = rig.run(5.0)
    assert len(readings) == pytest.approx(375, abs=6)
    np.testing.assert_allclose(fields(readings).mean(axis=0), FIELD, atol=5e-8)
    assert fields(readings).var(axis=0).mean() == pytest.approx(rig.driver.variance, rel=0.15)


def test_averaging_lowers_the_noise_as_stated():
    rig = Rig(averages=8)
    readings = rig.run(5.0)
    assert fields(readings).var(axis=0).mean() == pytest.approx(rig.driver.variance, rel=0.2)
    assert rig.driver.variance < Rig().driver.variance


def test_stamps_are_the_middle_of_the_measurement():
    rig = Rig()
    readings = rig.run(3.0)
    stamps = np.array([r.stamp for r in readings])
    made = np.array(rig.chip.measured_at)
    assert np.abs(stamps[:, None] - made).min(axis=1).max() < 500_000
    assert (np.diff(stamps) > 0).all()


def test_mounting_turns_chip_axes_into_body_axes():
    readings = Rig(mounting=(math.pi, 0.0, 0.0)).run(1.0)
    np.testing.assert_allclose(fields(readings).mean(axis=0), FIELD * [1, -1, -1], atol=5e-8)


def test_the_self_test_passes_a_good_chip_and_says_what_it_read():
    rig = Rig()
    rig.run(1.0)
    x, y, z = rig.driver.diagnostics()['self_test_counts']
    # Datasheet: about 452, 452 and 421 counts at gain 5.
    assert x == pytest.approx(452, abs=5)
    assert y == pytest.approx(452, abs=5)
    assert z == pytest.approx(421, abs=5)


@pytest.mark.parametrize('coil', [0.0, 0.4, 1.4, -1.0])
def test_the_self_test_refuses_a_broken_chip(coil):
    with pytest.raises(SelfTestError, match='expected 243 to 575'):
        Rig(chip={'coil': coil}).run(1.0)


def test_the_self_test_can_be_left_out():
    rig = Rig(chip={'coil': 0.0}, self_test=False)
    assert len(rig.run(1.0)) > 60


def test_a_wrong_chip_is_named():
    with pytest.raises(WrongChipError, match='51 4d 43, expected 48 34 33'):
        Rig(chip={'identity': b'QMC'}).run(1.0)


def test_overflow_is_not_published_and_the_range_grows():
    strong = lambda t: FIELD if t < 1.0 else np.array([350e-6, 0.0, 0.0])  # noqa: E731
    rig = Rig(field=strong)
    readings = rig.run(3.0)
    late = fields(readings)[-60:]
    np.testing.assert_allclose(late.mean(axis=0), [350e-6, 0.0, 0.0], atol=3e-7)
    values = fields(readings)
    near = np.abs(values[:, None] - np.array([FIELD, [350e-6, 0.0, 0.0]])).max(axis=2).min(axis=1)
    assert near.max() < 2e-6
    assert rig.driver.overflows == 3
    assert rig.driver.diagnostics()['range_gauss'] == 4.0


def test_a_field_beyond_every_range_is_reported_not_published():
    rig = Rig(field=lambda t: np.array([2e-3, 0.0, 0.0]))
    assert rig.run(3.0) == []
    assert rig.driver.overflows > 100
    said = rig.driver.diagnostics()
    assert said['level'] == 2
    assert 'over 8.1 gauss' in said['message']


@pytest.mark.parametrize('rate', [1.0, 2.0, 10.0, 50.0, 75.0, 76.0, 80.0, 100.0])
def test_it_measures_at_the_rate_and_tells_at_once(rate):
    rig = Rig(rate=rate)
    rig.run(1.0)
    ages, count, start = [], 0, rig.clock()
    while rig.clock() - start < 20 * SECOND:
        ages += [(rig.clock() - r.stamp) * 1e-9 for r in rig.run(rig.driver.poll_period)]
        count += 1
    assert len(ages) / 20.0 == pytest.approx(rate, rel=0.03, abs=0.06)
    assert len(rig.chip.measured_at) == 1000 or len(rig.chip.measured_at) < 21.0 * rate + 5
    # Half a measurement, the wait for its end, one poll and the transfers.
    assert max(ages) < 0.012
    assert rig.driver.diagnostics()['level'] == 0


def test_an_overflow_is_told_with_the_new_range_and_then_forgotten():
    rig = Rig(field=lambda t: FIELD if t < 2.5 else np.array([350e-6, 0.0, 0.0]), rate=1.0)
    rig.run(2.4)
    assert rig.driver.diagnostics()['level'] == 0
    # A range takes two measurements, for which the next second is not waited.
    assert len(rig.run(3.0)) >= 2
    assert (rig.driver.diagnostics()['level'], rig.driver.overflows) == (1, 3)
    rig.run(2.0)
    assert rig.driver.diagnostics()['level'] == 0


def test_a_field_that_comes_back_into_range_is_published_again():
    rig = Rig(field=lambda t: np.array([2e-3, 0.0, 0.0]) if 1.0 < t < 3.0 else FIELD)
    rig.run(2.5)
    assert rig.driver.diagnostics()['level'] == 2
    readings = rig.run(3.0)
    np.testing.assert_allclose(fields(readings).mean(axis=0), FIELD, atol=3e-7)
    # Once more, for what has happened since; then all is well.
    assert [rig.driver.diagnostics()['level'] for _ in range(2)] == [1, 0]


def test_counts_that_no_converter_makes_are_a_fault():
    rig = Rig()
    rig.run(1.0)
    honest, rig.chip._measure = rig.chip._measure, lambda done: None

    def impossible(done):
        honest(done)
        rig.chip.registers[3:5] = (3000).to_bytes(2, 'big')

    rig.chip._measure = impossible
    assert rig.run(1.0) == []
    assert any('more than the converter has' in reason for reason in rig.driver.link.faults)
    rig.chip._measure = honest
    assert len(rig.run(3.0)) > 50


def test_a_measurement_that_never_becomes_ready_is_a_fault_and_told():
    rig = Rig()
    rig.run(1.0)
    honest, rig.chip._measure = rig.chip._measure, lambda done: None
    rig.chip.registers[9] &= ~1
    rig.run(1.5)
    assert any('becomes ready' in reason for reason in rig.driver.link.faults)
    assert rig.driver.diagnostics()['level'] >= 1
    rig.chip._measure = honest
    assert len(rig.run(5.0)) > 100


def test_a_stuck_bus_is_waited_for():
    rig = Rig()
    rig.run(1.0)
    rig.bus.stuck = True
    transfers = rig.bus.transfers
    assert rig.run(30.0) == []
    assert rig.bus.transfers - transfers < 100
    assert rig.driver.diagnostics()['level'] == 2
    assert 'held low' in rig.driver.diagnostics()['message']
    rig.bus.stuck = False
    assert len(rig.run(7.0)) > 100
    assert rig.driver.diagnostics()['reconnects'] == 1


def test_a_power_dip_is_noticed():
    rig = Rig(range=4.0)
    rig.run(1.5)
    rig.chip.brown_out()
    readings = rig.run(4.0)
    np.testing.assert_allclose(fields(readings)[-100:].mean(axis=0), FIELD, atol=1e-7)
    assert any('power dip' in reason for reason in rig.driver.link.faults)


def test_a_frozen_chip_is_set_up_again():
    rig = Rig()
    rig.run(1.0)
    rig.chip.frozen = True
    rig.run(2.0)
    assert any('frozen' in reason for reason in rig.driver.link.faults)
    rig.chip.frozen = False
    assert len(rig.run(3.0)) > 100


def test_a_floating_bus_is_no_wrong_chip():
    rig = Rig()
    rig.bus.floating = True
    assert rig.run(2.0) == []
    rig.bus.floating = False
    assert len(rig.run(6.0)) > 100


@settings(max_examples=25, deadline=None)
@given(
    faults=st.lists(
        st.tuples(
            st.sampled_from(['stuck', 'absent', 'floating', 'fail', 'short', 'brown-out', 'noise', 'pause']),
            st.floats(0.01, 1.0),
        ),
        min_size=1,
        max_size=5,
    )
)
def test_whatever_happens_readings_are_true_and_come_back(faults):
    rig = Rig(longest_delay=0.5)
    readings = rig.run(0.5)
    for fault, seconds in faults:
        if fault == 'stuck':
            rig.bus.stuck = True
        elif fault == 'absent':
            rig.bus.absent.add(0x1E)
        elif fault == 'floating':
            rig.bus.floating = True
        elif fault == 'fail':
            rig.bus.fail_next(5, errno.EIO)
        elif fault == 'short':
            rig.bus.shorten_next(4)
        elif fault == 'brown-out':
            rig.chip.brown_out()
        elif fault == 'noise':
            rig.bus.error_rate = 0.3
        elif fault == 'pause':
            rig.clock.advance(seconds * SECOND)
        readings += rig.run(seconds)
        rig.bus.clear_faults()
    recovered = rig.run(3.0)
    assert len(recovered) > 50
    assert np.abs(fields(readings + recovered) - FIELD).max() < 2e-6
    assert (np.diff([r.stamp for r in readings + recovered]) > 0).all()


@pytest.mark.parametrize(
    ('values', 'named'),
    [
        ({'range': 1.0}, 'range'),
        ({'averages': 3}, 'averages'),
        ({'bus': 'usb'}, 'bus'),
        ({'rate': 500.0}, 'rate'),
        ({'first_delay': 6.0}, 'longest_delay'),
    ],
)
def test_bad_parameters_are_named(values, named):
    with pytest.raises(ParameterError, match=named):
        build(Hmc5883lParams, values)


def test_every_range_can_be_chosen():
    for gauss in RANGES:
        assert build(Hmc5883lParams, {'range': gauss}).range == gauss
