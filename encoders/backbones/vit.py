"""Plain vision transformer (Dosovitskiy et al. 2021) for images and clips of any size."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.runtime.errors import UserError


@dataclass(frozen=True)
class ViTConfig:
    """Size of a transformer."""

    image_size: tuple[int, int] = (120, 160)  # px; other sizes work without learned positions
    patch_size: int = 16  # side of a square patch, px
    channels: int = 3  # input channels
    width: int = 192  # width of a token
    depth: int = 6  # number of blocks
    heads: int = 3  # attention heads; they divide `width`
    mlp_ratio: float = 4.0  # hidden width of a block's MLP over `width`
    class_token: bool = False  # prepend a learned token and pool by it; otherwise pool by the mean
    # learned tokens without position, not part of the output (Darcet et al. 2024)
    registers: int = 0
    # initial value of learned factors on both branches of a block (Touvron et al. 2021), if any
    layer_scale: float | None = None
    tubelet: int = 1  # frames in a token: 1 for images; clips have a multiple of it
    frames: int = 1  # frames of a clip; 1 for images
    learned_positions: bool = False  # learn the position codes; the input size is then fixed
    norm_epsilon: float = 1e-5  # epsilon of every LayerNorm

    def __post_init__(self) -> None:
        if self.width % (4 * self.heads):
            raise UserError(
                f"ViT width {self.width} must be divisible by 4 x heads ({self.heads}): "
                "choose another width or number of heads"
            )
        if self.tubelet > 1 and self.width % 6:
            raise UserError(
                f"ViT width {self.width} must be divisible by 6 for clips (sine and cosine of time, "
                "row and column): choose another width"
            )
        if self.tubelet < 1 or self.registers < 0 or self.frames % self.tubelet:
            raise UserError(
                f"no ViT has {self.registers} registers and {self.frames} frames of {self.tubelet} a "
                "token: registers from 0, tubelet from 1, frames a multiple of it"
            )


PRESETS: dict[str, ViTConfig] = {
    "tiny": ViTConfig(patch_size=40, width=32, depth=2, heads=2, mlp_ratio=2.0),
    "compact": ViTConfig(width=128, depth=4, heads=4),
    "small": ViTConfig(),
    # ViT-H/14 as in ImageBind and the MMWand paper, which pool by the class token.
    "huge": ViTConfig(patch_size=14, width=1280, depth=32, heads=16, class_token=True),
}


def sinusoidal_positions(
    rows: int, columns: int, width: int, times: int | None = None
) -> Float[Tensor, "n {width}"]:
    """Return fixed position codes, one half for the row, one for the column (MAE, He et al. 2022).

    With tubelets in time, `times`, their codes are the first of three thirds. The width is a
    multiple of 4, or of 6 for clips.
    """
    sides = [rows, columns] if times is None else [times, rows, columns]
    bands = width // (2 * len(sides))
    frequency = 10000.0 ** -(torch.arange(bands) / bands)
    places = torch.meshgrid(*(torch.arange(side) for side in sides), indexing="ij")
    angles = torch.stack([place.flatten() for place in places], 1)[:, :, None] * frequency
    return torch.cat([angles.sin(), angles.cos()], -1).flatten(1)


@lru_cache(maxsize=8)
def _known_positions(
    rows: int, columns: int, width: int, times: int | None = None
) -> Float[Tensor, "n {width}"]:
    """Return cached `sinusoidal_positions`; not to be modified."""
    with torch.inference_mode(False):
        return sinusoidal_positions(rows, columns, width, times)


class Block(nn.Module):
    """Pre-norm self-attention and MLP."""

    def __init__(
        self,
        width: int,
        heads: int,
        mlp_ratio: float,
        norm_epsilon: float = 1e-5,
        layer_scale: float | None = None,
    ) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width, norm_epsilon)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width, norm_epsilon)
        self.mlp_in = nn.Linear(width, int(width * mlp_ratio))
        self.mlp_out = nn.Linear(int(width * mlp_ratio), width)
        scaled = layer_scale is not None
        self.scale1 = nn.Parameter(torch.full((width,), layer_scale)) if scaled else None
        self.scale2 = nn.Parameter(torch.full((width,), layer_scale)) if scaled else None

    def attention(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b n d"]:
        """Return multi-head self-attention over the tokens."""
        b, n, d = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        y = F.scaled_dot_product_attention(q, k, v)
        return self.out(y.transpose(1, 2).reshape(b, n, d))

    def forward(self, x: Float[Tensor, "b n d"]) -> Float[Tensor, "b n d"]:
        """Return the output tokens."""
        attended = self.attention(self.norm1(x))
        x = x + (attended if self.scale1 is None else attended * self.scale1)
        changed = self.mlp_out(F.gelu(self.mlp_in(self.norm2(x))))
        return x + (changed if self.scale2 is None else changed * self.scale2)


class ViT(nn.Module):
    """Transformer from images or clips to tokens.

    Inputs are padded with zeros at the right and bottom to multiples of the patch; for
    background-subtracted touch, zero is an untouched gel.
    """

    def __init__(self, config: ViTConfig) -> None:
        super().__init__()
        self.config = config
        c = config
        self.patch = _patch_projection(c)
        self.class_token = nn.Parameter(torch.zeros(1, 1, c.width)) if c.class_token else None
        self.registers = nn.Parameter(torch.empty(1, c.registers, c.width)) if c.registers else None
        *times, rows, columns = _grid(c)
        codes = sinusoidal_positions(rows, columns, c.width, *times)
        self.positions = nn.Parameter(codes[None]) if c.learned_positions else None
        self.blocks = nn.ModuleList(
            Block(c.width, c.heads, c.mlp_ratio, c.norm_epsilon, c.layer_scale)
            for _ in range(c.depth)
        )
        self.norm = nn.LayerNorm(c.width, c.norm_epsilon)
        self.apply(_initialise)
        for name, weight in self.named_parameters():
            if name.endswith((".out.weight", ".mlp_out.weight")):
                # keeps the variance of the residual stream independent of depth, as in GPT-2
                nn.init.xavier_uniform_(weight, gain=1 / math.sqrt(2 * c.depth))
        if self.registers is not None:
            # equal registers would stay equal, because only their values differ
            nn.init.normal_(self.registers, std=0.02)

    def embed_patches(self, images: Float[Tensor, "b c *t h w"]) -> Float[Tensor, "b n d"]:
        """Return patch embeddings with positions, row by row, without class token and registers.

        UserError: clips of a length that is no multiple of `tubelet`, or another size than the
        configured one with learned positions.
        """
        size, tubelet = self.config.patch_size, self.config.tubelet
        h, w = images.shape[-2:]
        if tubelet > 1 and (images.ndim != 5 or images.shape[2] % tubelet):
            raise UserError(
                f"this ViT takes clips (batch, channels, frames, height, width) of a multiple of "
                f"{tubelet} frames, not {tuple(images.shape)}"
            )
        tokens = self.patch(F.pad(images, (0, -w % size, 0, -h % size)))
        positions = self._positions(*tokens.shape[2:])
        return tokens.flatten(2).transpose(1, 2) + positions.to(tokens)

    def _positions(self, *grid: int) -> Float[Tensor, "n d"]:
        """Return codes for times (of clips), rows and columns of patches."""
        if self.positions is None:
            *times, rows, columns = grid
            return _known_positions(rows, columns, self.config.width, *times)
        if grid != (expected := _grid(self.config)):
            raise UserError(
                f"this ViT has learned positions for {expected} patches, not {grid}: give it the "
                f"size that it was trained with, {self.config.image_size}"
            )
        return self.positions[0]

    def forward(
        self, images: Float[Tensor, "b c *t h w"], ids_keep: Int[Tensor, "b k"] | None = None
    ) -> Float[Tensor, "b n d"]:
        """Return normalised output tokens: a class token, if any, then one for each patch.

        `ids_keep` are the patches to compute (time by time, row by row); None for all.
        """
        return self.encode(self.embed_patches(images), ids_keep)[:, self.config.registers :]

    def encode(
        self, tokens: Float[Tensor, "b n d"], ids_keep: Int[Tensor, "b k"] | None = None
    ) -> Float[Tensor, "b m d"]:
        """Return all output tokens of embedded patches: registers, class token, patches in `ids_keep`."""
        if ids_keep is not None:
            tokens = tokens.gather(1, ids_keep[:, :, None].expand(-1, -1, tokens.shape[2]))
        if self.class_token is not None:
            tokens = torch.cat([self.class_token.expand(len(tokens), -1, -1), tokens], 1)
        if self.registers is not None:
            tokens = torch.cat([self.registers.expand(len(tokens), -1, -1), tokens], 1)
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens)

    def features(
        self, images: Float[Tensor, "b c *t h w"], ids_keep: Int[Tensor, "b k"] | None = None
    ) -> Float[Tensor, "b d"]:
        """Return one vector an image: the class token if there is one, else the mean token."""
        tokens = self(images, ids_keep)
        return tokens[:, 0] if self.class_token is not None else tokens.mean(1)


def patch_grid(config: ViTConfig) -> tuple[int, int]:
    """Return rows and columns of patches in an image of the configured size."""
    rows, columns = (-(-side // config.patch_size) for side in config.image_size)
    return rows, columns


def patchify(images: Float[Tensor, "b c h w"], vit: ViTConfig) -> Float[Tensor, "b n p"]:
    """Return the pixels of every patch, row by row, padded with zeros as in the backbone."""
    size = vit.patch_size
    h, w = images.shape[2:]
    padded = F.pad(images, (0, -w % size, 0, -h % size))
    return F.unfold(padded, size, stride=size).transpose(1, 2)


def _grid(config: ViTConfig) -> tuple[int, ...]:
    """Return the configured tubelets in time (for clips), rows and columns."""
    times = () if config.tubelet == 1 else (config.frames // config.tubelet,)
    return (*times, *patch_grid(config))


def _patch_projection(config: ViTConfig) -> nn.Conv2d | nn.Conv3d:
    size = config.patch_size
    if config.tubelet == 1:
        return nn.Conv2d(config.channels, config.width, size, stride=size)
    tube = (config.tubelet, size, size)
    return nn.Conv3d(config.channels, config.width, tube, stride=tube)


def random_masking(
    config: ViTConfig, mask_ratio: float, count: int, generator: torch.Generator
) -> Int[Tensor, "{count} k"]:
    """Draw which patches of `count` images to keep, for `ViT.forward`.

    A share of `mask_ratio` in [0, 1) is dropped; at least one patch stays. `generator` is the
    CPU's.
    """
    rows, columns = patch_grid(config)
    order = torch.rand(count, rows * columns, generator=generator).argsort(1)
    return order[:, : max(1, round((1 - mask_ratio) * rows * columns))]


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)  # as in MAE; suits narrow and wide backbones
        nn.init.zeros_(module.bias)
    elif isinstance(module, nn.Conv2d | nn.Conv3d) and module.bias is not None:
        fan_in = module.weight[0].numel()
        nn.init.trunc_normal_(module.weight, std=fan_in**-0.5)
        nn.init.zeros_(module.bias)
