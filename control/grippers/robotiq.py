"""Robotiq 2F-85 gripper over serial (Modbus RTU), registers as in its instruction manual."""

import struct
import threading
import time
from collections.abc import Callable

import minimalmodbus
import numpy as np

from touchgoal.control.cell.config import GripperSection
from touchgoal.control.interfaces import DriverError, GripperReading
from touchgoal.control.motion.tool import ROBOTIQ_2F85
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.control.sensors.serial_port import open_port
from touchgoal.runtime.errors import UserError

# Registers, as in its instruction manual (section 4); its twin has the same.
SLAVE = 9  # Modbus address
COMMAND, STATUS = 0x03E8, 0x07D0  # first registers written and read; 6 bytes each
ACTIVATE, GO = 0x01, 0x08  # bits of the first command byte
ACTIVE = 3  # status of a finished activation: bits 4 and 5 of the first status byte
MOVING, STOPPED_OPENING, STOPPED_CLOSING, ARRIVED = range(4)  # of an object: bits 6 and 7
NO_MESSAGES = 0x09  # fault after a second without messages: ignored, because any message ends it
POSITIONS = 3, 230  # counts fully open and closed, between which the stroke is linear
SPEEDS = 0.020, ROBOTIQ_2F85.speed  # m/s for 0 to 255
FORCES = ROBOTIQ_2F85.force  # N for 0 to 255

_SPEED = 0.05  # m/s
_PERIOD = 0.02  # s between exchanges; one takes 2 to 10 ms
_ACTIVATION = 8.0  # s that opening and closing once may take
_MISSES = 5  # unanswered exchanges in a row that mean it is lost
_FAULTS = {
    0x05: "it must finish its activation first",
    0x07: "it is not activated",
    0x08: "it is too hot: let it cool down",
    0x0A: "its supply is below 24 V",
    0x0B: "it is releasing by itself: wait, then activate it",
    0x0C: "an internal fault: see Robotiq's manual",
    0x0D: "its activation failed: clear the fingers, then activate it",
    0x0E: "overcurrent: take away what blocks it, then activate it",
    0x0F: "it released by itself: activate it",
}


class Robotiq:
    """Gripper over a 2F-85; a thread talks to it, commands never wait for the port."""

    def __init__(self, config: GripperSection) -> None:
        self.config = config
        self._port = open_port(config.port, 115200, timeout=0.1)
        self._modbus = minimalmodbus.Instrument(self._port, SLAVE)
        # `_lock` is of `_wanted` and `_stopped`, and is held for no exchange.
        self._port_lock, self._lock = threading.Lock(), threading.Lock()
        self._wanted: int | None = None
        self._stopped, self._misses = False, 0
        try:
            self._start()
        except Exception:
            self._port.close()
            raise
        self._latest = LatestValue(f"gripper {config.port}", self._take)

    def read(self) -> GripperReading:
        """See Gripper."""
        return self._latest.read()

    def command(self, width: float) -> None:
        """See Gripper."""
        if fault := self.read().fault:
            raise DriverError(f"no command is taken: {fault}")
        with self._lock:
            if self._stopped:
                raise DriverError("no command is taken: the gripper was stopped")
            self._wanted = self._position(width)

    def stop(self, release_to: float | None = None) -> None:
        """See Gripper: without the go bit the fingers halt, and what is held stays held."""
        with self._lock:
            self._stopped = True
            self._wanted = None if release_to is None else self._position(release_to)
        if release_to is None:
            with self._port_lock:
                self._write(bytes([ACTIVATE, 0, 0, 0, 0, 0]))

    def close(self) -> None:
        """See Gripper."""
        self._latest.close()
        self._port.close()

    def _position(self, width: float) -> int:
        """Return a width (m) in counts."""
        return round(float(np.interp(width, self.config.widths[::-1], POSITIONS[::-1])))

    def _start(self) -> None:
        """Require an active gripper, or activate it if that is allowed."""
        if self._status()[0] >> 4 & 3 == ACTIVE:
            return
        if not self.config.activate:
            raise UserError(
                "the gripper is not activated: set `activate = true`, and keep hands away, it opens "
                "and closes fully"
            )
        self._write(bytes(6))
        self._write(bytes([ACTIVATE, 0, 0, 0, 0, 0]))
        end = time.monotonic() + _ACTIVATION
        while self._status()[0] >> 4 & 3 != ACTIVE:
            if time.monotonic() > end:
                raise DriverError(
                    "the gripper does not become active: clear its fingers, cycle power"
                )
            time.sleep(0.1)

    def _status(self) -> bytes:
        """Return the six bytes of its status."""
        read = self._modbus.read_registers
        return struct.pack(">3H", *_exchange(lambda: read(STATUS, 3, functioncode=4)))

    def _write(self, command: bytes) -> None:
        """Write the six bytes of a command."""
        values = list(struct.unpack(">3H", command))
        _exchange(lambda: self._modbus.write_registers(COMMAND, values))

    def _take(self) -> GripperReading | None:
        time.sleep(_PERIOD)
        try:
            with self._port_lock:
                self._send()
                status = self._status()
        except DriverError:
            self._misses += 1
            if self._misses >= _MISSES:
                raise
            return None
        self._misses = 0
        code = status[2] & 0x0F
        return GripperReading(
            width=float(np.interp(status[4], POSITIONS, self.config.widths)),
            grasped=status[0] >> 6 in (STOPPED_OPENING, STOPPED_CLOSING),
            fault=_FAULTS.get(code, f"fault {code:#04x}") if code not in (0, NO_MESSAGES) else "",
            stamp=time.monotonic(),
        )

    def _send(self) -> None:
        """Repeat the command: after a second of silence the gripper reports a fault."""
        wanted = self._wanted
        if wanted is None:
            return
        speed = to_count(_SPEED, SPEEDS)
        force = to_count(self.config.force, FORCES)
        self._write(bytes([ACTIVATE | GO, 0, 0, wanted, speed, force]))


def to_count(value: float, span: tuple[float, float]) -> int:
    """Return the byte (0 to 255) for a value, clipped to the span."""
    return round(float(np.interp(value, span, (0, 255))))


def from_count(count: int, span: tuple[float, float]) -> float:
    """Return the value of a byte (0 to 255)."""
    return span[0] + (span[1] - span[0]) * count / 255


def _exchange(call: Callable[[], list[int] | None]) -> list[int]:
    """Return the answer to a request; DriverError if it is missing or garbled."""
    try:
        return call() or []
    except minimalmodbus.NoResponseError as error:
        raise DriverError("no answer: check its supply and cable") from error
    except minimalmodbus.SlaveReportedException as error:
        raise DriverError(f"it refuses: {error}") from error
    except minimalmodbus.ModbusException as error:
        raise DriverError("a garbled answer: check the cable") from error
    except Exception as error:  # of the port: termios.error is no OSError
        raise DriverError(f"its port failed ({error}): check its USB cable") from error
