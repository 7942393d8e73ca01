"""A UR controller in front of the cell, for ur-rtde's control, receive and dashboard clients.

Simulated: RTDE, the dashboard's state, power and stop commands, and ur-rtde's own control program
(`program.py`). The primary and secondary ports accept and say nothing.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from touchgoal.control.safety.limits import UR5E
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell
from touchgoal.sim_envs.twin.tcp_ports import ClientConnection, ListeningPort, Service
from touchgoal.sim_envs.twin.ur import messages
from touchgoal.sim_envs.twin.ur.messages import Package, Safety
from touchgoal.sim_envs.twin.ur.program import DONE, UrProgram

_CYCLE = 2  # ms, of a controller of the e-Series
_SELDOM = 10  # ms between polls of the dashboard and script ports
_UNLOCK_DELAY = 5.0  # s after a protective stop before it can be unlocked
_FORCE_LIMIT = 150.0  # N at the tool; the factory's safety presets run from 100 to 250
_FASTEST = 500.0  # Hz of an e-Series' data; also rad/s, above any joint's speed
_MOST_RECIPES = 255
_STOPPED, _PLAYING = 1, 2  # runtime_state
_POWER_OFF, _IDLE, _RUNNING = 3, 5, 7  # robot_mode
_MODES = {_POWER_OFF: "POWER_OFF", _IDLE: "IDLE", _RUNNING: "RUNNING"}


@dataclass(eq=False)
class Client:
    """One RTDE client: its recipes, and how often (ms) it wants data."""

    connection: ClientConnection
    outputs: list[str] = field(default_factory=list)
    inputs: list[list[str]] = field(default_factory=list)
    period: int = _CYCLE
    started: bool = False


class UrController(Service):
    """Serves a UR at `host`."""

    def __init__(self, cell: SimulatedCell, host: str) -> None:
        self.cell = cell
        hello = b"Connected: Universal Robots Dashboard Server\n"
        self._dashboard = ListeningPort(host, messages.DASHBOARD, hello)
        self._script = ListeningPort(host, messages.SCRIPT)
        self._rtde = ListeningPort(host, messages.RTDE)
        unused = messages.PRIMARY, messages.SECONDARY
        self._unused_ports = [ListeningPort(host, port) for port in unused]
        self._clients: dict[ClientConnection, Client] = {}
        self._values_sent: dict[str, float | Sequence[float]] = {}  # this millisecond's
        self._inputs: dict[str, float] = dict.fromkeys(messages.INPUTS, 0)
        self.frozen = False  # nothing gets through in either direction
        self.safety, self._mode = Safety.NORMAL, _RUNNING
        self._stopped_at = self._last_input_at = 0.0
        self._clock = 0.0
        self.nonsense = False  # whether to send NaN for joint speeds
        self._estimate, self._zero, self._wrench = np.zeros(6), np.zeros(6), np.zeros(6)
        self._program = self._new_program()
        self._program.running = False

    # The twin's loop.

    def receive(self) -> None:
        """Take what clients have sent; move the target on by a millisecond."""
        self._clock += DT
        if not self.frozen:
            self._poll_clients()
        program = self._program
        if program.running and self._clock - self._last_input_at > program.watchdog:
            program.end()
        if program.running and self.cell.steps % _CYCLE == 0:
            program.cycle()
        if program.running and program.activity is not None:
            q, dq = program.activity.step(self.cell.q_d, self.cell.dq_d)
            hardware = UR5E.hardware
            # Absurd speeds or NaN must not reach the physics either.
            if ((q >= hardware.lower) & (q <= hardware.upper) & (np.abs(dq) < _FASTEST)).all():
                self.cell.set_target(q, dq)
            else:
                self.protective_stop()

    def send(self) -> None:
        """Look for collisions after a millisecond, and send data that is due."""
        self._estimate_wrench()
        if self.safety is Safety.NORMAL and np.linalg.norm(self._wrench[:3]) > _FORCE_LIMIT:
            self.protective_stop()
            self.cell.give_way()
        if self.frozen:
            return
        self._values_sent.clear()
        for client in self._clients.values():
            if client.started and self.cell.steps % client.period == 0:
                client.connection.send(messages.package(Package.DATA, self._data(client)))

    def close(self) -> None:
        """Free the ports."""
        for listener in (self._dashboard, self._script, self._rtde, *self._unused_ports):
            listener.close()

    # Stops, from within and injected.

    def protective_stop(self) -> None:
        """Stop and hold; unlocked over the dashboard after 5 s."""
        self.safety, self._stopped_at = Safety.PROTECTIVE_STOP, self._clock
        self._program.end()

    def abort(self, error: str) -> None:
        """Stop for a fault; all of a UR's are protective stops."""
        if error != "protective_stop":
            raise UserError(f"a UR has no error {error!r}; ask for protective_stop")
        self.protective_stop()

    @property
    def driven(self) -> bool:
        """Whether a client's program moves the arm."""
        return self._program.running and bool(self._clients)

    def clear_error(self) -> None:
        """End a protective stop, as a person does at the pendant."""
        if self.safety is Safety.PROTECTIVE_STOP:
            self.safety = Safety.NORMAL

    def freeze(self, frozen: bool) -> None:
        """Block or unblock both directions."""
        self.frozen = frozen

    def stop_button(self, pressed: bool) -> None:
        """Press the emergency stop, which takes the power off, or release it."""
        self.safety = Safety.ROBOT_EMERGENCY_STOP if pressed else Safety.NORMAL
        if pressed:
            self._mode = _POWER_OFF
            self._program.end()

    def silence_gripper(self, silent: bool) -> None:
        """Raise UserError: the gripper is on a serial port."""
        raise UserError("this gripper is a serial device: unplug gripper")

    def drop(self) -> None:
        """Hang up on every RTDE client."""
        self._rtde.drop_all()

    # Clients.

    def _poll_clients(self) -> None:
        if self.cell.steps % _SELDOM == 0:
            self._poll_dashboard_and_script()
        connections = self._rtde.poll()
        self._clients = {c: self._clients.get(c) or Client(c) for c in connections}
        for connection, client in self._clients.items():
            try:
                packages, connection.unread = messages.split(connection.unread)
                for kind, payload in packages:
                    self._handle(client, kind, payload)
            except (ValueError, IndexError, OverflowError) as error:  # bytes that mean nothing
                print(f"an RTDE client was dropped: {error}")
                connection.close()

    def _poll_dashboard_and_script(self) -> None:
        for client in self._dashboard.poll():
            for line in client.lines():
                client.send(self._dashboard_answer(line).encode() + b"\n")
        for client in self._script.poll():
            text = client.unread.strip()
            if text.startswith(b"def") and text.endswith(b"end"):
                client.unread = b""
                self._play(text.decode(errors="replace"))
        for listener in self._unused_ports:
            for client in listener.poll():
                client.unread = b""

    def _handle(self, client: Client, kind: int, payload: bytes) -> None:
        def answer(body: bytes) -> None:
            client.connection.send(messages.package(Package(kind), body))

        if kind == Package.PROTOCOL_VERSION:
            answer(b"\x01" if payload == b"\x00\x02" else b"\x00")
        elif kind == Package.CONTROLLER_VERSION:
            answer(np.array(messages.VERSION, ">u4").tobytes())
        elif kind == Package.OUTPUTS:
            frequency = float(np.frombuffer(payload[:8], ">f8")[0])
            if not 0 <= frequency <= _FASTEST:
                raise messages.MalformedError(f"data at {frequency} Hz")
            client.period = max(_CYCLE, round(1000 / max(frequency, 1.0)))
            client.outputs, kinds = _recipe(payload[8:], messages.OUTPUTS)
            answer(b"\x01" + kinds)
        elif kind == Package.INPUTS:
            names, kinds = _recipe(payload, messages.INPUTS)
            if len(client.inputs) >= _MOST_RECIPES:
                raise messages.MalformedError("too many recipes")
            client.inputs.append(names)
            answer(bytes([len(client.inputs)]) + kinds)
        elif kind in (Package.START, Package.PAUSE):
            client.started = kind == Package.START
            answer(b"\x01")
        elif kind == Package.DATA and payload and 0 < payload[0] <= len(client.inputs):
            self._take_inputs(client.inputs[payload[0] - 1], payload[1:])

    def _take_inputs(self, names: list[str], payload: bytes) -> None:
        form = messages.layout(names, messages.INPUTS)
        if form.size != len(payload) or "external_force_torque" in names:
            return
        values = form.unpack(payload)
        if not np.isfinite(values).all():
            self.protective_stop()
            return
        self._inputs.update(zip(names, values, strict=True))
        self._last_input_at = self._clock
        if self._program.running:
            self._program.cycle()

    def _play(self, script: str) -> None:
        """Start ur-rtde's control program; refuse any other script."""
        name = re.match(r"def\s+(\w+)", script)
        if self.safety is Safety.NORMAL and self._mode == _RUNNING:
            self._program.end()
            self._program = self._new_program()
            self._program.running = name is not None and name[1] == "rtde_control"
            self._last_input_at = self._clock
            if not self._program.running:
                print("REFUSED: the twin runs no URScript of a client; protective stop", flush=True)
                self.protective_stop()
                self._program.ints[0] = DONE  # its client would wait 300 s; now its call raises

    def _new_program(self) -> UrProgram:
        return UrProgram(self.cell, self._inputs, self.protective_stop, self._zero_force)

    def _zero_force(self) -> None:
        self._zero = self._estimate.copy()

    def _dashboard_answer(self, line: str) -> str:
        safety = self.safety.name
        running = self._program.running
        answers = {
            "polyscopeversion": "URSoftware {}.{}.{}.{} (Jan 01 2026)".format(*messages.VERSION),
            "get serial number": "20265500001",
            "get robot model": "UR5",
            "is in remote control": "true",
            "robotmode": f"Robotmode: {_MODES[self._mode]}",
            "safetymode": f"Safetymode: {safety}",
            "safetystatus": f"Safetystatus: {safety}",
            "running": f"Program running: {str(running).lower()}",
            "programstate": "PLAYING rtde_control" if running else "STOPPED rtde_control",
            "quit": "Disconnected",
        }
        command = line.lower()
        if command in answers:
            return answers[command]
        if command == "stop":
            self._program.end()
            return "Stopped"
        if command == "unlock protective stop":
            if self.safety is Safety.PROTECTIVE_STOP:
                if self._clock - self._stopped_at < _UNLOCK_DELAY:
                    return "Cannot unlock protective stop until 5s after occurrence"
                self.safety = Safety.NORMAL
            return "Protective stop releasing"
        if command in ("power on", "power off", "brake release"):
            return self._power(command)
        return f"could not understand: '{line}'"

    def _power(self, command: str) -> str:
        if self.safety is Safety.NORMAL:
            modes = {"power on": _IDLE, "power off": _POWER_OFF, "brake release": _RUNNING}
            self._mode = modes[command]
            if self._mode != _RUNNING:
                self._program.end()
        return {"power on": "Powering on", "power off": "Powering off"}.get(
            command, "Brake releasing"
        )

    # Data.

    def _estimate_wrench(self) -> None:
        """Estimate the wrench on the TCP from joint torques, base frame, less the sensor's zero."""
        _, _, J = self.cell.kinematics(self.cell.q)
        known = np.linalg.solve(J @ J.T + 1e-8 * np.eye(6), J @ self.cell.tau_ext)
        self._estimate = known + self.cell.wrench_error
        self._wrench = self._estimate - self._zero

    def _data(self, client: Client) -> bytes:
        numbers: list[float] = []
        for name in client.outputs:
            value = self._values_sent.get(name)
            if value is None:
                value = self._values_sent[name] = self._value(name)
            numbers.extend(value if isinstance(value, Sequence) else [value])
        return b"\x01" + messages.layout(client.outputs, messages.OUTPUTS).pack(*numbers)

    def _value(self, name: str) -> float | Sequence[float]:
        program, cell = self._program, self.cell
        if name.startswith("output_int"):
            return program.ints[int(name.rpartition("_")[2])]
        if name.startswith("output_double"):
            return program.doubles[int(name.rpartition("_")[2])]
        if name in _VARIABLES:
            value = _VARIABLES[name](self, program, cell)
            return value.tolist() if isinstance(value, np.ndarray) else value
        size = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6}.get(messages.OUTPUTS[name])
        return 0 if size is None else [0] * size


_VARIABLES = {
    "actual_main_voltage": lambda c, p, cell: 48.0,
    "actual_robot_voltage": lambda c, p, cell: 48.0,
    "joint_mode": lambda c, p, cell: [255] * 6,  # running
    "joint_temperatures": lambda c, p, cell: [30.0] * 6,
    "timestamp": lambda c, p, cell: c._clock,
    "target_q": lambda c, p, cell: cell.q_d,
    "target_qd": lambda c, p, cell: cell.dq_d,
    "actual_q": lambda c, p, cell: cell.q,
    "actual_qd": lambda c, p, cell: np.full(6, np.nan) if c.nonsense else cell.dq,
    "target_moment": lambda c, p, cell: cell.joint_torque,
    "actual_TCP_pose": lambda c, p, cell: p.pose(cell.q),
    "target_TCP_pose": lambda c, p, cell: p.pose(cell.q_d),
    "actual_TCP_speed": lambda c, p, cell: cell.kinematics(cell.q)[2] @ cell.dq,
    "target_TCP_speed": lambda c, p, cell: cell.kinematics(cell.q_d)[2] @ cell.dq_d,
    "actual_TCP_force": lambda c, p, cell: c._wrench,
    "ft_raw_wrench": lambda c, p, cell: c._wrench,
    "tcp_force_scalar": lambda c, p, cell: float(np.linalg.norm(c._wrench[:3])),
    "runtime_state": lambda c, p, cell: _PLAYING if p.running else _STOPPED,
    "robot_mode": lambda c, p, cell: c._mode,
    "robot_status_bits": lambda c, p, cell: int(c._mode != _POWER_OFF) | p.running << 1,
    "safety_mode": lambda c, p, cell: int(c.safety),
    "safety_status": lambda c, p, cell: int(c.safety),
    "safety_status_bits": lambda c, p, cell: c.safety.bits,
    "speed_scaling": lambda c, p, cell: 1.0,
    "target_speed_fraction": lambda c, p, cell: 1.0,
}


def _recipe(payload: bytes, known: dict[str, str]) -> tuple[list[str], bytes]:
    """Return the known names of a recipe, and the kinds to answer with."""
    names = [name for name in payload.decode().split(",") if name]
    kinds = ",".join(known.get(name, "NOT_FOUND") for name in names)
    return [name for name in names if name in known], kinds.encode()
