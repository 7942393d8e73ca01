"""The process that renders and serves a twin's images, so that physics does not wait for it.

It follows the physics by its state, spoils its streams on request, and ends when the twin closes its end
of the pipe.
"""

import signal
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection

import mujoco
import numpy as np
from jaxtyping import Float

from touchgoal.control import features as ft
from touchgoal.control.arrays import Image
from touchgoal.control.sensors import live_image
from touchgoal.sim_envs.scene.contacts import PadContact
from touchgoal.sim_envs.scene.rendering import Renderer, open_renderer
from touchgoal.sim_envs.tactile.pad import TactilePad

_JPEG_HEADER = 640  # bytes of OpenCV's
_SENDING_TIMEOUT = 2.0  # s


@dataclass(eq=False)
class Stream(live_image.Stream):
    """One stream of images, as a camera sends them that may fail."""

    # stalled, frozen, lost, broken, halved: until when (time.monotonic) nothing comes, one image
    # repeats, clients are cut off and turned away, JPEGs have wrong bytes or are cut in half
    stalled: float = 0.0
    frozen: float = 0.0
    lost: float = 0.0
    broken: float = 0.0
    halved: float = 0.0

    @property
    def has_viewers(self) -> bool:
        """Whether a client would get an image."""
        return self.clients > 0 and time.monotonic() >= self.stalled

    def publish(self, image: Image) -> None:
        """Publish an image to all clients."""
        frozen = self.image if time.monotonic() < self.frozen else None
        super().publish(image if frozen is None else frozen)

    def wait_until_sent(self) -> None:
        """Wait until the last image is on its way to its clients."""
        with self.condition:
            self.condition.wait_for(
                lambda: self.sent >= self.count or not self.clients, _SENDING_TIMEOUT
            )

    def encode(self, image: Image) -> bytes:
        """Return an image as a JPEG, spoilt as long as it is asked for."""
        jpeg, now = super().encode(image), time.monotonic()
        if now < self.halved:
            return jpeg[: len(jpeg) // 2]
        return _with_random_bytes(jpeg) if now < self.broken else jpeg

    def is_open(self) -> bool:
        """Return whether clients are served."""
        return super().is_open() and time.monotonic() >= self.lost


def _with_random_bytes(jpeg: bytes) -> bytes:
    rng, damaged = np.random.default_rng(), np.frombuffer(jpeg, np.uint8).copy()
    places = rng.integers(_JPEG_HEADER, len(jpeg) - 2, 20)
    damaged[places] = rng.integers(0, 256, 20)
    return damaged.tobytes()


STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # everything that an image depends on
_CAMERA_NOISE = 1.5  # counts: lets a driver tell a still scene from a frozen camera
_TACTILE = [key.removeprefix(ft.IMAGE_PREFIX) for key in ft.TACTILE]


@dataclass(frozen=True)
class Scene:
    """Scene to render from now on."""

    model: mujoco.MjModel
    camera_size: tuple[int, int]  # rows and columns, px
    pads: list[TactilePad]  # left and right fingertip; empty without them
    rng: np.random.Generator  # draws the fingertips' noise


@dataclass(frozen=True)
class RenderRequest:
    """Images to render, and the state to render them from."""

    due: tuple[str, ...]  # names of the streams that are to have one
    state: Float[np.ndarray, " n"]  # physics state (`STATE`)
    contacts: tuple[PadContact, PadContact]  # left and right pad
    held: bool  # whether to answer only once the images are sent


Fault = tuple[str, str, float]
"""Name of a stream, which fault (an attribute of `Stream`), until when (s, time.monotonic)."""


class ImageTaker:
    """Renders the images of one scene."""

    def __init__(self, scene: Scene, cameras: bool) -> None:
        self._scene, self._data = scene, mujoco.MjData(scene.model)
        self._renderer: Renderer | None = None
        if cameras:
            self._renderer = open_renderer(scene.model, *scene.camera_size)
        self._noise_rng = np.random.default_rng(0)
        shape = *scene.camera_size, 3
        self._noise = self._noise_rng.normal(0.0, _CAMERA_NOISE, shape).astype(np.float32)

    def follow(self, request: RenderRequest) -> None:
        """Take over the physics' state."""
        model, data = self._scene.model, self._data
        mujoco.mj_setState(model, data, request.state, STATE)
        mujoco.mj_forward(model, data)
        self._contacts = request.contacts

    def take(self, name: str) -> Image:
        """Render a camera's or a fingertip's image."""
        if name in _TACTILE:
            side = _TACTILE.index(name)
            pad = self._scene.pads[side]
            return pad.sense(self._data, self._contacts[side], self._scene.rng).image
        assert self._renderer is not None
        self._renderer.update_scene(self._data, name)
        image = self._renderer.render()
        # One field of noise, shifted: drawing noise takes longer than rendering.
        shift = self._noise_rng.integers(0, image.shape[:2])
        noise = np.roll(self._noise, shift, axis=(0, 1))
        return np.clip(image + noise, 0, 255).astype(np.uint8)

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()


def serve(pipe: Connection, host: str, port: int, names: list[str]) -> None:
    """Render images on request until the twin has gone.

    First answers with the port (`port` 0: any that is free) or an OSError; then each RenderRequest
    with the number of images sent on each stream and the processor time (s), so far.
    """
    streams = {name: Stream() for name in names}
    try:
        server = live_image.StreamServer(streams, host, port)
    except OSError as error:
        pipe.send(error)
        return
    pipe.send(server.port)
    taker: ImageTaker | None = None
    while True:
        message: Scene | RenderRequest | Fault = pipe.recv()
        if isinstance(message, tuple):
            name, kind, until = message
            setattr(streams[name], kind, until)
        elif isinstance(message, Scene):
            if taker is not None:
                taker.close()
            taker = ImageTaker(message, cameras=bool(streams.keys() - set(_TACTILE)))
        else:
            assert taker is not None
            _publish(taker, message, streams)
            sent = {name: stream.sent for name, stream in streams.items()}
            pipe.send((sent, time.process_time()))


def _publish(taker: ImageTaker, request: RenderRequest, streams: dict[str, Stream]) -> None:
    viewed = [streams[name] for name in request.due if streams[name].has_viewers]
    if not viewed:
        return
    taker.follow(request)
    for name in request.due:
        if streams[name] in viewed:
            streams[name].publish(taker.take(name))
    if request.held:
        for stream in viewed:
            stream.wait_until_sent()


def main() -> None:
    """Serve with the arguments: number of the pipe to the twin, host, port, names of streams."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe, host, port, *names = sys.argv[1:]
    try:
        serve(Connection(int(pipe)), host, int(port), names)
    except (EOFError, OSError):  # the twin has ended
        pass
