"""T3: change of an object's pose on the pad."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from benchmarks.papers.tacbench.attentive import AttentiveProbe
from benchmarks.papers.tacbench.data import RigFrames, Rows
from benchmarks.papers.tacbench.task import Metrics, Outputs, Targets, split_pose
from benchmarks.real_touch.property_probe import interval

SHIFT_BINS, TURN_BINS = (0.1, 0.5, 1.0, 2.0, 5.0), (0.03, 0.2, 0.5, 1.0, 2.0)
"""Bounds of the classes on either side of 0, mm and degrees, as Sparsh."""
CLASSES = 2 * len(SHIFT_BINS) + 1


class PoseTask:
    """Pose change within a pair, along x, along y and about z, in 11 classes each."""

    def __init__(self, frames: RigFrames) -> None:
        """Take frames of slides."""
        assert frames.pose is not None
        self._frames = frames
        self.split = split_pose(frames)
        bins = (SHIFT_BINS, SHIFT_BINS, TURN_BINS)
        change = frames.pose - frames.pose[frames.before]
        self.classes = torch.stack([_classes(change[:, k], bins[k]) for k in range(3)], 1)
        train = self.classes[self.split.train]
        self._known = [torch.bincount(train[:, k], minlength=CLASSES) for k in range(3)]
        least = len(train) / 100  # rare classes weigh more, at most as a class of 1 % of the pairs
        self._weights = [len(train) / CLASSES / n.clamp(min=least) for n in self._known]

    def probe(self, features: int, grid: tuple[int, int]) -> nn.Module:
        """See Task."""
        return AttentiveProbe(features, 3 * CLASSES)

    def targets(self, rows: Rows) -> Targets:
        """Return the classes by axis."""
        return self.classes[rows].float()

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Return the sum over axes of the weighted cross entropy."""
        parts = outputs.unflatten(1, (3, CLASSES)).unbind(1)
        losses = [
            F.cross_entropy(part, targets[:, k].long(), self._weights[k].to(part))
            for k, part in enumerate(parts)
        ]
        return torch.stack(losses).sum()

    def read(self, outputs: Outputs) -> Int[Tensor, "b 3"]:
        """Return the most probable classes."""
        return outputs.unflatten(1, (3, CLASSES)).argmax(2)

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """Return 1 - accuracy, mean over axes."""
        return float((self.read(outputs) != self.classes[rows]).float().mean())

    def judge(self, predicted: list[Outputs], validation: list[Outputs], rows: Rows) -> Metrics:
        """See `pose_metrics`."""
        read = np.stack([self.read(outputs).numpy() for outputs in predicted])
        return pose_metrics(read, self.classes[rows].numpy(), self._frames.stroke[rows.numpy()])

    def references(self, rows: Rows) -> dict[str, Metrics]:
        """Return the metrics of the most frequent training classes."""
        truth = self.classes[rows].numpy()
        common = np.broadcast_to([int(n.argmax()) for n in self._known], truth.shape)
        objects = self._frames.stroke[rows.numpy()]
        return {"(commonest classes)": pose_metrics(common[None], truth, objects)}


def _classes(change: Float[Tensor, " n"], bins: tuple[float, ...]) -> Int[Tensor, " n"]:
    """Return classes 0 to 10: the number of bounds at or below a change."""
    bounds = torch.tensor([*(-b for b in reversed(bins)), *bins])
    return torch.bucketize(change.contiguous(), bounds, right=True)


def pose_metrics(
    predicted: Int[np.ndarray, "seeds n 3"], truth: Int[np.ndarray, "n 3"], objects: np.ndarray
) -> Metrics:
    """Return accuracy (mean over axes) with its interval, by axis, and within one class."""
    right = (predicted == truth).mean(0)
    return {
        "accuracy": float(right.mean()),
        "accuracy_interval": list(interval(right, objects)),
        "accuracy_by_axis": right.mean(0).tolist(),
        "within_one_class": float((np.abs(predicted - truth) <= 1).mean()),
    }
