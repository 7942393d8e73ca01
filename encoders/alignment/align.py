"""Alignment of touch with frozen image and text towers (the MMWand paper, after ImageBind)."""

import copy
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm import tqdm

from touchgoal.control.errors import UserError
from touchgoal.encoders import pretrained
from touchgoal.encoders.alignment.data import Augmentation, TouchData, prepare_touch_data
from touchgoal.encoders.alignment.infonce import info_nce, loss_floor, symmetric_info_nce
from touchgoal.encoders.alignment.retrieval import evaluate_retrieval
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder, TouchEncoderConfig
from touchgoal.encoders.backbones.vit import PRESETS as VIT_PRESETS
from touchgoal.encoders.backbones.vit import random_patches
from touchgoal.encoders.towers.towers import Towers
from touchgoal.encoders.training import checkpoint as resumable
from touchgoal.episodes.touches import Touches

_ENCODER = "encoder"


@dataclass(frozen=True)
class AlignConfig:
    """How to train a touch encoder.

    Attributes:
        sensor: Name of the fingertip sensor.
        vit: Size of the touch backbone: "tiny", "small" or "huge".
        embedding_dim: Width of the shared space, when heads are trained into one.
        epochs: Passes over the touches.
        batch_size: Touches a step; all of them if there are fewer.
        optimiser: "adam" (weight decay as L2 in the gradient) or "adamw" (decoupled).
        lr: Highest learning rate.
        weight_decay: Of matrices; biases, norms and tokens have none.
        warmup: Share of the steps in which the rate rises from 0.
        final_lr: Rate at the end over `lr`, reached by a cosine; 1 keeps it constant.
        temperature: Fixed, of every term.
        text_weight: Of touch-text against touch-image, the paper's lambda.
        image_text_weight: Of image-text; only for towers not pretrained together, as it trains
            nothing but their heads.
        symmetric: Both directions of each term; otherwise touch picks images and texts.
        multi_positive: Everything of the same object (or with the same sentence) is right;
            otherwise only the partner is.
        no_contact_texts: Said of touches without contact; if empty these are left out.
        token_share: Patches of each touch seen in training. Half of them costs half and does not
            harm (FLIP, Li et al. 2023).
        augmentation: Of the touches.
        bfloat16: Autocast of the backbone. Measured: 20 times slower on a CPU without AVX-512.
        device: Of the training.
        seed: Of everything random.
    """

    sensor: str = "gelsight_mini"
    vit: Literal["tiny", "small", "huge"] = "small"
    embedding_dim: int = 256
    epochs: int = 10
    batch_size: int = 128
    optimiser: Literal["adam", "adamw"] = "adamw"
    lr: float = 1e-3
    weight_decay: float = 0.05
    warmup: float = 0.1
    final_lr: float = 0.01
    temperature: float = 0.1
    text_weight: float = 1.0
    image_text_weight: float = 1.0
    symmetric: bool = True
    multi_positive: bool = True
    no_contact_texts: tuple[str, ...] = (
        "nothing touches the sensor",
        "an untouched gel, no contact",
        "the fingertip feels nothing",
        "free in the air, touching no object",
    )
    token_share: float = 0.5
    augmentation: Augmentation = field(
        default_factory=lambda: Augmentation(shift=8, gain=0.2, offset=0.1, noise=0.03)
    )
    bfloat16: bool = False
    device: str = "cpu"
    seed: int = 0


PRESETS: dict[str, AlignConfig] = {
    # 10,000 touches in about 15 minutes on two CPU cores
    "default": AlignConfig(),
    # Section V of the paper. What it leaves open is plain here: a constant learning rate, no
    # augmentation, no touches without contact. Meant for CLIP towers and a large GPU.
    "paper": AlignConfig(
        vit="huge",
        epochs=100,
        batch_size=64,
        optimiser="adam",
        lr=1e-4,
        weight_decay=0.05,
        warmup=0.0,
        final_lr=1.0,
        temperature=0.2,
        text_weight=1.0,
        symmetric=False,
        multi_positive=False,
        no_contact_texts=(),
        token_share=1.0,
        augmentation=Augmentation(),
        device="cuda",
    ),
}


def align(
    train: Touches,
    val: Touches,
    towers: Towers,
    config: AlignConfig,
    out_dir: Path,
    recipe: dict[str, Any],
    resume: bool = False,
) -> TouchEncoder:
    """Trains a touch encoder.

    Writes `metrics.jsonl` (a line an epoch) and `checkpoint.pt` (after every epoch), and at the end
    the epoch with the best mean of both validation mAPs to `encoder/`. Killed and resumed, it ends
    with the same weights as uninterrupted.

    Args:
        train: Touches to learn from.
        val: Touches to choose the epoch by.
        towers: Frozen towers, run once over all pictures and sentences.
        config: How to train.
        out_dir: A new run's directory, or with `resume` the one to go on with.
        recipe: JSON-able; where the touches come from, kept with the weights.
        resume: Go on after the last finished epoch.

    Returns:
        The encoder as saved in `out_dir/encoder`, in evaluation mode, on the CPU.

    Raises:
        UserError: Unfit data, no such device, or a directory that does not fit `resume`.
    """
    resumable.check(out_dir, resume, config.device)
    if config.epochs < 1 or config.batch_size < 2:
        raise UserError("training needs at least 1 epoch and batches of at least 2 touches")
    data, val_data = (
        prepare_touch_data(t, towers, config.sensor, config.no_contact_texts) for t in (train, val)
    )
    run = _Run(config, towers, data)
    if resume:
        run.restore(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    for epoch in range(len(run.history), config.epochs):
        metrics = run.train_epoch(epoch) | evaluate_retrieval(run.encoder, val_data)
        run.note({"epoch": epoch + 1} | metrics)
        run.checkpoint(out_dir)
        tqdm.write(_progress_line(metrics, epoch + 1, config.epochs))
    run.encoder.load_state_dict(run.best)
    provenance = {
        **recipe,
        "align": asdict(config),
        "touches": {"train": len(data), "val": len(val_data), "objects": list(data.names)},
        "metrics": max(run.history, key=_score),
    }
    pretrained.save(run.encoder, out_dir / _ENCODER, provenance)
    return pretrained.load_aligned(out_dir / _ENCODER)


class _Run:
    """State of a training that survives a kill."""

    def __init__(self, config: AlignConfig, towers: Towers, data: TouchData) -> None:
        self.config, self.data = config, data
        shape = TouchEncoderConfig.for_towers(
            VIT_PRESETS[config.vit], towers, config.sensor, config.embedding_dim
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.encoder = TouchEncoder(shape).to(config.device)
        self.optimiser = _optimiser(self.encoder, config)
        self.history: list[dict[str, float]] = []
        self.best: dict[str, Tensor] = {}
        self.batch_size = min(config.batch_size, len(data))
        self.steps = len(data) // self.batch_size

    def train_epoch(self, epoch: int) -> dict[str, float]:
        """One pass: the mean of each loss, and the floors."""
        config = self.config
        count, size = len(self.data), self.batch_size
        generator, batches = resumable.shuffle(count, size, config.seed, epoch)
        self.encoder.train()
        sums: dict[str, float] = {}
        floors: dict[str, float] = {}
        progress = tqdm(batches, desc=f"epoch {epoch + 1}/{config.epochs}", leave=False)
        for step, rows in enumerate(progress):
            for group in self.optimiser.param_groups:
                group["lr"] = _learning_rate(config, epoch * self.steps + step, self.steps)
            batch = _embed_batch(self.encoder, self.data, rows, config, generator)
            losses = batch_losses(batch, self.encoder.config.pretrained_together, config)
            self.optimiser.zero_grad()
            losses["loss"].backward()
            self.optimiser.step()
            floors = floors or _floors(batch, config)
            for name, loss in losses.items():
                sums[name] = sums.get(name, 0.0) + loss.item()
            progress.set_postfix(loss=f"{losses['loss'].item():.3f}")
        return {name: total / self.steps for name, total in sums.items()} | floors

    def note(self, metrics: dict[str, float]) -> None:
        """Adds an epoch to the history; keeps its weights if it is the best so far."""
        if not self.history or _score(metrics) > max(map(_score, self.history)):
            self.best = copy.deepcopy(self.encoder.state_dict())
        self.history.append(metrics)

    def checkpoint(self, out_dir: Path) -> None:
        """Writes everything needed to go on."""
        state = {
            "encoder": self.encoder.state_dict(),
            "best": self.best,
            "optimiser": self.optimiser.state_dict(),
        }
        resumable.save(out_dir, self._setting(), state, self.history)

    def restore(self, out_dir: Path) -> None:
        """Reads a checkpoint; UserError if it is of another training."""
        state = resumable.restore(out_dir, self._setting(), self.config.device)
        self.encoder.load_state_dict(state["encoder"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.best, self.history = state["best"], state["history"]

    def _setting(self) -> str:
        parts = asdict(self.config), asdict(self.encoder.config), len(self.data), self.data.names
        return json.dumps(parts)


def _optimiser(encoder: TouchEncoder, config: AlignConfig) -> torch.optim.Optimizer:
    matrices = [p for p in encoder.parameters() if p.ndim in (2, 4)]
    others = [p for p in encoder.parameters() if p.ndim not in (2, 4)]
    kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[config.optimiser]
    groups: list[dict[str, Any]] = [
        {"params": matrices, "weight_decay": config.weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return kind(groups, lr=config.lr)


def _learning_rate(config: AlignConfig, step: int, steps_per_epoch: int) -> float:
    steps = config.epochs * steps_per_epoch
    return config.lr * resumable.warmed_cosine(step, steps, config.warmup * steps, config.final_lr)


@dataclass(frozen=True, eq=False)
class AlignedBatch:
    """b touches with their partners, as unit vectors of the shared space.

    Attributes:
        touch: Embedded touches.
        text: A sentence for each.
        image: A picture for each, meaningless where there is no contact.
        contact: Which touches have a picture.
        same: Touch i and touch j feel the same object or carry the same sentence.
    """

    touch: Float[Tensor, "b d"]
    text: Float[Tensor, "b d"]
    image: Float[Tensor, "b d"]
    contact: Bool[Tensor, " b"]
    same: Bool[Tensor, "b b"]


def _embed_batch(
    encoder: TouchEncoder,
    data: TouchData,
    rows: Int[Tensor, " b"],
    config: AlignConfig,
    generator: torch.Generator,
) -> AlignedBatch:
    device = config.device
    sentences = data.draw_sentences(rows, generator)
    touch = config.augmentation(data.touch[rows].float(), generator).to(device)
    ids_keep = None
    if config.token_share < 1:
        vit = encoder.config.vit
        ids_keep = random_patches(vit, len(rows), config.token_share, generator).to(device)
    with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=config.bfloat16):
        embedded = encoder.embed_touch(touch, ids_keep).float()
    label = data.label[rows]
    same = (label[:, None] == label) | (sentences[:, None] == sentences)
    return AlignedBatch(
        touch=embedded,
        text=encoder.project_text(data.texts[sentences].to(device)),
        image=encoder.project_image(data.images[data.view_index[rows]].to(device)),
        contact=data.contact[rows].to(device),
        same=same.to(device),
    )


def batch_losses(
    batch: AlignedBatch, pretrained_together: bool, config: AlignConfig
) -> dict[str, Float[Tensor, ""]]:
    """The weighted sum "loss" (the paper's Eq. 2) and its terms.

    Touches without contact have no picture and take part in touch-text only. A batch with fewer than two
    touches in contact has no image terms.
    """
    nce = symmetric_info_nce if config.symmetric else info_nce
    c, tau = batch.contact, config.temperature
    same = batch.same if config.multi_positive else None
    same_c = batch.same[c][:, c] if config.multi_positive else None
    terms = {"loss_touch_text": nce(batch.touch, batch.text, tau, same)}
    loss = config.text_weight * terms["loss_touch_text"]
    if c.sum() >= 2:
        terms["loss_touch_image"] = nce(batch.touch[c], batch.image[c], tau, same_c)
        loss = loss + terms["loss_touch_image"]
        if not pretrained_together:
            terms["loss_image_text"] = nce(batch.image[c], batch.text[c], tau, same_c)
            loss = loss + config.image_text_weight * terms["loss_image_text"]
    return {"loss": loss} | terms


@torch.no_grad()
def _floors(batch: AlignedBatch, config: AlignConfig) -> dict[str, float]:
    """One direction's loss on this batch beside the least that its targets would allow."""
    c = batch.contact
    floors = {}
    for name, rows, target in (("text", c | ~c, batch.text), ("image", c, batch.image)):
        if rows.sum() < 2:
            continue
        right = batch.same[rows][:, rows] if config.multi_positive else None
        loss = info_nce(batch.touch[rows], target[rows], config.temperature, right)
        floors[f"touch_to_{name}_loss"] = loss.item()
        floors[f"touch_to_{name}_floor"] = loss_floor(target[rows], config.temperature, right)
    return floors


def _score(metrics: dict[str, float]) -> float:
    return (metrics["touch_to_text_map"] + metrics["touch_to_image_map"]) / 2


def _progress_line(metrics: dict[str, float], epoch: int, epochs: int) -> str:
    m = metrics
    return (
        f"epoch {epoch}/{epochs}  loss {m['loss']:.3f}  "
        f"touch->text {m['touch_to_text_loss']:.2f} (floor {m['touch_to_text_floor']:.2f})  "
        f"top-1 text {m['touch_to_text_top1']:.1%}, image {m['touch_to_image_top1']:.1%} "
        f"(chance {m['chance_top1']:.1%})"
    )
