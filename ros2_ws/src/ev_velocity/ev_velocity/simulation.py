# SPDX-License-Identifier: Apache-2.0
"""Drives of the plant with its sensors, as the same `Drive` that the scenarios give."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ev_velocity import plant
from ev_velocity.plant import Car
from ev_velocity.scenarios import (
    DURATION,
    GOOD_ROAD,
    RATE,
    SCENARIOS,
    Drive,
    Settings,
    acceleration_profile,
    observe,
    simulate,
)


@dataclass(frozen=True, slots=True)
class Course:
    """A road and what the driver wants on it."""

    phases: tuple[tuple[float, float], ...] = GOOD_ROAD
    patches: tuple[tuple[float, float, float], ...] = ()  # from m, to m, friction coefficient
    hills: tuple[tuple[float, float, float], ...] = ()  # from m, to m, grade
    accelerator_limit: float = 0.7
    brake_limit: float = 0.6
    abs_slip: float = 0.0  # 0: no ABS
    car: Car = field(default_factory=Car)
    sensors: Settings = field(default_factory=Settings)
    encoder_axle: str = 'front'


_LIMITED = ((2.0, 4.0), (0.0, 8.0), (-2.0, 60.0))
_STOP_AND_GO = tuple(
    phase for _ in range(4) for phase in ((1.5, 4.0), (0.0, 2.0), (-2.0, 3.2), (0.0, 4.0))
) + ((-2.0, 60.0),)

COURSES: dict[str, Course] = {
    'plant_good_road': Course(),
    # The patch under the driven axle while it accelerates, as in the paper's second test.
    'plant_oil_patch': Course(
        phases=((2.2, 5.0), (0.0, 10.0), (-2.5, 60.0)),
        patches=((16.0, 18.5, 0.08),),
        accelerator_limit=1.0,
        encoder_axle='rear',
    ),
    'plant_abs_braking': Course(
        phases=((2.0, 7.0), (0.0, 8.0), (-6.0, 60.0)),
        patches=((0.0, 1e4, 0.35),),
        brake_limit=1.0,
        abs_slip=0.15,
    ),
    'plant_four_wheel_spin': Course(
        phases=((2.5, 5.0), (0.0, 10.0), (-1.0, 60.0)),
        patches=((30.0, 60.0, 0.12),),
        accelerator_limit=1.0,
        car=Car(all_wheels_driven=True),
    ),
    'plant_long_hill': Course(hills=((60.0, 260.0, 0.08), (280.0, 420.0, -0.06)), accelerator_limit=1.0),
    'plant_stop_and_go': Course(phases=_STOP_AND_GO),
    'plant_multipath': Course(sensors=Settings(gps_rate=1.0, multipath=(18.0, 25.0, 5.8))),
    'plant_tunnel': Course(sensors=Settings(outage=(8.0, 38.0))),
    'plant_limited_grip': Course(
        phases=_LIMITED, patches=((0.0, 1e4, 0.25),), abs_slip=0.15, brake_limit=1.0
    ),
}


def _table(rows: tuple[tuple[float, float, float], ...]) -> np.ndarray:
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def drive_course(course: Course, seed: int, duration: float = DURATION) -> Drive:
    """Return a drive of `duration` s on `course`: the plant does not depend on the seed, its sensors do."""
    t = np.arange(round(duration * RATE) + 1) / RATE
    wanted = acceleration_profile(course.phases, t)
    targets = np.maximum(np.cumsum(wanted) / RATE, 0.0)
    last = sum(length for _, length in course.phases[:-1])
    stopped = np.flatnonzero((t > last) & (targets <= 0.0))
    if stopped.size:
        targets[stopped[0] :] = 0.0
    limits = np.array([course.accelerator_limit, course.brake_limit])
    out = plant.drive(
        course.car.array(),
        targets,
        limits,
        _table(course.patches),
        _table(course.hills),
        course.abs_slip,
        1.0 / RATE,
    )
    v, a, x, front, rear, accelerator, brake, grade = out.T
    wheel = rear if course.encoder_axle == 'rear' else front
    # The tyres' slip is in the wheel already; no grade but the course's and the road's own.
    settings = replace(course.sensors, slip_per_acceleration=0.0)
    return observe(settings, seed, t, v, a, x, wheel, grade, accelerator, brake)


def named(name: str, seed: int, duration: float = DURATION) -> Drive:
    """Return the drive of a scenario or a course; raises KeyError with the known names."""
    if name in COURSES:
        return drive_course(COURSES[name], seed, duration)
    if name in SCENARIOS:
        return simulate(SCENARIOS[name], seed, duration)
    raise KeyError(f"unknown scenario '{name}'; known: {', '.join((*SCENARIOS, *COURSES))}")
