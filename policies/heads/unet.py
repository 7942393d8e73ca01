"""Conditional 1-D U-Net of diffusion_policy (Chi et al. 2023), over the ticks of a chunk."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from touchgoal.runtime.errors import UserError


@dataclass(frozen=True)
class UNetConfig:
    """Size of a U-Net."""

    channels: tuple[int, ...]  # of each level; every level but the last halves the number of ticks
    kernel: int = 5  # ticks a convolution covers, odd
    groups: int = 8  # of the group norms; divides every number of channels
    step_embedding_dim: int = 128  # of the diffusion step's embedding, even

    def __post_init__(self) -> None:
        if not self.channels or any(c % self.groups for c in self.channels):
            raise UserError(
                f"U-Net channels {self.channels} must be multiples of the {self.groups} groups"
            )
        if self.kernel % 2 == 0 or self.step_embedding_dim % 2:
            raise UserError("a U-Net needs an odd kernel and an even step_embedding_dim")

    @property
    def tick_multiple(self) -> int:
        """Number of which the ticks must be a multiple."""
        return 2 ** (len(self.channels) - 1)


PRESETS: dict[str, UNetConfig] = {
    "tiny": UNetConfig((16, 32), groups=4, step_embedding_dim=16),
    # diffusion_policy's config for states; its 512-1024-2048 for images differs in width alone
    "published": UNetConfig((256, 512, 1024), step_embedding_dim=256),
}


class UNet(nn.Module):
    """Network from noisy chunk, diffusion step and condition to a chunk of the same shape.

    Layers and wiring are those of `ConditionalUnet1D` in diffusion_policy, whose first level's skip
    is unused, too.
    """

    def __init__(self, config: UNetConfig, action_dim: int, condition_dim: int) -> None:
        super().__init__()
        self.config = config
        w = config.step_embedding_dim
        self.step = nn.Sequential(nn.Linear(w, 4 * w), nn.Mish(), nn.Linear(4 * w, w))

        def block(in_channels: int, out_channels: int) -> ResidualBlock:
            return ResidualBlock(in_channels, out_channels, config.kernel, config.groups)

        widths, last = config.channels, config.channels[-1]
        steps = list(zip((action_dim, *widths), widths, strict=False))
        self.down = nn.ModuleList(nn.ModuleList([block(a, b), block(b, b)]) for a, b in steps)
        self.downsample = nn.ModuleList(nn.Conv1d(n, n, 3, 2, 1) for n in widths[:-1])
        self.middle = nn.ModuleList([block(last, last), block(last, last)])
        self.up = nn.ModuleList(
            nn.ModuleList([block(2 * b, a), block(a, a)]) for a, b in reversed(steps[1:])
        )
        self.upsample = nn.ModuleList(
            nn.ConvTranspose1d(n, n, 4, 2, 1) for n in reversed(widths[:-1])
        )
        self._sizes = [2 * m.out_channels for m in self.modules() if isinstance(m, ResidualBlock)]
        # one matrix for all blocks: the same result as one per block, with fewer calls
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition_dim + w, sum(self._sizes)))
        self.out = nn.Sequential(
            _convolution(widths[0], widths[0], config.kernel, config.groups),
            nn.Conv1d(widths[0], action_dim, 1),
        )

    def forward(
        self,
        noisy: Float[Tensor, "b h a"],
        step: Float[Tensor, " b"],
        condition: Float[Tensor, "b c"],
    ) -> Float[Tensor, "b h a"]:
        """Return the network's prediction for diffusion steps of 0 to about 100.

        The number of ticks is a multiple of `UNetConfig.tick_multiple`.
        """
        given = torch.cat(
            [self.step(sinusoidal_embedding(step, self.config.step_embedding_dim)), condition], 1
        )
        films = iter(self.film(given)[:, :, None].split(self._sizes, dim=1))
        x, skips = noisy.transpose(1, 2), []
        for level, blocks in enumerate(self.down):
            for block in cast(Iterable[nn.Module], blocks):
                x = block(x, next(films))
            skips.append(x)
            if level < len(self.downsample):
                x = self.downsample[level](x)
        for block in self.middle:
            x = block(x, next(films))
        for blocks, upsample in zip(self.up, self.upsample, strict=True):
            x = torch.cat([x, skips.pop()], 1)
            for block in cast(Iterable[nn.Module], blocks):
                x = block(x, next(films))
            x = upsample(x)
        return self.out(x).transpose(1, 2)


class ResidualBlock(nn.Module):
    """Two convolutions with FiLM between them, which scales and shifts every channel."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int, groups: int):
        super().__init__()
        self.out_channels = out_channels
        self.one = _convolution(in_channels, out_channels, kernel, groups)
        self.two = _convolution(out_channels, out_channels, kernel, groups)
        self.skip = (
            nn.Identity()
            if in_channels == out_channels
            else nn.Conv1d(in_channels, out_channels, 1)
        )

    def forward(
        self, x: Float[Tensor, "b i h"], film: Float[Tensor, "b s 1"]
    ) -> Float[Tensor, "b o h"]:
        """Return as many ticks, given the scales and shifts."""
        scale, shift = film.chunk(2, dim=1)
        return self.two(torch.addcmul(shift, scale, self.one(x))) + self.skip(x)


def _convolution(in_channels: int, out_channels: int, kernel: int, groups: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv1d(in_channels, out_channels, kernel, padding=kernel // 2),
        nn.GroupNorm(groups, out_channels),
        nn.Mish(),
    )


def sinusoidal_embedding(step: Float[Tensor, " b"], width: int) -> Float[Tensor, "b {width}"]:
    """Return sines and cosines of wavelengths up to 10,000 (Vaswani et al. 2017)."""
    half = width // 2
    rate = torch.exp(torch.arange(half, device=step.device) * (-math.log(10000.0) / (half - 1)))
    angle = step[:, None] * rate
    return torch.cat([angle.sin(), angle.cos()], 1)
