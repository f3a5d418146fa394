# SPDX-License-Identifier: Apache-2.0
"""Runs an estimator from bag to bag, without DDS and without rclpy.

The driver is the one of the live node (node_core.driver): same decoding, same handlers, same encoding.
Outputs carry the bag time of the message that caused them, so that equal inputs give equal bags.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools import rosargs
from bag_tools.bag import BagError, BagReader, BagWriter, resolve, zeroed
from bag_tools.cdr import decoder
from bag_tools.cli import Progress, guarded
from bag_tools.registry import find_ports
from kalman_core.health import Tally
from kalman_core.parameters import build
from node_core.driver import EstimatorDriver
from node_core.ports import Input, Output, Ports

# One health sample a second of bag time, as live nodes report on /diagnostics.
_HEALTH_PERIOD = 1_000_000_000  # ns
# Messages between two looks at the clock for the progress bar.
_PROGRESS_STRIDE = 512


@dataclass(slots=True)
class SensorHealth:
    """Once a second of bag time: stamps (ns), smoothed NIS and its gate; the gate is NaN where unknown."""

    stamps: list[int] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    gate: list[float] = field(default_factory=list)


@dataclass(slots=True)
class OfflineResult:
    """What a run did: messages in and out by topic, what was counted, wall time (s) without warm-up.

    `absent` are the input topics that the bag does not have; `start` is when the bag begins (ns).
    """

    inputs: dict[str, int]
    absent: list[str]
    outputs: dict[str, int]
    tally: Tally
    health: dict[str, SensorHealth]
    start: int
    seconds: float
    estimator: Any


def _check_inputs(reader: BagReader, ports: Ports, names: Mapping[str, Input]) -> dict[str, Input]:
    present = {}
    for name, port in names.items():
        topic = reader.topics.get(name)
        if topic is None:
            continue
        if topic.type != port.type:
            raise BagError(f"{reader.path}: topic '{name}' is {topic.type}, {ports.name} expects {port.type}")
        present[name] = port
    if not present:
        known = ', '.join(sorted(reader.topics)) or 'none'
        raise BagError(
            f'{reader.path}: has none of the inputs of {ports.name} ({", ".join(names)}); it has: {known}'
        )
    return present


def _check_remaps(ports: Ports, remaps: Mapping[str, str]) -> None:
    topics = [p.topic for p in ports.inputs] + [p.topic for p in ports.outputs.values()]
    known = {resolve(topic, ports.name) for topic in topics}
    for source in remaps:
        if resolve(source, ports.name) not in known:
            listed = ', '.join(sorted(known))
            raise BagError(f"remap of '{source}': {ports.name} has no such topic; it has: {listed}")


def _note_health(health: dict[str, SensorHealth], tally: Tally, stamp: int) -> None:
    for name, sensor in tally.sensors.items():
        if sensor.nis is not None:
            record = health.setdefault(name, SensorHealth())
            record.stamps.append(stamp)
            record.nis.append(sensor.nis)
            record.gate.append(float('nan') if sensor.gate is None else sensor.gate)


class _Sink:
    """Writes estimates into one preallocated message per output."""

    def __init__(self, writer: BagWriter, ports: Ports, remaps: dict[str, str]) -> None:
        self._writer = writer
        self._slots: dict[int, tuple[str, Any, Any]] = {}
        for output in ports.outputs.values():
            topic = rosargs.remapped(output.topic, remaps, ports.name)
            writer.add(topic, output.type, latched=output.latched)
            self._slots[id(output)] = (topic, output.encode, zeroed(output.type))

    def write(self, pairs: list[tuple[Output, Any]], stamp: int) -> None:
        for output, estimate in pairs:
            topic, encode, message = self._slots[id(output)]
            encode(estimate, message)
            self._writer.write(topic, stamp, message)


def _run(
    reader: BagReader,
    writer: BagWriter,
    driver: EstimatorDriver,
    inputs: dict[str, Input],
    sink: _Sink,
    copies: Collection[str],
    progress: Progress,
) -> tuple[dict[str, int], dict[str, SensorHealth]]:
    counts = dict.fromkeys(inputs, 0)
    health: dict[str, SensorHealth] = {}
    feed, put = driver.feed, sink.write
    decoders = {topic: decoder(reader.store, port.type) for topic, port in inputs.items()}
    next_health = reader.start + _HEALTH_PERIOD
    for number, (topic, stamp, data) in enumerate(reader.messages({*inputs, *copies})):
        if topic in copies:
            writer.write_raw(topic, stamp, data)
        port = inputs.get(topic)
        if port is not None:
            counts[topic] += 1
            try:
                message = decoders[topic](data)
            except Exception as error:
                raise BagError(f"{reader.path}: message {counts[topic]} of '{topic}' is damaged") from error
            pairs = feed(port, message)
            if pairs:
                put(pairs, stamp)
        if stamp >= next_health:
            _note_health(health, driver.tally, stamp)
            next_health = stamp + _HEALTH_PERIOD
        if not number % _PROGRESS_STRIDE:
            progress.update(stamp - reader.start)
    return counts, health


def offline(
    ports: Ports,
    params: Mapping[str, Any] | Any,
    bag_in: str | Path,
    bag_out: str | Path,
    remaps: Mapping[str, str] | None = None,
    *,
    copy: Collection[str] = (),
    storage: str | None = None,
    compression: str = 'none',
    overwrite: bool = False,
) -> OfflineResult:
    """Feed `bag_in` to the estimator of `ports` and write what it says to `bag_out`.

    `params` is an instance of ``ports.params`` or a mapping of values (checked). `remaps` renames inputs and
    outputs as ``-r a:=b`` does. Topics in `copy` (truth, for example) are copied as they are; '*' copies
    every topic that is not an output. Raises BagError and ParameterError; no partial bag is left.
    """
    values = params if isinstance(params, ports.params) else build(ports.params, dict(params))
    names = dict(remaps or {})
    with BagReader(bag_in) as reader:
        _check_remaps(ports, names)
        wanted = {rosargs.remapped(p.topic, names, ports.name): p for p in ports.inputs}
        inputs = _check_inputs(reader, ports, wanted)
        outputs = {rosargs.remapped(o.topic, names, ports.name) for o in ports.outputs.values()}
        copies = set(reader.topics) - outputs if '*' in copy else {reader.topic(name).name for name in copy}
        if clash := copies & outputs:
            raise BagError(f"{reader.path}: topic '{min(clash)}' cannot be copied, {ports.name} writes it")
        if ports.warm is not None:
            ports.warm()
        driver = EstimatorDriver(ports, values)
        started = time.perf_counter()
        with (
            BagWriter(bag_out, storage=storage, compression=compression, overwrite=overwrite) as writer,
            Progress(ports.name, reader.stop - reader.start) as progress,
        ):
            for name in sorted(copies):
                topic = reader.topics[name]
                writer.add(name, topic.type, qos=topic.qos[:1], store=reader.store)
            sink = _Sink(writer, ports, names)
            counts, health = _run(reader, writer, driver, inputs, sink, copies, progress)
    seconds = time.perf_counter() - started
    written = {name: writer.counts[name] for name in sorted(outputs)}
    absent = sorted(set(wanted) - set(inputs))
    return OfflineResult(
        counts, absent, written, driver.tally, health, reader.start, seconds, driver.estimator
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='offline',
        description='Run an estimator from bag to bag without DDS.',
        epilog='Parameters and remaps follow --ros-args: -p name:=value, --params-file f.yaml, -r from:=to.',
    )
    parser.add_argument('package', help='package of the estimator, for example imu_kalman')
    parser.add_argument('estimator', help='its name, for example attitude_estimator')
    parser.add_argument('bag_in', help='bag with the inputs')
    parser.add_argument('bag_out', help='bag to write: a folder name, or a .mcap or .db3 file')
    parser.add_argument(
        '--copy', nargs='+', default=[], metavar='TOPIC', help="topics to copy as they are ('*': all)"
    )
    parser.add_argument('--storage', choices=('mcap', 'sqlite3'), help='default: by suffix, else mcap')
    parser.add_argument('--compression', choices=('none', 'zstd'), default='none')
    parser.add_argument('--overwrite', action='store_true', help='replace an existing bag')
    return parser


def _summary(result: OfflineResult, stop: float) -> str:
    lines = [f'{n} in   {topic}' for topic, n in result.inputs.items()]
    lines += [f'0 in   {topic} (not in the bag)' for topic in result.absent]
    lines += [f'{n} out  {topic}' for topic, n in result.outputs.items()]
    for name, health in result.health.items():
        lines.append(f'mean NIS of {name}: {np.nanmean(health.nis):.3g}')
    for name, sensor in result.tally.sensors.items():
        reasons = ', '.join(f'{reason} ({n})' for reason, n in sensor.rejected.most_common())
        if reasons:
            lines.append(f'rejected from {name}: {reasons}')
    lines += [f'restarted: {reason}' for reason in result.tally.restarts]
    lines.append(f'{result.seconds:.2f} s for {stop:.1f} s of data')
    return '\n'.join(lines)


def run(argv: list[str]) -> int:
    """Run one estimator as the command line says."""
    own, ros = rosargs.split(argv, implied=True)
    options = _parser().parse_args(own)
    arguments = rosargs.parse(ros)
    ports = find_ports(options.package, options.estimator)
    values = rosargs.estimator_parameters(arguments, arguments.node or ports.name)
    result = offline(
        ports,
        values,
        options.bag_in,
        options.bag_out,
        arguments.remaps,
        copy=options.copy,
        storage=options.storage,
        compression=options.compression,
        overwrite=options.overwrite,
    )
    with BagReader(options.bag_in) as reader:
        print(_summary(result, (reader.stop - reader.start) * 1e-9))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('offline', run, argv)


if __name__ == '__main__':
    sys.exit(main())
