# SPDX-License-Identifier: Apache-2.0
"""Recorded fixtures: the 10 degree test on the stand and in free flight, each flown from a seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bag_tools.bag import BagWriter, zeroed
from quad_control import codec
from quad_control.attitude_filter import AttitudeFilter
from quad_control.controller import AttitudeController
from quad_control.craft import CraftParams, ImuErrorParams, hover_fraction
from quad_control.samples import ArmingState, Attitude, MotorCommand, Setpoint
from quad_control.simulation import QuadSimulator

# 2026-01-01T00:00:00Z: a date that is plainly not the day of the recording.
START = 1_767_225_600_000_000_000
_RATE = 200
_TILT = math.radians(10.0)
# Every n-th IMU sample there is a truth, a setpoint, a range, a battery voltage: 50, 50, 20, 5 Hz.
_TRUTH, _STICKS, _RANGE, _BATTERY = 4, 4, 10, 40
# /imu/data is recorded too, so that the controller can be replayed on its own.
_TYPES = {
    '/imu/data_raw': codec.IMU,
    '/imu/data': codec.IMU,
    '/setpoint': codec.JOINTS,
    '/range': codec.RANGE,
    '/battery': codec.BATTERY,
    '/motors/command': codec.JOINTS,
    '/truth/odometry': codec.ODOMETRY,
}


class _Recorder:
    def __init__(self, bag: BagWriter, offset: int) -> None:
        self._bag = bag
        self._offset = offset
        self._messages = {topic: zeroed(kind) for topic, kind in _TYPES.items()}
        for topic, kind in _TYPES.items():
            bag.add(topic, kind)

    def write(self, topic: str, encode: Callable[[Any, Any], None], sample: Any) -> None:
        stamp = sample.stamp + self._offset
        encode(sample._replace(stamp=stamp), self._messages[topic])
        self._bag.write(topic, stamp, self._messages[topic])


def _fly(path: Path, plant: QuadSimulator, seconds: float, pilot: Callable[[float, str], Setpoint]) -> None:
    """Fly the whole chain and record what its nodes would hear; `pilot(time, arming state)`."""
    attitude, controller = AttitudeFilter(), AttitudeController()
    state = 'disarmed'
    offset = START - plant.stamp
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        record = _Recorder(bag, offset)
        for i in range(round(seconds * _RATE)):
            if i % _STICKS == 0:
                sticks = pilot(i / _RATE, state)._replace(stamp=plant.stamp)
                controller.on_setpoint(sticks)
                record.write('/setpoint', codec.encode_setpoint, sticks)
            if i % _RANGE == 0:
                height = plant.range()
                controller.on_range(height)
                record.write('/range', codec.encode_range, height)
            if i % _BATTERY == 0:
                battery = plant.battery()
                controller.on_battery(battery)
                record.write('/battery', codec.encode_battery, battery)
            if i % _TRUTH == 0:
                record.write('/truth/odometry', codec.encode_truth, plant.truth())
            imu = plant.sense()
            record.write('/imu/data_raw', codec.encode_imu, imu)
            command = None
            for item in attitude.on_imu(imu) or []:
                if type(item) is not Attitude:
                    continue
                record.write('/imu/data', codec.encode_attitude, item)
                for out in controller.on_attitude(item) or []:
                    if isinstance(out, MotorCommand):
                        command = out
                    elif isinstance(out, ArmingState):
                        state = out.name
            if command is not None:
                record.write('/motors/command', codec.encode_motors, command)
            plant.advance(command.pulses if command else None)


def _stand(path: Path) -> None:
    """Write 8 s on the stand: 2 s still at 10 degrees, arm, throttle to hover, level."""
    craft = CraftParams(pinned=True)
    hover = hover_fraction(craft)
    plant = QuadSimulator(craft, ImuErrorParams(), seed=61, roll=_TILT)

    def pilot(time: float, _state: str) -> Setpoint:
        return Setpoint(0, 0.0, 0.0, 0.0, hover if time > 2.5 else 0.0, time > 2.0)

    _fly(path, plant, 8.0, pilot)


def _free(path: Path) -> None:
    """Write 14 s of flight: 2 s on the ground, arm, climb, hold, lean 10 degrees for a second, level."""
    craft = CraftParams(gust=0.3)
    plant = QuadSimulator(craft, ImuErrorParams(), seed=62)

    def pilot(time: float, _state: str) -> Setpoint:
        roll = _TILT if 9.0 <= time < 10.0 else 0.0
        throttle = 1.25 * hover_fraction(craft) if time > 2.5 else 0.0
        return Setpoint(0, roll, 0.0, 0.0, throttle, time > 2.0, time > 4.0)

    _fly(path, plant, 14.0, pilot)


FIXTURES: dict[str, Callable[[Path], None]] = {'quad_stand_10deg': _stand, 'quad_free_10deg': _free}
