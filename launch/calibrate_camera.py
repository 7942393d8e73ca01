"""Measure where a camera is: hand-eye calibration by a printed ChArUco board.

First print the board: touchgoal calibrate-camera --board board.png. For the wrist camera lay it on the
table, for the front camera fix it to the hand, flat. Take 15 views and more: change place and distance, and tilt by
20 degrees and more about two axes. The pose goes into the cell file, for the simulated arm (`--sim`).
"""

import json
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from pydantic import Field

from touchgoal.control.cell.config import CellConfig
from touchgoal.control.hand_eye.board import Board
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.option_types import Positive, checked_dataclass

if TYPE_CHECKING:
    from touchgoal.control.cell.connection import CellConnection
    from touchgoal.control.hand_eye.solve import HandEye, View

Side = Annotated[int, Field(ge=3, le=10)]


@checked_dataclass
class Config:
    """Options of calibrate-camera."""

    cell: Annotated[Path | None, tyro.conf.Positional] = None
    """Cell file with the camera; the result is written into it."""
    camera: Literal["front", "wrist"] = "front"
    """Camera: front stands beside the arm and sees the board in the hand, wrist is on the hand."""
    poses: Path | None = None
    """Let the arm move to these joint positions by itself: a JSON list of lists in rad, such as an
    earlier run's joints.json. Default: move it by hand (guiding, pendant) and press Enter at each view."""
    squares: tuple[Side, Side] = (8, 6)
    """Squares of the board across and down."""
    square_mm: Positive = 25.0
    """Side of a square, mm: measure it on the paper."""
    board: Path | None = None
    """Write the board to this PNG, print it at 100 %, and stop."""
    yes: bool = False
    """Do not ask for the typed confirmation before --poses moves the arm (for tests)."""
    out: Path | None = None
    """Folder of the run: views, joints.json, camera.json."""


def main(config: Config) -> None:
    """Print the board; or take views, calibrate, report and write the cell file."""
    board = Board(*config.squares, 1e-3 * config.square_mm)
    if config.board is not None:
        board.print_to(config.board)
        print(f"{config.board}: print it at 100 % and measure its squares for --square-mm")
    elif config.cell is None:
        raise UserError("give a cell file, or --board board.png to print a board")
    else:
        _calibrate(config, config.cell, board)


def _calibrate(config: Config, path: Path, board: Board) -> None:
    from touchgoal.control.cell.cell_file import read_cell_file
    from touchgoal.control.deployment.preflight import check_client
    from touchgoal.control.hand_eye.solve import calibrate_camera
    from touchgoal.launch.support.cell_run import confirm, connect
    from touchgoal.runtime.image_file import write_image
    from touchgoal.runtime.run_folder import open_run

    cell = read_cell_file(path)
    if config.camera not in cell.cameras:
        raise UserError(f"{path} has no [cameras.{config.camera}]")
    cell = replace(cell, cameras={config.camera: cell.cameras[config.camera]}, fingertips=None)
    check_client(cell)
    if config.poses is not None and not config.yes:
        confirm(cell)
    out = open_run(config.out, "calibrate-camera", config)
    with closing(connect(cell, new_episode=False)) as connection:
        views = list(_views(config, cell, connection, board))
    for i, view in enumerate(views):
        write_image(out / f"view_{i:02d}.png", view.image)
    write_json(out / "joints.json", [view.q.tolist() for view in views])
    result = calibrate_camera(views, connection.robot.arm, on_hand=config.camera == "wrist")
    _report(result, config, path, out, rows=views[0].image.shape[0])


def _views(
    config: Config, cell: CellConfig, connection: "CellConnection", board: Board
) -> "Iterator[View]":
    """Yield the views that show the board, and say of each how much of it."""
    from touchgoal.control import features as ft
    from touchgoal.control.hand_eye.solve import take_view

    count = 0
    places = _by_hand() if config.poses is None else _moved(config.poses, cell, connection)
    for _ in places:
        view = take_view(connection, ft.IMAGE_PREFIX + config.camera, board)
        if view.board is None:
            print(
                f"no board of {board.columns} x {board.rows} squares is seen: this view is left out"
            )
            continue
        count += 1
        old = " (a board drawn as before OpenCV 4.6)" if view.board.old_pattern else ""
        print(f"view {count}: {len(view.board.points)} corners{old}", flush=True)
        yield view


def _by_hand() -> Iterator[None]:
    """Wait for Enter before each view, until q."""
    if sys.stdin is None or not sys.stdin.isatty():
        raise UserError("nobody is there to move the arm: run it in a terminal, or give --poses")
    while input("Move, hold still, Enter takes a view; q and Enter: done > ").strip() != "q":
        yield


def _moved(poses: Path, cell: CellConfig, connection: "CellConnection") -> Iterator[None]:
    """Move the arm to each pose in turn; UserError if it was stopped on the way."""
    from touchgoal.control.deployment.control_loop import PLAN_ENDED
    from touchgoal.control.deployment.manual import ManualControl
    from touchgoal.control.deployment.terminal import HELP, Terminal

    goals = _read_poses(poses, connection.robot.arm.home.size)
    terminal = Terminal()
    control = ManualControl(cell, connection, terminal.operator_request, terminal.show_tick)
    with terminal.watching():
        print(f"MOVING: {HELP}", flush=True)
        for goal in goals:
            ending = control.move_arm(goal)
            if ending.reason != PLAN_ENDED:
                raise UserError(f"the arm did not arrive: {ending}")
            yield


def _read_poses(path: Path, n_joints: int) -> list[Any]:
    import numpy as np

    try:
        poses = np.array(json.loads(path.read_text()), np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise UserError(f"cannot read --poses {path}: {error}") from error
    if poses.ndim != 2 or poses.shape[1] != n_joints or not np.isfinite(poses).all():
        raise UserError(f"{path} must be a list of lists of {n_joints} joint positions, rad")
    return list(poses)


def _report(result: "HandEye", config: Config, cell_file: Path, out: Path, rows: int) -> None:
    import numpy as np

    from touchgoal.control.cell.cell_file import camera_lines, write_camera
    from touchgoal.control.deployment.observation import quaternion

    mm, degrees = 1e3 * result.position_errors, np.degrees(result.rotation_errors)
    closed = result.closed_form[:3, 3] - result.pose[:3, 3]
    square, camera = config.square_mm * result.square_scale, config.camera
    print(
        f"left out, each of {mm.size} views is missed by {mm.mean():.2f} mm and {degrees.mean():.3f} degrees on "
        f"average, by {mm.max():.2f} mm and {degrees.max():.3f} degrees at most; {result.pixel_error:.2f} px, "
        f"the arm's poses are off by {1e3 * result.arm_noise:.2f} mm\n"
        f"standard error of the camera: {1e3 * result.position_error:.2f} mm, "
        f"{np.degrees(result.rotation_error):.3f} degrees; the closed form puts it "
        f"{1e3 * np.linalg.norm(closed):.1f} mm away\n"
        f"squares of the board: {square:.2f} mm by the views (standard error "
        f"{config.square_mm * result.square_scale_error:.2f}), {config.square_mm:g} mm given"
    )
    pose = [*result.pose[:3, 3], *quaternion(result.pose[:3, :3])]
    values = {
        "pose": [round(float(value), 6) for value in pose],
        "fovy": round(float(np.degrees(2 * np.arctan(rows / 2 / result.lens.fy))), 3),
    }
    errors = {"left_out_mm": mm.tolist(), "left_out_degrees": degrees.tolist(), "square_mm": square}
    write_json(out / "camera.json", {"camera": camera, **values, **asdict(result.lens), **errors})
    write_camera(cell_file, camera, values)
    print(f"{camera_lines(values)}\nwritten to {cell_file}, [cameras.{camera}]")
