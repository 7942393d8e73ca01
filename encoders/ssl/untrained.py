"""Backbones that see what Sparsh's see, of its size or smaller, randomly initialised."""

from dataclasses import replace
from typing import Literal

from touchgoal.encoders.backbones.sparsh import SPARSH_BASE
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone, TouchBackboneConfig
from touchgoal.encoders.backbones.vit import ViTConfig
from touchgoal.encoders.preprocess import preprocessor_for

Method = Literal["mae", "dino", "ijepa", "vjepa"]

# As the presets of these names, with widths that have thirds, too, for clips.
_SIZES = {
    "tiny": ViTConfig(patch_size=40, width=48, depth=2, heads=2, mlp_ratio=2.0),
    "compact": ViTConfig(width=144, depth=4, heads=4),
    "small": ViTConfig(),
}


def vit_for(method: Method, size: str, image_size: tuple[int, int]) -> ViTConfig:
    """The network of a method: Sparsh's own, or a smaller one with its input and its registers.

    Args:
        method: Decides on the input: two frames on top of each other, or a clip.
        size: See `SelfDistillationConfig.vit`.
        image_size: Height and width in pixels that the preprocessor makes.
    """
    published = replace(SPARSH_BASE[method], image_size=image_size)
    if size == "base":
        return published
    return replace(
        _SIZES[size],
        image_size=image_size,
        channels=published.channels,
        registers=published.registers,
        tubelet=published.tubelet,
        frames=published.frames,
    )


def backbone_for(method: Method, size: str, sensor: str, stride: int) -> TouchBackbone:
    """A backbone for touches of a sensor whose frames lie so many ticks apart."""
    vit = vit_for(method, size, preprocessor_for(sensor).size)
    return TouchBackbone(TouchBackboneConfig.for_sensor(vit, sensor, stride))
