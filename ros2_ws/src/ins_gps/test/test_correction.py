# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from ins_gps.correction import ACCEPTED, EXCLUDED, UNUSED, joint_update


def _problem(seed, n=9, m=6):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    P = A @ A.T + 0.1 * np.eye(n)
    H = rng.normal(size=(m, n)) * (rng.random((m, n)) > 0.4)
    R = rng.uniform(0.1, 2.0, m)
    S = H @ P @ H.T + np.diag(R)
    nu = np.linalg.cholesky(S) @ rng.normal(size=m)
    return P, H, R, nu


def _update(P, H, nu, R, status, gate=np.inf):
    P, dx = P.copy(), np.zeros(len(P))
    normalised, information = np.zeros(len(nu)), np.zeros((len(nu), len(nu)))
    nis, used = joint_update(P, H, nu, R, status, gate, dx, normalised, information)
    return P, dx, nis, used, normalised, information


@pytest.mark.parametrize('seed', range(5))
def test_it_is_filterpys_update(seed):
    P, H, R, nu = _problem(seed)
    oracle = KalmanFilter(dim_x=9, dim_z=6)
    oracle.x, oracle.P, oracle.H, oracle.R = np.zeros((9, 1)), P.copy(), H, np.diag(R)
    oracle.update(nu[:, None])
    ours, dx, nis, used, _, information = _update(P, H, nu, R, np.full(6, ACCEPTED))
    np.testing.assert_allclose(dx, oracle.x[:, 0], atol=1e-12)
    np.testing.assert_allclose(ours, oracle.P, atol=1e-11)
    np.testing.assert_allclose(information, oracle.SI, atol=1e-11)
    assert nis == pytest.approx(float(nu @ oracle.SI @ nu))
    assert used == 6


@pytest.mark.parametrize('bad', range(6))
def test_the_wrong_measurement_is_excluded_and_leaves_no_trace(bad):
    P, H, R, nu = _problem(11)
    nu[bad] += 1_000.0
    status = np.full(6, ACCEPTED)
    ours, dx, _, used, normalised, _ = _update(P, H, nu, R, status, gate=25.0)
    assert status[bad] == EXCLUDED
    assert abs(normalised[bad]) > 5.0
    without = np.where(np.arange(6) == bad, UNUSED, ACCEPTED)
    P_without, dx_without, *_ = _update(P, H, nu, R, without)
    np.testing.assert_array_equal(ours, P_without)
    np.testing.assert_array_equal(dx, dx_without)
    assert used == 5


def test_the_leave_one_out_innovation_is_that_of_a_filter_without_it():
    P, H, R, nu = _problem(12)
    _, _, _, _, normalised, _ = _update(P, H, nu, R, np.full(6, ACCEPTED))
    for i in range(6):
        status = np.where(np.arange(6) == i, UNUSED, ACCEPTED)
        P_i, dx_i, *_ = _update(P, H, nu, R, status)
        expected = (nu[i] - H[i] @ dx_i) / np.sqrt(H[i] @ P_i @ H[i] + R[i])
        assert normalised[i] == pytest.approx(expected, rel=1e-9)


def test_nan_is_excluded():
    P, H, R, nu = _problem(13)
    nu[2] = np.nan
    status = np.full(6, ACCEPTED)
    ours, dx, *_ = _update(P, H, nu, R, status, gate=25.0)
    assert np.isfinite(dx).all()
    assert np.isfinite(ours).all()
