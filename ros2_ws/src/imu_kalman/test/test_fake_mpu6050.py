# SPDX-License-Identifier: Apache-2.0
"""The fake chip follows the register map."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from mpu6050_rig import DEG, FORCE, RATE, SECOND, G, constant

from imu_kalman import mpu6050_registers as reg
from imu_kalman.fake_bus import ManualClock
from imu_kalman.fake_mpu6050 import FakeMpu6050


@pytest.fixture
def chip():
    clock = ManualClock(0)
    return clock, FakeMpu6050(constant(), gyro_noise=0.0, accel_noise=0.0)


def test_after_power_up_the_chip_sleeps_and_says_what_it_is(chip):
    clock, mpu = chip
    assert mpu.read(reg.WHO_AM_I, 1, clock()) == b'\x68'
    assert mpu.read(reg.PWR_MGMT_1, 1, clock()) == b'\x40'
    clock.advance(SECOND)
    assert mpu.read(reg.ACCEL_XOUT_H, 14, clock()) == bytes(14)


def test_read_only_registers_keep_their_value(chip):
    clock, mpu = chip
    mpu.write(reg.WHO_AM_I, b'\x11', clock())
    mpu.write(reg.ACCEL_XOUT_H, b'\x11\x22', clock())
    assert mpu.read(reg.WHO_AM_I, 1, clock()) == b'\x68'
    assert mpu.read(reg.ACCEL_XOUT_H, 2, clock()) == b'\x00\x00'


@pytest.mark.parametrize('gyro_sel', range(4))
@pytest.mark.parametrize('accel_sel', range(4))
def test_ranges_scale_the_counts(chip, gyro_sel, accel_sel):
    clock, mpu = chip
    mpu.write(reg.PWR_MGMT_1, b'\x01', clock())
    mpu.write(reg.GYRO_CONFIG, bytes([gyro_sel << 3, accel_sel << 3]), clock())
    clock.advance(SECOND)
    counts = np.frombuffer(mpu.read(reg.ACCEL_XOUT_H, 14, clock()), '>i2')
    # Datasheet: full scale is 32768 counts.
    np.testing.assert_allclose(counts[:3], FORCE / G / (2 << accel_sel) * 32768, atol=0.51)
    np.testing.assert_allclose(counts[4:], RATE / DEG / (250 << gyro_sel) * 32768, rtol=1e-3, atol=0.51)
    assert counts[3] / 340.0 + 36.53 == pytest.approx(27.0, abs=0.002)


@pytest.mark.parametrize(
    ('dlpf', 'divider', 'rate'), [(0, 7, 1000.0), (1, 4, 200.0), (6, 99, 10.0), (7, 79, 100.0)]
)
def test_divider_and_filter_set_the_rate(chip, dlpf, divider, rate):
    clock, mpu = chip
    mpu.write(reg.SMPLRT_DIV, bytes([divider, dlpf]), clock())
    mpu.write(reg.PWR_MGMT_1, b'\x01', clock())
    clock.advance(10 * SECOND)
    mpu.read(reg.WHO_AM_I, 1, clock())
    assert mpu.samples == pytest.approx(10 * rate, abs=1)


def test_the_low_pass_delays_and_narrows():
    ramp = lambda t: SimpleNamespace(rate=np.outer(t, [1.0, 0.0, 0.0]), force=np.zeros((len(t), 3)))  # noqa: E731
    mpu = FakeMpu6050(ramp, gyro_noise=0.0, accel_noise=0.0)
    mpu.write(reg.CONFIG, b'\x06', 0)
    mpu.write(reg.PWR_MGMT_1, b'\x01', 0)
    counts = np.frombuffer(mpu.read(reg.GYRO_XOUT_H, 2, SECOND), '>i2')[0]
    assert counts / 131.0 * DEG == pytest.approx(1.0 - 18.6e-3, abs=1e-3)
    spread = []
    for dlpf in (1, 6):
        noisy = FakeMpu6050(constant((0, 0, 0), (0, 0, 0)), gyro_noise=0.1 * DEG)
        noisy.write(reg.CONFIG, bytes([dlpf]), 0)
        noisy.write(reg.PWR_MGMT_1, b'\x01', 0)
        values = [
            np.frombuffer(noisy.read(reg.GYRO_XOUT_H, 2, SECOND + i * 1_000_000), '>i2')[0]
            for i in range(500)
        ]
        spread.append(np.std(values) / 131.0)
    assert spread[0] == pytest.approx(0.1 * math.sqrt(0.5 * math.pi * 188), rel=0.15)
    assert spread[1] == pytest.approx(0.1 * math.sqrt(0.5 * math.pi * 5), rel=0.15)


def running_fifo(selected=0xF8):
    mpu = FakeMpu6050(constant(), gyro_noise=0.0, accel_noise=0.0)
    mpu.write(reg.SMPLRT_DIV, b'\x09\x01', 0)
    mpu.write(reg.INT_ENABLE, b'\x11', 0)
    mpu.write(reg.PWR_MGMT_1, b'\x01', 0)
    mpu.write(reg.FIFO_EN, bytes([selected]), 0)
    mpu.write(reg.USER_CTRL, b'\x40', 0)
    return mpu


def test_the_fifo_holds_what_is_selected_in_the_order_of_the_registers():
    mpu = running_fifo()
    now = 100_000_000
    count = int.from_bytes(mpu.read(reg.FIFO_COUNT_H, 2, now), 'big')
    assert count == 10 * 14
    frames = mpu.read(reg.FIFO_R_W, count, now)
    assert frames[-14:] == mpu.read(reg.ACCEL_XOUT_H, 14, now)
    mpu = running_fifo(selected=0x48)  # X gyro and accelerometer
    assert int.from_bytes(mpu.read(reg.FIFO_COUNT_H, 2, now), 'big') == 10 * 8
    registers = mpu.read(reg.ACCEL_XOUT_H, 14, now)
    assert mpu.read(reg.FIFO_R_W, 80, now)[-8:] == registers[:6] + registers[8:10]


def test_the_low_count_byte_is_a_shadow_of_the_last_look():
    mpu = running_fifo()
    assert mpu.read(reg.FIFO_COUNT_H, 2, 100_000_000) == bytes([0, 140])
    assert mpu.read(reg.FIFO_COUNT_H + 1, 1, 200_000_000) == bytes([140])
    assert mpu.read(reg.FIFO_COUNT_H, 2, 200_000_000) == bytes([280 // 256, 280 % 256])


def test_an_overflowing_fifo_loses_the_oldest_bytes_and_says_so():
    mpu = running_fifo()
    assert mpu.read(reg.INT_STATUS, 1, 700_000_000)[0] & 0x10 == 0
    count = int.from_bytes(mpu.read(reg.FIFO_COUNT_H, 2, 800_000_000), 'big')
    assert count == 1024
    assert mpu.read(reg.INT_STATUS, 1, 800_000_000)[0] & 0x10
    assert mpu.read(reg.INT_STATUS, 1, 800_000_000)[0] & 0x10 == 0
    assert mpu.read(reg.FIFO_R_W, 1024, 800_000_000)[-14:] == mpu.read(reg.ACCEL_XOUT_H, 14, 800_000_000)


def test_an_empty_fifo_repeats_its_last_byte_and_a_reset_needs_it_off():
    mpu = running_fifo()
    now = 100_000_000
    last = mpu.read(reg.FIFO_R_W, 140, now)[-1]
    assert mpu.read(reg.FIFO_R_W, 3, now) == bytes([last] * 3)
    now = 200_000_000
    mpu.write(reg.USER_CTRL, bytes([0x44]), now)
    assert int.from_bytes(mpu.read(reg.FIFO_COUNT_H, 2, now), 'big') == 140
    mpu.write(reg.USER_CTRL, bytes([0x04]), now)
    assert int.from_bytes(mpu.read(reg.FIFO_COUNT_H, 2, now), 'big') == 0
    assert mpu.read(reg.USER_CTRL, 1, now) == b'\x00'


def test_data_ready_is_cleared_by_reading_and_set_by_the_next_sample():
    mpu = running_fifo(selected=0)
    now = 15_000_000
    assert mpu.read(reg.INT_STATUS, 1, now) == b'\x01'
    assert mpu.read(reg.INT_STATUS, 1, now) == b'\x00'
    assert mpu.read(reg.INT_STATUS, 1, now + 10_000_000) == b'\x01'


def test_a_reset_takes_a_moment_and_restores_the_defaults():
    mpu = running_fifo()
    mpu.write(reg.PWR_MGMT_1, b'\x80', SECOND)
    with pytest.raises(OSError):
        mpu.read(reg.WHO_AM_I, 1, SECOND + 1000)
    assert mpu.read(reg.PWR_MGMT_1, 1, 2 * SECOND) == b'\x40'
    assert mpu.read(reg.FIFO_EN, 1, 2 * SECOND) == b'\x00'


def test_standby_axes_and_the_starting_gyro_read_zero():
    mpu = FakeMpu6050(constant(), gyro_noise=0.0, accel_noise=0.0)
    mpu.write(reg.PWR_MGMT_1, b'\x01\x24', 0)  # PWR_MGMT_2: X accelerometer and X gyro
    assert mpu.read(reg.GYRO_XOUT_H, 6, 20_000_000) == bytes(6)
    counts = np.frombuffer(mpu.read(reg.ACCEL_XOUT_H, 14, SECOND), '>i2')
    assert counts[0] == 0
    assert counts[4] == 0
    assert (counts[[1, 2, 5, 6]] != 0).all()
