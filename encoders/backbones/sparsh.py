"""Networks of the four published Sparsh encoders (Higuera et al. 2024), and smaller ones.

With patches of 16 px (the text says 14) the base networks have exactly Table 3's parameter counts.
"""

from dataclasses import replace
from typing import Literal

from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import ViTConfig

Method = Literal["mae", "dino", "ijepa", "vjepa"]

# Images there stand upright; the LayerNorm's epsilon is in no file of weights.
UPRIGHT, SQUARE, NORM_EPSILON = (320, 240), (224, 224), 1e-6


_BASE = ViTConfig(  # Two frames on top of each other, the newer first.
    patch_size=16, channels=6, width=768, depth=12, heads=12, norm_epsilon=NORM_EPSILON
)
_SQUARE_BASE = replace(_BASE, image_size=SQUARE, learned_positions=True)
SPARSH_BASE: dict[str, ViTConfig] = {
    "mae": replace(_BASE, image_size=UPRIGHT, layer_scale=1.0),
    "dino": replace(_BASE, image_size=UPRIGHT, layer_scale=1.0, registers=1),
    "ijepa": _SQUARE_BASE,
    "vjepa": replace(_SQUARE_BASE, channels=3, tubelet=2, frames=4),
}
_SIZES = {  # Our presets; widths are multiples of 6 (sine and cosine of three axes), for clips.
    "tiny": ViTConfig(patch_size=40, width=48, depth=2, heads=2, mlp_ratio=2.0),
    "compact": ViTConfig(width=144, depth=4, heads=4),
    "small": ViTConfig(),
}


def backbone_for(method: Method, size: str, sensor: str, stride: int) -> TouchBackbone:
    """Return a randomly initialised backbone for a sensor, with frames `stride` ticks apart.

    Sizes are base, which is Sparsh's network of the method, and tiny, compact and small, with its input
    and registers.
    """
    vit = SPARSH_BASE[method]
    if size != "base":
        vit = replace(
            _SIZES[size],
            channels=vit.channels,
            registers=vit.registers,
            tubelet=vit.tubelet,
            frames=vit.frames,
        )
    return TouchBackbone(TouchBackboneConfig.for_sensor(vit, sensor, stride))
