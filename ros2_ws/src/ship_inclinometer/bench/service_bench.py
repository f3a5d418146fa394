# SPDX-License-Identifier: Apache-2.0
"""Validity, calibration, Modbus and event log: what is measured through the streaming classes."""

from __future__ import annotations

import asyncio
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bag_tools.bench import Row
from ship_inclinometer import modbus_map as m
from ship_inclinometer.attitude_estimator import AttitudeEstimator
from ship_inclinometer.calibration import fit_ellipsoid
from ship_inclinometer.event_log import EventLog
from ship_inclinometer.modbus_device import ModbusDevice
from ship_inclinometer.modbus_server import TcpServer
from ship_inclinometer.samples import VALID, Angles, ImuSample, MagSample, Validity
from ship_inclinometer.simulation import Recording, scenario, simulate

START = 10**18
_WRITER = """
import sys
from ship_inclinometer.event_log import EventLog
log = EventLog(sys.argv[1])
n = 0
while True:
    print(log.append(n, 'mark', 'bench', str(n)), flush=True)
    n += 1
"""


def row(name: str, value: float, unit: str, bar: float | None = None, **extra) -> Row:
    """Return a row of this package."""
    return Row('ship_inclinometer', name, float(value), unit, bar, **extra)


def rows(quick: bool) -> Iterator[Row]:
    """Yield the rows of the Modbus server and of the event log."""
    yield from modbus_rows(2_000 if quick else 100_000)
    lost = lost_events(5 if quick else 200)
    yield row('event log: confirmed events lost over kill -9', lost, 'events', 0.0, seeds=5 if quick else 200)


def stream(recording: Recording) -> list:
    """Return all estimates of the streaming estimator without aiding."""
    rows_ = [
        (START + round(t * 1e9), 0, tuple(g), tuple(f))
        for t, g, f in zip(recording.truth.t, recording.gyro.tolist(), recording.accelerometer.tolist())
    ]
    rows_ += [
        (START + round(t * 1e9), 1, tuple(b), ())
        for t, b in zip(recording.magnetometer_t, recording.magnetometer.tolist())
    ]
    estimator, out = AttitudeEstimator(), []
    for stamp, port, first, second in sorted(rows_, key=lambda r: r[:2]):
        if port == 0:
            out += estimator.on_imu(ImuSample(stamp, first, second))
        else:
            out += estimator.on_mag(MagSample(stamp, first))
    return out


def time_to_valid(seed: int) -> float:
    """Return when [s] the estimator first says valid after a start in motion with 5 °/s of gyro bias."""
    recording = simulate(scenario('hot_start', duration=120.0), seed)
    valid = [e.stamp for e in stream(recording) if isinstance(e, Validity) and e.validity == VALID]
    return (valid[0] - START) / 1e9 if valid else float('inf')


def undeclared_error(seed: int) -> float:
    """Return the largest roll or pitch error [deg] that is declared valid in turns without any speed."""
    recording = simulate(scenario('turns'), seed)
    angles = [e for e in stream(recording) if isinstance(e, Angles) and e.validity == VALID]
    times = np.array([(e.stamp - START) / 1e9 for e in angles])
    worst = 0.0
    for axis in range(2):
        truth = np.interp(times, recording.truth.t, recording.truth.angles[:, axis])
        error = np.degrees(np.abs(np.array([e.angles[axis] for e in angles]) - truth))
        worst = max(worst, float(np.max(error)))
    return worst


def _recorded(folder: str) -> np.ndarray | None:
    """Return a recording of the HMC5883L (N, 3) [G], None where the data or h5py are missing."""
    path = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'ship/mpu6050_hmc5883l' / folder
    try:
        import h5py

        with h5py.File(path / 'hmc5883l_compass.mat') as file:
            return np.array(next(iter(file.values())))[1:].T
    except (ImportError, OSError):
        return None


def recorded_sphere() -> np.ndarray | None:
    """Return the recorded sphere (N, 3) [G], None where the data or h5py are missing."""
    return _recorded('full-sphere')


def blocks(count: int, length: int, folds: int) -> np.ndarray:
    """Return the fold (count,) of each sample when blocks of `length` samples go to the folds in turn."""
    return np.arange(count) // length % folds


def held_out_spread(raw: np.ndarray, fold_of: np.ndarray) -> float:
    """Return the spread [%] of the norm of each fold's samples, calibrated by the other folds."""
    norms = np.empty(len(raw))
    for fold in np.unique(fold_of):
        calibration = fit_ellipsoid(raw[fold_of != fold])
        norms[fold_of == fold] = (
            np.linalg.norm(calibration.apply(raw[fold_of == fold]), axis=1) / calibration.norm
        )
    return 100.0 * float(np.std(norms) / np.mean(norms))


def sphere_rows() -> Iterator[Row]:
    """Yield the rows of the real sphere, nothing where it is missing."""
    raw, still = recorded_sphere(), _recorded('unmoved-with-x-pointing-forward-10min')
    if raw is None or still is None:
        return
    norms = np.linalg.norm(raw, axis=1)
    still_norms = np.linalg.norm(still, axis=1)
    peers = {
        'raw': 100.0 * float(np.std(norms) / np.mean(norms)),
        'the same chip lying still': 100.0 * float(np.std(still_norms) / np.mean(still_norms)),
    }
    count = len(raw)
    splits = {
        'random fifths': np.random.default_rng(0).permutation(count) % 5,
        '5 folds of 0.65 s blocks': blocks(count, 50, 5),
        'halves of 2.6 s blocks': blocks(count, 200, 2),
        'contiguous tenths': np.arange(count) * 10 // count,
        'contiguous fifths': np.arange(count) * 5 // count,
    }
    for name, fold_of in splits.items():
        spread = held_out_spread(raw, fold_of)
        name = f'real HMC5883L sphere: spread of held-out norms, {name}'
        yield row(name, spread, '%', 0.5, reference=peers)


class _Owner:
    def record(self, kind: str, who: str, text: str) -> None:
        """Forget."""

    def command(self, name: str, who: str) -> None:
        """Do nothing."""

    def changed(self, settings: dict[str, float]) -> None:
        """Forget."""

    def save(self, settings: dict[str, float], crc: int) -> None:
        """Forget."""


def modbus_rows(count: int) -> Iterator[Row]:
    """Yield torn reads and the 99th percentile over TCP loopback."""
    torn, latency = asyncio.run(_read_while_updating(count))
    yield row(f'Modbus TCP: torn blocks in {count} reads', torn, 'reads', 0.0)
    yield row('Modbus TCP loopback: 99 % of reads within', 1e3 * latency, 'ms', 5.0)


async def _read_while_updating(count: int) -> tuple[int, float]:
    device = ModbusDevice(1, _Owner(), 0)
    values = {f.name: 1.0 for f in m.MEASURED} | {'utc_seconds': 1.0, 'utc_milliseconds': 0.0, 'age': 0.0}
    server = TcpServer(device, '127.0.0.1', 0, ['127.0.0.1'])
    await device.update(values, {})
    await server.start()

    async def update() -> None:
        while True:
            await device.update(values, {})
            await asyncio.sleep(0.002)

    task = asyncio.create_task(update())
    reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
    request = struct.pack('>HHHBBHH', 1, 0, 6, 1, 4, 0, m.INPUT_COUNT)
    first, last = m.INPUT_ADDRESS['sequence'], m.INPUT_ADDRESS['sequence_copy']
    torn, times = 0, np.empty(count)
    for i in range(count):
        begin = time.perf_counter()
        writer.write(request)
        answer = await reader.readexactly(9 + 2 * m.INPUT_COUNT)
        times[i] = time.perf_counter() - begin
        words = struct.unpack(f'>{m.INPUT_COUNT}H', answer[9:])
        torn += words[first] != words[last]
    task.cancel()
    writer.close()
    await server.stop()
    return torn, float(np.quantile(times, 0.99))


def lost_events(kills: int) -> int:
    """Return how many confirmed events are missing after `kills` writers were killed at random moments."""
    rng = np.random.default_rng(0)
    lost = 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'events.db'
        confirmed: set[int] = set()
        for _ in range(kills):
            writer = subprocess.Popen([sys.executable, '-c', _WRITER, str(path)], stdout=subprocess.PIPE)
            assert writer.stdout is not None
            confirmed.add(int(writer.stdout.readline()))
            time.sleep(float(rng.uniform(0.0, 0.1)))
            writer.send_signal(signal.SIGKILL)
            confirmed |= {int(line) for line in writer.stdout.read().splitlines(True) if line.endswith(b'\n')}
            writer.wait()
            log = EventLog(path)
            present = {event.id for event in log.events()}
            log.close()
            lost = len(confirmed - present)
    return lost
