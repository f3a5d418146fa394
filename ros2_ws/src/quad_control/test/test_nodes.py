# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes: the loop flies, page and parameters obey the same checks, a kill stops."""

import json
import urllib.error
import urllib.request
from contextlib import ExitStack

import pytest
from page_backend import has_ipv6
from sensor_msgs.msg import Range

from node_core.testing import Process, probe

TOKEN = 'a-token-of-the-test-0123456789'


@pytest.fixture(scope='module')
def flight():
    """Yield (probe, processes, collected) of a craft that hovers in lock-step with its simulator."""
    with ExitStack() as stack:
        nodes = {
            'attitude_filter': {'lockstep': True},
            'attitude_controller': {'lockstep': True},
            'pilot': {'mission': 'hover', 'rate': 200.0},
            'esc_driver': {'bus': 'fake', 'watchdog': 1.0},
            'web_tuner': {'port': 0, 'token': TOKEN},
        }
        processes = {
            name: stack.enter_context(Process.node('quad_control', name, params=params))
            for name, params in nodes.items()
        }
        watcher = stack.enter_context(probe())
        heard = {
            'events': watcher.collect('std_msgs/msg/String', 'controller/events'),
            'truth': watcher.collect('nav_msgs/msg/Odometry', 'truth/odometry'),
            'pulses': watcher.collect('sensor_msgs/msg/JointState', 'esc/pulses'),
            'commands': watcher.collect('sensor_msgs/msg/JointState', 'motors/command'),
        }
        for topic in ('imu/data', 'motors/command', 'setpoint', 'esc/pulses'):
            watcher.wait_for_publisher(topic)
        watcher.until(lambda: 'page: ' in processes['web_tuner'].output, 'the page')
        processes['quad_simulator'] = stack.enter_context(
            Process.node('quad_control', 'quad_simulator', params={'pace': 'lockstep', 'seed': 3})
        )
        watcher.until(lambda: heard['truth'] and height(heard) > 1.0, 'take-off')
        yield watcher, processes, heard


def height(heard):
    return heard['truth'][-1].pose.pose.position.z


def url(processes):
    return processes['web_tuner'].output.split('page: ')[1].split('#')[0]


def ask(processes, path, body=None, token=TOKEN, origin=None):
    headers = {'Authorization': f'Bearer {token}', 'Content-Type': 'application/json'}
    if origin:
        headers['Origin'] = origin
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url(processes) + path, data=data, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=60) as response:
            return response.status, json.loads(response.read())
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())


def value(state, name):
    return next(g['value'] for g in state['gains'] if g['name'] == name)


def said(heard, start):
    return any(m.data.startswith(start) for m in heard['events'])


def test_the_craft_hovers_level_through_the_processes(flight):
    watcher, _, heard = flight
    first = heard['truth'][-1].header.stamp.sec
    watcher.until(lambda: heard['truth'][-1].header.stamp.sec >= first + 5, 'five seconds of flight')
    recent = heard['truth'][-400:]
    assert all(0.5 < m.pose.pose.position.z < 6.0 for m in recent)
    assert all(abs(m.pose.pose.orientation.x) < 0.1 for m in recent)


def test_what_the_controller_commands_reaches_the_chip(flight):
    watcher, _, heard = flight
    assert list(heard['commands'][-1].name) == list(heard['pulses'][-1].name)
    watcher.until(lambda: min(heard['pulses'][-1].position) > 1200.0, 'pulses of a hover')


def test_page_and_parameters_change_the_same_gain_under_the_same_checks(flight):
    watcher, processes, _ = flight
    watcher.until(lambda: ask(processes, 'api/state')[0] == 200, 'the page')
    status, state = ask(processes, 'api/gains', {'gains': {'roll_rate_p': 0.07}})
    assert (status, value(state, 'roll_rate_p')) == (200, 0.07)
    assert ask(processes, 'api/gains', {'gains': {'roll_rate_p': 70.0}})[0] == 422
    assert ask(processes, 'api/gains', {'gains': {'roll_rate_p': 0.08}}, token='wrong')[0] == 401
    assert (
        ask(processes, 'api/gains', {'gains': {'roll_rate_p': 0.08}}, origin='http://evil.example')[0] == 403
    )
    assert not watcher.set_parameter('attitude_controller', 'roll_rate_p', 50.0).successful
    assert watcher.set_parameter('attitude_controller', 'pitch_rate_p', 0.065).successful

    def followed():
        now = ask(processes, 'api/state')[1]
        return value(now, 'pitch_rate_p') == 0.065 and value(now, 'roll_rate_p') == 0.07

    watcher.until(followed, 'the page to follow the parameter')


def test_gains_that_swing_are_reverted_and_the_parameter_follows(flight):
    watcher, processes, heard = flight
    watcher.until(lambda: said(heard, 'trial: kept'), 'the trial before to end')
    before = value(ask(processes, 'api/state')[1], 'roll_rate_p')
    assert watcher.set_parameter('attitude_controller', 'roll_rate_p', 0.9).successful
    watcher.until(lambda: said(heard, 'trial: reverted'), 'the revert')
    watcher.until(lambda: value(ask(processes, 'api/state')[1], 'roll_rate_p') == before, 'the parameter')


def test_undo_on_the_page_brings_the_gain_back(flight):
    _, processes, _ = flight
    before = value(ask(processes, 'api/state')[1], 'yaw_angle_p')
    status, state = ask(processes, 'api/gains', {'gains': {'yaw_angle_p': 2.25}})
    assert (status, value(state, 'yaw_angle_p')) == (200, 2.25)
    status, state = ask(processes, 'api/undo', {})
    assert (status, value(state, 'yaw_angle_p')) == (200, before)


def test_autotune_proposes_and_only_its_application_changes_gains(flight):
    watcher, processes, heard = flight
    before = ask(processes, 'api/state')[1]
    assert ask(processes, 'api/action', {'name': 'autotune_roll'})[0] == 200
    watcher.until(lambda: said(heard, 'proposal: roll'), 'the proposal')
    assert ask(processes, 'api/state')[1]['gains'] == before['gains']
    trials = len([m for m in heard['events'] if m.data.startswith('trial: kept')])
    assert ask(processes, 'api/action', {'name': 'apply_proposal'})[0] == 200

    def applied():
        now = ask(processes, 'api/state')[1]
        return value(now, 'roll_rate_p') != value(before, 'roll_rate_p') and now['history']

    history = watcher.until(applied, 'the gains of the proposal')
    assert history[-1]['by'] == 'autotune'
    assert set(history[-1]['changes']) == {
        f'roll_{name}' for name in ('angle_p', 'rate_p', 'rate_i', 'rate_d')
    }
    watcher.until(
        lambda: len([m for m in heard['events'] if m.data.startswith('trial: kept')]) > trials, 'the trial'
    )


def test_a_kill_stops_the_motors_and_the_mission_does_not_arm_again(flight):
    watcher, processes, heard = flight
    assert ask(processes, 'api/action', {'name': 'kill'})[0] == 200
    watcher.until(lambda: max(heard['commands'][-1].position) <= 1000.0, 'stopped motors')
    watcher.until(lambda: max(heard['pulses'][-1].position) <= 1000.0, 'stopped pulses')
    events = len(heard['events'])
    stamp = heard['truth'][-1].header.stamp.sec
    watcher.until(lambda: heard['truth'][-1].header.stamp.sec > stamp + 3, 'three more seconds')
    assert not any(m.data == 'arming: armed' for m in heard['events'][events:])


def test_motors_idle_when_the_controller_dies_in_flight(flight):
    watcher, processes, heard = flight
    # Told anew, the pilot arms and takes off once more.
    assert watcher.set_parameter('pilot', 'height', 1.6).successful
    watcher.until(lambda: min(heard['pulses'][-1].position) > 1200.0, 'pulses of a flight')
    processes.pop('attitude_controller').kill()
    watcher.until(lambda: max(heard['pulses'][-1].position) <= 1000.0, 'idle pulses')


def test_the_nodes_end_with_0(flight):
    _, processes, _ = flight
    assert {name: process.stop() for name, process in processes.items()} == dict.fromkeys(processes, 0)


@pytest.mark.skipif(not has_ipv6(), reason='this machine has no IPv6 loopback')
def test_the_page_is_served_on_an_ipv6_address():
    with Process.node(
        'quad_control', 'web_tuner', params={'host': '::1', 'port': 0, 'token': TOKEN}
    ) as process:
        with probe() as watcher:
            watcher.until(lambda: 'page: http://[::1]:' in process.output, 'the page', process=process)
        nodes = {'web_tuner': process}
        assert ask(nodes, 'api/state', origin=url(nodes).rstrip('/'))[0] == 200
        assert process.stop() == 0


def test_a_mission_beyond_the_range_finder_is_a_warning_on_the_terminal_and_in_diagnostics():
    with (
        Process.node('quad_control', 'pilot', params={'mission': 'hover', 'height': 45.0}) as process,
        probe() as watcher,
    ):
        heard = watcher.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
        publisher = watcher.publisher('sensor_msgs/msg/Range', 'range', process=process)
        message = Range(min_range=0.0, max_range=40.0, range=1.0)

        def warned():
            publisher.publish(message)
            statuses = [s for array in heard for s in array.status if s.name == 'pilot']
            return any('holds at 32 m' in s.message and s.level == b'\x01' for s in statuses)

        watcher.until(warned, 'the warning', process=process)
        assert 'the range finder reaches 40 m: holds at 32 m' in process.output
        assert process.stop() == 0


def test_a_missing_pwm_chip_is_said_on_the_terminal_and_ends_nothing():
    with (
        Process.node('quad_control', 'esc_driver', params={'bus': '/dev/i2c-99'}) as process,
        probe() as watcher,
    ):
        watcher.until(lambda: 'no contact with the PWM chip' in process.output, 'the fault', process=process)
        assert process.stop() == 0


@pytest.mark.parametrize(
    ('node', 'params', 'said'),
    [
        ('attitude_filter', {'filter': 'magic'}, "parameter 'filter' is 'magic'"),
        ('attitude_controller', {'roll_rate_p': -1.0}, "parameter 'roll_rate_p' is -1"),
        ('esc_driver', {'bus': 'usb'}, "parameter 'bus' is 'usb'"),
        ('web_tuner', {'host': '0.0.0.0'}, "parameter 'token' is too short"),
        ('quad_simulator', {'masss': 2.0}, "unknown parameter 'masss'"),
    ],
)
def test_a_bad_parameter_is_one_line_and_exit_code_2(node, params, said):
    with Process.node('quad_control', node, params=params) as process:
        assert process.wait() == 2
        assert said in process.output
