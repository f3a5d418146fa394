# SPDX-License-Identifier: Apache-2.0
"""The simulator as a process: what it publishes is what `simulate` says, at its rate."""

import sys
from pathlib import Path

import numpy as np
import pytest

from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation import simulate
from kalman_core.parameters import build, default_yaml
from node_core.testing import Process, probe, ros_arguments

RUN = 'from imu_kalman.nodes.imu_simulator import main; main()'
CONFIG = Path(__file__).parents[1] / 'config'


def start(**params):
    return Process([sys.executable, '-c', RUN, *ros_arguments(params)])


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def xyz(vector):
    return [vector.x, vector.y, vector.z]


@pytest.fixture
def graph():
    with probe() as p:
        yield p


def test_the_default_parameter_file_is_current():
    assert (CONFIG / 'imu_simulator.yaml').read_text() == default_yaml(SimulatorParams, 'imu_simulator')


def test_it_publishes_the_simulation_in_order_and_without_loss(graph):
    values = {'motion': 'tumble', 'seed': 11, 'rate': 250.0, 'mag_every': 5, 'frame_id': 'box'}
    imu = graph.collect('sensor_msgs/msg/Imu', 'imu/data_raw')
    mag = graph.collect('sensor_msgs/msg/MagneticField', 'imu/mag')
    truth = graph.collect('geometry_msgs/msg/QuaternionStamped', 'truth/orientation')
    with start(**values) as process:
        graph.until(
            lambda: len(imu) >= 300 and len(truth) >= 300 and len(mag) >= 60, 'samples', process=process
        )
        assert process.stop() == 0
    stamps = np.array([stamp_of(m) for m in imu])
    np.testing.assert_array_equal(np.diff(stamps), 4_000_000)
    np.testing.assert_array_equal(np.diff([stamp_of(m) for m in mag]), 20_000_000)
    # Which sample was the first to arrive depends on discovery: find it, then all must agree.
    block = simulate(build(SimulatorParams, values), 60.0)
    got = np.array([xyz(m.angular_velocity) for m in imu])
    first = int(np.flatnonzero((block.gyro == got[0]).all(axis=1))[0])
    rows = slice(first, first + len(got))
    np.testing.assert_array_equal(got, block.gyro[rows])
    np.testing.assert_array_equal([xyz(m.linear_acceleration) for m in imu], block.accel[rows])
    by_stamp = {stamp_of(m): m.quaternion for m in truth}
    q = by_stamp[stamps[-1]] if stamps[-1] in by_stamp else by_stamp[stamps[-2]]
    row = first + len(got) - (1 if stamps[-1] in by_stamp else 2)
    np.testing.assert_array_equal([q.w, q.x, q.y, q.z], block.quaternion[row])
    assert imu[0].header.frame_id == mag[0].header.frame_id == 'box'
    assert truth[0].header.frame_id == 'map'
    assert imu[0].orientation_covariance[0] == -1.0
    assert imu[0].angular_velocity_covariance[0] > 0.0
    assert mag[0].magnetic_field_covariance[0] > 0.0


def test_diagnostics_report_the_samples(graph):
    arrays = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    with start() as process:
        graph.until(
            lambda: any(
                s.name == 'imu_simulator' and int(s.values[0].value) > 0 for a in arrays for s in a.status
            ),
            'a status',
            process=process,
        )


@pytest.mark.parametrize(
    ('params', 'named'),
    [
        ({'motion': 'flying'}, "parameter 'motion' is 'flying'"),
        ({'rate': -1.0}, "parameter 'rate' is -1"),
        ({'motion_time': 1.0}, "parameter 'motion_time' is 1"),
        ({'speed': 1.0}, "unknown parameter 'speed'"),
    ],
)
def test_bad_parameters_end_with_one_line_and_code_2(params, named):
    with start(**params) as process:
        assert process.wait() == 2
        assert named in process.output
        assert len(process.output.strip().splitlines()) == 1
