"""Fit of a policy's end output: it learns how successful recordings end."""

import torch
import torch.nn.functional as F
from accelerate.utils import send_to_device
from jaxtyping import Float
from torch import Tensor

from touchgoal.policies.heads.end import DONE_SECONDS, EndOutput
from touchgoal.policies.network import PolicyNetwork
from touchgoal.policies.training.sequence_dataset import SequenceDataset

_STEPS, _BATCH, _RATE, _DECAY, _NOISE = 1500, 512, 1e-3, 1e-2, 0.1
_ROWS = 1024  # windows that are encoded at once
_LIMITS = 0.5, 0.6, 0.7, 0.8, 0.9, 0.95
_EARLY = 1.0  # s before a recording's end at which it is not done
_LEAST = 0.5  # share of the successful recordings whose end must be noticed


def fit_end(
    policy: PolicyNetwork, windows: SequenceDataset, validation: SequenceDataset, seed: int
) -> tuple[int, int]:
    """Fit the end output to windows; return how many of the successful validation episodes it ends.

    The second number is that of these episodes. The limit is the lowest at which none of the validation
    episodes ends a second early; infinite if fewer than half are ended by then.
    """
    end = policy.end
    assert end is not None, "the policy has no end output"
    condition, done = _conditions(policy, windows), windows.recorded.done.float()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = EndOutput(condition.shape[1])
    fresh.mean.copy_(condition.mean(0))
    fresh.scale.copy_(condition.std(0).clamp(min=1e-6))
    inputs = fresh.scaled(condition)
    fresh.requires_grad_(True)
    optimiser = torch.optim.AdamW(fresh.parameters(), _RATE, weight_decay=_DECAY)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(_STEPS):
        rows = torch.randint(len(inputs), (min(_BATCH, len(inputs)),), generator=generator)
        noise = _NOISE * torch.randn(len(rows), inputs.shape[1], generator=generator)
        found = fresh.network(inputs[rows] + noise)[:, 0]
        loss = F.binary_cross_entropy_with_logits(found, done[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    fresh.requires_grad_(False)
    ended = _set_limit(fresh, policy, validation)
    end.load_state_dict(fresh.state_dict())
    return ended


def _set_limit(
    end: EndOutput, policy: PolicyNetwork, validation: SequenceDataset
) -> tuple[int, int]:
    recorded, hz = validation.recorded, policy.config.control_hz
    end.limit.fill_(1.0)
    found = end(_conditions(policy, validation)).split(list(recorded.lengths))
    succeeded = [bool(part[-1]) for part in recorded.done.split(list(recorded.lengths))]
    hold, early = round(DONE_SECONDS * hz), round(_EARLY * hz)
    lasting = [part.unfold(0, min(hold, len(part)), 1).amin(1) for part in found]
    for limit in _LIMITS:
        before = [
            part[: -early if good else None] for part, good in zip(lasting, succeeded, strict=True)
        ]
        if any((part >= limit).any() for part in before):
            continue
        told = sum(
            bool((part >= limit).any())
            for part, good in zip(lasting, succeeded, strict=True)
            if good
        )
        if told >= max(1, _LEAST * sum(succeeded)):
            end.limit.fill_(limit)
            return told, sum(succeeded)
    end.limit.fill_(torch.inf)
    return 0, sum(succeeded)


@torch.no_grad()
def _conditions(policy: PolicyNetwork, windows: SequenceDataset) -> Float[Tensor, "n c"]:
    """Return what the head reads in each window, at true key poses with cameras."""
    device, found = policy.action_normalizer.scale.device, []
    for rows in torch.arange(len(windows)).split(_ROWS):
        given = send_to_device((windows.take(rows)[0], windows.key_pose(rows)), device)
        found.append(policy.condition(*given).cpu())
    return torch.cat(found)
