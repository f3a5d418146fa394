# SPDX-License-Identifier: Apache-2.0
"""The paper's filter behind `schedule: published`, driven in event time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalman_core.event_time import NANOSECONDS
from kalman_core.health import Tally
from ship_inclinometer import published_kernels as k
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.samples import DEGRADED, INVALID, Attitude
from ship_inclinometer.topics import GNSS, IMU, LOG, MAG

_MAG_AGE = 5.0  # s


def settings(p: AttitudeParams) -> np.ndarray:
    """Return the array (SETTINGS,) that the kernels read, in SI units."""
    c = np.zeros(k.SETTINGS)
    c[k.GYRO_NOISE] = math.radians(p.gyro_noise) / math.sqrt(2.0)
    c[k.BIAS_WALK] = math.radians(p.gyro_bias_walk)
    c[k.BIAS_SIGMA] = math.radians(p.gyro_bias_sigma)
    c[k.FORCE_SIGMA] = p.published_force_sigma
    c[k.FIELD_SIGMA] = p.published_field_sigma
    c[k.INTERVAL] = p.published_interval
    c[k.CUTOFF] = p.published_cutoff
    c[k.DIP] = math.radians(p.field_dip)
    c[k.DECLINATION] = math.radians(p.declination)
    c[k.INSTANT] = float(p.published_transition == 'instant')
    return c


class PublishedModel:
    """Owns the flat state of `published_kernels`."""

    def __init__(self, params: AttitudeParams, tally: Tally) -> None:
        self._params = params
        self._tally = tally
        self._settings = settings(params)
        self._origin: int | None = None
        self.state = np.zeros(k.SIZE)
        self._covariance = self.state[k.COV :].reshape(6, 6)

    def reset(self) -> None:
        """Return to the empty state."""
        self.state[:] = 0.0
        self._origin = None

    def apply(self, port: int, sample: Any) -> Attitude | None:
        """Advance to the sample and use it; called by the event-time buffer."""
        if port >= 2:
            self._tally.reject((GNSS, LOG)[port - 2], 'not used by the published schedule')
            return None
        if self._origin is None:
            self._origin = sample.stamp
        # The kernels take 0 for "never": time starts at 1 s.
        t = 1.0 + (sample.stamp - self._origin) / NANOSECONDS
        state = self.state
        if port == 1:
            k.published_mag(state, self._settings, t, np.array(sample.field))
            self._tally.accept(MAG, sample.stamp)
            return None
        gyro, force = np.array(sample.gyro), np.array(sample.force)
        gap = t - state[k.T]
        if state[k.STARTED] > 0.0 and gap > self._params.stale_time:
            state[:] = 0.0
            if not self._tally.muted:
                self._tally.restart(f'no IMU sample for {gap:.2f} s')
        nis = k.published_imu(state, self._settings, t, gyro, force)
        if not np.isfinite(np.sum(state)):
            state[:] = 0.0
            if not self._tally.muted:
                self._tally.restart('not finite')
        self._tally.accept(IMU, sample.stamp, nis if nis >= 0.0 else None)
        if state[k.STARTED] < 2.0:
            return None
        return Attitude(
            sample.stamp,
            sample.frame,
            state[k.Q : k.Q + 4].copy(),
            gyro - state[k.BIAS : k.BIAS + 3],
            force,
            self._covariance[:3, :3].copy(),
            self.validity()[0],
        )

    def validity(self) -> tuple[int, str, bool]:
        """Return (validity, reason, whether the heading may be trusted)."""
        state = self.state
        if state[k.STARTED] < 2.0:
            return INVALID, 'aligning', False
        heading = state[k.FIELD_SEEN] > 0.0 and state[k.T] - state[k.FIELD_SEEN] < _MAG_AGE
        limit = math.radians(self._params.valid_sigma)
        if max(self._covariance[0, 0], self._covariance[1, 1]) > limit * limit:
            return DEGRADED, 'tilt uncertain', bool(heading)
        if not heading:
            return DEGRADED, 'no magnetic heading', False
        # Its covariance takes sway for white noise: never to be trusted like the inertial filter's.
        return DEGRADED, 'sway not modelled', True

    def diagnostics(self) -> dict[str, Any]:
        """Return the validity and the gyro bias."""
        validity, reason, _ = self.validity()
        bias = self.state[k.BIAS : k.BIAS + 3]
        return {
            'level': (b'\x00', b'\x01', b'\x02')[validity],
            'message': reason or 'valid',
            'gyro_bias_deg_s': ' '.join(f'{math.degrees(b):.4f}' for b in bias),
        }
