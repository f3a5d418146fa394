# SPDX-License-Identifier: Apache-2.0
"""Parameters of the ship simulator and its named scenarios."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kalman_core.parameters import ParameterError, parameter


@dataclass(frozen=True)
class SimulatorParams:
    """Sea, ship, sensors. Defaults: irregular beam sea, straight course, no GNSS."""

    sea: str = parameter(
        'jonswap',
        'kind of sea; tumble: the sensor turned by hand through all sides',
        choices=('jonswap', 'pierson_moskowitz', 'sine', 'tumble'),
    )
    duration: float = parameter(720.0, 'length of a simulated run', unit='s', minimum=1.0, maximum=86400.0)
    rate: float = parameter(200.0, 'IMU rate', unit='Hz', minimum=10.0, maximum=1000.0)
    significant_height: float = parameter(2.5, 'significant wave height', unit='m', minimum=0.0, maximum=20.0)
    peak_period: float = parameter(9.0, "period of the spectrum's peak", unit='s', minimum=2.0, maximum=30.0)
    peak_enhancement: float = parameter(3.3, 'JONSWAP peak enhancement', minimum=1.0, maximum=10.0)
    heading_to_sea: float = parameter(
        90.0,
        'angle between bow and sea: 0 head, 90 beam, 135 quartering',
        unit='°',
        minimum=0.0,
        maximum=180.0,
    )
    roll_period: float = parameter(12.0, 'natural roll period', unit='s', minimum=1.0, maximum=60.0)
    roll_damping: float = parameter(0.06, 'roll damping ratio', minimum=0.005, maximum=1.0)
    largest_roll: float = parameter(15.0, 'largest roll of the run', unit='°', minimum=0.0, maximum=60.0)
    list_angle: float = parameter(0.0, 'standing heel', unit='°', minimum=-45.0, maximum=45.0)
    pitch_period: float = parameter(7.0, 'natural pitch period', unit='s', minimum=1.0, maximum=60.0)
    pitch_damping: float = parameter(0.2, 'pitch damping ratio', minimum=0.005, maximum=1.0)
    largest_pitch: float = parameter(3.0, 'largest pitch of the run', unit='°', minimum=0.0, maximum=30.0)
    largest_yaw: float = parameter(1.5, 'largest yaw of the run', unit='°', minimum=0.0, maximum=30.0)
    sway: float = parameter(
        0.8, 'sway of the roll centre as a share of the wave (sine: m)', minimum=0.0, maximum=5.0
    )
    heave: float = parameter(1.0, 'heave as a share of the wave (sine: m)', minimum=0.0, maximum=5.0)
    surge: float = parameter(0.2, 'surge as a share of the wave in a beam sea', minimum=0.0, maximum=5.0)
    imu_forward: float = parameter(
        -20.0, 'IMU forward of the roll centre', unit='m', minimum=-300.0, maximum=300.0
    )
    imu_starboard: float = parameter(
        3.0, 'IMU to starboard of the roll centre', unit='m', minimum=-60.0, maximum=60.0
    )
    imu_down: float = parameter(-15.0, 'IMU below the roll centre', unit='m', minimum=-80.0, maximum=80.0)
    course: float = parameter(30.0, 'course, clockwise from north', unit='°', minimum=-360.0, maximum=360.0)
    speed: float = parameter(8.0, "ship's speed", unit='m/s', minimum=0.0, maximum=30.0)
    turn_rate: float = parameter(2.0, 'rate of turn', unit='°/s', minimum=0.0, maximum=10.0)
    turn_angle: float = parameter(180.0, 'angle of a turn', unit='°', minimum=0.0, maximum=720.0)
    turn_entry: float = parameter(
        8.0, 'time to enter and to leave a turn', unit='s', minimum=0.5, maximum=60.0
    )
    turn_heel: float = parameter(2.0, 'outward heel in a turn', unit='°', minimum=-10.0, maximum=20.0)
    turn_starts: tuple[float, ...] = parameter(
        (-1.0, -1.0), 'start of the turn to port and of the turn to starboard, negative: none', unit='s'
    )
    gyro_noise: float = parameter(
        0.12, 'gyro noise of a 100 Hz sample', unit='°/s', minimum=0.0, maximum=10.0
    )
    gyro_bias: float = parameter(
        0.5, 'gyro bias, each axis of random sign', unit='°/s', minimum=0.0, maximum=20.0
    )
    gyro_warmup: float = parameter(
        0.3, 'drift of the bias while warming up', unit='°/s', minimum=0.0, maximum=10.0
    )
    gyro_warmup_time: float = parameter(600.0, 'time of 95 % of the warm-up', unit='s', minimum=1.0)
    gyro_bias_walk: float = parameter(
        0.002, 'random walk of the gyro bias', unit='°/s/√s', minimum=0.0, maximum=1.0
    )
    accelerometer_noise: tuple[float, ...] = parameter(
        (3.1, 3.1, 5.0), 'accelerometer noise of a 100 Hz sample', unit='mg', minimum=0.0, maximum=1000.0
    )
    accelerometer_bias: float = parameter(
        1.0, 'accelerometer bias, each axis of random sign', unit='mg', minimum=0.0, maximum=200.0
    )
    angle_noise: float = parameter(
        0.0, "the paper's white noise on measured directions, per sample", unit='°', minimum=0.0, maximum=20.0
    )
    engine_frequencies: tuple[float, ...] = parameter(
        (12.5, 37.0), 'engine vibration lines, 0: none', unit='Hz', minimum=0.0, maximum=500.0
    )
    engine_acceleration: float = parameter(0.3, 'amplitude of each line and axis', unit='m/s²', minimum=0.0)
    magnetometer_rate: float = parameter(75.0, 'magnetometer rate', unit='Hz', minimum=1.0, maximum=1000.0)
    magnetometer_noise: float = parameter(1.5, 'magnetometer noise of a sample', unit='mG', minimum=0.0)
    field_norm: float = parameter(480.0, 'magnetic field', unit='mG', minimum=200.0, maximum=700.0)
    field_dip: float = parameter(55.0, 'dip of the field', unit='°', minimum=-85.0, maximum=85.0)
    declination: float = parameter(0.0, 'declination, east positive', unit='°', minimum=-90.0, maximum=90.0)
    soft_iron: float = parameter(0.005, 'soft iron left after calibration', minimum=0.0, maximum=0.5)
    hard_iron: float = parameter(
        3.0, 'hard iron left after calibration, random direction', unit='mG', minimum=0.0
    )
    disturbance: float = parameter(0.0, 'field of a passing magnetic disturbance', unit='mG', minimum=0.0)
    disturbance_start: float = parameter(300.0, 'start of the disturbance', unit='s')
    disturbance_time: float = parameter(60.0, 'length of the disturbance', unit='s', minimum=0.0)
    gnss_rate: float = parameter(0.0, 'GNSS velocity rate, 0: no GNSS', unit='Hz', minimum=0.0, maximum=50.0)
    gnss_noise: float = parameter(0.05, 'GNSS velocity noise', unit='m/s', minimum=0.0, maximum=10.0)
    gnss_delay: float = parameter(
        0.0, 'how late the stamp of a GNSS velocity is', unit='s', minimum=0.0, maximum=1.0
    )
    gnss_dropout_start: float = parameter(0.0, 'start of a GNSS drop-out', unit='s')
    gnss_dropout_time: float = parameter(0.0, 'length of the drop-out', unit='s', minimum=0.0)
    antenna_forward: float = parameter(-10.0, 'antenna forward of the roll centre', unit='m')
    antenna_starboard: float = parameter(0.0, 'antenna to starboard of the roll centre', unit='m')
    antenna_down: float = parameter(-25.0, 'antenna below the roll centre', unit='m')
    log_noise: float = parameter(0.1, 'noise of the speed log', unit='m/s', minimum=0.0)
    log_scale_error: float = parameter(0.01, 'scale error of the speed log', minimum=0.0, maximum=0.5)

    def __post_init__(self) -> None:
        """Refuse a sea that no one could sample."""
        if self.rate < 2.5 * max(self.engine_frequencies, default=0.0):
            raise ParameterError("parameter 'rate' is too low for 'engine_frequencies'")


_BEAM = SimulatorParams()
_SINE = replace(
    _BEAM, sea='sine', roll_period=10.0, largest_pitch=2.0, largest_yaw=1.0, sway=0.8, heave=0.8, surge=0.0
)
_TURNS = replace(_BEAM, turn_starts=(200.0, 450.0))

SCENARIOS: dict[str, SimulatorParams] = {
    'beam': _BEAM,
    'quartering': replace(_BEAM, heading_to_sea=135.0, largest_roll=10.0, largest_pitch=4.0),
    'head': replace(_BEAM, heading_to_sea=0.0, largest_roll=3.0, largest_pitch=6.0),
    'swell': replace(_BEAM, peak_period=14.0),
    'storm': replace(_BEAM, significant_height=6.0, peak_period=12.0, largest_roll=30.0, largest_pitch=6.0),
    'calm': replace(_BEAM, significant_height=0.2, peak_period=5.0, largest_roll=0.5, largest_pitch=0.3),
    'turns': _TURNS,
    'turns_gnss': replace(_TURNS, gnss_rate=5.0),
    'sine': _SINE,
    'paper': replace(_SINE, angle_noise=1.5),
    'hot_start': replace(_BEAM, gyro_bias=5.0, duration=180.0),
    'disturbed': replace(_BEAM, disturbance=150.0),
    'calibration': replace(
        _BEAM,
        sea='tumble',
        duration=240.0,
        speed=0.0,
        imu_forward=0.0,
        imu_starboard=0.0,
        imu_down=0.0,
        engine_frequencies=(0.0, 0.0),
        soft_iron=0.05,
        hard_iron=150.0,
        accelerometer_bias=20.0,
    ),
}


def scenario(name: str, **changes) -> SimulatorParams:
    """Return the named scenario with `changes`; raise ParameterError for an unknown name."""
    if name not in SCENARIOS:
        raise ParameterError(f"unknown scenario '{name}'; known: {', '.join(SCENARIOS)}")
    return replace(SCENARIOS[name], **changes)


@dataclass(frozen=True)
class PlayParams:
    """What is played."""

    scenario: str = parameter('beam', 'named sea, ship and sensors', choices=tuple(SCENARIOS))
    seed: int = parameter(0, 'seed of the first run; each further run takes the next', minimum=0)
    time_factor: float = parameter(1.0, 'time goes this much faster', minimum=0.01, maximum=100.0)


@dataclass(frozen=True)
class ShipSimulatorParams(SimulatorParams, PlayParams):
    """All parameters of the node: what is played, and what differs from the scenario."""
