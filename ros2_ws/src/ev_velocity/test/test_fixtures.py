# SPDX-License-Identifier: Apache-2.0
import hashlib

import numpy as np
import pytest

from bag_tools.bag import BagReader
from ev_velocity.codec import ESTIMATORS
from ev_velocity.fixtures import FIXTURES
from ev_velocity.replays import REPLAYS
from kalman_core.parameters import build
from node_core.driver import EstimatorDriver
from node_core.messages import stamp_of


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    for name, write in FIXTURES.items():
        write(folder / f'{name}.mcap')
    return folder


def messages(path):
    with BagReader(path) as bag:
        types = {name: bag.topic(name).type for name in ('/imu/data_raw', '/truth/velocity')}
        kinds = {c.topic: c.msgtype for c in bag._reader.connections}
        assert types.items() <= kinds.items()
        for topic, time, data in bag.messages():
            yield topic, time, bag.decode(data, kinds[topic])


def test_a_fixture_is_small_and_the_same_every_time(bags, tmp_path):
    sizes = [path.stat().st_size for path in bags.glob('*.mcap')]
    assert len(sizes) == len(FIXTURES)
    assert sum(sizes) < 1_500_000
    FIXTURES['ev_oil_patch'](tmp_path / 'again.mcap')
    digests = [hashlib.sha256() for _ in range(2)]
    for digest, path in zip(digests, (bags / 'ev_oil_patch.mcap', tmp_path / 'again.mcap')):
        with BagReader(path) as bag:
            for topic, time, data in bag.messages():
                digest.update(f'{topic}{time}'.encode() + bytes(data))
    assert digests[0].hexdigest() == digests[1].hexdigest()


@pytest.mark.parametrize('replay', REPLAYS, ids=lambda replay: replay.bag)
def test_the_joint_filter_beats_the_fusion_on_every_fixture(bags, replay):
    results = {}
    for entry in replay.entries:
        ports = ESTIMATORS[entry.estimator]
        driver = EstimatorDriver(ports, build(ports.params, dict(entry.params)))
        by_topic = {f'/{port.topic}': port for port in ports.inputs}
        estimates, truth = [], []
        for topic, _, message in messages(bags / f'{replay.bag}.mcap'):
            if topic == replay.truth:
                truth.append((stamp_of(message), message.twist.linear.x))
            elif topic in by_topic:
                out = driver.feed(by_topic[topic], message)
                estimates += [(e.stamp, e.speed) for port, e in out if port.topic == entry.output]
        origin = truth[0][0]
        x, y = np.array([(stamp - origin, speed) for stamp, speed in truth], dtype=float).T
        ex, ey = np.array([(stamp - origin, speed) for stamp, speed in estimates], dtype=float).T
        results[entry.label] = np.sqrt(np.mean((np.interp(x, ex, ey) - y) ** 2))
    # Nine samples of GPS before it fails are all that scale and delay can be learned from.
    assert results['joint'] < (0.1 if replay.bag == 'ev_gps_trouble' else 0.05)
    assert results['joint'] < 0.5 * min(results['published'], results['fusion'])
