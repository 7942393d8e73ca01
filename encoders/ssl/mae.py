"""Masked autoencoding of touch (He et al. 2022; Sparsh, Higuera et al. 2024): no labels needed."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from tqdm import tqdm

from touchgoal.control.errors import UserError
from touchgoal.encoders import pretrained
from touchgoal.encoders.backbones.touch_backbone import BATCH, TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS as VIT_PRESETS
from touchgoal.encoders.backbones.vit import Block, ViTConfig, random_patches, sinusoidal_positions
from touchgoal.encoders.probes.ridge import ridge_r2
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.training import checkpoint as resumable

_ENCODER = "encoder"


@dataclass(frozen=True)
class MaeConfig:
    """How to train a backbone by masked autoencoding.

    Attributes:
        sensor: Name of the fingertip sensor.
        vit: Size of the backbone.
        visible: Share of the patches that the backbone sees.
        bottleneck: The decoder sees the mean of the backbone's tokens and nothing else, so that this
            mean, which is the embedding, holds all that is needed to reconstruct the picture. Otherwise it
            sees the tokens, as published.
        decoder_width: Size of the decoder's tokens.
        decoder_depth: Its blocks.
        epochs: Passes over the touches.
        batch_size: Touches a step; all of them if there are fewer.
        lr: Highest learning rate, of AdamW; reached from 0 in a tenth of the training, left by a
            cosine to 0.
        weight_decay: Of matrices.
        device: Of the training.
        seed: Of everything random.
    """

    sensor: str = "gelsight_mini_markers"
    vit: Literal["tiny", "compact", "small"] = "compact"
    visible: float = 0.5
    bottleneck: bool = True
    decoder_width: int = 96
    decoder_depth: int = 2
    epochs: int = 30
    batch_size: int = 128
    lr: float = 1e-3
    weight_decay: float = 0.05
    device: str = "cpu"
    seed: int = 0


class MaskedAutoencoder(nn.Module):
    """A backbone, and a decoder that reconstructs what the backbone did not see."""

    def __init__(self, config: MaeConfig) -> None:
        """Builds both, randomly initialised."""
        super().__init__()
        self.config = config
        vit = VIT_PRESETS[config.vit]
        self.backbone = TouchBackbone(TouchBackboneConfig.for_sensor(vit, config.sensor))
        width = config.decoder_width
        self.decoder_embed = nn.Linear(vit.width, width)
        self.mask_token = nn.Parameter(torch.zeros(width))
        self.decoder_blocks = nn.ModuleList(
            Block(width, 4, 4.0) for _ in range(config.decoder_depth)
        )
        self.decoder_norm = nn.LayerNorm(width)
        self.decoder_pred = nn.Linear(width, vit.channels * vit.patch_size**2)

    def loss(
        self,
        touch: Float[Tensor, "b 3 h w"],
        ids_keep: Int[Tensor, "b k"],
    ) -> Float[Tensor, ""]:
        """Mean squared error of the reconstructed patches, in the preprocessor's units.

        All patches count with a bottleneck, else the unseen ones. Patches are not brought to
        variance 1, as He et al. do: most of a touch is untouched, and would be noise at full size.
        """
        error = (self.reconstruct(touch, ids_keep) - patchify(touch, self.backbone.config.vit)) ** 2
        if self.config.bottleneck:
            return error.mean()
        unseen = torch.ones(error.shape[:2], device=error.device).scatter(1, ids_keep, 0.0)
        return (error.mean(2) * unseen).sum() / unseen.sum()

    def reconstruct(
        self,
        touch: Float[Tensor, "b 3 h w"],
        ids_keep: Int[Tensor, "b k"],
    ) -> Float[Tensor, "b n p"]:
        """All patches of touches, of which the backbone sees those in `ids_keep`."""
        tokens = self.decoder_embed(self.backbone.vit(touch, ids_keep))
        rows, columns = _patch_grid(self.backbone.config.vit)
        b, d = len(tokens), tokens.shape[2]
        if self.config.bottleneck:
            x = tokens.mean(1, keepdim=True).expand(b, rows * columns, d)
        else:
            x = self.mask_token.expand(b, rows * columns, d)
            x = x.scatter(1, ids_keep[:, :, None].expand(-1, -1, d), tokens)
        x = x + sinusoidal_positions(rows, columns, d).to(x)
        for block in self.decoder_blocks:
            x = block(x)
        return self.decoder_pred(self.decoder_norm(x))


def patchify(images: Float[Tensor, "b c h w"], vit: ViTConfig) -> Float[Tensor, "b n p"]:
    """The pixels of every patch, row by row, padded with zeros as the backbone does."""
    size = vit.patch_size
    h, w = images.shape[2:]
    padded = nn.functional.pad(images, (0, -w % size, 0, -h % size))
    return nn.functional.unfold(padded, size, stride=size).transpose(1, 2)


def train_mae(
    train: TouchFrames,
    val: TouchFrames,
    config: MaeConfig,
    out_dir: Path,
    recipe: dict[str, Any],
    resume: bool = False,
) -> TouchBackbone:
    """Trains a backbone.

    Writes `metrics.jsonl` (a line an epoch), `checkpoint.pt` (after every epoch) and, at the end,
    the backbone to `encoder/`. Killed and resumed, it ends with the same weights as uninterrupted.

    Args:
        train: Touches to learn from.
        val: Touches of other episodes.
        config: How to train.
        out_dir: A new run's directory, or with `resume` the one to go on with.
        recipe: JSON-able; where the touches come from, kept with the weights.
        resume: Go on after the last finished epoch.

    Returns:
        The backbone as saved in `out_dir/encoder`, for inference, on the CPU.

    Raises:
        UserError: No such device, or a directory that does not fit `resume`.
    """
    resumable.check(out_dir, resume, config.device)
    if config.epochs < 1 or config.batch_size < 1 or not 0 < config.visible <= 1:
        raise UserError("training needs epochs and batch_size of at least 1, visible in (0, 1]")
    run = _Run(config, train)
    if resume:
        run.restore(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    for epoch in range(len(run.history), config.epochs):
        loss = {"epoch": epoch + 1, "loss": run.train_epoch(epoch)}
        run.history.append(loss | validate(run.model, train, val))
        run.checkpoint(out_dir)
        tqdm.write(_progress_line(run.history[-1], config.epochs))
    provenance = {
        **recipe,
        "mae": asdict(config),
        "touches": {"train": len(train), "val": len(val)},
        "metrics": run.history[-1],
    }
    pretrained.save(run.model.backbone, out_dir / _ENCODER, provenance)
    return pretrained.load_touch_backbone(out_dir / _ENCODER)


@torch.no_grad()
def validate(model: MaskedAutoencoder, train: TouchFrames, val: TouchFrames) -> dict[str, float]:
    """Loss on `val`, its variance, and what a linear reading of the embedding knows of the force.

    The reading (`force_r2`: shear along the image's columns and rows, normal) is fitted on 2,048
    touches of `train`, if the episodes know the force.
    """
    model.eval()
    vit, device = model.backbone.config.vit, model.mask_token.device
    generator = torch.Generator().manual_seed(0)
    total, power = 0.0, 0.0
    for batch in val.touch.split(BATCH):
        touch = batch.to(device).float()
        ids_keep = random_patches(vit, len(touch), model.config.visible, generator).to(device)
        total += model.loss(touch, ids_keep).item() * len(touch)
        power += patchify(touch, vit).square().mean().item() * len(touch)
    metrics = {"validation_loss": total / len(val), "validation_power": power / len(val)}
    if train.wrench is None or val.wrench is None:
        return metrics
    rows = torch.linspace(0, len(train) - 1, min(2048, len(train))).long()
    fitted, tested = _embed(model.backbone, train.touch[rows]), _embed(model.backbone, val.touch)
    r2 = ridge_r2(fitted, train.wrench[rows, :3], tested, val.wrench[:, :3])
    return metrics | {
        f"force_{axis}_r2": value.item() for axis, value in zip("xyz", r2, strict=True)
    }


def _embed(backbone: TouchBackbone, touch: Tensor) -> Tensor:
    device = next(backbone.parameters()).device
    rows = [backbone.embed_touch(batch.to(device).float()) for batch in touch.split(BATCH)]
    return torch.cat(rows).cpu()


class _Run:
    """State of a training that survives a kill."""

    def __init__(self, config: MaeConfig, data: TouchFrames) -> None:
        self.config, self.data = config, data
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.model = MaskedAutoencoder(config).to(config.device)
        matrices = [p for p in self.model.parameters() if p.ndim > 1]
        others = [p for p in self.model.parameters() if p.ndim < 2]
        self.optimiser = torch.optim.AdamW(
            [
                {"params": matrices, "weight_decay": config.weight_decay},
                {"params": others, "weight_decay": 0.0},
            ],
            lr=config.lr,
        )
        self.history: list[dict[str, float]] = []
        self.batch_size = min(config.batch_size, len(data))
        self.steps = len(data) // self.batch_size

    def train_epoch(self, epoch: int) -> float:
        """One pass, its mean loss."""
        config = self.config
        count, size = len(self.data), self.batch_size
        generator, batches = resumable.shuffle(count, size, config.seed, epoch)
        vit = self.model.backbone.config.vit
        self.model.train()
        total = 0.0
        for i, rows in enumerate(tqdm(batches, desc=f"epoch {epoch + 1}", leave=False)):
            for group in self.optimiser.param_groups:
                group["lr"] = config.lr * self._warmed(epoch * self.steps + i)
            ids_keep = random_patches(vit, len(rows), config.visible, generator)
            touch = self.data.touch[rows].to(config.device).float()
            loss = self.model.loss(touch, ids_keep.to(config.device))
            self.optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
            self.optimiser.step()
            total += loss.item()
        return total / self.steps

    def checkpoint(self, out_dir: Path) -> None:
        """Writes everything needed to go on."""
        state = {"model": self.model.state_dict(), "optimiser": self.optimiser.state_dict()}
        resumable.save(out_dir, self._setting(), state, self.history)

    def restore(self, out_dir: Path) -> None:
        """Reads a checkpoint; UserError if it is of another training."""
        state = resumable.restore(out_dir, self._setting(), self.config.device)
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.history = state["history"]

    def _warmed(self, step: int) -> float:
        steps = self.config.epochs * self.steps
        return resumable.warmed_cosine(step, steps, steps // 10)

    def _setting(self) -> str:
        return json.dumps((asdict(self.config), len(self.data)))


def _patch_grid(vit: ViTConfig) -> tuple[int, int]:
    rows, columns = (-(-side // vit.patch_size) for side in vit.image_size)
    return rows, columns


def _progress_line(metrics: dict[str, float], epochs: int) -> str:
    read = "  ".join(f"{k} {x:.2f}" for k, x in metrics.items() if k.startswith("force"))
    return (
        f"epoch {metrics['epoch']}/{epochs}  loss {metrics['loss']:.4f}  validation "
        f"{metrics['validation_loss']:.4f} of {metrics['validation_power']:.4f}  {read}"
    )
