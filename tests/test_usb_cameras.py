"""USB cameras: found by serial number, found again after a replug, exposure locked."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numbered_pictures import numbered, until

from touchgoal.control.sensors.tactile_camera import (
    DIGIT_CROP,
    GELSIGHT_MINI_CROP,
    NO_CROP,
    fingertip_view,
)
from touchgoal.control.sensors.usb_cameras import find_sensor_camera, list_cameras
from touchgoal.control.sensors.video import VideoCamera, VideoConfig
from touchgoal.control.tactile.sensor_models import DIGIT, GELSIGHT_MINI, GELSIGHT_MINI_MARKERS
from touchgoal.runtime.errors import UserError


def plug(root: Path, node: int, product: str, serial: str, index: int = 0) -> None:
    """Nodes as Linux makes them: class/videoN/device links to an interface of a USB device."""
    usb = root / "devices" / f"usb-{serial}"
    (usb / "1-1:1.0").mkdir(parents=True, exist_ok=True)
    for name, text in (("product", product), ("serial", serial), ("idProduct", "636d")):
        (usb / name).write_text(text + "\n")
    folder = root / "class" / f"video{node}"
    folder.mkdir(parents=True)
    (folder / "device").symlink_to(usb / "1-1:1.0")
    (folder / "name").write_text(f"{product}: {product}\n")
    (folder / "index").write_text(f"{index}\n")


def test_fingertips_are_found_by_name_and_serial_number(tmp_path: Path) -> None:
    plug(tmp_path, 0, "Integrated Webcam", "W1")
    plug(tmp_path, 2, "GelSight Mini R0B 28GH-EJZ8", "28GHEJZ8")
    plug(tmp_path, 3, "GelSight Mini R0B 28GH-EJZ8", "28GHEJZ8", index=1)  # metadata
    plug(tmp_path, 10, "DIGIT", "D20001")
    root = tmp_path / "class"
    assert [c.device for c in list_cameras(root)] == ["/dev/video0", "/dev/video2", "/dev/video10"]
    assert find_sensor_camera(GELSIGHT_MINI_MARKERS, root=root).device == "/dev/video2"
    assert find_sensor_camera(DIGIT, "D20001", root).device == "/dev/video10"
    with pytest.raises(UserError, match="GelSight Mini R0B 28GH-EJZ8"):
        find_sensor_camera(DIGIT, "D99", root)
    plug(tmp_path, 12, "DIGIT", "D20002")
    with pytest.raises(UserError, match="D20001, D20002"):
        find_sensor_camera(DIGIT, root=root)


def test_a_fingertips_view_is_chosen_by_its_model_for_a_device_too() -> None:
    assert fingertip_view(DIGIT, "/dev/video3", None) == DIGIT_CROP
    assert fingertip_view(GELSIGHT_MINI, "28GHEJZ8", None) == GELSIGHT_MINI_CROP
    assert fingertip_view(GELSIGHT_MINI, "http://127.0.0.1/left", None) == NO_CROP
    assert fingertip_view(DIGIT, "D20001", 0.1) == replace(DIGIT_CROP, border=0.1)


class PluggedCamera:
    """OpenCV's capture of a camera that gives one picture and is then unplugged."""

    def __init__(self, keeps: float = 0.0) -> None:
        self.set_to: dict[int, float] = {}
        self.keeps, self.grabs = keeps, 0

    def isOpened(self) -> bool:
        return True

    def set(self, prop: int, value: float) -> bool:
        self.set_to[prop] = value
        return True

    def get(self, prop: int) -> float:
        return self.keeps or self.set_to.get(prop, 0.0)

    def grab(self) -> bool:
        self.grabs += 1
        return self.grabs == 1

    def retrieve(self) -> tuple[bool, np.ndarray]:
        data = cv2.imencode(".jpg", numbered(self.grabs))[1]
        return True, data.reshape(1, -1)

    def release(self) -> None: ...


def test_after_a_replug_the_serial_number_is_looked_up_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked, devices = [], iter(["/dev/video2", "/dev/video4", *["/dev/video6"] * 99])

    def opened(source: str, _: int) -> PluggedCamera:
        asked.append(source)
        return PluggedCamera()

    monkeypatch.setattr(cv2, "VideoCapture", opened)
    camera = VideoCamera(VideoConfig("28GHEJZ8", device=lambda: next(devices)))
    assert camera.read().image.shape == (96, 128, 3)
    until(lambda: len(asked) > 1)
    camera.close()
    assert asked[:2] == ["/dev/video2", "/dev/video4"]


def test_exposure_and_white_balance_are_locked_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    plugged = PluggedCamera()
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: plugged)
    VideoCamera(VideoConfig("0", exposure=120.0, white_balance=4600)).close()
    assert plugged.set_to[cv2.CAP_PROP_AUTO_EXPOSURE] == 1  # V4L2_EXPOSURE_MANUAL
    assert plugged.set_to[cv2.CAP_PROP_EXPOSURE] == 120
    assert plugged.set_to[cv2.CAP_PROP_AUTO_WB] == 0
    assert plugged.set_to[cv2.CAP_PROP_WB_TEMPERATURE] == 4600
    plugged.keeps = 99.0
    with pytest.raises(UserError, match="keeps exposure 99 instead of 120"):
        VideoCamera(VideoConfig("0", exposure=120.0))
