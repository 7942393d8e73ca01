"""Cross-modal retrieval: how well touches find the sentences and images of their objects."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from touchgoal.encoders.alignment.data import NO_CONTACT, TouchData
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder
from touchgoal.encoders.backbones.touch_backbone import BATCH

METRICS = (
    "chance_top1", "touch_to_text_top1", "touch_to_text_map", "chance_text_map",
    "touch_to_image_top1", "touch_to_image_map", "chance_image_map",
)  # fmt: skip


@torch.no_grad()
def evaluate_retrieval(encoder: TouchEncoder, data: TouchData) -> dict[str, float | None]:
    """Measure retrieval by cosine for touches with contact.

    A touch is never matched with the view of its own episode, which it could recognise by size,
    place and light. So image retrieval is measured only for objects with a second episode.

    Returns:
        `touch_to_text_top1`, `touch_to_image_top1`: how often the right object is nearest, an
        object being the mean embedding of its sentences or views; `chance_top1`.
        `touch_to_text_map`, `touch_to_image_map`: mean average precision over all sentences or
        views, those of the object being relevant; `chance_text_map`, `chance_image_map`.
        `contact_accuracy` (with touches without contact): how often the nearest sentences are right
        about contact; `chance_contact` is the share of the larger group. None for what cannot be
        measured on these touches.
    """
    encoder.eval()
    metrics: dict[str, float | None] = dict.fromkeys(METRICS)
    if not data.contact.any():
        return metrics
    device = encoder.device
    touch = torch.cat(
        [encoder.embed_touch(batch.to(device).float()) for batch in data.touch.split(BATCH)]
    ).cpu()
    texts = encoder.project_text(data.texts.to(device)).cpu()
    images = encoder.project_image(data.images.to(device)).cpu()
    present, label = data.label[data.contact].unique(return_inverse=True)
    metrics["chance_top1"] = 1 / len(present)
    no_view = torch.full_like(label, -1)
    metrics |= _retrieve(
        "text", touch[data.contact], label, texts, data.describes[present], no_view
    )
    views, own_view = data.view_index[data.contact].unique(return_inverse=True)
    shows = torch.zeros(len(present), len(views), dtype=torch.bool)
    shows[label, own_view] = True
    metrics |= _retrieve("image", touch[data.contact], label, images[views], shows, own_view)
    if NO_CONTACT in data.names:
        cosines = touch @ _prototypes(texts, data.describes).T
        says_contact = cosines.argmax(1) != data.names.index(NO_CONTACT)
        share = data.contact.float().mean().item()
        metrics["contact_accuracy"] = (says_contact == data.contact).float().mean().item()
        metrics["chance_contact"] = max(share, 1 - share)
    return metrics


def _retrieve(
    modality: str,
    touch: Float[Tensor, "n d"],
    label: Int[Tensor, " n"],
    gallery: Float[Tensor, "m d"],
    belongs: Bool[Tensor, "k m"],
    own: Int[Tensor, " n"],
) -> dict[str, float]:
    """Return both metrics of one modality; a touch must not find the candidate `own` (or -1)."""
    relevant = belongs[label] & (torch.arange(len(gallery)) != own[:, None])
    asked = relevant.any(1)
    touch, label, own, relevant = touch[asked], label[asked], own[asked], relevant[asked]
    if not len(touch):
        return {}
    cosines = touch @ _prototypes(gallery, belongs).T
    cosines[torch.arange(len(touch)), label] = (touch * _prototypes(gallery, relevant)).sum(1)
    similarity, chance = (touch @ gallery.T).numpy(), np.zeros(relevant.shape, np.float32)
    excluded = own[:, None].numpy() == np.arange(len(gallery))
    similarity[excluded] = chance[excluded] = -np.inf
    return {
        f"touch_to_{modality}_top1": top1(cosines, label),
        f"touch_to_{modality}_map": mean_average_precision(similarity, relevant.numpy()),
        f"chance_{modality}_map": mean_average_precision(chance, relevant.numpy()),
    }


def _prototypes(
    gallery: Float[Tensor, "m d"], belongs: Bool[Tensor, "k m"]
) -> Float[Tensor, "k d"]:
    return F.normalize(belongs.float() @ gallery, dim=1)


def top1(similarity: Float[Tensor, "n k"], label: Int[Tensor, " n"]) -> float:
    """Return how often the right candidate is the nearest; one of t equally near counts 1/t."""
    best = similarity == similarity.max(1, keepdim=True).values
    hit = best[torch.arange(len(label)), label]
    return (hit / best.sum(1)).mean().item()


def mean_average_precision(
    similarity: Float[np.ndarray, "n m"], relevant: Bool[np.ndarray, "n m"]
) -> float:
    """Return the mean average precision, with its expected value where scores tie.

    Without care for ties a collapsed encoder on a gallery sorted by object scores twice chance. For
    constant similarity the result is exactly chance. Every query has a relevant item.
    """
    return float(average_precisions(similarity, relevant).mean())


def average_precisions(
    similarity: Float[np.ndarray, "n m"], relevant: Bool[np.ndarray, "n m"]
) -> Float[np.ndarray, " n"]:
    """Return each query's average precision, see `mean_average_precision`."""
    queries = zip(similarity, relevant, strict=True)
    return np.array([_average_precision(s, r) for s, r in queries])


def _average_precision(
    similarity: Float[np.ndarray, " m"], relevant: Bool[np.ndarray, " m"]
) -> float:
    order = np.argsort(-similarity, kind="stable")
    _, group = np.unique(-similarity[order], return_inverse=True)
    size = np.bincount(group)
    right = np.bincount(group, weights=relevant[order])
    above, right_above = np.cumsum(size) - size, np.cumsum(right) - right
    # place i (1-based) within a tie of n items with r right ones is right with probability r/n;
    # then, of the i-1 before it in the tie, (i-1)(r-1)/(n-1) are expected to be right too
    place = np.arange(len(order)) - above[group] + 1
    n, r = size[group], right[group]
    before = right_above[group] + (place - 1) * (r - 1) / np.maximum(n - 1, 1)
    precision = (before + 1) / (above[group] + place)
    return float((r / n * precision).sum() / relevant.sum())
