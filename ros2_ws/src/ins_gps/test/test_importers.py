# SPDX-License-Identifier: Apache-2.0
"""The recorded walk as a bag: complete, in order, and good enough to navigate by."""

import numpy as np
import pytest

from bag_tools.bag import BagError, BagReader, BagWriter
from bag_tools.offline import offline
from bag_tools.score import Subject, Window, score
from ins_gps.codec import INS_GPS_PORTS
from ins_gps.importers import IMPORTERS
from ins_gps.replays import RECORDED


def convert(source, path):
    with BagWriter(path, compression='zstd') as bag:
        IMPORTERS['gnss_imu_walk'](source, bag)


@pytest.fixture(scope='module')
def bag(recordings, tmp_path_factory):
    path = tmp_path_factory.mktemp('walk') / 'walk.mcap'
    convert(recordings / 'gnss_imu_walk_60s', path)
    return path


def test_everything_is_in_the_bag_in_order_of_time(bag):
    with BagReader(bag) as reader:
        counts = {topic: entry.count for topic, entry in reader.topics.items()}
        stamps = [stamp for _, stamp, _ in reader.messages()]
    # 60 s: IMU 150 Hz, GNSS and track 4 Hz; the stand is the first 10 s.
    assert counts['/imu/data_raw'] > 8900
    assert counts['/gnss/observations'] == counts['/truth/position'] == 241
    assert counts['/gnss/corrections'] == counts['/gnss/fix'] == 41
    assert (np.diff(stamps) >= 0).all()


def test_the_estimator_finds_the_way_and_knows_how_well(bag, tmp_path):
    replay = RECORDED[0].replay(bag)
    entry = next(e for e in replay.entries if e.label == 'proposed')
    offline(INS_GPS_PORTS, dict(entry.params), bag, tmp_path / 'out.mcap')
    estimate = Subject(tmp_path / 'out.mcap', f'/{entry.output}', entry.field)
    found = score(estimate, Subject(bag, replay.truth), Window(after=replay.after))[0].score
    assert found.component('norm').max < 1.5
    # Errors of 40 s of one walk are correlated: their mean NEES scatters widely about its expectation.
    assert found.nees < 3.0 * found.dof


def test_a_folder_without_the_files_is_named(tmp_path):
    with pytest.raises(BagError, match=r'imu\*\.csv'):
        convert(tmp_path, tmp_path / 'walk.mcap')
    assert not list(tmp_path.glob('*.mcap'))
