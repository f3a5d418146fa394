# SPDX-License-Identifier: Apache-2.0
"""Keeps what the joint filter has learned of the wheels from one drive to the next."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import replace
from pathlib import Path

from ev_velocity.params import VelocityParams
from ev_velocity.velocity import CALIBRATED, VelocityEstimator
from kalman_core.parameters import ParameterError, build

# Between drives pressure and load change the rolling radius by about this much.
AGEING_SIGMA = 0.001


def load(params: VelocityParams) -> VelocityParams:
    """Return `params` with the start values of its calibration file; as they are if there is none yet.

    Raises ParameterError naming the file for one that cannot be used.
    """
    if not params.calibration_file:
        return params
    path = Path(params.calibration_file).expanduser()
    try:
        values = json.loads(path.read_text(encoding='utf-8'))
        chosen = {name: values[name] for name in CALIBRATED}
    except FileNotFoundError:
        return params
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ParameterError(
            f"calibration_file '{path}': {error!r}, expected JSON with {CALIBRATED}"
        ) from None
    try:
        build(VelocityParams, chosen)
    except ParameterError as error:
        raise ParameterError(f"calibration_file '{path}': {error}") from None
    sigma = (chosen['scale_sigma'] ** 2 + AGEING_SIGMA**2) ** 0.5
    return replace(params, **{**chosen, 'scale_sigma': sigma})


def save(estimator: VelocityEstimator) -> bool:
    """Write what was learned to the estimator's calibration file; False when there is nothing to write.

    Only what is known better than at the start is written: a short drive does not spoil a good file. Raises
    ParameterError for what `load` would refuse, as of a wheel far from `wheel_radius`.
    """
    params = estimator.params
    learned = estimator.learned()
    if not params.calibration_file or learned['scale_sigma'] >= params.scale_sigma:
        return False
    path = Path(params.calibration_file).expanduser()
    try:
        build(VelocityParams, learned)
    except ParameterError as error:
        raise ParameterError(f"calibration_file '{path}': learned {error}") from None
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name)
    try:
        with os.fdopen(handle, 'w', encoding='utf-8') as file:
            json.dump(learned, file, indent=1)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    return True


def calibrated(params: VelocityParams) -> VelocityEstimator:
    """Return the estimator that starts from its calibration file."""
    return VelocityEstimator(load(params))
