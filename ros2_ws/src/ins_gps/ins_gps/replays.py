# SPDX-License-Identifier: Apache-2.0
"""What `./ws run` replays of this package."""

from pathlib import Path

from bag_tools.bag import BagReader
from bag_tools.catalogue import Entry, Recorded, Replay
from ins_gps.evaluation import PRINTED

_TRUTH = '/truth/odometry'
_PAPER = {
    'alignment': 'given',
    'initial_attitude': (0.0, 0.0, 1.5707963267948966),
    'initial_tilt_sigma': 0.005,
    'initial_yaw_sigma': 0.01,
    'elevation_mask': 0.0,
    'elevation_weighting': False,
    'code_noise': 0.9,
    'code_slow_alone': 0.0,
    'code_multipath': 0.0,
    'accel_bias_sigma': 0.01,
    'gyro_bias_sigma': 5e-6,
    'gyro_noise': 4e-5,
    'accel_noise': 1e-3,
    'accel_bias_walk': 0.0,
    'gyro_bias_walk': 0.0,
    'carrier_walk': 0.0005,
    'doppler_noise': 0.05,
    'channels': 8,
    'origin': (0.0, 0.0, 100.0),
}
_CORRELATED = _PAPER | {
    'code_noise': 0.6,
    'code_slow_alone': 0.36,
    'code_multipath': 0.6,
    'origin': (21.0, 105.8, 100.0),
}
_FAULTS = _PAPER | {'origin': (21.0, 105.8, 100.0)}
_COMPONENTS = ('norm',)


def _systems(params: dict) -> tuple[Entry, ...]:
    modes = {'GPS': 'gps', 'loose': 'loose', 'tight': 'tight_doppler', 'proposed': 'tight_tdcp'}
    return tuple(
        Entry(name, 'ins_gps_estimator', 'odometry', params | {'mode': mode}) for name, mode in modes.items()
    )


REPLAYS = (
    Replay(
        'gnss_paper',
        "the paper's satellites and DGPS budget", _TRUTH, _systems(_PAPER), _COMPONENTS, after=60.0,
        printed={'position': PRINTED['proposed']},
    ),
    Replay(
        'gnss_outage', 'two satellites for 20 s', _TRUTH, _systems(_CORRELATED), _COMPONENTS, after=30.0
    ),
    Replay(
        'gnss_faults', 'jump, ramp, slips, late epochs', _TRUTH, _systems(_FAULTS), _COMPONENTS, after=30.0
    ),
)  # fmt: skip


def _walk(bag: Path) -> Replay:
    """Return the replay of the imported walk; its local frame begins at the first fix of the bag."""
    with BagReader(bag) as reader:
        fix = next(
            reader.decode(data, reader.topics[t].type) for t, _, data in reader.messages(['/gnss/fix'])
        )
    params = {'origin': (fix.latitude, fix.longitude, fix.altitude), 'correction_age': 100.0}
    modes = {'GPS': 'gps', 'loose': 'loose', 'tight': 'tight_doppler', 'proposed': 'tight_tdcp'}
    return Replay(
        bag.stem,
        'recorded walk with RTK reference',
        '/truth/position',
        tuple(
            Entry(name, 'ins_gps_estimator', 'odometry', params | {'mode': mode}, 'pose.pose.position')
            for name, mode in modes.items()
        ),
        _COMPONENTS,
        after=20.0,  # s: it stands for the first 10
    )


RECORDED = (Recorded('ins/gnss_imu_walk_60s', 'ins_gps:gnss_imu_walk', _walk, live_seconds=30.0),)
