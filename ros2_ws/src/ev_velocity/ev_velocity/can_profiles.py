# SPDX-License-Identifier: Apache-2.0
"""Which signals of a car's DBC say what the package needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

KMH = 1.0 / 3.6  # m/s
PERCENT = 0.01


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal of a frame; (value · factor + add) is in SI. `period` (s) is how often its frame comes."""

    frame: str
    name: str
    factor: float = 1.0
    period: float = 0.02


@dataclass(frozen=True, slots=True)
class Profile:
    """The signals of one car. `gears` maps raw gear values to 1, −1 or 0; others are unknown."""

    wheels: Mapping[str, Signal]
    accelerator: Signal
    brake: Signal | None = None  # pressure or travel
    brake_switch: Signal | None = None
    speed: Signal | None = None
    gear: Signal | None = None
    gears: Mapping[int, int] = field(default_factory=dict)
    reverse: Signal | None = None  # a bit of its own
    acceleration: Signal | None = None  # along the car
    counters: Mapping[str, str] = field(default_factory=dict)  # frame → rolling counter

    def signals(self) -> tuple[Signal, ...]:
        """Return every signal of the profile."""
        single = (
            self.accelerator, self.brake, self.brake_switch, self.speed, self.gear, self.reverse,
            self.acceleration,
        )  # fmt: skip
        return (*self.wheels.values(), *(s for s in single if s is not None))


IMIEV = Profile(
    wheels={
        'wheel_1': Signal('WHEELS_1_2', 'WHEEL_1', KMH),
        'wheel_2': Signal('WHEELS_1_2', 'WHEEL_2', KMH),
        'wheel_3': Signal('BRAKE_WHEELS_3_4', 'WHEEL_3', KMH),
        'wheel_4': Signal('BRAKE_WHEELS_3_4', 'WHEEL_4', KMH),
    },
    accelerator=Signal('ACCELERATOR', 'ACCELERATOR', PERCENT),
    brake=Signal('BRAKE_WHEELS_3_4', 'BRAKE'),
    speed=Signal('SPEED', 'SPEED', KMH),
    gear=Signal('GEAR', 'GEAR'),
    gears={0x50: 0, 0x4E: 0, 0x52: -1, 0x44: 1, 0x83: 1, 0x32: 1},
)

# The acceleration has its sign turned and a doubtful scale; there is no reference to it.
TOYOTA86 = Profile(
    wheels={
        'wheel_front_left': Signal('ID_D4', 'WS_FL'),
        'wheel_front_right': Signal('ID_D4', 'WS_FR'),
        'wheel_rear_left': Signal('ID_D4', 'WS_RL'),
        'wheel_rear_right': Signal('ID_D4', 'WS_RR'),
    },
    accelerator=Signal('ID_140', 'THROTTLE', PERCENT, 0.01),
    brake=Signal('ID_D1', 'BRAKE', PERCENT),
    speed=Signal('ID_D1', 'SPEED'),
    gear=Signal('ID_141', 'GEAR', period=0.01),
    gears={0: 0, 1: 1, 2: 1, 3: 1, 4: 1, 5: 1, 6: 1},
    reverse=Signal('ID_154', 'REVERSE', period=1.0),
    acceleration=Signal('ID_D0', 'ACCEL_LONG', -1.0),
)

PROFILES = {'imiev': IMIEV, 'toyota86': TOYOTA86}
