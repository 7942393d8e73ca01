"""Linear heads that bring frozen towers' images and sentences to frozen touch embeddings.

The touch embedding stays as it is, so what it tells apart stays as it is; words and pictures are
projected among the touches. A head W of sentences is the same as a head of touch into words, W
transposed, so nothing is lost by the direction.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from touchgoal.encoders.alignment.infonce import symmetric_info_nce
from touchgoal.runtime.option_types import Count, NotNegative, Positive, checked_dataclass


@checked_dataclass
class HeadsConfig:
    """Training of the heads."""

    epochs: Count = 40
    """Passes over the touches."""
    batch_size: Count = 256
    """Touches in each step."""
    lr: Positive = 2e-3
    """Highest learning rate; it falls to 0 by a cosine."""
    weight_decay: NotNegative = 0.02
    """Decoupled weight decay."""
    temperature: Positive = 0.1
    """Temperature of the InfoNCE losses."""
    text_weight: NotNegative = 1.0
    """Weight of the touch-text loss: lambda in the MMWand paper; 0 leaves it out."""


@dataclass(frozen=True, eq=False)
class Paired:
    """n touches with v views each, and the m sentences on their k objects.

    Attributes:
        touch: Unit touch embeddings.
        label: Object of each touch.
        image: Image tower's embeddings of each touch's views.
        texts: Text tower's embeddings.
        describes: Whether sentence j is on object i.
    """

    touch: Float[Tensor, "n d"]
    label: Int[Tensor, " n"]
    image: Float[Tensor, "n v i"]
    texts: Float[Tensor, "m t"]
    describes: Bool[Tensor, "k m"]


class Heads(nn.Module):
    """Bias-free linear maps of images and sentences to touch embeddings, unit vectors all."""

    image_mean: Float[Tensor, " i"]
    text_mean: Float[Tensor, " t"]

    def __init__(self, touch_dim: int, image_dim: int, text_dim: int) -> None:
        super().__init__()
        self.image, self.text = (
            nn.Linear(image_dim, touch_dim, False),
            nn.Linear(text_dim, touch_dim, False),
        )
        self.register_buffer("image_mean", torch.zeros(image_dim))
        self.register_buffer("text_mean", torch.zeros(text_dim))

    def images(self, embeddings: Float[Tensor, "*n i"]) -> Float[Tensor, "*n d"]:
        """Project images among touches."""
        return F.normalize(self.image(F.normalize(embeddings, dim=-1) - self.image_mean), dim=-1)

    def texts(self, embeddings: Float[Tensor, "*n t"]) -> Float[Tensor, "*n d"]:
        """Project sentences among touches."""
        return F.normalize(self.text(F.normalize(embeddings, dim=-1) - self.text_mean), dim=-1)


def fit_heads(data: Paired, config: HeadsConfig, seed: int) -> Heads:
    """Fit heads by InfoNCE between touch and image, touch and text, and image and text.

    Touches, views and sentences of the same object all count as positives.
    """
    draw = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        heads = Heads(data.touch.shape[1], data.image.shape[2], data.texts.shape[1])
    heads.image_mean.copy_(F.normalize(data.image, dim=-1).mean((0, 1)))
    heads.text_mean.copy_(F.normalize(data.texts, dim=-1).mean(0))
    optimizer = torch.optim.AdamW(heads.parameters(), config.lr, weight_decay=config.weight_decay)
    n = len(data.touch)
    steps = max(n // config.batch_size, 1) * config.epochs
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        rows = torch.randperm(n, generator=draw)[: config.batch_size]
        view = torch.randint(data.image.shape[1], (len(rows),), generator=draw)
        sentence = _draw_sentences(data, rows, draw)
        touch = data.touch[rows]
        image, text = heads.images(data.image[rows, view]), heads.texts(data.texts[sentence])
        label = data.label[rows]
        same = (label[:, None] == label) | (sentence[:, None] == sentence)
        tau = config.temperature
        loss = symmetric_info_nce(touch, image, tau, same) + symmetric_info_nce(
            image, text, tau, same
        )
        if config.text_weight:
            loss = loss + config.text_weight * symmetric_info_nce(touch, text, tau, same)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return heads.eval()


def _draw_sentences(
    data: Paired, rows: Int[Tensor, " b"], draw: torch.Generator
) -> Int[Tensor, " b"]:
    """Draw one sentence for each touch."""
    describes = data.describes[data.label[rows]].float()
    return torch.multinomial(describes, 1, generator=draw)[:, 0]
