# SPDX-License-Identifier: Apache-2.0
"""Parameters of the roll analysis."""

from __future__ import annotations

from dataclasses import dataclass

from kalman_core.parameters import parameter


@dataclass(frozen=True)
class RollParams:
    """Roll period and amplitudes after MSC.363(92), spectrum and warnings beside them."""

    hysteresis: float = parameter(
        0.3,
        'crossing of the mean heel that ends a half cycle',
        unit='°',
        minimum=0.01,
        maximum=5.0,
        live=True,
    )
    no_roll: float = parameter(
        0.5, 'amplitude about the mean heel below which there is no roll', unit='°', minimum=0.05, live=True
    )
    longest_period: float = parameter(45.0, 'longest roll period', unit='s', minimum=5.0, maximum=120.0)
    list_time: float = parameter(
        60.0, 'time constant of the mean heel', unit='s', minimum=10.0, maximum=3600.0
    )
    output_rate: float = parameter(5.0, 'rate of the output', unit='Hz', minimum=1.0, maximum=50.0)
    spectrum_time: float = parameter(
        300.0, 'length of the record behind the spectral period', unit='s', minimum=60.0, maximum=1800.0
    )
    natural_period: float = parameter(
        0.0,
        "ship's natural roll period, 0: unknown, no synchronous warning",
        unit='s',
        minimum=0.0,
        live=True,
    )
    warning_amplitude: float = parameter(
        5.0,
        'roll amplitude from which resonance is warned of',
        unit='°',
        minimum=0.5,
        maximum=45.0,
        live=True,
    )
    period_tolerance: float = parameter(
        0.1, 'relative difference of periods that counts as equal', minimum=0.01, maximum=0.5, live=True
    )
