# SPDX-License-Identifier: Apache-2.0
"""Channels of the tight filter: which satellite lies where in the state, its corrections and its weight."""

import math

import numpy as np
from numba import njit

from ins_gps.constants import (
    FREQUENCY_E5B,
    FREQUENCY_L1,
    FREQUENCY_L2,
    FREQUENCY_L5,
    SPEED_OF_LIGHT,
    WAVELENGTH_L1,
)
from ins_gps.faults import close_hypothesis
from ins_gps.layout import (
    C_AGREED,
    C_BARRED,
    C_CORRECTED,
    C_KEY,
    C_MULTIPATH,
    C_NSEC,
    C_SEC,
    C_SLOW,
    CHANNEL,
    CHANNEL_WIDTH,
    CORRECTION_WIDTH,
    HEAD,
    K_NSEC,
    K_RANGE,
    K_RATE,
    K_SEC,
    K_SHIFT,
    K_SHIFT_NSEC,
    K_SHIFT_SEC,
    NAVIGATION,
    NSEC,
    PER_CHANNEL,
    RATE,
    SEC,
    SLOTS_PER_SYSTEM,
)
from ins_gps.orbit import range_and_rate
from ins_gps.orbit_change import follow_orbit
from ins_gps.prediction import CONFIG_PREDICTION, covariance_of, signatures_of
from kalman_core.earth import ecef_from_geodetic

# Configuration columns after those of `prediction`.
(
    CODE_NOISE,  # m, white
    CODE_SLOW,  # m, constant per satellite, with DGPS correction
    CODE_SLOW_ALONE,  # m, the same without correction
    CODE_MULTIPATH,  # m, first order
    MULTIPATH_TIME,  # s
    CARRIER_NOISE,  # m, white
    CARRIER_WALK,  # m/sqrt(s)
    DOPPLER_NOISE,  # m/s
    LEVER_X,  # m, antenna from IMU, forward-right-down
    LEVER_Y,
    LEVER_Z,
    MASK,  # rad
    GATE,  # squared leave-one-out innovation
    RATES,  # 0 none, 1 Doppler, 2 carrier difference between epochs, 3 carrier difference as a rate
    WEIGHTING,  # 1: σ grows with 1/sin(elevation) and low C/N0
    CORRECTION_AGE,  # s
    RATE_CORRECTION,  # 1: the base's rate correction applies to the carrier difference
    CLONES,  # 1: clone and channel states are estimated
    LOST_TIME,  # s without any accepted code before the position starts anew
    CN0_REFERENCE,  # dB-Hz
    PUBLISHED_RATE_NOISE,  # m/s, of the carrier difference taken as a rate
    CARRIER_INTERVAL,  # s, longest carrier difference
    FAULT_GATE,  # statistic of a drifting code
    CODE_BAND,  # m, constant per signal of another band, against the first band's of its satellite
    CODE_BAND_COMMON,  # m, the part of it that all satellites share: the receiver's delay of the band
) = range(CONFIG_PREDICTION, CONFIG_PREDICTION + 25)
CONFIG_SIZE = CONFIG_PREDICTION + 25

# What became of a row, reported per satellite.
ROW_UNUSED, ROW_USED, ROW_CODE_REJECTED, ROW_LOW, ROW_NO_ORBIT, ROW_DRIFTS = 0, 1, 2, 3, 4, 5
RATE_NONE, RATE_USED, RATE_SLIP, RATE_NEW, RATE_DOPPLER = 0, 1, 2, 3, 4
# Columns of the per-row report and of the epoch's summary.
REPORT_CODE, REPORT_RATE, REPORT_CODE_W, REPORT_RATE_W, REPORT_ELEVATION = 0, 1, 2, 3, 4
REPORT_WIDTH = 5
SUM_CODE_NIS, SUM_CODE_USED, SUM_RATE_NIS, SUM_RATE_USED, SUM_CLOCK_JUMP, SUM_RESTART = 0, 1, 2, 3, 4, 5
SUMMARY = 6

# A channel that was not seen for this long (s) starts its errors anew: the satellite has moved on.
_FORGET = 600.0
FIRST_BAND = 1.0  # L1 and E1: the band of DGPS corrections and broadcast clocks


@njit(cache=True, nogil=True)
def wavelength(signal):
    """Return the wavelength (m) of a RINEX band."""
    if signal == 2.0:
        return SPEED_OF_LIGHT / FREQUENCY_L2
    if signal == 5.0:
        return SPEED_OF_LIGHT / FREQUENCY_L5
    if signal == 7.0:
        return SPEED_OF_LIGHT / FREQUENCY_E5B
    return SPEED_OF_LIGHT / FREQUENCY_L1


@njit(cache=True, nogil=True)
def clear_error(state, channels, index, variance):
    """Make error `index` independent of all others, with this variance."""
    P = covariance_of(state, channels)
    signatures_of(state, channels)[:, index] = 0.0
    n = P.shape[0]
    for k in range(n):
        P[index, k] = 0.0
        P[k, index] = 0.0
    P[index, index] = variance


@njit(cache=True, nogil=True)
def signal_key(row):
    """Return the number, never 0, that names a row's satellite and signal."""
    return 1.0 + row[0] * 1_000.0 + row[1] * 10.0 + row[2]


@njit(cache=True, nogil=True)
def _first_band_of(state, channels, channel):
    """Return the channel of the same satellite's first band, alike in correction and in use, or -1."""
    at = HEAD + channel * CHANNEL_WIDTH
    name = state[at + C_KEY] - 1.0
    wanted = state[at + C_KEY] - name % 10.0 + FIRST_BAND
    for i in range(channels):
        other = HEAD + i * CHANNEL_WIDTH
        if i == channel or state[other + C_KEY] != wanted or state[other + C_BARRED] > 0.0:
            continue
        if (
            state[other + C_CORRECTED] == state[at + C_CORRECTED]
            and state[SEC] - state[other + C_SEC] < _FORGET
        ):
            return i
    return -1


@njit(cache=True, nogil=True)
def _pair_of_band(state, channels, channel):
    """Return the two channels of another satellite that know best how far the bands are apart, or -1, -1."""
    P = covariance_of(state, channels)
    at = HEAD + channel * CHANNEL_WIDTH
    name = state[at + C_KEY] - 1.0
    best, best_first, least = -1, -1, math.inf
    for i in range(channels):
        other = HEAD + i * CHANNEL_WIDTH
        theirs = state[other + C_KEY] - 1.0
        if i == channel or theirs < 0.0 or theirs % 10.0 != name % 10.0:
            continue
        if theirs // 1_000.0 != name // 1_000.0 or state[other + C_BARRED] > 0.0:
            continue
        if state[other + C_CORRECTED] != state[at + C_CORRECTED]:
            continue
        first = _first_band_of(state, channels, i)
        if first < 0:
            continue
        a, b = CHANNEL + PER_CHANNEL * i, CHANNEL + PER_CHANNEL * first
        spread = P[a, a] + P[b, b] - 2.0 * P[a, b]
        if spread < least:
            best, best_first, least = i, first, spread
    return best, best_first


@njit(cache=True, nogil=True)
def _lean_on(state, channels, index, source, sign):
    """Add `sign` times error `source` to error `index`; what it depends on comes with it."""
    P, F = covariance_of(state, channels), signatures_of(state, channels)
    n = P.shape[0]
    P[index, index] += P[source, source] + 2.0 * sign * P[index, source]
    for k in range(n):
        if k != index:
            P[index, k] += sign * P[source, k]
            P[k, index] = P[index, k]
    F[:, index] += sign * F[:, source]


@njit(cache=True, nogil=True)
def _renew_slow(state, channels, config, channel, corrected):
    """Start the slow error of a code anew: with a DGPS correction it is another than without.

    Orbit, satellite clock and troposphere are the same for all signals of a satellite, and the receiver's
    delay of a band for all satellites: a code of another band starts from what is known of these, so that
    its errors do not count as independent.
    """
    at = HEAD + channel * CHANNEL_WIDTH
    state[at + C_CORRECTED] = 1.0 if corrected else 0.0
    state[at + C_SLOW] = state[at + C_BARRED] = state[at + C_AGREED] = 0.0
    close_hypothesis(state, channels, channel)
    slow = config[CODE_SLOW] if corrected else config[CODE_SLOW_ALONE]
    index, on = CHANNEL + PER_CHANNEL * channel, config[CLONES]
    if (state[at + C_KEY] - 1.0) % 10.0 == FIRST_BAND or on == 0.0:
        clear_error(state, channels, index, on * slow * slow)
        return
    own = config[CODE_BAND] ** 2
    twin = _first_band_of(state, channels, channel)
    clear_error(state, channels, index, own if twin >= 0 else own + slow * slow)
    if twin >= 0:
        state[at + C_SLOW] = state[HEAD + twin * CHANNEL_WIDTH + C_SLOW]
        _lean_on(state, channels, index, CHANNEL + PER_CHANNEL * twin, 1.0)
    other, first = _pair_of_band(state, channels, channel)
    P = covariance_of(state, channels)
    if other < 0:
        P[index, index] += config[CODE_BAND_COMMON] ** 2
        return
    # The other satellite's pair differs by the receiver's delay and by a part of its own.
    P[index, index] += own
    state[at + C_SLOW] += state[HEAD + other * CHANNEL_WIDTH + C_SLOW]
    state[at + C_SLOW] -= state[HEAD + first * CHANNEL_WIDTH + C_SLOW]
    _lean_on(state, channels, index, CHANNEL + PER_CHANNEL * other, 1.0)
    _lean_on(state, channels, index, CHANNEL + PER_CHANNEL * first, -1.0)


@njit(cache=True, nogil=True)
def channel_of(state, channels, config, key, corrected):
    """Return the channel of satellite `key`, freeing the one unseen longest if all are taken."""
    free, oldest = -1, -1
    oldest_age = -1.0
    for i in range(channels):
        at = HEAD + i * CHANNEL_WIDTH
        if state[at + C_KEY] == key:
            age = state[SEC] - state[at + C_SEC]
            if age < _FORGET:
                if corrected != (state[at + C_CORRECTED] > 0.0):
                    _renew_slow(state, channels, config, i, corrected)
                return i
            free = i
            break
        if state[at + C_KEY] == 0.0:
            if free < 0:
                free = i
        else:
            age = state[SEC] - state[at + C_SEC] + (state[NSEC] - state[at + C_NSEC]) * 1e-9
            if age > oldest_age:
                oldest, oldest_age = i, age
    if free < 0:
        # A satellite of this very epoch keeps its channel.
        if oldest_age <= 0.0:
            return -1
        free = oldest
    at = HEAD + free * CHANNEL_WIDTH
    for k in range(CHANNEL_WIDTH):
        state[at + k] = 0.0
    state[at + C_KEY] = key
    _renew_slow(state, channels, config, free, corrected)
    first = CHANNEL + PER_CHANNEL * free
    on = config[CLONES]
    clear_error(state, channels, first + 1, on * config[CODE_MULTIPATH] * config[CODE_MULTIPATH])
    clear_error(state, channels, first + 2, on * config[CARRIER_NOISE] * config[CARRIER_NOISE])
    return free


@njit(cache=True, nogil=True)
def decay_multipath(state, channels, config, dt):
    """Advance the multipath states of all channels by dt (s); nothing else depends on them in between."""
    if not (config[MULTIPATH_TIME] > 0.0 and config[CLONES] > 0.0):
        return
    P = covariance_of(state, channels)
    n = P.shape[0]
    factor = math.exp(-dt / config[MULTIPATH_TIME])
    fresh = (1.0 - factor * factor) * config[CODE_MULTIPATH] ** 2
    for i in range(channels):
        at = HEAD + i * CHANNEL_WIDTH
        if state[at + C_KEY] == 0.0:
            continue
        state[at + C_MULTIPATH] *= factor
        index = CHANNEL + PER_CHANNEL * i + 1
        for k in range(n):
            P[index, k] *= factor
        for k in range(n):
            P[k, index] *= factor
        P[index, index] += fresh
        signatures_of(state, channels)[:, index] *= factor


@njit(cache=True, nogil=True)
def antenna(state, config, mat_nb, mat_en, lever_n, out):
    """Fill `out` (3,) with the antenna's ECEF position and `lever_n` (3,) with the lever arm in NED."""
    nav = state[NAVIGATION : NAVIGATION + 3]
    for i in range(3):
        lever_n[i] = (
            mat_nb[i, 0] * config[LEVER_X] + mat_nb[i, 1] * config[LEVER_Y] + mat_nb[i, 2] * config[LEVER_Z]
        )
    position = ecef_from_geodetic(nav[0], nav[1], nav[2])
    for i in range(3):
        out[i] = position[i]
        for j in range(3):
            out[i] += mat_en[i, j] * lever_n[j]


@njit(cache=True, nogil=True)
def antenna_velocity(state, config, mat_nb, mat_en, out):
    """Fill `out` (3,) with the antenna's velocity in ECEF (m/s), rotation about the IMU included."""
    w = state[RATE : RATE + 3]
    x, y, z = config[LEVER_X], config[LEVER_Y], config[LEVER_Z]
    b0, b1, b2 = w[1] * z - w[2] * y, w[2] * x - w[0] * z, w[0] * y - w[1] * x
    v = np.empty(3)
    for i in range(3):
        v[i] = state[NAVIGATION + 3 + i] + mat_nb[i, 0] * b0 + mat_nb[i, 1] * b1 + mat_nb[i, 2] * b2
    for i in range(3):
        out[i] = mat_en[i, 0] * v[0] + mat_en[i, 1] * v[1] + mat_en[i, 2] * v[2]


@njit(cache=True, nogil=True)
def correction_slot(channels, row):
    """Return where the correction of a row's satellite begins."""
    slot = int(row[0]) * SLOTS_PER_SYSTEM + int(row[1])
    return HEAD + channels * CHANNEL_WIDTH + slot * CORRECTION_WIDTH


@njit(cache=True, nogil=True)
def correction_of(state, channels, config, row):
    """Return (range correction, rate correction, valid) of a row's satellite at the state's time."""
    at = correction_slot(channels, row)
    if state[at + K_SEC] == 0.0:
        return 0.0, 0.0, False
    age = (state[SEC] - state[at + K_SEC]) + (state[NSEC] - state[at + K_NSEC]) * 1e-9
    if abs(age) > config[CORRECTION_AGE]:
        return 0.0, 0.0, False
    value = state[at + K_RANGE] + age * state[at + K_RATE]
    changed = (state[at + K_SHIFT_SEC] - state[at + K_SEC]) + (
        state[at + K_SHIFT_NSEC] - state[at + K_NSEC]
    ) * 1e-9
    if state[at + K_SHIFT_SEC] != 0.0 and changed > 0.0:
        value += state[at + K_SHIFT]
    return value, state[at + K_RATE], True


@njit(cache=True, nogil=True)
def store_corrections(state, channels, rows, sec, nsec):
    """Keep a base's corrections: rows (m, 5) of `samples.CORRECTION_FIELDS`."""
    for i in range(len(rows)):
        at = correction_slot(channels, rows[i])
        state[at + K_RANGE] = rows[i, 2]
        state[at + K_RATE] = rows[i, 3]
        state[at + K_SEC] = sec
        state[at + K_NSEC] = nsec


@njit(cache=True, nogil=True)
def has_code(state, channels, config, row):
    """Return whether a row has a code that can be used.

    A correction holds the ionosphere of the first band: without a model nothing says how much more another
    band has, and it is metres.
    """
    if not math.isfinite(row[3]):
        return False
    if row[2] == FIRST_BAND or math.isfinite(row[17]):
        return True
    return not correction_of(state, channels, config, row)[2]


@njit(cache=True, nogil=True)
def corrected_range(state, channels, config, row):
    """Return (pseudorange free of satellite clock and modelled delays (m), rate correction, corrected).

    A correction holds the ionosphere of the first band, of which another band has more.
    """
    value = row[3] + SPEED_OF_LIGHT * row[15]
    correction, rate, valid = correction_of(state, channels, config, row)
    if valid:
        if row[2] != FIRST_BAND and math.isfinite(row[17]):
            value -= row[17] * (1.0 - (WAVELENGTH_L1 / wavelength(row[2])) ** 2)
        return value + correction, rate, True
    if math.isfinite(row[17]):
        value -= row[17]
    if math.isfinite(row[18]):
        value -= row[18]
    return value, 0.0, False


@njit(cache=True, nogil=True)
def weight_of(config, elevation, cn0):
    """Return the factor on the code variance for a low elevation (rad) or weak signal (dB-Hz)."""
    if config[WEIGHTING] == 0.0:
        return 1.0
    sine = math.sin(max(elevation, 0.05))
    factor = 0.5 + 0.5 / (sine * sine)
    if math.isfinite(cn0) and cn0 < config[CN0_REFERENCE]:
        factor *= 10.0 ** (0.1 * (config[CN0_REFERENCE] - cn0))
    return factor


@njit(cache=True, nogil=True)
def assign(state, channels, config, rows, site, mat_en, use, report):
    """Give each usable row its channel: use[i] is the channel or -1; report[i] says why not."""
    zero = np.zeros(3)
    los = np.empty(3)
    count = 0
    for i in range(len(rows)):
        use[i] = -1
        report[i, :] = 0.0
    # The first band comes first: the others lean on it, and it keeps its channels where these are few.
    for other_bands in (False, True):
        for i in range(len(rows)):
            row = rows[i]
            if (row[2] != FIRST_BAND) != other_bands:
                continue
            if not (math.isfinite(row[9] + row[10] + row[11] + row[15]) and row[9] * row[9] > 0.0):
                report[i, REPORT_CODE] = ROW_NO_ORBIT
                continue
            if not math.isfinite(row[3]) and not math.isfinite(row[4]):
                continue
            range_and_rate(row[9:15], site, zero, los)
            up = -(mat_en[0, 2] * los[0] + mat_en[1, 2] * los[1] + mat_en[2, 2] * los[2])
            elevation = math.asin(min(1.0, max(-1.0, up)))
            if elevation < config[MASK]:
                report[i, REPORT_CODE] = ROW_LOW
                continue
            key = signal_key(row)
            corrected = correction_of(state, channels, config, row)[2]
            use[i] = channel_of(state, channels, config, key, corrected)
            if use[i] < 0:
                continue
            at = HEAD + use[i] * CHANNEL_WIDTH
            since = (state[SEC] - state[at + C_SEC]) + (state[NSEC] - state[at + C_NSEC]) * 1e-9
            estimated = config[CLONES] > 0.0
            follow_orbit(state, at, correction_slot(channels, row), estimated, row, site, since)
            # Seen now: cannot lose its channel to a later row of this epoch.
            state[at + C_SEC], state[at + C_NSEC] = state[SEC], state[NSEC]
            report[i, REPORT_ELEVATION] = weight_of(config, elevation, row[6])
            count += 1
    return count
