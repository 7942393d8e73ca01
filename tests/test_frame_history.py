"""Encoders of two frames and of clips: the earlier frame is the true one, recorded or tick by tick."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_policies import TOY, toy_observations

from touchgoal.control import features as ft
from touchgoal.control.deployment.realtime import RealTimeActor
from touchgoal.encoders.backbones.touch_backbone import BATCH, TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS, ViTConfig
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.pretrained import load_encoder, save
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.network import PolicyNetwork
from touchgoal.policies.perception.frozen_touch import TouchEmbedder

STRIDE = 3
PAIR = replace(PRESETS["tiny"], channels=6)
CLIP = replace(PRESETS["tiny"], width=48, tubelet=2, frames=4)


def backbone(vit: ViTConfig) -> TouchBackbone:
    torch.manual_seed(0)
    return TouchBackbone(TouchBackboneConfig.for_sensor(vit, "gelsight_mini", STRIDE)).eval()


def pictures(n: int) -> np.ndarray:
    return np.random.default_rng(0).integers(80, 120, (n, 6, 8, 3), np.uint8)


@torch.no_grad()
def by_hand(encoder: TouchBackbone, frames: np.ndarray, i: int) -> np.ndarray:
    """What is felt at frame i, the newest frame first; the first frame stands for those before it."""
    preprocess, clip = preprocessor_for("gelsight_mini"), encoder.config.vit.tubelet > 1
    seen = [preprocess(frames[max(i - STRIDE * k, 0)][None], frames[0])[0] for k in range(4)]
    touch = np.stack(seen, 1) if clip else np.concatenate(seen[:2])
    return encoder.vit(torch.from_numpy(touch)[None])[0].mean(0).numpy()


@pytest.mark.parametrize("vit", [PAIR, CLIP], ids=["two frames", "clip of four"])
def test_recorded_frames_are_embedded_with_their_past(vit: ViTConfig, tmp_path: Path) -> None:
    encoder, frames = backbone(vit), pictures(BATCH + 4)
    found = encoder.embed_frames(frames, frames[0])
    for i in (0, 2, 5, BATCH - 1, BATCH, BATCH + 3):
        np.testing.assert_allclose(found[i], by_hand(encoder, frames, i), atol=1e-5)
    some = encoder.embed_frames(frames, frames[0], np.array([40, 7, 7]))
    np.testing.assert_allclose(some, found[[40, 7, 7]], atol=1e-5)
    save(encoder, tmp_path, {}, half=False)
    np.testing.assert_allclose(load_encoder(tmp_path).embed(frames), found, atol=1e-5)


@pytest.mark.parametrize("vit", [PRESETS["tiny"], PAIR, CLIP], ids=["one", "two", "clip"])
@pytest.mark.parametrize("real_time", [False, True])
def test_a_policy_feels_what_its_training_did(vit: ViTConfig, real_time: bool) -> None:
    """Also between plans, when nobody asks: the past is what was observed, not what was embedded."""
    touch, ticks = TouchEmbedder(backbone(vit), "toy"), toy_observations(14)
    config = replace(TOY, touch_dim=touch.dim, execution_horizon=4)
    planner, felt = LearnedPolicy(PolicyNetwork(config).eval(), touch), {}
    embed = planner._embed_touch

    def watched(history):
        rows = embed(history)
        felt[float(history[-1][ft.STATE][0])] = rows
        return rows

    planner._embed_touch = watched
    actor = RealTimeActor(planner, timeout=10.0) if real_time else planner
    for tick in ticks:
        actor.act(dict(tick))
    if isinstance(actor, RealTimeActor):
        actor.close()
    frames = {key: np.stack([tick[key] for tick in ticks]) for key in ft.TACTILE}
    sides = [touch.encoder.embed_frames(frames[key], frames[key][0]) for key in ft.TACTILE]
    recorded = np.concatenate(sides, 1)
    known = {float(tick[ft.STATE][0]): i for i, tick in enumerate(ticks)}
    assert len(felt) >= 6 and max(known[key] for key in felt) > 2 * STRIDE
    for key, rows in felt.items():
        np.testing.assert_allclose(rows, recorded[known[key]], atol=1e-5)


def test_no_frame_is_preprocessed_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    touch, ticks = TouchEmbedder(backbone(CLIP), "toy"), toy_observations(12)
    made, preprocess = [], touch._recent[ft.TACTILE_LEFT]._preprocess

    def counted(frames, background):
        made.append(frames)
        return preprocess(frames, background)

    for recent in touch._recent.values():
        monkeypatch.setattr(recent, "_preprocess", counted)
    for i in range(len(ticks)):
        touch.embed_tick(ticks[max(i - touch.reach, 0) : i + 1], ticks[0])
    assert len(made) == 2 * len(ticks)
