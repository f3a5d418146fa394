# SPDX-License-Identifier: Apache-2.0
"""Keeps what the joint filter has learned of the wheels from one drive to the next."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import replace
from pathlib import Path

from ev_velocity.params import VelocityParams
from ev_velocity.velocity import VelocityEstimator
from kalman_core.parameters import ParameterError, build

# Between drives pressure and load change the rolling radius by about this much.
AGEING_SIGMA = 0.001
NAMES = ('scale', 'scale_sigma', 'slip', 'slip_sigma')


def load(params: VelocityParams) -> VelocityParams:
    """Return `params` with the start values of its calibration file; as they are if there is none yet.

    Raises ParameterError naming the file for one that cannot be used.
    """
    if not params.calibration_file:
        return params
    path = Path(params.calibration_file).expanduser()
    try:
        values = json.loads(path.read_text(encoding='utf-8'))
        chosen = {name: values[name] for name in NAMES}
    except FileNotFoundError:
        return params
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ParameterError(f"calibration_file '{path}': {error!r}, expected JSON with {NAMES}") from None
    try:
        build(VelocityParams, chosen)
    except ParameterError as error:
        raise ParameterError(f"calibration_file '{path}': {error}") from None
    sigma = (chosen['scale_sigma'] ** 2 + AGEING_SIGMA**2) ** 0.5
    return replace(params, **{**chosen, 'scale_sigma': sigma})


def save(estimator: VelocityEstimator) -> bool:
    """Write what was learned to the estimator's calibration file; False when there is nothing to write.

    Only what is known better than at the start is written: a short drive does not spoil a good file.
    """
    params = estimator.params
    learned = estimator.learned()
    if not params.calibration_file or learned['scale_sigma'] >= params.scale_sigma:
        return False
    path = Path(params.calibration_file).expanduser()
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
