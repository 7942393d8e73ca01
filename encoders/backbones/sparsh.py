"""The four published Sparsh encoders of size base (Higuera et al. 2024, Table 3), as shapes.

Table 3's parameter counts are met exactly by these, with patches of 16 pixels (the text says 14).
"""

from dataclasses import replace

from touchgoal.encoders.backbones.vit import ViTConfig

# Pictures there stand upright; the LayerNorm's epsilon is in no file of weights.
UPRIGHT, SQUARE, NORM_EPSILON = (320, 240), (224, 224), 1e-6
CLIP_FRAMES = 4


def _base(
    image_size: tuple[int, int],
    channels: int = 6,  # two frames on top of each other, the newer first
    registers: int = 0,
    layer_scale: float | None = None,
    tubelet: int = 1,
    frames: int = 1,
    learned_positions: bool = False,
) -> ViTConfig:
    return ViTConfig(
        image_size=image_size,
        patch_size=16,
        channels=channels,
        width=768,
        depth=12,
        heads=12,
        registers=registers,
        layer_scale=layer_scale,
        tubelet=tubelet,
        frames=frames,
        learned_positions=learned_positions,
        norm_epsilon=NORM_EPSILON,
    )


SPARSH_BASE: dict[str, ViTConfig] = {
    "mae": _base(UPRIGHT, layer_scale=1.0),
    "dino": _base(UPRIGHT, layer_scale=1.0, registers=1),
    "ijepa": _base(SQUARE, learned_positions=True),
    "vjepa": _base(SQUARE, channels=3, tubelet=2, frames=CLIP_FRAMES, learned_positions=True),
}
_SIZES = {"tiny": (192, 3), "small": (384, 6), "base": (768, 12)}  # width, heads


def sparsh_vit(method: str, size: str) -> ViTConfig:
    """A method's encoder of size tiny, small or base: as wide as ViTs of that name."""
    width, heads = _SIZES[size]
    return replace(SPARSH_BASE[method], width=width, heads=heads)
