"""Images that are not their sensor's are refused by a line that names the fault; whole ones pass."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_cell import FakeCamera, FakeClock
from toy_episodes import FPS, make_episode

import touchgoal
from touchgoal.control.calibration.ball import press_surface
from touchgoal.control.features import TACTILE
from touchgoal.control.interfaces import DriverError
from touchgoal.control.sensors.tactile_camera import NO_CROP, TactileCamera
from touchgoal.control.tactile.image_guard import (
    check_presses,
    check_unpressed,
    check_untouched,
    find_seam,
)
from touchgoal.control.tactile.sensor_calibration import load, save, shade
from touchgoal.control.tactile.sensor_models import (
    DIGIT,
    GELSIGHT_MINI,
    GELSIGHT_MINI_MARKERS,
    SensorModel,
)
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.episodes.touches import check_fingertips
from touchgoal.launch.__main__ import main
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import NO_RANDOMIZATION
from touchgoal.sim_envs.scene.objects import find_object, sample_body
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

REAL = Path(__file__).parents[2] / "shared" / "data"  # beside the project; not part of it
MINI = load(GELSIGHT_MINI.sensor_file)


def stretched(image: np.ndarray) -> np.ndarray:
    """Stretch by 8 % along the rows and cut off the sides."""
    height, width, _ = image.shape
    wide = cv2.resize(np.ascontiguousarray(image), (round(1.08 * width), height))
    left = (wide.shape[1] - width) // 2
    return wide[:, left : left + width]


def torn(image: np.ndarray) -> np.ndarray:
    middle = len(image) // 2
    return np.concatenate([image[:middle], np.roll(image[middle:], 40, 1)])


def half_grey(image: np.ndarray) -> np.ndarray:
    middle = len(image) // 2
    return np.concatenate([image[:middle], np.full_like(image[middle:], 128)])


Fault = Callable[[np.ndarray], np.ndarray]
FAULTS: dict[str, tuple[Fault, str]] = {
    "exchanged": (lambda p: p[..., ::-1], "red and blue are exchanged"),
    "left to right": (lambda p: p[:, ::-1], "it is mirrored left to right"),
    "top to bottom": (lambda p: p[::-1], "it is mirrored top to bottom"),
    "turned": (lambda p: p[::-1, ::-1], "it is turned by 180 degrees"),
    "stretched": (stretched, "it fits when scaled by 0.926 along its rows"),
    "scrolled": (lambda p: np.roll(p, 80, 0), "torn or rolled at row 80"),
    "rolled": (lambda p: np.roll(p, 100, 1), "torn or rolled at column 100"),
    "torn": (torn, "torn or rolled at row"),
    "half grey": (half_grey, "torn or rolled at row"),
}


def other_light(image: np.ndarray) -> np.ndarray:
    return (image * np.array([0.85, 1.0, 1.15])).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("model", [GELSIGHT_MINI, DIGIT], ids=lambda model: model.name)
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_is_named(fault: str, model: SensorModel) -> None:
    change, says = FAULTS[fault]
    rng = np.random.default_rng(0)
    image = load(model.sensor_file).background + rng.normal(size=(*model.image_shape, 3))
    image = np.ascontiguousarray(change(other_light(image)))
    with pytest.raises(UserError) as refused:
        check_untouched(image, model, "the image")
    assert says in str(refused.value)


def test_other_sensors_of_the_model_pass() -> None:
    """In other light, with dust on the gel, with printed dots."""
    rng = np.random.default_rng(0)
    for model in (GELSIGHT_MINI, GELSIGHT_MINI_MARKERS, DIGIT):
        for _ in range(8):
            unit = sample_instance(model, rng)
            image = other_light(unit.with_dots(render_untouched(unit, rng)))
            for x, y in rng.integers(20, 220, (6, 2)):
                cv2.circle(image, (int(x), int(y)), 3, (30, 25, 30), -1)
            check_untouched(image, model, "the image")
            check_unpressed(image, model, "the image")


def balls(model: SensorModel) -> tuple[np.ndarray, list[np.ndarray]]:
    """The untouched gel and four presses, with noise."""
    calibration, rng = load(model.sensor_file), np.random.default_rng(0)
    rows, columns = model.image_shape
    surfaces = [np.zeros(model.image_shape, np.float32)] + [
        press_surface(calibration, np.array([x * columns, y * rows, 20.0]), 4e-3)
        for x in (0.3, 0.7)
        for y in (0.3, 0.7)
    ]
    images = [shade(calibration, surface) for surface in surfaces]
    noisy = [(p + rng.normal(size=p.shape)).round().clip(0, 255).astype(np.uint8) for p in images]
    return noisy[0], noisy[1:]


@pytest.mark.parametrize(
    "model", [GELSIGHT_MINI, GELSIGHT_MINI_MARKERS, DIGIT], ids=lambda m: m.name
)
def test_a_press_is_no_untouched_image(model: SensorModel) -> None:
    unit = sample_instance(model, np.random.default_rng(0), NO_RANDOMIZATION)
    for press in balls(model)[1]:
        with pytest.raises(UserError, match="begins in touch"):
            check_unpressed(unit.with_dots(press), model, "the image")


def test_presses_tell_a_mirror_that_the_untouched_gel_does_not_show(tmp_path: Path) -> None:
    both = (MINI.background.astype(float) + MINI.background[:, ::-1]) / 2
    save(replace(MINI, background=both.astype(np.uint8)), tmp_path, {})
    model = replace(GELSIGHT_MINI, sensor_file=tmp_path)
    untouched, presses = balls(model)
    check_presses(untouched, presses, model, "the presses")
    untouched, presses = untouched[:, ::-1].copy(), [p[:, ::-1].copy() for p in presses]
    check_untouched(untouched, model, "the image")
    with pytest.raises(UserError, match="mirrored left to right"):
        check_presses(untouched, presses, model, "the presses")


def test_a_pressed_edge_is_no_tear() -> None:
    block = sample_body(find_object("wooden_block"), np.random.default_rng(0), mass=0.05)
    gel = sample_instance(GELSIGHT_MINI, np.random.default_rng(0), NO_RANDOMIZATION)
    untouched, stepped = render_untouched(gel, np.random.default_rng(0)), 0
    for y in np.arange(-0.0215, -0.0155, 0.0008):  # m; an edge lies across the pad, along its rows
        bench = PressBench(block, GELSIGHT_MINI, gel)
        bench.place(np.array([0.0, y, 0.03]), None)
        image = bench.sense(40.0, np.random.default_rng(1), centre=(0.0, 0.0)).image
        stepped += bool(find_seam(image))
        assert not find_seam(image, untouched)
    assert stepped
    assert "row" in find_seam(torn(untouched), untouched)


def test_a_fingertip_leaves_out_torn_images() -> None:
    clock = FakeClock()
    camera = FakeCamera(clock, MINI.background)
    fingertip = TactileCamera(camera, GELSIGHT_MINI, NO_CROP)
    clock.time = 1.0
    whole = fingertip.read()
    clock.time, camera.image = 2.0, torn(MINI.background)
    assert fingertip.read() is whole and "torn" in fingertip.problem
    clock.time, camera.image = 3.0, MINI.background
    assert fingertip.read().stamp == 3.0 and not fingertip.problem
    camera.image = torn(MINI.background)
    with pytest.raises(DriverError, match="torn or rolled"):
        TactileCamera(camera, GELSIGHT_MINI, NO_CROP).read()


def test_commands_and_curves_refuse_exchanged_colours(tmp_path: Path) -> None:
    untouched, presses = balls(GELSIGHT_MINI)
    swapped = [image[..., ::-1] for image in (*[untouched] * 3, *presses * 4)]
    cv2.imwrite(str(tmp_path / "background.png"), swapped[0][..., ::-1])
    for i, image in enumerate(swapped[3:]):
        cv2.imwrite(str(tmp_path / f"{i:02d}.png"), image[..., ::-1])
    options = ["--out", str(tmp_path / "out")]
    commands = [
        ["check-sensor", str(tmp_path), *options],
        ["calibrate", str(tmp_path), "--mm-per-pixel", "0.0634", "--ball-mm", "4", *options],
    ]
    for command in commands:
        with pytest.raises(SystemExit, match="red and blue are exchanged"):
            main(command)
    with pytest.raises(UserError, match="red and blue are exchanged"):
        touchgoal.Reward("last")(tactile={"left": np.stack(swapped)})


def test_a_set_in_which_the_fingertips_change_places_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    units = [sample_instance(GELSIGHT_MINI, rng) for _ in range(2)]

    writer = EpisodeWriter(tmp_path, FPS)
    for sides in ((0, 1), (0, 1), (1, 0)):
        episode = make_episode(0, 3)
        for key, side in zip(TACTILE, sides, strict=True):
            episode.frames[key] = np.stack([render_untouched(units[side], rng) for _ in range(3)])
        episode.meta["sensor"] = "gelsight_mini"
        writer.append(episode)
    check_fingertips(EpisodeSet(tmp_path), range(2))
    with pytest.raises(UserError, match="episode 2 look exchanged"):
        check_fingertips(EpisodeSet(tmp_path), range(3))


@pytest.mark.skipif(not REAL.is_dir(), reason="real frames are not part of the repository")
@pytest.mark.parametrize(("folder", "model"), [("mini", GELSIGHT_MINI), ("digit", DIGIT)])
def test_real_presses_pass_and_their_faults_do_not(folder: str, model: SensorModel) -> None:
    files = sorted((REAL / f"{folder}_presses").glob("*.png"))
    images = {file.name: cv2.imread(str(file))[..., ::-1].copy() for file in files}  # pyright: ignore
    untouched = images.pop("background.png")
    for image in (untouched, *images.values()):
        check_untouched(image, model, "the image")
    for change, says in FAULTS.values():
        with pytest.raises(UserError, match=says):
            check_untouched(np.ascontiguousarray(change(untouched)), model, "the image")
    presses = list(images.values())[::4]
    check_unpressed(untouched, model, "the image")
    for press in presses:
        with pytest.raises(UserError, match="begins in touch"):
            check_unpressed(press, model, "the image")
    check_presses(untouched, presses, model, "the presses")
