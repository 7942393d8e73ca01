"""Masked autoencoding of touch (He et al. 2022; Sparsh, Higuera et al. 2024)."""

import torch
from jaxtyping import Float, Float16, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.sparsh import backbone_for
from touchgoal.encoders.backbones.touch_backbone import BATCH, TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import PRESETS as VIT_PRESETS
from touchgoal.encoders.backbones.vit import (
    Block,
    ViTConfig,
    patch_grid,
    patchify,
    random_masking,
    sinusoidal_positions,
)
from touchgoal.encoders.ssl.config import MaeConfig
from touchgoal.encoders.ssl.frames import TouchFrames
from touchgoal.encoders.ssl.validation import forces_line, read_forces
from touchgoal.runtime.errors import UserError


class MaskedAutoencoder(nn.Module):
    """Backbone, and a decoder that reconstructs hidden patches."""

    def __init__(self, config: MaeConfig, sensor: str, stride: int = 1) -> None:
        """Build both, randomly initialised; `stride` is the ticks between stacked frames.

        UserError: unknown sensor, or nothing is masked.
        """
        super().__init__()
        self.config = config
        if config.stacked:
            self.backbone = backbone_for("mae", config.vit, sensor, stride)
        else:
            preset = VIT_PRESETS[config.vit]
            self.backbone = TouchBackbone(TouchBackboneConfig.for_sensor(preset, sensor))
        vit, width = self.backbone.config.vit, config.decoder_width
        self.decoder_embed = nn.Linear(vit.width, width)
        self.mask_token = None if config.bottleneck else nn.Parameter(torch.zeros(width))
        self.decoder_blocks = nn.ModuleList(
            Block(width, config.decoder_heads, 4.0) for _ in range(config.decoder_depth)
        )
        self.decoder_norm = nn.LayerNorm(width)
        self.decoder_pred = nn.Linear(width, vit.channels * vit.patch_size**2)
        self._check_mask(vit)

    def forward(
        self, touch: Float16[Tensor, "b t 3 h w"], ids_keep: Int[Tensor, "b k"]
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the loss: the mean squared error of the reconstructed patches, in the preprocessor's units.

        With a bottleneck all patches count, otherwise the masked ones. Patches are not normalised
        to variance 1, as in He et al.: most of a touch is untouched, and would become noise at full
        size.
        """
        images = self.backbone.stack(touch.float())
        actual = patchify(images, self.backbone.config.vit)
        error = (self.reconstruct(images, ids_keep) - actual) ** 2
        if self.config.bottleneck:
            return {"loss": error.mean()}
        masked = torch.ones(error.shape[:2], device=error.device).scatter(1, ids_keep, 0.0)
        return {"loss": (error.mean(2) * masked).sum() / masked.sum()}

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw the patches that the backbone reads: `ids_keep` (count, k)."""
        vit = self.backbone.config.vit
        return {"ids_keep": random_masking(vit, self.config.mask_ratio, count, generator)}

    def reconstruct(
        self, touch: Float[Tensor, "b c h w"], ids_keep: Int[Tensor, "b k"]
    ) -> Float[Tensor, "b n p"]:
        """Return all patches, decoded from those in `ids_keep`."""
        tokens = self.decoder_embed(self.backbone.vit(touch, ids_keep))
        rows, columns = patch_grid(self.backbone.config.vit)
        b, d = len(tokens), tokens.shape[2]
        if self.mask_token is None:
            x = tokens.mean(1, keepdim=True).expand(b, rows * columns, d)
        else:
            x = self.mask_token.to(tokens).expand(b, rows * columns, d)
            x = x.scatter(1, ids_keep[:, :, None].expand(-1, -1, d), tokens)
        x = x + sinusoidal_positions(rows, columns, d).to(x)
        for block in self.decoder_blocks:
            x = block(x)
        return self.decoder_pred(self.decoder_norm(x))

    def _check_mask(self, vit: ViTConfig) -> None:
        rows, columns = patch_grid(vit)
        unmasked = random_masking(vit, self.config.mask_ratio, 1, torch.Generator()).shape[1]
        if unmasked == rows * columns and not self.config.bottleneck:
            raise UserError(
                f"mask_ratio {self.config.mask_ratio} masks none of {unmasked} patches, and without "
                "bottleneck there is nothing to learn: raise it"
            )


@torch.no_grad()
def validate(model: MaskedAutoencoder, train: TouchFrames, val: TouchFrames) -> dict[str, float]:
    """Return losses on other touches, and how well a linear probe reads forces.

    `validation_loss`, `validation_loss_of_blank` (the loss of predicting an untouched gel), and the
    metrics of `read_forces`.
    """
    vit, device = model.backbone.config.vit, model.backbone.device
    generator = torch.Generator().manual_seed(0)
    total, blank = 0.0, 0.0
    for batch in val.touch.split(BATCH):
        touch = batch.to(device)
        ids_keep = model.draw(len(touch), generator)["ids_keep"].to(device)
        total += model(touch, ids_keep)["loss"].item() * len(touch)
        images = model.backbone.stack(touch.float())
        blank += patchify(images, vit).square().mean().item() * len(touch)
    return {
        "validation_loss": total / len(val),
        "validation_loss_of_blank": blank / len(val),
        **read_forces(lambda touches: _embed(model, touches), train, val),
    }


def _embed(model: MaskedAutoencoder, touch: Tensor) -> Tensor:
    backbone = model.backbone
    batches = (backbone.stack(batch.to(backbone.device).float()) for batch in touch.split(BATCH))
    return torch.cat([backbone.embed_touch(batch) for batch in batches]).cpu()


def progress_line(metrics: dict[str, float]) -> str:
    """Return the line to print for an epoch."""
    return (
        f"loss {metrics['loss']:.4f} in training, {metrics['validation_loss']:.4f} in validation "
        f"({metrics['validation_loss_of_blank']:.4f} for an untouched gel){forces_line(metrics)}"
    )
