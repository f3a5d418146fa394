# SPDX-License-Identifier: Apache-2.0
"""Runs a simulated recording through the batch kernel or the streaming class, and scores it."""

from ship_inclinometer.attitude_batch import attitude_errors, run_recording
from ship_inclinometer.samples import ImuSample, MagSample, SpeedSample, VelocitySample

START = 10**18


def run_batch(recording, params):
    return run_recording(recording, params).rows


def errors(recording, rows):
    score = attitude_errors(recording, rows)
    return score.angles, score.nees_tilt


def events_of(recording, with_log=False):
    """Return (stamp, port, sample) in order of time."""
    rows = []
    for t, gyro, force in zip(recording.truth.t, recording.gyro.tolist(), recording.accelerometer.tolist()):
        stamp = START + round(t * 1e9)
        rows.append((stamp, 0, ImuSample(stamp, tuple(gyro), tuple(force))))
    for t, field in zip(recording.magnetometer_t, recording.magnetometer.tolist()):
        stamp = START + round(t * 1e9)
        rows.append((stamp, 1, MagSample(stamp, tuple(field))))
    variance = (recording.params.gnss_noise**2,) * 3
    for t, velocity in zip(recording.gnss_t, recording.gnss_velocity.tolist()):
        stamp = START + round(t * 1e9)
        rows.append((stamp, 2, VelocitySample(stamp, tuple(velocity), variance)))
    if with_log:
        for t, speed in zip(recording.log_t, recording.log_speed.tolist()):
            stamp = START + round(t * 1e9)
            rows.append((stamp, 3, SpeedSample(stamp, speed)))
    return sorted(rows, key=lambda row: row[:2])


def feed(estimator, events):
    handlers = (estimator.on_imu, estimator.on_mag, estimator.on_gnss, estimator.on_log)
    out = []
    for _, port, sample in events:
        out += handlers[port](sample) or []
    return out
