"""Fit of a policy's end output: it learns how successful recordings end."""

import torch
import torch.nn.functional as F
from accelerate.utils import send_to_device
from jaxtyping import Bool, Float
from torch import Tensor

from touchgoal.policies.heads.end import LASTING, EndOutput
from touchgoal.policies.network import PolicyNetwork
from touchgoal.policies.perception.proprioception import input_widths
from touchgoal.policies.sight.key_pose import KEY_POSE_DIM
from touchgoal.policies.training.sequence_dataset import SequenceDataset

_STEPS, _PASSES, _BATCH = 1500, 100, 512  # steps and passes over the data at most
_RATE, _DECAY, _NOISE = 1e-3, 1e-2, 0.1
_LEAST_SPREAD = 0.05  # of an input by sight, to divide by: few recordings show too little of it
_ROWS = 1024  # windows that are encoded at once
_EARLY = 0.5  # s before the end of a recording begins at which it is not done
_LEAST_LIMIT = 0.5
_LEAST_SHARE, _FEWEST = 0.5, 5  # share of the ends that must be noticed, of so many at least


def fit_end(
    policy: PolicyNetwork, windows: SequenceDataset, validation: SequenceDataset, seed: int
) -> tuple[int, int]:
    """Fit the end output to windows; return how many of the successful validation episodes it ends.

    The second number is that of these episodes. The limit is the least that no validation episode exceeds
    half a second before its end begins; infinite if fewer than half of the ends, or of 5 episodes, exceed it.
    """
    assert policy.end is not None, "the policy has no end output"
    condition, done = _conditions(policy, windows), windows.recorded.done.float()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        end = EndOutput(condition.shape[1]).requires_grad_(True)
    end.mean.copy_(condition.mean(0))
    end.scale.copy_(condition.std(0).clamp(min=_LEAST_SPREAD if policy.key_pose else 1e-6))
    end.scale[~read_by_end(policy)] = torch.inf
    inputs, generator = end.scaled(condition), torch.Generator().manual_seed(seed)
    optimiser = torch.optim.AdamW(end.parameters(), _RATE, weight_decay=_DECAY)
    for _ in range(min(_STEPS, _PASSES * -(-len(inputs) // _BATCH))):
        rows = torch.randint(len(inputs), (min(_BATCH, len(inputs)),), generator=generator)
        noise = _NOISE * torch.randn(len(rows), inputs.shape[1], generator=generator)
        found = end.network(inputs[rows] + noise)[:, 0]
        optimiser.zero_grad()
        F.binary_cross_entropy_with_logits(found, done[rows]).backward()
        optimiser.step()
    end.stands.fill_((windows.recorded.succeeded & windows.recorded.done).sum() > done.sum() / 2)
    ended = _set_limit(end.requires_grad_(False), policy, validation)
    policy.end.load_state_dict(end.state_dict())
    return ended


def read_by_end(policy: PolicyNetwork) -> Bool[Tensor, " c"]:
    """Return which of the head's inputs the end output reads: with cameras the gripper's width and the key pose.

    It would else learn the turns and tilts of the hand at the few ends that it is shown.
    """
    config, read = policy.config, torch.ones(policy.condition_dim, dtype=torch.bool)
    if policy.key_pose:
        ticks = read[:-KEY_POSE_DIM].view(config.observation_horizon, -1)
        ticks[:] = False
        _, *others = input_widths(config.proprioception, config.representation)
        ticks[:, -sum(others) - 1] = True
    return read


def _set_limit(
    end: EndOutput, policy: PolicyNetwork, validation: SequenceDataset
) -> tuple[int, int]:
    recorded, hz = validation.recorded, policy.config.control_hz
    last, before = [], [_LEAST_LIMIT]
    found, lengths = end(_conditions(policy, validation)), list(recorded.lengths)
    for episode, done in zip(found.split(lengths), recorded.done.split(lengths), strict=True):
        lasting = episode.unfold(0, min(round(LASTING * hz), len(episode)), 1).amin(1)
        before += lasting[: -int(done.sum()) - round(_EARLY * hz) if done[-1] else None].tolist()
        last += [lasting.max().item()] * bool(done[-1])
    limit = max(before)
    ended = sum(value > limit for value in last)
    end.limit.fill_(limit if ended >= _LEAST_SHARE * max(len(last), _FEWEST) else torch.inf)
    return ended if end.limit.isfinite() else 0, len(last)


@torch.no_grad()
def _conditions(policy: PolicyNetwork, windows: SequenceDataset) -> Float[Tensor, "n c"]:
    """Return what the head reads in each window, at true key poses with cameras."""
    device, found = policy.action_normalizer.scale.device, []
    for rows in torch.arange(len(windows)).split(_ROWS):
        given = send_to_device((windows.take(rows)[0], windows.key_pose(rows)), device)
        found.append(policy.condition(*given).cpu())
    return torch.cat(found)
