# SPDX-License-Identifier: Apache-2.0
"""``ros2 run workspace_harness system NAME``: the nodes of one system, simulator included, in one process.

Web pages, Modbus and drivers of hardware are left out: they are run on purpose, beside this.
"""

from __future__ import annotations

import sys

from node_core.compose import compose
from node_core.spin import fail

SYSTEMS = {
    'imu_kalman': ('imu_simulator', 'angle_estimator', 'attitude_estimator'),
    'ship_inclinometer': ('ship_simulator', 'attitude_estimator', 'roll_analysis', 'alarm_monitor'),
    'ev_velocity': ('vehicle_simulator', 'velocity_estimator', 'fusion_estimator'),
    'ins_gps': ('uav_simulator', 'ins_gps_estimator'),
    'quad_control': ('quad_simulator', 'attitude_filter', 'attitude_controller', 'pilot'),
}
# Two estimators of one system may say the same topic; then all but the last get a name space of their own.
REMAPS = {
    'imu_kalman': ('angle_estimator:imu/data:=angle/imu/data',),
}


def arguments(name: str, given: list[str]) -> list[str]:
    """Return the command line of the composed process: the system's own remaps before what is given."""
    remaps = [part for rule in REMAPS.get(name, ()) for part in ('-r', rule)]
    rest = given[1:] if given[:1] == ['--ros-args'] else given
    flags = [*remaps, *rest]
    return ['system', '--ros-args', *flags] if flags else ['system']


def main() -> None:
    """Entry point."""
    name, *given = sys.argv[1:] or ['']
    if name not in SYSTEMS:
        sys.exit(fail(f"no system '{name}'; known: {', '.join(SYSTEMS)}"))
    sys.exit(compose([f'{name}/{node}' for node in SYSTEMS[name]], arguments(name, given)))
