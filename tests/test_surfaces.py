"""Random surfaces pressed by the pad simulator alone, and the encoder that is fitted to them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI
from touchgoal.encoders.pretrained import load_encoder, save
from touchgoal.encoders.whitening.covariance import inverse_square_root
from touchgoal.encoders.whitening.simulated_surfaces import (
    WhiteningConfig,
    train,
)
from touchgoal.sim_envs.tactile.rig.surface_press import (
    SurfacePose,
    overlap,
    press,
    random_pose,
    untouched,
)
from touchgoal.sim_envs.tactile.rig.surfaces import TILE, Surface, random_surface
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance

SMOOTH = np.zeros((TILE, TILE), np.float32)
LEVEL = SurfacePose((0.0, 0.0), 0.0, (0.0, 0.0), (128.0, 128.0), 0.5e-3)
SHAPE, PITCH = (120, 160), 0.118e-3


def test_a_ball_lies_in_the_gel_as_deep_as_it_is_pressed() -> None:
    """Against the circle of a sphere: at its rim the overlap of radius a is a^2 / 2R less."""
    ball = Surface("ball", 5e-3, 1.0, SMOOTH, 1.0)
    deep = overlap(ball, LEVEL, SHAPE, PITCH)
    assert deep.max() == pytest.approx(0.5e-3, abs=3e-5)
    rim = np.sqrt((deep > 0).sum() * PITCH**2 / np.pi)
    assert rim == pytest.approx(np.sqrt(2 * 5e-3 * 0.5e-3), rel=0.02)
    soft = overlap(replace(ball, firmness=0.5), LEVEL, SHAPE, PITCH)
    np.testing.assert_allclose(soft, deep / 2, atol=1e-9)


def test_a_texture_turns_with_its_body() -> None:
    """A ridge along y of the surface, turned by 90 degrees, lies along x of the image."""
    ridge = SMOOTH.copy()
    ridge[:, 126:131] = 1e-4
    surface = Surface("flat", 1e-2, 1.0, ridge, 1.0)
    for turn, axis in ((0.0, 0), (np.pi / 2, 1)):
        high = overlap(surface, replace(LEVEL, turn=turn), SHAPE, PITCH) > 0.45e-3
        spread = np.ptp(np.argwhere(high), axis=0)
        assert spread[axis] > 60 and spread[1 - axis] < 10


def test_the_same_seed_presses_the_same_surface() -> None:
    def touch() -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(3)
        unit = sample_instance(GELSIGHT_MINI, rng)
        pressed = press(random_surface(rng), random_pose(rng), unit, rng)
        return pressed, untouched(unit, rng)

    (one, rest), (other, _) = touch(), touch()
    np.testing.assert_array_equal(one, other)
    assert np.abs(one.astype(int) - rest).max() > 10


def test_every_kind_of_surface_can_be_drawn() -> None:
    rng = np.random.default_rng(0)
    drawn = [random_surface(rng) for _ in range(80)]
    assert {surface.body for surface in drawn} == {
        "flat",
        "ball",
        "cylinder",
        "edge",
        "bar",
        "corner",
    }
    assert all(np.isfinite(t.texture).all() and np.ptp(t.texture) < 3e-3 for t in drawn)


def test_whitening_undoes_a_covariance() -> None:
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(4000, 5)) @ rng.normal(size=(5, 5))
    covariance = np.cov(samples.T)
    V = inverse_square_root(covariance, 0.0)
    np.testing.assert_allclose(V.T @ covariance @ V, np.eye(5), atol=1e-8)


def test_an_encoder_fitted_to_surfaces_comes_back(tmp_path: Path) -> None:
    encoder = train(GELSIGHT_MINI, "gelsight_mini", WhiteningConfig(surfaces=16, presses=2))
    save(encoder, tmp_path, {"data": "simulated"}, half=False)
    loaded = load_encoder(tmp_path)
    rng = np.random.default_rng(1)
    unit = sample_instance(GELSIGHT_MINI, rng)
    frames = np.stack([untouched(unit, rng), press(random_surface(rng), LEVEL, unit, rng)])
    embedded = loaded.embed(frames)
    assert np.linalg.norm(embedded[1]) == pytest.approx(1, abs=0.02)
    np.testing.assert_allclose(embedded, encoder.embed(frames), atol=1e-4)


def test_the_shipped_one_loads_and_takes_the_light_out() -> None:
    rng = np.random.default_rng(0)
    unit = sample_instance(GELSIGHT_MINI, rng)
    rest = untouched(unit, rng)
    frame = press(Surface("ball", 5e-3, 1.0, SMOOTH, 1.0), LEVEL, unit, rng)
    lit = np.rint(frame * 1.1).clip(0, 255).astype(np.uint8)
    steady, brighter, other = load_encoder("gelsight_mini_surfaces").embed(
        np.stack([frame, lit, press(random_surface(rng), LEVEL, unit, rng)]), rest
    )
    assert np.linalg.norm(brighter - steady) < 0.7 * np.linalg.norm(other - steady)


def test_light_on_an_untouched_gel_is_no_touch() -> None:
    """A fifth of the lightest touch, wanted on real frames (`benchmark real-touch`): here a light ball."""
    rng = np.random.default_rng(0)
    unit = sample_instance(GELSIGHT_MINI, rng)
    rest, again = untouched(unit, rng), untouched(unit, rng)
    light = press(Surface("ball", 5e-3, 1.0, SMOOTH, 1.0), replace(LEVEL, depth=0.05e-3), unit, rng)
    frames = [again, *(np.rint(again * gain).astype(np.uint8) for gain in (0.9, 1.1)), light]
    same, darker, brighter, touched = load_encoder("gelsight_mini_surfaces").embed(
        np.stack(frames), rest
    )
    lightest = np.linalg.norm(touched - same)
    assert max(np.linalg.norm(darker - same), np.linalg.norm(brighter - same)) < 0.2 * lightest
