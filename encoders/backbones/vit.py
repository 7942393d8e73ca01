"""A plain vision transformer (Dosovitskiy et al. 2021) that takes any input size."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.control.errors import UserError


@dataclass(frozen=True)
class ViTConfig:
    """Size of a transformer.

    Attributes:
        image_size: Height and width in pixels that the backbone is meant for; other sizes work too.
        patch_size: Side of a square patch in pixels.
        channels: Input channels.
        width: Size of a token.
        depth: Number of blocks.
        heads: Attention heads; must divide `width`.
        mlp_ratio: Hidden size of a block's MLP over `width`.
        class_token: Prepend a learned token and pool by it; otherwise pool by the mean.
    """

    image_size: tuple[int, int] = (120, 160)
    patch_size: int = 16
    channels: int = 3
    width: int = 192
    depth: int = 6
    heads: int = 3
    mlp_ratio: float = 4.0
    class_token: bool = False

    def __post_init__(self) -> None:
        """Raises UserError for sizes that cannot be built."""
        if self.width % (4 * self.heads) or self.width % self.heads:
            raise UserError(
                f"ViT width {self.width} must be divisible by 4 x heads ({self.heads}): "
                "choose another width or number of heads"
            )


PRESETS: dict[str, ViTConfig] = {
    "tiny": ViTConfig(patch_size=40, width=32, depth=2, heads=2, mlp_ratio=2.0),
    "compact": ViTConfig(width=128, depth=4, heads=4),
    "small": ViTConfig(),
    # ViT-H/14 as in ImageBind and the MMWand paper, which pool by the class token.
    "huge": ViTConfig(patch_size=14, width=1280, depth=32, heads=16, class_token=True),
}


def sinusoidal_positions(rows: int, columns: int, width: int) -> Float[Tensor, "n {width}"]:
    """Fixed 2-D position codes, as in MAE (He et al. 2022): half for the row, half for the column.

    Args:
        rows: Patches from top to bottom.
        columns: Patches from left to right.
        width: Size of a code, a multiple of 4.

    Returns:
        One code a patch, row by row (n = rows * columns).
    """
    frequency = 10000.0 ** -(torch.arange(width // 4) / (width // 4))
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    angles = torch.stack([y.flatten(), x.flatten()], 1)[:, :, None] * frequency
    return torch.cat([angles.sin(), angles.cos()], -1).flatten(1)


class Block(nn.Module):
    """Pre-norm self-attention and MLP."""

    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        """Builds the two residual branches."""
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.mlp_in = nn.Linear(width, int(width * mlp_ratio))
        self.mlp_out = nn.Linear(int(width * mlp_ratio), width)

    def attention(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b n d"]:
        """Multi-head self-attention over the tokens."""
        b, n, d = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        y = F.scaled_dot_product_attention(q, k, v)
        return self.out(y.transpose(1, 2).reshape(b, n, d))

    def forward(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b n d"]:
        """One transformer block."""
        x = x + self.attention(self.norm1(x))
        return x + self.mlp_out(F.gelu(self.mlp_in(self.norm2(x))))


class ViT(nn.Module):
    """Images to tokens.

    An input whose sides are no multiples of the patch is padded with zeros at the right and the
    bottom. For background-subtracted touch, zero means an untouched gel.
    """

    def __init__(self, config: ViTConfig) -> None:
        """Builds a randomly initialised backbone."""
        super().__init__()
        self.config = config
        c = config
        self.patch = nn.Conv2d(c.channels, c.width, c.patch_size, stride=c.patch_size)
        self.class_token = nn.Parameter(torch.zeros(1, 1, c.width)) if c.class_token else None
        self.blocks = nn.ModuleList(Block(c.width, c.heads, c.mlp_ratio) for _ in range(c.depth))
        self.norm = nn.LayerNorm(c.width)
        self.apply(_initialise)
        for name, weight in self.named_parameters():
            if name.endswith((".out.weight", ".mlp_out.weight")):
                # keeps the variance of the residual stream independent of depth, as in GPT-2
                nn.init.xavier_uniform_(weight, gain=1 / math.sqrt(2 * c.depth))

    def embed_patches(self, images: Float[Tensor, "b c h w"]) -> Float[Tensor, "b n d"]:
        """Patch embeddings with positions, row by row, without the class token."""
        size = self.config.patch_size
        h, w = images.shape[2:]
        tokens = self.patch(F.pad(images, (0, -w % size, 0, -h % size)))
        rows, columns = tokens.shape[2:]
        positions = sinusoidal_positions(rows, columns, self.config.width)
        return tokens.flatten(2).transpose(1, 2) + positions.to(tokens)

    def forward(
        self, images: Float[Tensor, "b c h w"], ids_keep: Int[Tensor, "b k"] | None = None
    ) -> Float[Tensor, "b t d"]:
        """Normalised output tokens.

        Args:
            images: Preprocessed images.
            ids_keep: Indices (row by row) of the patches each image keeps; all when None. The dropped
                ones are never computed, as masked self-supervision wants.

        Returns:
            One token for each kept patch in the order of `ids_keep`; the class token, if any, first.
        """
        tokens = self.embed_patches(images)
        if ids_keep is not None:
            tokens = tokens.gather(1, ids_keep[:, :, None].expand(-1, -1, tokens.shape[2]))
        if self.class_token is not None:
            tokens = torch.cat([self.class_token.expand(len(tokens), -1, -1), tokens], 1)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)

    def features(
        self, images: Float[Tensor, "b c h w"], ids_keep: Int[Tensor, "b k"] | None = None
    ) -> Float[Tensor, "b d"]:
        """One vector an image: the class token if there is one, else the mean of the tokens."""
        tokens = self(images, ids_keep)
        return tokens[:, 0] if self.class_token is not None else tokens.mean(1)


def patch_grid(config: ViTConfig) -> tuple[int, int]:
    """Rows and columns of patches in an image of the configured size."""
    rows, columns = (-(-side // config.patch_size) for side in config.image_size)
    return rows, columns


def random_masking(
    config: ViTConfig, count: int, mask_ratio: float, generator: torch.Generator
) -> Int[Tensor, "{count} k"]:
    """Draws which patches of `count` images of the configured size to keep, for `ViT.forward`.

    Args:
        config: Size of the images and patches.
        count: Images.
        mask_ratio: Share of the patches left out, in [0, 1); at least one patch is kept.
        generator: Of the draw.
    """
    rows, columns = patch_grid(config)
    order = torch.rand(count, rows * columns, generator=generator).argsort(1)
    return order[:, : max(1, round((1 - mask_ratio) * rows * columns))]


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(
            module.weight
        )  # as MAE: right for narrow backbones as for wide ones
        nn.init.zeros_(module.bias)
    elif isinstance(module, nn.Conv2d) and module.bias is not None:
        fan_in = module.weight[0].numel()
        nn.init.trunc_normal_(module.weight, std=fan_in**-0.5)
        nn.init.zeros_(module.bias)
