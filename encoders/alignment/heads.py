"""Linear heads from frozen towers' image and sentence embeddings to frozen touch embeddings.

Touch embeddings stay as they are, so they distinguish touches as well as before. Mapping sentences to
touch by W ranks pairs like mapping touch to sentences by the transpose of W, so nothing is lost.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from touchgoal.encoders.alignment.config import HeadsConfig
from touchgoal.encoders.alignment.infonce import symmetric_info_nce
from touchgoal.encoders.backbones.tower_map import TowerMap

_BATCH, _LR, _WEIGHT_DECAY = 256, 2e-3, 0.02  # touches a step; of AdamW, with a cosine to 0
_TEMPERATURE = 0.07  # of the InfoNCE losses
_TEXT_HIDDEN = 512  # width of the hidden layer beside the linear map of sentences


@dataclass(frozen=True, eq=False)
class PairedEmbeddings:
    """n touches, v views of the first k of them, and m sentences on their o objects."""

    touch: Float[Tensor, "n d"]  # unit touch embeddings
    label: Int[Tensor, " n"]  # object of each touch
    image: Float[Tensor, "k v i"]  # image tower's embeddings
    texts: Float[Tensor, "m t"]  # text tower's embeddings
    describes: Bool[Tensor, "o m"]  # whether sentence j is on object i


class Heads(nn.Module):
    """Maps from image and sentence embeddings to touch; all give unit vectors."""

    def __init__(self, touch_dim: int, image_dim: int, text_dim: int) -> None:
        super().__init__()
        self.image = TowerMap(image_dim, touch_dim)
        self.text = TowerMap(text_dim, touch_dim, _TEXT_HIDDEN)


def fit_heads(data: PairedEmbeddings, config: HeadsConfig, seed: int) -> Heads:
    """Fit heads by InfoNCE between touch and image, touch and text, and image and text.

    Touches, views and sentences of the same object all count as positives.
    """
    draw = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        heads = Heads(data.touch.shape[1], data.image.shape[2], data.texts.shape[1])
    heads.image.centre(data.image)
    heads.text.centre(data.texts)
    optimizer = torch.optim.AdamW(heads.parameters(), _LR, weight_decay=_WEIGHT_DECAY)
    n = len(data.touch)
    steps = max(n // _BATCH, 1) * config.epochs
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        rows = torch.randperm(n, generator=draw)[:_BATCH]
        optimizer.zero_grad()
        _loss(heads, data, rows, config, draw).backward()
        optimizer.step()
        schedule.step()
    return heads.eval()


def _loss(
    heads: Heads,
    data: PairedEmbeddings,
    rows: Int[Tensor, " b"],
    config: HeadsConfig,
    draw: torch.Generator,
) -> Float[Tensor, ""]:
    """Return the loss of a batch; touches without views take part in touch and text alone."""
    sentence, label = _draw_sentences(data, rows, draw), data.label[rows]
    touch, text = data.touch[rows], heads.text(data.texts[sentence])
    same = (label[:, None] == label) | (sentence[:, None] == sentence)
    viewed = rows < len(data.image)
    view = torch.randint(data.image.shape[1], (int(viewed.sum()),), generator=draw)
    image, both = heads.image(data.image[rows[viewed], view]), same[viewed][:, viewed]
    loss = symmetric_info_nce(touch[viewed], image, _TEMPERATURE, both)
    loss = loss + symmetric_info_nce(image, text[viewed], _TEMPERATURE, both)
    if config.text_weight:
        own = symmetric_info_nce(touch, text, _TEMPERATURE, same)
        loss = loss + config.text_weight * own
    return loss


def _draw_sentences(
    data: PairedEmbeddings, rows: Int[Tensor, " b"], draw: torch.Generator
) -> Int[Tensor, " b"]:
    """Draw one sentence for each touch."""
    describes = data.describes[data.label[rows]].float()
    return torch.multinomial(describes, 1, generator=draw)[:, 0]
