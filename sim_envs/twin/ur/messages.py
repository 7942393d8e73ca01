"""A UR's wire format: RTDE packages and variables.

Source: Universal Robots' RTDE guide and dashboard server manual (e-Series, PolyScope 5).
"""

import struct
from enum import IntEnum

DASHBOARD, PRIMARY, SECONDARY, SCRIPT, RTDE = 29999, 30001, 30002, 30003, 30004
VERSION = (5, 15, 0, 0)


class Package(IntEnum):
    """Kinds of RTDE package."""

    PROTOCOL_VERSION = 86
    CONTROLLER_VERSION = 118
    TEXT = 77
    OUTPUTS = 79
    INPUTS = 73
    START = 83
    PAUSE = 80
    DATA = 85


class Safety(IntEnum):
    """Safety mode of the controller."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7

    @property
    def bits(self) -> int:
        """Bit 0 normal, 2 protective stop, 6 and 7 emergency stop, 10 stopped for safety."""
        return {1: 1, 3: 1 << 2 | 1 << 10, 7: 1 << 6 | 1 << 7 | 1 << 10}[self]


FORMATS = {
    "DOUBLE": "d",
    "UINT8": "B",
    "UINT32": "I",
    "INT32": "i",
    "UINT64": "Q",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}


def _types(**names: str) -> dict[str, str]:
    return {name: kind for kind, listed in names.items() for name in listed.split()}


_REGISTERS = range(48)
OUTPUTS = _types(
    VECTOR6D="target_q target_qd target_qdd target_current target_moment actual_q actual_qd "
    "actual_qdd actual_current actual_moment joint_control_output actual_TCP_pose actual_TCP_speed "
    "actual_TCP_force target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage "
    "ft_raw_wrench payload_inertia actual_current_as_torque",
    DOUBLE="timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum "
    "actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0 "
    "standard_analog_input1 standard_analog_output0 standard_analog_output1 payload "
    "tcp_force_scalar " + " ".join(f"output_double_register_{i}" for i in _REGISTERS),
    VECTOR3D="actual_tool_accelerometer payload_cog elbow_position elbow_velocity",
    UINT64="actual_digital_input_bits actual_digital_output_bits",
    UINT32="runtime_state robot_status_bits safety_status_bits output_bit_registers0_to_31 "
    "output_bit_registers32_to_63",
    INT32="robot_mode safety_mode safety_status "
    + " ".join(f"output_int_register_{i}" for i in _REGISTERS),
    VECTOR6INT32="joint_mode",
)
INPUTS = _types(
    UINT32="speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    DOUBLE="speed_slider_fraction " + " ".join(f"input_double_register_{i}" for i in _REGISTERS),
    VECTOR6D="external_force_torque",
    INT32=" ".join(f"input_int_register_{i}" for i in _REGISTERS),
)


def package(kind: Package, payload: bytes) -> bytes:
    """Return a package's bytes."""
    return struct.pack(">HB", 3 + len(payload), kind) + payload


class MalformedError(ValueError):
    """Bytes that are no RTDE package."""


def split(unread: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """Split off whole packages (kind, payload); return them and the rest; or MalformedError."""
    found = []
    while len(unread) >= 3:
        length, kind = struct.unpack_from(">HB", unread)
        if length < 3:
            raise MalformedError("a package shorter than its header")
        if len(unread) < length:
            break
        found.append((kind, unread[3:length]))
        unread = unread[length:]
    return found, unread


def layout(names: list[str], kinds: dict[str, str]) -> struct.Struct:
    """Return the binary layout of a recipe's variables."""
    return struct.Struct(">" + "".join(FORMATS[kinds[name]] for name in names))
