# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter

from quad_control import attitude_published as published

DT, SIGMA, R = 0.005, 0.8, 8e-4


def test_the_printed_process_noise_is_the_papers_and_the_corrected_one_its_formula():
    assert published.printed_q11(SIGMA, DT, True) == pytest.approx(5.33e-6, rel=1e-3)
    assert published.printed_q11(SIGMA, DT, False) == pytest.approx(2.67e-8, rel=2e-3)


@pytest.mark.parametrize('with_rate', [False, True])
def test_equals_filterpy_with_the_same_matrices(with_rate):
    rng = np.random.default_rng(0)
    q11 = published.printed_q11(SIGMA, DT, not with_rate)
    oracle = KalmanFilter(dim_x=2, dim_z=2 if with_rate else 1)
    oracle.F = np.array([[1.0, DT], [0.0, 1.0]])
    # filterpy's continuous white-noise acceleration has the same other entries: sigma² dt²/2, sigma² dt.
    oracle.Q = SIGMA**2 * np.array([[0.0, DT**2 / 2], [DT**2 / 2, DT]])
    oracle.Q[0, 0] = q11
    oracle.H = np.eye(2) if with_rate else np.array([[1.0, 0.0]])
    oracle.R = np.diag([R, 4e-6]) if with_rate else np.array([[R]])
    oracle.x = np.zeros(2)
    oracle.P = np.diag([0.05, 1.0])
    x, P = np.zeros(2), np.diag([0.05, 1.0])
    for _ in range(300):
        angle, rate = 0.1 * rng.standard_normal(2)
        published.step(x, P, DT, SIGMA, q11, angle, R, rate, 4e-6 if with_rate else 0.0)
        oracle.predict()
        oracle.update(np.array([angle, rate]) if with_rate else np.array([angle]))
        assert x == pytest.approx(oracle.x, abs=1e-12)
        assert pytest.approx(oracle.P, abs=1e-12) == P


def test_the_formula_of_the_paper_is_filterpys_continuous_white_noise():
    q = Q_continuous_white_noise(dim=2, dt=DT, spectral_density=SIGMA**2)
    assert published.printed_q11(SIGMA, DT, False) == pytest.approx(q[0, 0])


def test_accelerometer_angles_of_known_attitudes():
    g = 9.8
    assert published.accelerometer_angles(0.0, g * math.sin(0.3), g * math.cos(0.3)) == pytest.approx(
        (0.3, 0.0)
    )
    assert published.accelerometer_angles(-g * math.sin(0.4), 0.0, g * math.cos(0.4)) == pytest.approx(
        (0.0, 0.4)
    )


def test_r_rises_only_beyond_the_deadband():
    g = 9.80665
    assert published.adaptive_factor(0.0, 0.0, 1.09 * g, 3.0, 0.1) == pytest.approx(1.0)
    assert published.adaptive_factor(0.0, 0.0, 1.5 * g, 3.0, 0.1) == pytest.approx(1.0 + 3.0 * 0.4)


def test_the_angle_innovation_wraps():
    x, P = np.array([3.1, 0.0]), np.diag([0.05, 1.0])
    innovation, _ = published.step(x, P, DT, SIGMA, 0.0, -3.1, R, 0.0, 0.0)
    assert innovation == pytest.approx(2 * math.pi - 6.2)
