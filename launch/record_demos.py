"""Record demonstrations by teleoperation: the arm is led by a SpaceMouse or by keys, with deploy's safety.

Between two demonstrations the arm may be led without a record, to put the scene back: Enter begins the
next one, q ends. In a demonstration Enter ends it as a success, n as a failure, q discards it. A stopped
arm ends the command; start it again with the same --out to go on. Exit status: 0, or 4 if it was stopped.
"""

import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from touchgoal.control.features import CONTROL_HZ
from touchgoal.control.teleoperation.device import DeviceName, TeleoperationConfig
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Count, Seed, checked_dataclass

if TYPE_CHECKING:
    from touchgoal.control.cell.config import CellConfig
    from touchgoal.control.cell.connection import CellConnection
    from touchgoal.control.deployment.control_loop import Ending
    from touchgoal.control.deployment.session import Result
    from touchgoal.control.safety.action_filter import ActionFilter
    from touchgoal.control.teleoperation.device import TeleoperationDevice

STOPPED = 4  # exit status
_LONGEST_PAUSE = 3600.0  # s between two demonstrations
_CAMERA_SIZE = 256, 256  # rows and columns of the recorded camera images, px
_SETTLE_TIME = 0.5  # s for which the arm comes to rest before a demonstration


@checked_dataclass
class Config:
    """Options of record-demos."""

    cell: Annotated[Path, tyro.conf.Positional]
    """Cell file: your own (.toml), the cell.json of a twin, or a shipped example by name, such as sim."""
    device: DeviceName = "keyboard"
    """What leads the arm: keyboard, spacemouse, or scripted, which picks and places where a simulator
    says, for rehearsals without a person."""
    task: str = ""
    """Name of a task of your own, in place of the cell file's."""
    episodes: Count = 50
    """Number of demonstrations to record; discarded ones do not count."""
    sim: bool = False
    """Use a simulated arm in place of the cell file's."""
    seed: Seed | None = None
    """Random seed of the first scene, in place of the cell file's; each further one adds one (simulated
    arm or twin only)."""
    hand: TeleoperationConfig = TeleoperationConfig()
    """Response of the hand to the device."""
    yes: bool = False
    """Do not ask for a touch of each fingertip and the typed confirmation (for tests)."""
    out: Path | None = None
    """Folder of the run; the episodes go to its `episodes/`, after those already there."""


def main(config: Config) -> None:
    """Record one demonstration after the other; each begins with deploy's checks."""
    from touchgoal.control.cell.cell_file import find_cell_file, read_cell_file
    from touchgoal.control.deployment.control_loop import DISCARDED, STOPPED_BY_OPERATOR, Ending
    from touchgoal.control.deployment.preflight import check_client
    from touchgoal.control.deployment.session import metrics, report
    from touchgoal.control.deployment.terminal import say
    from touchgoal.launch.support.cell_run import check_cell, confirm, connect
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.run_folder import open_run

    file = find_cell_file(config.cell)
    cell = read_cell_file(file, config.device, config.sim, config.seed, config.task)
    if config.device != "scripted" and (sys.stdin is None or not sys.stdin.isatty()):
        raise UserError("nobody is there to lead the arm: run it in a terminal")
    check_client(cell)
    out = open_run(config.out, "record-demos", config, adds=True)
    numbers, ending, confirmed = [], Ending("begins", done=True), config.yes
    while len(numbers) < config.episodes:
        print(f"\n{cell.task.name}: {len(numbers) + 1} of {config.episodes}", flush=True)
        with closing(connect(cell)) as connection:
            safety = check_cell(cell, connection, out / "episodes")
            if not confirmed:
                confirm(cell, connection)
                confirmed = True
            if config.device != "scripted":
                ending = _put_back(config, connection, safety)
                if not ending.done:
                    break
            result = _record(config, cell, connection, safety, out / "episodes")
        ending = result.ending
        if ending.reason != DISCARDED:
            numbers.append(metrics(result))
        say(report(result, metrics(result), str(out / "episodes")))
        if ending.stopped and (not cell.moves_nothing_real or ending.reason == STOPPED_BY_OPERATOR):
            break
        if cell.moves_nothing_real:
            cell = replace(cell, task=replace(cell.task, seed=cell.task.seed + 1))
    write_json(out / "metrics.json", {"episodes": numbers})
    done = sum(row["success"] is True for row in numbers)
    say(f"{len(numbers)} demonstrations recorded, {done} successes: {out / 'episodes'}")
    if ending.stopped:
        print(f"touchgoal record-demos: {ending}", file=sys.stderr)
        sys.exit(STOPPED)


def _put_back(config: Config, connection: "CellConnection", safety: "ActionFilter") -> "Ending":
    """Let a person lead the arm without a record; the ending is `done` once they are ready."""
    from touchgoal.control.deployment.control_loop import ControlLoop
    from touchgoal.control.deployment.terminal import Terminal
    from touchgoal.control.run_log import RunLog
    from touchgoal.control.teleoperation.teleoperator import Teleoperator

    with closing(_open_device(config, connection, 0)) as device:
        terminal = Terminal(device.press)
        request, show = terminal.operator_request, terminal.show_tick
        loop = ControlLoop(connection, safety, True, request, show)
        actor = Teleoperator(device, safety, loop.commanded, config.hand)
        with terminal.watching():
            print("put the scene back; Enter begins, q ends, space stops the arm", flush=True)
            ending = loop.run(actor, _LONGEST_PAUSE, RunLog())
    if ending.done:
        connection.clock.wait(connection.clock.now() + _SETTLE_TIME)
    return ending


def _record(
    config: Config,
    cell: "CellConfig",
    connection: "CellConnection",
    safety: "ActionFilter",
    episodes: Path,
) -> "Result":
    from touchgoal.control.deployment.session import Session
    from touchgoal.control.deployment.terminal import RECORDING_HELP, Terminal
    from touchgoal.control.teleoperation.device import KEYS
    from touchgoal.control.teleoperation.teleoperator import Teleoperator
    from touchgoal.episodes.episode_recorder import EpisodeRecorder

    with closing(_open_device(config, connection, cell.task.seed)) as device:
        terminal = Terminal(device.press)
        session = Session(
            cell=cell,
            connection=connection,
            safety=safety,
            recorder=EpisodeRecorder(episodes, CONTROL_HZ),
            execute=True,
            make_actor=lambda loop: Teleoperator(device, safety, loop.commanded, config.hand),
            operator_request=lambda: terminal.operator_request() or device.verdict,
            on_tick=terminal.show_tick,
            camera_size=_CAMERA_SIZE,
        )
        with terminal.watching():
            keys = f"\n{KEYS}" if config.device == "keyboard" else ""
            print(f"RECORDING: {RECORDING_HELP}{keys}", flush=True)
            return session.run()


def _open_device(config: Config, connection: "CellConnection", seed: int) -> "TeleoperationDevice":
    """Return the device, at rest; UserError if there is none. `seed` is that of a script's errors."""
    from touchgoal.control.deployment.scripted import PickPlacePoses
    from touchgoal.control.teleoperation.device import KeyboardDevice
    from touchgoal.control.teleoperation.scripted_device import ScriptedDevice
    from touchgoal.control.teleoperation.spacemouse import SpaceMouse

    if config.device == "keyboard":
        return KeyboardDevice(CONTROL_HZ)
    if config.device == "spacemouse":
        return SpaceMouse()
    layout = connection.truth()["layout"] if connection.truth else {}
    if "grasp" not in layout:
        raise UserError("the scripted device needs a simulated scene of pick-place")
    poses = PickPlacePoses(tuple(layout["grasp"]), tuple(layout["goal"]))
    return ScriptedDevice(poses, seed)
