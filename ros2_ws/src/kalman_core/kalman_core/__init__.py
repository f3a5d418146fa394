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

The names below are the public interface; each is loaded from its module on first use, so that importing the
package costs nothing. ``from kalman_core.linear import correct`` does the same and is what kernels do.
"""

from importlib import import_module
from typing import Any

_PUBLIC = {
    'consistency': 'anees chi2_band nees nis whiteness',
    'earth': 'ecef_from_enu ecef_from_geodetic ecef_from_geodetic_series earth_rate_ned enu_from_ecef '
    'geodetic_from_ecef geodetic_from_ecef_series gravity mat_ecef_from_enu mat_ecef_from_ned radii '
    'swap_ned_enu transport_rate_ned',
    'error_state': 'discretise discretise_second_order inject_attitude inject_attitude_body left_jacobian '
    'numerical_jacobian reset_covariance',
    'event_time': 'EventTimeBuffer Model',
    'gates': 'GATES chi2_gate chi2_gates chi2_tail',
    'health': 'SensorTally Tally',
    'linear': 'Filtered cholesky cholesky_solve correct correct_scalar correct_sequential filter_series '
    'innovation_covariance normalized_square predict propagate_covariance symmetrize update update_scalar',
    'noise': 'allan_deviation flicker gauss_markov quantise random_walk white',
    'parameters': 'ParameterError allowed build coerce default_yaml markdown_table parameter',
    'rotation': 'cross euler_from_quat matrix_from_quat quat_conjugate quat_from_euler quat_from_matrix '
    'quat_from_rotvec quat_multiply quat_normalize quat_rotate quat_rotate_inverse rotvec_from_quat skew '
    'wrap wrap_array',
    'smoother': 'Smoothed rts smoother_step',
}
_MODULE_OF = {name: module for module, names in _PUBLIC.items() for name in names.split()}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(f'{__name__}.{_MODULE_OF[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names besides those already loaded."""
    return sorted({*globals(), *_MODULE_OF})
