"""A gel seen at an angle: against a pinhole camera written out here, without OpenCV's perspective."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_cell import SIM, write_cell_file

from touchgoal.control import features as ft
from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.cell.connection import connect_camera
from touchgoal.control.sensors.tactile_camera import NO_CROP, fingertip_view, rectify
from touchgoal.control.tactile.sensor_models import GELSIGHT_WEDGE
from touchgoal.runtime.errors import UserError

WIDE, HIGH = 32.0, 24.0  # mm of gel
DOTS = [(4.0, 3.0), (28.0, 3.0), (16.0, 12.0), (4.0, 21.0), (28.0, 21.0), (22.0, 8.0)]  # mm
SHAPE = GELSIGHT_WEDGE.image_shape


def pinhole(x: np.ndarray, y: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Project a gel point (mm) to px in a camera turned by 40 degrees about the gel's y axis."""
    angle, distance = np.radians(40.0), 40.0  # mm to the gel's middle
    side, depth = (x - WIDE / 2) * np.cos(angle), distance + (x - WIDE / 2) * np.sin(angle)
    return scale * (320 + 500 * side / depth), scale * (240 + 500 * (y - HIGH / 2) / depth)


def seen_at_an_angle(scale: float) -> tuple[np.ndarray, tuple]:
    """The image, light grey with dark dots of 1 mm radius; the gel's corners in it."""
    high, wide = int(480 * scale), int(640 * scale)
    # Points of the gel, denser than the pixels; a pixel shows the mean of those that it sees.
    x, y = np.meshgrid(np.arange(0, WIDE, 0.02), np.arange(0, HIGH, 0.02))
    dark = np.min([np.hypot(x - a, y - b) for a, b in DOTS], 0) < 1.0
    u, v = pinhole(x, y, scale)
    pixel = (np.rint(v).astype(int) * wide + np.rint(u).astype(int)).ravel()
    count = np.bincount(pixel, minlength=high * wide)
    light = np.bincount(pixel, np.where(dark, 40.0, 200.0).ravel(), high * wide)
    grey = np.where(count > 0, light / np.maximum(count, 1), 30.0).reshape(high, wide)
    image = np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, 2)
    ends = [(0.0, 0.0), (WIDE, 0.0), (0.0, HIGH), (WIDE, HIGH)]
    corners = [pinhole(np.array(a), np.array(b), scale) for a, b in ends]
    return image, tuple((float(a), float(b)) for a, b in corners)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_gel_seen_at_an_angle_is_shown_from_above(scale: float) -> None:
    image, corners = seen_at_an_angle(scale)
    flat = rectify(image, SHAPE, corners)
    assert flat.shape == (*SHAPE, 3) and flat.dtype == np.uint8
    for x, y in DOTS:
        # 10 px a millimetre; an image's edge lies half a pixel out from the middle of its first pixel.
        column, row = 10 * x - 0.5, 10 * y - 0.5
        left, top = int(column) - 16, int(row) - 16
        darkness = 200.0 - flat[top : top + 33, left : left + 33, 0]
        darkness[darkness < 60] = 0
        rows, columns = np.mgrid[top : top + 33, left : left + 33]
        found = [(axis * darkness).sum() / darkness.sum() for axis in (columns, rows)]
        assert found == pytest.approx([column, row], abs=0.2)
        area = (darkness > 80).sum()  # a disc of 10 px radius, however far from the camera
        assert area == pytest.approx(np.pi * 100, rel=0.1)


def test_corners_of_no_gel_are_refused() -> None:
    for says, corners in {
        "outside": ((0.0, 0.0), (700.0, 0.0), (0.0, 400.0), (600.0, 400.0)),
        "another order": ((0.0, 0.0), (600.0, 0.0), (600.0, 400.0), (0.0, 400.0)),  # clockwise
        "no quadrangle": ((0.0, 0.0), (600.0, 0.0), (0.0, 0.0), (600.0, 0.0)),
    }.items():
        with pytest.raises(UserError, match=says):
            rectify(np.zeros((480, 640, 3), np.uint8), SHAPE, corners)


def test_a_wedges_camera_needs_its_corners() -> None:
    _, corners = seen_at_an_angle(1.0)
    with pytest.raises(UserError, match="at an angle"):
        fingertip_view(GELSIGHT_WEDGE, "/dev/video2")
    assert fingertip_view(GELSIGHT_WEDGE, "http://pi/raw", corners=corners).corners == corners
    assert fingertip_view(GELSIGHT_WEDGE, "http://127.0.0.1/left") == NO_CROP  # a twin's


def test_a_cell_file_has_the_corners_of_either_gel(tmp_path: Path) -> None:
    image, corners = seen_at_an_angle(1.0)
    y, x = np.mgrid[:480, :640] // 4
    image = np.stack([x, 255 - x, y], -1).astype(np.uint8)  # as smooth as a gel
    cv2.imwrite(str(tmp_path / "0.png"), image[..., ::-1])
    a, b, c, d = ((639 - x, y) for x, y in corners)
    mirrored = b, a, d, c
    both = [[list(point) for point in gel] for gel in (corners, mirrored)]
    sides = f'left = "{tmp_path}/%d.png", right = "{tmp_path}/%d.png"'
    tips = f'fingertips = {{ sensor = "gelsight_wedge", {sides}, corners = {both} }}\n'
    cell = read_cell_file(write_cell_file(tmp_path, tips + SIM))
    assert cell.fingertips is not None and cell.fingertips.corners == (corners, mirrored)
    for side, gel in enumerate((corners, mirrored)):
        camera = connect_camera(cell, ft.TACTILE[side])
        np.testing.assert_array_equal(camera.read().image, rectify(image, SHAPE, gel))
        camera.close()
