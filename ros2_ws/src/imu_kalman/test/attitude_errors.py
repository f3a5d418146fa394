# SPDX-License-Identifier: Apache-2.0
"""Errors of attitudes in tests: the metric of the recorded trials."""

import numpy as np
from scipy.spatial.transform import Rotation


def rotation(quat):
    return Rotation.from_quat(quat, scalar_first=True)


def errors(found, true):
    """Total, heading and inclination error in degrees (metric of the recorded trials)."""
    d = (rotation(found) * rotation(true).inv()).as_quat(scalar_first=True)
    total = 2 * np.arccos(np.clip(np.abs(d[:, 0]), 0, 1))
    heading = 2 * np.arctan2(np.abs(d[:, 3]), np.abs(d[:, 0]))
    inclination = 2 * np.arccos(np.clip(np.hypot(d[:, 0], d[:, 3]), 0, 1))
    return np.degrees(np.stack([total, heading, inclination], axis=1))


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))
