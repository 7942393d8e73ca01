"""What DINO, I-JEPA and V-JEPA share: a teacher that is a moving average of what is trained, and the run.

The teacher is what is kept, measured and saved: it is steadier than its student.
"""

import copy
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.frame_history import stack_frames
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.ssl.config import SelfDistillationConfig


def frozen_copy(module: nn.Module) -> Any:
    """The same, which no gradient reaches."""
    return copy.deepcopy(module).requires_grad_(False)


@torch.no_grad()
def update_average(average: nn.Module, module: nn.Module, momentum: float) -> None:
    """Exponential moving average: average <- momentum * average + (1 - momentum) * module."""
    for mean, weight in zip(average.parameters(), module.parameters(), strict=True):
        mean.lerp_(weight, 1 - momentum)


class SelfDistillation(nn.Module):
    """A backbone that learns from its own moving average; the objective is the subclass's.

    Attributes:
        backbone: What is trained.
        teacher: Its average.
        step: Updates so far; part of the state, so that schedules go on after an interruption.
    """

    step: Int[Tensor, ""]

    def __init__(self, config: SelfDistillationConfig, backbone: TouchBackbone, steps: int) -> None:
        """Builds the teacher, equal to the backbone.

        Args:
            config: For the teacher's momentum.
            backbone: Randomly initialised.
            steps: Updates of the whole training.
        """
        super().__init__()
        self.backbone, self.teacher = backbone, frozen_copy(backbone)
        self.register_buffer("step", torch.zeros((), dtype=torch.long))
        self._momentum, self._steps = (config.momentum, config.final_momentum), max(steps, 1)

    def draw(self, count: int, generator: torch.Generator) -> dict[str, Any]:
        """What is random about a batch of so many touches: `forward`'s further arguments."""
        raise NotImplementedError

    def averaged(self) -> list[tuple[nn.Module, nn.Module]]:
        """Averages, and what they are of."""
        return [(self.teacher, self.backbone)]

    @property
    def done(self) -> float:
        """Share of the training that is done."""
        return min(self.step.item() / self._steps, 1.0)

    def update_teacher(self) -> None:
        """After every update of the weights."""
        first, last = self._momentum
        momentum = first + self.done * (last - first)
        for average, module in self.averaged():
            update_average(average, module, momentum)
        self.step += 1

    def stacked(self, touch: Tensor) -> Float[Tensor, "b c *t h w"]:
        """Touches, the frames of each newest first, as the network takes them."""
        return stack_frames(touch.float(), self.backbone.config.vit)
