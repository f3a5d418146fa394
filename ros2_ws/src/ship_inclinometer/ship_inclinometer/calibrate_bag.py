# SPDX-License-Identifier: Apache-2.0
"""Reads a bag in which the sensor was turned through all sides, and writes the estimator's YAML."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from bag_tools.bag import BagError, BagReader
from kalman_core.parameters import ParameterError, build
from node_core.ports import BadMessage
from ship_inclinometer import topics
from ship_inclinometer.calibration import CalibrationError, fit_ellipsoid, gyro_bias, write_yaml
from ship_inclinometer.codec import decode_gnss, decode_imu, decode_mag
from ship_inclinometer.params import AttitudeParams
from ship_inclinometer.samples import ImuSample, MagSample
from ship_inclinometer.swing_bag import swing_of

GRAVITY = 9.80665
_USAGE = 2


class Samples(NamedTuple):
    """Rates, specific forces and fields (N, 3) of a bag, and all of its samples in order of arrival."""

    rates: np.ndarray
    forces: np.ndarray
    fields: np.ndarray
    ordered: list[Any]


_DECODERS = {topics.IMU: decode_imu, topics.MAG: decode_mag, topics.GNSS: decode_gnss}
_PARTS = ('magnetometer', 'accelerometer', 'gyro', 'swing')


def read(path: Path) -> Samples:
    """Return the samples of a bag; messages that do not decode are left out."""
    ordered: list[Any] = []
    with BagReader(path) as bag:
        known = {f'/{topic}': decode for topic, decode in _DECODERS.items()}
        for topic, _, data in bag.messages(known.keys() & set(bag.topics)):
            try:
                ordered.append(known[topic](bag.decode(data, bag.topics[topic].type)))
            except BadMessage:
                continue
    imu = [s for s in ordered if isinstance(s, ImuSample)]
    mag = [s for s in ordered if isinstance(s, MagSample)]
    columns = [s.gyro for s in imu], [s.force for s in imu], [s.field for s in mag]
    rates, forces, fields = (np.reshape(np.array(c, dtype=np.float64), (-1, 3)) for c in columns)
    return Samples(rates, forces, fields, ordered)


def _arguments(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='calibration', description=__doc__)
    parser.add_argument('bag', type=Path, help='bag with imu/data_raw and imu/mag, for a swing gnss/velocity')
    parser.add_argument('--out', type=Path, default=Path('calibration.yaml'), help='YAML to write')
    parser.add_argument('--node', default='attitude_estimator', help='node name in the YAML')
    parser.add_argument('--field', type=float, help='norm of the field in µT; default: the mean radius')
    parser.add_argument(
        '--parts',
        default='magnetometer',
        help='comma-separated: magnetometer, accelerometer (turned slowly), gyro (at rest), '
        'swing (steady legs on all headings)',
    )
    parser.add_argument(
        '--with',
        dest='earlier',
        type=Path,
        help='YAML of an earlier calibration: used and written anew with it',
    )
    return parser.parse_args(arguments)


def _earlier(path: Path | None, node: str) -> dict[str, Any]:
    """Return the parameters of an earlier calibration; raise CalibrationError when it cannot be used."""
    if path is None:
        return {}
    try:
        values = dict(yaml.safe_load(path.read_text(encoding='utf-8'))[node]['ros__parameters'])
        build(AttitudeParams, values)
    except (OSError, yaml.YAMLError, TypeError, KeyError, ParameterError) as error:
        raise CalibrationError(f'{path}: no parameters of {node} ({error})') from error
    return values


def _calibrate(options: argparse.Namespace, parts: set[str], values: dict[str, Any]) -> Iterator[str]:
    """Fill `values` part by part; yield a line on each."""
    samples = read(options.bag)
    field = None if options.field is None else 1e-6 * options.field
    for name, raw, norm in (
        ('magnetometer', samples.fields, field),
        ('accelerometer', samples.forces, GRAVITY),
    ):
        if name in parts:
            fitted = _named(name, lambda raw=raw, norm=norm: fit_ellipsoid(raw, norm))
            values[f'{name}_matrix'] = fitted.matrix.ravel().tolist()
            values[f'{name}_offset'] = fitted.offset.tolist()
            yield f'{name}: spread {100 * fitted.spread:.2f} %, coverage {100 * fitted.coverage:.0f} %'
    if 'gyro' in parts:
        values['gyro_offset'] = _named('gyro', lambda: gyro_bias(samples.rates)).tolist()
        yield 'gyro: ' + ', '.join(f'{math.degrees(v):.3f}' for v in values['gyro_offset']) + ' °/s'
    if 'swing' in parts:
        params = build(AttitudeParams, values)
        coefficients = _named('swing', lambda: swing_of(samples.ordered, params))
        values['deviation_coefficients'] = coefficients.tolist()
        yield 'swing: A … E ' + ', '.join(f'{v:.2f}' for v in coefficients) + ' °'


def _named(part: str, calibrate: Callable[[], Any]) -> Any:
    try:
        return calibrate()
    except CalibrationError as error:
        raise CalibrationError(f'{part}: {error}') from error


def command(arguments: list[str]) -> int:
    """Run the command line; return the exit code."""
    options = _arguments(arguments)
    parts = set(options.parts.split(','))
    if parts - set(_PARTS):
        unknown = sorted(parts - set(_PARTS))[0]
        print(f'calibration: unknown part {unknown!r}; known: {", ".join(_PARTS)}', file=sys.stderr)
        return _USAGE
    try:
        values = _earlier(options.earlier, options.node)
        lines = list(_calibrate(options, parts, values))
        write_yaml(options.out, options.node, values)
    except (BagError, CalibrationError, OSError) as error:
        print(f'calibration: {error}', file=sys.stderr)
        return _USAGE
    print('\n'.join(lines))
    print(f'wrote {options.out}')
    return 0
