"""Estimators and the feedback expert: what a policy learns on, and what corrects it."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from toy_policies import TOY, torch_rng, toy_dataset, toy_policy

from touchgoal.control import features as ft
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.recording import EpisodeSpec, record_episode
from touchgoal.episodes.schema import CORRECTED
from touchgoal.policies import checkpoint
from touchgoal.policies.checkpoint import ESTIMATOR, SHIPPED_POLICIES, SavedPolicy
from touchgoal.policies.config import PoseEstimatorConfig, PoseTrainConfig
from touchgoal.policies.perception.known_names import NAMES
from touchgoal.policies.perception.placements import Placements, Variety, render_placements
from touchgoal.policies.perception.pose_estimator import Look, PoseEstimator
from touchgoal.policies.perception.pose_training import pose_errors, train_pose_estimator
from touchgoal.policies.perception.state_estimation import (
    ESTIMATED,
    StateEstimator,
    load_pose_estimator,
)
from touchgoal.policies.perception.target_words import WORDS_WIDTH, Appearance, embed, sentence
from touchgoal.policies.training.dagger import DaggerRoles
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import RefusedError, UserError
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.objects import CATALOGUE

CROPS = ((ft.FRONT, (0, 32, 0, 32)),)
SMALL = PoseEstimatorConfig(
    (32, 32), CROPS, 8, look=16, channels=8, keypoints=4, keypoint_features=4, width=16
)
SPOTS = {"red": (255, 0, 0), "blue": (0, 0, 255)}  # the objects; the goal is green


def spots(count: int) -> Placements:
    """Draw a red and a blue spot, of which the second is left out at times, and a green goal."""
    places = torch.stack([torch.randperm(25, generator=torch_rng(i))[:3] for i in range(count)])
    places = torch.stack([places // 5, places % 5], 2) * 6 + 4
    objects = 1 + torch.arange(count) % 2
    images = torch.full((count, 32, 32, 3), 128, dtype=torch.uint8)
    for image, place, n in zip(images, places, objects, strict=True):
        colours = [*list(SPOTS.values())[:n], (0, 255, 0)]
        for colour, (row, column) in zip(colours, [*place[:n], place[2]], strict=True):
            image[row - 1 : row + 2, column - 1 : column + 2] = torch.tensor(colour)
    start = torch.zeros(count, 2, 7)
    start[..., 3] = 1.0
    start[..., :2], start[..., 5:] = places[:, :2] / 100, places[:, 2:] / 100
    tcp = torch.randn(count, 7, generator=torch_rng())
    sentence = torch.tensor([[0, 1]]).repeat(count, 1)
    sentence[objects == 1, 1] = -1
    pixels = {ft.FRONT: places.float()}
    named = tuple(f"the {colour} spot" for colour in SPOTS)
    shift = torch.zeros(count, 3)
    return Placements({ft.FRONT: images}, tcp, shift, start, pixels, objects, sentence, named)


def test_contact_is_the_simulators_in_every_tick() -> None:
    env = PickPlace(PickPlaceConfig(camera_size=(32, 32), cameras=("front",)))
    episode = record_episode(env, EpisodeSpec(4, options={"object": "wooden_block"}))
    frames, estimator = episode.frames, StateEstimator(PoseEstimator(SMALL).eval())
    ticks = [{k: v[i] for k, v in frames.items()} for i in range(len(frames[ft.ACTION]))]
    found = np.stack([estimator.estimate(tick, ticks[0])[ft.TRUTH_CONTACT] for tick in ticks])
    assert frames[ft.TRUTH_CONTACT].any(0).all() and not frames[ft.TRUTH_CONTACT][0].any()
    np.testing.assert_array_equal(found, frames[ft.TRUTH_CONTACT])
    estimator.estimate(ticks[40], ticks[0])
    again = ticks[0] | {}  # another episode begins
    assert not estimator.estimate(again, again)[ft.TRUTH_CONTACT].any()


def test_a_hand_that_starts_elsewhere_than_in_training_is_refused() -> None:
    network = PoseEstimator(SMALL).eval()
    hands = np.array([0.45, 0, 0.26, 0, 1, 0, 0]) + [[0.03], [-0.03]] * np.eye(1, 7)
    network.tcp_normalizer.fit_mean_std(torch.from_numpy(hands).float())
    first = dict.fromkeys((ft.FRONT, *ft.TACTILE), np.zeros((32, 32, 3), np.uint8))
    for x, refused in ((0.5, False), (0.62, True)):
        tick = first | {ft.TCP_POSE: np.array([x, 0, 0.26, 0, 1, 0, 0], np.float32)}
        with (
            pytest.raises(UserError, match="near .0.45, 0.0, 0.26. m") if refused else nullcontext()
        ):
            StateEstimator(network, "the red one")._begin(tick)


GEL = np.full((120, 160, 3), 90, np.uint8)
FIRST = dict.fromkeys(ft.TACTILE, GEL) | {ft.FRONT: np.zeros((32, 32, 3), np.uint8)}
TOUCH = dict.fromkeys(ft.TACTILE, cv2.circle(GEL.copy(), (80, 60), 20, (190, 20, 140), -1))
FAR, NEAR = 0.3, 0.07  # m of the hand over the table


def test_a_moved_object_is_followed_until_the_first_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two looks must agree; an unsure one counts for nothing, a first one ends it.

    A hand that hides the object misleads once.
    """
    now = {"x": 0.0, "sure": 1.0}

    def look(*_: object) -> Look:
        start = torch.tensor([[now["x"], 0, 0, 1, 0, 0.3, 0.3]])
        sure, one = torch.full((1, 2), now["sure"]), torch.ones(1)
        return Look(start, sure, one, one, {})

    monkeypatch.setattr(PoseEstimator, "look", look)
    estimator = StateEstimator(PoseEstimator(replace(SMALL, sure=(0.3, 0.3, 0.5, 0.5))).eval())

    def followed(*steps: tuple[float, float, float, dict]) -> list[float]:
        ticks, seen = [], []
        for now["x"], now["sure"], height, more in steps:
            ticks.append({**FIRST, ft.TCP_POSE: np.eye(7, dtype=np.float32)[2] * height, **more})
            seen.append(float(estimator.estimate(ticks[-1], ticks[0])[ft.TRUTH_START][0]))
        return seen

    here, away = (0.0, 1.0, FAR, {}), (0.5, 1.0, FAR, {})
    touched = (0.9, 1.0, FAR, TOUCH)
    found = followed(here, (0.5, 0.1, FAR, {}), away, away, touched, touched)
    assert found == pytest.approx([0, 0, 0, 0.5, 0.5, 0.5])
    near = (0.02, 1.0, NEAR, {})
    found = followed(here, *(near, near, here, here) * 2)
    assert found == pytest.approx([0, 0, 0.02, 0.02, 0, 0, 0, 0, 0])
    with pytest.raises(RefusedError, match="where the object is .0.20 sure, 0.30 needed"):
        followed((0.0, 0.2, FAR, {}))


def test_a_hand_tilted_by_a_thousandth_changes_no_estimate() -> None:
    """In training it never is, and inverse kinematics leaves 1e-9: no information, but a small unit."""
    network = load_pose_estimator(SHIPPED_POLICIES["pick-place"] / ESTIMATOR)
    images = {ft.FRONT: torch.full((1, 256, 256, 3), 90, dtype=torch.uint8)}
    hand, words = torch.tensor([[0.45, 0, 0.26, 0, 1, 0, 0]]), torch.zeros(1, WORDS_WIDTH)
    tilted = hand + torch.tensor([[0, 0, 0, 1e-3, 0, 0, 1e-3]])
    still = torch.zeros(1, 3)
    found = (network(images, tcp, still, words) for tcp in (tilted, hand))
    torch.testing.assert_close(*found)


def train_pose(
    count: int, epochs: int, out: Path, options: TrainerOptions
) -> tuple[Placements, PoseEstimator]:
    """Train a small estimator on bright spots; return the spots, too."""
    torch.manual_seed(0)
    placements, sight = spots(count), PoseEstimator(SMALL)
    config = PoseTrainConfig(epochs=epochs, lr=1e-2)
    train_pose_estimator(sight, placements, config, out, options, {})
    return placements, sight


def test_a_place_is_learnt_and_words_choose(tmp_path: Path) -> None:
    placements, sight = train_pose(256, 60, tmp_path, TrainerOptions())
    errors = pose_errors(sight, placements)
    assert errors["0 others"]["object_mm"][0] < 15 and errors["1 others"]["found"] > 0.9
    rows = placements.objects == 2
    images = {ft.FRONT: placements.images[ft.FRONT][rows]}
    tcp = placements.tcp[rows]
    for k, said in enumerate(("a red dot", "a blue dot")):
        words = embed([said]).expand(len(tcp), -1)
        off = (
            sight(images, tcp, placements.shift[rows], words)[:, :2] - placements.start[rows, k, :2]
        )
        assert off.norm(dim=1).median() < 0.02  # 0.12 by chance


def test_of_two_objects_that_fit_equally_the_one_before_is_kept() -> None:
    sight, scores = PoseEstimator(SMALL).eval(), torch.full((1, 2, 4, 4), -5.0)
    scores[..., 0, 0] = scores[..., 3, 3] = 3.0
    sight.scores = lambda *_: {ft.FRONT: scores}  # type: ignore[method-assign]
    lit = {ft.FRONT: torch.zeros(1, 32, 32, 3, dtype=torch.uint8)}
    scene = sight.scene(lit, torch.zeros(1, 7), torch.zeros(1, 3))
    for end in (1.5, 25.5):
        before = {ft.FRONT: torch.full((1, 2, 2), end)}
        found = sight.look(lit, torch.zeros(1, WORDS_WIDTH), scene, before).places[ft.FRONT]
        torch.testing.assert_close(found, before[ft.FRONT], atol=0.1, rtol=0)


def test_the_surest_crop_says_how_a_box_is_turned(monkeypatch: pytest.MonkeyPatch) -> None:
    sight, lit = PoseEstimator(SMALL).eval(), {ft.FRONT: torch.zeros(1, 32, 32, 3).byte()}

    def scaled(_: object, scene: torch.Tensor, places: dict[str, torch.Tensor]) -> torch.Tensor:
        sure = places[ft.FRONT][:, 0].eq(torch.tensor([10.0, 13.0])).all(1)
        return torch.ones(len(scene), 7) * torch.where(sure, -0.9, 0.1)[:, None]

    monkeypatch.setattr(sight, "scaled", scaled)
    start, one = torch.tensor([[0.5, 0.1, 0.02, 0.1, 0.0, 0.4, 0.2]]), torch.ones(1)
    look = Look(start, torch.ones(1, 2), start[:, 3], one, {ft.FRONT: torch.full((1, 2, 2), 16.0)})
    found = sight.turned_surely(lit, torch.zeros(1, 4), look)
    assert found.turned.item() == pytest.approx(0.9 * 2**0.5)
    start[:, 3:5] = -0.9
    torch.testing.assert_close(found.start, start)


def test_a_sentence_fits_its_object_alone() -> None:
    rng = np.random.default_rng(0)
    looks = [
        Appearance(CATALOGUE[name], np.array(CATALOGUE[name].material.rgba[:3]), painted=False)
        for name in ("toy_brick", "brick", "golf_ball")
    ]
    said = [{sentence(rng, a, [b for b in looks if b is not a]) for _ in range(60)} for a in looks]
    assert not said[0] & said[1] and not said[0] & said[2]
    assert "the toy brick" in said[0] and "a white ball" in said[2]
    assert all("block" not in words or "red" in words for words in said[1] if words)
    assert sentence(rng, looks[0], [replace(looks[0]), replace(looks[0])]) is None


def test_placements_say_where_each_object_is() -> None:
    config = PickPlaceConfig(cameras=("front",), camera_size=(256, 256), tactile=False)
    usual = Variety(covered=0, repainted=0)
    placements = render_placements(config, 1, 12, seeds.POSE_VALIDATION.start, 1, usual)
    assert placements.shift.any(1).any() and not placements.shift.any(1).all()
    assert len(placements) == 12 and placements.objects.unique().tolist()[-1] > 1
    for i, n in enumerate(placements.objects):
        assert (placements.sentence[i, n:] == -1).all()
        row, column = placements.pixels[ft.FRONT][i, -1].round().long()
        red, green, blue = placements.images[ft.FRONT][i, row, column].tolist()
        assert green > red and green > blue  # the disc


SEES = (ft.STATE, ft.TCP_POSE, *ESTIMATED)
ESTIMATING = replace(TOY, touch_dim=0, touch="", proprioception=SEES, position_noise=0.0)
BLIND = PickPlaceConfig(cameras=(), tactile=False)
JOB = EpisodeSpec(1, options={"object": "wooden_block"})


@pytest.mark.parametrize("disturbance", [0.0, 0.01])
def test_it_picks_and_places_though_it_is_led_astray(disturbance: float) -> None:
    episode = record_episode(PickPlace(replace(BLIND, disturbance=disturbance)), JOB, DaggerRoles())
    assert episode.meta["success"]
    moved = np.abs(episode.frames[ft.ACTION][:, :7])
    assert moved.max() < 0.1  # rad a tick, 2 rad/s: an FR3 may turn its slowest joint as fast


def test_a_learner_acts_and_is_corrected(tmp_path: Path) -> None:
    learner = toy_policy(ESTIMATING, toy_dataset(ESTIMATING))
    checkpoint.save(learner, tmp_path / "learner", {})
    roles = DaggerRoles(SavedPolicy(tmp_path / "learner"))
    env = PickPlace(replace(BLIND, max_seconds=1.0))
    episode = record_episode(env, JOB, roles)
    assert episode.meta["outcome"] == CORRECTED
    observation, _ = env.reset(seed=JOB.seed, options=JOB.options)
    learner, expert = roles(env, JOB)
    for tick in range(20):
        answer, action = expert.act(observation), learner.act(observation)
        np.testing.assert_array_equal(episode.frames[ft.STATE][tick], observation[ft.STATE])
        np.testing.assert_allclose(episode.frames[ft.ACTION][tick], answer, atol=1e-6)
        assert not np.allclose(action, answer)
        observation, *_ = env.step(action)


def test_a_name_that_fits_nothing_is_refused_with_what_is_seen() -> None:
    """Six scenes of three objects by all names of the catalogue: those that are there, and the others."""
    network = load_pose_estimator(SHIPPED_POLICIES["pick-place"] / ESTIMATOR)
    options = {"tactile": False, "cameras": ("front",), "camera_size": (256, 256)}
    env = PickPlace(PickPlaceConfig(**options, distractors=2))
    gels = dict.fromkeys(ft.TACTILE, np.zeros((8, 8, 3), np.uint8))
    taken, refused, listed, first = [], [], [], {}
    for seed in range(6):
        first = env.reset(seed=seed)[0] | gels
        there = {body.kind.name.replace("_", " ") for body in env.bodies}
        for name in NAMES:
            why = ""
            try:
                StateEstimator(network, f"the {name}").estimate(first, first)
            except RefusedError as error:
                why = str(error)
            (taken if name in there else refused).append((why == "") == (name in there))
            listed += [n in why for n in there] if "looks like" in why else []
    assert np.mean(taken) > 0.9 and np.mean(refused) > 0.7 and np.mean(listed) > 0.7
    with pytest.raises(RefusedError, match="may be what is meant: it sees .*: name one"):
        StateEstimator(network).estimate(first, first)
