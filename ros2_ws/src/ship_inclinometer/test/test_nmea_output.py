# SPDX-License-Identifier: Apache-2.0
import contextlib
import os
import socket
import threading

import pytest
from modbus_fakes import Clock
from serial_cable import Cable

from ship_inclinometer import nmea_output
from ship_inclinometer.nmea import checksum, sentence
from ship_inclinometer.nmea_output import SerialOutput, UdpOutput

STEP = 0.1  # s, between two rounds


def hrm(heel):
    return sentence(
        'II', 'HRM', f'{heel:.1f}', '11.6', '9.8', '13.1', 'A', '14.0', '15.2', '230000', '31', '12'
    )


def full_round(heel):
    others = [sentence('II', 'XDR', 'A', f'{heel:.2f}', 'D', 'ROLL', 'A', '1.00', 'D', 'PITCH')]
    others += [sentence('II', 'ROT', '3.0', 'A'), sentence('II', 'THS', '100.0', 'A')]
    return [hrm(heel), *others, sentence('II', 'HDT', '100.0', 'T')]


@pytest.fixture
def cable(tmp_path):
    cable = Cable(tmp_path)
    yield cable
    for file in (cable.master, cable.slave):
        with contextlib.suppress(OSError):
            os.close(file)


def opened(cable, baudrate=38400):
    clock = Clock()
    line = SerialOutput(cable.link, baudrate, clock)
    line.connect()
    return line, clock


def whole(data):
    """Return the sentences of `data`, all of which must be whole."""
    assert data.endswith(b'\r\n') or not data
    lines = data.decode('ascii').split('\r\n')[:-1]
    for text in lines:
        assert text.startswith('$')
        assert text.count('$') == 1
        assert checksum(text[1:-3]) == text[-2:]
    return lines


def test_a_line_that_is_fast_enough_gets_every_sentence(cable):
    line, clock = opened(cable)
    rounds = [full_round(n * 0.1) for n in range(20)]
    for sentences in rounds:
        line.send(sentences)
        assert whole(cable.read()) == [text.strip() for text in sentences]
        clock.now += STEP
    assert (line.sent, line.dropped, line.fault) == (100, 0, '')


@pytest.mark.parametrize('baudrate', [1200, 4800, 9600])
def test_a_slow_line_carries_what_it_can_and_the_newest_of_each_kind(cable, baudrate):
    line, clock = opened(cable, baudrate)
    data, worst, seconds = b'', 0.0, 20.0
    for n in range(round(seconds / STEP)):
        heel = n * STEP
        line.send(full_round(heel))
        # What is in the system's buffer has yet to pass the line.
        unsent = max(line._free_at - clock.now, 0.0)
        data += (new := cable.read())
        told = [float(text.split(',')[1]) for text in whole(new) if 'HRM' in text]
        worst = max([worst, *(unsent + heel - age for age in told)])
        clock.now += STEP
    lines = whole(data)
    kinds = {kind: sum(kind in text for text in lines) for kind in ('HRM', 'XDR', 'ROT', 'THS', 'HDT')}
    # Each kind gets its turn, heel the first.
    assert kinds['HRM'] == max(kinds.values())
    assert min(kinds.values()) > 0.4 * kinds['HRM']
    # The line is busy all the time, never with more than one round and one sentence in stock.
    carried = len(data) / (baudrate / 10 * seconds)
    assert 0.97 < carried < 1.05
    assert worst <= 0.1 + 82 * 10 / baudrate + STEP
    assert line.dropped > 0


def test_a_heading_that_has_become_invalid_is_not_told_late(cable):
    line, clock = opened(cable, 1200)
    line.send(full_round(0.0))
    data = b''
    for _ in range(50):
        clock.now += STEP
        line.send([hrm(1.0), sentence('II', 'THS', '', 'V')])
        data += cable.read()
    lines = whole(data)
    assert sum('THS,,V' in text for text in lines) > 3
    assert not any('HDT' in text or 'THS,100' in text for text in lines)


def test_alerts_wait_for_a_slow_line_and_none_is_lost(cable):
    line, clock = opened(cable, 4800)
    told = [sentence('II', 'ALF', '1', '1', str(n), '', 'B', 'A', 'V') for n in range(20)]
    data = b''
    for n in range(100):
        line.send([hrm(0.0)] + ([told[n]] if n < len(told) else []))
        data += cable.read()
        clock.now += STEP
    assert [text for text in whole(data) if 'ALF' in text] == [text.strip() for text in told]


def test_what_waits_is_bounded(cable):
    line, _ = opened(cable, 1200)
    for n in range(500):
        line.send([sentence('II', 'ALF', str(n))])
    assert len(line._waiting) == nmea_output._LARGEST_QUEUE
    assert line.dropped > 400


def test_nobody_reads_and_later_somebody_does(cable):
    line, clock = opened(cable, 115200)
    for n in range(3000):
        line.send(full_round(float(n)))
        clock.now += STEP
    assert line.fault == ''
    data = cable.read()
    for n in range(20):
        line.send(full_round(5000.0 + n))
        data += cable.read()
        clock.now += STEP
    # What was cut where the buffer was full is ended before anything else is said.
    assert whole(data)[-5] == hrm(5019.0).strip()


def test_a_line_that_vanishes_is_opened_again(cable):
    line, clock = opened(cable)
    line.send(full_round(1.0))
    assert len(whole(cable.read())) == 5
    cable.unplug()
    for _ in range(30):
        clock.now += STEP
        line.send(full_round(2.0))
    assert cable.link in line.fault
    cable.plug()
    for _ in range(20):
        clock.now += STEP
        line.send(full_round(3.0))
    lines = whole(cable.read())
    # Nothing of the time before.
    assert {text.split(',')[1] for text in lines if 'HRM' in text} == {'3.0'}
    assert (line.fault, line.reopened) == ('', 1)
    line.close()
    assert line._file is None


def test_what_is_no_serial_line_is_refused(tmp_path, cable):
    with pytest.raises(OSError, match='nowhere'):
        SerialOutput(str(tmp_path / 'nowhere'), 4800).connect()
    with pytest.raises(KeyError, match='12345'):
        SerialOutput(cable.link, 12345).connect()
    before = len(os.listdir('/proc/self/fd'))
    (tmp_path / 'file').write_text('')
    with pytest.raises(Exception, match='Inappropriate ioctl'):
        SerialOutput(str(tmp_path / 'file'), 4800).connect()
    assert len(os.listdir('/proc/self/fd')) <= before


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(('127.0.0.1', 0))
        receiver.settimeout(10.0)
        yield receiver


def test_a_round_is_one_datagram(receiver):
    output = UdpOutput('127.0.0.1', receiver.getsockname()[1])
    output.send(full_round(1.0))
    assert receiver.recv(2048).decode() == ''.join(full_round(1.0))
    assert (output.sent, output.failed, output.fault) == (1, 0, '')
    output.close()


def test_a_datagram_that_cannot_be_sent_is_told_and_the_next_one_tried():
    # A datagram cannot be that long.
    output = UdpOutput('127.0.0.1', 9)
    output.send([hrm(0.0)] * 2000)
    assert output.failed == 1
    assert '127.0.0.1: ' in output.fault
    output.send([hrm(0.0)])
    assert (output.sent, output.fault) == (1, '')
    output.close()


def test_a_name_is_looked_up_beside_and_again_when_it_was_not_found(receiver, monkeypatch):
    asked, go_on, clock = threading.Semaphore(0), threading.Semaphore(0), Clock()
    answers = [OSError('Temporary failure in name resolution'), [(2, 2, 17, '', ('127.0.0.1', 1))]]

    def slow(*_arguments):
        asked.release()
        assert go_on.acquire(timeout=10.0)
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(nmea_output.socket, 'getaddrinfo', slow)
    others = set(threading.enumerate())
    output = UdpOutput('display.ship', receiver.getsockname()[1], clock)
    for fault, seconds in (('Temporary failure', 2.0), ('', 0.0)):
        output.send(full_round(0.0))
        assert asked.acquire(timeout=10.0)
        # Not held up, and not asked a second time meanwhile.
        output.send(full_round(0.0))
        go_on.release()
        for thread in set(threading.enumerate()) - others:
            thread.join(10.0)
        assert fault in output.fault
        clock.now += seconds
    output.send(full_round(7.0))
    assert receiver.recv(2048).decode() == ''.join(full_round(7.0))
    assert output.fault == ''
    output.close()
