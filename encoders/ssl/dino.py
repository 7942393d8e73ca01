"""Self-distillation without labels (DINO: Caron et al. 2021; Sparsh) for touch.

Views are blocks of patches of the same touch, never scaled: a contact's size must stay as it is.
"""

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.backbones.vit import patch_grid
from touchgoal.encoders.ssl.config import DinoConfig
from touchgoal.encoders.ssl.masks import draw_blocks
from touchgoal.encoders.ssl.self_distillation import SelfDistillation, frozen_copy
from touchgoal.encoders.training.trainer import gather_batch, own_rows

_GLOBAL_VIEWS = 2
_GLOBAL_SCALE, _LOCAL_SCALE = (0.48, 1.0), (0.1, 0.48)  # share of the patches in a view
_STUDENT_TEMPERATURE = 0.1
# The teacher's, which is sharper, rises linearly in the first share of the steps.
_FIRST_TEMPERATURE, _TEACHER_TEMPERATURE, _TEMPERATURE_WARMUP = 0.04, 0.07, 0.07
_CENTER_MOMENTUM = 0.9  # of the teacher's mean output, which is subtracted against collapse


class DinoHead(nn.Module):
    """Three layers to a unit vector, then its cosine with every prototype."""

    def __init__(self, width: int, config: DinoConfig) -> None:
        super().__init__()
        hidden = config.head_width
        layers: list[nn.Module] = []
        for size in (width, hidden):
            layers += [nn.Linear(size, hidden)]
            layers += [_SharedBatchNorm(hidden)] if config.batch_norm else []
            layers += [nn.GELU()]
        self.mlp = nn.Sequential(*layers, nn.Linear(hidden, config.head_bottleneck))
        bottleneck, prototypes = config.head_bottleneck, config.prototypes
        self.prototypes = nn.Linear(bottleneck, prototypes, bias=False)

    def forward(self, x: Float[Tensor, "n d"]) -> Float[Tensor, "n p"]:
        """Return scores from -1 to 1."""
        unit = F.normalize(self.mlp(x).float(), dim=1)
        with torch.autocast(x.device.type, enabled=False):  # low temperatures amplify rounding
            return unit @ F.normalize(self.prototypes.weight, dim=1).T


class _SharedBatchNorm(nn.BatchNorm1d):
    """Batch norm over the batch of all processes, on any device."""

    def forward(self, input: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        if not self.training:
            return super().forward(input)
        return own_rows(super().forward(gather_batch(input)), len(input))


class Dino(SelfDistillation):
    """DINO objective: a student with its head, and the average of both."""

    center: Float[Tensor, " p"]

    def __init__(self, config: DinoConfig, backbone: TouchBackbone, steps: int) -> None:
        super().__init__(config, backbone, steps)
        self.config = config
        self.head = DinoHead(backbone.config.vit.width, config)
        self.teacher_head = frozen_copy(self.head)
        self.register_buffer("center", torch.zeros(config.prototypes))

    def averaged(self) -> list[tuple[nn.Module, nn.Module]]:
        """See `SelfDistillation`."""
        return [*super().averaged(), (self.teacher_head, self.head)]

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Any]:
        """Draw blocks of the image's shape: `global_ids` (count, 2, k), `local_ids` (count, v, j)."""
        grid, config = patch_grid(self.backbone.config.vit), self.config
        views = {"global_ids": (_GLOBAL_SCALE, _GLOBAL_VIEWS)}
        views["local_ids"] = (_LOCAL_SCALE, config.local_views)
        drawn = {}
        for name, ((low, high), blocks) in views.items():
            side = math.sqrt(low + (high - low) * torch.rand((), generator=generator).item())
            size = max(round(grid[0] * side), 1), max(round(grid[1] * side), 1)
            drawn[name] = draw_blocks(grid, size, count, blocks, generator)
        return drawn

    def forward(
        self, touch: Tensor, global_ids: Int[Tensor, "b 2 k"], local_ids: Int[Tensor, "b v j"]
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the loss, and the mutual information of touch and prototype, nats: 0 at collapse."""
        images = self.backbone.stack(touch.float())
        with torch.no_grad():
            scores = self._scores(self.teacher, self.teacher_head, images, [global_ids])
            targets = self._targets(scores)
        views = [global_ids, local_ids]
        student = self._scores(self.backbone, self.head, images, views)
        with torch.autocast(images.device.type, enabled=False):
            loss = cross_entropy_of_views(targets, student / _STUDENT_TEMPERATURE)
        if self.training:
            self._move_center(scores)
        every = gather_batch(targets.transpose(0, 1)).transpose(0, 1)
        return {"loss": loss, "teacher_information": information(every)}

    def _scores(
        self, backbone: TouchBackbone, head: DinoHead, images: Tensor, views: list[Tensor]
    ) -> Float[Tensor, "v b p"]:
        """Return the scores of every view of every touch; patches are embedded once."""
        vit = backbone.vit
        patches = vit.embed_patches(images)
        outputs = []
        for ids in views:
            count = ids.shape[1]
            tokens = vit.encode(patches.repeat(count, 1, 1), ids.transpose(0, 1).flatten(0, 1))
            registers = vit.config.registers
            read = (
                tokens[:, 0] if self.config.reads == "register" else tokens[:, registers:].mean(1)
            )
            outputs.append(read.unflatten(0, (count, len(ids))))
        read = torch.cat(outputs)
        return head(read.flatten(0, 1)).unflatten(0, read.shape[:2])

    def _targets(self, scores: Float[Tensor, "2 b p"]) -> Float[Tensor, "2 b p"]:
        """Return the teacher's distributions over prototypes."""
        warm = min(self.done / _TEMPERATURE_WARMUP, 1.0)
        rise = _TEACHER_TEMPERATURE - _FIRST_TEMPERATURE
        temperature = _FIRST_TEMPERATURE + warm * rise
        return ((scores - self.center) / temperature).softmax(2)

    @torch.no_grad()
    def _move_center(self, scores: Float[Tensor, "2 b p"]) -> None:
        mean = gather_batch(scores.flatten(0, 1)).mean(0)
        self.center.lerp_(mean, 1 - _CENTER_MOMENTUM)


def cross_entropy_of_views(
    targets: Float[Tensor, "g b p"], logits: Float[Tensor, "v b p"]
) -> Float[Tensor, ""]:
    """Return the mean over all pairs of a teacher's and another student's view (DINO's equation 3).

    The teacher has distributions for the first g views, the student for all.
    """
    pairs = -torch.einsum("gbp,vbp->gv", targets, logits.log_softmax(2)) / targets.shape[1]
    same = torch.eye(*pairs.shape, dtype=torch.bool, device=pairs.device)
    return pairs[~same].mean()


def information(targets: Float[Tensor, "v b p"]) -> Float[Tensor, ""]:
    """Return the mutual information of touch and prototype within a batch, nats."""
    common, own = torch.special.entr(targets.mean(1)).sum(1), torch.special.entr(targets).sum(2)
    return common.mean() - own.mean()
