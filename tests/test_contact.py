"""Contact on gels, touches picked from episodes, and MuJoCo's own contact forces as the oracle."""

from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.control.tactile.background import Background
from touchgoal.control.tactile.contact import (
    THRESHOLD,
    ContactDetector,
    contact_strength,
    threshold_for,
)
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.episodes.touches import collect_touches
from touchgoal.sim_envs.bead_maze import BeadMaze
from touchgoal.sim_envs.config import BeadMazeConfig
from touchgoal.sim_envs.scene.build import SIDES

HEIGHT, WIDTH = 240, 320
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
GEL = np.stack([90 + 40 * X / WIDTH, 100 + 30 * Y / HEIGHT, 110 - 30 * X / WIDTH], axis=-1)


def sensed(light: np.ndarray, bump: np.ndarray, seed: int = 0) -> np.ndarray:
    """Frames of the gel under drifting light, with a shading bump of the given heights."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((HEIGHT, WIDTH, 3), dtype=np.float32)
    shape = np.exp(-((X - 200) ** 2 + (Y - 90) ** 2) / (2 * 7.5**2))[..., None]
    frames = np.empty((len(light), HEIGHT, WIDTH, 3), np.uint8)
    for i, (gain, height) in enumerate(zip(light, bump, strict=True)):
        # shifting one field of noise by a random offset is much faster than drawing anew
        shifted = np.roll(noise, rng.integers(0, (HEIGHT, WIDTH)), axis=(0, 1))
        frames[i] = GEL * gain + height * shape * np.array([1, -0.5, 0.3]) + shifted + 0.5
    return frames


def detect_contact(
    frames: np.ndarray, background: np.ndarray, threshold: float = THRESHOLD
) -> np.ndarray:
    detector = ContactDetector(Background(background[None]), threshold)
    return np.array([detector.update(frame) for frame in frames])


def background_of(frames: np.ndarray) -> np.ndarray:
    return np.median(frames[:5], axis=0).astype(np.uint8)


def test_weak_shading_is_found_in_drifting_light() -> None:
    height = np.zeros(200)
    height[20:40] = height[140:160] = 8
    frames = sensed(1 + 0.15 * np.sin(np.arange(200) / 80), height)
    assert np.abs(frames[125].mean() - frames[0].mean()) > 10, "the light must really drift"
    np.testing.assert_array_equal(detect_contact(frames, background_of(frames)), height > 0)


def test_contact_ends_only_below_half_the_threshold() -> None:
    height = np.array([0, 0, 0, 0, 0, 1.7, 8, 1.7, 1.7, 0, 1.7], float)
    frames = sensed(np.ones(len(height)), height)
    background = background_of(frames)
    weak = contact_strength(frames, background)[[5, 7, 8, 10]]
    assert (weak > THRESHOLD / 2).all() and (weak < THRESHOLD).all()
    expected = [False] * 6 + [True] * 3 + [False] * 2
    assert detect_contact(frames, background).tolist() == expected


def test_what_a_long_contact_leaves_behind_is_no_contact() -> None:
    """Light that drifted during a strong contact stays above half the threshold; it is absorbed."""
    height = np.array([0] * 3 + [60] * 3 + [1.7] * 200, float)
    frames = sensed(np.ones(len(height)), height)
    background = background_of(frames[:3])
    assert THRESHOLD / 2 < contact_strength(frames[-1:], background)[0] < THRESHOLD
    detector = ContactDetector(Background(background[None]))
    assert [detector.update(frame) for frame in frames] == [False] * 3 + [True] * 3 + [False] * 200
    assert detector.strength < THRESHOLD / 2


def test_a_stream_that_starts_with_one_frame_learns_its_noise() -> None:
    """The first JPEG is read several times; later ones differ by compression and drifting light."""
    light = 1 + 0.002 * np.arange(80)
    height = np.zeros(80)
    height[50:70] = 25
    quality = [cv2.IMWRITE_JPEG_QUALITY, 60]
    jpegs = [cv2.imencode(".jpg", frame, quality)[1] for frame in sensed(light, height)]
    frames = np.stack([np.asarray(cv2.imdecode(jpeg, 1)) for jpeg in jpegs])
    detector = ContactDetector(Background(frames[:1]))
    touching = [detector.update(frame) for frame in (*[frames[0]] * 5, *frames[1:])][5:]
    np.testing.assert_array_equal(touching, height[1:] > 0)
    assert contact_strength(frames[1:50], frames[0]).max() > THRESHOLD, "fools a fixed one"
    assert detector.threshold > THRESHOLD


def test_a_shaking_camera_over_dots_is_no_contact() -> None:
    """Half a pixel moves every dot's rim by tens of counts; a dent in one place still shows."""
    height = np.zeros(40)
    height[25:] = 15
    frames = sensed(np.ones(40), height)
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, 40)
    for i, angle in enumerate(angles):
        for x, y in np.mgrid[16:WIDTH:32, 16:HEIGHT:32].reshape(2, -1).T:
            cv2.circle(frames[i], (int(x), int(y)), 8, (30, 30, 30), cv2.FILLED)
        shift = 0.5 * min(i, 1) * np.array([np.cos(angle), np.sin(angle)])
        matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
        size = WIDTH, HEIGHT
        frames[i] = cv2.warpAffine(frames[i], matrix, size, borderMode=cv2.BORDER_REPLICATE)
    detector = ContactDetector(Background(frames[:1]))
    assert [detector.update(frame) for frame in frames[1:]] == (height[1:] > 0).tolist()


def test_two_touched_frames_among_the_first_five_leave_the_threshold() -> None:
    """People who record clips touch early: 12 of 409 real clips do."""
    height = np.array([0, 0, 0, 40, 60], float)
    frames = sensed(np.ones(5), height)
    background = background_of(frames)
    threshold = threshold_for(frames, background)
    assert detect_contact(frames, background, threshold).tolist() == (height > 0).tolist()


def test_wrenches_and_slip_are_mujocos() -> None:
    env = BeadMaze(BeadMazeConfig(cameras=(), tactile=False))
    env.reset(seed=3)
    # rad a tick: across the wire, until the bead slips in the fingers
    for turn in [0.0] * 11 + [0.004] * 4:
        env.step(np.append(np.full(env.n_joints, turn), 0.0))
    model, data = env.model, env.data
    external = np.zeros(6)
    tcp = data.site("tcp").xpos
    for pad, side in zip(env.pad_contacts(), SIDES, strict=True):
        site, geom = data.site(f"{side}_sensor"), model.geom(f"{side}_pad").id
        wrench, fastest, others = np.zeros(6), 0.0, set()
        for i in range(data.ncon):
            contact = data.contact[i]
            if geom not in contact.geom or contact.efc_address < 0:
                continue
            towards = 1.0 if contact.geom[1] == geom else -1.0
            solved = np.zeros(6)
            mujoco.mj_contactForce(model, data, i, solved)
            force, torque = towards * solved.reshape(2, 3) @ contact.frame.reshape(3, 3)
            wrench[:3] += force
            wrench[3:] += torque + np.cross(contact.pos - site.xpos, force)
            external[:3] += force
            external[3:] += torque + np.cross(contact.pos - tcp, force)
            sliding = np.diff([_velocity(env, g, contact.pos) for g in contact.geom], axis=0)[0]
            normal = contact.frame[:3]
            fastest = max(fastest, float(np.linalg.norm(sliding - normal * (normal @ sliding))))
            others |= set(contact.geom.tolist()) - {geom}
        local = wrench.reshape(2, 3) @ site.xmat.reshape(3, 3)
        np.testing.assert_allclose([pad.force, pad.torque], local, atol=1e-9)
        assert pad.slip_speed == pytest.approx(fastest, abs=1e-9)
        assert pad.geoms == others and others
    assert max(pad.slip_speed for pad in env.pad_contacts()) > 1e-3  # m/s
    # The wire touches no more of the robot than its bead.
    np.testing.assert_allclose(env.external_wrench(), external, atol=1e-9)
    np.testing.assert_allclose(env.contact_force(), external[:3], atol=1e-9)
    assert env.contact_force().any()


def _velocity(env: BeadMaze, geom: int, point: np.ndarray) -> np.ndarray:
    """Return the velocity (m/s) of a point (m, world frame) fixed to a geom."""
    twist, body = np.zeros(6), env.model.geom_bodyid[geom]
    mujoco.mj_objectVelocity(env.model, env.data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
    return twist[3:] + np.cross(twist[:3], point - env.data.xpos[body])


def touch_episode(seed: int, truth: bool) -> Episode:
    """Contact from frame 20 on the left and 25 on the right; none at all in episode 2."""
    n, rng = 40, np.random.default_rng(seed)
    y, x = np.mgrid[:96, :128]
    bump = np.exp(-((x - 60) ** 2 + (y - 50) ** 2) / 200)[..., None] * [30, -20, 10]
    contact = np.arange(n)[:, None] >= [20, 25] if seed != 2 else np.zeros((n, 2), bool)
    frames: dict[str, np.ndarray] = {}
    frames[ft.WRIST] = np.tile(np.arange(n, dtype=np.uint8)[:, None, None, None] * 6, (16, 16, 3))
    for side, key in enumerate(ft.TACTILE):
        gel = 100 + 20 * seed + 5 * side + rng.normal(0, 1, (n, 96, 128, 3))
        frames[key] = (gel + contact[:, side, None, None, None] * bump).astype(np.uint8)
    if truth:
        frames[ft.TRUTH_CONTACT] = contact
    descriptions = [f"feels like {seed}", "hard"]
    return Episode(frames, "touch", {"object": f"object_{seed}", "descriptions": descriptions})


@pytest.mark.parametrize("truth", [True, False])
def test_touches(tmp_path: Path, truth: bool) -> None:
    writer = EpisodeWriter(tmp_path)
    for seed in range(3):
        writer.append(touch_episode(seed, truth))
    episodes = EpisodeSet(tmp_path)
    touches = collect_touches(
        episodes, contact_frames_per_episode=8, no_contact_frames_per_episode=3, seed=0
    )
    assert len(touches) == 2 * (8 + 3) + 3
    assert [touches.object.count(name) for name in ("object_0", "object_1", "")] == [8, 8, 9]
    assert len(touches.background) == 2 * len(touches.view) == 6
    assert touches.descriptions["object_1"] == ["feels like 1", "hard"]
    bumped = touches.frames.astype(int) - touches.background[touches.background_index]
    touched = bumped[:, 50, 60, 0] > 15
    assert touched.tolist() == [name != "" for name in touches.object]
    assert np.abs(bumped[~touched].mean(axis=(1, 2, 3))).max() < 2, "the background is its own"
    # the last frame before contact is 19; five frames earlier the wrist image is 14 * 6 bright
    assert touches.view[:2].mean(axis=(1, 2, 3)) == pytest.approx(14 * 6, abs=3)
    np.testing.assert_array_equal(touches.view_index, touches.background_index // 2)
    again = collect_touches(episodes, 8, 3, seed=0)
    np.testing.assert_array_equal(again.frames, touches.frames)
    assert (collect_touches(episodes, 8, 3, seed=1).frames != touches.frames).any()


def test_a_firm_grasp_in_the_first_frames_is_no_noise() -> None:
    """It moves all dots; learnt as background, no depth of the whole run would be read."""
    dots = {"sensor": "gelsight_mini_markers", "as_deployed": True, "split": "test"}
    env = BeadMaze(BeadMazeConfig(cameras=()), **dots)
    seen, _ = env.reset(seed=7_000_001)
    detectors = {key: ContactDetector(Background(seen[key][None])) for key in ft.TACTILE}
    ticks = (env.step(np.zeros(8))[0] for _ in range(14))
    touching = [[d.update(tick[key]) for key, d in detectors.items()] for tick in ticks]
    assert touching[-1] == [True, True]
