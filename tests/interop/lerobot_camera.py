"""A fingertip through lerobot's camera interface; run by lerobot_plugins.py in lerobot's Python.

python tests/interop/lerobot_camera.py FOLDER       FOLDER: for a cell file
"""

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import draccus
import numpy as np
from lerobot.cameras import make_cameras_from_configs
from lerobot.robots.so_follower import SO101FollowerConfig
from lerobot.utils.import_utils import register_third_party_plugins

from touchgoal.control.sensors.live_image import StreamServer
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.sim_envs.twin.image_process import Stream

CELL = """
arm = "sim"
gripper = {{ kind = "franka_hand" }}
task = {{ name = "pick-place", policy = "expert" }}
fingertips = {{ sensor = "gelsight_mini", left = "{url}", right = "{url}" }}
safety = {{ observation_age = {age} }}
"""
AGE = 1.0  # s
RATE = 25.0  # Hz


def play(stream: Stream) -> None:
    """Publish the untouched gel with a camera's noise."""
    rng, untouched = np.random.default_rng(0), load(GELSIGHT_MINI.sensor_file).background
    while True:
        if stream.has_viewers:
            noise = rng.integers(-3, 4, untouched.shape)
            stream.publish(np.clip(untouched + noise, 0, 255).astype(np.uint8))
        time.sleep(1 / RATE)


def refusal(read: Callable[[], np.ndarray]) -> str:
    """Return why an image is refused, once it is."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        try:
            read()
        except TimeoutError as error:
            return str(error)
    raise AssertionError("every image was taken")


def main() -> None:
    register_third_party_plugins()
    stream, cell = Stream(), Path(sys.argv[1]) / "cell.toml"
    server = StreamServer({"gel": stream}, "127.0.0.1", 0)
    threading.Thread(target=play, args=(stream,), daemon=True).start()
    cell.write_text(CELL.format(url=f"http://127.0.0.1:{server.port}/gel", age=AGE))
    wanted = f"{{tip: {{type: touchgoal, cell: {cell}, camera: tactile_left}}}}"
    arguments = ["--port=none", f"--cameras={wanted}"]
    config = draccus.parse(SO101FollowerConfig, args=arguments)
    (camera,) = make_cameras_from_configs(config.cameras).values()
    with camera:
        images = [camera.async_read(5000) for _ in range(5)] + [camera.read(), camera.read()]
        for before, after in zip(images, images[1:], strict=False):
            assert (before != after).any()
        assert camera.read_latest().shape == (camera.height, camera.width, 3) == (240, 320, 3)
        stream.frozen = np.inf
        frozen = refusal(camera.read_latest)
        assert refusal(camera.async_read) == frozen or "one image" in frozen
        stream.frozen = 0.0
        camera.read()
        stream.stalled = np.inf
        stalled = refusal(camera.read_latest)
    server.close()
    print(f"{len(images)} images read at {camera.fps} Hz; refused: {frozen}; {stalled}")


if __name__ == "__main__":
    main()
