"""The twin: one loop of all wire services and the physics, 1 ms at a time."""

import os
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from touchgoal.control.cell.config import (
    CameraName,
    CameraSection,
    CellConfig,
    FingertipsSection,
    GripperSection,
    SafetySection,
    TaskSection,
    ToolSection,
)
from touchgoal.control.sensors.load_cell import LoadCellConfig
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.cell.simulated_cell import DT, SimulatedCell
from touchgoal.sim_envs.config import TaskConfig
from touchgoal.sim_envs.tactile.rig.press_bench import warm_up
from touchgoal.sim_envs.tasks import make_env
from touchgoal.sim_envs.twin.control_port import ControlPort
from touchgoal.sim_envs.twin.franka.controller import FrankaArm
from touchgoal.sim_envs.twin.franka.hand import FrankaHand
from touchgoal.sim_envs.twin.images import CAMERA_RATE, Images
from touchgoal.sim_envs.twin.lock_step import LockStep
from touchgoal.sim_envs.twin.serial import devices as serial_ports
from touchgoal.sim_envs.twin.tcp_ports import Service
from touchgoal.sim_envs.twin.ur.controller import UrController

_MAX_BACKLOG = 0.1  # s behind real time beyond which the twin stops trying to catch up
# s to wait for a client that drives the arm. In lock-step for as long as a loaded machine needs; in
# real time about as long as a busy one stalls.
_LOCK_STEP_TIMEOUT, _CLIENT_TIMEOUT = 2.0, 0.1
_RUN_SECONDS = 40.0


@dataclass(frozen=True)
class TwinConfig:
    """Options of a twin."""

    task: TaskConfig  # task of the cell; its `arm` is replaced by `arm`
    arm: Literal["fr3", "ur5e"]  # FR3 with the Franka Hand, or UR5e with a Robotiq
    seed: int
    host: str  # loopback address of everything; twins at different ones run side by side
    port: int  # image port; the next one is the control port. 0: any that are free
    lock_step: bool  # wait for the client that drives the arm, so that runs repeat
    folder: Path  # where serial devices appear
    wrench_error: bool = True  # the arm's estimate of force is as wrong as a real arm's


class Twin:
    """The cell with its services, in one thread.

    In lock-step it waits for the client that drives the arm or holds the time (`lock_step.py`).
    """

    def __init__(self, config: TwinConfig) -> None:
        env = make_env(replace(config.task, arm=config.arm))
        self.cell = SimulatedCell(env, config.seed, config.wrench_error)
        if env.config.tactile:
            warm_up(env.bodies, env.sensor)  # else a client loses the arm while code is loaded
        self._lock_step: LockStep | None = None
        self._next_step_at = time.monotonic()
        self.stopped = False  # set it to end `run`
        self.parent: int | None = None  # process with which `run` ends, too
        self.pace = Pace()
        self._services: list[Service] = []
        with ExitStack() as undo:
            undo.callback(self.close)
            try:
                self.cell_config = self._open(config)  # content of the cell file
            except OSError as error:
                raise UserError(
                    f"cannot serve at {config.host} ({error.strerror}): give an address of this "
                    "computer at which no other twin is, such as --host 127.0.0.2"
                ) from error
            undo.pop_all()

    def run(self) -> None:
        """Serve until `stopped`, or until the parent has ended."""
        while not self.stopped and self.parent in (None, os.getppid()):
            self.step()

    def step(self) -> None:
        """Advance everything by a millisecond, unless time stands."""
        lock_step = self._lock_step
        if lock_step is not None and lock_step.standing:
            lock_step.wait(self._commands.sockets)
            for service in self._services:
                service.hold()
            return
        for service in self._services:
            service.receive()
        self.cell.step()
        for service in self._services:
            service.send()
        self.pace.count_step(self._arm.driven, self.images.processor_time)
        if lock_step is not None and lock_step.held:
            lock_step.count_step()
        else:
            self._keep_pace()

    def close(self) -> None:
        """Free ports, files and the OpenGL contexts."""
        for service in self._services:
            service.close()
        self.cell.env.close()

    def _keep_pace(self) -> None:
        now = time.monotonic()
        allowed = 0.0 if self.cell_config.lock_step else _MAX_BACKLOG
        self._next_step_at = max(self._next_step_at + DT, now - allowed)
        if self._next_step_at > now:
            time.sleep(self._next_step_at - now)

    def _open(self, config: TwinConfig) -> CellConfig:
        cell, host, folder = self.cell, config.host, config.folder
        folder.mkdir(parents=True, exist_ok=True)
        services = self._services
        services.append(load_cell := serial_ports.LoadCell(cell, folder / "load_cell"))
        ports = {"load_cell": load_cell.port}
        force = cell.env.grasp_force  # N, grasp force of the episode
        hand = None
        if config.arm == "fr3":
            timeout = _LOCK_STEP_TIMEOUT if config.lock_step else _CLIENT_TIMEOUT
            services.append(hand := FrankaHand(cell, host))
            # First, so that the arm's client works while the others are served.
            services.insert(0, arm := FrankaArm(cell, host, timeout, hand.link))
            gripper = GripperSection("franka_hand", address=host, force=force)
        else:
            services.append(arm := UrController(cell, host))
            services.append(robotiq := serial_ports.Robotiq(cell, folder / "gripper"))
            ports["gripper"] = robotiq.port
            tool = cell.env.robot.tool
            gripper = GripperSection(
                "robotiq",
                port=str(robotiq.port.path),
                widths=(tool.stroke[1], tool.stroke[0]),
                force=max(force, tool.force[0]),
            )
        self.images = images = Images(cell, host, config.port)
        services.append(images)
        control = config.port + 1 if config.port else 0

        def reset() -> None:
            images.reset()
            load_cell.reset()
            if hand is not None:
                hand.reset()

        if config.lock_step:
            assert hand is not None and isinstance(arm, FrankaArm)
            self._lock_step = LockStep(cell, arm, hand, images, load_cell)
        self._arm = arm
        self._commands = ControlPort(
            cell, arm, images, ports, host, control, self._lock_step, reset
        )
        services.append(self._commands)
        return self._describe(config, gripper, str(load_cell.port.path))

    def _describe(self, config: TwinConfig, gripper: GripperSection, load_cell: str) -> CellConfig:
        """Return the cell file; the link of a lock-step twin may be silent for longer."""
        env, streams = self.cell.env, self.images.addresses()
        cameras: dict[CameraName, CameraSection] = {
            name: CameraSection(streams[name], CAMERA_RATE)
            for name in get_args(CameraName)
            if name in streams
        }
        fingertips = None
        if "tactile_left" in streams:
            sides = streams["tactile_left"], streams["tactile_right"]
            fingertips = FingertipsSection(config.task.sensor, *sides)
        limits, maze = env.robot, isinstance(env, BeadMaze)
        tool = limits.tool
        return CellConfig(
            arm=config.arm,
            address=config.host,
            gripper=gripper,
            task=TaskSection(
                name="bead-maze" if maze else "pick-place",
                policy="shipped" if maze else "expert",
                instruction=env.instruction(),
                seconds=_RUN_SECONDS,
                twin=self._commands.address,
                seed=config.seed,
                objects=() if maze else (env.bodies[0].kind.name,),
                wires=(env.wire.name,) if isinstance(env, BeadMaze) else (),
            ),
            tool=ToolSection(
                tool.tcp_offset, tool.mass, tool.centre_of_mass, tuple(tool.finger_corners)
            ),
            fingertips=fingertips,
            cameras=cameras,
            load_cell=LoadCellConfig(load_cell, serial_ports.NEWTONS_PER_COUNT, serial_ports.ZERO),
            safety=SafetySection(
                # Objects are grasped 2 mm above the table, which a simulated table survives.
                fingertips_lower=(*limits.fingertips.lower[:2].tolist(), 0.0),
                state_timeout=_LOCK_STEP_TIMEOUT if config.lock_step else None,
            ),
            lock_step=config.lock_step,
        )


_BLOCK = 1000  # ms that are measured together


class Pace:
    """Counts simulated seconds in which a client drives the arm."""

    def __init__(self) -> None:
        self._seconds: list[np.ndarray] = []  # s: wall, the twin's processor, its images' process
        self._began: np.ndarray | None = None
        self._steps = 0

    def count_step(self, driven: bool, images: float) -> None:
        """Count a millisecond; `images`: processor s that their process has taken so far."""
        if not driven:
            self._began = None
            return
        self._steps += 1
        if self._began is not None and self._steps < _BLOCK:
            return
        now = np.array([time.monotonic(), time.process_time(), images])
        if self._began is not None:
            self._seconds.append((now - self._began) / (1e-3 * _BLOCK))
        self._began, self._steps = now, 0

    def summary(self) -> dict[str, float]:
        """Return figures of the counted seconds."""
        if not self._seconds:
            return {"seconds": 0}
        wall, twin, images = np.transpose(self._seconds)
        return {
            "seconds": len(self._seconds),
            "pace_median": float(np.median(1 / wall)),
            "pace_slowest": float(1 / wall.max()),
            "processor_twin": float(np.median(twin)),
            "processor_pictures": float(np.median(images)),
        }
