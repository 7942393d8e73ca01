"""The peer of `encoder_speed`: the same networks written plainly, with torch's own transformer."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.vit import Block, ViT, patchify
from touchgoal.encoders.ssl.mae import MaskedAutoencoder


class PlainViT(nn.Module):
    """A ViT of ours with `torch.nn.TransformerEncoder`, position codes stored, LayerScale multiplied into weights."""

    positions: Float[Tensor, "1 n d"]

    def __init__(self, vit: ViT) -> None:
        """The same function with the same weights; of one without class token."""
        super().__init__()
        config = vit.config
        self.patch, self.size = vit.patch, config.patch_size
        self.registers = vit.registers
        sides = config.image_size if config.tubelet == 1 else (config.frames, *config.image_size)
        blank = torch.zeros(1, config.channels, *sides)
        with torch.no_grad():
            codes = vit.embed_patches(blank) - vit.get_parameter("patch.bias")
        self.register_buffer("positions", codes)
        self.blocks = _encoder([*vit.blocks], vit.norm)

    def forward(
        self, images: Float[Tensor, "b c *t h w"], ids_keep: Int[Tensor, "b k"] | None = None
    ) -> Float[Tensor, "b n d"]:
        """Normalised output tokens, of the patches in `ids_keep` if given."""
        h, w = images.shape[-2:]
        padded = nn.functional.pad(images, (0, -w % self.size, 0, -h % self.size))
        x = self.patch(padded).flatten(2).transpose(1, 2) + self.positions
        if ids_keep is not None:
            x = x.gather(1, ids_keep[:, :, None].expand(-1, -1, x.shape[2]))
        if self.registers is None:
            return self.blocks(x)
        x = torch.cat([self.registers.expand(len(x), -1, -1), x], 1)
        return self.blocks(x)[:, self.registers.shape[1] :]


class PlainMae(nn.Module):
    """A masked autoencoder of ours in the same way, with a bottleneck: the decoder is given a mean."""

    positions: Float[Tensor, "1 n d"]

    def __init__(self, mae: MaskedAutoencoder, positions: Float[Tensor, "n d"]) -> None:
        """The same function with the same weights.

        Args:
            mae: Ours.
            positions: Of its decoder.
        """
        super().__init__()
        self.vit, self.config = PlainViT(mae.backbone.vit), mae.backbone.config.vit
        self.embed, self.read = mae.decoder_embed, mae.decoder_pred
        self.decoder = _encoder([*mae.decoder_blocks], mae.decoder_norm)
        self.register_buffer("positions", positions[None])

    def forward(
        self, touch: Float[Tensor, "b 3 h w"], ids_keep: Int[Tensor, "b k"]
    ) -> Float[Tensor, ""]:
        """Mean squared error of all patches."""
        x = self.embed(self.vit(touch, ids_keep)).mean(1, keepdim=True) + self.positions
        return nn.functional.mse_loss(self.read(self.decoder(x)), patchify(touch, self.config))


def _encoder(blocks: list[nn.Module], norm: nn.Module) -> nn.TransformerEncoder:
    """Blocks of ours as a stack of torch's layers."""
    first = blocks[0]
    assert isinstance(first, Block) and isinstance(norm, nn.LayerNorm)
    layer = nn.TransformerEncoderLayer(
        norm.normalized_shape[0],
        first.heads,
        first.mlp_in.out_features,
        dropout=0.0,
        activation="gelu",
        layer_norm_eps=norm.eps,
        batch_first=True,
        norm_first=True,
    )
    stack = nn.TransformerEncoder(layer, len(blocks), norm, enable_nested_tensor=False)
    with torch.no_grad():
        for ours, plain in zip(blocks, stack.layers, strict=True):
            assert isinstance(ours, Block) and isinstance(plain, nn.TransformerEncoderLayer)
            plain.load_state_dict(_weights(ours))
    return stack


def _weights(block: Block) -> dict[str, Tensor]:
    parts = {"norm1": block.norm1, "norm2": block.norm2, "linear1": block.mlp_in}
    named = {f"{to}.{name}": w for to, part in parts.items() for name, w in part.named_parameters()}
    for to, part, scale in (
        ("self_attn.out_proj", block.out, block.scale1),
        ("linear2", block.mlp_out, block.scale2),
    ):
        factor = torch.ones(len(part.bias)) if scale is None else scale
        named[f"{to}.weight"] = part.weight * factor[:, None]
        named[f"{to}.bias"] = part.bias * factor
    named["self_attn.in_proj_weight"] = block.qkv.weight
    named["self_attn.in_proj_bias"] = block.qkv.bias
    return named
