"""A cell of fake devices that do as they are commanded, to test the control loop; a cell file."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from touchgoal.control import features as ft
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.deployment.control_loop import ControlLoop, Ending
from touchgoal.control.interfaces import Actor, ArmReading, Cost, Frame, GripperReading, LoadReading
from touchgoal.control.run_log import RunLog
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI

SIM = """
arm = "sim"
gripper = { kind = "franka_hand" }
cameras.front = { source = "simulated" }
task = { name = "pick-place", policy = "expert", objects = ["wooden_block"], seed = 3 }
"""


def write_cell_file(folder: Path, text: str) -> Path:
    path = folder / "cell.toml"
    path.write_text(text)
    return path


@dataclass
class FakeClock:
    """A clock that jumps to the time that is waited for."""

    time: float = 0.0

    def now(self) -> float:
        return self.time

    def age(self, stamp: float) -> float:
        return self.time - stamp

    def wait(self, until: float) -> None:
        self.time = max(self.time, until)


@dataclass
class FakeArm:
    """An arm that is at once where it is commanded."""

    clock: FakeClock
    reading: ArmReading = field(
        default_factory=lambda: ArmReading(
            FR3.arm.home, np.zeros(7), np.zeros(6), np.zeros(7), "", 0.0, 0.0
        )
    )
    stopped: bool = False

    def read(self) -> ArmReading:
        return replace(self.reading, stamp=self.clock.time, time=self.clock.time)

    def command(self, q: np.ndarray) -> None:
        self.reading = replace(self.reading, q=q)

    def stop(self) -> None:
        self.stopped = True

    def close(self) -> None: ...


@dataclass
class FakeGripper:
    """A gripper that records its commands; it `follows` them to an object of 40 mm, or stands still."""

    clock: FakeClock
    reading: GripperReading = field(default_factory=lambda: GripperReading(0.04, False, "", 0.0))
    silent_from: float = np.inf
    follows: bool = False
    commands: list[str] = field(default_factory=list)

    def read(self) -> GripperReading:
        return replace(self.reading, stamp=min(self.clock.time, self.silent_from))

    def command(self, width: float) -> None:
        self.commands.append(f"{width:.3f}")
        if self.follows:
            self.reading = replace(self.reading, width=max(width, 0.04), grasped=width < 0.04)

    def stop(self, release_to: float | None = None) -> None:
        self.commands.append("stop" if release_to is None else f"open to {release_to:.3f}")

    def close(self) -> None: ...


@dataclass
class FakeCamera:
    """A camera that shows one image, new each time and `late` (s)."""

    clock: FakeClock
    image: np.ndarray
    rate: float = 30.0
    problem: str = ""
    late: float = 0.0

    def read(self) -> Frame:
        return Frame(self.image, round(1000 * self.clock.time), self.clock.time - self.late)

    def close(self) -> None: ...


class FakeFingertip(FakeCamera):
    """A fingertip that nothing touches: one frame for ever, always new."""

    model = GELSIGHT_MINI

    def __init__(self, clock: FakeClock) -> None:
        super().__init__(clock, load(self.model.sensor_file).background)

    def read(self) -> Frame:
        return Frame(self.image, 0, self.clock.time)


@dataclass
class FakeLoadCell:
    """A load cell that reads one force (N)."""

    clock: FakeClock
    force: float = 0.0

    def read(self) -> LoadReading:
        return LoadReading(self.force, 0, self.clock.time)

    def close(self) -> None: ...


class KeptTicks(list):
    """A recorder that keeps the ticks."""

    def add(self, tick: dict) -> None:
        self.append(tick)

    def save(self, task: str, meta: dict) -> int:
        return 0

    def close(self) -> None: ...


class FakeCell:
    """Fake devices, and a run of the control loop on them.

    Attributes:
        log, rows: figures and ticks of the last run.
    """

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.arm, self.gripper = FakeArm(self.clock), FakeGripper(self.clock)
        self.load_cell: FakeLoadCell | None = None
        self.cameras: dict = {}
        self.log, self.rows = RunLog(), KeptTicks()

    def connection(self) -> CellConnection:
        return CellConnection(FR3, self.arm, self.gripper, self.cameras, self.load_cell, self.clock)

    def run(
        self,
        each_tick: Callable[[int], None],
        step: float = 0.0,
        width: float = 0.04,
        seconds: float = 5.0,
        execute: bool = True,
        log: RunLog | None = None,
        cost: Cost | None = None,
        actor: Actor | None = None,
    ) -> Ending:
        """`each_tick` gets the number of the tick before the actor acts in it.

        Args:
            step: rad that the first joint is to go each tick.
            width: m asked of the gripper, which stands at 0.04 m: closer, it does not follow.
            seconds: after which it ends.
            execute: False: a dry run.
            log: in place of one that keeps the ticks in `rows`.
            actor: in place of the one described.
        """
        safety = ActionFilter(FR3, ft.CONTROL_HZ)
        loop = ControlLoop(self.connection(), safety, execute, lambda: "", lambda _: None, cost)
        self.rows = KeptTicks()
        self.log = log or RunLog(self.rows.add)

        class Moves(Actor):
            ticks = 0

            def act(self, observation: dict) -> np.ndarray:
                self.ticks += 1
                each_tick(self.ticks)
                return np.array([step, *[0.0] * 6, width])

        return loop.run(actor or Moves(), seconds, self.log)
