# SPDX-License-Identifier: Apache-2.0
import errno
import sys
import types

import pytest

from imu_kalman.fake_bus import FakeBus, ManualClock
from imu_kalman.i2c import I2cDevice, Link, LinuxI2cBus, explain, is_bus_path

SECOND = 1_000_000_000


class Memory:
    """A chip of 256 plain registers that remembers what was asked of it."""

    def __init__(self):
        self.registers = bytearray(range(256))
        self.asked = []

    def read(self, register, count, now):
        self.asked.append((register, count))
        return bytes(self.registers[register : register + count])

    def write(self, register, data, now):
        self.registers[register : register + len(data)] = data


@pytest.fixture
def clock():
    return ManualClock()


@pytest.fixture
def bus(clock):
    return FakeBus({0x1E: Memory()}, clock, spend=clock.advance)


def test_a_disturbed_transfer_is_repeated(bus):
    device = I2cDevice(bus, 0x1E)
    bus.fail_next(2)
    assert device.read(5, 3) == bytes([5, 6, 7])
    bus.fail_next(1)
    device.write(9, 1, 2)
    assert device.read(9, 2) == bytes([1, 2])
    assert device.retried == 3


def test_a_lasting_failure_is_raised_with_its_code(bus):
    bus.fail_next(3, errno.EIO)
    with pytest.raises(OSError) as caught:
        I2cDevice(bus, 0x1E).read(0)
    assert caught.value.errno == errno.EIO


def test_a_read_with_side_effects_is_not_repeated(bus):
    bus.fail_next(1)
    with pytest.raises(OSError):
        I2cDevice(bus, 0x1E).read_once(0)
    assert bus.transfers == 1


def test_a_short_answer_is_an_error(bus):
    bus.shorten_next(1)
    with pytest.raises(OSError, match='short read: 3 of 4'):
        I2cDevice(bus, 0x1E).read_once(0, 4)
    bus.shorten_next(1)
    assert len(I2cDevice(bus, 0x1E).read(0, 4)) == 4


def test_chips_answer_only_at_their_address(bus):
    with pytest.raises(OSError) as caught:
        I2cDevice(bus, 0x1D).read(0)
    assert 'no acknowledge' in explain(caught.value)


def test_a_stuck_bus_times_out_and_a_closed_one_is_an_error(bus):
    bus.stuck = True
    with pytest.raises(OSError) as caught:
        I2cDevice(bus, 0x1E).read(0)
    assert 'held low' in explain(caught.value)
    bus.stuck = False
    bus.close()
    with pytest.raises(OSError, match='closed'):
        I2cDevice(bus, 0x1E).read(0)


def test_transfers_take_their_time_on_the_wire(bus, clock):
    before = clock()
    I2cDevice(bus, 0x1E).read(0, 14)
    # Address, register, address again and 14 bytes, nine bits each, plus start and stop.
    assert (clock() - before) * 1e-9 == pytest.approx(9 * 18 / 400e3)


def test_the_pause_after_faults_doubles_up_to_its_limit_and_starts_anew_after_success(bus):
    link = Link(bus.open, 0x1E, first_delay=0.1, longest_delay=1.0)
    now, pauses = 0, []
    for _ in range(6):
        assert link.device(now) is not None
        link.failed(now, 'broken')
        start = now
        while link.device(now) is None:
            now += SECOND // 100
        pauses.append((now - start) / SECOND)
    assert pauses == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.0, 1.0])
    assert link.faults == {'broken': 6}
    link.works()
    link.failed(now, 'again')
    assert link.device(now + SECOND // 10 - 1) is None
    assert link.device(now + SECOND // 10) is not None
    assert link.reconnects == 1


def test_a_bus_that_cannot_be_opened_is_reported_by_the_driver_not_swallowed():
    def missing():
        raise FileNotFoundError(errno.ENOENT, 'No such file or directory', '/dev/i2c-7')

    link = Link(missing, 0x1E)
    with pytest.raises(FileNotFoundError) as caught:
        link.device(0)
    assert 'switched on' in explain(caught.value)


def test_retries_are_counted_over_reconnections(bus):
    link = Link(bus.open, 0x1E)
    bus.fail_next(1)
    link.device(0).read(0)
    link.failed(0, 'x')
    bus.fail_next(2)
    link.device(SECOND).read(0)
    assert link.retried == 3


@pytest.mark.parametrize(('path', 'good'), [('/dev/i2c-1', True), ('/dev/i2c-', False), ('1', False)])
def test_bus_paths(path, good):
    assert is_bus_path(path) is good


def test_explain_never_is_empty():
    assert explain(OSError(errno.EBUSY, 'Device or resource busy')) == 'Device or resource busy'
    assert explain(OSError()) == 'OSError'


def test_the_linux_back_end_makes_one_combined_transfer(monkeypatch):
    calls = []

    class Message(list):
        @classmethod
        def read(cls, address, count):
            return cls([('r', address, count)])

        @classmethod
        def write(cls, address, data):
            return cls([('w', address, tuple(data))])

    class Bus:
        def __init__(self, path):
            calls.append(('open', path))

        def i2c_rdwr(self, *messages):
            calls.append([m[0] for m in messages])
            for message in messages:
                if message[0][0] == 'r':
                    message[:] = range(message[0][2])

        def close(self):
            calls.append('close')

    module = types.SimpleNamespace(SMBus=Bus, i2c_msg=Message)
    monkeypatch.setitem(sys.modules, 'smbus2', module)
    linux = LinuxI2cBus('/dev/i2c-3')
    assert linux.read(0x68, 0x3B, 4) == bytes([0, 1, 2, 3])
    linux.write(0x68, 0x6B, b'\x80\x01')
    linux.close()
    assert calls == [
        ('open', '/dev/i2c-3'),
        [('w', 0x68, (0x3B,)), ('r', 0x68, 4)],
        [('w', 0x68, (0x6B, 0x80, 0x01))],
        'close',
    ]


def test_the_linux_back_end_says_when_the_bus_is_missing():
    pytest.importorskip('smbus2')
    with pytest.raises(OSError) as caught:
        LinuxI2cBus('/dev/i2c-250')
    assert explain(caught.value) == 'no such bus /dev/i2c-250: is I2C switched on?'
