# SPDX-License-Identifier: Apache-2.0
"""`ros2 run ins_gps input_doctor BAG`: says in plain words what is wrong with a bag's IMU and GNSS data."""

from __future__ import annotations

import argparse
import sys


def main(argv: list[str] | None = None) -> None:
    """Print findings; exit code 1 if one is an error, 2 if the bag cannot be read."""
    parser = argparse.ArgumentParser(prog='input_doctor', description=__doc__)
    parser.add_argument('bag', help='bag to examine')
    parser.add_argument('--imu', default='/imu/data_raw', help='topic of sensor_msgs/Imu')
    parser.add_argument('--gnss', default='/gnss/observations', help='topic of raw observations')
    options = parser.parse_args(argv)
    from bag_tools.bag import BagError
    from ins_gps.examination import examine

    try:
        findings = examine(options.bag, options.imu, options.gnss)
    except BagError as error:
        print(f'input_doctor: {error}', file=sys.stderr)
        sys.exit(2)
    for finding in findings:
        print(f'{finding.level:8} {finding.check}: {finding.text}')
    sys.exit(any(finding.level == 'error' for finding in findings))
