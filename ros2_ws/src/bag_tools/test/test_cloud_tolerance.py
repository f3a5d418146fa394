# SPDX-License-Identifier: Apache-2.0
"""Clouds of float64 are compared as numbers, not as bytes."""

import numpy as np

from bag_tools.bag import BagWriter, zeroed
from bag_tools.content import compare

CLOUD = 'sensor_msgs/msg/PointCloud2'


def write(path, values):
    cloud = zeroed(CLOUD)
    field = zeroed('sensor_msgs/msg/PointField')
    field.name, field.datatype, field.count = 'pseudorange', 8, 1
    cloud.fields = [field]
    cloud.data = np.frombuffer(np.array(values).tobytes(), dtype=np.uint8)
    with BagWriter(path) as writer:
        writer.add('/cloud', CLOUD)
        writer.write('/cloud', 1, cloud)
    return path


def test_a_rounding_is_within_a_tolerance_and_a_metre_or_a_missing_value_is_not(tmp_path):
    a = write(tmp_path / 'a.mcap', [2e7, np.nan])
    rounded = write(tmp_path / 'b.mcap', [2e7 + 3.7e-9, np.nan])
    moved = write(tmp_path / 'c.mcap', [2e7 + 1.0, np.nan])
    filled = write(tmp_path / 'd.mcap', [2e7, 0.0])
    assert not compare(a, rounded)[0].equal
    assert compare(a, rounded, tolerance=1e-8)[0].equal
    assert not compare(a, moved, tolerance=1e-8)[0].equal
    assert not compare(a, filled, tolerance=1e-8)[0].equal
