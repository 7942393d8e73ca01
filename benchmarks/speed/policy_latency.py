"""Time of a plan on one core, stage by stage, beside networks of published sizes.

Warm-up is left out. Networks of published sizes carry random weights.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.options import BenchmarkOptions
from benchmarks.speed.rates import one_core
from touchgoal.control import features as ft
from touchgoal.encoders.backbones.vit import ViT, ViTConfig
from touchgoal.policies.checkpoint import SHIPPED_POLICIES, SavedPolicy
from touchgoal.policies.config import SamplerConfig
from touchgoal.policies.heads.diffusion import Diffusion, DiffusionConfig
from touchgoal.policies.heads.unet import PRESETS
from touchgoal.policies.network import PolicyConfig
from touchgoal.policies.perception.end_to_end import difference_images
from touchgoal.runtime.option_types import Count, CountOrNone, checked_dataclass


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark policy-latency."""

    policy: Path | None = None
    """Folder of a policy from train-policy; default: the shipped one of bead-maze."""
    repeats: Count = 200
    """Plans to time."""
    large_repeats: CountOrNone = 5
    """Runs of each network of a published size; 0 leaves them out."""
    control_hz: Count = ft.CONTROL_HZ
    """Control ticks per second; a plan should fit into one."""


_VITS = {
    "ViT-tiny": ViTConfig((224, 224), width=192, depth=12, heads=3),
    "ViT-small": ViTConfig((224, 224), width=384, depth=12, heads=6),
    "ViT-base": ViTConfig((224, 224), width=768, depth=12, heads=12),
}


@dataclass(frozen=True)
class Stage:
    """Times of one stage, ms."""

    what: str
    median: float
    p95: float
    slowest: float


def run(config: Config) -> dict[str, Any]:
    """Time all stages on one core."""
    with one_core(), torch.inference_mode():
        stages = _stages(config) + _published(config)
    period = 1000 / config.control_hz
    lines = [f"{'one core, ms':<58}{'median':>9}{'p95':>9}{'slowest':>9}"]
    lines += [f"{s.what:<58}{s.median:>9.1f}{s.p95:>9.1f}{s.slowest:>9.1f}" for s in stages]
    lines.append(f"a tick at {config.control_hz} Hz has {period:.0f} ms")
    return {"table": "\n".join(lines), "stages": [asdict(s) for s in stages]}


def _stages(config: Config) -> list[Stage]:
    folder = config.policy or SHIPPED_POLICIES["bead-maze"]
    maker = SavedPolicy(folder)
    planner, policy = maker(), maker.network()
    ticks = _observations(policy.config, planner.env_config().camera_size)
    stages = []
    if planner.touch is not None:
        encoder = planner.touch.encoder
        frame = ticks[0][ft.TACTILE_LEFT]
        both = np.concatenate([encoder.preprocess(frame[None], frame)] * 2)
        alike = [torch.from_numpy(both)] * len(encoder.offsets)
        touch = encoder.stack(torch.stack(alike, 1))

        def preprocess() -> None:
            for key in ft.TACTILE:
                encoder.preprocess(ticks[1][key][None], ticks[0][key])

        stages.append(_time("preprocess both fingertips", config.repeats, preprocess))
        embed = partial(encoder.embed_touch, touch)
        stages.append(_time("touch encoder, both", config.repeats, embed))
    look = policy.end_to_end_encoder
    if policy.config.end_to_end is not None and look is not None:
        size = policy.config.end_to_end.size
        differences = [difference_images(ticks[1][k][None], ticks[0][k], size) for k in ft.TACTILE]
        images = torch.from_numpy(np.stack(differences, 1))
        stages.append(_time("end-to-end encoder", config.repeats, lambda: look(images)))
    condition = torch.zeros(1, policy.condition_dim)
    generator = torch.Generator().manual_seed(0)
    denoise = partial(policy.head.sample, condition, generator)
    stages.append(_time("denoising", config.repeats, denoise))
    turn, horizon = iter(range(10**9)), planner.history_ticks

    def tick() -> None:
        i = next(turn)
        planner.plan([ticks[(i + k) % 8] for k in range(horizon)])  # one tick is new, as on the arm

    stages.append(_time("a whole plan, observation to actions", config.repeats, tick))
    return stages


def _published(config: Config) -> list[Stage]:
    if config.large_repeats == 0:
        return []
    generator = torch.Generator().manual_seed(0)
    sampler = SamplerConfig("ddim", prediction_type="epsilon", num_inference_steps=16)
    head = Diffusion(DiffusionConfig(PRESETS["published"], sampler), 8, 8, 1550).eval()
    condition = torch.zeros(1, 1550)
    size = sum(p.numel() for p in head.parameters()) / 1e6
    name = f"published U-Net, {size:.0f} M, 16 DDIM steps (random weights)"
    stages = [_time(name, config.large_repeats, lambda: head.sample(condition, generator))]
    for name, vit in _VITS.items():
        backbone, both = ViT(vit).eval(), torch.zeros(2, 3, 224, 224)
        what = f"{name} at 224 x 224, both fingertips (random weights)"
        stages.append(_time(what, config.large_repeats, lambda t=backbone, b=both: t.features(b)))
    return stages


def _observations(config: PolicyConfig, camera: tuple[int, int]) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    keys = [key for key in config.proprioception if key not in config.estimated]
    images = dict.fromkeys(ft.CAMERAS, (*camera, 3))
    images |= {key: ft.FEATURES[key].shape for key in ft.TACTILE}
    return [
        {key: rng.normal(size=ft.FEATURES[key].shape).astype(np.float32) for key in keys}
        | {key: rng.integers(90, 110, shape, np.uint8) for key, shape in images.items()}
        for _ in range(8)
    ]


def _time(what: str, repeats: int, work: Callable[[], object]) -> Stage:
    for _ in range(3):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return Stage(what, float(np.median(times)), float(np.quantile(times, 0.95)), max(times))
