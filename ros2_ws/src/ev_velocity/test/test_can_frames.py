# SPDX-License-Identifier: Apache-2.0
import math
import os
from dataclasses import replace
from pathlib import Path

import can
import cantools
import numpy as np
import pytest

from ev_velocity.can_frames import (
    SET_BACK,
    CanDecoder,
    CanError,
    CarOnCan,
    Gear,
    Pedals,
    Speed,
    Wheels,
    load_dbc,
    replay,
)
from ev_velocity.can_profiles import IMIEV, PROFILES, TOYOTA86, Profile, Signal
from ev_velocity.can_source import BusFrames
from node_core.byte_sources import SourceError

DATA = Path(os.environ.get('ESTIMATOR_DATA', '../shared/data')) / 'ev'
START = 1_767_225_600_000_000_000
PERIOD = 20_000_000


@pytest.fixture
def car():
    sender = CarOnCan('virtual', 'test_can_frames')
    yield sender
    sender.close()


def decoder(brake_full=400.0):
    return CanDecoder(load_dbc(''), IMIEV, brake_full)


def feed(decoder, messages, stamp=START):
    return [r for m in messages for r in decoder.on_frame(stamp, m.arbitration_id, bytes(m.data))]


def test_what_the_simulated_car_sends_is_what_is_read(car):
    d = decoder()
    feed(d, car.frames(speed=12.5, accelerator=0.3, brake=0.0))
    readings = {type(r): r for r in feed(d, car.frames(12.5, 0.3, 0.0), START + PERIOD)}
    assert readings[Wheels].speeds == pytest.approx([12.5] * 4, abs=0.02)
    assert readings[Speed].speed == pytest.approx(12.5, abs=0.003)
    assert readings[Pedals].accelerator == pytest.approx(0.3, abs=0.005)
    assert readings[Gear].direction == 1
    braking = feed(d, car.frames(12.5, 0.0, 0.5), START + 2 * PERIOD)
    assert next(r for r in braking if isinstance(r, Pedals)).brake == pytest.approx(0.5, abs=0.01)


def test_bytes_read_as_the_public_descriptions_say():
    d = decoder()
    speed = d.on_frame(START, 0x215, bytes([0x19, 0x00, 0, 0, 0, 0, 0, 0]))
    assert speed == [Speed(START, pytest.approx(0x1900 / 128.0 / 3.6))]
    assert d.on_frame(START, 0x418, bytes([0x52, 0, 0, 0, 0, 0, 0])) == [Gear(START, -1)]
    pedals = d.on_frame(START, 0x210, bytes([0, 0, 125, 0, 0, 0, 0]))
    assert pedals == [Pedals(START, pytest.approx(0.5), 0.0)]
    raw = (49152 + 19 * 36).to_bytes(2, 'big')
    wheels = d.on_frame(START, 0x200, bytes([0, 0]) + raw + raw + bytes([0, 0]))[0]
    assert wheels.speeds[:2] == pytest.approx((10.0, 10.0), abs=1e-6)
    assert all(math.isnan(speed) for speed in wheels.speeds[2:])


def test_wrong_frames_are_counted_with_their_reason():
    d = decoder()
    assert d.on_frame(START, 0x215, bytes(5)) == []
    assert d.on_frame(START, 0x215, bytes([0xFF] * 8)) == []
    assert d.on_frame(START, 0x7FF, bytes(8)) == []
    assert d.on_frame(START, 0x215, bytes(8), error=True) == []
    d.on_frame(START + 1, 0x215, bytes(8))
    assert d.on_frame(START, 0x215, bytes(8)) == []
    health = d.health['SPEED']
    assert dict(health.rejected) == {
        'DLC 5, expected 8': 1,
        'SPEED out of range': 1,
        'stamp goes back': 1,
    }
    assert health.accepted == 1
    assert d.bus_errors == 1


def test_missing_and_stale_frames_are_named(car):
    d = decoder()
    assert set(d.stale(START, 0.5)) == set(d.health)
    for i in (0, 1, 2, 10, 11):
        feed(d, car.frames(5.0, 0.0, 0.0), START + i * PERIOD)
    assert d.health['SPEED'].missing == 7
    assert d.stale(START + 12 * PERIOD, 0.5) == []
    d.on_frame(START + 60 * PERIOD, 0x215, bytes(8))
    assert 'SPEED' not in d.stale(START + 60 * PERIOD, 0.5)
    assert 'GEAR' in d.stale(START + 60 * PERIOD, 0.5)


def test_a_clock_that_is_set_back_is_followed(car):
    d = decoder()
    for i in range(50):
        feed(d, car.frames(5.0, 0.1, 0.0), START + i * PERIOD)
    back = START - 3600 * 10**9
    assert set(d.stale(back, 0.5)) == set(d.health)
    readings = [feed(d, car.frames(6.0, 0.1, 0.0), back + i * PERIOD) for i in range(4)]
    refused = sum(h.rejected['stamp goes back'] for h in d.health.values())
    assert refused == SET_BACK - 1
    assert [len(some) for some in readings[2:]] == [4, 4]
    assert d.stale(back + 4 * PERIOD, 0.5) == []
    last = next(r for r in readings[3] if isinstance(r, Wheels))
    assert last.speeds == pytest.approx([6.0] * 4, abs=0.02)


def test_single_frames_out_of_order_are_no_set_back(car):
    d = decoder()
    for i in range(3 * SET_BACK):
        feed(d, car.frames(5.0, 0.1, 0.0), START + i * PERIOD)
        assert d.on_frame(START - 10**9, 0x215, bytes(8)) == []
    assert d.health['SPEED'].rejected['stamp goes back'] == 3 * SET_BACK


class Bus:
    """A bus of python-can that gives what it is told; as socketcan's, it never says that it is off."""

    state = can.BusState.ACTIVE

    def __init__(self, *messages):
        self.messages = list(messages)
        self.open = True

    def recv(self, timeout):
        message = self.messages.pop(0) if self.messages else None
        if isinstance(message, Exception):
            raise message
        return message

    def shutdown(self):
        self.open = False


def bus_of(monkeypatch, *messages):
    bus = Bus(*messages)
    monkeypatch.setattr(can, 'Bus', lambda **_: bus)
    return bus, BusFrames('socketcan', 'can0', 500_000)


def test_a_live_bus_gives_frames_and_counts_its_errors(monkeypatch):
    data = can.Message(arbitration_id=0x215, data=bytes(8), is_extended_id=False)
    noisy = can.Message(arbitration_id=0x08, data=bytes(8), is_error_frame=True)
    bus, frames = bus_of(monkeypatch, data, None, noisy)
    assert frames.read() == (0, 0x215, bytes(8), False)
    assert frames.read() == ()
    assert frames.read().error
    frames.close()
    assert not bus.open


def test_a_controller_that_leaves_the_bus_is_named(monkeypatch):
    off = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True)
    _, frames = bus_of(monkeypatch, off)
    with pytest.raises(SourceError, match="socketcan 'can0': bus-off"):
        frames.read()
    bus, frames = bus_of(monkeypatch)
    bus.state = can.BusState.ERROR
    with pytest.raises(SourceError, match='bus-off'):
        frames.read()
    # A data frame may have that bit in its id.
    _, frames = bus_of(monkeypatch, can.Message(arbitration_id=0x40, data=b'', is_extended_id=False))
    assert frames.read().frame_id == 0x40


def test_a_lost_interface_is_named(monkeypatch):
    _, frames = bus_of(monkeypatch, can.CanOperationError('gone'))
    with pytest.raises(SourceError, match="'can0' lost: gone"):
        frames.read()
    monkeypatch.undo()
    with pytest.raises(SourceError, match="'x' cannot be opened"):
        BusFrames('nonsense', 'x', 500_000)


def test_a_counter_that_stands_still_is_a_frozen_sender():
    text = (
        'VERSION ""\nNS_ :\nBS_:\nBU_: A\n\nBO_ 16 F: 2 A\n'
        ' SG_ X : 0|8@1+ (1,0) [0|200] "" A\n SG_ N : 8|4@1+ (1,0) [0|15] "" A\n'
    )
    signal = Signal('F', 'X')
    profile = Profile(wheels={'wheel_1': signal}, accelerator=signal, counters={'F': 'N'})
    d = CanDecoder(cantools.database.load_string(text, 'dbc'), profile)
    given = [len(d.on_frame(START + i, 16, bytes([100, n]))) for i, n in enumerate((3, 4, 4, 5))]
    assert given == [2, 2, 0, 2]
    assert d.health['F'].rejected['counter stands still'] == 1


def test_bad_files_are_named(tmp_path):
    bad = tmp_path / 'bad.dbc'
    bad.write_text('BO_ nonsense')
    with pytest.raises(CanError, match=r'bad\.dbc: not a DBC'):
        load_dbc(str(bad))
    with pytest.raises(CanError, match='no such DBC'):
        load_dbc(str(tmp_path / 'none.dbc'))
    with pytest.raises(CanError, match='no such log'):
        list(replay(str(tmp_path / 'none.log')))
    with pytest.raises(CanError, match=r"no signal 'WHEELS_1_2\.NOPE'"):
        CanDecoder(load_dbc(''), replace(IMIEV, wheels={'wheel_1': Signal('WHEELS_1_2', 'NOPE')}))


@pytest.mark.parametrize('suffix', ['.log', '.asc', '.blf'])
def test_a_log_replays_on_its_recorded_times(tmp_path, car, suffix):
    path = tmp_path / f'drive{suffix}'
    with can.Logger(str(path)) as writer:
        for i in range(20):
            for message in car.frames(5.0 + 0.1 * i, 0.2, 0.0):
                message.timestamp = START * 1e-9 + 0.02 * i
                message.channel = 0
                writer.on_message_received(message)
    d = decoder()
    readings = [r for frame in replay(str(path)) for r in d.on_frame(*frame)]
    speeds = [r for r in readings if isinstance(r, Speed)]
    assert len(speeds) == 20
    assert speeds[-1].speed == pytest.approx(6.9, abs=0.01)
    steps = np.diff([s.stamp for s in speeds])
    np.testing.assert_allclose(steps, PERIOD, atol=1e6)


def test_the_own_dbc_says_of_every_frame_whether_it_was_verified():
    for message in load_dbc('').messages:
        assert message.comment, message.name
        assert 'erified' in message.comment or 'UNVERIFIED' in message.comment
    assert sorted(PROFILES) == ['imiev', 'toyota86']


TOYOTA = DATA / 'toyota86_can'


@pytest.mark.skipif(not TOYOTA.exists(), reason=f'no recording at {TOYOTA} (ESTIMATOR_DATA)')
def test_a_recorded_log_of_another_car_decodes():
    d = CanDecoder(load_dbc(str(TOYOTA / 'sample_can_spec.dbc')), TOYOTA86)
    frames = list(replay(str(TOYOTA / 'can_sample.candump.log')))
    readings = [r for frame in frames for r in d.on_frame(*frame)]
    wheels = np.array([r.speeds for r in readings if isinstance(r, Wheels)])
    assert len(wheels) > 4000
    assert np.all(np.isfinite(wheels))
    assert wheels.max() < 60.0
    # While the clutch is pressed the gear reads 7 to 15, which the DBC does not allow.
    refused = {(name, why) for name, h in d.health.items() for why in h.rejected}
    assert refused == {('ID_141', 'GEAR out of range')}
    # The car's own speed lies within its wheels.
    speeds = np.array([r.speed for r in readings if isinstance(r, Speed)])
    assert abs(len(speeds) - len(wheels)) < 3
    count = min(len(speeds), len(wheels))
    assert np.median(np.abs(speeds[:count] - np.median(wheels[:count], axis=1))) < 0.1
