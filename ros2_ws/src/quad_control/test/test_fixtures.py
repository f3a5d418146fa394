# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from bag_tools.bag import BagReader
from bag_tools.offline import offline
from quad_control.codec import CONTROLLER_PORTS, decode_motors
from quad_control.fixtures import FIXTURES

# Both fixtures together, bytes.
MOST = 1_500_000


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    paths = {name: folder / f'{name}.mcap' for name in FIXTURES}
    for name, write in FIXTURES.items():
        write(paths[name])
    return paths


def test_fixtures_are_small_and_the_same_every_time(bags, tmp_path):
    assert sum(path.stat().st_size for path in bags.values()) < MOST
    again = tmp_path / 'quad_stand_10deg.mcap'  # the storage keeps its own name inside
    FIXTURES['quad_stand_10deg'](again)
    assert again.read_bytes() == bags['quad_stand_10deg'].read_bytes()


@pytest.mark.parametrize('name', FIXTURES)
def test_both_flights_arm_lean_and_come_back_level(bags, name):
    with BagReader(bags[name]) as reader:
        tilts = [
            np.degrees(2.0 * np.hypot(m.pose.pose.orientation.x, m.pose.pose.orientation.y))
            for _, _, data in reader.messages(['/truth/odometry'])
            for m in [reader.decode(data, 'nav_msgs/msg/Odometry')]
        ]
        armed = any(
            max(decode_motors(reader.decode(data, 'sensor_msgs/msg/JointState'))[1]) > 1200.0
            for _, _, data in reader.messages(['/motors/command'])
        )
    assert armed
    assert max(tilts) > 9.0
    assert tilts[-1] < 3.0


def test_the_controller_replayed_from_the_bag_commands_what_flew(bags, tmp_path):
    out = tmp_path / 'out.mcap'
    offline(CONTROLLER_PORTS, {}, bags['quad_stand_10deg'], out, remaps={}, overwrite=True)

    def commands(path):
        with BagReader(path) as reader:
            return [
                decode_motors(reader.decode(data, 'sensor_msgs/msg/JointState'))
                for _, _, data in reader.messages(['/motors/command'])
            ]

    flown, replayed = commands(bags['quad_stand_10deg']), commands(out)
    assert [s for s, _ in flown] == [s for s, _ in replayed]
    # The voltage of a BatteryState is float32: its rounding is all that may differ.
    assert np.array([p for _, p in replayed]) == pytest.approx(np.array([p for _, p in flown]), abs=1e-4)
