"""The diffusion policy's core: representations, windows, training, files, samplers."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from accelerate.utils import send_to_device
from toy_policies import (
    DIFFUSION,
    FLOW,
    TOY,
    torch_rng,
    toy_dataset,
    toy_observations,
    toy_policy,
    toy_touch_embedder,
)

from touchgoal.control import features as ft
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.episodes.format.repair import validate
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.policies import checkpoint
from touchgoal.policies.actions import Normalizer, to_actions, to_representation
from touchgoal.policies.config import ActionRepresentation, SamplerConfig, TrainConfig
from touchgoal.policies.heads.diffusion import FLOW_TIME_SCALE, DiffusionConfig, denoise
from touchgoal.policies.heads.mlp import MLPConfig
from touchgoal.policies.heads.unet import PRESETS, UNet
from touchgoal.policies.network import PolicyConfig
from touchgoal.policies.training import train as train_module
from touchgoal.policies.training.sequence_dataset import SequenceDataset, load_recordings
from touchgoal.policies.training.train import train
from touchgoal.policies.training.training_data import find_pauses, report_pauses
from touchgoal.runtime.errors import UserError


@pytest.mark.parametrize("kind", ["delta", "relative", "absolute", "base_twist", "body_twist"])
def test_representations_round_trip(kind: ActionRepresentation) -> None:
    actions = torch.randn(5, 8, 8, generator=torch_rng())
    joints = torch.randn(5, 7, generator=torch_rng(1))
    represented = to_representation(actions, joints, kind)
    again = to_actions(represented, joints, kind)
    if kind == "body_twist":  # the same but for the elbow, which moves less
        again, actions = to_representation(again, joints, kind), represented
    torch.testing.assert_close(again, actions, rtol=1e-3, atol=1e-4)
    if kind == "absolute":
        torch.testing.assert_close(represented[:, -1, :7], joints + actions[..., :7].sum(1))


def test_windows_stay_inside_their_episode() -> None:
    windows = toy_dataset(TOY, (3, 20))
    condition, actions = windows.take(torch.tensor([0, 2, 3, 22]))
    state, done = windows.recorded.state, windows.recorded.actions
    for i, seen in enumerate(([0, 0], [1, 2], [3, 3])):
        torch.testing.assert_close(condition.state[i], state[seen])
    for i, rows in ((1, [2] * 8), (2, range(3, 11)), (3, [22] * 8)):
        torch.testing.assert_close(actions[i], done[list(rows)])
    torch.testing.assert_close(windows.actions[3], actions[2])


@pytest.mark.parametrize("head", [DIFFUSION, FLOW, MLPConfig(64, 2)])
def test_nothing_is_learned_of_what_lies_after_the_end(head) -> None:
    """Padding reaches neither the loss nor the normalizer."""
    config = replace(TOY, head=head)
    dataset = toy_dataset(config, (3, 20))
    assert dataset.action_is_pad[0].tolist() == [False] * 2 + [True] * 6
    assert dataset.action_is_pad[2].all() and not dataset.action_is_pad[3:12].any()
    rows = torch.tensor([0, 3])
    batch, actions = dataset.take(rows)
    is_pad = dataset.action_is_pad[rows]
    other = torch.where(is_pad[..., None], torch.full_like(actions, 9.0), actions)
    policy = toy_policy(config, dataset)
    losses = []
    for chunk in (actions, other):
        loss = policy(batch, chunk, BatchNoise(torch_rng()), is_pad)["loss"]
        losses.append(torch.autograd.grad(loss, list(policy.head.parameters())))
    if isinstance(head, MLPConfig):  # a U-Net sees the padding, noised, beside the rest
        for one, two in zip(*losses, strict=True):
            torch.testing.assert_close(one, two)
    everything = policy.head.loss(torch.zeros(2, 8, 8), torch.zeros(2, policy.condition_dim),
                                  BatchNoise(torch_rng()), torch.ones(2, 8, dtype=torch.bool))  # fmt: skip
    assert everything == 0
    wild = toy_dataset(config, (3, 20))
    wild.recorded.actions[[2, 22]] = 9.0  # the last tick's, never done
    for name, scale in toy_policy(config, wild).named_buffers():
        if name.startswith("action_normalizer"):
            torch.testing.assert_close(scale, dict(policy.named_buffers())[name])


def test_accelerate_moves_observations_to_a_device() -> None:
    batch, _ = toy_dataset(TOY).take(torch.tensor([0, 3]))
    moved, _ = send_to_device((batch, None), torch.device("meta"))
    assert moved.touch.is_meta and moved.state.is_meta and moved.images is None


@pytest.mark.parametrize(
    "config",
    [
        TOY,
        replace(TOY, head=FLOW, representation="absolute"),
        replace(TOY, head=DiffusionConfig(MLPConfig(64, 2))),
        replace(TOY, head=MLPConfig(64, 2), representation="delta"),
    ],
    ids=["ddim-relative", "flow-absolute", "mlp-relative", "regression-delta"],
)
def test_a_toy_batch_is_learned_by_heart(config: PolicyConfig) -> None:
    windows = toy_dataset(config, (6, 6))
    policy = toy_policy(config, windows)
    rows = torch.arange(len(windows))
    condition, actions = windows.take(rows)
    optimiser, generator = torch.optim.Adam(policy.parameters(), 5e-3), torch_rng()
    for _ in range(120):
        loss = policy(condition, actions, BatchNoise(generator), windows.action_is_pad)["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    plan = policy.plan(condition, torch_rng(3)).actions
    assert plan.shape == actions.shape
    done = ~windows.action_is_pad
    error, spread = (plan - actions)[done], (actions - actions[done].mean(0))[done]
    assert error.square().mean() < 0.1 * spread.square().mean()
    assert (plan[..., 7] == 0).all()
    assert torch.equal(plan, policy.plan(condition, torch_rng(3)).actions)


CONFIG = TrainConfig(epochs=3, batch_size=8, lr=1e-3, snapshot_epochs=2)
SEED = TrainerOptions(seed=4)


def test_a_stopped_training_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    windows, validated, about = toy_dataset(TOY), iter(range(3)), {"data": "toy"}
    validate = train_module._validate

    def killed(*args):
        if next(validated) == 2:
            raise KeyboardInterrupt
        return validate(*args)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt) as stop:
        patch.setattr(train_module, "_validate", killed)
        train(TOY, windows, windows, CONFIG, tmp_path, SEED, about)
    (note,) = stop.value.__notes__
    assert "2 of 3 epochs are saved" in note and "--resume" in note
    go_on = replace(SEED, resume=True)
    with pytest.raises(UserError, match=r"seed was 4, is 5\): resume with its own"):
        train(TOY, windows, windows, CONFIG, tmp_path, replace(go_on, seed=5), about)
    train(TOY, windows, windows, CONFIG, tmp_path, go_on, about)
    assert (tmp_path / "snapshots/epoch-0002/policy.json").is_file()
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 3
    provenance = checkpoint.POLICY_FORMAT.provenance(tmp_path / "policy")
    assert provenance["data"] == "toy" and provenance["seed"] == 4
    assert math.isfinite(provenance["metrics"]["validation_error"])


@pytest.mark.parametrize("head", [DIFFUSION, DiffusionConfig(MLPConfig(32, 1)), MLPConfig(32, 1)])
def test_a_saved_policy_plans_the_same(tmp_path: Path, head: DiffusionConfig | MLPConfig) -> None:
    config = replace(TOY, head=head, representation="absolute")
    windows = toy_dataset(config)
    policy = toy_policy(config, windows)
    for weight in policy.parameters():
        weight.data = weight.data.half().float()
    checkpoint.save(policy, tmp_path, {})
    loaded = checkpoint.load(tmp_path)
    assert loaded.config == config
    condition, _ = windows.take(torch.arange(3))
    plans = [p.plan(condition, torch_rng()).actions for p in (loaded, policy)]
    assert torch.equal(*plans)


def test_a_hand_that_only_opens_and_closes_is_sent_nothing_in_between(tmp_path: Path) -> None:
    config = replace(TOY, head=MLPConfig(32, 1))
    recorded = toy_dataset(config).recorded
    actions = recorded.actions.clone()
    actions[:, 7] = 0.08 * (torch.arange(len(actions)) % 2)
    windows = SequenceDataset(replace(recorded, actions=actions), config)
    train(config, windows, windows, CONFIG, tmp_path, SEED, {})
    policy = checkpoint.load(tmp_path / "policy")
    condition, _ = windows.take(torch.arange(8))
    widths = policy.plan(condition, torch_rng()).actions[..., 7]
    assert set(widths.unique().tolist()) <= set(policy.config.gripper_widths)
    assert sorted(policy.config.gripper_widths) == pytest.approx([0.0, 0.08])


def record_ticks(root: Path, *episodes: list[dict[str, np.ndarray]]) -> Path:
    """Record episodes; where a tick names no action, part of its state stands for one."""
    for observed in episodes:
        ticks = [{ft.ACTION: tick[ft.STATE][:8], **tick} for tick in observed]
        frames = {key: np.stack([tick[key] for tick in ticks]) for key in ticks[0]}
        EpisodeWriter(root).append(Episode(frames, "feel"))
    return root


def test_episodes_are_embedded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    embedder = toy_touch_embedder()
    config = replace(TOY, touch_dim=embedder.dim)
    ticks = toy_observations(4), toy_observations(6)
    episodes = EpisodeSet(record_ticks(tmp_path / "set/episodes", *ticks))
    first = load_recordings(episodes, [0, 1], config, embedder)
    monkeypatch.setattr(embedder, "embed", lambda *_: pytest.fail("a second embedding"))
    again = load_recordings(episodes, [1], config, embedder)
    assert first.lengths == (4, 6)
    assert torch.equal(first.touch[4:], again.touch)
    assert first.state.shape == (10, 22) and torch.equal(first.actions[4:], again.actions)
    frames = toy_observations(4)
    row = torch.from_numpy(embedder.embed_tick([frames[3]], frames[0])).half()
    torch.testing.assert_close(first.touch[3], row, rtol=1e-2, atol=1e-2)
    assert validate(tmp_path / "set/episodes") == []  # what is kept inside the set is no damage
    kept = list((tmp_path / "set/episodes/.cache/embeddings/toy").iterdir())
    assert len(kept) == 2
    for path in kept:
        np.save(path, np.load(path)[1:])
    with pytest.raises(UserError, match="is damaged: delete"):
        load_recordings(episodes, [0], config, embedder)
    blind = load_recordings(episodes, [0], replace(config, touch_dim=0, touch=""), None)
    assert blind.touch.shape == (4, 0)


def test_two_sets_beside_each_other_share_no_embeddings(tmp_path: Path) -> None:
    embedder, touches = toy_touch_embedder(), []
    config = replace(TOY, touch_dim=embedder.dim)
    for first in (0, 1):
        episodes = EpisodeSet(record_ticks(tmp_path / str(first), toy_observations(5)[first:][:4]))
        touches.append(load_recordings(episodes, [0], config, embedder).touch)
        assert torch.equal(touches[-1], torch.from_numpy(embedder.embed(episodes, 0)).half())
    assert not torch.equal(*touches)


def test_a_pause_at_the_start_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    config = replace(TOY, touch_dim=0, touch="")
    ticks = toy_observations(30)
    still = [{**ticks[0], ft.ACTION: np.zeros(8, np.float32)} for _ in range(15)]
    moving = [{**tick, ft.ACTION: np.full(8, 0.1, np.float32)} for tick in ticks[1:16]]
    episodes = EpisodeSet(record_ticks(tmp_path / "set", [*still, *moving]))
    pauses = find_pauses(episodes, [0])
    report_pauses(pauses, 20, trimmed=False)
    assert "1 of 1 episodes begin with a pause of 0.8 to 0.8 s" in capsys.readouterr().out
    trimmed = load_recordings(episodes, [0], config, None, skip=pauses)
    assert trimmed.lengths == (15,) and trimmed.actions.unique().tolist() == [pytest.approx(0.1)]


def test_the_wrench_is_learned_beyond_the_first_ticks(tmp_path: Path) -> None:
    forces = [np.full(6, 3.0 + i, np.float32) for i in range(4)]
    ticks = [{**t, ft.WRENCH: f} for t, f in zip(toy_observations(4), forces, strict=True)]
    episodes = EpisodeSet(record_ticks(tmp_path / "set", ticks))
    config = replace(TOY, touch_dim=0, touch="", proprioception=(ft.STATE, ft.WRENCH))
    for skip in ([0], [2]):
        wrench = load_recordings(episodes, [0], config, None, skip=skip).state[:, 15]
        assert wrench.tolist() == [0.0, 1.0, 2.0, 3.0][skip[0] :]


def test_the_average_follows_the_weights_by_the_published_decay() -> None:
    """1 - (1 + step)^-0.75, at most 0.9999 (diffusion_policy's EMAModel)."""
    decays = [train_module.ema_decay(step) for step in (0, 15, 80, 200_000, 220_000)]
    assert decays == pytest.approx([0.0, 0.875, 26 / 27, 0.99989426, 0.9999], abs=1e-8)
    average, weights = [torch.zeros(1)], [torch.ones(1)]
    train_module._update_average(average, weights, 15)
    assert average[0].item() == pytest.approx(0.125)


def test_a_width_that_rarely_changes_keeps_its_range() -> None:
    widths = torch.zeros(1001, 2, 1)
    widths[::500] = 0.08
    normalizer = Normalizer((2, 1))
    normalizer.fit_range(widths, share=0.98)
    assert normalizer(widths).unique().tolist() == [-1.0, 1.0]


MEAN, DEVIATION = 0.4, 0.3  # of the Gaussian that the exact flow knows


def test_unet_is_the_published_one() -> None:
    """Parameters of diffusion_policy's network for 7 actions and 1550 conditions: 87.4 M."""
    with torch.device("meta"):
        published = UNet(PRESETS["published"], 7, 1550)
    assert sum(p.numel() for p in published.parameters()) == 87_439_623


def exact_flow(x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Return the velocity that takes noise to samples of one Gaussian."""
    t = step[0] / FLOW_TIME_SCALE
    gain = (t * DEVIATION**2 - (1 - t)) / (t**2 * DEVIATION**2 + (1 - t) ** 2)
    return MEAN + gain * (x - t * MEAN)


def test_the_exact_flow_gives_the_gaussian_back() -> None:
    def network(x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        return x + (1 - step[0] / FLOW_TIME_SCALE) * exact_flow(x, step)

    noise = torch.randn(4000, 4, 1, generator=torch_rng())
    config = SamplerConfig("flow", num_inference_steps=200, clip=9)
    samples = denoise(config, network, noise, torch_rng(1))
    assert samples.mean().item() == pytest.approx(MEAN, abs=0.01)
    assert samples.std().item() == pytest.approx(DEVIATION, rel=0.03)


@pytest.mark.parametrize("predicted", ["epsilon", "sample"])
@pytest.mark.parametrize("kind", ["ddpm", "ddim"])
def test_samplers_equal_diffusers(kind: Any, predicted: Any) -> None:
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler  # here: it takes 3 s
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

    options: dict[str, Any] = {"num_train_timesteps": 100, "prediction_type": predicted}
    options |= {"beta_schedule": "squaredcos_cap_v2", "timestep_spacing": "trailing"}
    theirs: Any = (DDPMScheduler if kind == "ddpm" else DDIMScheduler)(**options)
    steps = 100 if kind == "ddpm" else 10
    theirs.set_timesteps(steps)
    config = SamplerConfig(kind, prediction_type=predicted, num_inference_steps=steps)
    x = noise = torch.randn(3, 8, 2, generator=torch_rng())
    generator, more = torch_rng(1), {"use_clipped_model_output": True} if kind == "ddim" else {}
    for t in theirs.timesteps:
        x = theirs.step(x.tanh(), t, x, generator=generator, **more).prev_sample
    ours = denoise(config, lambda x, t: x.tanh(), noise, torch_rng(1))
    torch.testing.assert_close(ours, x, atol=1e-3, rtol=1e-3)
