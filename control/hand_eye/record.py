"""Views of a board for a hand-eye calibration, taken while the arm is at rest."""

from dataclasses import dataclass

import numpy as np

from touchgoal.control.arrays import Image
from touchgoal.control.cell.connection import CellConnection
from touchgoal.control.hand_eye.board import Board, BoardView
from touchgoal.control.hand_eye.solve import HandEye, Transform, calibrate_hand_eye
from touchgoal.control.interfaces import Joints
from touchgoal.control.motion.arm_models import ArmModel
from touchgoal.control.motion.kinematics import Kinematics
from touchgoal.runtime.errors import UserError

_SETTLING = 0.5  # s after which an arm swings no more and images are newer than its motion
_REST = 0.01  # rad/s


@dataclass(frozen=True)
class View:
    """An image, the arm's measured joint positions (rad) in it, and the board if it is seen."""

    image: Image
    q: Joints
    board: BoardView | None


def take_view(connection: CellConnection, camera: str, board: Board) -> View:
    """Take a view by the connection's camera of that key; UserError if the arm moves."""
    clock = connection.clock
    clock.wait(clock.now() + _SETTLING)
    reading = connection.arm.read()
    image = connection.cameras[camera].read().image
    if np.abs(reading.velocity).max() > _REST:
        raise UserError("the arm moves: hold it still for a view")
    return View(image, reading.q, board.find(image))


def calibrate_camera(views: list[View], arm: ArmModel, on_hand: bool) -> HandEye:
    """Calibrate from the views that show the board; see `calibrate_hand_eye`."""
    kinematics = Kinematics(arm, 0.0)
    seen = [(view.board, _pose(kinematics, view.q)) for view in views if view.board is not None]
    rows, columns = views[0].image.shape[:2] if views else (0, 0)
    boards, poses = [board for board, _ in seen], [pose for _, pose in seen]
    return calibrate_hand_eye(boards, poses, (columns, rows), on_hand)


def _pose(kinematics: Kinematics, q: Joints) -> Transform:
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = kinematics.forward(q)
    return T
