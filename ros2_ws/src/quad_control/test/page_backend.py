# SPDX-License-Identifier: Apache-2.0
"""A backend for page tests: the real controller on the simulated craft, in process, without ROS."""

import dataclasses
import math
import socket

import numpy as np

from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import benchmark_craft, benchmark_imu, hover_fraction
from quad_control.params import GAINS, ControllerParams
from quad_control.samples import Attitude, MotorCommand, Setpoint
from quad_control.simulation import QuadSimulator
from quad_control.tuner_data import ACTIONS
from quad_control.web_server import Gain, Refused

# Every push to the page flies this many samples: real time at 20 pushes a second.
STEPS = 10
# A step of the setpoint lasts this many samples.
LEAN = 400


class FlyingBackend:
    """Flies on when the page asks for samples; its clock is the number of pushes."""

    actions = ACTIONS

    def __init__(self):
        craft = benchmark_craft(drag_linear=0.8)
        self.plant = QuadSimulator(craft, benchmark_imu(), hovering=True, height=20.0)
        self.attitude, self.controller = AttitudeFilter(), AttitudeController()
        self.attitude.start(self.plant.x[6:10].copy())
        self.hover = hover_fraction(craft)
        self.controller.start_flying((1.0, 0.0, 0.0, 0.0), self.hover)
        self.acted = []
        self.trial = ''
        self.roll = 0.0
        self.leaning = 0
        self.counter = 0
        self.kept = []
        self.events = []

    def gains(self):
        out = []
        for f in dataclasses.fields(ControllerParams):
            m = f.metadata
            if f.name in GAINS:
                value = getattr(self.controller.params, f.name)
                out.append(Gain(f.name, value, m['min'], m['max'], m['unit'], m['text']))
        return out

    async def set_gains(self, changes):
        if changes.get('max_rate') == 13.0:
            raise Refused('thirteen is refused')
        self.controller.set_params(dataclasses.replace(self.controller.params, **changes))

    async def act(self, name):
        self.acted.append(name)
        if name == 'step_roll':
            self.roll = math.radians(10.0)
            self.leaning = LEAN
        return f'did {name}'

    def state(self):
        return {
            'arming': 'armed',
            'voltage': 24.8,
            'rate': 200.0,
            'trial': self.trial,
            'events': self.events[-50:],
        }

    def samples(self, after):
        for _ in range(STEPS):
            self._step()
        self.kept = self.kept[-1200:]
        return self.counter, [s for number, s in self.kept if number > after]

    def _step(self):
        c, plant = self.controller, self.plant
        self.leaning -= 1
        if self.leaning == 0:
            self.roll = 0.0
        c.on_setpoint(Setpoint(plant.stamp, self.roll, 0.0, 0.0, self.hover, True))
        command = None
        for item in self.attitude.on_imu(plant.sense()) or []:
            if type(item) is not Attitude:
                continue
            for out in c.on_attitude(item) or []:
                if isinstance(out, MotorCommand):
                    command = out.pulses
                elif hasattr(out, 'kind'):
                    self.events.append(f'{out.kind}: {out.text}')
        roll, pitch, _ = plant.euler
        plant.advance(command)
        self.counter += 1
        noise = 0.03 * np.sin(0.9 * self.counter)
        angles = [[self.roll, 0.0], [roll, pitch], [roll + noise, pitch - noise]]
        self.kept.append((self.counter, [plant.time, *angles, list(command)]))


def has_ipv6():
    """Return whether this machine has an IPv6 loopback."""
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(('::1', 0))
    except OSError:
        return False
    return True
