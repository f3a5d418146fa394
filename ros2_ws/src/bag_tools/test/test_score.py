# SPDX-License-Identifier: Apache-2.0
"""Scores against errors that were put in by hand, and against scipy's rotations."""

import json

import numpy as np
import pytest
from bag_samples import IMU, SECOND, stamped
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from bag_tools import score as tool
from bag_tools.bag import BagError, BagWriter, zeroed
from bag_tools.errors import (
    at,
    attitude_errors,
    delay,
    euler_angles,
    nees,
    quat_multiply,
    quaternions,
    rotation_vectors,
)
from bag_tools.score import Subject, Window, evaluate, pair, score
from bag_tools.series import Series, read_series

DEGREE = np.pi / 180.0


def wxyz(rotation):
    return np.roll(np.atleast_2d(rotation.as_quat()), 1, axis=1)


def stamps_at(rate, count, start=SECOND):
    return start + (np.arange(count) * (1e9 / rate)).astype(np.int64)


def vector(stamps, values, role='vector', cov=None):
    values = np.asarray(values, dtype=float).reshape(len(stamps), -1)
    labels = ('x', 'y', 'z')[: values.shape[1]]
    return Series(role, 'vector', stamps, values, labels, 'm', cov)


def orientation(stamps, rotation, cov=None):
    return Series('orientation', 'orientation', stamps, wxyz(rotation), ('w', 'x', 'y', 'z'), 'rad', cov)


def test_statistics_of_hand_made_errors():
    stamps = stamps_at(10, 4)
    result = evaluate(vector(stamps, [1.0, -1.0, 3.0, 5.0]), vector(stamps, [0.0] * 4)).score
    (x,) = result.components
    assert (x.rmse, x.mean, x.max) == (3.0, 2.0, 5.0)
    assert x.percentiles['50'] == 2.0
    assert result.samples == 4
    assert result.seconds == pytest.approx(0.3)


def test_vectors_get_a_norm():
    stamps = stamps_at(10, 2)
    result = evaluate(vector(stamps, [[3, 4, 0], [0, 0, 0]]), vector(stamps, np.zeros((2, 3)))).score
    assert result.component('norm').max == 5.0
    assert result.component('norm').rmse == pytest.approx(5.0 / np.sqrt(2))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_rotation_maths_agrees_with_scipy(seed):
    rng = np.random.default_rng(seed)
    a, b = Rotation.random(5, random_state=rng), Rotation.random(5, random_state=rng)
    product = quat_multiply(wxyz(a), wxyz(b))
    assert np.abs(np.sum(product * wxyz(a * b), axis=1)) == pytest.approx(1.0)
    vectors = Rotation.from_rotvec(rotation_vectors(wxyz(a)))
    assert (vectors * a.inv()).magnitude() == pytest.approx(0.0, abs=1e-12)
    back = quaternions(euler_angles(wxyz(a)))
    assert np.abs(np.sum(back * wxyz(a), axis=1)) == pytest.approx(1.0)
    assert attitude_errors(wxyz(a), wxyz(b))['total'] == pytest.approx((a * b.inv()).magnitude())


def test_heading_and_inclination_are_told_apart():
    truth = Rotation.from_euler('ZYX', [[0.5, 0.2, -0.4]])
    turned = Rotation.from_rotvec([0.0, 0.0, 0.1]) * truth
    tilted = Rotation.from_rotvec([0.03, 0.04, 0.0]) * truth
    heading, tilt = (attitude_errors(wxyz(r), wxyz(truth)) for r in (turned, tilted))
    assert heading['heading'] == pytest.approx(0.1)
    assert heading['inclination'] == pytest.approx(0.0, abs=1e-9)
    assert tilt['inclination'] == pytest.approx(0.05)
    assert tilt['heading'] == pytest.approx(0.0, abs=1e-9)


def test_only_a_vector_that_may_be_angles_is_taken_for_roll_pitch_yaw():
    stamps = stamps_at(10, 5)
    truth = orientation(stamps, Rotation.from_euler('z', np.zeros((5, 1))))
    for role, pairs in (
        ('vector', 1),
        ('angular_velocity', 0),
        ('linear_velocity', 0),
        ('magnetic_field', 0),
    ):
        vector = Series(role, 'vector', stamps, np.zeros((5, 3)), ('x', 'y', 'z'))
        assert len(pair([vector], [truth])) == pairs
        assert len(pair([truth], [vector])) == pairs


def test_orientation_errors_are_degrees_whatever_the_quaternions_sign():
    stamps = stamps_at(10, 50)
    truth = Rotation.from_euler('z', np.linspace(0, 6, 50)[:, None])
    estimate = orientation(stamps, Rotation.from_rotvec([0.0, 0.0, 2.0 * DEGREE]) * truth)
    flipped = Series(**{f: getattr(estimate, f) for f in estimate.__slots__} | {'values': -estimate.values})
    for series in (estimate, flipped):
        result = evaluate(series, orientation(stamps, truth))
        assert result.score.component('heading').rmse == pytest.approx(2.0)
        assert result.errors[:, 2] == pytest.approx(2.0)
        assert np.abs(result.estimate - result.truth).max() < 2.001


@pytest.mark.parametrize('frame', ['world', 'body'])
def test_nees_is_chi_square_in_the_frame_of_the_covariance(frame):
    rng = np.random.default_rng(2)
    n = 4000
    truth = Rotation.from_euler('ZYX', np.column_stack((np.linspace(0, 20, n), np.full(n, 1.2), np.zeros(n))))
    root = np.diag([0.01, 0.002, 0.05])
    errors = rng.normal(size=(n, 3)) @ root
    turn = Rotation.from_rotvec(errors)
    estimate = turn * truth if frame == 'world' else truth * turn
    cov = np.tile(root @ root, (n, 1, 1))
    stamps = stamps_at(100, n)
    result = evaluate(orientation(stamps, estimate, cov), orientation(stamps, truth), frame=frame)
    # 3 degrees of freedom; the mean of n draws has standard deviation √(6/n) = 0.04.
    assert result.score.nees == pytest.approx(3.0, abs=0.15)
    assert result.score.dof == 3
    assert result.sigmas[0] == pytest.approx(np.diag(root) / DEGREE)
    other = 'body' if frame == 'world' else 'world'
    assert (
        evaluate(orientation(stamps, estimate, cov), orientation(stamps, truth), frame=other).score.nees > 10
    )


@pytest.mark.parametrize('frame', ['world', 'body'])
def test_each_component_has_its_own_nees(frame):
    """A heading ten times worse than it says leaves the inclination consistent."""
    rng = np.random.default_rng(3)
    n = 4000
    truth = Rotation.from_euler('ZYX', np.column_stack((np.linspace(0, 20, n), np.full(n, 1.2), np.zeros(n))))
    said = np.tile(np.diag([0.004, 0.004, 0.002]) ** 2, (n, 1, 1))
    estimate = Rotation.from_rotvec(rng.normal(size=(n, 3)) * [0.004, 0.004, 0.02]) * truth
    if frame == 'body':
        turn = estimate.as_matrix()
        said = turn.transpose(0, 2, 1) @ said @ turn
    stamps = stamps_at(100, n)
    found = evaluate(orientation(stamps, estimate, said), orientation(stamps, truth), frame=frame).score
    assert found.component('inclination').nees == pytest.approx(1.0, abs=0.05)
    assert found.component('heading').nees == pytest.approx(100.0, rel=0.1)
    assert found.component('total').nees == pytest.approx(found.nees / 3.0)


def test_components_of_vectors_have_their_own_nees_where_it_is_known():
    stamps = stamps_at(10, 2)
    cov = np.tile(np.diag([4.0, 1.0, 0.0]), (2, 1, 1))
    found = evaluate(vector(stamps, [[2.0, 3.0, 5.0]] * 2, cov=cov), vector(stamps, np.zeros((2, 3)))).score
    assert [c.nees for c in found.components] == [1.0, 9.0, None, None]
    assert found.nees is None


def test_nees_of_a_singular_covariance_is_unknown():
    got = nees(np.array([[1.0, 2.0], [1.0, 2.0]]), np.array([np.eye(2), np.zeros((2, 2))]))
    assert got[0] == pytest.approx(5.0)
    assert np.isnan(got[1])


def test_interpolation_agrees_with_scipy_and_stops_at_gaps():
    stamps = stamps_at(10, 20)
    stamps[10:] += SECOND  # a second without truth
    rotations = Rotation.from_euler('ZYX', np.random.default_rng(1).normal(size=(20, 3)) * 0.3)
    wanted = np.sort(
        np.concatenate((stamps, stamps[:-1] + 31_000_000, [stamps[9] + SECOND // 2, stamps[0] - 1]))
    )
    values, known = at(orientation(stamps, rotations), wanted)
    inside = np.concatenate((stamps, np.delete(stamps[:-1], 9) + 31_000_000))
    assert set(wanted[known]) == set(inside)
    expected = Slerp(stamps.astype(float), rotations)(wanted[known].astype(float))
    assert np.abs(np.sum(values[known] * wxyz(expected), axis=1)) == pytest.approx(1.0)


@pytest.mark.parametrize('lag', [0.12, -0.05, 0.0033, 0.0])
def test_delay_is_the_shift_that_was_put_in(lag):
    t = np.arange(0, 60, 0.01)

    def motion(time):
        return np.column_stack((np.sin(time), 0.5 * np.cos(0.7 * time)))

    assert delay(motion(t - lag), motion(t), 0.01) == pytest.approx(lag, abs=1e-5)


def test_delay_of_an_orientation_at_another_rate():
    def attitude(rate, lag, count):
        stamps = stamps_at(rate, count)
        t = (stamps - SECOND) * 1e-9 - lag
        return orientation(stamps, Rotation.from_euler('x', 0.3 * np.sin(t)[:, None]))

    result = evaluate(attitude(100, 0.04, 6000), attitude(40, 0.0, 2400))
    assert result.score.delay == pytest.approx(0.04, abs=0.002)


def test_delay_counts_only_what_the_window_lets_through():
    stamps = stamps_at(100, 4000)
    t = (stamps - SECOND) * 1e-9

    def attitude(lag):
        return orientation(stamps, Rotation.from_euler('x', 0.3 * np.sin(t - lag)[:, None]))

    result = evaluate(attitude(np.where(t < 20.0, 0.3, 0.04)), attitude(0.0), Window(after=20.0))
    assert result.score.delay == pytest.approx(0.04, abs=0.002)


def test_delay_of_what_stands_still_is_unknown():
    assert delay(np.ones((100, 1)), np.ones((100, 1)), 0.01) is None


def test_window_and_mask_choose_the_samples():
    stamps = stamps_at(1, 10)
    where = (np.array([SECOND, 5 * SECOND, 8 * SECOND]), np.array([False, True, False]))
    errors = vector(stamps, np.arange(10.0))
    result = evaluate(errors, vector(stamps, np.zeros(10)), Window(after=5.0, where=where))
    assert result.errors[:, 0].tolist() == [5.0, 6.0]
    with pytest.raises(BagError, match='no sample of the estimate lies where truth is known'):
        evaluate(errors, vector(stamps, np.zeros(10)), Window(after=50.0))


def test_roles_are_paired_across_message_types():
    stamps = stamps_at(10, 5)
    imu = [orientation(stamps, Rotation.identity(5)), vector(stamps, np.zeros((5, 3)), 'angular_velocity')]
    truth = [orientation(stamps, Rotation.identity(5))]
    assert [(e.role, t.role) for e, t in pair(imu, truth)] == [('orientation', 'orientation')]
    angles = vector(stamps, np.tile([0.1, 0.0, 0.0], (5, 1)))
    ((estimate, reference),) = pair([angles], truth)
    assert evaluate(estimate, reference).score.component('inclination').rmse == pytest.approx(0.1 / DEGREE)
    assert pair([vector(stamps, np.zeros(5))], truth) == []


@pytest.fixture
def odometry(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('odom', 'nav_msgs/msg/Odometry')
        bag.add('truth', 'nav_msgs/msg/Odometry')
        bag.add('speed', 'geometry_msgs/msg/TwistStamped')
        bag.add('moving', 'std_msgs/msg/Bool')
        flag = zeroed('std_msgs/msg/Bool')
        for k in range(100):
            stamp = SECOND + k * 10_000_000
            for topic, offset in (('/truth', 0.0), ('/odom', 0.5)):
                m = stamped(zeroed('nav_msgs/msg/Odometry'), stamp)
                m.pose.pose.position.x = k * 0.1 + offset
                m.twist.twist.linear.x = 10.0 - offset
                m.pose.covariance[:] = np.eye(6).ravel() * 0.25
                m.twist.covariance[:] = np.eye(6).ravel()
                bag.write(topic, stamp, m)
            s = stamped(zeroed('geometry_msgs/msg/TwistStamped'), stamp)
            s.twist.linear.x = 9.0
            bag.write('/speed', stamp, s)
            if k in (0, 50):
                flag.data = k == 50
                bag.write('/moving', stamp, flag)
    return tmp_path / 'bag'


def test_odometry_is_scored_in_all_its_parts(odometry):
    results = {c.score.role: c.score for c in score(Subject(odometry, 'odom'), Subject(odometry, 'truth'))}
    assert set(results) == {'position', 'orientation', 'linear_velocity', 'angular_velocity'}
    assert results['position'].component('x').rmse == pytest.approx(0.5)
    assert results['position'].nees == pytest.approx(1.0)  # 0.5² / 0.25
    assert results['linear_velocity'].component('x').mean == pytest.approx(-0.5)
    assert results['orientation'].component('total').max == 0.0


@pytest.mark.parametrize(
    ('path', 'unit', 'nees'),
    [
        ('pose.pose.position', 'm', 1.0),  # 0.5² over a variance of 0.25
        ('pose.pose.position.x', 'm', 1.0),
        ('pose.pose.position.y', 'm', 0.0),
        ('twist.twist.linear', 'm/s', 0.25),
        ('twist.twist.linear.x', 'm/s', 0.25),
        ('twist.twist.angular.z', 'rad/s', 0.0),
        ('header.stamp.nanosec', '', None),
    ],
)
def test_a_field_keeps_its_unit_and_its_part_of_the_covariance(odometry, path, unit, nees):
    found = score(Subject(odometry, 'odom', path), Subject(odometry, 'truth', path))[0].score
    assert found.components[0].unit == unit
    assert found.components[0].name in ('x', path.rsplit('.', 1)[-1])
    assert found.nees == (nees if nees is None else pytest.approx(nees))


def test_command_line_scores_fields_and_masks(odometry, capsys):
    bag = str(odometry)
    assert tool.main([bag, '/speed', '/truth', '--where', '/moving', '--json']) == 0
    linear = {s['role']: s for s in json.loads(capsys.readouterr().out)}['linear_velocity']
    assert linear['samples'] == 50
    assert linear['components'][0]['rmse'] == pytest.approx(1.0)
    fields = ['--field', 'twist.linear.x', '--truth-field', 'twist.twist.linear.x']
    assert tool.main([bag, '/speed', '/truth', *fields]) == 0
    assert '1' in capsys.readouterr().out.splitlines()[1].split()
    fields = ['--field', 'twist.twist.linear.x', '--truth-field', 'twist.twist.linear.x']
    assert tool.main([bag, '/odom', '/truth', *fields, '--json']) == 0
    assert json.loads(capsys.readouterr().out)[0]['nees'] == pytest.approx(0.25)  # 0.5² over a variance of 1
    assert tool.main([bag, '/speed', '/truth', '--field', 'twist.size']) == 2
    assert "has no numbers at 'twist.size'" in capsys.readouterr().err
    assert tool.main([bag, '/moving', '/truth']) == 2
    assert 'no quantity in common' in capsys.readouterr().err


def test_unset_and_non_finite_values_are_left_out(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('imu', IMU)
        for k, (w, rate) in enumerate([(0.0, 1.0), (1.0, float('nan')), (2.0 / 2.0, 2.0)]):
            m = stamped(zeroed(IMU), SECOND + k)
            m.orientation.w = w
            m.angular_velocity.x = rate
            bag.write('/imu', SECOND + k, m)
    series = {s.role: s for s in read_series(tmp_path / 'bag', 'imu')}
    assert series['orientation'].stamps.tolist() == [SECOND + 1, SECOND + 2]
    assert series['angular_velocity'].values[:, 0].tolist() == [1.0, 2.0]
    assert series['orientation'].covariance is None


def _geodetic(rows, covariance=None):
    rows = np.array(rows, dtype=float)
    stamps = 10**9 * np.arange(1, len(rows) + 1)
    return Series('geodetic', 'vector', stamps, rows, ('latitude', 'longitude', 'altitude'), '', covariance)


@pytest.mark.parametrize(
    ('latitude', 'longitude'), [(0.0, 0.0), (60.0, 25.0), (60.0, 180.0), (-33.0, -180.0)]
)
def test_geodetic_positions_are_scored_in_metres_wherever_they_lie(latitude, longitude):
    from kalman_core.earth import ecef_from_enu, geodetic_from_ecef

    truth = [(latitude, longitude, 10.0)] * 5
    origin = np.radians(latitude), np.radians(longitude), 10.0
    lat, lon, height = geodetic_from_ecef(ecef_from_enu(np.array([1.0, -2.0, 3.0]), *origin))
    rows = [(np.degrees(lat), np.degrees(lon), height)] * 5
    scored = evaluate(_geodetic(rows, np.tile(np.eye(3), (5, 1, 1))), _geodetic(truth)).score
    assert [c.unit for c in scored.components] == ['m'] * 4
    assert [c.mean for c in scored.components[:3]] == pytest.approx([1.0, -2.0, 3.0], abs=1e-6)
    assert scored.nees == pytest.approx(14.0)


def test_quantities_that_messages_name_differently_are_not_compared():
    def series(role):
        return Series(role, 'vector', np.array([1, 2]), np.zeros((2, 3)), ('x', 'y', 'z'))

    assert pair([series('position')], [series('geodetic')]) == []
    assert pair([series('angular_velocity')], [series('position')]) == []
    assert len(pair([series('angular_velocity')], [series('vector')])) == 1
