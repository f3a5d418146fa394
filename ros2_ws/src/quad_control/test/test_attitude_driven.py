# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from kalman_core.rotation import (
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    rotvec_from_quat,
)
from quad_control import attitude_driven as driven

DT = 0.005


def boxplus(state, error):
    q, b, v = state
    return quat_multiply(quat_from_rotvec(error[:3]), q), b + error[3:6], v + error[6:]


def boxminus(a, b):
    turn = rotvec_from_quat(quat_multiply(a[0], quat_conjugate(b[0])))
    return np.concatenate((turn, a[1] - b[1], a[2] - b[2]))


def start(rng):
    return quat_normalize(rng.standard_normal(4)), 0.02 * rng.standard_normal(3), rng.standard_normal(3)


def moved(state, gyro, force):
    q, b, v = (part.copy() for part in state)
    driven.predict(q, b, v, np.zeros((9, 9)), gyro, force, DT, 0.0, 0.0, 0.0)
    return q, b, v


@pytest.mark.parametrize('seed', range(5))
def test_the_covariance_moves_by_the_numerical_jacobian(seed):
    rng = np.random.default_rng(seed)
    state = start(rng)
    gyro, force = rng.standard_normal(3), np.array([0.5, -0.3, 9.8]) + rng.standard_normal(3)
    base = moved(state, gyro, force)
    jacobian = np.empty((9, 9))
    for i in range(9):
        step = np.zeros(9)
        step[i] = 1e-6
        jacobian[:, i] = (boxminus(moved(boxplus(state, step), gyro, force), base)) / 1e-6
    a = rng.standard_normal((9, 9))
    P = a @ a.T
    expected = jacobian @ P @ jacobian.T
    q, b, v = (part.copy() for part in state)
    driven.predict(q, b, v, P, gyro, force, DT, 0.0, 0.0, 0.0)
    # The kernel takes f_n at the end of the step for its mean: a relative error of |w| dt.
    assert pytest.approx(expected, rel=0.02, abs=0.02) == P


@pytest.mark.parametrize('axis', [0, 1])
def test_the_drag_row_is_the_numerical_one(axis):
    rng = np.random.default_rng(axis)
    state = start(rng)
    drag = 0.4

    def predicted(s):
        return -drag * quat_rotate(quat_conjugate(s[0]), s[2])[axis]

    numeric = np.array(
        [
            (predicted(boxplus(state, 1e-6 * e)) - predicted(boxplus(state, -1e-6 * e))) / 2e-6
            for e in np.eye(9)
        ]
    )
    # Only this axis carries information: the gain of the update is then P·h / s.
    q, b, v = (part.copy() for part in state)
    P = np.eye(9)
    force = np.zeros(3)
    force[axis] = predicted(state) + 1e-3
    force[1 - axis] = predicted_other(state, 1 - axis, drag)
    before = (q.copy(), b.copy(), v.copy())
    driven.correct(q, b, v, P, force, 1.0, drag, 1e6, 1e18, 1e18)
    assert boxminus((q, b, v), before) * 1e6 / 1e-3 == pytest.approx(numeric, rel=1e-3, abs=1e-4)


def predicted_other(state, axis, drag):
    return -drag * quat_rotate(quat_conjugate(state[0]), state[2])[axis]


def test_an_update_is_the_textbook_one():
    rng = np.random.default_rng(4)
    a = rng.standard_normal((9, 9))
    P = a @ a.T
    h, r, innovation = rng.standard_normal(9), 0.7, 0.01
    state = start(rng)
    s = h @ P @ h + r
    gain = P @ h / s
    joseph = (np.eye(9) - np.outer(gain, h)) @ P @ (np.eye(9) - np.outer(gain, h)).T + r * np.outer(
        gain, gain
    )
    q, b, v = (part.copy() for part in state)
    nis = driven.update(q, b, v, P, h, innovation, r)
    assert nis == pytest.approx(innovation**2 / s)
    assert boxminus((q, b, v), state) == pytest.approx(gain * innovation, abs=1e-12)
    assert pytest.approx(joseph, abs=1e-9) == P


@pytest.mark.parametrize('force', [(0.0, 0.0, 9.8), (3.0, -2.0, 9.0), (0.0, 9.8, 0.1), (0.0, 0.0, -9.8)])
def test_the_first_tilt_turns_the_specific_force_upwards(force):
    q = driven.tilt_quaternion(*force)
    up = quat_rotate(q, np.array(force))
    assert up == pytest.approx((0.0, 0.0, math.hypot(*force)), abs=1e-9)
