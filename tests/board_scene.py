"""The simulated cell with a ChArUco board in it: on the table, or held by the hand."""

import cv2
import mujoco
import numpy as np

from touchgoal.control.hand_eye.board import Board
from touchgoal.control.motion.rotations import fingers_down, rotation_matrix
from touchgoal.control.safety.limits import FR3
from touchgoal.sim_envs.scene.build import arm_joints, build
from touchgoal.sim_envs.scene.rendering import open_renderer

BOARD = Board(8, 6, 0.025)
_THICKNESS = 0.002  # m
_PIXELS_PER_METRE = 8000


def add_board(spec: mujoco.MjSpec, held: bool, board: Board = BOARD) -> None:
    """A thin plate whose upper side shows the board; no contact."""
    image = np.pad(board.draw(_PIXELS_PER_METRE), 8, constant_values=255)
    rows, columns = image.shape
    texture = spec.add_texture(
        name="board", type=mujoco.mjtTexture.mjTEXTURE_2D, width=columns, height=rows, nchannel=3
    )
    texture.data = np.repeat(image[..., None], 3, axis=2).tobytes()
    material = spec.add_material(name="board", specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "board"
    width, height = (side / _PIXELS_PER_METRE for side in (columns, rows))
    body = (spec.body("hand") if held else spec.worldbody).add_body(name="board")
    body.pos = np.array([0.0, 0.0, 0.16] if held else [0.45, 0.0, 0.003])
    body.quat = np.full(4, 0.5) if held else np.array([1.0, 0.0, 0.0, 0.0])
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[width / 2, height / 2, _THICKNESS / 2],
        material="board",
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=1,
    )


class BoardScene:
    """Camera images of the board at any posture of the arm, and the camera's true pose."""

    def __init__(self, camera: str, rows: int, columns: int) -> None:
        self.on_hand, self._camera = camera == "wrist", camera
        spec = build([])
        add_board(spec, held=not self.on_hand)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        for i in (1, 2):
            self._data.joint(f"finger_joint{i}").qpos = 0.04
        self._renderer = open_renderer(self._model, rows, columns)

    def image(self, q: np.ndarray) -> np.ndarray:
        """RGB, as a twin's stream shows it: through JPEG."""
        for name, value in zip(arm_joints("fr3"), q, strict=True):
            self._data.joint(name).qpos = value
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        bgr = np.ascontiguousarray(self._renderer.render()[..., ::-1])
        jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
        seen = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        assert seen is not None
        return np.ascontiguousarray(seen[..., ::-1])

    def true_pose(self) -> np.ndarray:
        """OpenCV's camera frame in the hand's frame (wrist) or the base's (front), by MuJoCo."""
        data, T = self._data, np.eye(4)
        camera, hand = data.camera(self._camera), data.body("hand")
        T[:3, :3] = camera.xmat.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
        T[:3, 3] = camera.xpos
        if self.on_hand:
            R = hand.xmat.reshape(3, 3)
            T[:3, :3], T[:3, 3] = R.T @ T[:3, :3], R.T @ (T[:3, 3] - hand.xpos)
        return T

    def close(self) -> None:
        self._renderer.close()


def postures(scene: BoardScene, n: int, seed: int) -> list[np.ndarray]:
    """Postures (rad) that show most of the board: places 0.2 m apart, tilted by up to 35 degrees."""
    kinematics, rng = FR3.kinematics(), np.random.default_rng(seed)
    middle = np.array([0.40, 0.0, 0.25] if scene.on_hand else [0.55, 0.0, 0.32])
    found: list[np.ndarray] = []
    while len(found) < n:
        tilt = rotation_matrix(rng.uniform(-0.45, 0.45, 3))
        place = middle + rng.uniform(-1, 1, 3) * (
            [0.1, 0.1, 0.1] if scene.on_hand else [0.18, 0.15, 0.15]
        )
        solution = kinematics.solve_ik_near(place, tilt @ fingers_down(0.0), FR3.arm.home)
        view = BOARD.find(scene.image(solution.q)) if solution.reached else None
        if view is not None and len(view.points) > 15:
            found.append(solution.q)
    return found
