"""Signs and sizes of simulated touch: where shadows fall, dots turn and objects are seen."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.papers.tacbench_rig.config import RigConfig, rig_unit
from benchmarks.papers.tacbench_rig.held_slides import simulate_slide
from touchgoal.control.tactile.markers.tracker import MarkerTracker
from touchgoal.control.tactile.sensor_models import DIGIT, GELSIGHT, GELSIGHT_MINI, SensorModel
from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI_MARKERS as DOTTED
from touchgoal.sim_envs.config import NO_RANDOMIZATION, PickPlaceConfig
from touchgoal.sim_envs.experts.pick_place import PickPlaceExpert
from touchgoal.sim_envs.object_slides import REST
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.objects import CATALOGUE, Body
from touchgoal.sim_envs.tactile.optics import colour_change
from touchgoal.sim_envs.tactile.rig.press_bench import PressBench
from touchgoal.sim_envs.tactile.sensor_instance import sample_instance


@pytest.mark.parametrize("sensor", [GELSIGHT, DIGIT], ids=lambda s: s.name)
@pytest.mark.parametrize("largest_turn", [0.0, 80.0])
def test_shadows_fall_opposite_the_bright_sides(sensor: SensorModel, largest_turn: float) -> None:
    """Each light alone on a bump: bright towards the light, shadow behind."""
    lights = replace(NO_RANDOMIZATION, azimuth=largest_turn)
    middle = np.array(sensor.image_shape) // 4
    y, x = np.mgrid[: 2 * middle[0], : 2 * middle[1]].astype(np.float32) - middle[:, None, None]
    bump = 6e-4 * np.exp(-(x**2 + y**2) / (2 * 9**2)).astype(np.float32)
    for seed in range(4):
        instance = sample_instance(sensor, np.random.default_rng(seed), lights)
        response, shadow = instance.calibration.response, instance.calibration.shadow
        slopes = np.zeros_like(response)
        slopes[:, :2] = response[:, :2]
        bright, dark = (
            colour_change(
                bump,
                replace(instance, calibration=replace(instance.calibration, response=r, shadow=s)),
            )
            for r, s in ((slopes, 0 * shadow), (0 * slopes, np.diag(np.diag(shadow))))
        )
        for channel in range(3):
            towards, away = (
                complex((change[channel] * x).sum(), (change[channel] * y).sum())
                for change in (bright, -dark)
            )
            assert abs(np.angle(-away / towards, deg=True)) < 20


def test_torsion_turns_the_dots_the_way_the_object_turns() -> None:
    unit, radius, load = rig_unit(RigConfig(seed=3)), 4e-3, 4.0
    can = Body(replace(CATALOGUE["glass_ball"], shape="cylinder"), (radius, 4e-3), 0.1)
    bench = PressBench(can, DOTTED, unit)
    bench.place(np.zeros(3))
    depth, rng = -load / DOTTED.normal_stiffness, np.random.default_rng(0)
    assert DOTTED.markers is not None
    for torsion in (8e-3, -8e-3):
        rest = bench.sense(0.0, rng).image
        tracker = MarkerTracker(rest, DOTTED.markers, DOTTED.pixel_pitch)
        tracker.update(bench.sense(load, rng, depth=depth).image)
        before = tracker.displacement
        tracker.update(bench.sense(load, rng, depth=depth, torsion=torsion).image)
        moved = tracker.displacement - before
        away = tracker.rest.positions - (np.array(rest.shape[1::-1]) - 1) / 2
        under = np.linalg.norm(away, axis=-1) * DOTTED.pixel_pitch < 0.8 * radius
        turns = (away[..., 0] * moved[..., 1] - away[..., 1] * moved[..., 0])[under]
        assert np.sign(turns.mean()) == np.sign(torsion) and np.abs(turns).mean() > 5


def test_an_object_is_seen_where_it_lies() -> None:
    """The bulge around the bar changes, too, and draws its middle towards the image's."""
    slide = simulate_slide(RigConfig(sensor="gelsight_mini", seed=5, load=(3.0, 3.0)), 0)
    h, w, _ = slide.frames.shape[1:]
    y, x = np.mgrid[:h, :w]
    for k in (REST, REST + 20, REST + 59):
        change = np.abs(slide.frames[k].astype(float) - slide.frames[0]).sum(2)
        seen = np.where(change > 25, 1.0, 0.0)  # noise stays below it
        mx, my = (seen * x).sum() / seen.sum(), (seen * y).sum() / seen.sum()
        place = np.array([mx - (w - 1) / 2, my - (h - 1) / 2]) * GELSIGHT_MINI.pixel_pitch
        assert np.linalg.norm(place - slide.pose[k, :2]) < 1.2e-3
        (xx, xy), (_, yy) = np.cov(x.ravel(), y.ravel(), aweights=seen.ravel())
        turn = np.arctan2(2 * xy, xx - yy) / 2 - slide.pose[k, 2]
        assert np.degrees(turn) == pytest.approx(0, abs=8)


def test_grasp_shows_on_both_pads_with_the_commanded_force() -> None:
    env = PickPlace(PickPlaceConfig(cameras=()))
    env.reset(seed=0, options={"object": "golf_ball", "grasp_force": 10.0})
    expert = PickPlaceExpert(env)
    for _ in range(60):
        env.step(expert.act({}))
    sensor = GELSIGHT_MINI
    for frame in env.tactile_frames:
        pressed = sensor.foundation_modulus * frame.depth[frame.mask].sum() * sensor.pixel_pitch**2
        assert pressed == pytest.approx(10.0, rel=0.25)  # the gel's smoothing moves some outside
    env.close()
