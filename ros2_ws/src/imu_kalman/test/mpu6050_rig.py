# SPDX-License-Identifier: Apache-2.0
"""An MPU6050 driver on a fake chip, in time that passes only in the test."""

import math
from types import SimpleNamespace

import numpy as np

from imu_kalman.fake_bus import FakeBus, ManualClock
from imu_kalman.fake_mpu6050 import FakeMpu6050
from imu_kalman.mpu6050 import Mpu6050Driver
from imu_kalman.mpu6050_params import Mpu6050Params
from kalman_core.parameters import build

SECOND = 1_000_000_000
DEG = math.pi / 180.0
G = 9.80665
FORCE = np.array([1.0, -2.0, 9.0])
RATE = np.array([0.1, -0.2, 0.3])


def constant(rate=RATE, force=FORCE):
    def motion(times):
        n = len(times)
        return SimpleNamespace(rate=np.tile(rate, (n, 1)), force=np.tile(force, (n, 1)))

    return motion


def still(times):
    return constant((0.0, 0.0, 0.0), (0.0, 0.0, G))(times)


class Rig:
    """A driver on a fake chip, in time that passes only here."""

    def __init__(self, motion=None, chip=None, **params):
        self.clock = ManualClock()
        self.chip = FakeMpu6050(motion or constant(), start=self.clock(), **(chip or {}))
        self.bus = FakeBus({0x68: self.chip}, self.clock, spend=self.clock.advance)
        self.params = build(Mpu6050Params, params)
        self.driver = Mpu6050Driver(self.params, self.bus.open, self.clock)
        self.rng = np.random.default_rng(0)

    def run(self, seconds, jitter=0.0):
        readings = []
        end = self.clock() + seconds * SECOND
        period = SECOND / self.params.polls_per_second
        while self.clock() < end:
            self.clock.advance(period * (1.0 + jitter * self.rng.exponential()))
            readings += self.driver.poll()
        return readings

    def raw(self):
        """The bus for looking at registers without a driver."""
        return self.bus.open()


def stamps_of(readings):
    return np.array([r.stamp for r in readings])


def mean_of(readings, name):
    return np.mean([getattr(r, name) for r in readings], axis=0)
