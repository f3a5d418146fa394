# SPDX-License-Identifier: Apache-2.0
"""The attitude controller: attitude and setpoint in, four pulses out; arming and tuning in flight inside."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from kalman_core.health import Tally
from quad_control.altitude import SIZE as ALTITUDE_SIZE
from quad_control.altitude import Altitude, pressure_height, upward_acceleration
from quad_control.arming import ARMED, DESCENT, DISARMED, NAMES, Arming, Checks
from quad_control.arming import SIZE as ARMING_SIZE
from quad_control.attitude_error import attitude_error, heading, tilt_cosine
from quad_control.attitude_loop import AXES, YAW_CENTRE, AttitudeLoop, clip
from quad_control.attitude_loop import SIZE as LOOP_SIZE
from quad_control.mixer import mix, pulses_from_thrust
from quad_control.params import GAINS, GRAVITY, ControllerParams
from quad_control.samples import (
    ArmingState,
    Attitude,
    BatterySample,
    ControlReport,
    Event,
    MotorCommand,
    PressureSample,
    RangeSample,
    Setpoint,
)
from quad_control.tuning_in_flight import TuningInFlight, saturates
from quad_control.vertical import SIZE as VERTICAL_SIZE
from quad_control.vertical import VerticalFilter

NANOSECONDS = 1_000_000_000
ATTITUDE, SETPOINT, RANGE, BATTERY, PRESSURE = 'imu/data', 'setpoint', 'range', 'battery', 'pressure'
# A barometer is heard only when the range finder has been silent for this long (s).
_RANGE_SILENT = 1.0
# A height this far (m) from the expected one is an echo, a hole in the ground or a gust in the housing.
_RANGE_JUMP, _PRESSURE_JUMP = 0.5, 3.0
# The first step has no predecessor: it takes the paper's period (s).
_FIRST_STEP = 0.005
# Attitudes in a row that are older than the newest before the clock is believed to have jumped back.
_JUMP_CONFIRMATIONS = 10
# Throttle (fraction) that counts as take-off: from here on integrals run and throttle zero keeps control.
_TAKE_OFF = 0.1
# Throttle is divided by the cosine of the tilt, at most by this cosine (60°).
_LEAST_COSINE = 0.5

# Flat state.
_ARMING = slice(0, ARMING_SIZE)
_ALTITUDE = slice(ARMING_SIZE, ARMING_SIZE + ALTITUDE_SIZE)
_OWN = ARMING_SIZE + ALTITUDE_SIZE
_HEADING, _AIRBORNE, _ATTITUDE_TIME, _SETPOINT_TIME, _VOLTAGE = range(_OWN, _OWN + 5)
_LOOP = slice(_OWN + 5, _OWN + 5 + LOOP_SIZE)
_VERTICAL = slice(_OWN + 5 + LOOP_SIZE, _OWN + 5 + LOOP_SIZE + VERTICAL_SIZE)
_SIZE = _OWN + 5 + LOOP_SIZE + VERTICAL_SIZE


class AttitudeController:
    """Estimator of the `attitude_controller` node: handlers return what is to be published.

    `params` may be replaced in flight through `set_params`; gains then move in over `gain_blend_time` and,
    with `guard_gain_changes`, are on trial.
    """

    def __init__(self, params: ControllerParams | None = None) -> None:
        self.params = params or ControllerParams()
        self.tally = Tally()
        self.state = np.zeros(_SIZE)
        s = self.state
        self.arming = Arming(self.params, s[_ARMING])
        self.altitude = Altitude(s[_ALTITUDE])
        self.vertical = VerticalFilter(s[_VERTICAL])
        self.loop = AttitudeLoop(self.params, s[_LOOP])
        self._thrust, self._achieved, self._pulses = np.zeros(4), np.zeros(4), np.zeros(4)
        self.tuning = TuningInFlight(lambda kind, text: self._say(kind, text, self._newest_stamp()))
        self._events: list[Event] = []
        self.reset()

    def reset(self) -> None:
        """Disarm and forget everything but the parameters."""
        s = self.state
        s[:] = 0.0
        self.arming.reset()
        self.altitude.reset()
        self.vertical.reset()
        self.loop.reset()
        s[_ATTITUDE_TIME] = s[_SETPOINT_TIME] = -math.inf
        s[_VOLTAGE] = math.nan
        self._epoch: int | None = None
        self._setpoint = Setpoint(0, 0.0, 0.0, 0.0, 0.0, False)
        self._attitude: Attitude | None = None
        self._range_time = -math.inf
        self._ground_pressure: float | None = None
        self._older = 0
        self._unchanged: tuple[float, int] | None = None
        self._silence = 0.0
        self._turning = False
        self._told: float | None = None
        self.tuning.reset()
        self._events.clear()

    # Handlers -----------------------------------------------------------------------------------------

    def on_setpoint(self, sample: Setpoint) -> None:
        """Take the pilot's demand; angles and throttle are limited to their ranges."""
        values = sample[1:5]
        if not all(map(math.isfinite, values)):
            self.tally.reject(SETPOINT, 'not finite')
            return
        heard = math.isfinite(self.state[_SETPOINT_TIME])
        # A message that is only repeated is no pilot: it must not keep a lost link alive.
        if heard and 0 <= self._setpoint.stamp - sample.stamp < NANOSECONDS:
            self.tally.reject(SETPOINT, 'duplicate or older than the last')
            return
        p = self.params
        limited = Setpoint(
            sample.stamp,
            clip(sample.roll, p.max_tilt),
            clip(sample.pitch, p.max_tilt),
            clip(sample.yaw_rate, p.max_yaw_rate),
            min(max(sample.throttle, 0.0), 1.0),
            sample.arm,
            sample.hold,
        )
        self._setpoint = limited
        # The age counts from the attitude it met, so that pilot and IMU may keep different clocks.
        self.state[_SETPOINT_TIME] = self._newest_time()
        self.tally.accept(SETPOINT, sample.stamp)

    def on_range(self, sample: RangeSample) -> None:
        """Take a height over ground (m)."""
        if not math.isfinite(sample.height) or sample.height < 0.0:
            self.tally.reject(RANGE, 'not a height')
            return
        self._range_time = self._newest_time()
        if not self.altitude.correct(sample.height, self._range_time, _RANGE_JUMP):
            self.tally.reject(RANGE, 'wild jump')
            return
        self.tally.accept(RANGE, sample.stamp)

    def on_pressure(self, sample: PressureSample) -> None:
        """Take an air pressure (Pa): the height over where the motors last stood, if no range is heard."""
        if not math.isfinite(sample.pressure) or sample.pressure <= 0.0:
            self.tally.reject(PRESSURE, 'not a pressure')
            return
        if self._ground_pressure is None or not self.arming.flying:
            self._ground_pressure = sample.pressure
        time = self._newest_time()
        if time - self._range_time > _RANGE_SILENT:
            height = pressure_height(sample.pressure, self._ground_pressure)
            if not self.altitude.correct(height, time, _PRESSURE_JUMP):
                self.tally.reject(PRESSURE, 'wild jump')
                return
        self.tally.accept(PRESSURE, sample.stamp)

    def on_battery(self, sample: BatterySample) -> None:
        """Take the battery voltage (V)."""
        if not math.isfinite(sample.voltage) or sample.voltage <= 0.0:
            self.tally.reject(BATTERY, 'not a voltage')
            return
        last = self.state[_VOLTAGE]
        # A first-order low-pass over 5 samples: the sag of one gust is not an empty battery.
        blend = 1.0 if math.isnan(last) else 0.2
        self.state[_VOLTAGE] = sample.voltage if blend == 1.0 else last + blend * (sample.voltage - last)
        self.tally.accept(BATTERY, sample.stamp)

    def on_attitude(self, sample: Attitude) -> list | None:
        """Fly one step; returns the motor command, the report and events, or None for an unusable sample."""
        if not all(map(math.isfinite, (*sample.quaternion, *sample.rate, *sample.force))):
            self.tally.reject(ATTITUDE, 'not finite')
            return None
        if self._epoch is None:
            self._epoch = sample.stamp
        time = (sample.stamp - self._epoch) * 1e-9
        last = float(self.state[_ATTITUDE_TIME])
        if time <= last:
            return self._backward(sample)
        self._older = 0
        self._silence = 0.0
        first = self._attitude is None
        gap = _FIRST_STEP if first else time - last
        self.state[_ATTITUDE_TIME] = time
        self._attitude = sample
        self.tally.accept(ATTITUDE, sample.stamp)
        self._say('arming', self.arming.tick(self._checks(time, 0.0 if first else gap)), sample.stamp)
        if not self.arming.flying:
            up = upward_acceleration(sample.quaternion, sample.force)
            self.vertical.rest(up + GRAVITY, min(gap, self.params.imu_timeout))
            return self._rest(sample)
        return self._fly(sample, time, min(gap, self.params.imu_timeout))

    def on_tick(self, clock: float) -> list:
        """Watch for silence; `clock` is any steady time in s. Returns a stop when attitudes have ceased.

        Call it every 5 ms: an attitude older than `imu_timeout` stops the motors. Motors that still turn
        after a kill or a disarming get their stop here, attitudes or not.
        """
        if self._attitude is None:
            return []
        stamp = self._attitude.stamp
        if self._unchanged is None or self._unchanged[1] != stamp:
            self._unchanged = (clock, stamp)
        age = self._silence = clock - self._unchanged[0]
        now = stamp + round(age * 1e9)
        if self.arming.flying:
            if age <= self.params.imu_timeout:
                return []
            time = float(self.state[_ATTITUDE_TIME])
            self._say('arming', self.arming.tick(self._checks(time + age, age)), now)
        elif not self._turning:
            return []
        return self._rest(self._attitude._replace(stamp=now))

    # Pilot and tuning ---------------------------------------------------------------------------------

    def arm(self, on: bool) -> tuple[bool, str]:
        """Arm or disarm; returns whether the wish was met, and what happened."""
        age = self._silence if self._attitude else math.inf
        text = self.arming.request(on, self._checks(self._newest_time(), age))
        self._say('arming', text, self._newest_stamp())
        return self.arming.mode == (ARMED if on else DISARMED), text or NAMES[self.arming.mode]

    def kill(self) -> str:
        """Stop the motors at once."""
        text = self.arming.kill(self._newest_time())
        self._say('arming', text, self._newest_stamp())
        return text

    def start_flying(self, quaternion: tuple, throttle: float) -> None:
        """Take over a craft that already flies at `quaternion` with hover `throttle`: no checks, armed."""
        self.arming.state[0] = ARMED
        self.state[_AIRBORNE] = 1.0
        self.state[_HEADING] = heading(np.asarray(quaternion))
        self.altitude.hover = throttle
        self.vertical.start(throttle)

    def set_params(self, params: ControllerParams, *, trial: bool | None = None) -> None:
        """Take new parameters; gains move in bumplessly and, in flight, are on trial unless told not to."""
        before = {name: getattr(self.params, name) for name in GAINS}
        changed = [name for name in GAINS if before[name] != getattr(params, name)]
        self.params = params
        self.arming.params = params
        self.loop.configure(params)
        wanted = params.guard_gain_changes if trial is None else trial
        if changed and wanted and self.arming.mode == ARMED:
            self.tuning.begin_trial(params, self._newest_time(), before, changed)

    def autotune(self, axis: str) -> str:
        """Start a relay test on `axis`; returns an empty string or why not."""
        if axis not in AXES:
            return f"axis is '{axis}', allowed: {', '.join(AXES)}"
        if self.arming.mode != ARMED or not self.state[_AIRBORNE]:
            return 'autotune needs an armed craft off the ground'
        if self.params.controller != 'cascade':
            return 'autotune needs controller: cascade'
        self.tuning.begin_relay(axis, self.params)
        return ''

    def diagnostics(self) -> dict:
        """Return the controller's own values for the diagnostics."""
        voltage = float(self.state[_VOLTAGE])
        return {
            'arming': NAMES[self.arming.mode],
            'airborne': bool(self.state[_AIRBORNE]),
            'controller': self.params.controller,
            'trial': self.tuning.on_trial,
            'autotune': self.tuning.relay is not None,
            'hover_thrust': self.altitude.hover,
            'climb_m_s': self.vertical.climb,
            'climb_sigma_m_s': self.vertical.sigma,
            'battery_v': voltage,
        }

    @property
    def last_demand(self) -> np.ndarray:
        """Torque demand (3,) of the last step, thrust fractions, before the mixer."""
        return self.loop.demand

    # One step -----------------------------------------------------------------------------------------

    def _fly(self, sample: Attitude, time: float, dt: float) -> list:
        p = self.params
        s = self.state
        q = np.array(sample.quaternion)
        self._turning = True
        self.loop.blend(dt)
        up = upward_acceleration(sample.quaternion, sample.force)
        self.altitude.predict(up, dt)
        roll, pitch, yaw_rate, throttle = self._demand(time, dt)
        if throttle > _TAKE_OFF:
            s[_AIRBORNE] = 1.0
        if abs(yaw_rate) > YAW_CENTRE or not s[_AIRBORNE]:
            s[_HEADING] = heading(q)
        errors = attitude_error(q, roll, pitch, s[_HEADING])
        relay = self.tuning.relay
        targets = self.loop.rate_targets(errors, yaw_rate, relay[0] if relay else -1)
        if not s[_AIRBORNE]:
            self.loop.rest()
            throttle = 0.0
        else:
            self.loop.step(sample.rate, errors, targets, yaw_rate, dt, relay)
            throttle /= max(tilt_cosine(q), _LEAST_COSINE)
        demand = self.loop.demand
        mix(demand[0], demand[1], demand[2], throttle, p.idle_thrust, 1.0, self._thrust, self._achieved)
        self.loop.unwind(self._achieved)
        if self.arming.mode == ARMED:  # a descent without range flies on a share of what was learnt
            self.altitude.learn_hover(self._achieved[3], sample.force[2], dt)
        self._feel_climb(sample, up + GRAVITY, tilt_cosine(q), time, dt)
        rate_errors = tuple(t - r for t, r in zip(targets, sample.rate))
        lost = saturates(demand, self._achieved)
        self._fall_back(self.tuning.watch(p, time, dt, rate_errors, errors, lost))
        voltage = s[_VOLTAGE]
        sag = 1.0
        if p.sag_compensation and not math.isnan(voltage):
            sag = min(max(voltage / p.voltage_full, 0.5), 1.2)
        pulses_from_thrust(self._thrust, p.thrust_curve, sag, p.pulse_min, p.pulse_max, self._pulses)
        report = ControlReport(
            sample.stamp,
            (roll, pitch, yaw_rate),
            (roll - errors[0], pitch - errors[1], sample.rate[2]),
            (float(demand[0]), float(demand[1]), float(demand[2]), float(throttle)),
            _four(self._achieved),
        )
        return [MotorCommand(sample.stamp, _four(self._pulses), _four(self._thrust)), report, *self.said()]

    def _feel_climb(self, sample: Attitude, force_up: float, cosine: float, time: float, dt: float) -> None:
        if not self.state[_AIRBORNE]:
            self.vertical.rest(force_up, dt)
            return
        self.vertical.step(
            force_up,
            sample.force[2],
            cosine,
            self._achieved[3],
            dt,
            self.altitude.climb_rate if self.altitude.fresh(time) else None,
            self.arming.mode == ARMED,
            self.params.inflow,
        )

    def _rest(self, sample: Attitude) -> list:
        self._fall_back(self.tuning.stop())
        p = self.params
        self.loop.rest()
        self._turning = False
        self.state[_AIRBORNE] = 0.0
        stop = (p.pulse_min,) * 4
        zero = (0.0, 0.0, 0.0, 0.0)
        angles = attitude_error(np.array(sample.quaternion), 0.0, 0.0, heading(np.array(sample.quaternion)))
        set_now = self._setpoint
        report = ControlReport(
            sample.stamp,
            (set_now.roll, set_now.pitch, set_now.yaw_rate),
            (-angles[0], -angles[1], sample.rate[2]),
            zero,
            zero,
        )
        return [MotorCommand(sample.stamp, stop, zero), report, *self.said()]

    def _demand(self, time: float, dt: float) -> tuple[float, float, float, float]:
        p, sp, altitude = self.params, self._setpoint, self.altitude
        fresh = altitude.fresh(time)
        if self.arming.mode == DESCENT:
            if not self.state[_AIRBORNE] or (fresh and altitude.on_ground(time)):
                self._say('arming', self.arming.landed(time), self._newest_stamp())
                return 0.0, 0.0, 0.0, 0.0
            if fresh:
                return 0.0, 0.0, 0.0, altitude.climb(-p.descent_rate, p, dt)
            if self.vertical.known:
                return 0.0, 0.0, 0.0, self.vertical.sink(p.descent_rate, p.climb_p, p.inflow)
            return 0.0, 0.0, 0.0, p.descent_throttle * altitude.hover
        if sp.hold and fresh and self.state[_AIRBORNE]:
            return sp.roll, sp.pitch, sp.yaw_rate, altitude.hold(p, dt)
        altitude.release()
        return sp.roll, sp.pitch, sp.yaw_rate, sp.throttle

    def _fall_back(self, gains: dict[str, float] | None) -> None:
        """Go back to the gains before a trial."""
        if gains is not None:
            self.params = dataclasses.replace(self.params, **gains)  # type: ignore[arg-type]
            self.loop.configure(self.params)

    # Small things -------------------------------------------------------------------------------------

    def _backward(self, sample: Attitude) -> list | None:
        self.tally.reject(ATTITUDE, 'older than the last')
        self._older += 1
        if self._older < _JUMP_CONFIRMATIONS:
            return None
        self.tally.restart('time jumped back')
        self.reset()
        return None

    def _checks(self, time: float, attitude_age: float) -> Checks:
        a = self._attitude
        voltage = float(self.state[_VOLTAGE])
        return Checks(
            time,
            attitude_age,
            time - float(self.state[_SETPOINT_TIME]),
            math.inf if a is None else math.sqrt(max(max(a.rate_variance), 0.0)),
            math.inf if a is None else math.acos(min(max(tilt_cosine(np.array(a.quaternion)), -1.0), 1.0)),
            self._setpoint.throttle,
            self._setpoint.arm,
            None if math.isnan(voltage) else voltage,
            self.altitude.sinking(time, 0.5 * self.params.descent_rate),
        )

    def _newest_time(self) -> float:
        time = float(self.state[_ATTITUDE_TIME])
        return time if math.isfinite(time) else 0.0

    def _newest_stamp(self) -> int:
        return self._attitude.stamp if self._attitude else 0

    def _say(self, kind: str, text: str, stamp: int) -> None:
        if text:
            self._events.append(Event(stamp, kind, text))

    def said(self) -> list:
        """Return events that are not said yet, and the arming state at the start and when it has changed."""
        events, self._events = self._events, []
        out: list = list(events)
        if self._told != self.arming.mode:
            self._told = self.arming.mode
            out.append(ArmingState(self._newest_stamp(), NAMES[self.arming.mode]))
        return out


def _four(values: np.ndarray) -> tuple[float, float, float, float]:
    a, b, c, d = values
    return float(a), float(b), float(c), float(d)
