"""Sentences mapped into a fixed touch embedding by a ridge regression.

Objects have ranks 0 to 2 of hardness, roughness and bumpiness, as in PhysiCLeAR. Every rank, and
every triple of ranks in the data, is a sentence; its target is the mean of the touches it
describes.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from touchgoal.encoders.backbones.tower_map import TowerMap

RANK_WORDS = (
    ("soft", "slightly hard", "hard"),
    ("smooth", "slightly rough", "rough"),
    ("flat", "slightly bumpy", "bumpy"),
)
"""Words for the ranks of hardness, roughness and bumpiness."""
_STRENGTH = 0.003  # of the ridge; on real objects, 100 times more or less changes nothing

EmbedTexts = Callable[[list[str]], Float[Tensor, "k t"]]


def rank_sentences(property_: int) -> list[str]:
    """Return the sentences for the three ranks of a property."""
    return [f"a {word} object" for word in RANK_WORDS[property_]]


def fit_text_head(
    touches: Float[Tensor, "n d"], ranks: Int[Tensor, "n 3"], embed_texts: EmbedTexts
) -> TowerMap:
    """Fit a ridge from sentences to the mean of the centred touches that each describes."""
    sentences, places, weights = [], [], []
    for property_ in range(ranks.shape[1]):
        for rank, sentence in enumerate(rank_sentences(property_)):
            true = ranks[:, property_] == rank
            if true.any():
                sentences.append(sentence)
                places.append(touches[true].mean(0))
                weights.append(1.0)
    for triple in ranks.unique(dim=0):
        true = (ranks == triple).all(1)
        words = [names[rank] for names, rank in zip(RANK_WORDS, triple.tolist(), strict=True)]
        sentences.append(f"a {words[0]}, {words[1]} and {words[2]} object")
        places.append(touches[true].mean(0))
        weights.append(float(true.float().mean()))
    texts = F.normalize(embed_texts(sentences).double(), dim=1)
    weight = torch.tensor(weights, dtype=torch.float64)
    weight /= weight.sum()
    mean = weight @ texts
    apart = texts - mean
    # The dual form: there are far fewer sentences than dimensions.
    inner = apart @ apart.T + _STRENGTH * torch.diag(1 / weight)
    matrix = apart.T @ torch.linalg.solve(inner, torch.stack(places).double())
    head = TowerMap(texts.shape[1], touches.shape[1])
    head.mean.copy_(mean)
    head.linear.weight.data.copy_(matrix.T)
    return head.requires_grad_(False)
