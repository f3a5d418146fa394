# SPDX-License-Identifier: Apache-2.0
"""Modbus where something goes wrong: masters that vanish, lines that close, settings that cannot be saved."""

import asyncio
import contextlib
import errno
import os
import socket
import struct
import termios

import pytest
from modbus_fakes import KEY, UNIT, make, rtu
from serial_cable import Cable
from test_modbus_device import HEEL_WARNING, ask, unlock, words
from test_modbus_server import ANSWER, MINE, PATIENCE, READ, REPLY, VALUES, Line, frame, tcp_server

from ship_inclinometer import modbus_map as m
from ship_inclinometer.modbus_server import RtuServer, TcpServer


async def answered(port):
    """Return whether a new master gets its answer."""
    reader, writer = await asyncio.open_connection('127.0.0.1', port)
    writer.write(frame(1, *READ))
    reply = await asyncio.wait_for(reader.readexactly(7 + len(ANSWER)), PATIENCE)
    writer.close()
    return reply == frame(1, *ANSWER)


def vanish(connection):
    """Close without a goodbye: the peer gets a reset."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
    connection.close()


def test_masters_that_vanish_at_any_moment_leave_the_others_served():
    async def scene():
        async with tcp_server(max_connections=4) as (server, _, _):
            for data in (b'', frame(1, *READ)[:5], frame(1, *READ), frame(1, *READ) * 50, b'\xff' * 300) * 4:
                connection = socket.create_connection(('127.0.0.1', server.port))
                connection.sendall(data)
                vanish(connection)
            assert await answered(server.port)
            while server._connections:
                await asyncio.sleep(0.01)

    asyncio.run(asyncio.wait_for(scene(), PATIENCE))


@pytest.mark.parametrize('number', [errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ECONNRESET])
def test_a_master_that_lost_its_power_ends_its_connection_and_nothing_else(number):
    """The system tells by an error of the read, once its probes stay unanswered."""

    async def scene():
        device, _, _ = make()
        await device.update(VALUES, {'valid': True})
        server, readers = TcpServer(device, '127.0.0.1', 0, ['127.0.0.0/8']), []
        serve = server._serve

        async def watched(reader, writer):
            readers.append(reader)
            await serve(reader, writer)

        server._serve = watched
        await server.start()
        reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
        writer.write(frame(1, *READ))
        await reader.readexactly(7 + len(ANSWER))
        readers[0].set_exception(OSError(number, os.strerror(number)))
        assert await reader.read() == b''
        assert await answered(server.port)
        writer.close()
        await server.stop()

    asyncio.run(asyncio.wait_for(scene(), PATIENCE))


def test_half_a_request_is_forgotten_after_a_second():
    async def scene():
        async with tcp_server() as (server, _, _):
            reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
            writer.write(frame(1, *READ)[:6])
            await asyncio.sleep(1.5)
            writer.write(frame(2, *READ))
            reply = await reader.readexactly(7 + len(ANSWER))
            writer.close()
            return reply

    assert asyncio.run(asyncio.wait_for(scene(), PATIENCE)) == frame(2, *ANSWER)


def test_a_server_that_was_never_started_can_be_stopped():
    device = make()[0]
    asyncio.run(TcpServer(device, '127.0.0.1', 0, ['127.0.0.1']).stop())
    asyncio.run(RtuServer(device, '/dev/ttyS99').stop())


def test_a_peer_whose_address_is_none_is_refused(tmp_path):
    """A tunnel over a Unix socket has no address that could be allowed."""

    async def scene():
        refused = []
        server = TcpServer(make()[0], '', 0, ['0.0.0.0/0', '::/0'], refused.append)
        listener = await asyncio.start_unix_server(server._serve, tmp_path / 'socket')
        reader, writer = await asyncio.open_unix_connection(tmp_path / 'socket')
        writer.write(frame(1, *READ))
        with contextlib.suppress(ConnectionError):
            assert await reader.read() == b''
        writer.close()
        listener.close()
        return len(refused)

    assert asyncio.run(asyncio.wait_for(scene(), PATIENCE)) == 1


@contextlib.asynccontextmanager
async def served(cable, **options):
    device, _, _ = make()
    await device.update(VALUES, {'valid': True})
    server = RtuServer(device, cable.link, 19200, **options)
    await server.start()
    try:
        yield server, device
    finally:
        await server.stop()


@pytest.fixture
def cable(tmp_path):
    cable = Cable(tmp_path)
    yield cable
    for file in (cable.master, cable.slave):
        with contextlib.suppress(OSError):
            os.close(file)


def open_files():
    return len(os.listdir('/proc/self/fd'))


def test_what_is_no_serial_line_is_refused_and_left_closed(tmp_path):
    (tmp_path / 'file').write_text('')

    async def scene(path):
        server = RtuServer(make()[0], str(path))
        try:
            await server.start()
        finally:
            await server.stop()

    for path, error in (
        (tmp_path / 'file', termios.error),
        ('/dev/null', termios.error),
        ('/nowhere', OSError),
    ):
        before = open_files()
        with pytest.raises(error):
            asyncio.run(scene(path))
        assert open_files() <= before


def test_a_line_that_stays_away_is_tried_again_and_again(cable):
    async def scene():
        async with served(cable):
            assert await Line(cable.master).ask(MINE) == REPLY
            before = open_files()
            cable.unplug()
            await asyncio.sleep(2.5)
            # Something else has taken the name meanwhile: it is no line.
            open(cable.link, 'w').close()
            await asyncio.sleep(1.5)
            cable.plug()
            answer = b''
            while not answer:
                answer = await Line(cable.master).ask(MINE, answered=False)
            assert answer.endswith(REPLY)
            assert open_files() <= before

    asyncio.run(asyncio.wait_for(scene(), PATIENCE))


def test_a_server_is_stopped_while_its_line_is_away(cable):
    async def scene():
        async with served(cable):
            cable.unplug()
            await asyncio.sleep(0.2)
        before = open_files()
        cable.plug()
        await asyncio.sleep(1.5)
        # The two ends of the new cable, and no third opening by the server.
        assert open_files() <= before + 2

    asyncio.run(asyncio.wait_for(scene(), PATIENCE))


def test_a_line_that_closes_before_the_answer_is_out_is_opened_again(cable):
    async def scene():
        async with served(cable) as (_, device):
            asked, go_on, respond = asyncio.Event(), asyncio.Event(), device.respond

            async def slowly(pdu, who):
                asked.set()
                await go_on.wait()
                return await respond(pdu, who)

            device.respond = slowly
            os.write(cable.master, MINE)
            await asked.wait()
            cable.unplug()
            go_on.set()
            await asyncio.sleep(0.1)
            cable.plug()
            answer = b''
            while not answer:
                answer = await Line(cable.master).ask(MINE, answered=False)
            assert answer.endswith(REPLY)

    asyncio.run(asyncio.wait_for(scene(), PATIENCE))


def test_a_master_that_reads_late_gets_every_answer(cable):
    block = (4, 0, 0, 0, m.INPUT_COUNT)
    count, size = 150, 5 + 2 * m.INPUT_COUNT

    async def scene():
        async with served(cable):
            os.write(cable.master, rtu(UNIT, *block) * count)
            await asyncio.sleep(1.0)
            received = b''
            while len(received) < count * size:
                with contextlib.suppress(BlockingIOError):
                    received += os.read(cable.master, 4096)
                await asyncio.sleep(0.001)
            return received

    received = asyncio.run(asyncio.wait_for(scene(), PATIENCE))
    assert received == received[:size] * count
    assert received[:3] == bytes([UNIT, 4, 2 * m.INPUT_COUNT])


def test_the_echo_of_its_own_answer_is_not_taken_for_a_request(cable):
    """A write is answered by itself: its echo would be a request again, and so on for ever."""
    write = rtu(UNIT, 6, 0, m.UNLOCK, KEY >> 8, KEY & 0xFF)

    async def scene():
        async with served(cable, echo=True) as (_, device):
            line = Line(cable.master)
            assert await line.ask(write) == write
            first = device.unlocked
            # The adapter echoes what the server has sent.
            assert await line.ask(write, answered=False) == b''
            assert await line.ask(MINE) == REPLY
            # The next request may follow the echo at once.
            assert await line.ask(REPLY + MINE) == REPLY
            return first

    assert asyncio.run(asyncio.wait_for(scene(), PATIENCE))


def test_settings_that_cannot_be_saved_are_answered_with_04_and_not_taken():
    device, ship, _ = make()
    unlock(device)

    def full(_settings, _crc):
        raise OSError(errno.ENOSPC, 'No space left on device')

    ship.save = full
    assert ask(device, 6, *words(m.SAVE, m.SAVE_COMMAND)) == bytes([0x86, 4])
    assert device.saved_crc == 0
    # Nor are settings that came along with the save.
    both = (16, *words(m.SAVE, 1), 2, *words(m.SAVE_COMMAND))
    assert ask(device, *both) == bytes([0x90, 4])
    assert ship.settings is None


def test_the_key_zero_locks_at_once():
    device, ship, _ = make()
    unlock(device)
    assert ask(device, 6, *words(m.UNLOCK, 0)) == bytes([6]) + words(m.UNLOCK, 0)
    assert ask(device, 6, *words(HEEL_WARNING, 110)) == bytes([0x86, 1])
    assert [kind for kind, _, _ in ship.events] == ['unlock', 'lock', 'refused']


def test_a_flag_cannot_be_set_and_cleared_at_once_and_no_coil_is_no_command():
    device, ship, _ = make()
    unlock(device)
    first = m.COILS.index('stop_set')
    assert ask(device, 15, 0, first, 0, 2, 1, 0b11) == bytes([0x8F, 3])
    assert ask(device, 15, 0, first, 0, 2, 1, 0b00) == bytes([15, 0, first, 0, 2])
    assert ask(device, 5, 0, first, 0, 0) == bytes([5, 0, first, 0, 0])
    assert ship.commands == []
    assert [kind for kind, _, _ in ship.events] == ['unlock']


@pytest.mark.parametrize('function', [5, 6, 15, 16, 22, 23])
def test_a_write_that_was_cut_off_is_answered_with_03(function):
    device, ship, _ = make()
    unlock(device)
    for length in range(4):
        assert ask(device, function, *bytes(length)) == bytes([function | 0x80, 3])
    assert ship.commands == []
    assert ship.settings is None


@pytest.mark.parametrize(
    ('parity', 'stop_bits', 'odd', 'checked'),
    [('E', 1, False, True), ('O', 1, True, True), ('N', 2, False, False)],
)
def test_a_character_has_eleven_bits_whatever_the_parity(cable, parity, stop_bits, odd, checked):
    async def scene():
        async with served(cable, parity=parity):
            return termios.tcgetattr(cable.slave)

    # A pseudo-terminal forgets PARENB, but not what goes with it.
    inputs, _, control, _, *speeds, _ = asyncio.run(scene())
    assert 1 + bool(control & termios.CSTOPB) == stop_bits
    assert bool(control & termios.PARODD) is odd
    assert bool(inputs & termios.INPCK) is checked
    assert control & termios.CSIZE == termios.CS8
    assert speeds == [termios.B19200] * 2
