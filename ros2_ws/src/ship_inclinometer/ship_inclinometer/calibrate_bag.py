# SPDX-License-Identifier: Apache-2.0
"""Reads a bag in which the sensor was turned through all sides, and writes the estimator's YAML."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from bag_tools.bag import BagError, BagReader
from node_core.ports import BadMessage
from ship_inclinometer import topics
from ship_inclinometer.calibration import CalibrationError, fit_ellipsoid, gyro_bias, write_yaml
from ship_inclinometer.codec import decode_imu, decode_mag

GRAVITY = 9.80665
_USAGE = 2


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rates, specific forces and fields (N, 3) of a bag; messages that do not decode are left out."""
    rates, forces, fields = [], [], []
    with BagReader(path) as bag:
        imu, mag = f'/{topics.IMU}', f'/{topics.MAG}'
        for topic, _, data in bag.messages({imu, mag} & set(bag.topics)):
            message = bag.decode(data, bag.topics[topic].type)
            try:
                if topic == imu:
                    sample = decode_imu(message)
                    rates.append(sample.gyro)
                    forces.append(sample.force)
                else:
                    fields.append(decode_mag(message).field)
            except BadMessage:
                continue
    rate, force, field = (np.reshape(np.array(r, dtype=np.float64), (-1, 3)) for r in (rates, forces, fields))
    return rate, force, field


def command(arguments: list[str]) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog='calibration', description=__doc__)
    parser.add_argument('bag', type=Path, help='bag with imu/data_raw and imu/mag')
    parser.add_argument('--out', type=Path, default=Path('calibration.yaml'), help='YAML to write')
    parser.add_argument('--node', default='attitude_estimator', help='node name in the YAML')
    parser.add_argument('--field', type=float, help='norm of the field in µT; default: the mean radius')
    parser.add_argument(
        '--parts',
        default='magnetometer',
        help='comma-separated: magnetometer, accelerometer (turned slowly), gyro (at rest)',
    )
    options = parser.parse_args(arguments)
    known = {'magnetometer', 'accelerometer', 'gyro'}
    parts = set(options.parts.split(','))
    if parts - known:
        print(
            f'calibration: unknown part {sorted(parts - known)[0]!r}; known: {", ".join(sorted(known))}',
            file=sys.stderr,
        )
        return _USAGE
    part = ''
    try:
        rates, forces, fields = read(options.bag)
        sections, bias = {}, None
        if 'magnetometer' in parts:
            part = 'magnetometer'
            sections[part] = fit_ellipsoid(fields, None if options.field is None else 1e-6 * options.field)
        if 'accelerometer' in parts:
            part = 'accelerometer'
            sections[part] = fit_ellipsoid(forces, GRAVITY)
        if 'gyro' in parts:
            part = 'gyro'
            bias = gyro_bias(rates)
    except (BagError, CalibrationError) as error:
        print(f'calibration: {part + ": " if part else ""}{error}', file=sys.stderr)
        return _USAGE
    write_yaml(options.out, options.node, sections, bias)
    for name, calibration in sections.items():
        print(f'{name}: spread {100 * calibration.spread:.2f} %, coverage {100 * calibration.coverage:.0f} %')
    print(f'wrote {options.out}')
    return 0
