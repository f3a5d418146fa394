# SPDX-License-Identifier: Apache-2.0
"""Parameters may change while the filters run; the state goes on."""

from dataclasses import replace

import numpy as np

from imu_kalman.angle import AngleFilter
from imu_kalman.attitude import AttitudeFilter
from imu_kalman.samples import ImuSample, MagSample

STEP = 10_000_000  # ns


def feed(estimator, first, count, rate=(0.0, 0.0, 0.0)):
    for i in range(first, first + count):
        estimator.on_imu(ImuSample(10**18 + i * STEP, rate, (0.0, 0.0, 9.81), 'imu'))
        if isinstance(estimator, AttitudeFilter):
            estimator.on_mag(MagSample(10**18 + i * STEP, (0.0, 2e-5, -4e-5), 'imu'))


def test_a_changed_parameter_keeps_the_state_and_acts_on_what_follows():
    for estimator in (AttitudeFilter(), AngleFilter()):
        feed(estimator, 0, 300)
        before = estimator.state.copy()
        estimator.set_params(replace(estimator.params, max_rate=1.0))
        np.testing.assert_array_equal(estimator.state, before)
        feed(estimator, 300, 10, rate=(2.0, 0.0, 0.0))
        assert estimator.tally.sensor('imu/data_raw').rejected['angular velocity out of range'] == 10


def test_without_the_magnetometer_heading_is_known_less_well():
    variances = []
    for use in (True, False):
        estimator = AttitudeFilter()
        feed(estimator, 0, 1000)
        estimator.set_params(replace(estimator.params, use_magnetometer=use))
        feed(estimator, 1000, 1000)
        last = ImuSample(10**18 + 2000 * STEP, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), 'imu')
        variances.append(estimator.on_imu(last)[0].values[18])
    assert variances[1] > 1.2 * variances[0]
