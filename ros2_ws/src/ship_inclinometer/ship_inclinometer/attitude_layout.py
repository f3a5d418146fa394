# SPDX-License-Identifier: Apache-2.0
"""State and settings of the inertial attitude filter, an error-state EKF with a model of the waves.

Error states (true = estimate + error, attitude error in the level frame ``q_true = exp(error_n) * q``):
attitude 0:3 · gyro bias 3:6 · accelerometer bias 6:9 · velocity 9:12 · position relative to the mean path
12:15 · velocity of the mean path 15:17 · wave oscillator 17:20 and its output, the wave displacement,
20:23 · magnetic deviation 23.

The mean path turns with the ship (its velocity keeps its angle to the bow); the displacement from it is a
narrow-band process that has no power at zero frequency (Fossen, "Handbook of Marine Craft Hydrodynamics and
Motion Control", 2011, section 8.2.6, linear approximation of a wave spectrum). So a slow growth of the
integrated position is the fault of tilt and biases, a quick one is the sea.
"""

GRAVITY = 9.80665
N = 24
TH, BG, BA, V, P_, VP, X1, X2, DEV = 0, 3, 6, 9, 12, 15, 17, 20, 23
# Nominal state and memory, in front of the covariance in one flat array.
S_TIME = 0
S_Q = 1
S_BG = 5
S_BA = 8
S_V = 11
S_P = 14
S_VP = 17
S_X1 = 19
S_X2 = 22
S_PHASE = 25
S_START = 26
S_POWER = 28  # mean square of the wave displacement: ahead, athwart, up [m²]
S_SPEED = 31  # mean square of the velocity relative to the path: level (both axes), up [m²/s²]
S_TURN = 33  # smoothed rate of turn [rad/s]
S_RATE = 34  # last corrected body rate [rad/s]
S_FORCE = 37  # last corrected specific force [m/s²]
S_LOG = 40  # times [s] of the last use of each source, -1 before the first
S_GNSS = 41
S_MAG = 42
S_AIDED = 43
S_NORM = 44  # learned field: norm [T], sine of the dip
S_DIP = 45
S_MAG_R = 46  # adaptive variance of a magnetic heading [rad²]
S_LEVEL = 47  # slow mean of the level specific force [m/s²], shows a filter that has gone astray
S_SLOW_TURN = 49
S_TURN_END = 50  # time [s] when the last turn ended
S_MAG_BAD = 51  # time [s] since when the magnetometer is rejected, -1 if it is not
S_VIBRATION = 52  # mean square of the fast specific force as white noise [m²/s³]
S_SMOOTH = 53  # specific force, 5 Hz low-pass [m/s²]
S_PATH = 56  # time [s] of the last leeway pseudo-measurement
S_FIELD_TIME = 57  # how long [s] the field has been learned
S_MAG_LAST = 58  # last magnetic innovation [rad] and its time [s]
S_MAG_LAST_TIME = 59
S_DRIVE = 60  # what drives the waves, relative to their power: level, up; follows the NIS
S_COV = 64
SIZE = S_COV + N * N
PHASE_EMPTY, PHASE_ALIGN, PHASE_RUN = 0.0, 1.0, 2.0
# Settings, filled by attitude_model.settings().
(
    C_GYRO_NOISE,
    C_BIAS_WALK,
    C_BIAS_SIGMA,
    C_ACC_NOISE,
    C_ACC_BIAS_SIGMA,
    C_ACC_BIAS_WALK,
    C_ALIGN_TIME,
    C_ALIGN_SIGMA,
    C_WAVE_DAMPING,
    C_WAVE_SIGMA,
    C_WAVE_PERIOD,
    C_WAVE_TIME,
    C_AIDING_INTERVAL,
    C_AIDING_SIGMA,
    C_PATH_WALK,
    C_PATH_TURN,
    C_SPEED_SIGMA,
    C_LEEWAY_SIGMA,
    C_LOG_SIGMA,
    C_GNSS_SIGMA,
    C_MAG_NOISE,
    C_DEVIATION,
    C_DEVIATION_ANGLE,
    C_DECLINATION,
    C_NORM_GATE,
    C_DIP_GATE,
    C_MAG_LOCKOUT,
    C_LEVER,
) = range(28)
C_ANTENNA = C_LEVER + 3
C_SWING = C_ANTENNA + 3
SETTINGS = C_SWING + 5
ALL, TILT, HEADING = 0, 1, 2
OK, GATED = 0, 1
STEP_OK, STEP_ASTRAY, STEP_BROKEN = 0, 1, 2
# A mean level specific force (m/s²) over 30 s that no ship's turn explains: 14° of tilt.
ASTRAY = 2.5
# A turn (rad/s): above what yawing in waves leaves after smoothing.
TURNING = 0.007
# Codes of mag_step beyond these two.
MAG_NORM, MAG_DIP, MAG_RELEARNED = 2, 3, 4
# Doubt (rad/s) about a gyro bias that is kept over a restart.
KEPT_BIAS_SIGMA = 0.005
# Current (m/s) that a velocity over ground may differ by from what was assumed through the water.
CURRENT = 3.0
# Deviation (rad) that a field learned anew may hold.
RELEARNED_DEVIATION = 0.2
