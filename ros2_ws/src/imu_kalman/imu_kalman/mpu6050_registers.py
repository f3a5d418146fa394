# SPDX-License-Identifier: Apache-2.0
"""Registers, bits and constants of the MPU-6050 that the driver and its fake share.

Source: InvenSense, "MPU-6000 and MPU-6050 Register Map and Descriptions", revision 4.2 (2013), and
"Product Specification", revision 3.4, for what is marked PS.
"""

from __future__ import annotations

import math

SMPLRT_DIV = 0x19
CONFIG = 0x1A
GYRO_CONFIG = 0x1B
ACCEL_CONFIG = 0x1C
FIFO_EN = 0x23
INT_PIN_CFG = 0x37
INT_ENABLE = 0x38
INT_STATUS = 0x3A
ACCEL_XOUT_H = 0x3B
TEMP_OUT_H = 0x41
GYRO_XOUT_H = 0x43
SIGNAL_PATH_RESET = 0x68
USER_CTRL = 0x6A
PWR_MGMT_1 = 0x6B
PWR_MGMT_2 = 0x6C
FIFO_COUNT_H = 0x72
FIFO_R_W = 0x74
WHO_AM_I = 0x75

# WHO_AM_I holds the upper six bits of the address with AD0 low, whatever AD0 is.
IDENTITY = 0x68
DEFAULT_ADDRESS = 0x68

INT_FIFO_OVERFLOW = 0x10
INT_DATA_READY = 0x01
USER_FIFO_EN = 0x40
USER_FIFO_RESET = 0x04
USER_SIG_COND_RESET = 0x01
PWR_DEVICE_RESET = 0x80
PWR_SLEEP = 0x40
# The gyro's own oscillator: steadier than the RC oscillator that is the default.
PWR_CLOCK_GYRO_X = 0x01
FIFO_TEMP = 0x80
FIFO_GYRO = 0x70
FIFO_ACCEL = 0x08

FIFO_SIZE = 1024  # bytes (PS 7.17)
FRAME_SIZE = 14  # bytes: accelerometer, temperature, gyro, each axis two bytes, high byte first

# Gyro bandwidth (Hz) by DLPF_CFG, with the filter's delay (s) and the internal rate (Hz).
BANDWIDTHS = (256, 188, 98, 42, 20, 10, 5)
GYRO_DELAYS = (0.98e-3, 1.9e-3, 2.8e-3, 4.8e-3, 8.3e-3, 13.4e-3, 18.6e-3)
ACCEL_BANDWIDTHS = (260, 184, 94, 44, 21, 10, 5)
INTERNAL_RATES = (8000.0, 1000.0, 1000.0, 1000.0, 1000.0, 1000.0, 1000.0)

# Full scale by FS_SEL and AFS_SEL: °/s and g for 32768 counts.
GYRO_RANGES = (250, 500, 1000, 2000)
ACCEL_RANGES = (2, 4, 8, 16)
GYRO_COUNTS = (131.0, 65.5, 32.8, 16.4)  # per °/s
ACCEL_COUNTS = (16384.0, 8192.0, 4096.0, 2048.0)  # per g

STANDARD_GRAVITY = 9.80665  # m/s^2
DEGREE = math.pi / 180.0

TEMPERATURE_COUNTS = 340.0  # per °C
TEMPERATURE_OFFSET = 36.53  # °C at 0 counts

GYRO_START_UP = 0.03  # s until the gyro settles after sleep (PS 6.1)
# A first-order low-pass of bandwidth b passes white noise as an ideal one of (π/2)·b does.
NOISE_BANDWIDTH = 0.5 * math.pi
