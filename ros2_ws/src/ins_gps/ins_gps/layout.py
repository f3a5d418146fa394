# SPDX-License-Identifier: Apache-2.0
"""Where everything lies in the filter's one flat state array, and the order of its error states.

Error state (truth = estimate + error): position (m, NED) 0-2, velocity (m/s, NED) 3-5, attitude (rad, NED,
q_true = exp(error) q) 6-8, accelerometer bias 9-11, gyro bias 12-14, receiver clock (m) 15, clock drift
(m/s) 16, inter-system bias (m) 17, lasting errors of position fixes (m, NED): a fast one 18-20 and a slow
one 21-23, clone of the previous epoch: antenna position (m, NED) 24-26 and clock (m) 27; then per channel:
slow range error (m), multipath (m), carrier noise of the last epoch (m).
"""

# Values of STAGE.
WAITING, COASTING, RUNNING = 0.0, 1.0, 2.0

# Error states.
POS, VEL, ATT, ACC, GYR, CLK, DRIFT, ISB, FIX, CLONE, CLONE_CLK, CHANNEL = (
    0, 3, 6, 9, 12, 15, 16, 17, 18, 24, 27, 28,
)  # fmt: skip
NAV_STATES = 17  # those that the transition couples: position ... drift
PER_CHANNEL = 3

# Head of the flat array.
SEC, NSEC, STAGE = 0, 1, 2
NAVIGATION = 3  # NAV values: latitude, longitude, height, velocity, q_nb
ACC_BIAS, GYR_BIAS = 13, 16
CLOCK, CLOCK_DRIFT, INTERSYSTEM = 19, 20, 21
RATE, FORCE, HAVE_IMU = 22, 25, 28  # the last sample, bias-free
SPAN, SPAN_FORCE = 29, 30  # s and m/s since the covariance was advanced
CLONE_POS, CLONE_CLOCK, CLONE_SEC, CLONE_NSEC, CLONE_VALID = 33, 36, 37, 38, 39
EPOCH_SEC, EPOCH_NSEC, HAVE_EPOCH = 40, 41, 42
LOST = 43  # s for which no code was accepted although satellites were there
ALIGN_COUNT, ALIGN_FORCE, ALIGN_RATE = 44, 45, 48
ORIGIN, HAVE_ORIGIN = 51, 54
IMU_SEC, IMU_NSEC = 55, 56
STILL, ZERO_USED, CONSTRAINED = 57, 58, 59  # s: still since; last update of either kind
FIX_SEC = 60
IMU_STEP = 64  # s, the last interval of the IMU
BEFORE_VELOCITY = 61  # velocity of the epoch before, while coasting
WHEEL_SUMS = 65  # lateral and vertical: leaky sums of the non-holonomic innovations in σ
HELD = 67  # s over which the last IMU sample has been held
NOISE_SEC, NOISE_NSEC, NOISE_COUNT = 68, 69, 70  # of `vibration`: the last sample; how many before it fit
NOISE_DIFFERENCES = 71  # per axis the last sample and its first and second difference
NOISE_PSD = 89  # (rad/s)²/Hz, then (m/s²)²/Hz, by axis of the IMU
FIX_ERROR = 95  # m, NED: the lasting errors of fixes, the fast one first
FIX_SPREAD = 101  # m²: trace of the last fix's covariance
HEAD = 102

# One channel.
C_KEY, C_SEC, C_NSEC, C_PHASE, C_SAT, C_SATCLK, C_SLOW, C_MULTIPATH, C_NOISE, C_REJECTED = (
    0, 1, 2, 3, 4, 7, 8, 9, 10, 11,
)  # fmt: skip
# Of `faults`: cumulated sums, onset (s), score and information of a drift, its sign, barred (0 or 1), s of
# agreement.
C_PLUS, C_MINUS, C_ONSET, C_SCORE, C_INFORMATION, C_SIGN, C_BARRED, C_AGREED = 12, 13, 14, 15, 16, 17, 18, 19
C_CORRECTED = 20  # 1: the slow error is that of a code with DGPS correction
C_CODE, C_VELOCITY, C_DRIFT = 21, 22, 25  # m, m/s, m/s: of the epoch of C_SAT; code 0: not known
CHANNEL_WIDTH = 26

# DGPS corrections: one slot per satellite that can exist.
SLOTS_PER_SYSTEM = 40
CORRECTION_SLOTS = 2 * SLOTS_PER_SYSTEM
K_RANGE, K_RATE, K_SEC, K_NSEC = 0, 1, 2, 3
# Step (m) of the modelled range at the last change of the ephemeris, and when that was.
K_SHIFT, K_SHIFT_SEC, K_SHIFT_NSEC = 4, 5, 6
CORRECTION_WIDTH = 7


def error_states(channels: int) -> int:
    """Return the number of error states with this many channels."""
    return CHANNEL + PER_CHANNEL * channels


def copied_states(channels: int) -> int:
    """Return the number of error states that a frozen copy holds: all but the clone, which follows others."""
    return error_states(channels) - (CHANNEL - CLONE)


def state_size(channels: int, copies: int = 0) -> int:
    """Return the length of the flat array with this many channels.

    After head, channels and corrections: the covariance (n, n), the signatures of `faults` (channels, n).
    A smoother freezes `copies` errors of an earlier time behind the error states; what later measurements
    say of them is kept in as many values at the array's end.
    """
    n = error_states(channels) + copies
    start = HEAD + channels * CHANNEL_WIDTH + CORRECTION_SLOTS * CORRECTION_WIDTH
    return start + n * n + channels * n + copies
