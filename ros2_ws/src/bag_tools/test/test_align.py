# SPDX-License-Identifier: Apache-2.0
"""Constants between two devices: what was put in by hand is found again, and leaves the rest as it was."""

import json

import numpy as np
import pytest
from bag_samples import SECOND
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from test_score import orientation, stamps_at, vector

from bag_tools import score as tool
from bag_tools.align import Solved, aligned, solve
from bag_tools.bag import BagError, BagWriter, zeroed
from bag_tools.score import Subject, Window, evaluate, score

DEGREE = np.pi / 180.0
AS_IT_IS = Rotation.identity()
ANGLES = st.floats(-np.pi, np.pi)


def everywhere(stamps):
    return np.ones(len(stamps), dtype=bool)


def motion(seconds):
    """A body that rolls, pitches and turns by some tens of degrees."""
    t = np.asarray(seconds, dtype=float)
    return Rotation.from_euler(
        'ZYX', np.column_stack((0.7 * np.sin(0.4 * t), 0.3 * np.sin(1.7 * t), 0.4 * np.sin(1.1 * t + 0.3)))
    )


def pose_of(found):
    return Rotation.from_quat(np.roll(found.mounting, -1))


def late(lag, mounting=AS_IT_IS, heading=0.0, count=2000):
    """What a device says that is `lag` s late, turned on the body and about the vertical."""
    stamps = stamps_at(100, count)
    seconds = np.arange(count) / 100.0 - lag
    return orientation(stamps, Rotation.from_rotvec([0, 0, -heading]) * motion(seconds) * mounting.inv())


def truth(count=200):
    return orientation(stamps_at(10, count), motion(np.arange(count) / 10.0))


@settings(max_examples=20, deadline=None)
@given(st.tuples(ANGLES, ANGLES, ANGLES), ANGLES, st.floats(-1.8, 1.8))
def test_what_was_put_in_is_found(turn, heading, lag):
    mounting = Rotation.from_rotvec(turn)
    found = solve(late(lag, mounting, heading), truth(), ('mounting', 'heading', 'lag'), everywhere)
    # The truth is interpolated between samples 0.1 s apart.
    assert (pose_of(found).inv() * mounting).magnitude() < 0.2 * DEGREE
    assert abs((found.heading - heading + np.pi) % (2 * np.pi) - np.pi) < 0.2 * DEGREE
    assert found.lag == pytest.approx(lag, abs=2e-3)


def test_what_is_left_is_the_error_that_was_there():
    noisy = late(0.3, Rotation.from_euler('x', 180, degrees=True), 0.5)
    generator = np.random.default_rng(1)
    rotation = Rotation.from_quat(np.roll(noisy.values, -1, axis=1))
    noisy = orientation(noisy.stamps, rotation * Rotation.from_rotvec(generator.normal(0.0, 0.01, (2000, 3))))
    result = evaluate(noisy, truth(), constants=('mounting', 'heading', 'lag')).score
    assert result.component('total').rmse == pytest.approx(np.sqrt(3.0) * 0.01 / DEGREE, rel=0.05)
    assert abs(result.delay) < 3e-3
    assert evaluate(noisy, truth()).score.component('total').rmse > 90.0


def test_a_heading_that_drifts_leaves_the_mounting_as_it_is():
    mounting = Rotation.from_euler('ZYX', [90.0, 2.0, -3.0], degrees=True)
    seen = late(0.2, mounting)
    drift = Rotation.from_rotvec(np.outer(np.linspace(0.0, 2.0, len(seen.stamps)), [0, 0, 1]))
    seen = orientation(seen.stamps, drift * Rotation.from_quat(np.roll(seen.values, -1, axis=1)))
    found = evaluate(seen, truth(), constants=('mounting', 'lag'))
    assert (pose_of(found.score.solved).inv() * mounting).magnitude() < 0.2 * DEGREE
    assert found.score.component('inclination').rmse < 0.1
    assert found.score.component('heading').max > 90.0


def test_a_lag_alone_is_that_of_the_correlation_for_any_quantity():
    t = np.arange(2000) / 100.0
    seen = vector(stamps_at(100, 2000), np.sin(t - 0.25))
    reference = vector(stamps_at(100, 2000), np.sin(t))
    found = evaluate(seen, reference, constants=('lag',))
    assert found.score.solved.lag == pytest.approx(0.25, abs=1e-3)
    assert found.score.components[0].rmse < 1e-3
    turned = evaluate(late(0.25), truth(), constants=('lag',)).score
    assert turned.solved == Solved(lag=pytest.approx(0.25, abs=2e-3))


@pytest.mark.parametrize('frame', ['world', 'body'])
def test_the_covariance_turns_with_the_axes(frame):
    """Errors with their own uncertain axis have the same NEES before and after."""
    mounting, heading = Rotation.from_euler('ZYX', [70.0, 10.0, 120.0], degrees=True), 1.1
    reference = orientation(stamps_at(100, 2000), motion(np.arange(2000) / 100.0))
    plain = Rotation.from_quat(np.roll(late(0.0, mounting, heading).values, -1, axis=1))
    sigma = np.array([0.002, 0.01, 0.05])
    error = Rotation.from_rotvec(np.random.default_rng(2).normal(0.0, sigma, (2000, 3)))
    covariance = np.tile(np.diag(sigma**2), (2000, 1, 1))
    seen = orientation(reference.stamps, plain * error if frame == 'body' else error * plain, covariance)
    result = evaluate(seen, reference, frame=frame, constants=('mounting', 'heading')).score
    assert result.nees == pytest.approx(3.0, abs=0.3)


def test_only_what_counts_is_solved_from():
    seen, reference = late(0.0), truth()
    spoilt = seen.values.copy()
    spoilt[1000:] = [0.0, 1.0, 0.0, 0.0]
    seen = orientation(seen.stamps, Rotation.from_quat(np.roll(spoilt, -1, axis=1)))
    found = evaluate(seen, reference, Window(before=9.0), constants=('mounting',)).score
    assert found.component('inclination').rmse < 0.1


def test_nothing_solved_changes_nothing():
    seen = late(0.1)
    same = aligned(seen, Solved())
    assert same.stamps is seen.stamps
    assert same.values is seen.values


def level(count=500):
    return orientation(
        stamps_at(100, count), Rotation.from_euler('z', np.sin(np.arange(count) / 50.0)[:, None])
    )


def test_what_the_motion_does_not_tell_is_refused():
    with pytest.raises(BagError, match=r'the truth tilts by .*° \(RMS\), at least 2° are needed'):
        solve(level(), level(), ('mounting',), everywhere)
    still = orientation(stamps_at(100, 500), Rotation.from_euler('x', np.full((500, 1), 0.2)))
    for constants in (('lag',), ('lag', 'mounting'), ('lag', 'heading')):
        with pytest.raises(BagError, match=r'too little moves|at least 2°'):
            solve(still, still, constants, everywhere)
    with pytest.raises(BagError, match='beyond 2 s'):
        solve(late(2.1), truth(), ('mounting', 'lag'), everywhere)
    with pytest.raises(BagError, match='no sample of the estimate lies where truth is known'):
        solve(late(0.0), truth(), ('heading',), lambda stamps: np.zeros(len(stamps), dtype=bool))


@pytest.fixture
def bag(tmp_path):
    """Odometry late by 0.2 s in /odom, its truth in /truth."""
    path = tmp_path / 'turned.mcap'
    quaternion, point = 'geometry_msgs/msg/QuaternionStamped', 'geometry_msgs/msg/PointStamped'
    with BagWriter(path) as writer:
        rows = [('/odom', quaternion, late(0.2, Rotation.from_euler('z', 90, degrees=True)))]
        rows += [('/truth', quaternion, truth()), ('/place', point, None)]
        for topic, kind, _ in rows:
            writer.add(topic, kind)
        messages = []
        for topic, kind, series in rows[:2]:
            for stamp, q in zip(series.stamps, series.values):
                message = zeroed(kind)
                message.quaternion.w, message.quaternion.x, message.quaternion.y, message.quaternion.z = q
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(stamp), SECOND)
                messages.append((int(stamp), topic, message))
        place = zeroed(point)
        place.header.stamp.sec = 2
        messages.append((2 * SECOND, '/place', place))
        for stamp, topic, message in sorted(messages, key=lambda m: m[0]):
            writer.write(topic, stamp, message)
    return path


def test_the_command_says_what_it_took_out(bag, capsys):
    line = [str(bag), '/odom', '/truth', '--solve', 'mounting', 'lag']
    assert tool.main(line) == 0
    shown = capsys.readouterr().out
    assert 'solved: mounting roll 0.00°, pitch 0.00°, yaw 90.00°' in shown.replace('-0.00', '0.00')
    assert 'lag 200.' in shown or 'lag 199.' in shown
    assert tool.main([*line, '--json']) == 0
    solved = json.loads(capsys.readouterr().out)[0]['solved']
    assert solved['heading'] is None
    assert solved['lag'] == pytest.approx(0.2, abs=2e-3)


def test_a_mounting_needs_an_orientation(bag):
    with pytest.raises(BagError, match="'/place' has no orientation"):
        score(Subject(bag, '/place'), Subject(bag, '/place'), constants=('mounting',))
