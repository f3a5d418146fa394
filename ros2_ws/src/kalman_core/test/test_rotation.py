# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from kalman_core import rotation

COMPONENT = st.floats(-4.0, 4.0)
ROTVEC = arrays(np.float64, 3, elements=COMPONENT)
VECTOR = arrays(np.float64, 3, elements=st.floats(-100.0, 100.0))
few = settings(max_examples=60, deadline=None)


def scipy_of(q):
    return Rotation.from_quat(q, scalar_first=True)


def same_rotation(q, expected):
    """Angle (rad) between a quaternion and a scipy Rotation."""
    return (scipy_of(q) * expected.inv()).magnitude()


@few
@given(rotvec=ROTVEC)
def test_the_exponential_map_equals_scipy(rotvec):
    q = rotation.quat_from_rotvec(rotvec)
    assert same_rotation(q, Rotation.from_rotvec(rotvec)) < 1e-14 * max(1.0, np.linalg.norm(rotvec)) * 10
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize('angle', [0.0, 1e-300, 1e-12, 1e-6, 0.99e-4, 1.01e-4, 1e-3, 3.0, math.pi - 1e-9])
def test_the_logarithm_inverts_the_exponential_at_every_size_of_angle(angle):
    axis = np.array([0.6, -0.48, 0.64])
    back = rotation.rotvec_from_quat(rotation.quat_from_rotvec(angle * axis))
    assert back == pytest.approx(angle * axis, rel=1e-14, abs=1e-16)


@few
@given(rotvec=ROTVEC)
def test_the_logarithm_equals_scipy_for_both_signs_of_the_quaternion(rotvec):
    expected = Rotation.from_rotvec(rotvec)
    q = expected.as_quat(scalar_first=True)
    for sign in (1.0, -1.0):
        got = rotation.rotvec_from_quat(sign * q)
        assert np.linalg.norm(got) <= math.pi + 1e-15
        assert (Rotation.from_rotvec(got) * expected.inv()).magnitude() < 1e-14


@few
@given(a=ROTVEC, b=ROTVEC, v=VECTOR)
def test_product_inverse_matrix_and_rotation_of_vectors_equal_scipy(a, b, v):
    ra, rb = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    p, q = ra.as_quat(scalar_first=True), rb.as_quat(scalar_first=True)
    assert same_rotation(rotation.quat_multiply(p, q), ra * rb) < 1e-14
    assert same_rotation(rotation.quat_conjugate(p), ra.inv()) < 1e-14
    assert np.allclose(rotation.matrix_from_quat(p), ra.as_matrix(), atol=1e-14)
    assert np.allclose(rotation.quat_rotate(p, v), ra.apply(v), atol=1e-12)
    assert np.allclose(rotation.quat_rotate_inverse(p, v), ra.inv().apply(v), atol=1e-12)


@few
@given(rotvec=ROTVEC)
def test_a_matrix_gives_back_its_quaternion_with_positive_scalar(rotvec):
    expected = Rotation.from_rotvec(rotvec)
    q = rotation.quat_from_matrix(expected.as_matrix())
    assert q[0] >= 0.0
    assert same_rotation(q, expected) < 1e-14


@pytest.mark.parametrize(
    'axis', np.vstack([np.eye(3), -np.eye(3), [[1, 1, 0], [0, 1, 1], [1, 0, -1], [1, 1, 1]]])
)
@pytest.mark.parametrize('angle', [math.pi, math.pi - 1e-7, 2.5, 1e-9])
def test_half_turns_keep_full_precision_through_a_matrix(axis, angle):
    expected = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis))
    assert same_rotation(rotation.quat_from_matrix(expected.as_matrix()), expected) < 1e-14


@few
@given(roll=st.floats(-3.1, 3.1), pitch=st.floats(-1.57, 1.57), yaw=st.floats(-3.1, 3.1))
def test_euler_angles_equal_scipys_intrinsic_zyx_and_come_back(roll, pitch, yaw):
    q = rotation.quat_from_euler(roll, pitch, yaw)
    assert same_rotation(q, Rotation.from_euler('ZYX', [yaw, pitch, roll])) < 1e-14
    back = rotation.euler_from_quat(q)
    tolerance = 1e-13 / math.cos(pitch)
    assert back == pytest.approx((roll, pitch, yaw), abs=tolerance)


@pytest.mark.parametrize('pitch', [math.pi / 2, -math.pi / 2])
@pytest.mark.parametrize(('roll', 'yaw'), [(0.0, 0.4), (0.7, -1.2), (-2.0, 3.0), (3.0, 3.0), (-3.0, 2.9)])
def test_looking_straight_up_or_down_yaw_carries_both_angles(pitch, roll, yaw):
    q = rotation.quat_from_euler(roll, pitch, yaw)
    for sign in (1.0, -1.0):
        r, p, y = rotation.euler_from_quat(sign * q)
        assert (r, p) == (0.0, pitch)
        assert -math.pi <= y < math.pi
        assert same_rotation(rotation.quat_from_euler(r, p, y), scipy_of(q)) < 1e-7


def test_euler_angles_of_a_quaternion_with_rounding_above_unit_norm_are_finite():
    q = rotation.quat_from_euler(0.3, math.pi / 2, 0.1) * (1 + 1e-12)
    assert all(math.isfinite(angle) for angle in rotation.euler_from_quat(q))
    q = rotation.quat_from_euler(0.3, -math.pi / 2, 0.1) * (1 + 1e-12)
    assert all(math.isfinite(angle) for angle in rotation.euler_from_quat(q))


@pytest.mark.parametrize('bad', [np.zeros(4), np.full(4, np.nan), [np.inf, 0, 0, 0], np.full(4, 1e200)])
def test_normalising_what_has_no_direction_gives_the_identity(bad):
    assert np.array_equal(rotation.quat_normalize(np.array(bad, dtype=float)), [1.0, 0.0, 0.0, 0.0])


def test_normalising_keeps_the_direction():
    q = np.array([1.0, -2.0, 3.0, -4.0])
    assert rotation.quat_normalize(q) == pytest.approx(q / math.sqrt(30.0), rel=1e-15)


@few
@given(a=VECTOR, b=VECTOR)
def test_cross_and_skew_equal_numpy(a, b):
    expected = np.cross(a, b)
    assert np.allclose(rotation.cross(a, b), expected, atol=1e-11)
    assert np.allclose(rotation.skew(a) @ b, expected, atol=1e-11)


@few
@given(angle=st.floats(-1e4, 1e4))
def test_wrapped_angles_lie_in_the_half_open_interval_and_differ_by_whole_turns(angle):
    wrapped = rotation.wrap(angle)
    assert -math.pi <= wrapped < math.pi
    turns = (angle - wrapped) / (2.0 * math.pi)
    assert turns == pytest.approx(round(turns), abs=1e-11)
    assert rotation.wrap_array(np.array([[angle]]))[0, 0] == pytest.approx(wrapped, abs=1e-11)


def test_wrapping_keeps_what_is_in_the_interval_and_maps_its_open_end_to_the_closed_one():
    below = math.nextafter(math.pi, 0.0)
    assert rotation.wrap(below) == below
    assert rotation.wrap(1e-300) == 1e-300
    assert rotation.wrap(-math.pi) == -math.pi
    assert rotation.wrap(math.pi) == -math.pi
    assert rotation.wrap(3.0 * math.pi) == -math.pi
    assert rotation.wrap(-math.nextafter(math.pi, 4.0)) == pytest.approx(math.pi)
    assert rotation.wrap(-math.nextafter(math.pi, 4.0)) < math.pi
    assert list(rotation.wrap_array([math.pi, -math.pi, 4.0])) == [-math.pi, -math.pi, 4.0 - 2.0 * math.pi]
    assert rotation.wrap_array(-math.nextafter(math.pi, 4.0)) == -math.pi


def test_after_many_turns_rounding_does_not_leave_the_interval():
    for turns in range(-4001, 4001, 2):
        for angle in (turns * math.pi, math.nextafter(turns * math.pi, 0.0)):
            assert -math.pi <= rotation.wrap(angle) < math.pi


@pytest.mark.parametrize('bad', [math.inf, -math.inf, math.nan])
@pytest.mark.filterwarnings('ignore::RuntimeWarning')
def test_wrapping_what_is_not_finite_gives_nan_and_no_exception(bad):
    assert math.isnan(rotation.wrap(bad))
