# SPDX-License-Identifier: Apache-2.0
import asyncio
import contextlib
import os
import pty
import shutil
import struct
import tempfile
import tty

import pytest
from modbus_fakes import KEY, UNIT, make, rtu
from pymodbus.client import AsyncModbusTcpClient

from ship_inclinometer import modbus_map as m
from ship_inclinometer.modbus_server import RtuServer, TcpServer

SILENCE = 0.15  # s, longer than any answer takes
PATIENCE = 30.0  # s, for an answer that has to come, on a machine that does other things
VALUES = {f.name: 1.0 for f in m.MEASURED} | {'utc_seconds': 1.0, 'utc_milliseconds': 0.0, 'age': 0.0}


@contextlib.asynccontextmanager
async def tcp_server(allowed=('127.0.0.0/8',), **options):
    device, ship, _ = make()
    await device.update(VALUES, {'valid': True})
    server = TcpServer(device, '127.0.0.1', 0, list(allowed), **options)
    await server.start()
    try:
        yield server, device, ship
    finally:
        await server.stop()


def frame(transaction, *pdu, unit=UNIT, protocol=0):
    return struct.pack('>HHHB', transaction, protocol, len(pdu) + 1, unit) + bytes(pdu)


async def exchange(port, data):
    """Send `data`, close the sending side, and return all that comes until the server hangs up."""
    reader, writer = await asyncio.open_connection('127.0.0.1', port)
    received = b''
    with contextlib.suppress(ConnectionError):
        writer.write(data)
        await writer.drain()
        writer.write_eof()
        while chunk := await asyncio.wait_for(reader.read(4096), 30):
            received += chunk
    writer.close()
    return received


READ = (4, 0, 0, 0, 1)
ANSWER = (4, 2, 0, m.MAP_VERSION)


def run_tcp(data):
    async def scene():
        async with tcp_server() as (server, _, _):
            return await exchange(server.port, data)

    return asyncio.run(scene())


def test_pipelined_requests_are_all_answered_in_order():
    data = b''.join(frame(n, *READ) for n in range(1, 6))
    assert run_tcp(data) == b''.join(frame(n, *ANSWER) for n in range(1, 6))


@pytest.mark.parametrize('unit', [0, 1, 8, 247])
def test_a_foreign_unit_and_a_broadcast_get_silence_over_tcp(unit):
    assert run_tcp(frame(1, *READ, unit=unit) + frame(2, *READ)) == frame(2, *ANSWER)


def test_bad_counts_and_unknown_functions_keep_their_function_code_over_tcp():
    data = frame(1, 3, 0, 0, 0, 0) + frame(2, 99, 1) + frame(3, 3, 0, 0, 0, 126)
    assert run_tcp(data) == frame(1, 0x83, 3) + frame(2, 0xE3, 1) + frame(3, 0x83, 3)


def test_another_protocol_gets_silence_and_the_next_request_an_answer():
    assert run_tcp(frame(1, *READ, protocol=5) + frame(2, *READ)) == frame(2, *ANSWER)


def test_a_request_in_single_bytes_is_answered():
    async def scene():
        async with tcp_server() as (server, _, _):
            reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
            for byte in frame(9, *READ):
                writer.write(bytes([byte]))
                await writer.drain()
            answer = await asyncio.wait_for(reader.readexactly(11), 5)
            writer.close()
            return answer

    assert asyncio.run(scene()) == frame(9, *ANSWER)


def test_who_is_not_allowed_is_hung_up_on():
    async def scene():
        async with tcp_server(allowed=('10.0.0.0/8',)) as (server, _, _):
            return await exchange(server.port, frame(1, *READ))

    assert asyncio.run(scene()) == b''


def test_a_lost_framing_ends_that_connection_only():
    async def scene():
        async with tcp_server() as (server, _, _):
            lost = await exchange(server.port, b'\x00\x01\x00\x00\xff\xff\x07\x03\x00\x00')
            return lost, await exchange(server.port, frame(1, *READ))

    assert asyncio.run(scene()) == (b'', frame(1, *ANSWER))


def test_masters_that_vanished_lock_nobody_out():
    async def scene():
        async with tcp_server(max_connections=3) as (server, _, _):
            silent = [await asyncio.open_connection('127.0.0.1', server.port) for _ in range(3)]
            # The first one speaks again: it is no longer the one that was silent longest.
            silent[0][1].write(frame(1, *READ))
            assert await asyncio.wait_for(silent[0][0].readexactly(11), 5) == frame(1, *ANSWER)
            newcomer = await exchange(server.port, frame(2, *READ))
            silent[0][1].write(frame(3, *READ))
            kept = await asyncio.wait_for(silent[0][0].readexactly(11), 5)
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.wait_for(silent[1][0].read(1), 5) == b''
            for _, writer in silent:
                writer.close()
            return newcomer, kept

    assert asyncio.run(scene()) == (frame(2, *ANSWER), frame(3, *ANSWER))


def test_every_function_code_over_tcp_is_answered_as_the_specification_says():
    # Requests of the right structure for the codes that are served, two bytes for the others.
    bodies = {1: (0, 0, 0, 1), 2: (0, 0, 0, 1), 3: (0, 0, 0, 1), 4: (0, 0, 0, 1)}
    bodies |= {5: (0, 0, 0xFF, 0), 6: (0, 10, 0, 110), 15: (0, 0, 0, 1, 1, 1), 16: (0, 10, 0, 1, 2, 0, 110)}
    bodies |= {22: (0, 10, 0, 0, 0, 110), 23: (0, 10, 0, 1, 0, 10, 0, 1, 2, 0, 110)}
    codes = range(256)
    stream = run_tcp(b''.join(frame(n, n, *bodies.get(n, (0, 0))) for n in codes))
    at = 0
    for n in codes:
        transaction, protocol, length, unit = struct.unpack_from('>HHHB', stream, at)
        pdu = stream[at + 7 : at + 6 + length]
        assert (transaction, protocol, unit) == (n, 0, UNIT)
        if n in (1, 2, 3, 4):
            assert pdu[0] == n
            assert pdu[1] == len(pdu) - 2
        else:
            # Unknown functions, and all that write while locked.
            assert pdu == bytes([n | 0x80, 1])
        at += 6 + length
    assert at == len(stream)


@pytest.mark.parametrize('transaction', [0, 1, 0x7FFF, 0x8000, 0xFFFF])
def test_the_transaction_is_repeated(transaction):
    assert run_tcp(frame(transaction, *READ)) == frame(transaction, *ANSWER)


def test_only_the_own_unit_and_255_are_answered_over_tcp():
    stream = run_tcp(b''.join(frame(unit, *READ, unit=unit) for unit in range(256)))
    assert stream == frame(UNIT, *ANSWER) + frame(255, *ANSWER, unit=255)


def test_the_largest_adu_is_served_and_a_longer_one_ends_the_connection():
    # 260 bytes: FC 16 with 123 registers is 253 bytes of PDU at most; here it writes where nothing is.
    largest = (16, 0, 100, 0, 123, 246, *([0] * 246))
    assert run_tcp(frame(1, *largest)) == frame(1, 0x90, 2)
    assert run_tcp(frame(1, *largest, 0, 0)) == b''


def test_a_frame_that_never_ends_is_forgotten_and_the_next_one_answered():
    async def scene():
        async with tcp_server() as (server, _, _):
            reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
            writer.write(frame(1, *READ)[:9])
            await asyncio.sleep(1.5)
            writer.write(frame(2, *READ))
            answer = await asyncio.wait_for(reader.readexactly(11), 5)
            writer.close()
            return answer

    assert asyncio.run(scene()) == frame(2, *ANSWER)


def test_a_peer_that_closes_its_sending_side_still_gets_its_answers():
    async def scene():
        async with tcp_server() as (server, _, _):
            reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
            writer.write(b''.join(frame(n, *READ) for n in range(20)))
            writer.write_eof()
            answers = await asyncio.wait_for(reader.read(), 5)
            writer.close()
            return answers

    assert asyncio.run(scene()) == b''.join(frame(n, *ANSWER) for n in range(20))


def test_pymodbus_client_reads_the_map_and_writes_after_the_key():
    async def scene():
        async with tcp_server() as (server, device, ship):
            async with AsyncModbusTcpClient('127.0.0.1', port=server.port) as client:
                block = await client.read_input_registers(0, count=m.INPUT_COUNT, device_id=UNIT)
                assert len(block.registers) == m.INPUT_COUNT
                inputs = await client.read_discrete_inputs(0, count=len(m.DISCRETE), device_id=UNIT)
                assert inputs.bits[0]
                locked = await client.write_register(m.FIRST_SETTING, 110, device_id=UNIT)
                assert locked.isError()
                await client.write_register(m.UNLOCK, KEY, device_id=UNIT)
                await client.write_register(m.FIRST_SETTING, 110, device_id=UNIT)
                await client.write_coil(0, True, device_id=UNIT)
            assert device.settings['heel_warning'] == 11.0
            assert ship.commands == ['acknowledge']
            assert all('127.0.0.1' in who for _, who, _ in ship.events)

    asyncio.run(scene())


def test_a_read_is_never_torn():
    async def scene():
        async with tcp_server() as (server, device, _):

            async def update():
                while True:
                    await device.update(VALUES, {})
                    await asyncio.sleep(0)

            task = asyncio.create_task(update())
            reader, writer = await asyncio.open_connection('127.0.0.1', server.port)
            first, last = m.INPUT_ADDRESS['sequence'], m.INPUT_ADDRESS['sequence_copy']
            seen = set()
            for _ in range(500):
                writer.write(frame(1, 4, 0, 0, 0, m.INPUT_COUNT))
                answer = await reader.readexactly(9 + 2 * m.INPUT_COUNT)
                words = struct.unpack(f'>{m.INPUT_COUNT}H', answer[9:])
                assert words[first] == words[last]
                seen.add(words[first])
            task.cancel()
            writer.close()
            return len(seen)

    assert asyncio.run(scene()) > 50


@contextlib.asynccontextmanager
async def rtu_line():
    device, ship, _ = make()
    await device.update(VALUES, {'valid': True})
    master, slave = pty.openpty()
    tty.setraw(master)
    os.set_blocking(master, False)
    server = RtuServer(device, os.ttyname(slave), 19200)
    await server.start()
    try:
        yield Line(master), device, ship, os.ttyname(slave)
    finally:
        await server.stop()
        os.close(master)
        os.close(slave)


class Line:
    def __init__(self, file):
        self.file = file

    async def ask(self, *bursts, gap=0.1, answered=True):
        """Write `bursts`; return what comes until the line is silent (`answered`: after it has spoken)."""
        for burst in bursts[:-1]:
            os.write(self.file, burst)
            await asyncio.sleep(gap)
        os.write(self.file, bursts[-1])
        received, loop = b'', asyncio.get_running_loop()
        deadline = loop.time() + (PATIENCE if answered else SILENCE)
        while loop.time() < deadline:
            with contextlib.suppress(BlockingIOError):
                received += os.read(self.file, 4096)
                deadline = loop.time() + SILENCE
            await asyncio.sleep(0.002)
        return received


def run_rtu(*bursts, **how):
    async def scene():
        async with rtu_line() as (line, _, _, _):
            return await line.ask(*bursts, **how)

    return asyncio.run(scene())


MINE, REPLY = rtu(UNIT, *READ), rtu(UNIT, *ANSWER)


@pytest.mark.parametrize(
    'bursts',
    [
        (MINE,),
        (b'\x55\xaa\x00' + MINE,),
        (b'\x55\xaa\x00', MINE),
        (MINE[:5], MINE),
        (MINE[:5] + MINE,),
        (rtu(2, 3, 4, 1, 2, 3, 4), MINE),
        (rtu(2, 3, 4, 1, 2, 3, 4) + MINE,),
        (rtu(9, *READ), MINE),
        (rtu(0, *READ), MINE),
        (MINE[:-1] + b'\x00', MINE),
        (bytes(range(256)), MINE),
    ],
)
def test_exactly_one_answer_on_the_bus_whatever_went_before(bursts):
    assert run_rtu(*bursts) == REPLY


def test_a_foreign_unit_and_a_broadcast_get_silence_over_rtu():
    assert run_rtu(rtu(UNIT + 1, *READ), answered=False) == b''
    assert run_rtu(rtu(0, *READ), answered=False) == b''


def test_a_frame_with_a_long_pause_inside_is_no_frame():
    assert run_rtu(MINE[:4], MINE[4:], gap=0.3, answered=False) == b''


def test_a_frame_in_pieces_of_an_usb_adapter_is_one():
    assert run_rtu(MINE[:4], MINE[4:], gap=0.005) == REPLY


def test_exceptions_over_rtu():
    assert run_rtu(rtu(UNIT, 3, 0, 0, 0, 0)) == rtu(UNIT, 0x83, 3)
    assert run_rtu(rtu(UNIT, 0x2B, 14, 1, 0)) == rtu(UNIT, 0xAB, 1)
    assert run_rtu(rtu(UNIT, 5, 0, 0, 0x12, 0x34)) == rtu(UNIT, 0x85, 3)


def test_a_broadcast_write_is_carried_out_only_when_unlocked():
    async def scene():
        async with rtu_line() as (line, device, _, _):
            write = rtu(0, 6, 0, m.FIRST_SETTING, 0, 110)
            assert await line.ask(write, answered=False) == b''
            assert device.settings['heel_warning'] == 10.0
            await line.ask(rtu(UNIT, 6, 0, m.UNLOCK, KEY >> 8, KEY & 0xFF))
            assert await line.ask(write, answered=False) == b''
            assert device.settings['heel_warning'] == 11.0

    asyncio.run(scene())


async def command(*arguments, env=None):
    process = await asyncio.create_subprocess_exec(
        *arguments, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT, env=env
    )
    out, _ = await asyncio.wait_for(process.communicate(), 30)
    return process.returncode, out.decode()


@contextlib.asynccontextmanager
async def far_end(line):
    """Give the master end of a pty a name that another program can open, by a second pty."""
    outer, inner = pty.openpty()
    tty.setraw(outer)
    os.set_blocking(outer, False)
    loop = asyncio.get_running_loop()

    def pump(source, sink):
        with contextlib.suppress(OSError):
            os.write(sink, os.read(source, 4096))

    loop.add_reader(outer, pump, outer, line.file)
    loop.add_reader(line.file, pump, line.file, outer)
    try:
        yield os.ttyname(inner)
    finally:
        loop.remove_reader(outer)
        loop.remove_reader(line.file)
        os.close(outer)
        os.close(inner)


@pytest.mark.skipif(
    shutil.which('mbpoll') is None and 'WS_REQUIRE_PROGRAMS' not in os.environ,
    reason='mbpoll is not installed (apt-get install mbpoll)',
)
@pytest.mark.parametrize('transport', ['tcp', 'rtu'])
def test_mbpoll_reads_the_whole_map(transport):
    assert shutil.which('mbpoll') is not None, 'mbpoll is not installed'

    async def scene():
        if transport == 'tcp':
            async with tcp_server() as (server, _, _):
                return await poll('-m', 'tcp', '-p', str(server.port), target='127.0.0.1')
        async with rtu_line() as (line, _, _, _), far_end(line) as path:
            return await poll('-m', 'rtu', '-b', '19200', '-P', 'even', target=path)

    async def poll(*mode, target):
        out = []
        for kind, count in (('3', m.INPUT_COUNT), ('1', len(m.DISCRETE)), ('0', len(m.COILS)), ('4', 4)):
            arguments = ('-a', str(UNIT), '-0', '-r', '0', '-c', str(count), '-t', kind, '-1', '-q', target)
            out.append(await command('mbpoll', *mode, *arguments))
        return out

    for (code, text), count in zip(asyncio.run(scene()), (m.INPUT_COUNT, len(m.DISCRETE), len(m.COILS), 4)):
        assert code == 0, text
        assert text.count(']:') == count


NODE_SCRIPT = """
const M = require('modbus-serial'); const c = new M();
(async () => {
  if (process.argv[1] === 'tcp') await c.connectTCP('127.0.0.1', {port: +process.argv[2]});
  else await c.connectRTUBuffered(process.argv[2], {baudRate: 19200, parity: 'even'});
  c.setID(+process.argv[3]); c.setTimeout(3000);
  const r = await c.readInputRegisters(0, +process.argv[4]);
  const d = await c.readDiscreteInputs(0, 16); const h = await c.readHoldingRegisters(0, 4);
  console.log(JSON.stringify([r.data.length, d.data.length, h.data.length])); c.close(() => process.exit(0));
})().catch(e => { console.log(e.message); process.exit(1); });
"""


def node_has_modbus():
    import subprocess

    if shutil.which('node') is None:
        return False
    return subprocess.run(['node', '-e', "require('modbus-serial')"], capture_output=True).returncode == 0


@pytest.mark.parametrize('transport', ['tcp', 'rtu'])
def test_modbus_serial_of_npm_reads_the_whole_map(transport):
    if not node_has_modbus():
        pytest.skip('npm package modbus-serial is not installed (npm install modbus-serial, NODE_PATH)')

    async def scene():
        tail = (str(UNIT), str(m.INPUT_COUNT))
        if transport == 'tcp':
            async with tcp_server() as (server, _, _):
                return await command('node', '-e', NODE_SCRIPT, 'tcp', str(server.port), *tail)
        async with rtu_line() as (line, _, _, _), far_end(line) as path:
            return await command('node', '-e', NODE_SCRIPT, 'rtu', path, *tail)

    code, text = asyncio.run(scene())
    assert code == 0, text
    assert text.strip() == f'[{m.INPUT_COUNT},16,4]'


def test_a_serial_line_that_goes_and_comes_back_is_served_again():
    async def scene():
        device, _, _ = make()
        await device.update(VALUES, {'valid': True})
        with contextlib.ExitStack() as files:

            def line():
                master, slave = pty.openpty()
                files.callback(os.close, slave)
                tty.setraw(master)
                os.set_blocking(master, False)
                return master, os.ttyname(slave)

            first, name = line()
            link = files.enter_context(tempfile.TemporaryDirectory()) + '/tty'
            os.symlink(name, link)
            server = RtuServer(device, link, 19200)
            await server.start()
            try:
                assert await Line(first).ask(MINE) == REPLY
                # The adapter is pulled out, and put in again under the same name.
                os.unlink(link)
                os.close(first)
                second, name = line()
                files.callback(os.close, second)
                os.symlink(name, link)
                answer = b''
                while not answer:
                    answer = await Line(second).ask(MINE, answered=False)
                assert answer.endswith(REPLY)
            finally:
                await server.stop()

    asyncio.run(asyncio.wait_for(scene(), PATIENCE))


def test_a_baud_rate_that_no_line_has_is_refused():
    with pytest.raises(ValueError, match="parameter 'baudrate' is 12345"):
        RtuServer(make()[0], '/dev/null', 12345)
