"""Wear of a gel on its untouched pictures: a scratch, a hole and dust are seen, noise and light are not."""

import cv2
import numpy as np
import pytest

from touchgoal.control.tactile.gel_wear import find_wear
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.sim_envs.tactile.markers import draw
from touchgoal.sim_envs.tactile.optics import render_untouched
from touchgoal.sim_envs.tactile.sensor_instance import SensorInstance, sample_instance


def look(instance: SensorInstance, rng: np.random.Generator) -> np.ndarray:
    picture = render_untouched(instance, rng)
    draw(picture, instance.markers, instance.marker_radius)
    return picture


def drawn(
    picture: np.ndarray, kind: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a scratch, a hole in the coating or a dust grain; return the picture and the place (px)."""
    h, w, _ = picture.shape
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
        change = 20 - picture.astype(float)
    else:
        cv2.circle(mask, middle, int(rng.integers(2, 5)), 255, -1, cv2.LINE_AA)
        change = -0.5 * picture
    share = cv2.GaussianBlur(mask / 255.0, (0, 0), 0.7)[..., None]
    return np.clip(picture + share * change, 0, 255).astype(np.uint8), at


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
