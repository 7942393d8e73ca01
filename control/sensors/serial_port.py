"""Serial ports and Modbus' checksum."""

import struct

import serial

from touchgoal.runtime.errors import UserError


def open_port(device: str, baud: int, timeout: float) -> serial.Serial:
    """Open a device for itself alone; reads wait `timeout` s. UserError if that fails."""
    try:
        return serial.Serial(device, baud, timeout=timeout, write_timeout=timeout, exclusive=True)
    except serial.SerialException as error:
        raise UserError(
            f"cannot open {device}: check the cable and that nothing else uses it, and that you are "
            f"in the group dialout ({error})"
        ) from error


def modbus_crc(message: bytes) -> bytes:
    """Return the CRC-16 of a message, low byte first (polynomial 0xA001, start 0xFFFF)."""
    value = 0xFFFF
    for byte in message:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)
