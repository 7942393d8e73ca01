"""T4 and T6: one label per pair of frames, whether a grasp holds or which cloth it is."""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from benchmarks.papers.tacbench.attentive import AttentiveProbe
from benchmarks.papers.tacbench.data import RigFrames, Rows
from benchmarks.papers.tacbench.task import (
    Metrics,
    Outputs,
    Split,
    Targets,
    split_grasp,
    split_textile,
)
from benchmarks.papers.tacbench_rig.cloths import CLOTHS
from benchmarks.real_touch.property_probe import interval


class LabelTask:
    """One label for each pair of frames."""

    def __init__(
        self, frames: RigFrames, split: Callable[[RigFrames], Split], names: tuple[str, ...]
    ) -> None:
        """Take frames whose labels are numbers of these names."""
        assert frames.label is not None
        self._label, self._stroke = frames.label, frames.stroke
        self.split, self.names = split(frames), names
        train = self._label[self.split.train]
        self._known = torch.bincount(train, minlength=len(names))
        self._weights = len(train) / len(names) / self._known.clamp(min=1)

    def probe(self, features: int, grid: tuple[int, int]) -> nn.Module:
        """See Task."""
        return AttentiveProbe(features, len(self.names))

    def targets(self, rows: Rows) -> Targets:
        """Return the labels."""
        return self._label[rows, None].float()

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Return the weighted cross entropy."""
        return F.cross_entropy(outputs, targets[:, 0].long(), self._weights.to(outputs))

    def truth(self, rows: Rows) -> Int[np.ndarray, " b"]:
        """Return the true labels."""
        return self._label[rows].numpy()

    def read(self, outputs: Outputs) -> Int[np.ndarray, " b"]:
        """Return the most probable labels."""
        return outputs.argmax(1).numpy()

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """Return 1 - accuracy plus a little of the loss, which breaks ties of few recordings."""
        loss = float(self.loss(outputs, self.targets(rows)))
        return float((self.read(outputs) != self.truth(rows)).mean()) + 0.01 * loss

    def judge(self, predicted: list[Outputs], validation: list[Outputs], rows: Rows) -> Metrics:
        """See `label_metrics`."""
        read = np.stack([self.read(outputs) for outputs in predicted])
        return label_metrics(read, self.truth(rows), self._stroke[rows.numpy()])

    def references(self, rows: Rows) -> dict[str, Metrics]:
        """Return the metrics of the most frequent training label."""
        common = np.full((1, len(rows)), int(self._known.argmax()))
        metrics = label_metrics(common, self.truth(rows), self._stroke[rows.numpy()])
        return {"(commonest label)": metrics}


def label_metrics(
    predicted: Int[np.ndarray, "seeds n"], truth: Int[np.ndarray, " n"], objects: np.ndarray
) -> Metrics:
    """Return accuracy, mean over seeds, with its interval, and the mean accuracy of the labels."""
    right = (predicted == truth).mean(0)
    return {
        "accuracy": float(right.mean()),
        "accuracy_interval": list(interval(right, objects)),
        "balanced_accuracy": float(np.mean([right[truth == k].mean() for k in np.unique(truth)])),
    }


def grasp_task(frames: RigFrames) -> LabelTask:
    """Return T4: whether the object is still held after the shake."""
    return LabelTask(frames, split_grasp, ("falls", "holds"))


def textile_task(frames: RigFrames) -> LabelTask:
    """Return T6: which cloth."""
    return LabelTask(frames, split_textile, tuple(cloth.name for cloth in CLOTHS))
