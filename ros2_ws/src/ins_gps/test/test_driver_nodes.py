# SPDX-License-Identifier: Apache-2.0
"""The drivers of NMEA, RTCM and RINEX and the DGPS base as processes."""

import calendar
import contextlib
import math
import socket
import sys
import threading
from functools import partial

import numpy as np
import pytest
from rtcm_encoder import ephemeris_1019, msm, station
from test_nmea import gga, gst, rmc
from test_rtcm import CELL, ORBIT, TOW, WEEK_NUMBER

from ins_gps.codec import (
    CLOUD,
    FIX,
    TWIST,
    decode_corrections,
    decode_fix,
    decode_observations,
    decode_velocity,
)
from ins_gps.constants import GPS_EPOCH_UNIX, WEEK
from ins_gps.nmea import KNOT
from kalman_core.earth import ecef_from_geodetic
from node_core.messages import stamp_of
from node_core.testing import Process, probe, ros_arguments

LONG = 600  # s: discovery on a loaded machine
GEODETIC = np.array([math.radians(21.0285), math.radians(105.8542), 12.345])
DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'


def start(node, **params):
    code = f'from ins_gps.nodes.{node} import main; main()'
    return Process([sys.executable, '-c', code, *ros_arguments(params)])


@pytest.fixture
def graph():
    with probe() as p:
        yield p


def rtcm(count):
    """Return ephemerides of eight satellites, and epochs once a second, each with a base position."""
    satellites = range(1, 9)
    out = [ephemeris_1019(ORBIT | {'satellite': s, 'mean_anomaly': 0.7 * s}, WEEK_NUMBER) for s in satellites]
    for i in range(count):
        out.append(station(ecef_from_geodetic(*GEODETIC)))
        out.append(msm('G', 7, TOW + 1000 * i, [CELL | {'satellite': s, 'lock': 600} for s in satellites]))
    return b''.join(out)


def test_an_nmea_recording_gives_every_fix_and_velocity(graph, tmp_path):
    path = tmp_path / 'walk.nmea'
    times = [f'0927{s:02d}.00' for s in range(50)]
    path.write_bytes(b'noise' + b''.join(rmc(t) + gga(t) + gst(t) for t in times))
    fixes, velocities = graph.collect(FIX, 'gnss/fix'), graph.collect(TWIST, 'gnss/velocity')
    params = {'source': path, 'velocity_topic': 'gnss/velocity', 'replay_rate': 100.0}
    with start('nmea_driver', **params, wait_for_subscribers=LONG) as process:
        graph.until_over(process)
        assert process.wait() == 0, process.output
        assert '50 x GGA or RMC' in process.output
    seconds = [calendar.timegm((2024, 2, 29, 9, 27, i)) for i in range(50)]
    for messages in (fixes, velocities):
        assert [stamp_of(m) // 10**9 for m in messages] == seconds[-len(messages) :] != []
    fix = decode_fix(fixes[-1])
    assert np.degrees(fix.geodetic[0]) == pytest.approx(47.28523317, abs=1e-8)
    assert fix.covariance.diagonal() == pytest.approx((2.25, 0.64, 9.0))  # north, east, down
    assert fixes[-1].position_covariance_type == 2
    east = 10.0 * KNOT * math.sin(math.radians(60.0))
    assert decode_velocity(velocities[-1]).velocity[1] == pytest.approx(east)


def test_rtcm_of_a_recording_gives_every_epoch_and_the_base(graph, tmp_path):
    path = tmp_path / 'base.rtcm'
    path.write_bytes(rtcm(40))
    clouds, positions = graph.collect(CLOUD, 'gnss/observations'), graph.collect(FIX, 'base/position')
    with start('rtcm_driver', source=path, replay_rate=100.0, wait_for_subscribers=LONG) as process:
        graph.until_over(process)
        assert process.wait() == 0, process.output
    epochs = [decode_observations(message) for message in clouds]
    seconds = [e.stamp / 1e9 - GPS_EPOCH_UNIX - WEEK_NUMBER * WEEK - TOW * 1e-3 + 18.0 for e in epochs]
    assert seconds == pytest.approx(range(40 - len(epochs), 40))
    assert epochs
    assert all(len(epoch.rows) == 8 for epoch in epochs)
    np.testing.assert_allclose(decode_fix(positions[-1]).geodetic, GEODETIC, atol=1e-4)


def test_a_lost_caster_is_named_and_asked_again(graph):
    clouds, diagnostics = (
        graph.collect(CLOUD, 'gnss/observations'),
        graph.collect(DIAGNOSTICS, '/diagnostics'),
    )
    enough, requests = threading.Event(), []
    with socket.create_server(('127.0.0.1', 0)) as server:
        port = server.getsockname()[1]

        def serve():
            for visit in range(2):
                connection, _ = server.accept()
                with connection, contextlib.suppress(OSError):
                    requests.append(connection.recv(4096))
                    connection.sendall(b'ICY 200 OK\r\n\r\n')
                    number = 0
                    while not enough.wait(0.02):
                        tow = TOW + 1000 * (100 * visit + number)
                        connection.sendall(rtcm(0) + msm('G', 7, tow, [CELL | {'satellite': 3}]))
                        number += 1
                enough.clear()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        source = f'ntrip://me:secret@127.0.0.1:{port}/BASE0'
        with start('rtcm_driver', source=source, reconnect_time=1.5) as process:
            graph.until(lambda: len(clouds) > 5, 'epochs', process=process)
            enough.set()

            def named():
                return any(
                    s.level == b'\x02' and 'closed' in s.message for d in diagnostics for s in d.status
                )

            graph.until(named, 'an error that names the caster', process=process)
            before = len(clouds)
            graph.until(lambda: len(clouds) > before + 5, 'epochs after the loss', process=process)
            assert process.stop() == 0, process.output
            enough.set()
            assert process.output.count('closed by the server') == 1
            assert 'secret' not in process.output
        thread.join(timeout=5.0)
    assert not any('secret' in str(d) for d in diagnostics)
    assert all(b'Authorization: Basic' in request for request in requests)


def rinex_files(folder):
    base = folder / 'spirent_iono_none'
    if not base.is_dir():
        pytest.skip(f'no recording at {base}')
    return base / 'Base-static_MO_Spirent.obs', base / 'RINEX_GN_Spirent.23N'


def test_a_rinex_base_corrects_from_the_position_in_its_header(graph, recordings):
    observations, navigation = rinex_files(recordings)
    corrections, clouds = graph.collect(CLOUD, 'gnss/corrections'), graph.collect(CLOUD, 'base/observations')
    base = {'topic': 'base/observations', 'position_topic': 'base/position', 'replay_rate': 100.0}
    base |= {'observations': observations, 'navigation': navigation, 'queue_depth': 1000}
    with start('dgps_base', position_source='topic') as dgps:
        # The probe's subscription alone would start the recording.
        both = partial(graph.node.count_subscribers, '/base/observations')
        graph.until(lambda: both() >= 2, 'the subscription of the base', process=dgps)
        with start('rinex_driver', wait_for_subscribers=LONG, **base) as driver:
            graph.until_over(driver)
            assert driver.wait() == 0, driver.output
        graph.until(lambda: len(corrections) > 20, 'corrections', process=dgps)
        assert dgps.stop() == 0, dgps.output
    assert [stamp_of(m) // 10**9 for m in clouds] == [1_673_172_000 + i for i in range(601)][-len(clouds) :]
    assert len(decode_corrections(corrections[-1]).rows) >= 4


def test_a_wrong_base_position_is_said_by_the_node(graph, recordings):
    observations, navigation = rinex_files(recordings)
    diagnostics = graph.collect(DIAGNOSTICS, '/diagnostics')
    corrections = graph.collect(CLOUD, 'gnss/corrections')
    files = {'observations': observations, 'navigation': navigation, 'topic': 'base/observations'}
    with (
        start('dgps_base', position=[48.79, 9.172, 320.0]) as dgps,
        start('rinex_driver', **files, replay_rate=20.0, wait_for_subscribers=LONG),
    ):

        def said():
            return any(
                s.level == b'\x02' and 'wrong by about' in s.message for d in diagnostics for s in d.status
            )

        graph.until(said, 'an error about the position', process=dgps)
        assert dgps.stop() == 0, dgps.output
    # Ten epochs tell that it is wrong.
    assert len(corrections) < 10


@pytest.mark.parametrize(
    ('node', 'params', 'words'),
    [
        ('rinex_driver', {}, "'observations' is empty"),
        ('rinex_driver', {'observations': '/nowhere/base.obs'}, "'navigation' is empty"),
        (
            'rinex_driver',
            {'observations': '/nowhere/base.obs', 'navigation': '/nowhere/base.nav'},
            "'observations': /nowhere/base.obs: cannot be read",
        ),
        ('dgps_base', {}, "'position' is 0, 0, 0"),
        ('dgps_base', {'position_source': 'magic'}, "'position_source' is 'magic'"),
        ('nmea_driver', {}, "'source' is empty"),
        ('nmea_driver', {'source': '/nowhere/a.nmea'}, "'source': /nowhere/a.nmea"),
        ('rtcm_driver', {'source': 'ntrip://caster'}, "'source': expected ntrip://"),
        ('rtcm_driver', {'source': '/nowhere/a.rtcm', 'gps_week': -1}, "'gps_week' is -1"),
    ],
)
def test_a_bad_parameter_is_one_line_and_exit_code_2(node, params, words):
    with start(node, **params) as process:
        assert process.wait() == 2
        (line,) = [line for line in process.output.splitlines() if line.strip()]
        assert words in line
