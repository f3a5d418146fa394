# SPDX-License-Identifier: Apache-2.0
"""Parameters of the navigation filter and of the sensors' nodes."""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass

from kalman_core.parameters import ParameterError, parameter
from node_core.byte_params import RecordingParams, StreamParams

# RINEX bands that `bands` stands for.
BANDS = {'first': (1,), 'all': (1, 2, 5, 7)}
MODES = ('ins', 'gps', 'loose', 'tight_doppler', 'tight_tdcp', 'tight_code')


@dataclass(frozen=True, slots=True)
class FilterParams:
    """The filter; defaults fit a MEMS IMU and an ordinary single-frequency receiver."""

    mode: str = parameter('tight_tdcp', 'what is coupled, and how', choices=MODES)
    states: str = parameter(
        'full', 'published: 10 states, carrier difference as a rate', choices=('published', 'full')
    )
    channels: int = parameter(20, 'satellite signals that can be tracked at once', minimum=4, maximum=48)
    event_window: float = parameter(
        0.5, 'largest delay of arrival that is repaired', unit='s', minimum=0.0, maximum=5.0
    )
    gyro_noise: float = parameter(1e-4, 'white noise of the rates', unit='rad/s/√Hz', minimum=0.0)
    accel_noise: float = parameter(2e-3, 'white noise of the specific force', unit='m/s²/√Hz', minimum=0.0)
    vibration: bool = parameter(
        True, "noise that the IMU's samples show counts where it is more than gyro_noise and accel_noise"
    )
    gyro_bias_walk: float = parameter(1e-6, 'random walk of the gyro bias', unit='rad/s/√s', minimum=0.0)
    accel_bias_walk: float = parameter(1e-4, 'random walk of the accel bias', unit='m/s²/√s', minimum=0.0)
    gyro_bias_sigma: float = parameter(3e-3, 'gyro bias at the start, one σ', unit='rad/s', minimum=0.0)
    accel_bias_sigma: float = parameter(
        0.1, 'accelerometer bias at the start, one σ', unit='m/s²', minimum=0.0
    )
    imu_gap: float = parameter(0.1, 'longer without an IMU sample counts as a gap', unit='s', minimum=0.005)
    gap_force: float = parameter(2.0, 'acceleration possible in a gap, one σ', unit='m/s²', minimum=0.0)
    gap_rate: float = parameter(0.3, 'turn rate possible in a gap, one σ', unit='rad/s', minimum=0.0)
    covariance_step: float = parameter(
        0.1, 'interval at which the covariance is advanced', unit='s', minimum=0.001, maximum=1.0
    )
    clock_walk: float = parameter(0.03, 'random walk of the receiver clock', unit='m/√s', minimum=0.0)
    drift_walk: float = parameter(0.05, 'random walk of the clock drift', unit='m/s/√s', minimum=0.0)
    code_noise: float = parameter(1.0, 'white noise of the code', unit='m', minimum=1e-4)
    code_slow: float = parameter(
        0.5, 'constant range error of a satellite after DGPS correction, one σ', unit='m', minimum=0.0
    )
    code_slow_alone: float = parameter(
        2.5, 'the same without correction (orbit, clock, atmosphere)', unit='m', minimum=0.0
    )
    code_band: float = parameter(
        3.0,
        "constant error of another band's code against its satellite's L1 or E1 (bias, ionosphere), one σ",
        unit='m',
        minimum=0.0,
    )
    code_band_common: float = parameter(
        10.0, "the receiver's delay of a band against L1 or E1, one σ", unit='m', minimum=0.0
    )
    code_multipath: float = parameter(2.0, 'first-order multipath of the code, one σ', unit='m', minimum=0.0)
    multipath_time: float = parameter(60.0, 'its correlation time', unit='s', minimum=0.1)
    fix_time: float = parameter(
        60.0,
        "how long errors of fixes on gnss/fix last that have no ground station's corrections, 0: white",
        unit='s',
        minimum=0.0,
    )
    fix_white: float = parameter(
        0.3, 'share of their variance that is white all the same', minimum=0.01, maximum=1.0
    )
    carrier_noise: float = parameter(0.01, 'white noise of the carrier', unit='m', minimum=1e-6)
    carrier_walk: float = parameter(0.01, 'random walk of the carrier', unit='m/√s', minimum=0.0)
    doppler_noise: float = parameter(0.1, 'white noise of the Doppler', unit='m/s', minimum=1e-4)
    published_rate_noise: float = parameter(
        0.1, 'of the carrier difference taken as a rate', unit='m/s', minimum=1e-4
    )
    elevation_weighting: bool = parameter(True, 'σ of code and Doppler grow at low elevation and weak signal')
    cn0_reference: float = parameter(42.0, 'signals weaker than this weigh less', unit='dB-Hz', minimum=0.0)
    elevation_mask: float = parameter(
        math.radians(10.0), 'satellites below are not used', unit='rad', minimum=-1.6, maximum=1.5
    )
    gate_probability: float = parameter(
        1e-4, 'false rejection of one good satellite', minimum=1e-12, maximum=0.1
    )
    drift_probability: float = parameter(
        1e-4,
        'false alarm of the test for a code that drifts away slowly',
        minimum=1e-15,
        maximum=0.1,
    )
    lost_time: float = parameter(
        10.0, 'time with most codes rejected after which position and clock start anew', unit='s', minimum=1.0
    )
    carrier_interval: float = parameter(
        3.0, 'longest time between epochs that a carrier difference bridges', unit='s', minimum=0.01
    )
    correction_age: float = parameter(
        30.0, 'DGPS corrections older than this are not used', unit='s', minimum=0.1
    )
    rate_correction: bool = parameter(
        False, "the base's rate corrections apply to the carrier difference (needed under SA)"
    )
    lever_arm: tuple = parameter(
        (0.0, 0.0, 0.0), 'antenna from the IMU, forward, left, up', unit='m', minimum=-100.0, maximum=100.0
    )
    alignment: str = parameter(
        'velocity',
        'given: initial_attitude; static: level from gravity, yaw given; velocity: yaw from the course',
        choices=('given', 'static', 'velocity'),
    )
    initial_attitude: tuple = parameter(
        (0.0, 0.0, 0.0),
        'roll, pitch, yaw of base_link in ENU at the start',
        unit='rad',
        minimum=-7.0,
        maximum=7.0,
    )
    initial_tilt_sigma: float = parameter(
        0.02, 'roll and pitch at the start, one σ', unit='rad', minimum=1e-6
    )
    initial_yaw_sigma: float = parameter(0.3, 'yaw at the start, one σ', unit='rad', minimum=1e-6)
    alignment_speed: float = parameter(
        1.0, 'least horizontal speed for a yaw from the course', unit='m/s', minimum=0.1
    )
    zero_velocity: bool = parameter(False, 'zero-velocity updates while the IMU is still')
    zero_velocity_sigma: float = parameter(0.02, 'velocity while still, one σ', unit='m/s', minimum=1e-4)
    non_holonomic: bool = parameter(False, 'a road vehicle moves along its forward axis')
    non_holonomic_sigma: float = parameter(
        0.2, 'its lateral and vertical velocity, one σ', unit='m/s', minimum=1e-3
    )
    origin: tuple = parameter(
        (0.0, 0.0, 0.0), 'origin of the local frame, latitude °, longitude °, height m; all 0: the first fix'
    )

    def __post_init__(self) -> None:
        if not -90.0 <= self.origin[0] <= 90.0:
            raise ParameterError(f"parameter 'origin' has latitude {self.origin[0]:g}, allowed: -90 … 90")


@dataclass(frozen=True, slots=True)
class BaseParams:
    """A DGPS base receiver at a known position."""

    position: tuple = parameter(
        (0.0, 0.0, 0.0), 'antenna: latitude °, longitude °, ellipsoidal height m; must be given'
    )
    position_source: str = parameter(
        'parameter',
        'where the position is from: `position`, or the topic base/position (RTCM 1005/1006, RINEX header)',
        choices=('parameter', 'topic'),
    )
    elevation_mask: float = parameter(
        math.radians(5.0), 'satellites below are not corrected', unit='rad', minimum=0.0, maximum=1.5
    )
    smoothing: float = parameter(
        100.0, 'carrier smoothing of the codes', unit='s', minimum=1.0, maximum=3600.0
    )
    slip_limit: float = parameter(
        10.0, 'code minus smoothed code taken for a cycle slip', unit='m', minimum=0.5
    )
    position_limit: float = parameter(
        30.0, 'offset of the own fix at which the position counts as wrong', unit='m', minimum=1.0
    )
    rate_threshold: float = parameter(
        0.2, 'range-rate corrections below are noise and sent as 0', unit='m/s', minimum=0.0
    )
    position_epochs: int = parameter(10, 'epochs averaged for that', minimum=1)

    def __post_init__(self) -> None:
        if not -90.0 <= self.position[0] <= 90.0:
            raise ParameterError(f"parameter 'position' has latitude {self.position[0]:g}, allowed: -90 … 90")


@dataclass(frozen=True, slots=True)
class SimulatorParams:
    """The UAV simulator: one scenario, published in real time."""

    trajectory: str = parameter(
        'constant', 'motion of the craft', choices=('constant', 's_turns', 'flight', 'literal')
    )
    satellites: str = parameter('open_sky', 'paper, open_sky, or the path of a RINEX navigation file')
    budget: str = parameter('dgps', 'range errors', choices=('dgps', 'standalone', 'noiseless'))
    white: bool = parameter(False, 'redraw all range errors each epoch')
    selective_availability: float = parameter(0.0, 'bound of SA', unit='m', minimum=0.0)
    imu: str = parameter('hg1700', 'class of the IMU', choices=('hg1700', 'paper', 'mems', 'perfect'))
    imu_rate: float = parameter(100.0, 'rate of the IMU', unit='Hz', minimum=1.0, maximum=1000.0)
    gnss_rate: float = parameter(1.0, 'rate of GNSS', unit='Hz', minimum=0.1, maximum=20.0)
    duration: float = parameter(500.0, 'length, after which the node ends', unit='s', minimum=1.0)
    outage_start: float = parameter(0.0, 'start of an outage', unit='s', minimum=0.0)
    outage_end: float = parameter(0.0, 'its end; not after the start: none', unit='s', minimum=0.0)
    outage_left: int = parameter(0, 'satellites left during the outage', minimum=0)
    seed: int = parameter(0, 'decides all random errors', minimum=0)
    speed: float = parameter(1.0, 'times real time', minimum=0.01, maximum=1000.0)


@dataclass(frozen=True, slots=True)
class RinexParams(RecordingParams):
    """Replay of a receiver's RINEX files."""

    observations: str = parameter('', 'path of the RINEX observation file')
    navigation: str = parameter('', 'paths of RINEX navigation files, separated by commas')
    topic: str = parameter('gnss/observations', 'where the epochs go')
    position_topic: str = parameter('', "where the header's position goes (base/position); empty: nowhere")
    time_scale: str = parameter(
        'gps', 'header stamps: GPS time written as Unix seconds, or UTC', choices=('gps', 'utc')
    )
    leap_seconds: int = parameter(18, 'GPS minus UTC', unit='s', minimum=0, maximum=60)
    atmosphere: bool = parameter(True, 'model ionosphere (Klobuchar) and troposphere (Saastamoinen)')
    frame: str = parameter('gnss', 'frame id of the antenna')


@dataclass(frozen=True, slots=True)
class UbloxParams(StreamParams):
    """A u-blox receiver that sends RXM-RAWX, RXM-SFRBX and, for `fix_topic`, NAV-PVT."""

    # RXM-RAWX of 40 signals at 10 Hz fills 115200 Bd.
    baud: int = parameter(460_800, 'of a serial port', unit='Bd', minimum=300, maximum=10_000_000)
    bands: str = parameter(
        'first', 'first: L1 and E1; all: L2, L5, E5a and E5b too', choices=('first', 'all')
    )
    topic: str = parameter('gnss/observations', 'where the epochs go')
    # Not the estimator's gnss/fix: beside the same receiver's raw observations its fix says nothing new.
    fix_topic: str = parameter(
        'gnss/fix_receiver', "where the receiver's own fixes go; gnss/fix in place of raw observations"
    )
    time_scale: str = parameter(
        'utc', 'header stamps: UTC, or GPS time written as Unix seconds', choices=('gps', 'utc')
    )
    leap_seconds: int = parameter(
        18, 'GPS minus UTC until the receiver knows it', unit='s', minimum=0, maximum=60
    )
    atmosphere: bool = parameter(True, 'model ionosphere (Klobuchar) and troposphere (Saastamoinen)')
    frame: str = parameter('gnss', 'frame id of the antenna')

    @property
    def band_numbers(self) -> tuple[int, ...]:
        """RINEX bands as numbers."""
        return BANDS[self.bands]


@dataclass(frozen=True, slots=True)
class NmeaParams(StreamParams):
    """A receiver that speaks NMEA: GGA or RMC, better both; GST for σ, else GSA."""

    baud: int = parameter(9600, 'of a serial port', unit='Bd', minimum=300, maximum=10_000_000)
    fix_topic: str = parameter('gnss/fix', 'where the fixes go')
    velocity_topic: str = parameter('', 'where velocities from RMC or VTG go (gnss/velocity); empty: nowhere')
    range_sigma: float = parameter(
        4.0, 'error of a range without corrections, where no GST tells σ', unit='m', minimum=0.01
    )
    speed_sigma: float = parameter(
        0.1, 'error of the velocity, of which NMEA says nothing, one σ', unit='m/s', minimum=0.001
    )
    time_scale: str = parameter(
        'utc', 'header stamps: UTC, or GPS time written as Unix seconds', choices=('gps', 'utc')
    )
    leap_seconds: int = parameter(18, 'GPS minus UTC', unit='s', minimum=0, maximum=60)
    date: str = parameter('', 'day (YYYY-MM-DD, UTC) at the start of a recording without RMC and ZDA')
    frame: str = parameter('gnss', 'frame id of the antenna')

    def __post_init__(self) -> None:
        if self.date and not self.day:
            raise ParameterError(f"parameter 'date' is '{self.date}', expected YYYY-MM-DD")

    @property
    def day(self) -> int:
        """Noon of the date, ns since 1970; 0 if none is given."""
        try:
            noon = datetime.datetime.strptime(self.date, '%Y-%m-%d') + datetime.timedelta(hours=12)
        except ValueError:
            return 0
        return round(noon.replace(tzinfo=datetime.UTC).timestamp()) * 1_000_000_000


@dataclass(frozen=True, slots=True)
class RtcmParams(StreamParams):
    """An RTCM 3 stream with MSM4-MSM7 and the ephemerides 1019, 1045, 1046 of GPS and Galileo."""

    source: str = parameter(
        '',
        'file, serial port (/dev/... or COMn), tcp://HOST:PORT or ntrip://[USER:PASSWORD@]HOST[:PORT]/MOUNTPOINT',
    )
    bands: str = parameter(
        'first', 'first: L1 and E1; all: L2, L5, E5a and E5b too', choices=('first', 'all')
    )
    topic: str = parameter('gnss/observations', "where the epochs go; a base's: base/observations")
    position_topic: str = parameter('base/position', 'where the position of 1005 and 1006 goes')
    time_scale: str = parameter(
        'utc', 'header stamps: UTC, or GPS time written as Unix seconds', choices=('gps', 'utc')
    )
    leap_seconds: int = parameter(18, 'GPS minus UTC', unit='s', minimum=0, maximum=60)
    gps_week: int = parameter(
        0,
        'a week within nine years of a recording from before 2016 or after 2035 without Galileo; 0: between',
        unit='week',
        minimum=0,
        maximum=8191,
    )
    atmosphere: bool = parameter(True, 'model ionosphere (Klobuchar) and troposphere (Saastamoinen)')
    frame: str = parameter('gnss', 'frame id of the antenna')

    @property
    def band_numbers(self) -> tuple[int, ...]:
        """RINEX bands as numbers."""
        return BANDS[self.bands]
