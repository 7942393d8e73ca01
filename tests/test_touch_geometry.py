"""From frames back to touch: background, contact, markers, depth and force, on simulated presses."""

import cv2
import numpy as np
import pytest

from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import contact_strength
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.force import estimate_force
from touchgoal.control.tactile.markers.tracker import MarkerTracker, find_markers, without_markers
from touchgoal.control.tactile.sensor_models import DIGIT, GELSIGHT, GELSIGHT_MINI, SensorModel
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI_MARKERS as DOTTED
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import NO_RANDOMIZATION
from touchgoal.sim_envs.scene.objects import CATALOGUE, Body, ObjectKind
from touchgoal.sim_envs.tactile.markers import draw
from touchgoal.sim_envs.tactile.optics import render, render_untouched
from touchgoal.sim_envs.tactile.pad import TactileFrame
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance

HEIGHT, WIDTH = GELSIGHT_MINI.image_shape
MINI = sample_instance(GELSIGHT_MINI, np.random.default_rng(0), NO_RANDOMIZATION)
GLASS = CATALOGUE["glass_ball"]
assert DOTTED.markers is not None
DOTS = DOTTED.markers
BLOCK = ObjectKind("block", "box", GLASS.material, ())


def turned(axis: int, degrees: float) -> np.ndarray:
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return np.asarray(cv2.Rodrigues(vector)[0])


def press(
    body: Body,
    force: float,
    sensor: SensorModel = GELSIGHT_MINI,
    instance: SensorInstance = MINI,
    rotation: np.ndarray | None = None,
    at: tuple[float, float] = (1e-3, -0.5e-3),
) -> TactileFrame:
    bench = PressBench(body, sensor, instance)
    bench.place(np.array([*at, 0.03]), rotation)
    return bench.sense(force, np.random.default_rng(1), centre=at)


def untouched(instance: SensorInstance, n: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.stack([render_untouched(instance, rng) for _ in range(n)])


def dotted(
    image: np.ndarray, instance: SensorInstance, moved: np.ndarray | float = 0.0
) -> np.ndarray:
    image = image.copy()
    draw(image, (instance.markers + moved).astype(np.float32), instance.marker_radius)
    return image


@pytest.fixture(scope="module")
def gel() -> SensorInstance:
    return sample_instance(DOTTED, np.random.default_rng(0), NO_RANDOMIZATION)


def tracker_of(plain: np.ndarray, gel: SensorInstance) -> MarkerTracker:
    """A tracker that begins with the dots at rest."""
    return MarkerTracker(dotted(plain, gel), DOTS, gel.pixel_pitch)


def test_a_hidden_marker_is_flagged_and_found_again(gel: SensorInstance) -> None:
    rng = np.random.default_rng(6)
    plain = render_untouched(gel, rng)
    tracker = tracker_of(plain, gel)
    hidden = 31
    for step in range(12):
        moved = np.full((63, 2), [1.2 * step, 0.4 * step])
        frame = dotted(plain, gel, moved)
        if 3 <= step < 9:
            x, y = np.rint(gel.markers[hidden] + moved[hidden]).astype(int)
            frame[y - 12 : y + 13, x - 12 : x + 13] = plain[y - 12 : y + 13, x - 12 : x + 13]
        now = tracker.update(frame)
        lost = np.flatnonzero(~now.found)
        assert lost.tolist() == ([hidden] if 3 <= step < 9 else [])
        error = np.linalg.norm(now.positions.reshape(-1, 2) - gel.markers - moved, axis=1)
        assert error.max() < 0.3  # the neighbours carry the lost one along


@pytest.mark.parametrize("kind", ["jump", "turn", "shear", "drag"])
def test_dots_are_followed_through_half_a_spacing(gel: SensorInstance, kind: str) -> None:
    """Nearest spots are the neighbours' then: of all dots, of those at the rim, or in one place."""
    rng = np.random.default_rng(8)
    plain = render_untouched(gel, rng)
    half = 0.5 * DOTS.pitch / gel.pixel_pitch
    away = gel.markers - gel.markers.mean(0)
    for _ in range(4):
        matrix = {"turn": np.array([[0, 1], [-1, 0]]), "shear": rng.normal(size=(2, 2))}.get(kind)
        shape = np.ones((63, 2)) if matrix is None else away @ matrix.T
        if kind == "drag":
            centre = rng.uniform(-60, 60, 2)
            shape = np.exp(-((away - centre) ** 2).sum(1, keepdims=True) / (2 * 60**2)) * [0.8, 0.6]
        if kind == "jump":
            shape = shape * rng.normal(size=2)
        moved = half * shape / np.linalg.norm(shape, axis=1).max() + rng.normal(0, 0.5, (63, 2))
        tracker = tracker_of(plain, gel)
        for motion in (moved, np.zeros((63, 2))):
            now = tracker.update(dotted(plain, gel, motion))
            true = gel.markers + motion
            whole = ((true > 4) & (true < [WIDTH - 5, HEIGHT - 5])).all(1)
            error = np.linalg.norm(now.positions.reshape(-1, 2) - true, axis=1)
            assert now.found.reshape(-1)[whole].all() and error[whole].max() < 0.5


@pytest.mark.parametrize(
    ("degrees", "scale", "shift"), [(12, 1.0, 4), (-20, 0.9, 0), (3, 1.15, -6)]
)
def test_the_grid_is_ordered_however_it_lies(
    gel: SensorInstance, degrees: float, scale: float, shift: float
) -> None:
    matrix = cv2.getRotationMatrix2D((159.5, 119.5), degrees, 0.8 * scale)
    matrix[:, 2] += shift
    image = cv2.warpAffine(
        dotted(untouched(gel, 1)[0], gel), matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE
    )
    expected = gel.markers @ matrix[:, :2].T + matrix[:, 2]
    markers = find_markers(image, DOTS, gel.pixel_pitch / 0.8)
    assert markers.found.all()
    assert np.abs(markers.positions.reshape(-1, 2) - expected).max() < 0.3


@pytest.mark.parametrize(("rows", "columns", "pitch"), [(5, 7, 44), (6, 8, 36), (11, 15, 21)])
def test_another_grid_is_found_in_the_image(rows: int, columns: int, pitch: float) -> None:
    image, cells = untouched(MINI, 1)[0], np.indices((rows, columns))[::-1].reshape(2, -1).T
    dots = (cells + 0.5) * pitch + np.array([4.3, 7.6])
    draw(image, dots.astype(np.float32), 0.23 * pitch)
    markers = find_markers(image, DOTS, MINI.pixel_pitch)
    assert markers.found.shape == (rows, columns) and markers.found.all()
    assert np.abs(markers.positions.reshape(-1, 2) - dots).max() < 0.3


def test_a_gel_without_its_markers_is_refused() -> None:
    plain = untouched(MINI, 1)[0]
    lonely = plain.copy()
    draw(lonely, np.array([[100, 80], [140, 90]], np.float32), 8.0)
    for image in (plain, lonely, np.zeros_like(plain)):
        with pytest.raises(UserError, match="63 markers"):
            find_markers(image, DOTS, MINI.pixel_pitch)


@pytest.mark.parametrize("seed", [6, 56, 70])  # 70: dots a fifth larger in the image
def test_dots_of_another_unit_are_painted_out_whole(seed: int) -> None:
    """Rims left over look like a touch, and `deploy` refuses."""
    unit = sample_instance(DOTTED, np.random.default_rng(seed))
    plain = untouched(unit, 1)[0]
    image = dotted(plain, unit)
    dots = find_markers(image, DOTS, DOTTED.pixel_pitch)
    painted = without_markers(image, dots.positions, dots.largest_radius(DOTS))
    assert contact_strength(painted[None], plain)[0] < 7.0  # counts; refused are 12


PRESSES = {
    "ball": (Body(GLASS, (0.02,), 0.1), 5.0, None),
    "small ball": (Body(GLASS, (0.004,), 0.1), 2.0, None),
    "edge": (Body(BLOCK, (0.003, 0.003, 0.01), 0.1), 2.0, turned(2, 25)),
    "texture": (Body(CATALOGUE["golf_ball"], (0.02,), 0.1), 6.0, turned(0, 50)),
}


@pytest.mark.parametrize("sensor", [GELSIGHT_MINI, GELSIGHT, DIGIT], ids=lambda s: s.name)
@pytest.mark.parametrize("name", PRESSES)
def test_depth_comes_back(sensor: SensorModel, name: str) -> None:
    """Within 5 % of the indentation, averaged over the contact."""
    instance = sample_instance(sensor, np.random.default_rng(0), NO_RANDOMIZATION)
    body, force, rotation = PRESSES[name]
    frame = press(body, force, sensor, instance, rotation)
    background = Background(untouched(instance, 8)).image
    depth = DepthEstimator(instance.calibration).estimate(frame.image, background)
    contact = frame.depth > 0.05 * frame.depth.max()
    assert contact.mean() > 0.02
    assert np.abs(depth - frame.depth)[contact].mean() < 0.05 * frame.depth.max()
    assert np.abs(depth)[~contact].mean() < 0.05 * frame.depth.max()


@pytest.mark.parametrize("force", [1.0, 4.0, 10.0])
def test_force_from_depth(gel: SensorInstance, force: float) -> None:
    """On a marker gel: depth within 5 %, the normal force within 15 %."""
    frame = press(Body(GLASS, (0.015,), 0.1), force, DOTTED, gel)
    plain = untouched(gel, 1)[0]
    tracker = tracker_of(plain, gel)
    image = dotted(render(frame.surface, gel, np.random.default_rng(2)), gel, np.array([3.0, -2.0]))
    now = tracker.update(image)
    rest = without_markers(dotted(plain, gel), tracker.rest.positions, gel.marker_radius)
    depth = DepthEstimator(gel.calibration).estimate(
        without_markers(image, now.positions, gel.marker_radius), rest.astype(np.float32)
    )
    assert np.abs(depth - frame.depth).mean() < 0.05 * frame.depth.max()
    assert estimate_force(depth, gel.pixel_pitch, DOTTED) == pytest.approx(force, rel=0.15)
