"""Frames of a sensor from any source, presses recorded from them, the sensor checked, wear of its gel."""

import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from touchgoal.control.calibration.ball import press_surface
from touchgoal.control.calibration.check_report import figures, lines
from touchgoal.control.calibration.press_recorder import PressRecorder
from touchgoal.control.calibration.press_set import read_presses
from touchgoal.control.calibration.sensor_check import check_sensor
from touchgoal.control.sensors.fingertip_source import open_frames, recorded_frames
from touchgoal.control.sensors.live_image import LiveImage
from touchgoal.control.tactile.background import untouched_frames
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.gel_wear import find_wear
from touchgoal.control.tactile.sensor_calibration import load, shade
from touchgoal.control.tactile.sensor_models import (
    GELSIGHT_MINI,
    GELSIGHT_MINI_MARKERS,
    SENSORS,
    find_sensor,
)
from touchgoal.episodes.touches import touch_background
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import write_image
from touchgoal.sim_envs.config import NO_RANDOMIZATION
from touchgoal.sim_envs.tactile.markers import draw
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.rig.surface_press import SurfacePose, press
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, Surface
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance

BALL = Surface("ball", 4e-3, 1.0, np.zeros((TILE, TILE), np.float32), 1.0)
RNG = np.random.default_rng(0)
UNIT = sample_instance(GELSIGHT_MINI, RNG)
CENTRES = [(x, y) for y in (-75, 0, 75) for x in (-110, -40, 40, 110)]  # px from the middle


def pressed(x: float, y: float, depth: float) -> np.ndarray:
    """A ball at a place (px from the middle), so deep (mm) in the gel."""
    at = x * UNIT.pixel_pitch, y * UNIT.pixel_pitch
    return press(BALL, SurfacePose(at, 0.0, (0.0, 0.0), (0.0, 0.0), depth * 1e-3), UNIT, RNG)


@pytest.fixture(scope="module")
def session() -> list[np.ndarray]:
    """A settled gel; in each part a ball comes, stands for a fifth of a second, and goes."""
    frames = [render_untouched(UNIT, RNG) for _ in range(30)]
    for x, y in CENTRES:
        frames += [pressed(x, y, depth) for depth in (0.15, 0.4, *[0.6] * 6, 0.3)]
        frames += [render_untouched(UNIT, RNG) for _ in range(4)]
    return frames


def test_every_press_is_kept_once_where_it_was(session: list[np.ndarray]) -> None:
    recorder = PressRecorder((240, 320), per_cell=1)
    kept = [recorder.update(frame) for frame in session]
    assert recorder.complete and sum(kept) == 12
    found = np.array(recorder.circles)[:, :2] - [159.5, 119.5]
    off = np.abs(found - CENTRES).max()
    assert off < 10  # px: within the contact, the fit moves it further
    assert (recorder.counts == 1).all()


def test_a_gel_that_is_touched_first_is_waited_for(session: list[np.ndarray]) -> None:
    recorder = PressRecorder((240, 320))
    assert not any(recorder.update(frame) for frame in session[30:39])
    assert "untouched" in recorder.hint
    with pytest.raises(UserError, match="untouched"):
        _ = recorder.background
    for frame in session[:16]:
        recorder.update(frame)
    assert recorder.hint == "press at the top, left"


def test_record_presses_writes_what_is_calibrated(
    session: list[np.ndarray], tmp_path: Path
) -> None:
    """A folder of images; then a second ball is added."""
    images, out = tmp_path / "pictures", tmp_path / "out"
    images.mkdir()
    for i, frame in enumerate(session):
        cv2.imwrite(str(images / f"{i:04d}.png"), frame[..., ::-1])
    sizes = "--mm-per-pixel 0.059 --presses-per-part 1 --no-calibrate"
    options = [*sizes.split(), "--out", str(out)]
    main(["record-presses", str(images), "--ball-mm", "4", *options])
    main(["record-presses", str(images), "--ball-mm", "5", "--resume", *options])
    presses = read_presses(out / "presses", 0.059e-3)
    assert len(presses) == 24
    assert sorted(set(presses.ball_radius.round(4))) == [4e-3, 5e-3]
    np.testing.assert_array_equal(presses.files, [f"press_{i:03d}.png" for i in range(24)])


def test_a_video_and_a_folder_give_every_frame(session: list[np.ndarray], tmp_path: Path) -> None:
    path = tmp_path / "touch.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (320, 240))
    for frame in session[:40]:
        writer.write(frame[..., ::-1])
    writer.release()
    read = list(recorded_frames(path, GELSIGHT_MINI))
    assert len(read) == 40
    assert np.abs(read[0].astype(int) - session[0]).mean() < 4
    with pytest.raises(UserError, match="does not exist"):
        list(recorded_frames(tmp_path / "nothing", GELSIGHT_MINI))


def test_what_is_shown_live_can_be_read_live(session: list[np.ndarray]) -> None:
    """The image that record-presses shows is itself a stream such as live sensors send."""
    ended = threading.Event()
    with closing(LiveImage(0)) as live:
        live.show(session[0])

        def play() -> None:
            while not ended.wait(0.04):
                live.show(session[35])

        threading.Thread(target=play, daemon=True).start()
        with closing(open_frames(live.address, GELSIGHT_MINI)) as frames:
            read = [next(frames) for _ in range(5)]
        ended.set()
    assert read[-1].shape == (240, 320, 3)
    assert np.abs(read[-1].astype(int) - session[35]).mean() < 4


@pytest.fixture(scope="module")
def balls() -> list[np.ndarray]:
    """The measured Mini, untouched and under a ball of 4 mm, with noise of one count."""
    calibration, rng = load(GELSIGHT_MINI.sensor_file), np.random.default_rng(0)
    flat, circles = np.zeros((240, 320), np.float32), [[x, 120.0, 22.0] for x in (100, 160, 220)]
    pressed = [press_surface(calibration, np.array(circle), 4e-3) for circle in circles]
    clean = [shade(calibration, surface) for surface in ([flat] * 12 + pressed + [flat] * 3)]
    noisy = [image + rng.normal(size=image.shape) for image in clean]
    return [image.round().clip(0, 255).astype(np.uint8) for image in noisy]


def test_the_start_of_a_clip_is_no_untouched_gel_by_itself(
    balls: list[np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Dark first frames are named and left out; a clip pressed in all its frames is told as that."""
    for pressed in balls[12:15]:
        with pytest.raises(UserError, match="the recording begins in touch"):
            check_sensor([pressed] * 20, GELSIGHT_MINI)
    files = [tmp_path / "background.png", tmp_path / "clip" / "0.png", tmp_path / "clip" / "1.png"]
    for path, frame in zip(files, (balls[0], *balls[12:14]), strict=True):
        write_image(path, frame)
    main(
        [
            "check-sensor",
            str(tmp_path / "clip"),
            "--background",
            str(files[0]),
            "--out",
            str(tmp_path / "out"),
        ]
    )
    assert "3, 2 of them touched" in capsys.readouterr().out
    dark = [(0.5 * frame).astype(np.uint8) for frame in balls[:5]]
    settling = [*dark, *balls]
    check = check_sensor(settling, GELSIGHT_MINI)
    assert "frames 0 to 4 are left out" in capsys.readouterr().err
    assert (check.frames, check.touching) == (18, 3) and not check.drift_from_file.large
    np.testing.assert_array_equal(
        touch_background(np.stack(settling)), touch_background(np.stack(balls))
    )
    # a touch is no settling exposure, and ends it
    early = np.stack([*balls[:2], *[balls[13]] * 16])
    np.testing.assert_array_equal(untouched_frames(early), early[:2])


def test_a_sensor_check_reads_noise_ball_and_contact(balls: list[np.ndarray]) -> None:
    check = check_sensor(balls, GELSIGHT_MINI, ball_radius=4e-3)
    assert (check.frames, check.touching, len(check.presses)) == (18, 3, 3)
    assert check.noise == pytest.approx(1.05, abs=0.1)  # rounding adds a twelfth
    assert check.untouched < check.threshold < check.touched / 2
    radii = [press.ball.radius for press in check.presses if press.ball is not None]
    assert np.median(radii) == pytest.approx(1, abs=0.1)
    # The noise of one count is a part of the change, and no depth explains it.
    assert max(press.unexplained for press in check.presses) < 0.2
    assert not check.drift.large and not check.drift_from_file.large
    computed = check_sensor(balls, replace(GELSIGHT_MINI, measured=False), ball_radius=4e-3)
    assert computed.touching == 3 and not computed.presses and not computed.presses_unexplained
    printed = "\n".join(lines(computed, figures(computed, 4.0, None)))
    assert "images only" in printed and "force  " not in printed and "ball  " not in printed
    assert [name for name in SENSORS if SENSORS[name].images_only] == ["gelsight_wedge"]


def test_check_sensor_says_what_is_off(
    balls: list[np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Light that grows by a fifth on the way, a wrong ball, and a weight."""
    images = tmp_path / "pictures"
    images.mkdir()
    for i, frame in enumerate([*balls, *[balls[0]] * 90]):
        lit = np.rint(frame * (1 + 0.2 * min(i / 60, 1))).clip(0, 255)
        cv2.imwrite(str(images / f"{i:03d}.png"), lit.astype(np.uint8)[..., ::-1])
    main(["check-sensor", str(images), "--sensor", "gelsight_mini", "--ball-mm", "6",
          "--weight-g", "2000", "--out", str(tmp_path / "out")])  # fmt: skip
    printed = capsys.readouterr().out
    assert "lock the exposure" in printed and "record-presses" in printed
    assert "under a weight of 19.6 N: multiply" in printed
    drawn = cv2.imread(str(tmp_path / "out" / "check.png"))
    assert drawn is not None and drawn.shape == (24 + 3 * 240, 5 * 320, 3)


def test_a_sensor_check_counts_markers() -> None:
    unit = sample_instance(GELSIGHT_MINI_MARKERS, np.random.default_rng(0), NO_RANDOMIZATION)
    frames = [render_untouched(unit, RNG) for _ in range(3)]
    for frame, moved in zip(frames, (0.0, 0.0, 3.0), strict=True):
        draw(frame, unit.markers + np.array([moved, 0], np.float32), unit.marker_radius)
    check = check_sensor(frames, GELSIGHT_MINI_MARKERS)
    assert check.markers == pytest.approx(1, abs=0.02)
    assert check.largest_shift_px == pytest.approx(3, abs=0.5)


def test_a_darker_image_has_a_depth(balls: list[np.ndarray]) -> None:
    """A surface below rest everywhere used to cast shadows of negative length."""
    estimator = DepthEstimator(load(GELSIGHT_MINI.sensor_file), 8)
    depth = estimator.estimate(np.rint(0.75 * balls[0]).astype(np.uint8), balls[0].astype("f4"))
    assert np.isfinite(depth).all()


# ---- wear: a scratch, a hole and dust are seen, noise and light are not


def look(instance: SensorInstance, rng: np.random.Generator) -> np.ndarray:
    image = render_untouched(instance, rng)
    draw(image, instance.markers, instance.marker_radius)
    return image


def drawn(image: np.ndarray, kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw a scratch, a hole in the coating or a dust grain; return the image and the place (px)."""
    h, w, _ = image.shape
    mask, at = np.zeros((h, w), np.uint8), rng.uniform([0.3 * w, 0.3 * h], [0.7 * w, 0.7 * h])
    middle = int(at[0]), int(at[1])
    if kind == "scratched":
        turn = rng.uniform(0, np.pi)
        way = 30 * np.array([np.cos(turn), np.sin(turn)])
        start, end = (at - way).astype(int), (at + way).astype(int)
        cv2.line(mask, start.tolist(), end.tolist(), 255, 2, cv2.LINE_AA)
        change = np.full(3, rng.choice([-15.0, 15.0]))
    elif kind == "torn":
        axes = int(rng.integers(14, 40)), int(rng.integers(14, 30))
        cv2.ellipse(mask, middle, axes, rng.uniform(0, 180), 0, 360, 255, -1, cv2.LINE_AA)
        change = 20 - image.astype(float)
    else:
        cv2.circle(mask, middle, int(rng.integers(2, 5)), 255, -1, cv2.LINE_AA)
        change = -0.5 * image
    share = cv2.GaussianBlur(mask / 255.0, (0, 0), 0.7)[..., None]
    return np.clip(image + share * change, 0, 255).astype(np.uint8), at


@pytest.mark.parametrize(("name", "gels"), [("gelsight_mini", 20), ("gelsight_mini_markers", 8)])
def test_wear_is_seen_and_named_and_noise_and_light_are_not(name: str, gels: int) -> None:
    sensor, rng, named = find_sensor(name), np.random.default_rng(0), 0
    for gel in range(gels):
        instance = sample_instance(sensor, np.random.default_rng(gel))
        first = look(instance, rng)
        light = rng.uniform(0.95, 1.05, 3)  # of each channel
        now = np.clip(look(instance, rng) * light, 0, 255).astype(np.uint8)
        assert find_wear(now, first, sensor) is None
        for kind in ("torn", "scratched", "dirty"):
            worn, at = drawn(now, kind, rng)
            wear = find_wear(worn, first, sensor)
            if wear is None:  # a grain under a printed dot
                assert kind == "dirty" and sensor.markers is not None
                continue
            np.testing.assert_allclose(wear.place, at * sensor.pixel_pitch, atol=1e-3)
            named += wear.kind == kind
    assert named >= 0.9 * 3 * gels
