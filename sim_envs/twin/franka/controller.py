"""The arm's side of the Franka control interface, in front of the cell, for libfranka's joint motions.

Reflexes, limits and lost packets abort motions with a real arm's errors. Not simulated: Cartesian motions and
torques, which are rejected; impedances set by the client (the servo keeps Franka's default), self-collision,
guiding.
"""

import time

import numpy as np

from touchgoal.control.safety.limits import FR3
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell
from touchgoal.sim_envs.scene.build import MODELS
from touchgoal.sim_envs.twin.franka import limits, messages
from touchgoal.sim_envs.twin.franka.arm_state import OTHER, ArmState, Motion, end_effector
from touchgoal.sim_envs.twin.franka.limits import Setpoint
from touchgoal.sim_envs.twin.franka.messages import MoveStatus, RobotCommand, RobotMode
from touchgoal.sim_envs.twin.tcp_ports import Service

_MAX_LOST_PACKETS = 20  # packets in a row after which the arm stops: Franka's documentation
_POSITION, _VELOCITY = range(2)  # motion generators of joints; later ones are Cartesian
_TORQUES = 2  # controller of a client's torques; the others are the robot's own
_SETTERS = {*range(RobotCommand.SET_COLLISION_BEHAVIOUR, RobotCommand.SET_LOAD + 1)}
# s between states while time stands, to a client without a motion, with a motion that begins, and
# with one under way (libfranka gives up after 1 s).
_HELD_INTERVALS = 0.005, 0.02, 0.2
_BRAKING = FR3.hardware.acceleration  # rad/s^2 of braking; a real reflex brakes harder


class FrankaArm(Service):
    """Serves an arm at `host`, port 1337."""

    def __init__(self, cell: SimulatedCell, host: str, timeout: float, hand: messages.Link) -> None:
        """`hand`: the hand's link, which shares the arm's cable."""
        # timeout: s to wait for a client's answer to a state before the packet counts as lost
        self.cell, self.timeout = cell, timeout
        # mode: idle, moving, in a reflex, or user-stopped; error: the error in force
        self.mode, self.error = RobotMode.IDLE, ""
        self._hand = hand
        self._motion: Motion | None = None
        self._recovery: messages.Request | None = None
        self._cleared = False
        self._sent = self._echoed = 0
        self.nonsense = False  # whether to send NaN for joint speeds
        self._sent_at = 0.0  # monotonic s
        self._success_rate = 1.0
        self._thresholds = limits.THRESHOLDS
        self._ee, self._k = np.eye(4), np.eye(4)  # NE_T_EE and EE_T_K
        self._state = ArmState()
        self._reset_setpoint()
        self._state.write_hand(self._ee, self._k)
        self._load_code()
        self.link = messages.Link(host, messages.ROBOT_PORT, messages.ROBOT_VERSION, wide=True)

    # The twin's loop.

    def receive(self) -> None:
        """Take the client's messages; set the cell's target for the next millisecond."""
        motion = self._take_messages()
        if motion is not None and motion.begun:
            self._wait_for_client(motion)
        if self._recovery is not None:
            self._try_recovery(self._recovery)

    def send(self) -> None:
        """Check for faults after a millisecond, and send the state."""
        contact = self._estimate_wrench()
        if self._motion is not None:
            fault = limits.arm_fault(self.cell.excess, self.cell.speed) or contact.fault
            if fault is not None:
                self.abort(fault)
        self._send_state(contact)

    def hold(self) -> None:
        """Take the client's messages while time stands, and keep its connection alive.

        A client that drives the arm is sent the last state again; others look for new ones.
        """
        motion = self._take_messages()
        interval = _HELD_INTERVALS[0 if motion is None else 1 + motion.begun]
        if time.monotonic() - self._sent_at < interval:
            return
        if motion is not None and motion.begun:
            self._sent_at = time.monotonic()
            self.link.send(self._state.record.tobytes())
        else:
            self._send_state(self._estimate_wrench())

    @property
    def answered(self) -> bool:
        """Whether the client has answered the last state, if it drives the arm."""
        motion = self._motion
        return motion is None or not motion.begun or self._echoed >= self._sent - 1

    @property
    def follows_commands(self) -> bool:
        """Whether the client's motion has begun, or the arm accepts none."""
        motion = self._motion
        return self.mode != RobotMode.IDLE or (motion is not None and motion.begun)

    def close(self) -> None:
        """Free the port."""
        self.link.close()

    # Faults, from within and injected.

    def abort(self, error: str) -> None:
        """Stop with an error, in any motion or none: the arm brakes and waits for recovery."""
        if error not in messages.ERRORS:
            raise UserError(f"there is no error {error!r}; there are: {', '.join(messages.ERRORS)}")
        self.error, self.mode = error, RobotMode.REFLEX
        self._end(MoveStatus.REFLEX_ABORTED)
        if error in ("joint_reflex", "cartesian_reflex"):
            self.cell.give_way()

    @property
    def driven(self) -> bool:
        """Whether a client's motion goes on."""
        return self._motion is not None

    def clear_error(self) -> None:
        """End a reflex, as a person does in Desk."""
        if self.mode == RobotMode.REFLEX:
            self.mode, self.error = RobotMode.IDLE, ""

    def silence_gripper(self, silent: bool) -> None:
        """Block or unblock the hand's link."""
        self._hand.frozen = silent

    def freeze(self, frozen: bool) -> None:
        """Block or unblock both directions of both links."""
        self.link.frozen = self._hand.frozen = frozen

    def drop(self) -> None:
        """Hang up on the client."""
        self.link.drop()

    def stop_button(self, pressed: bool) -> None:
        """Press or release the user's stop."""
        if pressed:
            self.mode, self.error = RobotMode.USER_STOPPED, ""
            self._end(MoveStatus.PREEMPTED_BY_SAFETY)
        elif self.mode == RobotMode.USER_STOPPED:
            self.mode = RobotMode.IDLE

    def _end(self, status: MoveStatus | None) -> None:
        motion, self._motion = self._motion, None
        self.cell.brake(_BRAKING)
        self._reset_setpoint()
        if motion is not None and status is not None:
            self._send_state(self._estimate_wrench())  # the error first, as on the robot
            self.link.answer(motion.request, status)

    def _try_recovery(self, request: messages.Request) -> None:
        """Clear an error once the arm rests without contact; answer when the states show it."""
        if self._cleared:
            self.link.answer(request, 0)
            self._recovery = None
        elif not self.cell.moving and self._estimate_wrench().fault is None:
            self.mode, self.error, self._cleared = RobotMode.IDLE, "", True

    # Commands.

    def _handle(self, request: messages.Request) -> None:
        command = request.command
        if command == RobotCommand.MOVE:
            self._move(request)
        elif command == RobotCommand.STOP_MOVE:
            self.link.answer(request, 0)
            if self._motion is not None:
                self._end(MoveStatus.PREEMPTED)
        elif command == RobotCommand.AUTOMATIC_ERROR_RECOVERY:
            if self.mode == RobotMode.USER_STOPPED:
                self.link.answer(request, 2)  # rejected: a safety function is active
            else:
                self._recovery, self._cleared = request, False
        elif command == RobotCommand.GET_ROBOT_MODEL:
            urdf = MODELS["fr3"].with_name("fr3_clean.urdf").read_bytes()
            self.link.answer(request, 0, urdf)
        elif command in _SETTERS:
            self._configure(request)
            self.link.answer(request, 0)
        else:
            print(f"the twin does not know the Franka command {command}; client dropped")
            self.link.drop()

    def _configure(self, request: messages.Request) -> None:
        payload = request.payload
        if request.command == RobotCommand.SET_COLLISION_BEHAVIOUR:
            asked = np.frombuffer(payload, messages.COLLISION_BEHAVIOUR, 1)[0]
            self._thresholds = {name: asked[name].copy() for name in asked.dtype.names}
        elif request.command == RobotCommand.SET_NE_TO_EE:
            self._ee = np.frombuffer(payload, "<f8", 16).reshape(4, 4).T
            self._state.write_hand(self._ee, self._k)
        elif request.command == RobotCommand.SET_EE_TO_K:
            self._k = np.frombuffer(payload, "<f8", 16).reshape(4, 4).T
            self._state.write_hand(self._ee, self._k)
        elif request.command == RobotCommand.SET_LOAD:
            load = np.frombuffer(payload, "<f8", 13)
            record = self._state.record
            record["m_load"], record["F_x_Cload"], record["I_load"] = load[0], load[1:4], load[4:]

    def _move(self, request: messages.Request) -> None:
        if self.mode != RobotMode.IDLE or self._motion is not None:
            stopped = self.mode == RobotMode.USER_STOPPED
            status = MoveStatus.REJECTED_BY_SAFETY if stopped else MoveStatus.NOT_POSSIBLE
            self.link.answer(request, status)
            return
        controller, generator = (int(n) for n in np.frombuffer(request.payload, "<u4", 2))
        if controller > OTHER or controller == _TORQUES or generator > _VELOCITY:
            self.link.answer(request, MoveStatus.INVALID_ARGUMENT)
            return
        self._motion, self._success_rate = Motion(request, generator, controller), 1.0
        self.cell.set_target(self.cell.q_d.copy(), np.zeros(7))
        self._reset_setpoint()
        self.link.answer(request, MoveStatus.STARTED)

    # Set-points.

    def _wait_for_client(self, motion: Motion) -> None:
        deadline = time.monotonic() + self.timeout
        while (
            self._motion is motion
            and self.link.connected
            and self._echoed < self._sent - 1
            and motion.lost == 0
            and not self.link.frozen
            and (left := deadline - time.monotonic()) > 0
        ):
            self.link.wait(left)
            self._take_requests_and_orders()
        if self._motion is not motion:
            return
        lost = self._echoed < self._sent - 1
        motion.lost = motion.lost + 1 if lost else 0
        self._success_rate += 0.01 * ((not lost) - self._success_rate)
        if motion.lost > _MAX_LOST_PACKETS:
            self.abort("communication_constraints_violation")
        elif lost:
            last = self._setpoint  # a lost packet: acceleration stays (Franka's documentation)
            self._go_to(last.q + DT * (last.dq + DT * last.ddq))

    def _take_messages(self) -> Motion | None:
        """Take requests and set-points; return the motion, which ends with its client."""
        self._take_requests_and_orders()
        if self._motion is not None and not self.link.connected:
            self._end(None)
        return self._motion

    def _take_requests_and_orders(self) -> None:
        for request in self.link.requests():
            self._handle(request)
        for datagram in self.link.orders():
            if len(datagram) != messages.ROBOT_ORDER.itemsize:
                continue
            order = np.frombuffer(datagram, messages.ROBOT_ORDER, 1)[0]
            answered = int(order["message_id"])
            if self._echoed < answered < max(self._sent, 1):
                self._echoed = answered
                # Set-points that come after the arm has gone on without them are too old.
                late = self._motion is not None and self._motion.lost > 0
                if self._motion is not None and not (late and self._echoed < self._sent - 1):
                    self._apply_order(self._motion, order)

    def _apply_order(self, motion: Motion, order: np.void) -> None:
        motion.begun, motion.lost = True, 0
        if order["finished"]:
            self._end(MoveStatus.SUCCESS)
        elif motion.generator == _POSITION:
            self._go_to(order["q_c"].copy())
        else:
            self._go_to(self._setpoint.q + DT * order["dq_c"])

    def _go_to(self, q: np.ndarray) -> None:
        now = limits.next_setpoint(self._setpoint, q)
        fault = limits.joint_fault(self._setpoint, now)
        if fault is not None:
            self.abort(fault)
            return
        self._setpoint = now
        self.cell.set_target(now.q, now.dq)

    # State.

    def _load_code(self) -> None:
        contact = self._estimate_wrench()
        self._state.write_tcp(self.cell, self._ee, self._pose, self._wrench, contact)
        limits.joint_fault(self._setpoint, self._setpoint)

    def _reset_setpoint(self) -> None:
        zero = np.zeros(7)
        self._setpoint = Setpoint(self.cell.q_d.copy(), zero, zero)

    def _estimate_wrench(self) -> limits.Contact:
        self._pose, jacobian = end_effector(self.cell, self._ee, self.cell.q)
        known = limits.wrench_from_torques(self.cell.tau_ext, jacobian)
        self._wrench = known + self.cell.wrench_error
        thresholds, ddq = self._thresholds, self._setpoint.ddq
        return limits.judge_contact(thresholds, self.cell.tau_ext, self._wrench, ddq)

    def _send_state(self, contact: limits.Contact) -> None:
        state = self._state
        state.fields["message_id"][:] = self._sent
        state.write_joints(self.cell, self._setpoint.ddq, self.nonsense)
        state.write_tcp(self.cell, self._ee, self._pose, self._wrench, contact)
        state.write_mode(self.mode, self.error, self._motion, self._success_rate)
        self.link.send(state.record.tobytes())
        self._sent += 1
        self._sent_at = time.monotonic()
