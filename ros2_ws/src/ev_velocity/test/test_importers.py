# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import can
import pytest

from bag_tools.bag import BagError, BagReader, BagWriter
from ev_velocity.can_frames import CarOnCan
from ev_velocity.importers import IMPORTERS

DATA = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'ev'
START = 1_767_225_600.0
SOURCES = {
    'kingston': (DATA / 'kingston_1800s', {'/imu/data_raw', '/gps/speed', '/obd/speed', '/truth/velocity'}),
    'obd_kingston': (DATA / 'obd_kingston' / 'kingston_k19_1.csv', {'/obd/speed', '/truth/velocity'}),
    'can_toyota86': (
        DATA / 'toyota86_can' / 'can_sample.candump.log',
        {'/imu/data_raw', '/wheel/states', '/vehicle/pedals', '/vehicle/speed', '/vehicle/gear'},
    ),
}


def convert(name, source, path):
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        IMPORTERS[name](source, bag)


@pytest.mark.parametrize('name', SOURCES)
def test_a_recording_becomes_a_bag(name, tmp_path):
    source, topics = SOURCES[name]
    if not source.exists():
        pytest.skip(f'no recording at {source} (ESTIMATOR_DATA)')
    convert(name, source, tmp_path / 'drive.mcap')
    with BagReader(tmp_path / 'drive.mcap') as bag:
        seen, last = set(), 0
        for topic, time, _ in bag.messages():
            seen.add(topic)
            assert time >= last
            last = time
    assert seen == topics


def test_a_log_of_the_own_car_becomes_a_bag(tmp_path):
    sender = CarOnCan('virtual', 'test_importers')
    with can.Logger(str(tmp_path / 'drive.log')) as writer:
        for i in range(10):
            for message in sender.frames(5.0, 0.2, 0.0):
                message.timestamp, message.channel = START + 0.02 * i, 0
                writer.on_message_received(message)
    sender.close()
    convert('can_imiev', tmp_path / 'drive.log', tmp_path / 'drive.mcap')
    with BagReader(tmp_path / 'drive.mcap') as bag:
        topics = [topic for topic, _, _ in bag.messages()]
    assert topics.count('/wheel/states') == topics.count('/vehicle/speed') == 10


def test_what_cannot_be_imported_is_named_and_leaves_no_bag(tmp_path):
    (tmp_path / 'empty.log').write_text('(1767225600.000000) vcan0 7FF#00\n')
    with pytest.raises(BagError, match='no frame of the profile imiev'):
        convert('can_imiev', tmp_path / 'empty.log', tmp_path / 'drive.mcap')
    with pytest.raises(BagError, match=r'imu\.csv'):
        convert('kingston', tmp_path, tmp_path / 'drive.mcap')
    with pytest.raises(BagError, match='0 DBC files'):
        convert('can_toyota86', tmp_path / 'empty.log', tmp_path / 'drive.mcap')
    assert not list(tmp_path.glob('*.mcap'))
