# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bag_tools.bag import zeroed
from ins_gps import codec
from ins_gps.estimator import InsGpsEstimator
from ins_gps.odometry import body_quaternion
from ins_gps.params import FilterParams, SimulatorParams
from ins_gps.samples import (
    GROUND_CORRECTIONS,
    OBSERVATION_COLUMNS,
    BiasEstimate,
    Corrections,
    FixEstimate,
    GnssEpoch,
    ImuSample,
    NavigationEstimate,
    SettledEstimate,
)
from ins_gps.scenarios import scenario_of, truth_estimate
from ins_gps.simulation import Outage, Scenario
from ins_gps.simulation_gnss import simulate
from kalman_core.rotation import euler_from_quat, quat_from_euler
from node_core.driver import EstimatorDriver
from node_core.ports import BadMessage

PARAMS = FilterParams(
    channels=8, alignment='given', initial_attitude=(0.0, 0.0, np.pi / 2), elevation_mask=0.0
)


@pytest.fixture(scope='module')
def run():
    return simulate(Scenario(trajectory='s_turns', duration=12.0, imu_rate=20.0), 3)


def _samples(run):
    samples = [(s.stamp, 'on_imu', s) for s in run.imu_samples()]
    samples += [(e.stamp, 'on_gnss', e) for e in run.epochs]
    return sorted(samples, key=lambda s: s[:2], reverse=False)


def _drive(samples):
    estimator = InsGpsEstimator(PARAMS)
    out = []
    for _, handler, sample in samples:
        out.extend(getattr(estimator, handler)(sample) or [])
    return estimator, out


def test_settled_output_does_not_depend_on_the_order_of_arrival(run):
    samples = _samples(run)
    estimator, out = _drive(samples)
    reference = [e for e in out if type(e) is SettledEstimate]
    late = [
        (stamp + (300_000_000 if handler == 'on_gnss' else 0), handler, s) for stamp, handler, s in samples
    ]
    # The first epoch starts the filter and the window: it comes in time.
    late[0:2] = samples[0:2]
    other, out = _drive(sorted(late, key=lambda s: s[:2]))
    settled = [e for e in out if type(e) is SettledEstimate]
    assert len(reference) > 100
    by_stamp = {e.stamp: e for e in reference}
    for estimate in settled:
        np.testing.assert_array_equal(estimate.enu, by_stamp[estimate.stamp].enu)
    np.testing.assert_array_equal(estimator.state, other.state)


def test_each_epoch_gives_fix_and_biases(run):
    _, out = _drive(_samples(run))
    kinds = [type(e) for e in out]
    assert kinds.count(FixEstimate) == len(run.epochs)
    assert kinds.count(BiasEstimate) == len(run.epochs)
    assert kinds.count(NavigationEstimate) > 200


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=19, max_size=19), st.integers(0, 6))
def test_no_row_of_observations_breaks_it(run, values, count):
    estimator, _ = _drive(_samples(run)[:60])
    rows = np.tile(np.array(values), (count, 1))
    estimator.on_gnss(GnssEpoch(int(run.stamps[70]), rows))
    good = run.epochs[3].rows.copy()
    if count:
        good[:, 3:] = np.where(np.arange(16) == count, values[0], good[:, 3:])
    estimator.on_gnss(GnssEpoch(int(run.stamps[75]), good))
    estimator.on_imu(ImuSample(int(run.stamps[80]), np.array(values[:3]), np.array(values[3:6])))
    assert np.isfinite(estimator.state).all()


def test_observations_survive_the_message(run):
    epoch = run.epochs[0]
    message = zeroed(codec.CLOUD)
    codec.encode_observations(epoch, message)
    back = codec.decode_observations(message)
    assert back.stamp == epoch.stamp
    np.testing.assert_array_equal(back.rows, epoch.rows)
    codec.encode_observations(GnssEpoch(epoch.stamp, epoch.rows[:2]), message)
    assert codec.decode_observations(message).rows.shape == (2, OBSERVATION_COLUMNS)


def test_corrections_survive_the_message():
    sample = Corrections(5, np.array([[0.0, 3.0, -1.5, 0.0, 7.0], [1.0, 9.0, 2.5, 0.3, 8.0]]))
    message = zeroed(codec.CLOUD)
    codec.encode_corrections(sample, message)
    np.testing.assert_array_equal(codec.decode_corrections(message).rows, sample.rows)


def test_a_cloud_of_another_layout_is_refused(run):
    message = zeroed(codec.CLOUD)
    codec.encode_corrections(Corrections(5, np.zeros((1, 5))), message)
    with pytest.raises(BadMessage, match="no FLOAT64 field 'signal'"):
        codec.decode_observations(message)
    message.data = message.data[:7]
    with pytest.raises(BadMessage, match='wrong size'):
        codec.decode_observations(message)


def test_rclpy_messages_work_alike(run):
    sensor = pytest.importorskip('sensor_msgs.msg')
    message = sensor.PointCloud2()
    codec.encode_observations(run.epochs[0], message)
    np.testing.assert_array_equal(codec.decode_observations(message).rows, run.epochs[0].rows)


def test_imu_turns_from_left_up_to_right_down(run):
    message = zeroed(codec.IMU)
    codec.encode_imu(run.imu_samples()[0], message)
    assert message.linear_acceleration.z == pytest.approx(9.8, abs=0.1)
    back = codec.decode_imu(message)
    np.testing.assert_array_equal(back.force, run.force[0])
    for field, words in (
        ('angular_velocity', 'no angular velocity'),
        ('linear_acceleration', 'no specific f'),
    ):
        getattr(message, f'{field}_covariance')[0] = -1.0
        with pytest.raises(BadMessage, match=words):
            codec.decode_imu(message)
        getattr(message, f'{field}_covariance')[0] = 0.0


@pytest.mark.parametrize(
    ('ned', 'enu'), [((0, 0, 0), (0, 0, 90)), ((10, 0, 90), (10, 0, 0)), ((0, 20, 180), (0, -20, -90))]
)
def test_attitude_is_rep_103_in_messages(ned, enu):
    q = body_quaternion(quat_from_euler(*np.radians(ned)))
    np.testing.assert_allclose(np.degrees(euler_from_quat(q)), enu, atol=1e-9)
    np.testing.assert_allclose(np.abs(codec.ned_quaternion(q) @ quat_from_euler(*np.radians(ned))), 1.0)


def test_odometry_says_body_velocity_and_full_covariance(run):
    estimate = truth_estimate(run, 100)._replace(covariance=np.diag(np.arange(1.0, 10.0)))
    message = zeroed(codec.ODOMETRY)
    codec.encode_odometry(estimate, message)
    speed = np.linalg.norm(estimate.velocity)
    linear = message.twist.twist.linear
    assert np.linalg.norm([linear.x, linear.y, linear.z]) == pytest.approx(speed)
    assert linear.x > 0.9 * speed
    pose = np.asarray(message.pose.covariance).reshape(6, 6)
    np.testing.assert_allclose(np.diag(pose), [2.0, 1.0, 3.0, 8.0, 7.0, 9.0])
    assert np.linalg.eigvalsh(np.asarray(message.twist.covariance).reshape(6, 6))[0] > 0.0


def test_the_driver_feeds_it_from_messages(run):
    driver = EstimatorDriver(codec.INS_GPS_PORTS, PARAMS)
    ports = {p.topic: p for p in codec.INS_GPS_PORTS.inputs}
    imu, cloud = zeroed(codec.IMU), zeroed(codec.CLOUD)
    topics = set()
    for _, handler, sample in _samples(run)[:80]:
        if handler == 'on_imu':
            codec.encode_imu(sample, imu)
            result = driver.feed(ports['imu/data_raw'], imu)
        else:
            codec.encode_observations(sample, cloud)
            result = driver.feed(ports['gnss/observations'], cloud)
        for output, estimate in result:
            message = zeroed(output.type)
            output.encode(estimate, message)
            topics.add(output.topic)
    assert topics == {'odometry', 'odometry_settled', 'position', 'imu/bias'}
    values = driver.estimator.diagnostics()
    assert values['running']
    assert any(name.startswith('G01') for name in values)


def _nav_sat_fix():
    message = zeroed('sensor_msgs/msg/NavSatFix')
    message.header.stamp.sec = 5
    message.status.status = 0
    message.latitude, message.longitude, message.altitude = 21.0, 105.0, 10.0
    message.position_covariance[:] = np.diag([1.0, 4.0, 9.0]).ravel()
    message.position_covariance_type = 2
    return message


def test_a_fix_is_read_in_radians_and_its_covariance_turned_to_ned():
    sample = codec.decode_fix(_nav_sat_fix())
    np.testing.assert_allclose(sample.geodetic, [np.radians(21.0), np.radians(105.0), 10.0])
    np.testing.assert_allclose(np.diag(sample.covariance), [4.0, 1.0, 9.0])
    assert sample.status == 0
    message = _nav_sat_fix()
    message.status.status = GROUND_CORRECTIONS
    assert codec.decode_fix(message).status == GROUND_CORRECTIONS


@pytest.mark.parametrize(
    ('spoil', 'word'),
    [
        (lambda m: setattr(m.status, 'status', -1), 'no fix'),
        (lambda m: setattr(m, 'latitude', 91.0), 'out of range'),
        (lambda m: setattr(m, 'altitude', float('nan')), 'not finite'),
        (lambda m: setattr(m, 'position_covariance_type', 0), 'covariance unknown'),
        (lambda m: m.position_covariance.__setitem__(0, -1.0), 'not positive definite'),
    ],
)
def test_a_fix_that_cannot_be_used_is_refused_with_the_reason(spoil, word):
    message = _nav_sat_fix()
    spoil(message)
    with pytest.raises(BadMessage, match=word):
        codec.decode_fix(message)


def test_the_simulators_parameters_are_the_scenario(run):
    start = run.stamps[0]
    wanted = SimulatorParams(outage_start=10.0, outage_end=20.0, outage_left=3, budget='standalone')
    scenario = scenario_of(wanted, int(start))
    assert scenario.outages == (Outage(10.0, 20.0, 3),)
    assert scenario.start == start
    assert scenario_of(SimulatorParams(satellites='paper'), int(start)).origin[:2] == (0.0, 0.0)
