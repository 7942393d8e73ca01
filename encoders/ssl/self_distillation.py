"""Teacher and student of DINO, I-JEPA and V-JEPA.

The teacher, a moving average of the student, is measured and saved, because it varies less.
"""

import copy
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.ssl.config import SelfDistillationConfig


def frozen_copy(module: nn.Module) -> Any:
    """Return a copy without gradients."""
    return copy.deepcopy(module).requires_grad_(False)


class SelfDistillation(nn.Module):
    """Backbone that learns from its own moving average; subclasses define the objective.

    Attributes:
        backbone: The student.
        teacher: Its average.
        step: Updates so far; part of the state, so that schedules resume.
    """

    step: Int[Tensor, ""]

    def __init__(self, config: SelfDistillationConfig, backbone: TouchBackbone, steps: int) -> None:
        """Build the teacher, equal to the backbone, for a training of `steps` updates."""
        super().__init__()
        self.backbone, self.teacher = backbone, frozen_copy(backbone)
        self.register_buffer("step", torch.zeros((), dtype=torch.long))
        self._momentum, self._steps = (config.momentum, config.final_momentum), max(steps, 1)

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Any]:
        """Draw what is random about a batch of `count` touches: `forward`'s further arguments."""
        raise NotImplementedError

    def averaged(self) -> list[tuple[nn.Module, nn.Module]]:
        """Return pairs of an average and its module."""
        return [(self.teacher, self.backbone)]

    @property
    def done(self) -> float:
        """Return the share of the training that is done."""
        return min(self.step.item() / self._steps, 1.0)

    @torch.no_grad()
    def update_teacher(self) -> None:
        """Update the averages; to be called after every update of the weights."""
        first, last = self._momentum
        momentum = first + self.done * (last - first)
        for average, module in self.averaged():
            for mean, weight in zip(average.parameters(), module.parameters(), strict=True):
                mean.lerp_(weight, 1 - momentum)
        self.step += 1
