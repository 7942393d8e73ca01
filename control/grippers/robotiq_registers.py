"""Registers of a Robotiq 2F-85, as in its instruction manual (section 4); shared with its twin."""

from touchgoal.control.motion.tool import ROBOTIQ_2F85

SLAVE = 9  # Modbus address
COMMAND, STATUS = 0x03E8, 0x07D0  # first registers written and read; 6 bytes each
ACTIVATE, GO = 0x01, 0x08  # bits of the first command byte
ACTIVE = 3  # status of a finished activation: bits 4 and 5 of the first status byte
MOVING, STOPPED_OPENING, STOPPED_CLOSING, ARRIVED = range(4)  # of an object: bits 6 and 7
SILENCE = 0x09  # a fault that is over as soon as it can be read: a second without messages
POSITIONS = 3, 230  # counts fully open and closed, between which the stroke is linear
SPEEDS = 0.020, ROBOTIQ_2F85.speed  # m/s for 0 to 255
FORCES = ROBOTIQ_2F85.force  # N for 0 to 255


def to_count(value: float, span: tuple[float, float]) -> int:
    """Return the byte (0 to 255) for a value, clipped to the span."""
    return round(255 * min(max((value - span[0]) / (span[1] - span[0]), 0.0), 1.0))


def from_count(count: int, span: tuple[float, float]) -> float:
    """Return the value of a byte (0 to 255)."""
    return span[0] + (span[1] - span[0]) * count / 255
