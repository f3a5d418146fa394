# SPDX-License-Identifier: Apache-2.0
"""Parameters to the array that the kernels read."""

from __future__ import annotations

import math

import numpy as np

from ins_gps import channels as ch
from ins_gps.params import FilterParams
from ins_gps.prediction import CONFIG_PREDICTION
from kalman_core.gates import chi2_gate

_RATES = {'tight_doppler': 1.0, 'tight_tdcp': 2.0}


def config_array(params: FilterParams) -> np.ndarray:
    """Return the kernels' configuration: columns as declared in `prediction` and `channels`."""
    full = params.states == 'full'
    rates = _RATES.get(params.mode, 0.0)
    if rates == 2.0 and not full:
        rates = 3.0
    x, y, z = params.lever_arm
    values = [
        params.gyro_noise**2,
        params.accel_noise**2,
        params.gyro_bias_walk**2,
        params.accel_bias_walk**2,
        params.clock_walk**2,
        params.drift_walk**2,
        params.covariance_step,
        params.imu_gap,
        params.gap_force,
        params.gap_rate,
        float(full),
        float(full),
        float(full and params.vibration),
        params.code_noise,
        params.code_slow,
        params.code_slow_alone,
        params.code_multipath,
        params.multipath_time,
        params.carrier_noise,
        params.carrier_walk,
        params.doppler_noise,
        x,
        -y,
        -z,
        params.elevation_mask,
        chi2_gate(1, params.gate_probability) if full else math.inf,  # the paper has no gates
        rates,
        float(params.elevation_weighting),
        params.correction_age,
        float(params.rate_correction),
        float(full),
        params.lost_time,
        params.cn0_reference,
        params.published_rate_noise,
        params.carrier_interval,
        chi2_gate(1, params.drift_probability),
        params.code_band,
        params.code_band_common,
    ]
    assert len(values) == ch.CONFIG_SIZE
    assert values[CONFIG_PREDICTION] == params.code_noise
    return np.array(values)
