# SPDX-License-Identifier: Apache-2.0
"""The navigation filter: start, prediction and the five couplings over one flat state array.

Level frame NED, body forward-right-down. Nothing here knows of ROS or of the order of arrival;
`estimator` adds both.
"""

from __future__ import annotations

import math

import numpy as np

from ins_gps import channels as ch
from ins_gps import layout as at
from ins_gps.carrier import remember_carrier
from ins_gps.configuration import config_array
from ins_gps.constraints import non_holonomic_update, zero_velocity_update
from ins_gps.fates import count_rows
from ins_gps.gnss_update import gnss_epoch
from ins_gps.lasting import Lasting, add_rows, age_errors, errors_elsewhere, start_errors
from ins_gps.loose import EpochFix, epoch_fix, ned_covariance, vector_update
from ins_gps.params import FilterParams
from ins_gps.plausibility import imu_fault, navigation_fault, plausible_rows, valid_satellites
from ins_gps.prediction import advance_covariance, covariance_of, hold_to, imu_step
from ins_gps.samples import (
    BiasEstimate,
    Corrections,
    FixEstimate,
    GnssEpoch,
    ImuSample,
    NavigationEstimate,
    PositionSample,
    VelocitySample,
)
from ins_gps.start import (
    PRIOR_VELOCITY,
    average_sample,
    coasting_config,
    fix_estimate,
    hold_still,
    leave_antenna,
    position_rows,
    start_attitude,
    start_velocity,
)
from kalman_core.earth import ecef_from_geodetic, enu_from_ecef, mat_ecef_from_ned
from kalman_core.gates import chi2_gate
from kalman_core.health import Tally
from kalman_core.rotation import matrix_from_quat

NANOSECONDS = 1_000_000_000
_GATE_POSITION = chi2_gate(3, 1e-6)
_PRIOR_POSITION = 100.0  # m, so that the first epoch's codes decide
_PRIOR_CLOCK = 1_000.0  # m
_UNKNOWN_RATE = 1.0  # rad/s, of a craft without IMU
_PRIOR_DRIFT = 1_000.0  # m/s: 3 ppm of an oscillator
_PRIOR_INTERSYSTEM = 100.0  # m
# A velocity whose σ (m/s) is larger says nothing of the acceleration since.
_KNOWN_VELOCITY = 3.0
_GRAVITY = 9.8  # m/s²
# Velocities further apart (s) say nothing of the acceleration that the averaged force contains.
_LEVEL_INTERVAL = 2.5
MAX_STEP = 10.0  # s: a longer silence of the IMU ends the solution


class NavigationFilter:
    """Error-state filter; everything that changes lies in `state`.

    Use it in time order: `imu`, `gnss`, `corrections`, `position`, `velocity`; each takes one sample. It
    starts by itself from the first fix (see `FilterParams.alignment`) or by `initialise`. `copies`: see
    `layout.state_size`.
    """

    def __init__(self, params: FilterParams, tally: Tally | None = None, copies: int = 0) -> None:
        self.params = params
        self.tally = tally if tally is not None else Tally()
        self.channels = params.channels
        self.config = config_array(params)
        self._coasting_config = coasting_config(self.config)
        self.state = np.zeros(at.state_size(self.channels, copies))
        self.report = np.zeros((0, ch.REPORT_WIDTH))
        self.summary = np.zeros(ch.SUMMARY)
        self.rows = np.zeros((0, 19))
        self.reset()

    def reset(self) -> None:
        """Return to the state before the first sample, in place."""
        self.state[:] = 0.0
        lat, lon, height = self.params.origin
        if (lat, lon, height) != (0.0, 0.0, 0.0):
            self.state[at.ORIGIN : at.ORIGIN + 3] = math.radians(lat), math.radians(lon), height
            self.state[at.HAVE_ORIGIN] = 1.0

    @property
    def running(self) -> bool:
        """Whether there is a solution."""
        return self.state[at.STAGE] == at.RUNNING

    @property
    def coasting(self) -> bool:
        """Whether position and velocity follow GNSS alone until an attitude is known."""
        return self.state[at.STAGE] == at.COASTING

    @property
    def nav(self) -> np.ndarray:
        """View of latitude, longitude (rad), height (m), velocity (m/s, NED), q_nb."""
        return self.state[at.NAVIGATION : at.NAVIGATION + 10]

    @property
    def covariance(self) -> np.ndarray:
        """View of the error covariance (n, n), order of `layout`."""
        return covariance_of(self.state, self.channels)

    def initialise(self, stamp: int, nav, sigmas, clock=(0.0, 0.0), clock_sigmas=None) -> None:
        """Start from a known solution: nav (10,), sigmas (9,) of position, velocity (m, m/s, NED), attitude.

        clock: bias (m) and drift (m/s); `clock_sigmas` None: as good as unknown.
        """
        s, p = self.state, self.params
        self.nav[:] = nav
        s[at.ACC_BIAS : at.GYR_BIAS + 3] = 0.0
        s[at.CLOCK], s[at.CLOCK_DRIFT] = clock
        s[at.SPAN : at.SPAN_FORCE + 3] = 0.0
        s[at.CLONE_VALID] = s[at.LOST] = s[at.INTERSYSTEM] = s[at.HELD] = 0.0
        s[at.FIX_ERROR : at.FIX_SPREAD + 1] = 0.0
        s[at.SEC], s[at.NSEC] = divmod(stamp, NANOSECONDS)
        P = self.covariance
        P[:] = 0.0
        full = self.config[ch.CLONES] > 0.0
        diagonal = np.zeros(len(P))
        diagonal[:9] = np.asarray(sigmas) ** 2
        if full:
            diagonal[at.ACC : at.ACC + 3] = p.accel_bias_sigma**2
            diagonal[at.GYR : at.GYR + 3] = p.gyro_bias_sigma**2
        bias_sigma, drift_sigma = clock_sigmas or (_PRIOR_CLOCK, _PRIOR_DRIFT)
        diagonal[at.CLK] = bias_sigma**2
        if full:
            diagonal[at.DRIFT] = drift_sigma**2
        else:
            s[at.CLOCK_DRIFT] = 0.0
        diagonal[at.ISB] = _PRIOR_INTERSYSTEM**2
        np.fill_diagonal(P, diagonal)
        for i in range(self.channels):
            s[at.HEAD + i * at.CHANNEL_WIDTH] = 0.0
        if s[at.HAVE_ORIGIN] == 0.0:
            s[at.ORIGIN : at.ORIGIN + 3] = nav[:3]
            s[at.HAVE_ORIGIN] = 1.0
        s[at.STAGE] = at.RUNNING

    def imu(self, sample: ImuSample) -> NavigationEstimate | None:
        """Advance to the sample's stamp; None before there is a solution."""
        s = self.state
        sec, nsec = divmod(sample.stamp, NANOSECONDS)
        fault = imu_fault(sample)
        if fault:
            self.tally.reject('imu/data_raw', fault)
            return None
        if s[at.IMU_SEC] > 0.0 and sample.stamp <= _stamp(s[at.IMU_SEC], s[at.IMU_NSEC]):
            self.tally.reject('imu/data_raw', 'not newer than the last')
            return None
        average_sample(s, sample, sec, nsec)
        if s[at.IMU_SEC] > 0.0:
            s[at.IMU_STEP] = (sec - s[at.IMU_SEC]) + (nsec - s[at.IMU_NSEC]) * 1e-9
        s[at.IMU_SEC], s[at.IMU_NSEC] = sec, nsec
        self.tally.accept('imu/data_raw', sample.stamp)
        if not self.running or self.params.mode == 'gps':
            return None
        if sample.stamp - _stamp(s[at.SEC], s[at.NSEC]) > MAX_STEP * NANOSECONDS:
            self.tally.restart('no IMU for more than 10 s')
            s[at.STAGE] = at.WAITING
            return None
        imu_step(s, self.channels, self.config, sample.rate, sample.force, sec, nsec)
        self._constrain(sample.stamp)
        return self.estimate(sample.stamp)

    def _constrain(self, stamp: int) -> None:
        p = self.params
        if p.zero_velocity:
            used = zero_velocity_update(self.state, self.channels, self.config, p.zero_velocity_sigma)
            if used > 0:
                self.tally.accept('zero velocity', stamp)
        if p.non_holonomic:
            used = non_holonomic_update(self.state, self.channels, self.config, p.non_holonomic_sigma)
            if used > 0:
                self.tally.accept('non-holonomic', stamp)
            elif used < 0:
                self.tally.reject('non-holonomic', 'gate')

    def corrections(self, sample: Corrections) -> None:
        """Keep DGPS corrections until they are too old."""
        sec, nsec = divmod(sample.stamp, NANOSECONDS)
        good = valid_satellites(sample.rows) & np.isfinite(sample.rows[:, 2:4]).all(axis=1)
        ch.store_corrections(self.state, self.channels, sample.rows[good], sec, nsec)
        self.tally.accept('gnss/corrections', sample.stamp)
        for _ in range(int((~good).sum())):
            self.tally.reject('gnss/corrections', 'unknown satellite or not finite')

    def gnss(self, sample: GnssEpoch) -> FixEstimate | None:
        """Use one epoch of observations; None before there is a solution."""
        rows = sample.rows
        good = valid_satellites(rows)
        if not good.all():
            for _ in range(int((~good).sum())):
                self.tally.reject('gnss/observations', 'unknown satellite or signal')
            rows = rows[good]
        rows, implausible = plausible_rows(rows)
        if implausible:
            self.tally.reject('gnss/observations', 'implausible value')
        s = self.state
        sec, nsec = divmod(sample.stamp, NANOSECONDS)
        since = (sec - s[at.EPOCH_SEC]) + (nsec - s[at.EPOCH_NSEC]) * 1e-9 if s[at.HAVE_EPOCH] else 0.0
        if s[at.HAVE_EPOCH] and since <= 0.0:
            self.tally.reject('gnss/observations', 'not newer than the last epoch')
            return None
        self.tally.accept('gnss/observations', sample.stamp)
        if self.params.mode == 'gps':
            return self._gps_only(sample.stamp, rows, since)
        if s[at.STAGE] == at.WAITING:
            self._start(sample.stamp, rows, since)
            if s[at.STAGE] == at.WAITING:
                return None
        if self.coasting:
            hold_still(s)
        mode = self.params.mode
        if mode == 'ins' and self.running:
            hold_to(s, self.channels, self.config, sec, nsec)
            return None
        if mode in ('ins', 'loose'):
            self._loose(sample.stamp, rows, since)
        else:
            self._tight(sample.stamp, rows)
        self._align(since)
        return fix_estimate(sample.stamp, self.nav, self.covariance)

    @property
    def _prediction(self) -> np.ndarray:
        return self._coasting_config if self.coasting else self.config

    def _align(self, since: float) -> None:
        """End coasting once the attitude can be known; `since` (s): the interval of velocities."""
        if not self.coasting:
            return
        P, p = self.covariance, self.params
        sigma = math.sqrt(max(P[at.VEL, at.VEL] + P[at.VEL + 1, at.VEL + 1], 0.0))
        before = self.state[at.BEFORE_VELOCITY : at.BEFORE_VELOCITY + 3]
        acceleration, tilt = np.zeros(3), 0.0
        if 0.0 < since < _LEVEL_INTERVAL:
            measured = bool(before.any())
            if measured:
                acceleration = (self.nav[3:6] - before) / since
                tilt = math.sqrt(2.0) * sigma / since / _GRAVITY
            before[:] = self.nav[3:6] if sigma < _KNOWN_VELOCITY else 0.0
            if not measured:
                return
        attitude = start_attitude(self.state, p, self.nav[3:6], sigma, acceleration)
        if attitude is None:
            return
        attitude[1][:2] = np.hypot(attitude[1][:2], tilt)
        self.nav[6:10] = attitude[0]
        for start, sigmas in (
            (at.ATT, attitude[1]),
            (at.ACC, np.full(3, p.accel_bias_sigma * self.config[ch.CLONES])),
            (at.GYR, np.full(3, p.gyro_bias_sigma * self.config[ch.CLONES])),
        ):
            P[start : start + 3, :] = 0.0
            P[:, start : start + 3] = 0.0
            P[start : start + 3, start : start + 3] = np.diag(sigmas**2)
        leave_antenna(self.state, self.nav, self.covariance, self.config)
        self.state[at.HAVE_IMU] = self.state[at.HELD] = 0.0
        self.state[at.STAGE] = at.RUNNING

    def _tight(self, stamp: int, rows: np.ndarray) -> None:
        report = np.zeros((len(rows), ch.REPORT_WIDTH))
        summary = self.summary
        sec, nsec = divmod(stamp, NANOSECONDS)
        gnss_epoch(self.state, self.channels, self._prediction, rows, sec, nsec, report, summary)
        self.rows, self.report = rows, report
        if not self.tally.muted:
            count_rows(self.tally, stamp, report, float(self.config[ch.GATE]))
            if summary[ch.SUM_CLOCK_JUMP] != 0.0:
                self.tally.restart(f'receiver clock jumped by {summary[ch.SUM_CLOCK_JUMP]:.0f} m')
        if summary[ch.SUM_RESTART] > 0.0:
            self._restart_position(stamp, rows)

    def _restart_position(self, stamp: int, rows: np.ndarray) -> None:
        fix = epoch_fix(self.state, self.channels, self.config, self.params, rows, 0.0)
        if fix is None:
            return
        if not self.tally.muted:
            self.tally.restart(f'most codes rejected for {self.params.lost_time:g} s: position starts anew')
        # The epochs to come are measurements still: here one only says where.
        self._start_anew(stamp, fix.geodetic, np.eye(3) * _PRIOR_POSITION**2, fix)

    def _start_anew(self, stamp: int, geodetic, covariance, fix: EpochFix | None) -> None:
        """Believe a position (rad, rad, m) with covariance (3, 3) m² NED after all.

        What held on to a false position has hardly the right attitude: it is as doubtful as at a start.
        """
        if self.params.alignment == 'velocity':
            self._start_from(stamp, geodetic, covariance, fix)
            return
        velocity, velocity_sigma = start_velocity(geodetic, fix)
        if fix is None:
            velocity = self.nav[3:6].copy()
        p, attitude = self.params, np.sqrt(np.diag(self.covariance)[at.ATT : at.ATT + 3])
        attitude = np.maximum(attitude, [p.initial_tilt_sigma, p.initial_tilt_sigma, p.initial_yaw_sigma])
        clock = self.state[at.CLOCK] if fix is None else fix.position.clock
        self.initialise(
            stamp,
            np.r_[geodetic, velocity, self.nav[6:10]],
            np.r_[[1.0] * 3, [velocity_sigma] * 3, attitude],
            (clock, self.state[at.CLOCK_DRIFT]),
        )
        self.covariance[at.POS : at.POS + 3, at.POS : at.POS + 3] = covariance
        leave_antenna(self.state, self.nav, self.covariance, self.config)

    def _loose(self, stamp: int, rows: np.ndarray, since: float) -> None:
        s = self.state
        sec, nsec = divmod(stamp, NANOSECONDS)
        hold_to(s, self.channels, self._prediction, sec, nsec)
        start = ecef_from_geodetic(*self.nav[:3])
        fix = epoch_fix(s, self.channels, self.config, self.params, rows, since, start)
        s[at.EPOCH_SEC], s[at.EPOCH_NSEC], s[at.HAVE_EPOCH] = sec, nsec, 1.0
        remember_carrier(s, self.channels, self.config, rows)
        if fix is None:
            self.tally.reject('loose fix', 'no consistent fix')
            return
        sample = PositionSample(stamp, fix.geodetic, ned_covariance(fix.position, fix.geodetic))
        full = self.params.states == 'full'
        self._use_position(sample, 'loose fix', since, fix.lasting if full else (), fix)
        # The paper's loose coupling knows positions only.
        if fix.velocity is not None and full:
            mat = mat_ecef_from_ned(fix.geodetic[0], fix.geodetic[1])
            covariance = mat.T @ fix.velocity.covariance[:3, :3] @ mat
            self._use_velocity(stamp, mat.T @ fix.velocity.position, covariance, 'loose velocity')

    def _use_position(
        self, sample: PositionSample, name: str, since: float, lasting: Lasting, fix=None
    ) -> None:
        """Correct with a position `since` s after the last, of `fix`; if refused for long it is believed."""
        s = self.state
        if s[at.LOST] > self.params.lost_time:
            self._start_anew(sample.stamp, sample.geodetic, sample.covariance, fix)
            start_errors(s, self.channels, sample.covariance, lasting)
            self.tally.accept(name, sample.stamp)
            if not self.tally.muted:
                self.tally.restart(f'{name}: rejected for {self.params.lost_time:g} s, taken again')
            return
        nu, H = position_rows(s, self.nav, self._prediction, len(self.covariance), sample.geodetic)
        white = age_errors(s, self.channels, sample.covariance, since, lasting)
        add_rows(s, H, nu)
        used = self._vector(sample.stamp, H, nu, white, name, _GATE_POSITION)
        s[at.LOST] = 0.0 if used else s[at.LOST] + since

    def _use_velocity(self, stamp: int, velocity, covariance, name: str) -> None:
        s = self.state
        mat_nb = matrix_from_quat(self.nav[6:10])
        now = np.empty(3)
        ch.antenna_velocity(s, self._prediction, mat_nb, np.eye(3), now)
        H = np.zeros((3, len(self.covariance)))
        H[:, at.VEL : at.VEL + 3] = np.eye(3)
        self._vector(stamp, H, velocity - now, covariance, name, _GATE_POSITION)

    def _vector(self, stamp: int, H, nu, covariance, name: str, gate: float) -> bool:
        nis, used = vector_update(self.state, self.channels, H, nu, covariance, gate)
        if used:
            self.tally.accept(name, stamp, nis, _GATE_POSITION)
        else:
            self.tally.reject(name, 'innovation gate')
        return used

    def position(self, sample: PositionSample) -> FixEstimate | None:
        """Use a fix from elsewhere (loose coupling); it also starts the filter."""
        fault = navigation_fault(sample.geodetic, sample.covariance)
        if fault:
            self.tally.reject('gnss/fix', fault)
            return None
        sec, nsec = divmod(sample.stamp, NANOSECONDS)
        s, lasting = self.state, errors_elsewhere(sample.status, self.params)
        since = sec + 1e-9 * nsec - s[at.FIX_SEC] if s[at.FIX_SEC] else 0.0
        s[at.FIX_SEC] = sec + 1e-9 * nsec
        if s[at.STAGE] == at.WAITING:
            self._start_from(sample.stamp, sample.geodetic, sample.covariance, None)
            start_errors(s, self.channels, sample.covariance, lasting)
            return fix_estimate(sample.stamp, self.nav, self.covariance)
        if self.coasting:
            hold_still(s)
        hold_to(s, self.channels, self._prediction, sec, nsec)
        self._use_position(sample, 'gnss/fix', since, lasting)
        self._align(since)
        return fix_estimate(sample.stamp, self.nav, self.covariance)

    def velocity(self, sample: VelocitySample) -> None:
        """Use a velocity from elsewhere."""
        fault = navigation_fault(sample.velocity, sample.covariance)
        if fault:
            self.tally.reject('gnss/velocity', fault)
            return
        s = self.state
        if s[at.STAGE] == at.WAITING:
            self.tally.reject('gnss/velocity', 'no position to start from yet')
            return
        sec, nsec = divmod(sample.stamp, NANOSECONDS)
        if self.coasting:
            hold_still(s)
        hold_to(s, self.channels, self._prediction, sec, nsec)
        # The next fix aligns: it knows the time over which the velocity has changed.
        self._use_velocity(sample.stamp, sample.velocity, sample.covariance, 'gnss/velocity')

    def _gps_only(self, stamp: int, rows: np.ndarray, since: float) -> FixEstimate | None:
        s = self.state
        fix = epoch_fix(s, self.channels, self.config, self.params, rows, since)
        sec, nsec = divmod(stamp, NANOSECONDS)
        s[at.EPOCH_SEC], s[at.EPOCH_NSEC], s[at.HAVE_EPOCH] = sec, nsec, 1.0
        s[at.SEC], s[at.NSEC] = sec, nsec
        if fix is None:
            remember_carrier(s, self.channels, self.config, rows)
            self.tally.reject('loose fix', 'no consistent fix')
            return None
        sigmas = np.full(9, math.pi)  # the attitude is not known
        velocity = np.zeros(3)
        mat = mat_ecef_from_ned(fix.geodetic[0], fix.geodetic[1])
        velocity_covariance = np.eye(3) * PRIOR_VELOCITY**2
        if fix.velocity is not None:
            velocity = mat.T @ fix.velocity.position
            velocity_covariance = mat.T @ fix.velocity.covariance[:3, :3] @ mat
        self.initialise(stamp, np.r_[fix.geodetic, velocity, 1.0, 0.0, 0.0, 0.0], sigmas)
        P = self.covariance
        P[at.POS : at.POS + 3, at.POS : at.POS + 3] = ned_covariance(fix.position, fix.geodetic)
        P[at.VEL : at.VEL + 3, at.VEL : at.VEL + 3] = velocity_covariance
        remember_carrier(s, self.channels, self.config, rows)
        self.tally.accept('loose fix', stamp, fix.position.statistic)
        return fix_estimate(stamp, self.nav, self.covariance)

    def _start(self, stamp: int, rows: np.ndarray, since: float) -> None:
        fix = epoch_fix(self.state, self.channels, self.config, self.params, rows, since)
        s = self.state
        sec, nsec = divmod(stamp, NANOSECONDS)
        if fix is None:
            self.tally.reject('loose fix', 'no consistent fix to start from')
        else:
            # The epoch is used again, as a measurement: here it only says where.
            self._start_from(stamp, fix.geodetic, np.eye(3) * _PRIOR_POSITION**2, fix)
        s[at.EPOCH_SEC], s[at.EPOCH_NSEC], s[at.HAVE_EPOCH] = sec, nsec, 1.0

    def _start_from(self, stamp: int, geodetic, covariance, fix: EpochFix | None) -> None:
        velocity, velocity_sigma = start_velocity(geodetic, fix)
        drift = fix.velocity.clock if fix is not None and fix.velocity is not None else 0.0
        clock = (fix.position.clock if fix is not None else 0.0, drift)
        attitude = None
        if self.params.alignment != 'velocity':  # which needs the acceleration, hence another epoch
            attitude = start_attitude(self.state, self.params, velocity, velocity_sigma)
        self.state[at.BEFORE_VELOCITY : at.BEFORE_VELOCITY + 3] = 0.0
        if attitude is None:
            known, sigmas = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        else:
            known, sigmas = attitude
        self.initialise(
            stamp, np.r_[geodetic, velocity, known], np.r_[[1.0] * 3, [velocity_sigma] * 3, sigmas], clock
        )
        if attitude is None:
            self.covariance[at.ACC : at.GYR + 3, at.ACC : at.GYR + 3] = 0.0
            self.state[at.STAGE] = at.COASTING
        self.covariance[at.POS : at.POS + 3, at.POS : at.POS + 3] = covariance
        if attitude is not None:
            leave_antenna(self.state, self.nav, self.covariance, self.config)

    def estimate(self, stamp: int) -> NavigationEstimate:
        """Return what the filter knows now."""
        s, nav = self.state, self.nav.copy()
        origin = s[at.ORIGIN : at.ORIGIN + 3].copy()
        enu = enu_from_ecef(ecef_from_geodetic(nav[0], nav[1], nav[2]), origin[0], origin[1], origin[2])
        rate, covariance = s[at.RATE : at.RATE + 3].copy(), self.covariance[:9, :9].copy()
        if self.coasting:
            covariance[6:9] = covariance[:, 6:9] = 0.0
            covariance[6:9, 6:9] = np.eye(3) * math.pi**2  # no attitude yet
        bias = np.trace(self.covariance[at.GYR : at.GYR + 3, at.GYR : at.GYR + 3])
        # White noise of one sample: its density over the IMU's interval.
        white = self.params.gyro_noise**2 / max(s[at.IMU_STEP], 1e-3)
        variance = float(bias / 3.0 + white) if self.running else _UNKNOWN_RATE**2
        return NavigationEstimate(
            stamp, nav[:3], origin, enu, nav[3:6], nav[6:10], rate, covariance, variance
        )

    def biases(self, stamp: int) -> BiasEstimate:
        """Return sensor biases and clock with their σ."""
        s = self.state
        values = np.r_[s[at.ACC_BIAS : at.GYR_BIAS + 3], s[at.CLOCK], s[at.CLOCK_DRIFT]]
        sigmas = np.sqrt(np.maximum(np.diag(self.covariance)[at.ACC : at.DRIFT + 1], 0.0))
        return BiasEstimate(stamp, values, sigmas)

    def flush(self) -> None:
        """Bring the covariance up to the newest sample."""
        advance_covariance(self.state, self.channels, self.config)


def _stamp(sec: float, nsec: float) -> int:
    return int(sec) * NANOSECONDS + int(nsec)
