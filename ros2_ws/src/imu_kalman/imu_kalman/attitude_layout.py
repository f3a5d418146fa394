# SPDX-License-Identifier: Apache-2.0
"""Where things lie in the arrays of the attitude filter's kernels.

The flat state holds everything that changes while filtering, so that copying one array is a snapshot.
"""

import math

import numpy as np

from imu_kalman.params import AttitudeParams

N = 10
# Layout of the flat state.
SEC, NANOSEC, PHASE = 0, 1, 2
Q = 3
BIAS = 7
VEL = 10
POS = 12
LEVEL = 14  # density q of the motion noise as measured
RATE = 15  # last rate without bias, to carry a magnetometer sample back to the last attitude
SPAN = 18  # s summed in this block
COUNT = 19
RATE2 = 20  # integral of |rate|²
FORCE_N = 21  # integral of the specific force in local level (3)
ROT = 24  # integral of the rotation matrix (9)
GYR_SUM = 33
ACC_SUM = 36
MAG_N = 39  # sum of the field in local level (3)
MAG_COUNT = 42
REST_TIME = 43
REST_GYR = 44
REST_ACC = 47
REF_NORM, REF_DIP, REF_AGE = 50, 51, 52
NEW_NORM, NEW_DIP, NEW_TIME = 53, 54, 55
MAG_STATUS = 56
MOTION_NIS = 57
MAG_NIS = 58
MOTION_ACC, MOTION_VEL, MOTION_AGE = 60, 61, 62  # mean squares that give the frequency of the motion
MAG_LEVEL = 63  # mean square of the relative disturbance of the field
GRAVITY = 64  # specific force in local level, integrated: over the alignment, then with a short memory (3)
ALIGNED = 67  # s of alignment done
LAST_GYR, LAST_ACC = 68, 71  # last samples taken, for the check on wild jumps (3 each)
MAG_WAIT = 75  # s since the last block with a field
MAG_MEAN_NIS = 76
RESTS = 77  # blocks at rest since the start
# Faults of the sensor; see `attitude_faults`.
STUCK, BLIND = 78, 79  # s of this block in which an axis, or all three, were not measured
PUSHED, DEAF = 80, 81  # samples of this block whose specific force is doubted; s in which it was stuck
# By axis of the gyro, and for the specific force as a whole (4 each):
REPEATS = 82  # readings of this block that repeat the one before
SHARE = 86  # share of repeated readings
LONGEST = 90  # repetitions in a row that are no chance
RUN, RUN_TIME = 94, 98  # repetitions so far, and s of them
STUCK_COUNT, VARIED = 102, 103  # samples in a row with something stuck; samples that varied before them
SPIN_LEVEL, TURN_LEVEL = 104, 105  # angular acceleration² and rate² of the last seconds
LAST_MEAN = 106  # mean rate of the last block (3)
PERIOD = 109  # s between samples
DOUBT = 110  # rad², variance of the attitude that holds if a jump which is believed is a fault
JUMP, PUSH = 111, 124  # jumps of the rate and of the specific force, each laid out as follows
# Jumps of this fault, samples held, s since the last jump and since the first, variance added; value before
# (3), integral of what lies beyond it (3); largest change from one sample to the next, of this block and of
# the last seconds.
J_COUNT, J_HELD, J_QUIET, J_AGE, J_ADDED, J_VALUE, J_BEYOND, J_STEP, J_LEVEL = 0, 1, 2, 3, 4, 5, 8, 11, 12
GYR_VAR = 137  # (rad/s)², variance of the rate as its sender told it last; 0: never
COV = 138
STATE = COV + N * N

# Parameter vector.
(
    BLOCK,
    GYRO_PSD,
    SCALE_PSD,
    BIAS_PSD,
    BIAS_VAR,
    ACC_PSD,
    TILT_VAR,
    OMEGA_MIN,
    OMEGA_MAX,
    OMEGA_SHARE,
    DAMPING,
    LEVEL_MIN,
    LEVEL_SPAN,
    LEVEL_DECAY,
    REST_RATE,
    REST_FORCE,
    REST_SPAN,
    REST_PSD,
    MAG_PSD,
    MAG_SPAN,
    MAG_DECAY,
    MAG_DELAY,
    NORM_GATE,
    DIP_GATE,
    REF_MEMORY,
    REF_RECOVERY,
    MAX_GAP,
    MIN_FORCE,
    USE_MAG,
    DELAY,
    DELAY_VAR,
    HEADING_VAR,
    START_VEL_VAR,
    START_SPAN,
    MAX_ANGULAR_ACC,
    MAX_JERK,
    MIN_JUMP,
    MIN_PUSH,
    HIDDEN_ACC,
) = range(39)
PARAMS = 39
# Scratch (WORK, N, N): transition, half product, vectors (row by row below), covariance before the updates.
WORK = 4
PHI, HALF, VECTORS, PRIOR = range(WORK)
PH, GAIN, ROW, CORRECTION, LINK = range(5)
# work[VECTORS, LINK, 0]: how the block hangs on the one before it, for the smoother.
BROKEN, LINKED, RIGID = range(3)

# Codes of `inertial_step`.
OK, STARTED, RESTARTED, WAITING, FAILED, REALIGNING, HELD, LOST = range(8)
# More repetitions than any run has.
NEVER = 1e18
# Values of state[MAG_STATUS]: what the last block with a field did.
MAG_NONE, MAG_USED, MAG_DISTURBED, MAG_RELEARNED = range(4)

# A weaker field (T) has no usable direction: the earth's is 2e-5 at least, no small sensor resolves 1e-9.
MIN_FIELD = 1e-9
# Standard gravity (m/s²). Its error, and the accelerometer's scale, change tilt by that share only.
GRAVITY_NORM = 9.80665
# A wrapped angle of which nothing is known is uniform over the circle: variance pi²/3.
UNKNOWN_ANGLE_VAR = math.pi**2 / 3.0


def pack(p: AttitudeParams) -> np.ndarray:
    """Return the parameter vector of the kernels (PARAMS,)."""
    turn = 2.0 * math.pi
    values = {
        BLOCK: p.block,
        GYRO_PSD: p.gyro_noise**2,
        SCALE_PSD: p.rate_noise**2,
        BIAS_PSD: p.bias_walk**2,
        BIAS_VAR: p.bias_sigma**2,
        ACC_PSD: p.accel_noise**2,
        TILT_VAR: p.tilt_sigma**2,
        OMEGA_MIN: turn * p.motion_frequency,
        OMEGA_MAX: turn * max(p.motion_frequency, p.motion_frequency_max),
        OMEGA_SHARE: p.motion_share,
        DAMPING: p.motion_damping,
        LEVEL_MIN: p.motion_noise**2,
        LEVEL_SPAN: p.motion_span,
        LEVEL_DECAY: p.motion_memory,
        REST_RATE: p.rest_rate,
        REST_FORCE: p.rest_force,
        REST_SPAN: p.rest_time,
        REST_PSD: p.rest_noise**2,
        MAG_PSD: p.mag_noise**2,
        MAG_SPAN: p.mag_span,
        MAG_DECAY: p.mag_memory,
        MAG_DELAY: p.mag_delay,
        NORM_GATE: p.mag_norm_gate,
        DIP_GATE: p.mag_dip_gate,
        REF_MEMORY: p.mag_reference,
        REF_RECOVERY: p.mag_recovery,
        MAX_GAP: p.max_gap,
        MIN_FORCE: p.min_force,
        USE_MAG: float(p.use_magnetometer),
        DELAY: p.sensor_delay,
        DELAY_VAR: p.delay_sigma**2,
        HEADING_VAR: p.heading_sigma**2,
        START_VEL_VAR: p.start_speed**2,
        START_SPAN: p.start_time,
        MAX_ANGULAR_ACC: p.max_angular_acceleration,
        MAX_JERK: p.max_jerk,
        MIN_JUMP: p.min_jump,
        MIN_PUSH: p.min_push,
        HIDDEN_ACC: p.hidden_acceleration,
    }
    out = np.zeros(PARAMS)
    for index, value in values.items():
        out[index] = value
    return out
