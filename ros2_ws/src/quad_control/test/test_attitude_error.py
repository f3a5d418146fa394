# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core.rotation import quat_from_euler, quat_from_rotvec, quat_multiply, quat_normalize, quat_rotate
from quad_control.attitude_error import attitude_error, heading, tilt_cosine

angles = st.floats(-1.0, 1.0)
UP = np.array([0.0, 0.0, 1.0])


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4), angles, angles)
def test_turning_by_the_tilt_error_brings_the_thrust_axis_where_it_is_wanted(raw, roll, pitch):
    q = quat_normalize(np.array(raw) + 1e-3)
    x, y, _ = attitude_error(q, roll, pitch, 0.0)
    turned = quat_multiply(q, quat_from_rotvec(np.array([x, y, 0.0])))
    wanted = quat_from_euler(roll, pitch, heading(q))
    assert quat_rotate(turned, UP) == pytest.approx(quat_rotate(wanted, UP), abs=1e-9)


def test_small_errors_are_the_differences_of_the_angles():
    q = quat_from_euler(0.02, -0.01, 0.5)
    assert attitude_error(q, 0.0, 0.0, 0.53) == pytest.approx((-0.02, 0.01, 0.03), abs=1e-3)


def test_the_heading_error_takes_the_short_way():
    assert attitude_error(quat_from_euler(0.0, 0.0, 3.0), 0.0, 0.0, -3.0)[2] == pytest.approx(
        2 * math.pi - 6.0
    )


def test_upside_down_has_an_error_of_half_a_turn():
    x, y, _ = attitude_error(quat_from_euler(math.pi, 0.0, 0.0), 0.0, 0.0, 0.0)
    assert math.hypot(x, y) == pytest.approx(math.pi, abs=1e-6)


def test_the_tilt_cosine_ignores_the_heading():
    assert tilt_cosine(quat_from_euler(0.3, 0.0, 2.0)) == pytest.approx(math.cos(0.3))
