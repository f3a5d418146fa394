# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys

import numpy as np

from kalman_core import earth, error_state, linear, rotation, smoother

# What each kernel makes of fixed inputs, as bytes; run once here and once without the compiler.
SCRIPT = 'from test_without_jit import fingerprint; print(fingerprint())'


def fingerprint():
    rng = np.random.default_rng(1)
    F = 0.3 * rng.standard_normal((5, 5))
    A = rng.standard_normal((5, 5))
    Q, H, R = A @ A.T, rng.standard_normal((2, 5)), np.diag([0.3, 0.7])
    filtered = linear.filter_series(np.zeros(5), np.eye(5), rng.standard_normal((20, 2)), F, Q, H, R)
    smoothed = smoother.rts(filtered, F, Q)
    x, P = filtered.x[-1].copy(), filtered.P[-1].copy()
    linear.correct_sequential(x, P, rng.standard_normal(2), H, np.diag(R).copy(), np.inf)
    error_state.reset_covariance(P, np.array([0.1, 0.2, -0.3]), 1)
    q = rotation.quat_from_rotvec(np.array([0.4, -1.2, 0.3]))
    parts = [*filtered, *smoothed, x, P, *error_state.discretise(F, Q, 0.3)]
    parts += [*error_state.discretise_second_order(F, Q, 0.3), q, rotation.matrix_from_quat(q)]
    parts += [rotation.quat_rotate(q, x[:3]), rotation.quat_multiply(q, rotation.quat_conjugate(q))]
    parts += [np.array(rotation.euler_from_quat(q)), np.array(earth.geodetic_from_ecef(1e6 * x[:3] + 4e6))]
    return ' '.join(np.asarray(part, dtype=np.float64).tobytes().hex() for part in parts)


def test_every_kernel_gives_the_same_bits_without_the_compiler():
    environment = {**os.environ, 'NUMBA_DISABLE_JIT': '1'}
    folder = os.path.dirname(__file__)
    path = os.pathsep.join([folder, *filter(None, [environment.get('PYTHONPATH')])])
    done = subprocess.run(
        [sys.executable, '-c', SCRIPT],
        env={**environment, 'PYTHONPATH': path},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == fingerprint()
