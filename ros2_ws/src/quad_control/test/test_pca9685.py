# SPDX-License-Identifier: Apache-2.0
import errno
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_kalman.fake_bus import FakeBus, ManualClock
from quad_control.fake_pca9685 import FakePca9685
from quad_control.pca9685 import Pca9685Driver, prescale_for

SECOND = 1_000_000_000
MILLISECOND = 1_000_000
# One count at 400 Hz (µs): the finest the chip can do.
COUNT = 15 / 25.0


class Rig:
    """A driver on a fake chip, in time that passes only here."""

    def __init__(self, chip=None, **params):
        self.clock = ManualClock()
        self.chip = FakePca9685(**(chip or {}))
        self.bus = FakeBus({0x40: self.chip}, self.clock, spend=self.clock.advance)
        values = {'watchdog': 0.05, 'pulse_idle': 1000.0, 'frequency': 400.0, 'address': 0x40,
                  'channels': (0.0, 1.0, 2.0, 3.0)}  # fmt: skip
        self.params = SimpleNamespace(**(values | params))
        self.driver = Pca9685Driver(self.params, self.bus.open, self.clock)

    def run(self, seconds, command=None):
        """Poll every 5 ms, commanding at each if asked to; return the pulses seen after each."""
        seen = []
        end = self.clock() + seconds * SECOND
        while self.clock() < end:
            self.clock.advance(5 * MILLISECOND)
            if command is not None:
                self.driver.command(command)
            self.driver.poll()
            seen.append(self.pulses())
        return seen

    def pulses(self):
        return [self.chip.pulse(int(c), self.clock()) for c in self.params.channels]


# ---- the fake chip, by the register map ----


def test_registers_after_power_up():
    chip = FakePca9685()
    assert chip.read(0, 1, 0) == b'\x11'
    assert chip.read(1, 1, 0) == b'\x04'
    assert chip.read(0xFE, 1, 0) == b'\x1e'
    assert chip.read(0x09, 1, 0) == b'\x10'
    assert chip.pulse(0, SECOND) is None


def test_the_prescaler_is_set_only_asleep():
    chip = FakePca9685()
    chip.write(0xFE, b'\x0e', 0)
    assert chip.read(0xFE, 1, 0) == b'\x0e'
    chip.write(0, b'\x20', 0)
    chip.write(0xFE, b'\x79', 0)
    assert chip.read(0xFE, 1, 0) == b'\x0e'


def test_without_auto_increment_a_burst_stays_on_one_register():
    chip = FakePca9685()
    chip.write(0x06, b'\x01\x02\x03', 0)
    assert chip.registers[6:9] == bytes([3, 0, 0])
    chip.write(0, b'\x31', 0)
    chip.write(0x06, b'\x01\x02\x03', 0)
    assert chip.registers[6:9] == bytes([1, 2, 3])


def test_reserved_registers_are_not_acknowledged():
    with pytest.raises(OSError):
        FakePca9685().read(0x80, 1, 0)


def test_pulse_width_is_off_minus_on_of_the_period():
    chip = FakePca9685()
    chip.write(0, b'\x31', 0)
    chip.write(0xFE, bytes([prescale_for(50.0)]), 0)
    chip.write(0, b'\x20', 0)
    chip.write(0x06, bytes([0, 0, 0x33, 0x01]), 0)
    assert chip.pulse(0, 100_000) is None
    period = 4096 * 122 / 25.0
    assert chip.pulse(0, SECOND) == pytest.approx(0x133 * period / 4096)


def test_sleeping_holds_the_pulses_until_restart():
    chip = FakePca9685()
    chip.write(0, b'\x20', 0)
    chip.write(0x06, bytes([0, 0, 0, 8]), 0)
    chip.write(0, b'\x30', SECOND)
    assert chip.read(0, 1, SECOND)[0] & 0x80
    assert chip.pulse(0, 2 * SECOND) is None
    chip.write(0, b'\x20', 3 * SECOND)
    assert chip.pulse(0, 4 * SECOND) is None
    chip.write(0, b'\xa0', 4 * SECOND)
    assert chip.pulse(0, 5 * SECOND) is not None


# ---- the driver ----


def test_motors_idle_before_the_first_command_and_nothing_else_ever_came_out():
    rig = Rig()
    seen = rig.run(0.1)
    values = {round(p, 1) for pulses in seen for p in pulses if p is not None}
    assert values == {round(round(1000.0 / COUNT) * COUNT, 1)}
    assert seen[-1][0] == pytest.approx(1000.0, abs=0.5 * COUNT)
    assert rig.chip.pulse(7, rig.clock()) is None
    assert rig.driver.diagnostics()['level'] == 1


@settings(max_examples=40, deadline=None)
@given(
    pulses=st.lists(st.floats(900.0, 2000.0), min_size=4, max_size=4),
    frequency=st.floats(50.0, 450.0),
    channels=st.permutations(range(16)).map(lambda p: tuple(float(c) for c in p[:4])),
)
def test_pulses_come_out_on_their_channels_within_half_a_count(pulses, frequency, channels):
    rig = Rig(frequency=frequency, channels=channels)
    rig.run(0.05)
    assert rig.driver.command(pulses)
    count = (prescale_for(frequency) + 1) / 25.0
    np.testing.assert_allclose(rig.pulses(), pulses, atol=0.5001 * count)
    others = set(range(16)) - {int(c) for c in channels}
    assert all(rig.chip.pulse(c, rig.clock()) is None for c in others)
    made = 25e6 / 4096 / (prescale_for(frequency) + 1)
    assert made == pytest.approx(frequency, rel=0.05)


def test_neighbouring_channels_are_written_in_one_transfer():
    rig = Rig()
    rig.run(0.05, [1200.0] * 4)
    before = rig.bus.transfers
    rig.driver.command([1300.0, 1400.0, 1500.0, 1600.0])
    assert rig.bus.transfers - before == 1


def test_without_commands_the_motors_idle_within_the_watchdog_time():
    rig = Rig()
    rig.run(0.5, [1500.0] * 4)
    stopped = rig.clock()
    rig.run(0.045)
    assert rig.pulses()[0] == pytest.approx(1500.0, abs=COUNT)
    rig.run(0.01)
    np.testing.assert_allclose(rig.pulses(), 1000.0, atol=COUNT)
    assert rig.clock() - stopped < 62 * MILLISECOND
    assert rig.driver.timeouts == 1
    assert 'idle' in rig.driver.diagnostics()['message']
    rig.run(0.05, [1600.0] * 4)
    np.testing.assert_allclose(rig.pulses(), 1600.0, atol=COUNT)


@pytest.mark.parametrize(
    'bad',
    [
        [math.nan] * 4,
        [1500.0, math.inf, 1500.0, 1500.0],
        [1500.0] * 3,
        [1500.0] * 5,
        [1500.0, 1500.0, 1500.0, 3000.0],
        [0.0] * 4,
        [],
    ],
)
def test_what_is_no_command_neither_moves_a_motor_nor_feeds_the_watchdog(bad):
    rig = Rig()
    rig.run(0.1, [1500.0] * 4)
    assert not rig.driver.command(bad)
    np.testing.assert_allclose(rig.pulses(), 1500.0, atol=COUNT)
    rig.run(0.07, bad)
    np.testing.assert_allclose(rig.pulses(), 1000.0, atol=COUNT)
    assert rig.driver.rejected > 10


def test_a_disturbed_transfer_does_not_interrupt_the_pulses():
    rig = Rig()
    rig.run(0.1, [1500.0] * 4)
    for failures in (1, 2, 3, 5):
        rig.bus.fail_next(failures, errno.EIO)
        for pulses in rig.run(0.3, [1500.0] * 4):
            np.testing.assert_allclose(pulses, 1500.0, atol=COUNT)
    rig.run(0.1, [1700.0] * 4)
    np.testing.assert_allclose(rig.pulses(), 1700.0, atol=COUNT)


def test_one_false_answer_about_the_settings_does_not_interrupt_the_pulses():
    rig = Rig()
    rig.run(0.1, [1500.0] * 4)
    original, lies = rig.chip.read, [1]

    def read(register, count, now):
        data = original(register, count, now)
        if register == 0 and lies:
            lies.pop()
            return bytes([0x11, *data[1:]])
        return data

    rig.chip.read = read
    for pulses in rig.run(0.3, [1500.0] * 4):
        np.testing.assert_allclose(pulses, 1500.0, atol=COUNT)
    assert not lies
    assert rig.driver.power_dips == 0


def test_a_command_on_a_dead_bus_is_refused_and_does_not_come_alive_later():
    rig = Rig()
    rig.run(0.1, [1500.0] * 4)
    rig.bus.stuck = True
    assert not rig.driver.command([1900.0] * 4)
    rig.run(1.0)
    assert rig.driver.diagnostics()['level'] == 2
    rig.bus.stuck = False
    seen = rig.run(0.5)
    # The chip repeats what it last got; once it can be reached again the motors stop.
    assert all(p is None or p < 1501.0 for pulses in seen for p in pulses)
    np.testing.assert_allclose(rig.pulses(), 1000.0, atol=COUNT)


def test_after_a_power_dip_pulses_are_back_soon():
    rig = Rig()
    rig.run(0.5, [1500.0] * 4)
    rig.chip.brown_out()
    assert rig.pulses() == [None] * 4
    rig.run(0.15, [1500.0] * 4)
    np.testing.assert_allclose(rig.pulses(), 1500.0, atol=COUNT)
    assert rig.driver.power_dips == 1


def test_a_chip_that_comes_later_is_set_up():
    rig = Rig()
    rig.bus.absent.add(0x40)
    rig.run(1.0)
    assert 'no acknowledge' in rig.driver.diagnostics()['message']
    rig.bus.absent.clear()
    rig.run(0.5, [1250.0] * 4)
    np.testing.assert_allclose(rig.pulses(), 1250.0, atol=COUNT)


def test_something_else_at_the_address_is_reported():
    class Stubborn(FakePca9685):
        def write(self, register, data, now):
            pass

    rig = Rig()
    rig.bus.devices[0x40] = Stubborn()
    rig.run(0.5, [1500.0] * 4)
    assert 'is this a PCA9685' in rig.driver.diagnostics()['message']
    assert not rig.driver.running


def test_closing_stops_all_pulses():
    rig = Rig()
    rig.run(0.1, [1500.0] * 4)
    rig.driver.close()
    assert rig.pulses() == [None] * 4


def test_closing_on_a_dead_bus_does_not_raise():
    rig = Rig()
    rig.run(0.1, [1500.0] * 4)
    rig.bus.stuck = True
    rig.driver.close()
    assert any('closing' in reason for reason in rig.driver.link.faults)


def test_half_a_channel_is_refused():
    with pytest.raises(ValueError, match='not whole numbers'):
        Rig(channels=(0.0, 1.5, 2.0, 3.0))


def test_one_channel_twice_is_refused():
    with pytest.raises(ValueError, match='not different'):
        Rig(channels=(0.0, 1.0, 1.0, 2.0))


@settings(max_examples=40, deadline=None)
@given(
    events=st.lists(
        st.tuples(
            st.sampled_from(
                [
                    'command',
                    'silence',
                    'nan',
                    'stuck',
                    'absent',
                    'fail',
                    'short',
                    'noise',
                    'brown-out',
                    'floating',
                ]
            ),
            st.floats(0.01, 0.3),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_whatever_happens_only_commanded_pulses_come_out_and_silence_ends_idle(events):
    rig = Rig()
    rig.run(0.05)
    allowed = {1000.0}
    for number, (event, seconds) in enumerate(events):
        command = None
        if event == 'command':
            allowed.add(1100.0 + number)
            command = [1100.0 + number] * 4
        elif event == 'nan':
            command = [math.nan] * 4
        elif event == 'stuck':
            rig.bus.stuck = True
        elif event == 'absent':
            rig.bus.absent.add(0x40)
        elif event == 'floating':
            rig.bus.floating = True
        elif event == 'fail':
            rig.bus.fail_next(4)
        elif event == 'short':
            rig.bus.shorten_next(3)
        elif event == 'noise':
            rig.bus.error_rate = 0.3
        elif event == 'brown-out':
            rig.chip.brown_out()
        for pulses in rig.run(seconds, command):
            for pulse in pulses:
                assert pulse is None or min(abs(pulse - a) for a in allowed) <= COUNT
        rig.bus.clear_faults()
    rig.run(0.6)
    np.testing.assert_allclose(rig.pulses(), 1000.0, atol=COUNT)
