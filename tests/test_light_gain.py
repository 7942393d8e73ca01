"""The light of a fingertip: measured, taken out by every reader, and reported when it changes much."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.real_touch.image_force import change_statistics
from touchgoal.control import features as ft
from touchgoal.control.calibration.ball import find_circle
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import ContactDetector, contact_strength
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.image_guard import explain
from touchgoal.control.tactile.indentation import IndentationMeter
from touchgoal.control.tactile.light_gain import (
    LARGE_CHANGE,
    LightWatch,
    light_advice,
    light_gain,
    remove_gain,
)
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI, SensorModel, find_sensor
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.policies.perception.end_to_end import difference_images
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.objects import CATALOGUE, Body
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

Frame = np.ndarray
SENSORS = ("gelsight_mini", "gelsight_mini_markers", "digit", "gelsight")
DIM = np.array([0.85, 0.8, 0.9])
MINI = load(GELSIGHT_MINI.sensor_file)
WHITENED = preprocessor_for("gelsight_mini", 3)
DEPTH = DepthEstimator(MINI, 8)


def touches(sensor: SensorModel, seed: int, radius: float = 4e-3) -> tuple[Frame, Frame, float]:
    """A sensor untouched and pressed by a ball, and the share of the gel that the ball covers."""
    rng = np.random.default_rng(seed)
    bench = PressBench(
        Body(CATALOGUE["glass_ball"], (radius,), 0.1), sensor, sample_instance(sensor, rng)
    )
    bench.place(np.array([0.0, 0.0, 0.05]))
    rest = bench.sense(0.0, rng).image
    bench.place(np.zeros(3))
    touched = bench.sense(15.0, rng)
    return rest, touched.image, float((touched.overlap > 0).mean())


def lit(frame: Frame, gain: np.ndarray) -> Frame:
    return np.rint(frame * gain).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", SENSORS)
def test_any_light_is_taken_out_and_a_contact_is_not_taken_for_light(name: str) -> None:
    sensor, rng = find_sensor(name), np.random.default_rng(0)
    covered = []
    for seed in range(4):
        rest, touched, share = touches(sensor, seed, radius=(4e-3, 20e-3)[seed % 2])
        covered.append(share)
        assert np.abs(light_gain(touched, rest) - 1).max() < 0.02, share
        for gain in rng.uniform(0.2, 1.3, (4, 3)):
            now = lit(touched, gain)
            assert light_gain(now, touched) == pytest.approx(gain, rel=0.01)
            left = light_gain(remove_gain(now, rest), rest) / light_gain(touched, rest)
            assert left == pytest.approx(1, abs=0.02)
    assert max(covered) > 1 / 3


def test_images_without_light_keep_their_numbers_finite() -> None:
    rest, touched, _ = touches(GELSIGHT_MINI, 0)
    black = np.zeros_like(rest)
    for now, before in ((black, rest), (touched, black), (lit(rest, np.full(3, 9.0)), rest)):
        assert np.isfinite(remove_gain(now, before)).all()
    assert light_gain(touched, black) == pytest.approx(1)


def detector_strength(frame: Frame, rest: Frame) -> np.ndarray:
    detector = ContactDetector(Background(rest[None]), threshold=1.2)
    return np.array([detector.update(frame) and detector.strength])


def followed_indentation(frame: Frame, rest: Frame) -> np.ndarray:
    """Return the indentation after a second without contact in the light of the frame."""
    meter = IndentationMeter(GELSIGHT_MINI, rest)
    alone, rng = lit(rest, light_gain(frame, rest)), np.random.default_rng(0)
    for _ in range(25):
        meter.measure(np.rint(alone + rng.normal(0, 0.5, rest.shape)).clip(0, 255).astype(np.uint8))
    return 1e3 * np.array([meter.measure(frame)])


READERS: dict[str, Callable[[Frame, Frame], np.ndarray]] = {
    "contact strength": lambda frame, rest: contact_strength(frame[None], rest),
    "contact detector": detector_strength,
    "depth": lambda frame, rest: 1e3 * DEPTH.estimate(frame, rest.astype(np.float32)),
    "indentation": followed_indentation,
    "unexplained share": lambda frame, rest: np.array(
        [explain(DEPTH, frame, rest.astype(np.float32)).unexplained]
    ),
    "ball": find_circle,
    "force": lambda frame, rest: change_statistics(frame, rest.astype(np.float32)),
    "encoders": lambda frame, rest: preprocessor_for("gelsight_mini")(frame[None], rest),
    "whitened encoders": lambda frame, rest: WHITENED(frame[None], rest),
    "end to end": lambda frame, rest: (
        difference_images(frame[None], rest, (60, 80)).astype(float) - 128
    ),
}


@pytest.mark.parametrize("name", READERS)
def test_every_reader_reads_a_touch_alike_in_another_light(name: str) -> None:
    read = READERS[name]
    rest, touched, _ = touches(GELSIGHT_MINI, 1)
    steady, dimmed = read(touched, rest), read(lit(touched, DIM), rest)
    assert np.abs(steady).max() > 0
    assert np.abs(dimmed - steady).max() < 0.1 * np.abs(steady).max()
    assert np.abs(dimmed - steady).mean() < 0.02 * np.abs(steady).max()


def test_the_background_follows_the_light_and_still_reports_it() -> None:
    rest, _, _ = touches(GELSIGHT_MINI, 0)
    background = Background(rest[None])
    for _ in range(200):
        background.update(lit(rest, DIM))
    assert np.abs(background.steady - rest).max() < 2
    assert background.image / rest == pytest.approx(np.broadcast_to(DIM, rest.shape), abs=0.05)
    assert background.drift().large
    still = Background(rest[None])
    for _ in range(50):
        still.update(lit(rest, np.full(3, 1.04)))
    assert not still.drift().large


def test_the_environment_changes_the_light_after_the_first_image() -> None:
    config = PickPlaceConfig(cameras=(), light_change=(-0.2, 0.1, 0.0))
    images = []
    for env in (PickPlace(config), PickPlace(replace(config, light_change=(0.0,)))):
        first, _ = env.reset(seed=3)
        later, *_ = env.step(np.append(np.zeros(7), 0.08))
        images.append((first[ft.TACTILE_LEFT], later[ft.TACTILE_LEFT]))
        env.close()
    (first, later), (same, usual) = images
    np.testing.assert_array_equal(first, same)
    np.testing.assert_array_equal(later, lit(usual, np.array([0.8, 1.1, 1.0], np.float32)))


def test_a_large_change_of_the_light_is_reported_and_a_touch_is_not() -> None:
    rest, touched, _ = touches(GELSIGHT_MINI, 1)
    watch = LightWatch()
    for frame in (rest, touched):
        watch.update(dict.fromkeys(ft.TACTILE, frame))
    assert abs(watch.change) < 0.02 < LARGE_CHANGE and not light_advice([watch.change])
    watch.update({ft.TACTILE_LEFT: touched, ft.TACTILE_RIGHT: lit(rest, DIM)})
    assert watch.change == pytest.approx(-0.2, abs=0.01)
    assert "-20% after the first image in 1 of 2 episodes" in light_advice([watch.change, 0.01])
