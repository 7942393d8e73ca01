"""Load cell behind a microcontroller that prints lines of text, with a checksum if it can.

There is no standard for such lines, so the format is a setting. Without a checksum about 3 % of the
lines of a poor cable are two halves that fuse into a wrong number (measured); with one, none were.
"""

import math
import time
from dataclasses import dataclass

from touchgoal.control.newest import Newest
from touchgoal.control.protocols import LoadReading
from touchgoal.control.serial_port import open_port

_LONGEST = 256  # bytes of a line


@dataclass(frozen=True)
class LoadCellConfig:
    """One load cell.

    Attributes:
        port, baud: such as /dev/ttyACM0, 115200.
        newtons_per_count, zero: force = newtons_per_count * (value - zero).
        highest: N; a line beyond it, of either sign, is refused.
        value_field: which comma-separated field holds the value, from 0.
        time_field: which field holds the device's clock, whose steps must be positive; None: none.
        checksum: whether lines end in `*` and two hexadecimal digits, the XOR of all bytes before.
    """

    port: str
    newtons_per_count: float
    zero: float
    highest: float
    baud: int = 115200
    value_field: int = 1
    time_field: int | None = 0
    checksum: bool = True


class SerialLoadCell:
    """The LoadCell protocol over a serial port. A wrong line is counted and otherwise ignored."""

    def __init__(self, config: LoadCellConfig) -> None:
        self.config = config
        self._port = open_port(config.port, config.baud, timeout=0.2)
        self._buffer, self._clock, self._rejected = b"", -math.inf, 0
        self._whole = False  # whether the buffer starts at a line's start
        self._newest = Newest(f"load cell {config.port}", self._take)

    def read(self) -> LoadReading:
        """See LoadCell."""
        return self._newest.read()

    def close(self) -> None:
        """See LoadCell."""
        self._newest.close()
        self._port.close()

    def _take(self) -> LoadReading | None:
        """The last good one of the lines that came in, if any."""
        self._buffer += self._port.read(max(1, self._port.in_waiting))
        stamp, newest = time.monotonic(), None
        *lines, self._buffer = self._buffer.split(b"\n")
        for line in lines:
            force = self._force(line.strip()) if self._whole else None
            self._rejected += self._whole and force is None
            self._whole = True
            if force is not None:
                newest = LoadReading(force, self._rejected, stamp)
        if len(self._buffer) > _LONGEST:  # noise, or the wrong baud rate
            self._buffer, self._whole = b"", False
            self._rejected += 1
        return newest

    def _force(self, line: bytes) -> float | None:
        """Force (N) in a line, None if anything about it is wrong."""
        c = self.config
        if c.checksum:
            line, star, sum_ = line.rpartition(b"*")
            if not star or sum_.upper() != b"%02X" % xor(line):
                return None
        fields = line.split(b",")
        try:
            force = c.newtons_per_count * (float(fields[c.value_field]) - c.zero)
            clock = math.nan if c.time_field is None else float(fields[c.time_field])
        except (ValueError, IndexError):
            return None
        if clock <= self._clock or not abs(force) <= c.highest:
            return None
        self._clock = clock
        return force


def xor(line: bytes) -> int:
    """The exclusive or of all bytes."""
    result = 0
    for byte in line:
        result ^= byte
    return result
