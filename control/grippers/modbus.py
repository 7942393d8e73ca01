"""Modbus RTU: reads and writes of registers over a serial line."""

import struct

import serial

from touchgoal.control.interfaces import DriverError

_READ, _WRITE = 4, 16  # function codes: read input registers, write multiple registers


def crc(frame: bytes) -> bytes:
    """The frame's check, low byte first: CRC-16, polynomial 0xA001 (reflected 0x8005), from 0xFFFF."""
    value = 0xFFFF
    for byte in frame:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)


class Modbus:
    """One slave on a port; a garbled or missing answer raises DriverError."""

    def __init__(self, port: serial.Serial, slave: int) -> None:
        self._port, self._slave = port, slave

    def read(self, register: int, count: int) -> bytes:
        """The bytes of `count` registers from `register` on."""
        answer = self._exchange(struct.pack(">BHH", _READ, register, count), 1 + 2 * count)
        if answer[0] != 2 * count:
            raise DriverError("the answer has the wrong length")
        return answer[1:]

    def write(self, register: int, data: bytes) -> None:
        """Writes whole registers from `register` on."""
        count = len(data) // 2
        answer = self._exchange(struct.pack(">BHHB", _WRITE, register, count, len(data)) + data, 4)
        if answer != struct.pack(">HH", register, count):
            raise DriverError("the answer is to another write")

    def _exchange(self, request: bytes, size: int) -> bytes:
        """Sends slave, request and check; returns the answer's `size` bytes after its header."""
        frame = bytes([self._slave]) + request
        self._port.reset_input_buffer()
        self._port.write(frame + crc(frame))
        head = self._port.read(2)
        if len(head) < 2:
            raise DriverError("no answer")
        if head != frame[:2]:
            code = self._port.read(3)[:1].hex()
            raise DriverError(f"refused with code {code}" if head[1] & 0x80 else "a garbled answer")
        rest = self._port.read(size + 2)
        if crc(head + rest[:-2]) != rest[-2:]:
            raise DriverError("a garbled answer")
        return rest[:-2]
