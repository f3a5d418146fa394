# SPDX-License-Identifier: Apache-2.0
"""`ros2 run ins_gps smoother IN_BAG OUT_BAG`: writes the smoothed solution of a bag of IMU and GNSS data."""

from __future__ import annotations

import argparse
import sys


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='smoother',
        description=__doc__,
        epilog='Parameters and remaps of the estimator follow --ros-args: -p name:=value, '
        '--params-file f.yaml, -r from:=to.',
    )
    parser.add_argument('bag_in', help='bag with imu/data_raw and raw observations, fixes or velocities')
    parser.add_argument('bag_out', help='bag to write: a folder name, or a .mcap or .db3 file')
    parser.add_argument(
        '--copy', nargs='+', default=[], metavar='TOPIC', help="topics to copy as they are ('*': all)"
    )
    parser.add_argument('--compression', choices=('none', 'zstd'), default='none')
    parser.add_argument('--overwrite', action='store_true', help='replace an existing bag')
    return parser


def run(argv: list[str]) -> int:
    """Smooth one bag as the command line says."""
    from bag_tools import rosargs
    from ins_gps.bag_smoother import smooth_bag
    from ins_gps.params import FilterParams
    from kalman_core.parameters import build

    own, ros = rosargs.split(argv)
    options = _parser().parse_args(own)
    arguments = rosargs.parse(ros)
    # The estimator's own parameter file serves as it is.
    values = rosargs.estimator_parameters(arguments, arguments.node or 'ins_gps_estimator')
    result = smooth_bag(
        options.bag_in,
        options.bag_out,
        build(FilterParams, values),
        arguments.remaps,
        copy=options.copy,
        compression=options.compression,
        overwrite=options.overwrite,
    )
    for name, count in result.inputs.items():
        print(f'{count} in   {name}')
    for name, count in result.outputs.items():
        print(f'{count} out  {name}')
    for reason, count in result.refused.most_common():
        print(f'{count} refused from {reason}')
    for name, sensor in result.tally.sensors.items():
        if sensor.rejected:
            reasons = ', '.join(f'{reason} ({n})' for reason, n in sensor.rejected.most_common())
            print(f'rejected from {name}: {reasons}')
    for reason in result.tally.restarts:
        print(f'restarted: {reason}')
    return 0


def main(argv: list[str] | None = None) -> None:
    """Exit code 2 if the bag or a parameter cannot be used."""
    from bag_tools.cli import guarded

    sys.exit(guarded('smoother', run, argv))
