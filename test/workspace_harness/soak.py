# SPDX-License-Identifier: Apache-2.0
"""Endurance: hours of simulated time through an estimator, watched for growth and for bad covariances.

The input is a fixture, decoded once and repeated with shifted stamps, so that it costs next to nothing. At
each seam the world jumps, which no estimator may remember for ever.
"""

from __future__ import annotations

import copy
import gc
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools.bag import BagReader, resolve, zeroed
from bag_tools.cdr import decoder
from bag_tools.registry import find_ports
from ins_gps.replays import REPLAYS as INS_REPLAYS
from kalman_core.parameters import build
from node_core.driver import EstimatorDriver
from node_core.messages import set_stamp, stamp_of
from node_core.ports import Input, Ports
from workspace_harness.make_bags import root

# Every so many outputs the covariance is looked at: its eigenvalues cost as much as a filter step.
_CHECKED_EVERY = 50
# Every so many repetitions of the fixture a fresh estimator goes through the same one.
_FRESH_EVERY = 5
# Lengths of flattened covariance matrices in messages, and their sizes.
_SIZES = {9: 3, 36: 6}
# Eigenvalues this much below the largest are rounding.
_ROUNDING = 1e-14
_MEGABYTE = 1e6


@dataclass(frozen=True)
class Course:
    """One estimator on one fixture. `upstream` names an estimator of the package that makes its inputs.

    `renamed` maps topics of the bag to inputs.
    """

    package: str
    estimator: str
    bag: str
    params: Mapping[str, Any] = field(default_factory=dict)
    upstream: str = ''
    renamed: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Package and estimator."""
        return f'{self.package} {self.estimator}'


def _ins_params() -> dict[str, Any]:
    return dict(next(r for r in INS_REPLAYS if r.bag == 'gnss_outage').entries[-1].params)


# Where the trajectory of the fixture begins: latitude °, longitude °, height m.
_BASE = (21.0, 105.8, 100.0)
COURSES = (
    Course('imu_kalman', 'angle_estimator', 'imu_hand_held'),
    Course('imu_kalman', 'attitude_estimator', 'imu_hand_held'),
    Course('ship_inclinometer', 'attitude_estimator', 'ship_beam_sea'),
    Course('ship_inclinometer', 'roll_analysis', 'ship_beam_sea', upstream='attitude_estimator'),
    Course('ev_velocity', 'velocity_estimator', 'ev_good_road'),
    Course('ev_velocity', 'fusion_estimator', 'ev_good_road'),
    Course('ins_gps', 'ins_gps_estimator', 'gnss_outage', _ins_params()),
    Course(
        'ins_gps',
        'dgps_base',
        'gnss_outage',
        {'position': _BASE},
        renamed={'/gnss/observations': '/base/observations'},
    ),
    Course('quad_control', 'attitude_filter', 'quad_free_10deg'),
    Course('quad_control', 'attitude_controller', 'quad_free_10deg'),
)


@dataclass(frozen=True)
class Part:
    """One part of a run: processor time (s) per sample, that of a fresh estimator, memory (MB) at its end."""

    hours: float
    seconds_per_sample: float
    fresh_seconds_per_sample: float
    memory: float


@dataclass(frozen=True)
class Soak:
    """What a run showed: its parts, messages in and out, and outputs whose numbers or covariance are bad."""

    course: Course
    parts: tuple[Part, ...]
    samples: int
    outputs: int
    bad: int

    @property
    def growth(self) -> float:
        """Memory at the end over that at the end of the first part (MB)."""
        return self.parts[-1].memory - self.parts[0].memory

    @property
    def slowdown(self) -> float:
        """Time per sample in the last third over that in the first third; medians of the parts.

        Each part counts in units of a fresh estimator in the same minutes: the machine may have more to do
        at one end of the day than at the other.
        """
        third = max(len(self.parts) // 3, 1)
        times = [part.seconds_per_sample / part.fresh_seconds_per_sample for part in self.parts]
        return float(np.median(times[-third:]) / np.median(times[:third]))


def memory() -> float:
    """Return the resident memory of this process (MB)."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / _MEGABYTE


def _messages(course: Course, ports: Ports) -> list[tuple[Input, Any, int]]:
    """Return (input, decoded message, stamp ns) in the order of the bag."""
    path = root() / 'bags' / f'{course.bag}.mcap'
    above = find_ports(course.package, course.upstream) if course.upstream else ports
    heard = {resolve(port.topic): port for port in above.inputs}
    rows = []
    with BagReader(path) as reader:
        names = {t: course.renamed.get(t, t) for t in reader.topics}
        wanted = {t for t, name in names.items() if name in heard}
        decoders = {t: decoder(reader.store, reader.topics[t].type) for t in wanted}
        for topic, _, data in reader.messages(wanted):
            message = decoders[topic](data)
            rows.append((heard[names[topic]], message, stamp_of(message)))
    return _through(course, above, ports, rows) if course.upstream else rows


def _through(
    course: Course, above: Ports, ports: Ports, rows: list[tuple[Input, Any, int]]
) -> list[tuple[Input, Any, int]]:
    """Return what the upstream estimator says to the inputs of `ports`."""
    driver = EstimatorDriver(above, build(above.params, {}))
    heard = {resolve(port.topic): port for port in ports.inputs}
    found = []
    for port, message, _ in rows:
        for output, estimate in driver.feed(port, message):
            below = heard.get(resolve(output.topic))
            if below is not None:
                out = zeroed(output.type)
                output.encode(estimate, out)
                found.append((below, copy.deepcopy(out), stamp_of(out)))
    return found


def covariances(message: Any) -> Iterator[np.ndarray]:
    """Yield the covariance matrices in `message` and the messages it holds; unknown ones are left out."""
    for name in getattr(message, '__dataclass_fields__', ()):
        value = getattr(message, name)
        if name.endswith('covariance') and len(value) in _SIZES:
            size = _SIZES[len(value)]
            matrix = np.asarray(value, dtype=np.float64).reshape(size, size)
            used = np.flatnonzero(np.any(matrix != 0.0, axis=1))
            if matrix[0, 0] >= 0.0 and len(used):
                yield matrix[np.ix_(used, used)]
        elif hasattr(value, '__dataclass_fields__'):
            yield from covariances(value)


def positive_definite(matrix: np.ndarray) -> bool:
    """Return whether a covariance is finite, symmetric and has no eigenvalue of 0 or below.

    Rows are first scaled to a unit diagonal, so that units do not count.
    """
    if not np.isfinite(matrix).all() or (np.diag(matrix) <= 0.0).any():
        return False
    sigma = np.sqrt(np.diag(matrix))
    scaled = matrix / np.outer(sigma, sigma)
    symmetric = np.allclose(scaled, scaled.T, atol=1e-9)
    return bool(symmetric and np.linalg.eigvalsh(scaled)[0] > -_ROUNDING * len(scaled))


class _Run:
    """An estimator under way, with the processor time (s) and the messages it has taken."""

    def __init__(self, course: Course, ports: Ports) -> None:
        self.driver = EstimatorDriver(ports, build(ports.params, dict(course.params)))
        self.spent = 0.0
        self.samples = self.outputs = self.bad = 0
        self._slots = {id(o): zeroed(o.type) for o in ports.outputs.values()}

    def feed(self, rows: list[tuple[Input, Any, int]], shift: int) -> None:
        """Put `rows` through, their stamps later by `shift` ns."""
        started = time.process_time()
        for port, message, stamp in rows:
            set_stamp(message.header, stamp + shift)
            for output, estimate in self.driver.feed(port, message):
                out = self._slots[id(output)]
                output.encode(estimate, out)
                self.outputs += 1
                if self.outputs % _CHECKED_EVERY == 0:
                    self.bad += not all(positive_definite(c) for c in covariances(out))
        self.spent += time.process_time() - started
        self.samples += len(rows)

    def seconds_per_sample(self) -> float:
        """Return the time per message since the last call (s)."""
        taken = self.spent / self.samples
        self.spent, self.samples = 0.0, 0
        return taken


def soak(course: Course, hours: float, parts: int) -> Soak:
    """Run `course` for so many simulated hours, in `parts` equal parts of whole repetitions."""
    ports = find_ports(course.package, course.estimator)
    if ports.warm is not None:
        ports.warm()
    aged = _Run(course, ports)
    rows = _messages(course, ports)
    stamps = np.array([stamp for _, _, stamp in rows])
    # The seam is as long as the slowest sensor's step can be: no stamp comes twice.
    length = int(stamps.max() - stamps.min()) + 1_000_000_000
    cycles = max(round(hours * 3.6e12 / length / parts), 1)
    found, shift = [], 0
    for _ in range(parts):
        fresh = _Run(course, ports)
        for cycle in range(cycles):
            aged.feed(rows, shift)
            if cycle % _FRESH_EVERY == 0:
                fresh.feed(rows, shift)
            shift += length
        times = aged.seconds_per_sample(), fresh.seconds_per_sample()
        del fresh
        gc.collect()  # an estimator that is gone is no growth of the other
        found.append(Part(cycles * length / 3.6e12, *times, memory()))
    state = getattr(aged.driver.estimator, 'state', np.zeros(0))
    # NaN marks what is not known yet in some states: infinity never is a state.
    bad = aged.bad + int(np.isinf(state).any())
    return Soak(course, tuple(found), parts * cycles * len(rows), aged.outputs, bad)
