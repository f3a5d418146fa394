# SPDX-License-Identifier: Apache-2.0
"""The u-blox driver as a process."""

import contextlib
import socket
import sys
import threading

import pytest
from pyubx2 import GET, UBXMessage

from ins_gps.codec import CLOUD, FIX, decode_fix, decode_observations
from node_core.testing import Process, probe, ros_arguments

LONG = 600  # s: discovery on a loaded machine


def start(**params):
    code = 'from ins_gps.nodes.ublox_driver import main; main()'
    return Process([sys.executable, '-c', code, *ros_arguments(params)])


@pytest.fixture
def graph():
    with probe() as p:
        yield p


def pvt(second):
    """Return a NAV-PVT frame made by pyubx2."""
    fields = {'year': 2024, 'month': 2, 'day': 29, 'hour': 12, 'min': 0, 'second': second}
    fields |= {'validDate': 1, 'validTime': 1, 'fixType': 3, 'gnssFixOk': 1, 'lat': 21.0, 'lon': 105.0}
    fields |= {'height': 12_000, 'hAcc': 1500, 'vAcc': 2500}
    return UBXMessage('NAV', 'NAV-PVT', GET, **fields).serialize()


def test_a_lost_server_is_named_and_connected_again(graph):
    fixes = graph.collect(FIX, 'gnss/fix_receiver')
    diagnostics = graph.collect('diagnostic_msgs/msg/DiagnosticArray', '/diagnostics')
    stop, lost = threading.Event(), threading.Event()
    with socket.create_server(('127.0.0.1', 0)) as server:
        address = f'tcp://127.0.0.1:{server.getsockname()[1]}'

        def serve():
            for second in (10, 20):
                connection, _ = server.accept()
                with connection, contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    while not stop.wait(0.02) and not (second == 10 and lost.is_set()):
                        connection.sendall(pvt(second)[:50] + pvt(second))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        with start(source=address, reconnect_time=1.5) as process:
            graph.until(lambda: len(fixes) > 5, 'fixes', process=process)
            lost.set()

            def named():
                return any(s.level == b'\x02' and address in s.message for d in diagnostics for s in d.status)

            graph.until(named, 'an error that names the server', process=process)
            before = len(fixes)
            graph.until(lambda: len(fixes) > before + 5, 'fixes after the loss', process=process)
            assert process.stop() == 0, process.output
            stop.set()
        thread.join(timeout=5.0)
    sample = decode_fix(fixes[-1])
    assert sample.stamp == 1_709_208_020_000_000_000
    assert sample.covariance.diagonal() == pytest.approx((2.25, 2.25, 6.25))


def test_a_recording_is_published_and_the_node_ends(graph, recordings):
    path = recordings / 'spirent_ubx' / 'f9p_static_15min.ubx'
    if not path.is_file():
        pytest.skip(f'no recording at {path}')
    clouds = graph.collect(CLOUD, 'gnss/observations')
    replay = {'replay_rate': 200.0, 'wait_for_subscribers': LONG, 'queue_depth': 2000}
    with start(source=path, bands='all', **replay) as process:
        graph.until_over(process)
        assert process.wait() == 0, process.output
    epochs = [decode_observations(message) for message in clouds]
    assert len(epochs) == 1600
    assert sum(len(epoch.rows) >= 16 for epoch in epochs) > 500
    assert {1.0, 5.0} == {row[2] for epoch in epochs for row in epoch.rows}


@pytest.mark.parametrize(
    ('params', 'words'),
    [
        ({'source': '/nowhere/drive.ubx'}, '/nowhere/drive.ubx'),
        ({'source': 'tcp://nowhere'}, 'expected tcp://HOST:PORT'),
        ({}, "'source' is empty"),
        ({'source': '/dev/none', 'bands': 'third'}, "'bands' is 'third'"),
    ],
)
def test_a_bad_parameter_is_one_line_and_exit_code_2(params, words):
    with start(**params) as process:
        assert process.wait() == 2
        lines = [line for line in process.output.splitlines() if line.strip()]
        assert len(lines) == 1
        assert words in lines[0]
