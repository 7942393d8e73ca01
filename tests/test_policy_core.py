"""The diffusion policy's core: samplers against closed forms, training, windows, files."""

import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from touchgoal.control import vocabulary as v
from touchgoal.control.errors import UserError
from touchgoal.encoders.trunk import TouchTrunk, TouchTrunkConfig
from touchgoal.encoders.vit import PRESETS as VITS
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.store import EpisodeSet, EpisodeWriter
from touchgoal.policies import checkpoint, ema
from touchgoal.policies import train as train_module
from touchgoal.policies.acting import Planner, PolicyActor
from touchgoal.policies.actions import Representation, Scale, represent, to_actions
from touchgoal.policies.diffusion import DiffusionConfig, RegressionConfig
from touchgoal.policies.policy import Condition, Policy, PolicyConfig, unroll
from touchgoal.policies.realtime import RealTimeActor
from touchgoal.policies.samplers import (
    FLOW_STEPS,
    SamplerConfig,
    mend,
    signal_power,
    spoil,
    visited,
)
from touchgoal.policies.touch import TouchEmbedder
from touchgoal.policies.train import TrainConfig, train
from touchgoal.policies.unet import PRESETS, ShortConv1d, UNet
from touchgoal.policies.windows import Recorded, Windows, read

DIFFUSION = DiffusionConfig(PRESETS["tiny"], SamplerConfig(plan_steps=5))
FLOW = DiffusionConfig(PRESETS["tiny"], SamplerConfig("flow", plan_steps=5))
TOY = PolicyConfig(touch_dim=6, touch="toy", touch_width=8, head=DIFFUSION)
MEAN, DEVIATION = 0.4, 0.3  # of the Gaussian that the exact denoisers know


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def toy_windows(config: PolicyConfig, lengths: tuple[int, ...] = (9, 14), seed: int = 0) -> Windows:
    n, generator = sum(lengths), rng(seed)
    touch = torch.randn(n, config.touch_dim, generator=generator).half()
    state = 0.02 * torch.randn(n, config.state_dim, generator=generator)
    actions = 0.01 * torch.randn(n, 8, generator=generator)
    actions[:, 7] = 0.0  # a gripper that stays, as in the bead maze
    return Windows(Recorded(touch, state, actions, lengths), config)


def test_unet_is_the_published_one() -> None:
    """Parameters of diffusion_policy's network for 7 actions and 1550 conditions: 87.4 M."""
    with torch.device("meta"):
        published = UNet(PRESETS["published"], 7, 1550)
    assert sum(p.numel() for p in published.parameters()) == 87_439_623
    small = UNet(PRESETS["tiny"], 7, 5)
    chunk, step, condition = torch.randn(3, 8, 7), torch.tensor([0.0, 50.0, 99.0]), torch.ones(3, 5)
    out = small(chunk, step, condition)
    assert out.shape == chunk.shape
    assert not torch.allclose(small(chunk, step + 1, condition), out, atol=1e-5)
    assert not torch.allclose(small(chunk, step, condition + 1), out, atol=1e-5)


@pytest.mark.parametrize("ticks", [1, 2, 8])
def test_short_convolution_is_a_convolution(ticks: int) -> None:
    x, conv = torch.randn(3, 4, ticks, generator=rng()), ShortConv1d(4, 6, 5)
    expected = torch.nn.functional.conv1d(x, conv.weight, conv.bias, padding=2)
    torch.testing.assert_close(conv(x), expected)


def exact(config: SamplerConfig):
    """What a perfect network answers for samples of one Gaussian."""

    def network(x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        if config.kind == "flow":
            t = step[0] / FLOW_STEPS
            gain = (t * DEVIATION**2 - (1 - t)) / (t**2 * DEVIATION**2 + (1 - t) ** 2)
            velocity = MEAN + gain * (x - t * MEAN)
            return velocity if config.predict == "velocity" else x + (1 - t) * velocity
        power = signal_power(config.train_steps)[int(step[0])].float()
        gain = DEVIATION**2 * power.sqrt() / (DEVIATION**2 * power + 1 - power)
        clean = MEAN + gain * (x - power.sqrt() * MEAN)
        if config.predict == "sample":
            return clean
        return (x - power.sqrt() * clean) / (1 - power).sqrt()

    return network


@pytest.mark.parametrize(
    "config",
    [
        SamplerConfig("ddim", "sample", 1000, 200, clip=9),
        SamplerConfig("ddim", "epsilon", 1000, 200, clip=9),
        SamplerConfig("ddpm", "sample", 1000, 1000, clip=9),
        SamplerConfig("flow", "velocity", plan_steps=200, clip=9),
        SamplerConfig("flow", "sample", plan_steps=200, clip=9),
    ],
    ids=lambda c: f"{c.kind}-{c.predict}",
)
def test_exact_denoiser_gives_the_gaussian_back(config: SamplerConfig) -> None:
    noise = torch.randn(4000, 4, 1, generator=rng())
    samples = mend(config, exact(config), noise, rng(1))
    assert samples.mean().item() == pytest.approx(MEAN, abs=0.01)
    assert samples.std().item() == pytest.approx(DEVIATION, rel=0.03)


@pytest.mark.parametrize("predict", ["epsilon", "sample"])
def test_forward_process_has_the_schedules_statistics(predict: str) -> None:
    config = SamplerConfig(predict=predict, train_steps=10)  # pyright: ignore[reportArgumentType]
    clean = torch.full((20_000, 2, 1), 0.7)
    noisy, step, wanted = spoil(config, clean, rng())
    for t, power in enumerate(signal_power(10).tolist()):
        at = noisy[step == t]
        assert at.mean().item() == pytest.approx(0.7 * power**0.5, abs=0.05)
        assert at.std().item() == pytest.approx((1 - power) ** 0.5, rel=0.05)
    power = signal_power(10)[step.long()].float().view(-1, 1, 1)
    noise = wanted if predict == "epsilon" else (noisy - power.sqrt() * wanted) / (1 - power).sqrt()
    assert noise.std().item() == pytest.approx(1, abs=0.02)


def test_flow_goes_straight() -> None:
    clean = torch.randn(50, 4, 2, generator=rng())
    noisy, step, velocity = spoil(SamplerConfig("flow", "velocity"), clean, rng(1))
    left = 1 - step.view(-1, 1, 1) / FLOW_STEPS
    torch.testing.assert_close(noisy + left * velocity, clean)


def test_plans_start_from_noise_alone() -> None:
    assert visited(SamplerConfig(plan_steps=4)).tolist() == [99, 74, 49, 24]
    assert signal_power(100)[-1] < 1e-4
    with pytest.raises(UserError, match="ask for fewer"):
        SamplerConfig(plan_steps=101)
    with pytest.raises(UserError, match="cannot predict velocity"):
        SamplerConfig("ddim", "velocity")


@pytest.mark.parametrize("kind", ["ddpm", "ddim"])
def test_samplers_equal_diffusers(kind: str) -> None:
    diffusers = pytest.importorskip("diffusers")
    options = {
        "num_train_timesteps": 100,
        "beta_schedule": "squaredcos_cap_v2",
        "timestep_spacing": "trailing",
    }
    theirs = (diffusers.DDPMScheduler if kind == "ddpm" else diffusers.DDIMScheduler)(**options)
    steps = 100 if kind == "ddpm" else 10
    theirs.set_timesteps(steps)
    config = SamplerConfig(kind, "epsilon", plan_steps=steps)  # pyright: ignore[reportArgumentType]
    x = noise = torch.randn(3, 8, 2, generator=rng())
    generator, more = rng(1), {"use_clipped_model_output": True} if kind == "ddim" else {}
    for t in theirs.timesteps:
        x = theirs.step(x.tanh(), t, x, generator=generator, **more).prev_sample
    ours = mend(config, lambda x, t: x.tanh(), noise, rng(1))
    torch.testing.assert_close(ours, x, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("kind", ["delta", "chunk", "absolute"])
def test_representations_round_trip(kind: Representation) -> None:
    actions, joints = torch.randn(5, 8, 8, generator=rng()), torch.randn(5, 7, generator=rng(1))
    represented = represent(actions, joints, kind)
    torch.testing.assert_close(to_actions(represented, joints, kind), actions)
    if kind == "absolute":
        torch.testing.assert_close(represented[:, -1, :7], joints + actions[..., :7].sum(1))


def test_scales_round_trip_and_keep_constants() -> None:
    values = torch.randn(100, 3, generator=rng()) * torch.tensor([1e-3, 5.0, 0.0]) + 2
    scale = Scale((3,))
    scale.fit_range(values)
    scaled = scale(values)
    assert scaled.amin(0).tolist() == pytest.approx([-1, -1, 0], abs=1e-3)
    assert scaled.amax(0).tolist() == pytest.approx([1, 1, 0], abs=1e-3)
    torch.testing.assert_close(scale.inverse(scaled), values)
    assert (scale.inverse(scaled + torch.tensor([0, 0, 0.7]))[:, 2] == 2).all()


def test_average_follows_its_schedule() -> None:
    network, average = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
    ema.update(average, network, 0)
    assert torch.equal(average.weight, network.weight)  # nothing to remember yet
    assert ema.decay(15) == pytest.approx(1 - 16**-0.75) and ema.decay(10**9) == 0.9999


def test_windows_stay_inside_their_episode() -> None:
    windows = toy_windows(TOY, (3, 20))
    recorded = windows.recorded
    condition, actions = windows.take(torch.tensor([0, 2, 3, 22]))
    state, done = recorded.state, recorded.actions
    torch.testing.assert_close(condition.state[0], state[[0, 0]])
    torch.testing.assert_close(condition.state[1], state[[1, 2]])
    torch.testing.assert_close(condition.state[2], state[[3, 3]])
    torch.testing.assert_close(actions[1], done[[2] * 8])
    torch.testing.assert_close(actions[2], done[3:11])
    torch.testing.assert_close(actions[3], done[[22] * 8])
    torch.testing.assert_close(windows.actions[3], actions[2])


def policy_for(config: PolicyConfig, windows: Windows, seed: int = 0) -> Policy:
    torch.manual_seed(seed)
    policy = Policy(config)
    recorded = windows.recorded
    policy.fit_scales(recorded.touch.float(), recorded.state, windows.joints, windows.actions)
    return policy


@pytest.mark.parametrize(
    "config",
    [
        TOY,
        replace(TOY, head=FLOW, representation="absolute"),
        replace(TOY, head=RegressionConfig(64, 2), representation="delta"),
    ],
    ids=["ddim-chunk", "flow-absolute", "regression-delta"],
)
def test_a_toy_batch_is_learned_by_heart(config: PolicyConfig) -> None:
    windows = toy_windows(config, (6, 6))
    policy = policy_for(config, windows)
    condition, actions = windows.take(torch.arange(len(windows)))
    optimiser, generator = torch.optim.Adam(policy.parameters(), 5e-3), rng()
    for _ in range(120):
        loss = policy.loss(condition, actions, generator)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    plan = policy.plan(condition, rng(3))
    assert plan.shape == actions.shape
    error, spread = plan - actions, actions - actions.mean(0)
    assert error.square().mean() < 0.1 * spread.square().mean()
    assert (plan[..., 7] == 0).all()
    assert torch.equal(plan, policy.plan(condition, rng(3)))


CONFIG = TrainConfig(epochs=3, batch_size=8, lr=1e-3, snapshot_epochs=2, seed=4)


def test_a_killed_training_ends_as_an_uninterrupted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows, other = toy_windows(TOY), toy_windows(TOY, seed=1)
    whole = train(TOY, windows, other, CONFIG, tmp_path / "whole", {"data": "toy"})
    validate = train_module._Run.validate

    def killed(run, windows):
        if len(run.history) == 2:
            raise KeyboardInterrupt
        return validate(run, windows)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(train_module._Run, "validate", killed)
        train(TOY, windows, other, CONFIG, tmp_path / "killed", {})
    with pytest.raises(UserError, match="resume it"):
        train(TOY, windows, other, CONFIG, tmp_path / "killed", {})
    with pytest.raises(UserError, match="resume with its own"):
        train(TOY, windows, other, replace(CONFIG, seed=5), tmp_path / "killed", {}, resume=True)
    resumed = train(TOY, windows, other, CONFIG, tmp_path / "killed", {}, resume=True)
    for name, weight in whole.state_dict().items():
        assert torch.equal(weight, resumed.state_dict()[name]), name
    assert (tmp_path / "whole/snapshots/epoch-0002/policy.json").is_file()
    lines = [(tmp_path / run / "metrics.jsonl").read_text() for run in ("whole", "killed")]
    assert lines[0] == lines[1] and len(lines[0].splitlines()) == 3
    provenance = checkpoint.read_provenance(tmp_path / "whole/policy")
    assert provenance["data"] == "toy" and provenance["train"]["seed"] == 4
    assert math.isfinite(provenance["metrics"]["validation_error"])


@pytest.mark.parametrize("head", [DIFFUSION, RegressionConfig(32, 1)])
def test_a_saved_policy_plans_the_same(
    tmp_path: Path, head: DiffusionConfig | RegressionConfig
) -> None:
    config = replace(TOY, head=head, representation="absolute")
    windows = toy_windows(config)
    policy = policy_for(config, windows)
    for weight in policy.parameters():
        weight.data = weight.data.half().float()
    checkpoint.save(policy, tmp_path, {})
    loaded = checkpoint.load(tmp_path, touch="toy", control_hz=20)
    assert loaded.config == config
    condition, _ = windows.take(torch.arange(3))
    assert torch.equal(loaded.plan(condition, rng()), policy.plan(condition, rng()))


def feeling() -> TouchEmbedder:
    torch.manual_seed(0)
    trunk = TouchTrunk(TouchTrunkConfig.for_sensor(VITS["tiny"], "gelsight_mini"))
    return TouchEmbedder(trunk.eval(), "toy")


def toy_ticks(n: int) -> list[dict[str, np.ndarray]]:
    generator = np.random.default_rng(1)
    return [
        {
            v.STATE: generator.normal(size=15).astype(np.float32),
            v.TCP_POSE: generator.normal(size=7).astype(np.float32),
            **{k: generator.integers(0, 255, (6, 8, 3), np.uint8) for k in v.TACTILE},
        }
        for _ in range(n)
    ]


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_an_actor_does_its_plans_in_order_and_on_time(latency: int) -> None:
    touch = feeling()
    config = replace(TOY, touch_dim=touch.dim, execution_horizon=3)
    policy, ticks = policy_for(config, toy_windows(config)).eval(), toy_ticks(8)
    actor = PolicyActor(Planner(policy, touch, seed=5), latency)
    done = [actor.act(dict(tick)) for tick in ticks]  # nobody else keeps them
    rows = np.stack([touch.embed_tick(tick, ticks[0]) for tick in ticks])
    states = np.stack([np.concatenate([tick[v.STATE], tick[v.TCP_POSE]]) for tick in ticks])
    generator, expected = rng(5), []
    for asked in range(0, 8, 3):  # ticks on whose observation a plan is made
        asked = max(asked - latency, 0)
        seen = [max(asked - 1, 0), asked]
        condition = Condition(
            torch.from_numpy(rows[seen])[None], torch.from_numpy(states[seen])[None]
        )
        plan = policy.plan(condition, generator)[0].numpy()
        first = latency if expected else 0
        expected += list(plan[first : first + 3])
    np.testing.assert_allclose(done, expected[:8], rtol=1e-5)


def test_an_actor_refuses_what_it_cannot_do() -> None:
    touch = feeling()
    policy = Policy(replace(TOY, touch_dim=touch.dim))
    with pytest.raises(UserError, match="load the touch encoder"):
        Planner(policy, None)
    with pytest.raises(UserError, match="5 ticks late"):
        PolicyActor(Planner(policy, touch), latency=5)


def test_a_turn_looks_the_same_by_either_quaternion() -> None:
    state = torch.randn(5, 22)
    state[:, 18:] /= state[:, 18:].norm(dim=1, keepdim=True)
    other = torch.cat([state[:, :18], -state[:, 18:]], 1)
    seen = unroll(state, (v.STATE, v.TCP_POSE))
    torch.testing.assert_close(seen, unroll(other, (v.STATE, v.TCP_POSE)))
    matrix = np.zeros(9)
    import mujoco  # after touchgoal, which chooses the OpenGL platform

    mujoco.mju_quat2Mat(matrix, state[0, 18:].double().numpy())
    np.testing.assert_allclose(seen[0, 18:].reshape(2, 3).T, matrix.reshape(3, 3)[:, :2], atol=1e-6)


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no policy in"):
        checkpoint.load(tmp_path)
    checkpoint.save(Policy(TOY), tmp_path, {})
    with pytest.raises(UserError, match="feels through 'toy'"):
        checkpoint.load(tmp_path, touch="another")
    with pytest.raises(UserError, match="acts at 20 Hz"):
        checkpoint.load(tmp_path, control_hz=10)
    weights, path = load_file(tmp_path / "policy.safetensors"), tmp_path / "policy.json"
    save_file(weights | {"project.bias": torch.zeros(9)}, tmp_path / "policy.safetensors")
    with pytest.raises(UserError, match="project.bias is"):
        checkpoint.load(tmp_path)
    description = json.loads(path.read_text())
    path.write_text(json.dumps(description | {"format": 99}))
    with pytest.raises(UserError, match="format 99"):
        checkpoint.load(tmp_path)
    del description["config"]["head"]
    path.write_text(json.dumps(description))
    with pytest.raises(UserError, match="damaged"):
        checkpoint.load(tmp_path)


class SlowPlanner(Planner):
    """Takes its time; remembers its plans."""

    def __init__(self, policy: Policy, pause: float) -> None:
        super().__init__(policy, None)
        self.pause, self.plans = pause, []

    def plan(self, seen):
        time.sleep(self.pause if self.plans else 0.0)
        actions = super().plan(seen)
        self.plans.append((int(seen[-1][v.STATE][0]), actions))
        return actions


def test_a_late_plan_is_joined_where_it_should_be_by_now() -> None:
    """Every action is one that a plan meant for this very tick; none waits for a plan."""
    config = replace(TOY, touch_dim=0, touch="", execution_horizon=3)
    planner = SlowPlanner(policy_for(config, toy_windows(config)).eval(), pause=0.05)
    actor, done = RealTimeActor(planner), []
    for i, tick in enumerate(toy_ticks(40)):
        tick[v.STATE][0] = i
        done.append(actor.act(tick))
        time.sleep(0.02)
    actor.close()
    for i, action in enumerate(done):
        meant = [p[i - tick] for tick, p in planner.plans if 0 <= i - tick < 8]
        assert any(np.array_equal(action, m) for m in meant) or not action[:7].any()
    assert len(planner.plans) > 4 and sum(not a[:7].any() for a in done) == actor.starved
    assert len(actor.latencies) == len(planner.plans) - 1


def test_a_failing_planner_stops_the_actor() -> None:
    config = replace(TOY, touch_dim=0, touch="")
    actor = RealTimeActor(Planner(policy_for(config, toy_windows(config)).eval(), None))
    with pytest.raises(KeyError):
        actor.act({})
    actor.close()


def test_episodes_are_embedded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer, embedder = EpisodeWriter(tmp_path / "set"), feeling()
    config = replace(TOY, touch_dim=embedder.dim)
    for n in (4, 6):
        ticks = [{**tick, v.ACTION: tick[v.STATE][:8]} for tick in toy_ticks(n)]
        writer.append(Episode({k: np.stack([t[k] for t in ticks]) for k in ticks[0]}, "feel"))
    episodes, cache = EpisodeSet(tmp_path / "set"), tmp_path / "cache"
    first = read(episodes, [0, 1], config, embedder, cache)
    monkeypatch.setattr(embedder, "embed", None)  # a second embedding would fail
    again = read(episodes, [1], config, embedder, cache)
    assert first.lengths == (4, 6)
    assert torch.equal(first.touch[4:], again.touch)
    assert first.state.shape == (10, 22) and torch.equal(first.actions[4:], again.actions)
    frames = toy_ticks(4)
    row = torch.from_numpy(embedder.embed_tick(frames[3], frames[0])).half()
    torch.testing.assert_close(first.touch[3], row, rtol=1e-2, atol=1e-2)
    embedder.name = "b"
    with pytest.raises(UserError, match="other episodes or another encoder"):
        read(episodes, [0], replace(config, touch="b"), embedder, cache)
    with pytest.raises(UserError, match="make its config"):
        read(episodes, [0], config, None, cache)
    blind = read(episodes, [0], replace(config, touch_dim=0, touch=""), None, cache)
    assert blind.touch.shape == (4, 0)
    Policy(replace(config, touch_dim=0)).plan(
        Condition(blind.touch[None, :2].float(), blind.state[None, :2]), rng()
    )
