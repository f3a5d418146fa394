# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalman_core.rotation import quat_from_euler
from quad_control.arming import DESCENT, STOPPED
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import PRESSURE, RANGE, SETPOINT, AttitudeController
from quad_control.craft import CraftParams, benchmark_craft, benchmark_imu, hover_fraction, lever, max_thrust
from quad_control.flight import constant_pilot, fly, step_result
from quad_control.linear_plant import rate_plant
from quad_control.params import GAINS, AttitudeParams, ControllerParams
from quad_control.samples import (
    Attitude,
    BatterySample,
    Event,
    MotorCommand,
    PressureSample,
    RangeSample,
    Setpoint,
)
from quad_control.simulation import QuadSimulator

STEP = 5_000_000
IDLE = (1000.0,) * 4


def flight(payload=0.0, seconds=2.0, gain=1.0, name='gyro_driven', seed=0, params=None, meddle=None, **craft):
    """The 10° test: hovering with 10° of roll, level setpoint, estimator in the loop."""
    body = benchmark_craft(payload, **craft)
    plant = QuadSimulator(body, benchmark_imu(), seed=seed, roll=math.radians(10), height=10.0, hovering=True)
    params = params or ControllerParams()
    scaled = {n: getattr(params, n) * gain for n in GAINS if '_rate_' in n and n[-2:] in ('_p', '_i', '_d')}
    controller = AttitudeController(dataclasses.replace(params, **scaled))
    attitude = AttitudeFilter(AttitudeParams(filter=name))
    attitude.start(plant.x[6:10].copy())
    hover = hover_fraction(body)
    controller.start_flying(tuple(plant.x[6:10]), hover)
    hook = (lambda t: meddle(t, plant, controller)) if meddle else None
    log = fly(plant, attitude, controller, seconds, constant_pilot(hover), meddle=hook)
    return log, step_result(log.time, log.truth[:, 0]), controller


def attitude(stamp, roll=0.0, rate=(0.0, 0.0, 0.0), sigma=0.01):
    q = tuple(float(v) for v in quat_from_euler(roll, 0.0, 0.0))
    return Attitude(stamp, q, rate, (0.0, 0.0, 9.81), (1e-4,) * 3, (sigma**2,) * 3)


def ready(params=None):
    """A controller that hovers in level, on paper: armed, in the air, fed with still attitudes."""
    controller = AttitudeController(params)
    controller.start_flying((1.0, 0.0, 0.0, 0.0), 0.2)
    controller.on_setpoint(Setpoint(1, 0.0, 0.0, 0.0, 0.2, True))
    controller.on_attitude(attitude(10**9))
    return controller


def command(out):
    return next(e for e in out if isinstance(e, MotorCommand))


# The 10 degree test ------------------------------------------------------------------------------------


@pytest.mark.parametrize('pinned', [True, False])
def test_the_cascade_settles_ten_degrees_on_the_stand_and_in_free_flight(pinned):
    _, r, _ = flight(pinned=pinned, seconds=4.0)
    assert r.settling <= 0.3
    assert r.overshoot <= 0.5
    assert r.residual <= 0.05


@pytest.mark.parametrize('payload', [1.0, 3.2])
def test_one_set_of_gains_carries_every_payload(payload):
    assert flight(payload)[1].settling <= 0.4


@pytest.mark.parametrize('gain', [0.5, 2.0])
def test_half_and_double_loop_gain_settle(gain):
    assert flight(gain=gain)[1].settling <= 0.6


def test_a_filter_that_trusts_the_accelerometer_settles_on_the_stand_but_never_in_free_flight():
    assert flight(name='corrected', pinned=True, seconds=3.0)[1].settling < 2.0
    assert flight(name='corrected', pinned=False, seconds=3.0)[1].settling == math.inf


def test_the_published_pid_cannot_hold_a_bare_rigid_body():
    published = ControllerParams(controller='published', guard_gain_changes=False)
    assert flight(params=published, pinned=True, seconds=3.0)[1].settling > 2.5


def test_a_load_on_one_side_is_trimmed_by_the_integral():
    body = CraftParams(payload=0.3, payload_offset=(0.0, 0.03, 0.0), pinned=True)
    plant = QuadSimulator(body, benchmark_imu(), hovering=True)
    f, controller = AttitudeFilter(), AttitudeController()
    f.start(plant.x[6:10].copy())
    controller.start_flying(tuple(plant.x[6:10]), 0.2)
    log = fly(plant, f, controller, 8.0, constant_pilot(0.2))
    sag = np.degrees(np.abs(log.truth[:, 0]))
    assert sag.max() > 0.3
    assert sag[-200:].max() < 0.2


def test_the_craft_recovers_from_upside_down():
    plant = QuadSimulator(
        benchmark_craft(), benchmark_imu(), roll=math.radians(175), height=100.0, hovering=True
    )
    f = AttitudeFilter()
    f.start(plant.x[6:10].copy())
    controller = AttitudeController()
    controller.start_flying(tuple(plant.x[6:10]), 0.2)
    log = fly(plant, f, controller, 4.0, constant_pilot(0.2))
    assert abs(np.degrees(log.truth[-1, 0])) < 2.0


# Live changes ------------------------------------------------------------------------------------------


def test_a_live_gain_change_moves_each_output_by_less_than_one_percent_and_is_in_within_50_ms():
    controller = ready()
    stamp = 10**9
    before = None
    for i in range(60):
        stamp += STEP
        if i == 30:
            p = controller.params
            controller.set_params(dataclasses.replace(p, roll_rate_p=2 * p.roll_rate_p, roll_angle_p=12.0))
        pulses = np.array(
            command(controller.on_attitude(attitude(stamp, roll=0.02, rate=(0.01, 0.0, 0.0)))).pulses
        )
        if before is not None:
            assert np.abs(pulses - before).max() <= 10.0
        before = pulses
        if i == 39:
            assert controller.loop.gains[GAINS.index('roll_angle_p')] == 12.0


def test_changing_the_controller_in_flight_does_not_kick():
    controller = ready()
    stamp, before = 10**9, None
    for i in range(40):
        stamp += STEP
        if i in (20, 30):
            other = 'published' if i == 20 else 'cascade'
            controller.set_params(dataclasses.replace(controller.params, controller=other))
        pulses = np.array(command(controller.on_attitude(attitude(stamp, roll=0.003))).pulses)
        if before is not None:
            assert np.abs(pulses - before).max() < 15.0
        before = pulses


def test_gains_that_make_the_loop_swing_are_reverted_and_the_craft_comes_back():
    wild = {'roll_rate_p': 0.5, 'roll_rate_d': 0.0}

    def meddle(t, plant, controller):
        if abs(t - 1.0) < 1e-9:
            controller.set_params(dataclasses.replace(controller.params, **wild))

    log, _, controller = flight(seconds=4.0, meddle=meddle)
    texts = [e.text for e in log.events if e.kind == 'trial']
    assert texts[-1].startswith('reverted: ')
    assert controller.params == ControllerParams()
    assert np.degrees(np.abs(log.truth[:, 0])).max() < 30.0
    assert np.degrees(np.abs(log.truth[-40:, 0])).max() < 0.5


def test_good_gains_are_kept_after_the_trial():
    def meddle(t, plant, controller):
        if abs(t - 0.5) < 1e-9:
            controller.set_params(dataclasses.replace(controller.params, roll_rate_p=0.07))

    log, _, controller = flight(seconds=5.0, meddle=meddle)
    assert [e.text for e in log.events if e.kind == 'trial'][-1] == 'kept'
    assert controller.params.roll_rate_p == 0.07


def test_autotune_in_flight_finds_the_rate_loop_and_proposes_gains_that_fly():
    def meddle(t, plant, controller):
        if abs(t - 1.0) < 1e-9:
            assert controller.autotune('roll') == ''

    body = benchmark_craft()
    log, _, controller = flight(seconds=4.0, meddle=meddle)
    proposal = controller.tuning.proposal
    assert proposal is not None, [e.text for e in log.events]
    theory = rate_plant(4.0 * max_thrust(body) * lever(body) / body.inertia[0]).ultimate()
    text = next(e.text for e in log.events if e.kind == 'proposal')
    measured = float(text.split('Ku ')[1].split(',')[0])
    assert measured == pytest.approx(theory[0], rel=0.25)
    assert np.degrees(np.abs(log.truth[250:, 0])).max() < 5.0
    _, r, _ = flight(params=dataclasses.replace(ControllerParams(), **proposal))
    assert r.settling <= 0.4


# Bad input and silence ---------------------------------------------------------------------------------


def test_a_barometer_is_heard_only_while_the_range_finder_is_silent():
    controller = ready()
    controller.on_pressure(PressureSample(1, 101325.0))
    stamp = 10**9
    for _ in range(120):
        stamp += STEP
        controller.on_attitude(attitude(stamp))
    controller.on_pressure(PressureSample(2, 101325.0 - 12.0 * 3.0))
    assert controller.altitude.state[0] == pytest.approx(3.0, abs=0.1)
    controller.on_range(RangeSample(3, 0.5))
    for _ in range(10):
        stamp += STEP
        controller.on_attitude(attitude(stamp))
    before = controller.altitude.state[0]
    controller.on_pressure(PressureSample(4, 101325.0 - 12.0 * 3.0))
    assert controller.altitude.state[0] == before


def test_the_battery_sags_and_the_duty_rises():
    controller = ready()
    full = command(controller.on_attitude(attitude(10**9 + STEP))).pulses[0]
    controller.on_battery(BatterySample(1, 22.0))
    low = command(controller.on_attitude(attitude(10**9 + 2 * STEP))).pulses[0]
    assert (low - 1000.0) * 22.0 == pytest.approx((full - 1000.0) * 25.2, rel=1e-6)


@pytest.mark.parametrize('timeout', [ControllerParams().imu_timeout, 0.04])
def test_silence_stops_the_motors_within_50_ms_of_the_last_attitude(timeout):
    controller = ready(ControllerParams(imu_timeout=timeout))
    controller.on_attitude(attitude(10**9 + STEP))
    # The worst case: the attitude came right after a look of the watchdog, 5 ms before the next.
    ticks = [100.005 + 0.005 * i for i in range(20)]
    stopped = next(t for t in ticks if any(isinstance(e, MotorCommand) for e in controller.on_tick(t)))
    assert stopped - 100.0 <= 0.0501
    assert controller.on_tick(stopped + 0.005) == []


def test_attitudes_that_have_ceased_refuse_arming_by_service():
    controller = AttitudeController()
    controller.on_setpoint(Setpoint(10**9, 0.0, 0.0, 0.0, 0.0, False))
    controller.on_attitude(attitude(10**9))
    for clock in (0.0, 10.0):
        controller.on_tick(clock)
    assert controller.arm(True) == (False, 'refused: attitude is stale')
    controller.on_attitude(attitude(10**9 + STEP))
    assert controller.arm(True) == (True, 'armed')


def test_a_kill_in_a_silence_of_the_imu_stops_the_motors_once():
    controller = ready()
    controller.on_attitude(attitude(10**9 + STEP))
    controller.on_tick(0.0)
    controller.kill()
    assert command(controller.on_tick(0.005)).pulses == IDLE
    assert controller.on_tick(0.01) == []


def test_a_setpoint_that_is_only_repeated_is_a_lost_link():
    controller = ready()
    for i in range(1, 150):
        controller.on_attitude(attitude(10**9 + i * STEP))
        controller.on_setpoint(Setpoint(1, 0.0, 0.0, 0.0, 0.2, True))
    assert controller.arming.mode == DESCENT


def test_a_stop_during_a_trial_takes_the_new_gains_back():
    controller = ready()
    controller.set_params(dataclasses.replace(controller.params, roll_rate_p=0.3))
    controller.on_attitude(attitude(10**9 + STEP))
    controller.kill()
    out = controller.on_attitude(attitude(10**9 + 2 * STEP))
    assert command(out).pulses == IDLE
    assert 'reverted: the motors stopped during the trial' in [e.text for e in out if isinstance(e, Event)]
    assert controller.params == ControllerParams()


def test_a_gap_in_the_stamps_is_silence_too():
    controller = ready()
    out = controller.on_attitude(attitude(10**9 + 20 * STEP))
    assert command(out).pulses == IDLE


floats = st.one_of(st.floats(-1e6, 1e6), st.sampled_from([math.nan, math.inf, -math.inf, 0.0]))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from('asrb'), st.integers(-2, 20), floats, floats), max_size=15))
def test_no_input_makes_it_raise_or_send_a_pulse_that_is_none(inputs):
    controller = ready()
    stamp = 10**9
    for kind, offset, a, b in inputs:
        stamp = max(1, stamp + offset * STEP)
        if kind == 's':
            controller.on_setpoint(Setpoint(stamp, a, b, a, b, True))
        elif kind == 'r':
            controller.on_range(RangeSample(stamp, a))
        elif kind == 'b':
            controller.on_battery(BatterySample(stamp, a))
        else:
            out = controller.on_attitude(attitude(stamp)._replace(rate=(a, b, 0.0)))
            for e in out or []:
                if isinstance(e, MotorCommand):
                    assert all(1000.0 <= p <= 2000.0 for p in e.pulses)
    assert np.all(np.isfinite(controller.loop.state))


def test_a_looping_bag_restarts_it_disarmed():
    controller = ready()
    for i in range(12):
        controller.on_attitude(attitude(10**8 + i * STEP))
    assert controller.tally.restarts == ['time jumped back']
    out = controller.on_attitude(attitude(10**8 + 12 * STEP))
    assert command(out).pulses == IDLE


def test_an_armed_craft_on_the_ground_idles_and_does_not_wind_up():
    controller = AttitudeController()
    stamp = 10**9
    events = []
    for i in range(200):
        stamp += STEP
        controller.on_setpoint(Setpoint(stamp, 0.0, 0.0, 0.0, 0.0, i > 5))
        out = controller.on_attitude(attitude(stamp, roll=0.1))
        events += [e.text for e in out if isinstance(e, Event)]
    assert events == ['armed']
    pulses = command(out).pulses
    assert len(set(pulses)) == 1
    assert 1000.0 < pulses[0] < 1100.0
    assert not controller.loop.demand.any()


def test_a_link_lost_on_the_ground_stops_the_motors_at_idle():
    controller = AttitudeController()
    controller.altitude.hover = 0.2  # learnt in an earlier flight
    stamp, highest = 10**9, 0.0
    for i in range(260):
        stamp += STEP
        if i < 60:
            controller.on_setpoint(Setpoint(stamp, 0.0, 0.0, 0.0, 0.0, i > 5))
        highest = max(highest, *command(controller.on_attitude(attitude(stamp))).pulses)
    assert highest < 1100.0
    assert controller.arming.mode == STOPPED


def lost_link(height, seconds, ranged, **params):
    """The link is lost after 4 s. Returns sinks (m/s) and hover thrusts since, and the controller."""
    plant = QuadSimulator(CraftParams(), benchmark_imu(), seed=1, height=height, hovering=True)
    f, controller = AttitudeFilter(), AttitudeController(ControllerParams(**params))
    f.start(plant.x[6:10].copy(), plant.imu.gyro_bias)
    controller.start_flying(tuple(plant.x[6:10]), 0.15)
    sinks, hovers = [], []

    def pilot(time):
        if round(time / 0.005) % 40 == 0:
            controller.on_battery(plant.battery())
        if ranged and round(time / 0.005) % 10 == 0:
            controller.on_range(plant.range())
        if controller.arming.mode == DESCENT:
            sinks.append(-float(plant.x[5]))
            hovers.append(controller.altitude.hover)
        if time >= 4.0:
            return None
        return Setpoint(plant.stamp, 0.0, 0.0, 0.0, 0.15 - 0.05 * plant.x[5], True)

    fly(plant, f, controller, seconds, pilot)
    return sinks, hovers, controller


def test_a_descent_without_range_sinks_slowly_and_keeps_the_learnt_hover_thrust():
    sinks, hovers, controller = lost_link(60.0, 25.0, ranged=False)
    assert controller.arming.mode == DESCENT
    assert max(sinks) < 1.5
    assert min(sinks[-1000:]) > 0.1
    assert set(hovers) == {hovers[0]}


def test_a_descent_from_high_up_flies_until_it_has_landed():
    sinks, _, controller = lost_link(6.0, 20.0, ranged=True, descent_time=3.0)
    assert controller.arming.mode == STOPPED
    assert max(sinks) < 1.5


def test_one_wild_range_does_not_move_a_craft_that_holds_its_height():
    plant = QuadSimulator(CraftParams(), benchmark_imu(), seed=1, height=1.0, hovering=True)
    f, controller = AttitudeFilter(), AttitudeController()
    f.start(plant.x[6:10].copy(), plant.imu.gyro_bias)
    controller.start_flying(tuple(plant.x[6:10]), 0.15)
    heights = []

    def pilot(time):
        i = round(time / 0.005)
        if i % 10 == 0:
            controller.on_range(plant.range()._replace(height=39.0) if i == 1600 else plant.range())
        heights.append(plant.x[2])
        return Setpoint(plant.stamp, 0.0, 0.0, 0.0, 0.15, True, True)

    fly(plant, f, controller, 11.0, pilot)
    assert np.abs(np.array(heights[1600:]) - heights[1600]).max() < 0.1
    assert controller.tally.sensor(RANGE).rejected == {'wild jump': 1}


# Inputs and the pilot's services ------------------------------------------------------------------------


def test_setpoints_that_are_no_numbers_or_older_than_the_last_are_rejected_by_name():
    controller = ready()
    controller.on_setpoint(Setpoint(2 * 10**9, 0.1, 0.0, 0.0, 0.2, True))
    controller.on_setpoint(Setpoint(2 * 10**9 - 1, 0.2, 0.0, 0.0, 0.2, True))
    controller.on_setpoint(Setpoint(3 * 10**9, math.nan, 0.0, 0.0, 0.2, True))
    rejected = controller.tally.sensor(SETPOINT).rejected
    assert rejected == {'duplicate or older than the last': 1, 'not finite': 1}


@pytest.mark.parametrize(
    ('feed', 'sensor', 'reason'),
    [
        (lambda c: c.on_range(RangeSample(10**9, -1.0)), RANGE, 'not a height'),
        (lambda c: c.on_range(RangeSample(10**9, math.nan)), RANGE, 'not a height'),
        (lambda c: c.on_pressure(PressureSample(10**9, 0.0)), PRESSURE, 'not a pressure'),
    ],
)
def test_heights_that_are_none_are_rejected_by_name(feed, sensor, reason):
    controller = ready()
    feed(controller)
    assert controller.tally.sensor(sensor).rejected == {reason: 1}


def test_arming_by_service_says_what_happened_and_why_not():
    controller = AttitudeController()
    assert controller.arm(True) == (False, 'refused: attitude is stale')
    controller.on_setpoint(Setpoint(10**9, 0.0, 0.0, 0.0, 0.0, False))
    controller.on_attitude(attitude(10**9))
    assert controller.arm(True) == (True, 'armed')
    assert controller.arm(True) == (True, 'armed')
    assert 'stopped: kill switch' in controller.kill()
    assert controller.arm(True) == (False, 'refused: failsafe stopped')
    assert controller.arm(False) == (True, 'disarmed: by the pilot')
    assert controller.arm(False) == (True, 'disarmed')


@pytest.mark.parametrize(
    ('prepare', 'axis', 'word'),
    [
        (lambda: ready(), 'heave', 'allowed: roll, pitch, yaw'),
        (lambda: AttitudeController(), 'roll', 'armed craft off the ground'),
        (lambda: ready(ControllerParams(controller='published')), 'roll', 'needs controller: cascade'),
        (lambda: ready(), 'roll', ''),
    ],
)
def test_autotune_says_why_it_does_not_begin(prepare, axis, word):
    controller = prepare()
    answer = controller.autotune(axis)
    assert word in answer
    assert bool(answer) == bool(word)
    assert (controller.tuning.relay is not None) == (not word)


def test_a_relay_test_that_tilts_the_craft_too_far_stops_and_says_so():
    controller = ready()
    assert controller.autotune('roll') == ''
    said = [e.text for e in controller.on_attitude(attitude(10**9 + STEP, roll=1.0)) if isinstance(e, Event)]
    assert controller.tuning.relay is None
    assert any('roll: stopped, angle error 1.00 rad' in text for text in said), said


def test_gains_without_a_blend_time_are_in_at_once():
    controller = ready(ControllerParams(gain_blend_time=0.0))
    controller.set_params(ControllerParams(gain_blend_time=0.0, roll_rate_p=0.05), trial=False)
    assert controller.loop.gains[GAINS.index('roll_rate_p')] == 0.05
