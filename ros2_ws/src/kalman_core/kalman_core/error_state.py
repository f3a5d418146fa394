# SPDX-License-Identifier: Apache-2.0
"""Helpers of error-state filters: discretisation, injection of attitude errors, reset, Jacobians.

Sources: C. F. Van Loan, "Computing integrals involving the matrix exponential" (1978); Sola, "Quaternion
kinematics for the error-state Kalman filter" (2017), 4.3, 6.2 and 7; Chirikjian, "Stochastic Models,
Information Theory, and Lie Groups" (2012), 10.86 for the Jacobian of SO(3).
"""

import math
from collections.abc import Callable

import numpy as np
from numba import njit

from kalman_core.linear import propagate_covariance
from kalman_core.rotation import quat_from_rotvec, quat_multiply, quat_normalize

# Norm of F·dt below which the series of `discretise` has converged to rounding after _TERMS terms:
# 0.25**13 / 13! = 2e-18.
_SERIES_NORM = 0.25
_TERMS = 13
# Below this angle (rad) the Jacobian's coefficients come from their series, whose next terms are < 1e-16.
_SMALL_ANGLE = 1e-3


@njit(cache=True, nogil=True)
def _matmul(A, B):
    """Return ``A @ B`` for square matrices of any layout, skipping zeros of A."""
    n = A.shape[0]
    out = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            a = A[i, k]
            if a != 0.0:
                for j in range(n):
                    out[i, j] += a * B[k, j]
    return out


@njit(cache=True, nogil=True)
def discretise(F, W, dt):
    """Return (Phi, Qd) of ``ẋ = F x + w`` over dt (s), exact to rounding.

    F (n, n) is constant over dt, W (n, n) the spectral density of w (unit² /s, that is ``G q Gᵀ``).
    ``Phi = exp(F dt)`` and ``Qd = ∫ exp(F s) W exp(F s)ᵀ ds``, Van Loan's pair, computed by the series of
    both over dt/2ᵏ and k doublings, which keeps Qd positive semi-definite and never forms exp(-F dt).
    """
    n = F.shape[0]
    norm = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(F[i, j])
        norm = max(norm, row * abs(dt))
    doublings = 0
    step = dt
    while norm > _SERIES_NORM and doublings < 60:
        norm *= 0.5
        step *= 0.5
        doublings += 1
    Phi = np.eye(n)
    power = np.eye(n)
    term = W * step
    Qd = term.copy()
    for k in range(1, _TERMS):
        power = _matmul(F, power) * (step / k)
        Phi += power
        product = _matmul(F, term)
        term = (product + product.T) * (step / (k + 1))
        Qd += term
    for _ in range(doublings):
        grown = Qd.copy()
        propagate_covariance(grown, Phi, Qd)
        Qd = grown
        Phi = _matmul(Phi, Phi)
    return Phi, Qd


@njit(cache=True, nogil=True)
def discretise_second_order(F, W, dt):
    """Return (Phi, Qd) as `discretise` does, to second order in dt: the cheap choice at high rates.

    ``Phi = I + F dt + ½ F² dt²`` and ``Qd = ½ dt (Phi W Phiᵀ + W)``, the trapezoidal rule; the errors are
    O(dt³), and Qd is positive semi-definite for any dt.
    """
    n = F.shape[0]
    Phi = _matmul(F, F) * (0.5 * dt * dt)
    for i in range(n):
        for j in range(n):
            Phi[i, j] += F[i, j] * dt
        Phi[i, i] += 1.0
    half = W * (0.5 * dt)
    Qd = half.copy()
    propagate_covariance(Qd, Phi, half)
    return Phi, Qd


@njit(cache=True, nogil=True)
def left_jacobian(rotvec):
    """Return the left Jacobian J (3, 3) of SO(3): ``exp(v + d) = exp(J(v) d) exp(v)`` to first order in d.

    The right Jacobian, for errors in the body frame, is ``left_jacobian(-v)``.
    """
    x, y, z = rotvec[0], rotvec[1], rotvec[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < _SMALL_ANGLE:
        a = 0.5 - square / 24.0
        b = 1.0 / 6.0 - square / 120.0
    else:
        a = 2.0 * math.sin(0.5 * angle) ** 2 / square  # 1 - cos would cancel
        b = (angle - math.sin(angle)) / (square * angle)
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[2, 2] = 1.0 - b * (x * x + y * y)
    out[0, 1] = b * x * y - a * z
    out[1, 0] = b * x * y + a * z
    out[0, 2] = b * x * z + a * y
    out[2, 0] = b * x * z - a * y
    out[1, 2] = b * y * z - a * x
    out[2, 1] = b * y * z + a * x
    return out


@njit(cache=True, nogil=True)
def inject_attitude(q, error_n):
    """Return ``exp(error_n) * q``, normalised: the attitude error (3,) [rad] lies in the level frame."""
    return quat_normalize(quat_multiply(quat_from_rotvec(error_n), q))


@njit(cache=True, nogil=True)
def inject_attitude_body(q, error_b):
    """Return ``q * exp(error_b)``, normalised: the attitude error (3,) [rad] lies in the body frame."""
    return quat_normalize(quat_multiply(q, quat_from_rotvec(error_b)))


@njit(cache=True, nogil=True)
def reset_covariance(P, error, start):
    """Move P (n, n) in place to the error that remains after `error` (3,) [rad] was injected.

    The attitude error occupies ``P[start:start+3]`` and lies in the level frame (`inject_attitude`); for a
    body-frame error pass ``-error``. To first order the remaining error is ``J(error) (δ - error)``.
    """
    n = P.shape[0]
    G = np.eye(n)
    J = left_jacobian(error)
    for i in range(3):
        for j in range(3):
            G[start + i, start + j] = J[i, j]
    propagate_covariance(P, G, np.zeros((n, n)))


def numerical_jacobian(function: Callable[[np.ndarray], np.ndarray], x, step: float = 1e-6) -> np.ndarray:
    """Return the Jacobian (m, n) of `function` at x (n,) by central differences of `step`.

    For tests and for models without closed-form derivatives; the error is O(step²) plus rounding / step.
    """
    x = np.asarray(x, dtype=np.float64)
    columns = []
    for i in range(x.size):
        offset = np.zeros(x.size)
        offset[i] = step
        high = np.asarray(function(x + offset), dtype=np.float64)
        low = np.asarray(function(x - offset), dtype=np.float64)
        columns.append(np.atleast_1d(high - low) / (2.0 * step))
    return np.stack(columns, axis=-1)
