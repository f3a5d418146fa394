# SPDX-License-Identifier: Apache-2.0
"""The navigation filter behind event-time order: samples may arrive late and in any order."""

from __future__ import annotations

from typing import Any

import numpy as np

from ins_gps.constants import SYSTEM_LETTERS
from ins_gps.fates import fate_of
from ins_gps.filter import NANOSECONDS, NavigationFilter
from ins_gps.fix import protection_level
from ins_gps.params import FilterParams
from ins_gps.samples import (
    OBSERVATION_COLUMNS,
    BiasEstimate,
    Corrections,
    GnssEpoch,
    ImuSample,
    NavigationEstimate,
    PositionSample,
    SettledEstimate,
    VelocitySample,
)
from kalman_core.event_time import EventTimeBuffer
from kalman_core.health import Tally

_PORTS = ('imu/data_raw', 'gnss/corrections', 'gnss/observations', 'gnss/fix', 'gnss/velocity')


class InsGpsEstimator:
    """What the node, the offline runner and the tests drive; handlers never raise for bad samples."""

    def __init__(self, params: FilterParams) -> None:
        self.tally = Tally()
        self.navigation = NavigationFilter(params, self.tally)
        self._biases: BiasEstimate | None = None
        window = round(params.event_window * NANOSECONDS)
        self._buffer = EventTimeBuffer(self, _PORTS, self.tally, window=window)
        self._apply = (
            self.navigation.imu,
            self.navigation.corrections,
            self.navigation.gnss,
            self.navigation.position,
            self.navigation.velocity,
        )

    @property
    def state(self) -> np.ndarray:
        """The flat array that holds everything that changes."""
        return self.navigation.state

    def apply(self, port: int, sample: Any) -> Any:
        """Use one sample in its turn (called by the event-time buffer)."""
        return self._apply[port](sample)

    def reset(self) -> None:
        """Start anew."""
        self._buffer.clear()
        self.navigation.reset()

    def _feed(self, port: int, sample: Any) -> list[Any] | None:
        prompt, settled = self._buffer.feed(port, sample)
        if prompt is None and not settled:
            return None
        out = [] if prompt is None else [prompt]
        out.extend(SettledEstimate(*e) for e in settled if type(e) is NavigationEstimate)
        return out

    def on_imu(self, sample: ImuSample) -> list[Any] | None:
        """Return the prompt estimate and those that have settled."""
        return self._feed(0, sample)

    def on_corrections(self, sample: Corrections) -> list[Any] | None:
        """Keep DGPS corrections."""
        return self._feed(1, sample)

    def on_gnss(self, sample: GnssEpoch) -> list[Any] | None:
        """Use an epoch; return the position fix and the sensor biases."""
        if sample.rows.ndim != 2 or sample.rows.shape[1] != OBSERVATION_COLUMNS:
            self.tally.reject('gnss/observations', 'wrong layout')
            return None
        out = self._feed(2, sample)
        if out:
            out.append(self.navigation.biases(sample.stamp))
            if self.navigation.params.mode == 'gps' or self.navigation.coasting:
                out.append(self.navigation.estimate(sample.stamp))
        return out

    def on_position(self, sample: PositionSample) -> list[Any] | None:
        """Use a fix from elsewhere."""
        return self._feed(3, sample)

    def on_velocity(self, sample: VelocitySample) -> list[Any] | None:
        """Use a velocity from elsewhere."""
        return self._feed(4, sample)

    def diagnostics(self) -> dict[str, Any]:
        """Return mode, integrity and one entry per satellite: elevation weight, residuals in σ, fate."""
        navigation = self.navigation
        values: dict[str, Any] = {'mode': navigation.params.mode, 'running': navigation.running}
        values['waiting for an attitude'] = navigation.coasting
        if not (navigation.running or navigation.coasting):
            return values
        sigma = np.sqrt(np.maximum(np.diag(navigation.covariance)[:3], 0.0))
        values['horizontal protection level (m)'] = protection_level(float(np.hypot(sigma[0], sigma[1])))
        values['vertical protection level (m)'] = protection_level(float(sigma[2]))
        for row, report in zip(navigation.rows, navigation.report, strict=True):
            name = f'{SYSTEM_LETTERS[int(row[0])]}{int(row[1]):02d} band {int(row[2])}'
            values[name] = fate_of(report)
        return values


def warm() -> None:
    """Compile or load all kernels by a short simulated run."""
    from ins_gps.simulation import Scenario
    from ins_gps.simulation_gnss import simulate

    run = simulate(Scenario(duration=3.0, imu_rate=10.0), 0)
    for mode in ('tight_tdcp', 'loose'):
        estimator = InsGpsEstimator(FilterParams(mode=mode, alignment='given', channels=8))
        estimator.on_gnss(run.epochs[0])
        for sample in run.imu_samples():
            estimator.on_imu(sample)
        estimator.on_gnss(run.epochs[1])
        estimator.on_gnss(run.epochs[2])
