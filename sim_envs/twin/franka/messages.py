"""The Franka control interface's bytes: messages of server version 10, one client's connection.

Layouts are those of libfranka's public headers, as franky-sim documents them. As numpy records a
state is packed in 20 us instead of franky-sim's 0.3 ms.
"""

import select
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from touchgoal.sim_envs.twin.tcp_ports import ClientConnection, ListeningPort

ROBOT_PORT, HAND_PORT = 1337, 1338
ROBOT_VERSION, HAND_VERSION = 10, 3
_ABSURD = 1e6  # larger than any setting of an arm, in any unit
_LONGEST = 4096  # bytes of a command; the longest of the protocol has 300


def _floats(**sizes: int) -> list[tuple]:
    return [(name, "<f4", size) if size > 1 else (name, "<f4") for name, size in sizes.items()]


ROBOT_STATE = np.dtype(
    [
        ("message_id", "<u8"),
        *_floats(O_T_EE=16, O_T_EE_d=16, F_T_EE=16, EE_T_K=16, F_T_NE=16, NE_T_EE=16),
        *_floats(m_ee=1, I_ee=9, F_x_Cee=3, m_load=1, I_load=9, F_x_Cload=3, elbow=2, elbow_d=2),
        *_floats(tau_J=7, tau_J_d=7, dtau_J=7, q=7, q_d=7, dq=7, dq_d=7, ddq_d=7),
        *_floats(joint_contact=7, cartesian_contact=6, joint_collision=7, cartesian_collision=6),
        *_floats(tau_ext_hat_filtered=7, O_F_ext_hat_K=6, K_F_ext_hat_K=6, O_dP_EE_d=6, O_ddP_O=3),
        *_floats(elbow_c=2, delbow_c=2, ddelbow_c=2, O_T_EE_c=16, O_dP_EE_c=6, O_ddP_EE_c=6),
        *_floats(theta=7, dtheta=7, accelerometer_top=18, accelerometer_bottom=18),
        ("motion_generator_mode", "u1"),
        ("controller_mode", "u1"),
        ("errors", "u1", 41),
        ("reflex_reason", "u1", 41),
        ("robot_mode", "u1"),
        ("control_command_success_rate", "<f4"),
    ]
)
ROBOT_ORDER = np.dtype(
    [
        ("message_id", "<u8"),
        ("q_c", "<f8", 7),
        ("dq_c", "<f8", 7),
        ("O_T_EE_c", "<f8", 16),
        ("O_dP_EE_c", "<f8", 6),
        ("elbow_c", "<f8", 2),
        ("valid_elbow", "u1"),
        ("finished", "u1"),
        ("tau_J_d", "<f8", 7),
        ("torque_finished", "u1"),
    ]
)
COLLISION_BEHAVIOUR = np.dtype(
    [
        (f"{bound}_{kind}_{phase}", "<f8", size)
        for kind, size in (("torque", 7), ("force", 6))
        for phase in ("acceleration", "nominal")
        for bound in ("lower", "upper")
    ]
)
HAND_STATE = np.dtype(
    [
        ("message_id", "<u4"),
        ("width", "<f8"),
        ("max_width", "<f8"),
        ("is_grasped", "u1"),
        ("temperature", "<u2"),
    ]
)


class RobotCommand(IntEnum):
    """Commands to the arm."""

    CONNECT = 0
    MOVE = 1
    STOP_MOVE = 2
    SET_COLLISION_BEHAVIOUR = 3
    SET_JOINT_IMPEDANCE = 4
    SET_CARTESIAN_IMPEDANCE = 5
    SET_GUIDING_MODE = 6
    SET_EE_TO_K = 7
    SET_NE_TO_EE = 8
    SET_LOAD = 9
    AUTOMATIC_ERROR_RECOVERY = 10
    GET_ROBOT_MODEL = 11


class MoveStatus(IntEnum):
    """Status of a motion."""

    SUCCESS = 0
    STARTED = 1
    PREEMPTED = 2
    PREEMPTED_BY_SAFETY = 3
    REJECTED_BY_SAFETY = 4
    NOT_POSSIBLE = 5
    INVALID_ARGUMENT = 7
    REFLEX_ABORTED = 8


class RobotMode(IntEnum):
    """Mode of the arm."""

    IDLE = 1
    MOVE = 2
    REFLEX = 4
    USER_STOPPED = 5


class HandCommand(IntEnum):
    """Commands to the hand."""

    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


class HandStatus(IntEnum):
    """Result of a command to the hand."""

    SUCCESS = 0
    FAIL = 1
    UNSUCCESSFUL = 2
    ABORTED = 3


ERRORS = (  # bits of `errors`, in libfranka 0.21's order (asked of it one by one)
    "joint_position_limits_violation",
    "cartesian_position_limits_violation",
    "self_collision_avoidance_violation",
    "joint_velocity_violation",
    "cartesian_velocity_violation",
    "force_control_safety_violation",
    "joint_reflex",
    "cartesian_reflex",
    "max_goal_pose_deviation_violation",
    "max_path_pose_deviation_violation",
    "cartesian_velocity_profile_safety_violation",
    "joint_position_motion_generator_start_pose_invalid",
    "joint_motion_generator_position_limits_violation",
    "joint_motion_generator_velocity_limits_violation",
    "joint_motion_generator_velocity_discontinuity",
    "joint_motion_generator_acceleration_discontinuity",
    "cartesian_position_motion_generator_start_pose_invalid",
    "cartesian_motion_generator_elbow_limit_violation",
    "cartesian_motion_generator_velocity_limits_violation",
    "cartesian_motion_generator_velocity_discontinuity",
    "cartesian_motion_generator_acceleration_discontinuity",
    "cartesian_motion_generator_elbow_sign_inconsistent",
    "cartesian_motion_generator_start_elbow_invalid",
    "force_controller_desired_force_tolerance_violation",
    "start_elbow_sign_inconsistent",
    "communication_constraints_violation",
    "power_limit_violation",
    "cartesian_motion_generator_joint_position_limits_violation",
    "cartesian_motion_generator_joint_velocity_limits_violation",
    "cartesian_motion_generator_joint_velocity_discontinuity",
    "cartesian_motion_generator_joint_acceleration_discontinuity",
    "cartesian_position_motion_generator_invalid_frame",
    "controller_torque_discontinuity",
    "joint_p2p_insufficient_torque_for_planning",
    "tau_j_range_violation",
    "instability_detected",
    "joint_move_in_wrong_direction",
    "cartesian_spline_motion_generator_violation",
    "joint_via_motion_generator_planning_joint_limit_violation",
    "base_acceleration_initialization_timeout",
    "base_acceleration_invalid_reading",
)


_ARGUMENTS = {  # Bytes of arguments that each command has; a client that sends others is dropped.
    (True, RobotCommand.CONNECT): 4,
    (True, RobotCommand.SET_COLLISION_BEHAVIOUR): COLLISION_BEHAVIOUR.itemsize,
    (True, RobotCommand.SET_NE_TO_EE): 128,
    (True, RobotCommand.SET_EE_TO_K): 128,
    (True, RobotCommand.SET_LOAD): 104,
    (False, HandCommand.CONNECT): 4,
    (False, HandCommand.MOVE): 16,
    (False, HandCommand.GRASP): 40,
}
_LEAST_OF_MOVE = 8  # controller and motion generator; tolerances follow


@dataclass(frozen=True)
class Request:
    """A client's command over TCP: its number, the id to answer under, its arguments."""

    command: int
    id: int
    payload: bytes


class Link:
    """One client's connection: commands over TCP, states and set-points over UDP.

    A second client waits until the first has gone.
    """

    def __init__(self, host: str, port: int, version: int, wide: bool) -> None:
        """`wide`: 4-byte command and 1-byte status (arm), else 2 and 2 (hand)."""
        self._version, self._wide = version, wide
        self._header = struct.Struct("<III" if wide else "<HII")
        self._status = struct.Struct("<B" if wide else "<H")
        self._listener = ListeningPort(host, port)
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((host, 0))
        self._udp.setblocking(False)
        self._tcp: ClientConnection | None = None
        self._peer: tuple[str, int] | None = None
        self._unsent = b""  # while the link is frozen
        self.frozen = False  # nothing gets through in either direction

    @property
    def connected(self) -> bool:
        """Whether a client is connected and has shaken hands."""
        return self._peer is not None

    @property
    def sockets(self) -> list[ListeningPort | ClientConnection | socket.socket]:
        """Sockets on which a client may send."""
        return [self._listener if self._tcp is None else self._tcp, self._udp]

    def requests(self) -> list[Request]:
        """Return commands that have arrived; accept a new client."""
        if self.frozen:
            return []
        self._tcp = self._tcp or self._listener.accept()
        if self._tcp is None:
            return []
        self._flush()
        self._tcp.read()
        if not self._tcp.open:
            self.drop()
            return []
        return list(self._parse_requests(self._tcp))

    def orders(self) -> list[bytes]:
        """Return datagrams that have arrived."""
        found = []
        while True:
            try:
                data, sender = self._udp.recvfrom(1024)
            except OSError:  # nothing left, or the client's port has closed
                return [] if self.frozen else found
            if self._peer is not None and sender[0] == self._peer[0]:
                found.append(data)

    def wait(self, seconds: float) -> None:
        """Wait until the client sends on either socket."""
        select.select(self.sockets, [], [], seconds)

    def send(self, state: bytes) -> None:
        """Send a state to the client, if any; a datagram may be lost."""
        if self._peer is not None and not self.frozen:
            try:
                self._udp.sendto(state, self._peer)
            except OSError:
                pass

    def answer(self, request: Request, status: int, payload: bytes = b"") -> None:
        """Answer a command; some are answered more than once, or late."""
        self._write(request, self._status.pack(status) + payload)

    def drop(self) -> None:
        """Close the client's connection."""
        if self._tcp is not None:
            self._tcp.close()
        self._tcp, self._peer, self._unsent = None, None, b""

    def close(self) -> None:
        """Close everything."""
        self.drop()
        self._listener.close()
        self._udp.close()

    def _parse_requests(self, client: ClientConnection) -> Iterator[Request]:
        size = self._header.size
        while len(client.unread) >= size:
            command, id, length = self._header.unpack_from(client.unread)
            if not size <= length <= _LONGEST:
                self.drop()  # not libfranka
                return
            if len(client.unread) < length:
                return
            request = Request(command, id, client.unread[size:length])
            client.unread = client.unread[length:]
            if not self._well_formed(request):
                self.drop()
                return
            if command == RobotCommand.CONNECT:
                self._handshake(request)
            elif self.connected:
                yield request

    def _well_formed(self, request: Request) -> bool:
        n = len(request.payload)
        if self._wide and request.command == RobotCommand.MOVE:
            return n >= _LEAST_OF_MOVE
        expected = _ARGUMENTS.get((self._wide, request.command))
        if expected is None or request.command == RobotCommand.CONNECT:
            return n >= (expected or 0)
        if n != expected:
            return False
        # The hand itself refuses what it cannot do; libfranka checks the arm's numbers. Absurd
        # values (a tool a thousand metres long) would overflow the Jacobian.
        return not self._wide or bool(
            (np.abs(np.frombuffer(request.payload, "<f8")) < _ABSURD).all()
        )

    def _handshake(self, request: Request) -> None:
        assert self._tcp is not None
        _, port = struct.unpack_from("<HH", request.payload)
        self._peer = self._tcp.host, port
        self._write(request, struct.pack("<HH4x", 0, self._version))

    def _write(self, request: Request, body: bytes) -> None:
        if self._tcp is None:  # the client that asked has gone
            return
        length = self._header.size + len(body)
        self._unsent += self._header.pack(request.command, request.id, length) + body
        self._flush()

    def _flush(self) -> None:
        """Send what waits, unless the link is frozen."""
        if self._tcp is not None and not self.frozen:
            self._tcp.send(self._unsent)
            self._unsent = b""
