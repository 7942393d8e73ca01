"""Serial drivers against devices on pseudo-terminals: good lines, garbled ones, unplugged ones."""

import errno
import os
import random
import struct
import termios
import threading
import tty
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numbered_images import until

from touchgoal.control.cell.config import GripperSection
from touchgoal.control.grippers.robotiq import Robotiq
from touchgoal.control.interfaces import DriverError
from touchgoal.control.sensors.load_cell import (
    Checksum,
    LoadCellConfig,
    Sample,
    SerialLoadCell,
    parse,
    with_checksum,
)
from touchgoal.control.sensors.serial_port import modbus_crc
from touchgoal.runtime.errors import UserError


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """Yield the device's end of a serial line and the path of the computer's end."""
    device, computer = os.openpty()
    tty.setraw(device)
    tty.setraw(computer)
    yield device, os.ttyname(computer)
    for end in (device, computer):
        try:
            os.close(end)
        except OSError:
            pass  # a test unplugged it


def counted(k: int) -> bytes:
    """Line k: time k, value 1000 + k."""
    return with_checksum(b"%d,%d" % (k, 1000 + k), "crc16") + b"\n"


def damage(message: bytes, rng: random.Random) -> bytes:
    """A line as a poor cable brings it: up to five bytes lost, its end lost, or bits flipped."""
    damaged, kind = bytearray(message), rng.randrange(4)
    where = [rng.randrange(len(message)) for _ in range(4)]
    if kind == 0:
        del damaged[where[0] : where[0] + rng.randint(1, 5)]
    elif kind == 1:
        del damaged[-1]
    else:
        for i in where[: 1 if kind == 2 else 4]:
            damaged[i] ^= 1 << rng.randrange(8)
    return bytes(damaged)


@pytest.mark.parametrize(("checksum", "believed"), [("none", 6436), ("xor", 145), ("crc16", 0)])
def test_how_many_garbled_lines_are_believed(checksum: Checksum, believed: int) -> None:
    """Counts among over 30,000 lines; the driver's docstring has the shares."""
    cell = LoadCellConfig("", 2e-4, 84_213, max_force=100.0, checksum=checksum)
    rng, lines, sent, stream = random.Random(0), set(), set(), []
    for k in range(50_000):
        value = rng.randrange(84_213, 104_213)
        line = with_checksum(b"%d,%d" % (12 * k, value), checksum)
        lines.add(line)
        sent.add(Sample(2e-4 * (value - 84_213), 12 * k))
        stream.append(damage(line + b"\n", rng))
    garbled = [line for line in b"".join(stream).split(b"\n") if line not in lines]
    samples = [sample for line in garbled if (sample := parse(line, cell))]
    assert len(garbled) > 30_000 and parse(max(lines), cell) in sent
    assert sum(sample not in sent for sample in samples) == believed


def test_the_checksums_are_the_usual_ones() -> None:
    """CRC-16/MODBUS' check value; a sentence of NMEA's standard; examples of the gripper's manual."""
    assert with_checksum(b"123456789", "crc16") == b"123456789*4B37"
    assert with_checksum(b"GPGLL,5300.97914,N,00259.98174,E,125926,A", "xor").endswith(b"*28")
    assert modbus_crc(bytes.fromhex("091003E8000306000000000000")) == bytes.fromhex("7330")
    assert modbus_crc(bytes.fromhex("090407D00003")) == bytes.fromhex("B1CE")


def test_what_a_poor_cable_brings_is_counted(line: tuple[int, str]) -> None:
    """Every reading is of a sent line, and all else is counted, however the reads cut it up."""
    device, port = line
    config = LoadCellConfig(port, newtons_per_count=1.0, zero=0.0, max_force=1e5)
    cell = SerialLoadCell(config)
    rng, seen = random.Random(0), set()
    lines = [damage(counted(k), rng) if k % 4 == 2 else counted(k) for k in range(200)]
    stream = b"".join([*lines, b"\n"])
    os.write(device, counted(0))  # not believed: it may be the end of a longer one
    for cut in range(0, len(stream), 7):
        os.write(device, stream[cut : cut + 7])
        if cut > 200:
            seen.add(cell.read().force)
    os.write(device, counted(200))
    until(lambda: cell.read().force == 1200.0)
    assert seen <= {1000.0 + k for k in range(200)}
    wrong = [text for text in stream.split(b"\n")[:-1] if parse(text.strip(), config) is None]
    assert cell.read().rejected == len(wrong) > 20
    cell.close()


@pytest.mark.parametrize("bad", [b"5,9e9", b"5,nan", b"5", b"5,x", b"2,1"])
def test_wrong_ranges_fields_and_times_are_refused(line: tuple[int, str], bad: bytes) -> None:
    device, port = line
    cell = SerialLoadCell(LoadCellConfig(port, 1.0, 0.0, max_force=10.0, checksum="none"))
    os.write(device, b"half a li\n3,4\n" + bad + b"\n")
    until(lambda: cell.read().rejected == 0 and cell.read().force == 4.0)
    os.write(device, b"6,7\n")
    until(lambda: cell.read().force == 7.0)
    assert cell.read().rejected == 1
    cell.close()


def test_an_unplugged_load_cell_is_said(line: tuple[int, str]) -> None:
    device, port = line
    cell = SerialLoadCell(LoadCellConfig(port, 1.0, 0.0, 1e4))
    os.write(device, counted(1) + counted(2))
    until(lambda: cell.read().force == 1002.0)
    os.close(device)
    with pytest.raises(DriverError, match="load cell"):
        until(lambda: cell.read().force < 0)
    cell.close()


class Gripper2F85(threading.Thread):
    """The gripper's side of the wire: registers and a finger that takes 10 counts an exchange.

    `block` is the count at which something lies between the fingers.
    """

    def __init__(self, device: int, active: bool, block: int = 255) -> None:
        super().__init__(daemon=True)
        self.device, self.block = device, block
        self.output, self.position, self.fault = bytes(6), 3, 0
        self.active_after = 0 if active else 3  # exchanges
        self.garble = 0  # answers to spoil
        self.start()

    def run(self) -> None:
        request = b""
        try:
            while True:
                request += os.read(self.device, 64)
                if len(request) >= 8 and modbus_crc(request[:-2]) == request[-2:]:
                    self._serve(request[:-2])
                    request = b""
        except OSError:
            pass  # unplugged

    def _serve(self, request: bytes) -> None:
        code, register, count = struct.unpack(">xBHH", request[:6])
        if code == 16:
            assert register == 0x03E8
            answer, self.output = request[:6], request[7:]
        else:
            assert (code, register) == (4, 0x07D0)
            answer = request[:2] + bytes([2 * count]) + self._input()
        answer += modbus_crc(answer)
        if self.garble:
            self.garble -= 1
            answer = answer[:-1] + bytes([answer[-1] ^ 1])
        os.write(self.device, answer)

    def _input(self) -> bytes:
        activate, go = self.output[0] & 1 or self.active_after == 0, self.output[0] >> 3 & 1
        if activate and self.active_after:
            self.active_after -= 1
        status = (3 if not self.active_after else 1) << 4 | go << 3 | 1
        wanted, contact = self.output[3], 0
        if go and not self.active_after:
            self.position += int(np.clip(wanted - self.position, -10, 10))
            contact = 3 if self.position == wanted else 0
            if self.position >= self.block:
                self.position, contact = self.block, 2
        return bytes([status | contact << 6, 0, self.fault, wanted, self.position, 0])


def test_the_robotiq_opens_closes_and_holds(line: tuple[int, str]) -> None:
    device, port = line
    wire = Gripper2F85(device, active=False, block=150)
    section = GripperSection("robotiq", port=port)
    with pytest.raises(UserError, match="activate"):
        Robotiq(section)
    gripper = Robotiq(replace(section, activate=True))
    assert gripper.read().width == pytest.approx(0.085)
    gripper.command(0.06)
    until(lambda: abs(gripper.read().width - 0.06) < 4e-4)
    assert not gripper.read().grasped
    gripper.command(-1.0)  # clipped
    until(lambda: gripper.read().grasped)
    held = gripper.read()
    assert held.width == pytest.approx(0.085 * (230 - 150) / 227) and wire.output[3] == 230
    gripper.stop()
    until(lambda: wire.output[0] == 1)
    gripper.close()


def test_the_robotiq_bears_a_garbled_answer_and_says_faults(line: tuple[int, str]) -> None:
    device, port = line
    wire = Gripper2F85(device, active=True)
    gripper = Robotiq(GripperSection("robotiq", port=port, force=20.0))
    gripper.read()
    wire.garble = 4
    gripper.command(0.0)
    until(lambda: gripper.read().width < 1e-3)
    assert wire.garble == 0 and wire.output[4:] == bytes([59, 0])  # 50 mm/s, 20 N
    wire.fault, before = 0x09, gripper.read()  # it heard nothing for a second
    until(lambda: gripper.read().stamp > before.stamp + 0.05)
    assert gripper.read().fault == ""
    wire.fault = 0x0E
    until(lambda: "overcurrent" in gripper.read().fault)
    with pytest.raises(DriverError, match="overcurrent"):
        gripper.command(0.05)
    os.close(device)
    with pytest.raises(DriverError, match="gripper"):
        until(lambda: gripper.read().width > 1)
    gripper.close()


def test_the_robotiqs_port_raises_driver_errors_alone_and_holds_up_no_command(
    line: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    device, port = line
    Gripper2F85(device, active=True)
    gripper = Robotiq(GripperSection("robotiq", port=port))
    gripper.read()
    with gripper._port_lock:  # as during an exchange
        gripper.command(0.03)

    def pulled() -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(gripper._port, "reset_input_buffer", pulled)
    with pytest.raises(DriverError, match="its port failed .*check its USB cable"):
        gripper.stop()
    with pytest.raises(DriverError, match="gripper"):
        until(lambda: gripper.read().width > 1)
    gripper.close()


def test_five_answers_missed_in_a_row_lose_the_robotiq(line: tuple[int, str]) -> None:
    wire = Gripper2F85(line[0], active=True)
    gripper = Robotiq(GripperSection("robotiq", port=line[1]))
    gripper.read()
    wire.garble = 5
    with pytest.raises(DriverError, match="garbled"):
        until(lambda: gripper.read().width > 1)
    gripper.close()


def test_a_load_cell_whose_controller_restarts_is_heard_again_and_one_old_line_is_not() -> None:
    cell = SerialLoadCell.__new__(SerialLoadCell)
    cell.clock, cell._last, cell._behind = -np.inf, -np.inf, 0
    times = map(float, [*range(100, 120), 50, 120, 121, 121])
    taken = [cell._clock_advances(Sample(0.0, time)) for time in times]
    assert taken == [True] * 20 + [False, True, True, False]
    again = [cell._clock_advances(Sample(0.0, float(t))) for t in range(30)]
    assert again == [False] * 10 + [True] * 20
