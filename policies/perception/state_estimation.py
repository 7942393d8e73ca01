"""State estimation in pick-and-place: contact from touch, and the poses at the start from a camera.

A policy is trained on ground truth and acts on the estimates.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.policies.config import PoseEstimatorConfig
from touchgoal.policies.perception.pose_estimator import (
    Images,
    Look,
    Places,
    PoseEstimator,
    evenly_lit,
)
from touchgoal.policies.perception.target_words import WORDS_WIDTH, embed
from touchgoal.policies.perception.usual_view import UsualView
from touchgoal.runtime.errors import RefusedError, UserError
from touchgoal.sim_envs.config import CameraPlacement

ESTIMATOR_FORMAT = WeightsFormat(
    "estimator", "pose estimator", "train one with: touchgoal train-pose-estimator"
)
_FARTHEST = 4.0  # standard deviations of the hand's start in training
# m, between the network's places and those that the calibrated camera sees: a degree of a calibration's
# error is 16 mm.
_APART = 0.04
_PLACES = [0, 1, 5, 6]  # x and y of the object and of the goal in `features.TRUTH_START`
_YAW = slice(3, 5)  # cosine and sine of twice the grasp's yaw
_OBJECT = 5  # numbers of `features.TRUTH_START` on the object
_SHOW = "put objects and disc in view, and say which one is meant (--target)"
_ASKED = {  # and what to do
    "where the object is": _SHOW,
    "where the disc is": _SHOW,
    "how the object is turned": _SHOW,
    "which side is left": "it may be mirrored: let the camera send images as they are",
}
# m. The object has moved if two later estimates agree within the first distance and lie the second
# one away from the known place. A hand nearer than the third distance hides too much. Once the object
# seems back within the fourth distance of where it was, estimates from nearer than the fifth count no more.
_AGREE, _MOVED, _NEAREST, _BACK, _HIDES = 0.006, 0.014, 0.04, 0.008, 0.08
ESTIMATED = (ft.TRUTH_CONTACT, ft.TRUTH_START)


class StateEstimator:
    """Estimator of the columns `ESTIMATED`; it follows one episode after the other.

    Until the first touch it estimates at every tick, and follows an object that is moved.

    Attributes:
        cameras: columns of the camera images that it reads.
        camera_size: rows and columns of these.
        target: the object in words; "" if it is the only one.
        touches: whether a fingertip touched in the latest observation.
    """

    def __init__(
        self,
        pose_estimator: PoseEstimator,
        target: str = "",
        front_camera: CameraPlacement | None = None,
    ) -> None:
        """Use a network for inference.

        `front_camera` is where a calibrated camera stands; None if that is not known.
        """
        self.pose_estimator, self.target = pose_estimator, target
        self._views: dict[str, UsualView] = {}
        if front_camera is not None:
            usual, size = pose_estimator.config.front_camera, pose_estimator.config.size
            self._views[ft.FRONT] = UsualView(usual, front_camera, size)
        self.camera_size = pose_estimator.config.size
        self.cameras = tuple(key for key, _ in pose_estimator.config.crops)
        self._words = embed([target]) if target else torch.zeros(1, WORDS_WIDTH)
        self._first: Mapping[str, np.ndarray] | None = None
        self._scene, self._places = torch.empty(1, 0), Places()
        self._start = self._latest = np.empty(0, np.float32)
        self._contact: dict[str, ContactDetector] = {}
        self.touches = self._touched = self._misled = False
        self._before = np.empty(0)
        self._least = pose_estimator.config.sure

    def estimate(
        self, observation: Mapping[str, np.ndarray], first: Mapping[str, np.ndarray]
    ) -> dict[str, Float32[np.ndarray, " n"]]:
        """Return the contact of each pad (1 or 0), and the poses at the start.

        Observations come in order. The first one of an episode is without contact and shows the whole
        table. RefusedError: it does not show object and goal well enough.
        """
        if self._first is not first:
            self._begin(first)
        contact = [detector.update(observation[key]) for key, detector in self._contact.items()]
        self.touches = any(contact)
        self._touched |= self.touches
        away = np.linalg.norm(observation[ft.TCP_POSE][:3] - self._start[:3])
        nearest = _HIDES if self._misled else _NEAREST
        if not self._touched and observation is not first and away > nearest:
            self._look_again(observation)
        return {ft.TRUTH_CONTACT: np.array(contact, np.float32), ft.TRUTH_START: self._start}

    @torch.inference_mode()
    def _begin(self, first: Mapping[str, np.ndarray]) -> None:
        """Begin an episode: estimate its poses, store its untouched gels."""
        network, tcp = self.pose_estimator, torch.from_numpy(first[ft.TCP_POSE])[None]
        self._check_hand(tcp)
        images = self._images(first)
        view = self._views.get(ft.FRONT)
        shift = torch.zeros(1, 3) if view is None else torch.from_numpy(view.shift[None]).float()
        self._scene = network.scene(images, tcp, shift)
        look = network.look(images, self._words, self._scene)
        limit = network.config.misfit  # None: it knows no names
        if self.target and limit is not None:
            if network.misfit(*network.likeliest(images, self._words)).item() > limit:
                raise RefusedError(f"nothing here looks like '{self.target}': {self._seen(images)}")
        if look.turned.item() < self._least[2]:
            look = network.turned_surely(images, self._scene, look)
        sureness = look.sureness[0].tolist()
        for (what, remedy), sure, least in zip(_ASKED.items(), sureness, self._least, strict=True):
            if sure < least:
                raise RefusedError(
                    f"the camera does not show well {what} ({sure:.2f} sure, {least:.2f} needed): {remedy}"
                )
        if not self.target and limit is not None and len(network.seen(images)) > 1:
            raise RefusedError(f"several objects may be what is meant: {self._seen(images)}")
        self._places = look.places
        self._start = self._latest = _unit_yaw(look.start[0].numpy())
        self._check_camera(look, first)
        self._contact = {key: ContactDetector(Background(first[key][None])) for key in ft.TACTILE}
        self._first, self._touched, self._misled = first, False, False
        self._before = np.full(2, np.inf)  # where the object was before it moved

    def _seen(self, images: Images) -> str:
        names = ", ".join(self.pose_estimator.seen(images)) or "nothing that it knows"
        return f"it sees {names}: name one (--target)"

    @torch.inference_mode()
    def _look_again(self, observation: Mapping[str, np.ndarray]) -> None:
        """Replace the object's pose if two estimates agree that it moved.

        The camera's pose is taken from the first images, in which nothing moves.
        """
        seen = self._images(observation), self._words, self._scene
        look = self.pose_estimator.look(*seen, self._places)
        if np.less(look.sureness[0].numpy(), self._least).any():
            return
        now, before = _unit_yaw(look.start[0].numpy()), self._latest
        self._latest = now
        moved = np.linalg.norm(now[:2] - self._start[:2]) > _MOVED
        if moved and np.linalg.norm(now[:2] - before[:2]) < _AGREE:
            object_ = _unit_yaw((now + before) / 2)[:_OBJECT]
            self._misled |= bool(np.linalg.norm(object_[:2] - self._before) < _BACK)
            self._before = self._start[:2]
            self._start = np.concatenate([object_, self._start[_OBJECT:]])
            self._places = look.places

    def _check_camera(self, look: Look, first: Mapping[str, np.ndarray]) -> None:
        """Refuse a first look at the edge of the image, or that the calibrated camera sees elsewhere."""
        if (view := self._views.get(ft.FRONT)) is None:
            return
        seen = look.places[ft.FRONT][0].numpy().astype(np.float64)
        if not all(view.shows(place, first[ft.FRONT]) for place in seen):
            raise RefusedError(
                "object or disc lie at the edge of what the camera sees: turn it so that all of the "
                "table is in view, and calibrate it anew (calibrate-camera)"
            )
        heights = float(look.start[0, 2]), 0.0
        projected = [view.place(*pair) for pair in zip(seen, heights, strict=True)]
        apart = np.array(projected, np.float32) - self._start[_PLACES].reshape(2, 2)
        if (far := np.linalg.norm(apart, axis=1).max()) > _APART:
            raise RefusedError(
                f"object or disc are {1e3 * far:.0f} mm from where the calibrated camera sees them: "
                "calibrate it anew (calibrate-camera), and put nothing else in view"
            )

    def _check_hand(self, tcp: Float32[Tensor, "1 7"]) -> None:
        """Refuse a start outside the training's hand poses, which would look like a moved camera."""
        away = self.pose_estimator.tcp_normalizer(tcp)[0, :3]
        if away.abs().max() > _FARTHEST:
            usual = self.pose_estimator.tcp_normalizer.inverse(torch.zeros(7))[:3].tolist()
            x, y, z = (round(v, 2) + 0.0 for v in usual)  # -0.0 becomes 0.0
            raise UserError(
                f"the policy must start with the hand near ({x}, {y}, {z}) m, where its pose "
                "estimator was trained: move it there (task.start of a cell file)"
            )

    def _images(self, observation: Mapping[str, np.ndarray]) -> Images:
        """Return the evenly lit images of an observation."""
        images = {}
        for key in self.cameras:
            image, size = observation[key], self.camera_size
            if key in self._views:
                image = self._views[key](image)
            if image.shape[:2] != size:
                given, wanted = (f"{y} x {x}" for y, x in (image.shape[:2], size))
                raise UserError(
                    f"{key} is {given}, the policy was trained on {wanted}: make the environment "
                    "with load_policy(...).env_config(), or set camera_size"
                )
            images[key] = torch.from_numpy(image)[None]
        return evenly_lit(images)


def _unit_yaw(start: Float32[np.ndarray, "7"]) -> Float32[np.ndarray, "7"]:
    """Return `features.TRUTH_START` as a policy knows it, with a yaw of length 1."""
    unit = start.copy()
    unit[_YAW] /= max(float(np.linalg.norm(unit[_YAW])), 1e-6)
    return unit


def load_pose_estimator(directory: Path) -> PoseEstimator:
    """Read a pose estimator for inference; UserError: nothing there, or damaged."""
    network = PoseEstimator(ESTIMATOR_FORMAT.read_config(directory, PoseEstimatorConfig))
    ESTIMATOR_FORMAT.load_weights(network, directory)
    return network
