"""Serial devices on pseudo-terminals: a load cell under the table, and a Robotiq gripper."""

import os
import struct
import tty
from pathlib import Path

import numpy as np

from touchgoal.control.grippers import robotiq as registers
from touchgoal.control.sensors.load_cell import with_checksum
from touchgoal.control.sensors.serial_port import modbus_crc
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell
from touchgoal.sim_envs.twin.tcp_ports import Service

_LOAD_RATE = 80  # Hz, an HX711's faster rate
NEWTONS_PER_COUNT, ZERO = 2e-4, 84_213  # load cell; a bridge is never balanced
_LOAD_NOISE = 25.0  # counts

_STILL, _SETTLED = 1e-3, 0.05  # m/s, s


class SerialPort:
    """A pseudo-terminal behind a path that survives unplugging."""

    def __init__(self, path: Path) -> None:
        # garble: share of messages that lose a byte on their way to the client
        self.path, self.garble = path, 0.0
        self._rng = np.random.default_rng(0)
        self._ends: tuple[int, int] | None = None
        self.plug()

    def plug(self) -> None:
        """Plug it in."""
        if self._ends is not None:
            return
        self._ends = os.openpty()
        for end in self._ends:
            tty.setraw(end)
            os.set_blocking(end, False)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._ends[1]))

    def unplug(self) -> None:
        """Unplug it: a client's next read fails."""
        if self._ends is not None:
            for end in self._ends:
                os.close(end)
            self._ends = None
            self.path.unlink(missing_ok=True)

    def read(self) -> bytes:
        """Return bytes that the client has sent."""
        try:
            return os.read(self._ends[0], 4096) if self._ends else b""
        except OSError:
            return b""

    def write(self, message: bytes) -> None:
        """Send bytes; unread ones are lost, as on a wire."""
        if self._rng.random() < self.garble:
            cut = int(self._rng.integers(len(message) - 2))  # a line without its \r is still whole
            message = message[:cut] + message[cut + 1 :]
        try:
            if self._ends:
                os.write(self._ends[0], message)
        except OSError:
            pass


class LoadCell(Service):
    """A load cell under the table: lines `milliseconds,counts*CRC`, 80 a second.

    Force in N is `NEWTONS_PER_COUNT * (counts - ZERO)`; CRC: Modbus' CRC-16, hexadecimal.
    """

    def __init__(self, cell: SimulatedCell, path: Path) -> None:
        self.cell, self.port = cell, SerialPort(path)
        self._rng = np.random.default_rng(1)
        # sent: milliseconds of the last line
        self._milliseconds = self.sent = 0

    def reset(self) -> None:
        """Begin noise and line times as a new twin does."""
        self._rng = np.random.default_rng(1)
        self._milliseconds += -self._milliseconds % 1000  # a clock that goes back is a restart

    def send(self) -> None:
        """Write a line if one is due."""
        self._milliseconds += 1
        if self._milliseconds * _LOAD_RATE % 1000 >= _LOAD_RATE:
            return
        self.port.read()  # discard
        counts = ZERO + self.cell.env.table_load() / NEWTONS_PER_COUNT
        counts += self._rng.normal(0.0, _LOAD_NOISE)
        line = f"{self._milliseconds},{round(counts)}".encode()
        self.port.write(with_checksum(line, "crc16") + b"\r\n")
        self.sent = self._milliseconds

    def close(self) -> None:
        """Unplug it."""
        self.port.unplug()


class Robotiq(Service):
    """A 2F gripper's Modbus registers, activated; position 3 is the pads' stroke, 230 is closed."""

    def __init__(self, cell: SimulatedCell, path: Path) -> None:
        self.cell, self.port = cell, SerialPort(path)
        self._stroke = cell.env.robot.tool.stroke[1]
        self._unread = b""
        self._output_registers = bytearray([0x01, 0, 0, 0, 0, 0])
        self._ready_in = 0.0  # s of activation left
        self._width, self._still = np.inf, 0.0
        self._goal: float | None = None

    def receive(self) -> None:
        """Take requests and answer them."""
        self._unread += self.port.read()
        while (length := _request_length(self._unread)) and len(self._unread) >= length:
            frame, self._unread = self._unread[:length], self._unread[length:]
            if frame[0] != registers.SLAVE or modbus_crc(frame[:-2]) != frame[-2:]:
                self._unread = b""  # the next frame begins after a silence
                return
            answer = self._serve(frame)
            self.port.write(answer + modbus_crc(answer))

    def send(self) -> None:
        """Measure the fingers' motion."""
        width = self.cell.env.width()
        moved, self._width = abs(width - self._width), width
        self._still = self._still + DT if moved < _STILL * DT else 0.0
        if self._ready_in > 0:
            self._ready_in -= DT
            opening = self._ready_in > 1.0  # it opens, then closes
            self.cell.command_gripper(
                self._stroke if opening else 0.0, registers.SPEEDS[1], registers.FORCES[0]
            )

    def close(self) -> None:
        """Unplug it."""
        self.port.unplug()

    def _serve(self, frame: bytes) -> bytes:
        function, register = struct.unpack_from(">xBH", frame)
        head = frame[:2]
        if function == 16 and register >= registers.COMMAND:
            first = 2 * (register - registers.COMMAND)
            data = frame[7:-2]
            self._output_registers[first : first + len(data)] = data
            self._apply_registers()
            return frame[:6]
        if function in (3, 4) and register >= registers.STATUS:
            (count,) = struct.unpack_from(">H", frame, 4)
            first = 2 * (register - registers.STATUS)
            data = self._status()[first : first + 2 * count]
            return head + bytes([len(data)]) + data
        return bytes([frame[0], function | 0x80, 1])  # illegal function

    def _apply_registers(self) -> None:
        action, _, _, position, speed, force = self._output_registers[:6]
        if not action & registers.ACTIVATE:
            self._ready_in, self._goal = -1.0, None  # reset
        elif self._ready_in < 0:
            self._ready_in = 2.0
        elif action & registers.GO and self._ready_in == 0:
            opened, closed = registers.POSITIONS
            share = min(max((position - opened) / (closed - opened), 0.0), 1.0)
            goal = (1 - share) * self._stroke
            if goal != self._goal:
                self._goal, self._still = goal, 0.0
            self.cell.command_gripper(
                goal,
                registers.from_count(speed, registers.SPEEDS),
                registers.from_count(force, registers.FORCES),
            )
        elif self._ready_in == 0 and self._goal is not None:
            self._goal = None  # without the go bit it stays where it is
            self.cell.gripper_command.speed = 0.0

    def _status(self) -> bytes:
        if self._ready_in > 0:
            state = 1
        else:
            self._ready_in, state = (0.0, 3) if self._ready_in >= 0 else (-1.0, 0)
        going, found = self._goal is not None, registers.ARRIVED
        if self._goal is not None and abs(self._width - self._goal) > 2e-3:
            blocked = (
                registers.STOPPED_CLOSING if self._width > self._goal else registers.STOPPED_OPENING
            )
            found = blocked if self._still > _SETTLED else registers.MOVING
        first = (self._output_registers[0] & 1) | going << 3 | state << 4 | found << 6
        opened, closed = registers.POSITIONS
        share = min(max(1 - self._width / self._stroke, 0.0), 1.0)
        position = round(opened + share * (closed - opened))
        return bytes([first, 0, 0, self._output_registers[3], position, 0])


def _request_length(unread: bytes) -> int:
    """Return the length of the request that begins here; 0 if it is not known yet."""
    if len(unread) < 8:
        return 0
    return 9 + unread[6] if unread[1] == 16 else 8
