"""What TacBench asks of a touch encoder: T1, the force on the pad; T2, whether it slips; T3, how it moves."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from touchgoal.benchmarks.tacbench.data import (
    RigFrames,
    Rows,
    Split,
    split_force,
    split_pose,
    split_slip,
)

_BETA = 0.02  # of the smooth L1 loss, in shares of the force's range: Sparsh's
_THRESHOLDS = 200
_SHIFT_BINS, _TURN_BINS = (
    (0.1, 0.5, 1.0, 2.0, 5.0),
    (0.03, 0.2, 0.5, 1.0, 2.0),
)  # mm, degrees: Sparsh's
CLASSES = 2 * len(_SHIFT_BINS) + 1

Outputs = Float[Tensor, "b k"]
Targets = Float[Tensor, "b _"]


@runtime_checkable
class Task(Protocol):
    """One task, on one set of frames."""

    outputs: int
    split: Split

    def targets(self, rows: Rows) -> Targets:
        """What a probe is to put out."""
        ...

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Of a probe's raw outputs."""
        ...

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """By which snapshots are compared on validation frames; less is better."""
        ...


class ForceTask:
    """T1: shear along x and y, and normal force.

    Outputs are squashed and stand for shares of the largest force of each axis in training.
    """

    outputs = 3

    def __init__(self, frames: RigFrames) -> None:
        """Of the frames of strokes."""
        self._force = frames.force
        self.split = split_force(frames)
        self._scale = 1.1 * frames.force[self.split.train].abs().amax(0)

    def targets(self, rows: Rows) -> Targets:
        """Forces over their range."""
        return self._force[rows] / self._scale

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Smooth L1."""
        return F.smooth_l1_loss(_squash(outputs), targets, beta=_BETA)

    def read(self, outputs: Outputs) -> Float[Tensor, "b 3"]:
        """Forces, N."""
        return _squash(outputs) * self._scale

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """Root mean square over frames and axes, N."""
        return float((self.read(outputs) - self._force[rows]).square().mean().sqrt())

    def errors(self, outputs: Outputs, rows: Rows) -> Float[np.ndarray, "b 3"]:
        """Predicted less true, N."""
        return (self.read(outputs) - self._force[rows]).double().numpy()


def _squash(outputs: Outputs) -> Outputs:
    return torch.cat([outputs[:, :2].tanh(), outputs[:, 2:].sigmoid()], 1)


class SlipTask:
    """T2: whether the probe slides; and by how much the force changed in the pair, learned beside it."""

    outputs = 4

    def __init__(self, frames: RigFrames) -> None:
        """Of the frames of strokes."""
        self._slip = frames.slip
        self._change = frames.force - frames.force[frames.before]
        self.split = split_slip(frames)
        self._scale = self._change[self.split.train].abs().amax(0)
        share = frames.slip[self.split.train].float().mean()
        self._weight = (1 - share) / share.clamp(min=1e-3)

    def targets(self, rows: Rows) -> Targets:
        """Slip (0 or 1) and changes of the force over their range."""
        return torch.cat([self._slip[rows, None].float(), self._change[rows] / self._scale], 1)

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Weighted cross entropy and mean absolute error."""
        slip = F.binary_cross_entropy_with_logits(
            outputs[:, 0], targets[:, 0], pos_weight=self._weight.to(outputs)
        )
        return slip + F.l1_loss(outputs[:, 1:], targets[:, 1:])

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """1 less the F1 score at its best threshold."""
        truth = self._slip[rows].numpy()
        return 1 - max(f1_score(outputs[:, 0].numpy() > t, truth) for t in _cuts(outputs))

    def threshold(self, outputs: Outputs, rows: Rows) -> float:
        """Of the raw output: where F1 is best."""
        truth = self._slip[rows].numpy()
        return max(_cuts(outputs), key=lambda t: f1_score(outputs[:, 0].numpy() > t, truth))

    def truth(self, rows: Rows) -> Bool[np.ndarray, " b"]:
        """Whether frames slip."""
        return self._slip[rows].numpy()

    def change_error(self, outputs: Outputs, rows: Rows) -> Float[np.ndarray, " b"]:
        """Mean over axes of the absolute error of the change of force, N."""
        read = outputs[:, 1:] * self._scale
        return (read - self._change[rows]).abs().mean(1).double().numpy()


class PoseTask:
    """T3: the change of an object's pose in the pair, along x and y and about z, in 11 classes each."""

    outputs = 3 * CLASSES

    def __init__(self, frames: RigFrames) -> None:
        """Of the frames of slides."""
        assert frames.pose is not None
        self.split = split_pose(frames)
        bins = (_SHIFT_BINS, _SHIFT_BINS, _TURN_BINS)
        change = frames.pose - frames.pose[frames.before]
        self.classes = torch.stack([_classes(change[:, k], bins[k]) for k in range(3)], 1)
        known = [
            torch.bincount(self.classes[self.split.train, k], minlength=CLASSES) for k in range(3)
        ]
        # rare classes count more; none more than one of a hundredth of the frames
        least = len(self.split.train) / 100
        self._weights = [len(self.split.train) / CLASSES / n.clamp(min=least) for n in known]

    def targets(self, rows: Rows) -> Targets:
        """Classes, by axis."""
        return self.classes[rows].float()

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Sum over axes of the weighted cross entropy."""
        parts = outputs.unflatten(1, (3, CLASSES)).unbind(1)
        losses = [
            F.cross_entropy(part, targets[:, k].long(), self._weights[k])
            for k, part in enumerate(parts)
        ]
        return torch.stack(losses).sum()

    def read(self, outputs: Outputs) -> Int[Tensor, "b 3"]:
        """The likeliest classes."""
        return outputs.unflatten(1, (3, CLASSES)).argmax(2)

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """1 less the accuracy, the mean over axes."""
        return float((self.read(outputs) != self.classes[rows]).float().mean())


def _classes(change: Float[Tensor, " n"], bins: tuple[float, ...]) -> Int[Tensor, " n"]:
    """0 to 10: how many of the bounds -5 to 5 lie at or below a change."""
    bounds = torch.tensor([*(-b for b in reversed(bins)), *bins])
    return torch.bucketize(change.contiguous(), bounds, right=True)


def _cuts(outputs: Outputs) -> list[float]:
    """Places between raw outputs."""
    return torch.quantile(outputs[:, 0], torch.linspace(0, 1, _THRESHOLDS)[:-1]).tolist()


def f1_score(said: Bool[np.ndarray, " n"], truth: Bool[np.ndarray, " n"]) -> float:
    """Of the class true; 0 where nothing is right."""
    right = float((said & truth).sum())
    return 2 * right / max(float(said.sum() + truth.sum()), 1.0)


TASKS: dict[str, Callable[[RigFrames], Task]] = {
    "force": ForceTask,
    "slip": SlipTask,
    "pose": PoseTask,
}
