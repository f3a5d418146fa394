# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from bag_tools.bag import BagReader
from bag_tools.content import combined, topic_hashes
from imu_kalman.fixtures import FIXTURES, START, write_bag
from imu_kalman.sim_params import SimulatorParams
from imu_kalman.simulation import simulate


def read(path, topic):
    with BagReader(path) as bag:
        kind = bag.topics[topic].type
        return [(stamp, bag.decode(data, kind)) for _, stamp, data in bag.messages([topic])]


def stamp_of(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def xyz(vector):
    return np.array([vector.x, vector.y, vector.z])


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    for name, write in FIXTURES.items():
        write(folder / f'{name}.mcap')
    return folder


@pytest.mark.parametrize('name', FIXTURES)
def test_a_fixture_is_small_and_comes_out_the_same_again(name, bags, tmp_path):
    path = bags / f'{name}.mcap'
    assert path.stat().st_size < 1_000_000
    again = tmp_path / f'{name}.mcap'
    FIXTURES[name](again)
    with BagReader(path) as one, BagReader(again) as two:
        assert set(one.topics) == {'/imu/data_raw', '/imu/mag', '/truth/orientation'}
        assert combined(topic_hashes(one)) == combined(topic_hashes(two))


def test_a_bag_holds_what_was_simulated(tmp_path):
    params = SimulatorParams(motion='tumble', seed=9, mag_every=4)
    write_bag(tmp_path / 'x.mcap', params, 2.0)
    block = simulate(params, 2.0, START)
    imu = read(tmp_path / 'x.mcap', '/imu/data_raw')
    mag = read(tmp_path / 'x.mcap', '/imu/mag')
    truth = read(tmp_path / 'x.mcap', '/truth/orientation')
    assert len(imu) == len(truth) == 200
    assert len(mag) == 50
    for row in (0, 77, 199):
        stamp, message = imu[row]
        assert stamp == stamp_of(message) == block.stamp[row]
        np.testing.assert_array_equal(xyz(message.angular_velocity), block.gyro[row])
        np.testing.assert_array_equal(xyz(message.linear_acceleration), block.accel[row])
        assert message.orientation_covariance[0] == -1.0
        assert message.angular_velocity_covariance[4] > 0.0
        q = truth[row][1].quaternion
        np.testing.assert_array_equal([q.w, q.x, q.y, q.z], block.quaternion[row])
    np.testing.assert_array_equal(xyz(mag[3][1].magnetic_field), block.mag[12])
    assert mag[0][1].magnetic_field_covariance[8] > 0.0


def test_the_bad_fixture_has_every_fault_and_clean_data_between(bags):
    messages = read(bags / 'imu_bad_data.mcap', '/imu/data_raw')
    bag_time = np.array([t for t, _ in messages])
    stamps = np.array([stamp_of(m) for _, m in messages])
    gyro = np.array([xyz(m.angular_velocity) for _, m in messages])
    accel = np.array([xyz(m.linear_acceleration) for _, m in messages])
    assert np.isnan(gyro).any()
    assert np.isinf(accel).any()
    assert (accel == 0.0).all(axis=1).any()
    assert (np.abs(gyro) > 1e5).any()
    assert (stamps == 0).any()
    steps = np.diff(stamps[stamps > 0])
    assert (steps < 0).any()
    assert (steps == 0).sum() >= 50
    assert steps.max() > 1_000_000_000
    assert (np.diff(bag_time) >= 0).all()
    good = np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1) & (stamps > 0)
    assert good.mean() > 0.95
    field = np.array([xyz(m.magnetic_field) for _, m in read(bags / 'imu_bad_data.mcap', '/imu/mag')])
    assert (field == 0.0).all(axis=1).any()
    assert (np.abs(field) > 1e-3).any()


def test_the_truth_of_the_bad_fixture_is_the_truth(bags):
    clean = simulate(SimulatorParams(motion='hand_held', seed=44, initial_rest=3.0), 40.0, START)
    by_stamp = dict(zip(clean.stamp.tolist(), clean.quaternion))
    for _, message in read(bags / 'imu_bad_data.mcap', '/truth/orientation'):
        q = message.quaternion
        np.testing.assert_array_equal([q.w, q.x, q.y, q.z], by_stamp[stamp_of(message)])


def test_the_loop_goes_back_once_and_bag_time_never(bags):
    messages = read(bags / 'imu_loop.mcap', '/imu/data_raw')
    stamps = np.array([stamp_of(m) for _, m in messages])
    assert (np.diff(stamps) < 0).sum() == 1
    assert (np.diff([t for t, _ in messages]) > 0).all()
    half = len(messages) // 2
    np.testing.assert_array_equal(stamps[:half], stamps[half:])
