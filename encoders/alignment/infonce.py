"""InfoNCE (van den Oord et al. 2018), the paper's Eq. 1, and the least value it can take."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def info_nce(
    anchor: Float[Tensor, "n d"],
    target: Float[Tensor, "n d"],
    temperature: float,
    positives: Bool[Tensor, "n n"] | None = None,
) -> Float[Tensor, ""]:
    """One-directional loss: each anchor picks its own among all targets.

    Args:
        anchor: L2-normalised embeddings.
        target: L2-normalised embeddings, row by row the anchors' partners.
        temperature: Divides the cosines.
        positives: [i, j] is true where target j is a right answer to anchor i, the diagonal
            included; the loss is then the mean over the right answers (SupCon's L_out, Khosla et
            al. 2020). Without it only the partner is right, and a second touch of the same object
            in the batch counts as wrong: 46 % of the paper's batches of 64 have one per anchor.

    Returns:
        Mean over the anchors.
    """
    log_p = (anchor @ target.T / temperature).log_softmax(1)
    if positives is None:
        return -log_p.diagonal().mean()
    return -((log_p * positives).sum(1) / positives.sum(1)).mean()


def symmetric_info_nce(
    one: Float[Tensor, "n d"],
    other: Float[Tensor, "n d"],
    temperature: float,
    positives: Bool[Tensor, "n n"] | None = None,
) -> Float[Tensor, ""]:
    """Mean of both directions, as CLIP has it."""
    back = positives.T if positives is not None else None
    forth = info_nce(one, other, temperature, positives)
    return (forth + info_nce(other, one, temperature, back)) / 2


@torch.no_grad()
def loss_floor(
    target: Float[Tensor, "n d"],
    temperature: float,
    positives: Bool[Tensor, "n n"] | None = None,
    steps: int = 50,
) -> float:
    """The least `info_nce` that any anchors can reach against these fixed targets.

    Frozen towers put everything within a narrow cone, so the loss stays far above zero however
    good the touch encoder is: with 64 targets at cosines of .5 and the paper's temperature of
    .2 it cannot fall below 1.02 (1.61 at cosines of .7). Without this number a flat loss looks like a bug.

    The loss is convex in an anchor, and a unit vector lies in the unit ball, where Frank-Wolfe
    steps give both an iterate f(a) and the gap f(a) - f* <= <grad, a> + |grad|. The best
    difference over the steps is returned: never above the true least value, and close to it.

    Args:
        target: L2-normalised embeddings.
        temperature: As in training.
        positives: As in training.
        steps: More of them tighten the bound.
    """
    target = target.double()
    n = len(target)
    right = torch.eye(n, dtype=torch.bool) if positives is None else positives
    wanted = (right / right.sum(1, keepdim=True)).to(target)
    anchor = torch.nn.functional.normalize(wanted @ target, dim=1)
    best = torch.full((n,), -torch.inf, dtype=torch.float64, device=target.device)
    for step in range(steps):
        logits = anchor @ target.T / temperature
        loss = logits.logsumexp(1) - (wanted * logits).sum(1)
        gradient = (logits.softmax(1) - wanted) @ target / temperature
        length = gradient.norm(dim=1, keepdim=True)
        gap = (gradient * anchor).sum(1) + length[:, 0]
        best = torch.maximum(best, loss - gap)
        rate = 2 / (step + 2)
        anchor = (1 - rate) * anchor - rate * gradient / length.clamp_min(1e-12)
    return best.mean().item()
