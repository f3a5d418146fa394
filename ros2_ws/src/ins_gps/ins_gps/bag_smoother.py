# SPDX-License-Identifier: Apache-2.0
"""Smooths a bag: the estimator's own inputs in order of their stamps, its smoothed solution out."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from bag_tools import rosargs
from bag_tools.bag import BagError, BagReader, BagWriter, zeroed
from ins_gps import codec
from ins_gps import layout as at
from ins_gps.params import FilterParams
from ins_gps.plausibility import imu_fault
from ins_gps.samples import FixEstimate, ImuSample, NavigationEstimate
from ins_gps.smoother import Aid, SmoothedRun, Smoother
from kalman_core.earth import ecef_from_geodetic, enu_from_ecef
from kalman_core.health import Tally
from node_core.ports import BadMessage

NAME = 'smoother'
ODOMETRY = 'odometry_smoothed'
POSITION = 'position_smoothed'
_IMU = 'imu/data_raw'
# North-east-down to the order and signs of east-north-up.
_ENU = np.array([1, 0, 2])
_SIGNS = np.outer([1.0, 1.0, -1.0], [1.0, 1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Inputs:
    """What a bag holds for the filter, in order of stamps: IMU (n,), (n, 3), (n, 3), bag times, aids."""

    stamps: np.ndarray
    rate: np.ndarray
    force: np.ndarray
    times: np.ndarray
    aids: list[Aid]
    counts: dict[str, int]
    refused: Counter[str]


@dataclass(frozen=True, slots=True)
class SmoothedBag:
    """What was read and written by topic, what was refused and why, and the run itself."""

    inputs: dict[str, int]
    outputs: dict[str, int]
    refused: Counter[str]
    tally: Tally
    run: SmoothedRun


def read_inputs(bag: BagReader, remaps: Mapping[str, str] | None = None) -> Inputs:
    """Read the inputs of the estimator under their (remapped) names; BagError without an IMU or any aid."""
    names = {rosargs.remapped(p.topic, dict(remaps or {}), NAME): p for p in codec.INS_GPS_PORTS.inputs}
    present = {name: port for name, port in names.items() if name in bag.topics}
    imu_name = next(name for name, port in names.items() if port.topic == _IMU)
    if imu_name not in present or len(present) < 2:
        raise BagError(
            f'{bag.path}: needs {imu_name} and one of {", ".join(n for n in names if n != imu_name)}; '
            f'it has: {", ".join(sorted(bag.topics)) or "none"}'
        )
    imu: list[tuple[int, ImuSample]] = []
    aids: list[tuple[int, int, Any]] = []
    order = {name: index for index, name in enumerate(names)}
    counts: dict[str, int] = dict.fromkeys(present, 0)
    refused: Counter[str] = Counter()
    for topic, time, data in bag.messages(list(present)):
        port = present[topic]
        counts[topic] += 1
        try:
            sample = port.decode(bag.decode(data, port.type))
        except BadMessage as error:
            refused[f'{topic}: {error}'] += 1
            continue
        if topic != imu_name:
            aids.append((sample.stamp, order[topic], sample))
        elif fault := imu_fault(sample):
            refused[f'{topic}: {fault}'] += 1
        else:
            imu.append((time, sample))
    if not imu:
        raise BagError(f"{bag.path}: topic '{imu_name}' has no usable message")
    stamps, first = np.unique([s.stamp for _, s in imu], return_index=True)
    kept = [imu[i] for i in first]
    aids.sort(key=itemgetter(0, 1))
    return Inputs(
        stamps,
        np.array([s.rate for _, s in kept]),
        np.array([s.force for _, s in kept]),
        np.array([time for time, _ in kept], dtype=np.int64),
        [sample for _, _, sample in aids],
        counts,
        refused,
    )


def estimates(run: SmoothedRun, inputs: Inputs) -> Iterator[NavigationEstimate]:
    """Yield the smoothed solution at the stamps of the IMU."""
    navigation = run.navigation
    origin = navigation.state[at.ORIGIN : at.ORIGIN + 3].copy()
    index = np.searchsorted(inputs.stamps, run.imu_stamps)
    biases = np.stack([np.interp(run.imu_stamps, run.stamps, run.biases[:, 3 + k]) for k in range(3)], axis=1)
    step = float(np.median(np.diff(inputs.stamps))) * 1e-9 if len(inputs.stamps) > 1 else 1.0
    variance = navigation.params.gyro_noise**2 / max(step, 1e-3) + navigation.params.gyro_bias_sigma**2
    for k, (stamp, nav) in enumerate(zip(run.imu_stamps, run.imu_smoothed, strict=True)):
        enu = enu_from_ecef(ecef_from_geodetic(nav[0], nav[1], nav[2]), origin[0], origin[1], origin[2])
        yield NavigationEstimate(
            int(stamp),
            nav[:3],
            origin,
            enu,
            nav[3:6],
            nav[6:10],
            inputs.rate[index[k]] - biases[k],
            run.covariance_at(int(stamp)),
            variance,
        )


def smooth_bag(
    bag_in: str | Path,
    bag_out: str | Path,
    params: FilterParams,
    remaps: Mapping[str, str] | None = None,
    *,
    copy: Collection[str] = (),
    compression: str = 'none',
    overwrite: bool = False,
) -> SmoothedBag:
    """Write `bag_out` with the smoothed odometry at the IMU's stamps and positions at the epochs.

    Topics in `copy` are copied as they are ('*': all). Bag times are those of the IMU messages. Raises
    BagError and ParameterError; no partial bag is left.
    """
    with BagReader(bag_in) as bag:
        inputs = read_inputs(bag, remaps)
        try:
            run = Smoother(params).run(inputs.stamps, inputs.rate, inputs.force, inputs.aids)
        except ValueError as error:
            raise BagError(f'{bag.path}: {error}') from None
        names = {topic: rosargs.remapped(topic, dict(remaps or {}), NAME) for topic in (ODOMETRY, POSITION)}
        copies = set(bag.topics) if '*' in copy else {bag.topic(name).name for name in copy}
        if clash := copies & set(names.values()):
            raise BagError(f"{bag.path}: topic '{min(clash)}' cannot be copied, {NAME} writes it")
        with BagWriter(bag_out, compression=compression, overwrite=overwrite) as writer:
            for name in sorted(copies):
                topic = bag.topics[name]
                writer.add(name, topic.type, qos=topic.qos[:1], store=bag.store)
            writer.add(names[ODOMETRY], codec.ODOMETRY)
            writer.add(names[POSITION], codec.FIX)
            _write(writer, bag, inputs, run, names, copies)
    return SmoothedBag(inputs.counts, dict(writer.counts), inputs.refused, run.navigation.tally, run)


def _write(writer: BagWriter, bag: BagReader, inputs: Inputs, run: SmoothedRun, names, copies) -> None:
    odometry, fix = zeroed(codec.ODOMETRY), zeroed(codec.FIX)
    delay = (inputs.times - inputs.stamps).astype(float)

    def time_of(stamp: int) -> int:
        return stamp + round(float(np.interp(stamp, inputs.stamps, delay)))

    solutions = ((time_of(e.stamp), 0, e) for e in estimates(run, inputs))
    places = (
        (time_of(int(t)), 1, FixEstimate(int(t), nav[:3], P[np.ix_(_ENU, _ENU)] * _SIGNS))
        for t, nav, P in zip(run.stamps, run.smoothed, run.smoothed_covariance, strict=True)
    )
    copied = ((time, 2, (name, data)) for name, time, data in bag.messages(copies)) if copies else ()
    merged: Iterator[tuple[int, int, Any]] = heapq.merge(solutions, places, copied, key=itemgetter(0))
    for time, kind, what in merged:
        if kind == 0:
            codec.encode_odometry(what, odometry)
            writer.write(names[ODOMETRY], time, odometry)
        elif kind == 1:
            codec.encode_fix(what, fix)
            writer.write(names[POSITION], time, fix)
        else:
            writer.write_raw(what[0], time, what[1])
