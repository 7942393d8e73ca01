"""InfoNCE (van den Oord et al. 2018), the MMWand paper's Eq. 1, and its lower bound."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_FLOOR_STEPS = 50  # of Frank and Wolfe


def info_nce(
    anchor: Float[Tensor, "n d"],
    target: Float[Tensor, "n d"],
    temperature: float,
    positives: Bool[Tensor, "n n"] | None = None,
) -> Float[Tensor, ""]:
    """Return the one-directional loss, mean over anchors: each picks its own among all targets.

    Args:
        anchor: L2-normalised embeddings.
        target: L2-normalised embeddings, row by row the anchors' partners.
        positives: Whether target j is right for anchor i, the diagonal included; the loss is then
            the mean over the right answers (SupCon's L_out, Khosla et al. 2020). With None only the
            partner is right, and another touch of the same object counts as wrong: in the paper's
            batches of 64, 46 % of the anchors have one.
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
    """Return the mean of both directions, as in CLIP."""
    back = positives.T if positives is not None else None
    forth = info_nce(one, other, temperature, positives)
    return (forth + info_nce(other, one, temperature, back)) / 2


@torch.no_grad()
def loss_floor(
    target: Float[Tensor, "n d"], temperature: float, positives: Bool[Tensor, "n n"] | None = None
) -> float:
    """Return the least `info_nce` that any anchors can reach against these fixed targets.

    Frozen towers put all embeddings into a narrow cone, so the loss stays far above zero however
    good the touch encoder is: with 64 targets at cosines of 0.5 and temperature 0.2, above 1.02.

    The loss is convex in an anchor, and a unit vector lies in the unit ball, where Frank-Wolfe
    steps give an iterate f(a) and the gap f(a) - f* <= <grad, a> + |grad|. The best difference over
    the steps is returned: never above the true minimum, and close to it.
    """
    target = target.double()
    n = len(target)
    right = torch.eye(n, dtype=torch.bool) if positives is None else positives
    goal = (right / right.sum(1, keepdim=True)).to(target)
    anchor = torch.nn.functional.normalize(goal @ target, dim=1)
    best = torch.full((n,), -torch.inf, dtype=torch.float64, device=target.device)
    for step in range(_FLOOR_STEPS):
        logits = anchor @ target.T / temperature
        loss = logits.logsumexp(1) - (goal * logits).sum(1)
        gradient = (logits.softmax(1) - goal) @ target / temperature
        length = gradient.norm(dim=1, keepdim=True)
        gap = (gradient * anchor).sum(1) + length[:, 0]
        best = torch.maximum(best, loss - gap)
        rate = 2 / (step + 2)
        anchor = (1 - rate) * anchor - rate * gradient / length.clamp_min(1e-12)
    return best.mean().item()
