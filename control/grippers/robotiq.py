"""Robotiq 2F-85 gripper over serial (Modbus RTU), registers as in its instruction manual."""

import threading
import time
from dataclasses import dataclass

from touchgoal.control.errors import UserError
from touchgoal.control.grippers.modbus import Modbus
from touchgoal.control.interfaces import DriverError, GripperReading
from touchgoal.control.sensors.latest_value import LatestValue
from touchgoal.control.sensors.serial_port import open_port

_SLAVE, _OUTPUT, _INPUT = 9, 0x03E8, 0x07D0
_ACTIVATE, _GO = 0x01, 0x08  # bits of the first output byte
_ACTIVE = 3  # gripper status of a finished activation
_PERIOD = 0.02  # s between exchanges; one takes 2 to 10 ms
_ACTIVATION = 8.0  # s that opening and closing once may take
_MISSES = 5  # unanswered exchanges in a row that mean it is lost
_SPEED_RANGE = 0.020, 0.150  # m/s for 0 to 255
ROBOTIQ_FORCE_RANGE = 20.0, 235.0  # N for 0 to 255
_CONTACT = 1, 2  # object status: something stopped the fingers while opening, closing
_SILENCE = 0x09  # a fault that is over as soon as it can be read: a second without messages
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


@dataclass(frozen=True)
class RobotiqConfig:
    """One gripper.

    Attributes:
        port: such as /dev/ttyUSB0.
        activate: activate it if it is not; it then opens and closes fully once.
        speed, force: m/s and N.
        widths: m between the fingertips at positions 3 and 230, between which the stroke is linear;
            measure your own with sensors mounted.
    """

    port: str
    activate: bool = False
    speed: float = 0.05
    force: float = 20.0
    widths: tuple[float, float] = (0.085, 0.0)


_POSITIONS = 3, 230


class Robotiq:
    """The Gripper protocol over a 2F-85; a thread talks to it, commands never wait."""

    def __init__(self, config: RobotiqConfig) -> None:
        self.config = config
        self._port = open_port(config.port, 115200, timeout=0.1)
        self._modbus = Modbus(self._port, _SLAVE)
        self._lock = threading.Lock()
        self._wanted: int | None = None
        self._misses = 0
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
        opened, closed = self.config.widths
        share = min(max((opened - width) / (opened - closed), 0.0), 1.0)
        with self._lock:
            self._wanted = round(_POSITIONS[0] + share * (_POSITIONS[1] - _POSITIONS[0]))

    def stop(self) -> None:
        """See Gripper: without the go bit the fingers halt, and what is held stays held."""
        with self._lock:
            self._wanted = None
            self._modbus.write(_OUTPUT, bytes([_ACTIVATE, 0, 0, 0, 0, 0]))

    def close(self) -> None:
        """See Gripper."""
        self._latest.close()
        self._port.close()

    def _start(self) -> None:
        """Finds the gripper activated, or activates it if that is allowed."""
        if self._status()[0] >> 4 & 3 == _ACTIVE:
            return
        if not self.config.activate:
            raise UserError(
                "the gripper is not activated: set `activate = true`, and keep hands away, it opens "
                "and closes fully"
            )
        self._modbus.write(_OUTPUT, bytes(6))
        self._modbus.write(_OUTPUT, bytes([_ACTIVATE, 0, 0, 0, 0, 0]))
        end = time.monotonic() + _ACTIVATION
        while self._status()[0] >> 4 & 3 != _ACTIVE:
            if time.monotonic() > end:
                raise DriverError(
                    "the gripper does not become active: clear its fingers, cycle power"
                )
            time.sleep(0.1)

    def _status(self) -> bytes:
        return self._modbus.read(_INPUT, 3)

    def _take(self) -> GripperReading | None:
        time.sleep(_PERIOD)
        try:
            with self._lock:
                self._send()
                status = self._status()
        except DriverError:
            self._misses += 1
            if self._misses >= _MISSES:
                raise
            return None
        self._misses = 0
        first, last = self.config.widths
        share = (status[4] - _POSITIONS[0]) / (_POSITIONS[1] - _POSITIONS[0])
        code = status[2] & 0x0F
        return GripperReading(
            width=first + min(max(share, 0.0), 1.0) * (last - first),
            grasped=status[0] >> 6 in _CONTACT,
            fault=_FAULTS.get(code, f"fault {code:#04x}") if code not in (0, _SILENCE) else "",
            stamp=time.monotonic(),
        )

    def _send(self) -> None:
        """Every time, not only news: after a second of silence the gripper reports a fault."""
        if self._wanted is None:
            return
        speed = _count(self.config.speed, _SPEED_RANGE)
        force = _count(self.config.force, ROBOTIQ_FORCE_RANGE)
        self._modbus.write(_OUTPUT, bytes([_ACTIVATE | _GO, 0, 0, self._wanted, speed, force]))


def _count(value: float, span: tuple[float, float]) -> int:
    return round(255 * min(max((value - span[0]) / (span[1] - span[0]), 0.0), 1.0))
