# SPDX-License-Identifier: Apache-2.0
"""Kalman filter numerics without ROS, and the notation that all packages share.

Frames, one letter each: ``e`` Earth-centred Earth-fixed, ``i`` inertial, ``n`` local level (ENU in
ROS messages; NED inside ``ins_gps``, said in each module), ``b`` body (x forward, y left, z up).

``vec_n``
    a vector with components in ``n``.
``mat_nb``, ``q_nb``
    rotates components from ``b`` to ``n``: ``vec_n = mat_nb @ vec_b``. Quaternions are Hamilton, ordered
    (w, x, y, z), unit norm; messages carry (x, y, z, w) and only codecs convert.
Attitude error
    a rotation vector in the local-level frame, ``q_true = exp(error_n) * q_estimate`` unless a module
    says otherwise.
Units
    rad, rad/s, m, m/s, m/s², s; stamps are ``int`` nanoseconds.
Specific force
    what an accelerometer measures: acceleration minus gravity, +g upwards at rest.
Noise
    white noise as root power spectral density (rad/s/√Hz, m/s²/√Hz); a bias as σ and random-walk density.
Covariance
    of the *error* ``estimate − truth``.
Innovation
    ``measurement − prediction``; ``S`` is its covariance, NIS = innovationᵀ S⁻¹ innovation.

Kernels are ``numba.njit(cache=True, nogil=True)`` functions over arrays and scalars. A streaming class and
a batch function call the same kernel.
"""
