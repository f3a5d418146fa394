# SPDX-License-Identifier: Apache-2.0
"""The joint filter's memory: one flat array that holds everything that changes while filtering.

Scalars first; then the estimate, its state x (N,) and covariance P (N·N,); then the same of each filter of
the bank; their weights; and a ring of (time, integrated reading).
State::

    V      speed, m/s                      S      wheel scale error: the wheel reads (1 + s + c·a)·v
    B      accelerometer bias + g·sin(grade), m/s²   C  longitudinal slip per acceleration, s²/m
    K      accelerometer gain error (pitch under acceleration)
    TG     delay of the GPS speed, s       TW     delay of the encoder, s
    TS     delay of the speed signals of the wheels, s
    W      distance rolled by the wheel, m D      distance driven, m
    PW     W as it was at the last wheel sample, m
"""

from __future__ import annotations

import numpy as np

N = 11
V, B, K, S, C, TG, TW, TS, W, D, PW = range(N)

# Times are ns since the estimator's origin, exact in a double, and −1 for what has not happened yet.
(
    TIME,  # of the estimate's speed and distance
    BLOCK_TIME,  # of all else in x and P
    PUSH,  # ∫f dt since then, m/s
    HELD,  # time since then for which the reading counted, s
    ROUGH,  # variance of v since then from what the acceleration did between two readings, (m/s)²
    GAIN,  # mean of 1/(1 + K) and of B/(1 + K) over the bank
    GAIN_BIAS,
    MIXED_AT,  # distance driven when the filters of the bank were last mixed, m
    FORCE,  # last specific force, m/s²
    FORCE_TIME,
    INTEGRAL,  # U = ∫f dt, m/s
    BLEED,  # correction not yet let out, m/s
    DIRECTION,  # of the last gear that has one: 1, −1, or 0 before the first
    ACCELERATOR,  # pedals, 0…1
    BRAKE,
    COUNT,  # last encoder count
    COUNT_TIME,
    COUNT_SENSE,  # 1 or −1 as counts go up or down in this gear, 0 before its first tooth
    TURNED_SINCE,  # when they began to go the other way
    TEETH,  # counted without sign
    MOVED_TIME,  # when a wheel sensor last said that the car moves
    PENDING,  # 1 while a count waits for the next to confirm it
    PENDING_COUNT,
    PENDING_SPEED,
    SPEED_TIME,  # last sample of a wheel speed signal
    WHEEL_TIME,  # last sample of any wheel sensor
    WHEEL_ACCEPTED,  # last one used
    WHEEL_SPEED,  # m/s, scale corrected
    WHEEL_RESIDUAL,  # m/s
    WHEEL_REFUSED_SINCE,
    GPS_REFUSED_SINCE,
    GPS_LEAPT,  # whether the first of those refused was far outside the gate
    GPS_ACCEPTED,  # last one used
    NIS,  # of the last sample, −1 if it was not compared
    SLIP,  # slip ratio of the last wheel sample
    ACCELERATION_TIME,  # last output of the acceleration, and of the odometry
    ROAD_TIME,
    OUT_TIME,  # of the last output
    OUT_SPEED,
    OUT_SPEED_VARIANCE,
    OUT_ACCELERATION,
    OUT_ACCELERATION_VARIANCE,
    RING_HEAD,
) = range(43)
X = 43
P = X + N
FILTER = N + N * N
PRIOR = (0.25, 0.5, 0.2, 0.05)  # weights of the bank where nothing is known of the road
MODELS = len(PRIOR)
BANK = X + FILTER
WEIGHTS = BANK + MODELS * FILTER
RING = WEIGHTS + MODELS
SLOTS = 128  # ring entries: 1.3 s at the ring's step of 10 ms, which holds every delay allowed
SIZE = RING + 2 * SLOTS

# What is fixed while filtering.
(
    Q_SPEED, Q_BIAS, Q_GRADE, Q_WHEEL, Q_DELAY, Q_SCALE,
    GATE, TOOTH, WHEEL_CORRELATION, STILL_VARIANCE,
    STILL_TIME, STILL_SPEED, LOCKOUT, Q_COAST, BLEED_TIME, BLEED_STEP,
    P0_SCALE, P0_SLIP, MAX_GAP, SPEED_DELAY_VARIANCE, ACCELERATION_PERIOD, JERK,
    GPS_DELAY_VARIANCE,
) = range(23)  # fmt: skip
CONSTANTS = 23

# What an update did.
USED, REFUSED, REOPENED, SKIPPED, STARTED = range(5)


def fresh(x: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Return a memory (SIZE,) before its first sample, with state `x` (N,) and `variances` (N,)."""
    m = np.zeros(SIZE)
    m[[TIME, BLOCK_TIME, FORCE_TIME, OUT_TIME, ACCELERATION_TIME, ROAD_TIME]] = -1.0
    m[[COUNT_TIME, SPEED_TIME, WHEEL_TIME, WHEEL_ACCEPTED, GPS_ACCEPTED]] = -1.0
    m[[WHEEL_REFUSED_SINCE, GPS_REFUSED_SINCE, TURNED_SINCE]] = -1.0
    m[X:P] = x
    m[P:BANK] = np.diag(variances).ravel()
    m[BANK:WEIGHTS] = np.tile(m[X:BANK], MODELS)
    m[WEIGHTS:RING] = PRIOR
    m[GAIN] = 1.0 / (1.0 + x[K])
    m[GAIN_BIAS] = x[B] / (1.0 + x[K])
    m[RING:] = -1.0
    return m
