"""Calibration: known lights come back from presses, sensor files come back from disk."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchgoal.control.calibration.ball import ball_overlap, press_surface
from touchgoal.control.calibration.calibrate import fit
from touchgoal.control.calibration.press_set import (
    PressSet,
    read_presses,
    without_drift,
    write_presses,
)
from touchgoal.control.tactile import gel, sensor_calibration
from touchgoal.control.tactile.sensor_calibration import SensorCalibration
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError

SHAPE, PITCH, BALL, NOISE = (120, 160), 0.118e-3, 3e-3, 1.0
AZIMUTHS = (25.0, 150.0, -85.0)  # no sensor's


def known_sensor() -> SensorCalibration:
    """Three lamps by hand: linear and quadratic terms that change over the image, shadows."""
    angles = np.radians(AZIMUTHS)
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]] / 100
    glow = [110 + 40 * np.cos(a) * (x - 0.8) + 40 * np.sin(a) * (y - 0.6) for a in angles]
    response = np.zeros((3, sensor_calibration.N_FEATURES, 3), np.float32)
    response[:, :2, 0] = 90 * np.stack([np.cos(angles), np.sin(angles)], -1)
    response[:, [2, 4], 0] = -20
    response[:, 0, 1] = response[:, 1, 2] = 10
    return SensorCalibration(
        sensor="gelsight_mini",
        background=np.stack(glow, -1).astype(np.uint8),
        pixel_pitch=PITCH,
        response=response,
        light_azimuths=AZIMUTHS,
        shadow_slope=0.2,
        shadow=-15 * np.eye(3, dtype=np.float32),
        penumbra=0.1e-3,
        max_slope=0.9,
        max_depth=2e-3,
        blur_sigmas=(1.05e-3, 0.525e-3, 0.2625e-3, 0.1225e-3),
        noise=NOISE,
    )


def made_presses(sensor: SensorCalibration, n: int = 20) -> PressSet:
    """Presses all over the gel, with circles drawn by a hand that is off by a pixel."""
    rng = np.random.default_rng(0)
    true = rng.uniform([20, 20, 9], [140, 100, 14], (n, 3))
    images = []
    for circle in true:
        clean = sensor_calibration.shade(sensor, press_surface(sensor, circle, BALL))
        images.append((clean + NOISE * rng.normal(size=clean.shape)).round().clip(0, 255))
    labels = (true + rng.normal(0, [1, 1, 0.4], (n, 3))).round(1)
    files = tuple(f"{i:02d}.png" for i in range(n))
    stacked = np.stack(images).astype(np.uint8)
    return PressSet(sensor.background, stacked, labels, np.full(n, BALL), files)


@pytest.fixture(scope="module")
def presses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("presses")
    write_presses(made_presses(known_sensor()), folder)
    return folder


def off_by(found: float, true: float) -> float:
    return abs((found - true + 180) % 360 - 180)


def test_ball_touches_where_it_is_said_to() -> None:
    circle = np.array([80.0, 60.0, 12.0])
    overlap = ball_overlap(SHAPE, PITCH, circle, BALL)
    touching = overlap > gel.CONTACT_SHARE * overlap.max()
    assert np.sqrt(touching.sum() / np.pi) == pytest.approx(12, abs=0.3)
    y, x = np.argwhere(touching).mean(0)
    assert (x, y) == pytest.approx((80, 60), abs=0.1)
    curved = overlap[60, 80] - overlap[60, 90]
    assert curved == pytest.approx(BALL - np.sqrt(BALL**2 - (10 * PITCH) ** 2), rel=1e-3)


@pytest.mark.slow
def test_lights_come_back(presses: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    main(["calibrate", str(presses), "--mm-per-pixel", "0.118", "--out", str(tmp_path),
          "--illumination-exponent", "1", "--no-check-lamps"])  # fmt: skip
    found = sensor_calibration.load(tmp_path / "sensor_file")
    for azimuth, true in zip(found.light_azimuths, AZIMUTHS, strict=True):
        assert off_by(azimuth, true) < 10
    assert found.noise == pytest.approx(NOISE, rel=0.15)
    record = json.loads((tmp_path / "metrics.json").read_text())
    floor = NOISE * np.sqrt(2 / np.pi)  # mean absolute value of the noise alone
    assert record["held_out"]["fit, circles moved to the picture"]["l1_near"] < 1.35 * floor
    labelled = record["held_out"]["fit, circles as labelled"]["l1_near"]
    assert labelled < 0.6 * record["held_out"]["background alone"]["l1_near"]
    assert record["response_varies_over_image"]
    depth = record["held_out_depth"]["3"]
    assert depth["radius_mm"] == pytest.approx(3, rel=0.1) and depth["residual_um"] < 30
    for name in ("held_out.png", "lights.png"):
        assert cv2.imread(str(tmp_path / name)) is not None
    assert "held-out presses" in capsys.readouterr().out


def test_presses_in_one_place_say_nothing_about_the_rest(presses: Path) -> None:
    """Presses in the middle, ball radius unknown: the fit leaves out terms in position."""
    together = read_presses(presses, PITCH)
    spread = np.hypot(*(together.circles[:, :2] - [80, 60]).T)
    middle = together.take(np.argsort(spread)[:8])
    unknown = replace(middle, ball_radius=np.full(8, np.nan))
    found = fit(unknown, PITCH, "gelsight_mini", trust_labels=True)
    assert not found.varies_over_image and not np.isnan(found.ball_radius).any()
    assert np.abs(found.calibration.response[..., 0]).max() > 10
    assert not found.calibration.response[..., 1:].any()
    for azimuth, true in zip(found.calibration.light_azimuths, AZIMUTHS, strict=True):
        assert off_by(azimuth, true) < 10


def edit(folder: Path, file: str, change: Callable[[str], str]) -> None:
    (folder / file).write_text(change((folder / file).read_text()))


def set_row(column: int, value: str) -> Callable[[Path], None]:
    """Damage to the first press: another value in a column."""

    def damage(folder: Path) -> None:
        lines = (folder / "presses.csv").read_text().splitlines()
        row = lines[1].split(",")
        row[column] = value
        (folder / "presses.csv").write_text("\n".join([lines[0], ",".join(row), *lines[2:]]))

    return damage


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (
            lambda f: edit(f, "presses.csv", lambda t: "\n".join(t.splitlines()[:9])),
            "8 presses, calibration needs at least 16",
        ),
        (lambda f: (f / "background.png").unlink(), "background.png is missing"),
        (set_row(1, "170"), "lies outside the 160 x 120 image"),
        (set_row(3, "30"), "does not fit a ball of radius 3 mm"),
        (set_row(4, ""), "the ball's radius is missing"),
        (lambda f: shutil.copy(f / "background.png", f / "00.png"), "shows no contact"),
    ],
)
def test_unfit_presses_are_refused(
    presses: Path, tmp_path: Path, damage: Callable[[Path], object], says: str
) -> None:
    folder, out = tmp_path / "presses", tmp_path / "out"
    write_presses(read_presses(presses, PITCH), folder)
    damage(folder)
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", str(folder), "--mm-per-pixel", "0.118", "--out", str(out)])
    assert says in str(stopped.value.code) and "\n" not in str(stopped.value.code)
    assert not out.exists()


def test_sensor_file_comes_back(tmp_path: Path) -> None:
    kept = known_sensor()
    sensor_calibration.save(kept, tmp_path, {"source": "made up"})
    found = sensor_calibration.load(tmp_path)
    for field in fields(SensorCalibration):
        before, after = getattr(kept, field.name), getattr(found, field.name)
        if isinstance(before, str):
            assert before == after
        else:
            np.testing.assert_allclose(np.array(after), np.array(before), rtol=1e-6)
    assert json.loads((tmp_path / "sensor.json").read_text())["provenance"]["source"] == "made up"


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda f: (f / "background.png").unlink(), "background.png is missing"),
        (lambda f: edit(f, "sensor.json", lambda t: t[:99]), "is no sensor file"),
        (lambda f: edit(f, "sensor.json", lambda t: t.replace('t": 2', 't": 9')), "has format 9"),
        (lambda f: edit(f, "sensor.json", lambda t: t.replace("0.9", "-0.9")), "must be positive"),
    ],
)
def test_foreign_file_refused(tmp_path: Path, damage: Callable[[Path], object], says: str) -> None:
    sensor_calibration.save(known_sensor(), tmp_path, {})
    damage(tmp_path)
    with pytest.raises(UserError) as refused:
        sensor_calibration.load(tmp_path)
    assert says in str(refused.value)


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_shipped_sensor_files_fit_their_models(name: str) -> None:
    model = SENSORS[name]
    shipped = sensor_calibration.load(model.sensor_file)
    assert shipped.background.shape[:2] == model.image_shape
    assert shipped.pixel_pitch == pytest.approx(model.pixel_pitch)


def test_a_press_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    """cv2.imwrite would return False, and the press would be lost without a word."""
    (tmp_path / f"press_00.png.{os.getpid()}.tmp").mkdir()  # stands for a disk that takes no file
    presses = replace(made_presses(known_sensor(), 1), files=("press_00.png",))
    with pytest.raises(OSError):
        write_presses(presses, tmp_path)


def test_circles_are_found_in_the_images(tmp_path: Path) -> None:
    """No column of circles: the visible disc is larger than the contact, which the fit then finds."""
    made = made_presses(known_sensor(), 16)
    write_presses(made, tmp_path)
    edit(tmp_path, "presses.csv", lambda t: "\n".join(
        ",".join([line.split(",")[0], line.split(",")[4]]) for line in t.splitlines()))  # fmt: skip
    found = read_presses(tmp_path, PITCH)
    off = np.abs(found.circles[:, :2] - made.circles[:, :2])
    assert np.median(off) < 2 and off.max() < 6
    assert (0.7 < found.circles[:, 2] / made.circles[:, 2]).all()
    assert (found.circles[:, 2] / made.circles[:, 2] < 1.5).all()


def test_light_that_drifts_from_press_to_press_is_taken_out() -> None:
    press = made_presses(known_sensor(), 1)
    image = press.images[0]
    brighter = np.rint(image * np.array([1.05, 0.97, 1.02]) + [2, 0, -3]).clip(0, 255)
    steady = without_drift(brighter.astype(np.uint8), press.background, press.circles[0])
    assert np.abs(steady.astype(float) - image).mean() < 1.0
