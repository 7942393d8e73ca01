"""Sentences brought to where the touches they tell of lie, by a ridge: for an encoder that stays as it is.

Things are ranked for hardness, roughness and bumpiness, 0 to 2 each, as PhysiCLeAR's are. Every rank, and
every triple of ranks that occurs, is a sentence; its place is the mean of the touches it is true of.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

RANK_WORDS = (
    ("soft", "slightly hard", "hard"),
    ("smooth", "slightly rough", "rough"),
    ("flat", "slightly bumpy", "bumpy"),
)
"""What a rank of hardness, roughness and bumpiness is called."""
_STRENGTH = 0.003  # of the ridge; a hundred times more or less says the same of real things

EmbedTexts = Callable[[list[str]], Float[Tensor, "k t"]]


@dataclass(frozen=True, eq=False)
class TextHead:
    """From a text tower's embeddings to touch.

    Attributes:
        mean: of the unit text embeddings.
        matrix: what is left of them to touch.
    """

    mean: Float[Tensor, " t"]
    matrix: Float[Tensor, "t d"]

    def __call__(self, texts: Float[Tensor, "n t"]) -> Float[Tensor, "n d"]:
        """Unit vectors."""
        return F.normalize((F.normalize(texts, dim=1) - self.mean) @ self.matrix, dim=1)


def rank_sentences(property_: int) -> list[str]:
    """What is said of the three ranks of a property."""
    return [f"a {word} object" for word in RANK_WORDS[property_]]


def fit_text_head(
    touches: Float[Tensor, "n d"], ranks: Int[Tensor, "n 3"], embed_texts: EmbedTexts
) -> TextHead:
    """Ridge from sentences to the mean touch that each is true of.

    Args:
        touches: centred.
        ranks: of what was touched.
        embed_texts: a text tower's.
    """
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
    # The dual form: far fewer sentences than numbers in each.
    inner = apart @ apart.T + _STRENGTH * torch.diag(1 / weight)
    matrix = apart.T @ torch.linalg.solve(inner, torch.stack(places).double())
    return TextHead(mean.float(), matrix.float())
