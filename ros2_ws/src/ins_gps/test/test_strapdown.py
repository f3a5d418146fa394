# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from ins_gps.simulation import TRAJECTORIES, make_truth
from ins_gps.solution import error_of
from ins_gps.strapdown import increments, mechanise_series
from kalman_core.earth import gravity
from kalman_core.rotation import (
    euler_from_quat,
    quat_from_euler,
    quat_from_rotvec,
    quat_multiply,
    rotvec_from_quat,
)

ORIGIN = (math.radians(45.0), math.radians(-120.0), 500.0)


@pytest.mark.parametrize('name', ['constant', 's_turns', 'flight'])
def test_exact_imu_of_a_kinematic_truth_is_integrated_to_centimetres(name):
    truth, rate, force = make_truth(name, ORIGIN, 300.0, 100.0)
    out = mechanise_series(truth[0], rate, force, 0.01)
    error = error_of(out[-1], truth[-1])
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.linalg.norm(error[3:6]) < 2e-4
    assert np.linalg.norm(error[6:]) < 1e-6


def test_at_rest_it_stays_at_rest_for_an_hour_but_for_the_vertical_channel():
    nav = np.r_[ORIGIN, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    earth = 7.292115e-5 * np.array([math.cos(ORIGIN[0]), 0.0, -math.sin(ORIGIN[0])])
    force = np.array([0.0, 0.0, -gravity(ORIGIN[0], ORIGIN[2])])
    out = mechanise_series(nav, np.tile(earth, (360_000, 1)), np.tile(force, (360_000, 1)), 0.01)
    assert np.linalg.norm(error_of(out[-1], nav)[:2]) < 1e-2


def test_coning_is_corrected_to_fourth_order():
    w, a = 2.0 * math.pi * 5.0, math.radians(1.0)
    dt, n = 0.01, 1000

    def attitude(t):
        return quat_from_rotvec(np.array([a * math.cos(w * t), a * math.sin(w * t), 0.0]))

    def conjugate(q):
        return q * np.array([1.0, -1.0, -1.0, -1.0])

    fine = 50
    means = np.empty((n, 3))
    for i in range(n):
        total = np.zeros(3)
        for k in range(fine):
            t = i * dt + k * dt / fine
            total += rotvec_from_quat(quat_multiply(conjugate(attitude(t)), attitude(t + dt / fine)))
        means[i] = total / dt
    drifts = {}
    for corrected in (False, True):
        q = attitude(0.0)
        inc = np.empty(6)
        for i in range(1, n):
            before = means[i - 1] if corrected else means[i]
            increments(means[i], np.zeros(3), before, np.zeros(3), dt, inc)
            if i == 1:
                q = attitude(dt)
            q = quat_multiply(q, quat_from_rotvec(inc[:3]))
        drifts[corrected] = np.linalg.norm(rotvec_from_quat(quat_multiply(conjugate(q), attitude(n * dt))))
    assert drifts[True] < 0.05 * drifts[False]


def test_agrees_with_pyins():
    sim = pytest.importorskip('pyins.sim', reason='python-ins lives in the benchmark environment')
    trajectory, imu = sim.generate_sine_velocity_motion(
        0.01, 100.0, [50, 20, 100], [30, -20, 1], [8, 6, 2], 30, sensor_type='increment'
    )
    first, last = trajectory.iloc[0], trajectory.iloc[-1]
    angles = np.radians([first.roll, first.pitch, first.heading])
    nav = np.r_[
        np.radians([first.lat, first.lon]), first.alt, first.VN, first.VE, first.VD, quat_from_euler(*angles)
    ]
    values = np.ascontiguousarray(imu.values[1:] / 0.01)
    out = mechanise_series(
        nav, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]), 0.01
    )[-1]
    np.testing.assert_allclose(out[3:6], [last.VN, last.VE, last.VD], atol=1e-4)
    assert out[0] == pytest.approx(math.radians(last.lat), abs=1e-9)
    np.testing.assert_allclose(np.degrees(euler_from_quat(out[6:]))[:2], [last.roll, last.pitch], atol=1e-6)


def test_the_literal_reading_of_the_paper_does_not_fly():
    truth, _, _ = make_truth('literal', ORIGIN, 500.0, 10.0)
    assert np.abs(truth[-1, 3:6]).max() > 500.0 or truth[:, 2].min() < 0.0
    flyable, _, _ = make_truth('constant', ORIGIN, 500.0, 10.0)
    assert np.linalg.norm(flyable[:, 3:6], axis=1).max() < 46.0
    assert 'literal' in TRAJECTORIES
