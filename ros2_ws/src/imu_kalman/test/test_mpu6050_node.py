# SPDX-License-Identifier: Apache-2.0
"""The MPU6050 driver as a process, on the fake bus and on none."""

import sys
from pathlib import Path

import numpy as np
import pytest

from imu_kalman.mpu6050_params import Mpu6050Params
from kalman_core.parameters import default_yaml
from node_core.testing import Process, probe, ros_arguments

RUN = 'from imu_kalman.nodes.mpu6050_driver import main; main()'
# The node as it is, but with a look-alike on its bus.
RUN_WRONG_CHIP = """
import imu_kalman.nodes.mpu6050_node as node
from imu_kalman.fake_bus import FakeBus
from imu_kalman.fake_mpu6050 import FakeMpu6050
bus = FakeBus({0x68: FakeMpu6050(None, identity=0x70)}, lambda: 1)
node.bus_opener = lambda params: bus.open
from imu_kalman.nodes.mpu6050_driver import main
main()
"""
CONFIG = Path(__file__).parents[1] / 'config'


def start(code=RUN, **params):
    return Process([sys.executable, '-c', code, *ros_arguments(params)])


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def statuses(arrays):
    return [s for a in arrays for s in a.status if s.name == 'mpu6050_driver']


@pytest.fixture
def graph():
    with probe() as p:
        yield p


def test_the_default_parameter_file_is_current():
    assert (CONFIG / 'mpu6050_driver.yaml').read_text() == default_yaml(Mpu6050Params, 'mpu6050_driver')


@pytest.mark.parametrize('pacing', ['fifo', 'data_ready'])
def test_without_hardware_the_fake_chip_delivers(graph, pacing):
    imu = graph.collect('sensor_msgs/msg/Imu', 'imu/data_raw')
    temperature = graph.collect('sensor_msgs/msg/Temperature', 'imu/temperature')
    arrays = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    still = {'bus': 'fake', 'fake_motion': 'still', 'calibrate_at_start': False}
    with start(**still, pacing=pacing, rate=100.0) as process:
        graph.until(lambda: len(imu) > 300, 'three seconds of samples', process=process)
        before = imu[-1]
        response = graph.call('std_srvs/srv/Trigger', '/mpu6050_driver/calibrate')
        assert response.success, response.message
        seen, said = len(imu), len(arrays)
        graph.until(
            lambda: any(s.level == b'\x00' for s in statuses(arrays[said:])) and len(imu) > seen + 20,
            'a calibrated chip',
            process=process,
        )
        assert process.stop() == 0
    stamps = np.array([stamp_of(m) for m in imu])
    assert (np.diff(stamps) > 0).all()
    force = np.mean([[m.linear_acceleration.x, m.linear_acceleration.z] for m in imu[:200]], axis=0)
    np.testing.assert_allclose(force, [0.0, 9.80665], atol=0.05)
    last = imu[-1].angular_velocity
    assert abs(last.x) < 0.01
    # Until the bias is known the covariance says how large it may be.
    assert before.angular_velocity_covariance[0] > 1e-2 > imu[-1].angular_velocity_covariance[0]
    assert temperature[0].temperature == pytest.approx(27.0, abs=0.1)


def test_a_wrong_chip_ends_with_a_clear_line_and_code_2():
    with start(RUN_WRONG_CHIP, bus='fake') as process:
        assert process.wait() == 2
        assert 'WHO_AM_I is 0x70 (MPU6500), expected 0x68 (MPU6050)' in process.output


def test_without_a_bus_it_says_so_and_keeps_trying(graph):
    arrays = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    with start(bus='/dev/i2c-250') as process:
        found = graph.until(
            lambda: [s for s in statuses(arrays) if s.level == b'\x02'], 'an error', process=process
        )
        assert 'no such bus' in found[0].message
        response = graph.call('std_srvs/srv/Trigger', '/mpu6050_driver/calibrate')
        assert not response.success
        assert 'no samples' in response.message
        assert process.stop() == 0


@pytest.mark.parametrize(
    ('params', 'named'),
    [
        ({'bus': 'i2c-one'}, "parameter 'bus' is 'i2c-one'"),
        ({'gyro_range': 300}, "parameter 'gyro_range' is 300, allowed: 250, 500, 1000, 2000"),
        ({'rate': 0.5}, "parameter 'rate' is 0.5"),
    ],
)
def test_bad_parameters_end_with_one_line_and_code_2(params, named):
    with start(**params) as process:
        assert process.wait() == 2
        assert named in process.output
        assert len(process.output.strip().splitlines()) == 1
