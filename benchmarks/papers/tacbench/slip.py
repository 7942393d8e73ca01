"""T2: whether the probe slips over the pad."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from benchmarks.papers.tacbench.attentive import AttentiveProbe
from benchmarks.papers.tacbench.data import RigFrames, Rows
from benchmarks.papers.tacbench.task import Metrics, Outputs, Targets, split_slip
from benchmarks.real_touch.property_probe import interval
from touchgoal.sim_envs.object_slides import FRICTION

_THRESHOLDS = 200


class SlipTask:
    """Whether the probe slides, learned together with the force change within the pair."""

    def __init__(self, frames: RigFrames) -> None:
        """Take frames of strokes."""
        self._frames = frames
        self._change = frames.force - frames.force[frames.before]
        self.split = split_slip(frames)
        self._scale = self._change[self.split.train].abs().amax(0)
        share = frames.slip[self.split.train].float().mean()
        self._weight = (1 - share) / share.clamp(min=1e-3)

    def probe(self, features: int, grid: tuple[int, int]) -> nn.Module:
        """See Task."""
        return AttentiveProbe(features, 4)

    def targets(self, rows: Rows) -> Targets:
        """Return slip (0 or 1) and force changes over their range."""
        change = self._change[rows] / self._scale
        return torch.cat([self._frames.slip[rows, None].float(), change], 1)

    def loss(self, outputs: Outputs, targets: Targets) -> Float[Tensor, ""]:
        """Return weighted cross entropy plus mean absolute error."""
        slip = F.binary_cross_entropy_with_logits(
            outputs[:, 0], targets[:, 0], pos_weight=self._weight.to(outputs)
        )
        return slip + F.l1_loss(outputs[:, 1:], targets[:, 1:])

    def error(self, outputs: Outputs, rows: Rows) -> float:
        """Return 1 - F1 at its best threshold."""
        best = self.threshold(outputs, rows)
        return 1 - f1_score(outputs[:, 0].numpy() > best, self.truth(rows))

    def threshold(self, outputs: Outputs, rows: Rows) -> float:
        """Return the threshold on the raw output with the best F1."""
        truth = self.truth(rows)
        return max(_cuts(outputs), key=lambda t: f1_score(outputs[:, 0].numpy() > t, truth))

    def truth(self, rows: Rows) -> Bool[np.ndarray, " b"]:
        """Return whether frames slip."""
        return self._frames.slip[rows].numpy()

    def judge(self, predicted: list[Outputs], validation: list[Outputs], rows: Rows) -> Metrics:
        """Return F1 at validation thresholds, and the mean absolute force change error, mN."""
        cuts = [self.threshold(outputs, self.split.validation) for outputs in validation]
        slips = np.stack([o[:, 0].numpy() > t for o, t in zip(predicted, cuts, strict=True)])
        errors = [(o[:, 1:] * self._scale - self._change[rows]).abs().mean() for o in predicted]
        metrics = slip_metrics(slips, self.truth(rows), self._frames.stroke[rows.numpy()])
        return metrics | {"change_mae_mn": 1e3 * float(np.mean(errors)), "thresholds": cuts}

    def references(self, rows: Rows) -> dict[str, Metrics]:
        """Return the metrics of "always slips" and of true forces with the nominal cone."""
        truth, objects = self.truth(rows), self._frames.stroke[rows.numpy()]
        force = self._frames.force[rows].double().numpy()
        cone = np.hypot(force[:, 0], force[:, 1]) >= FRICTION * force[:, 2]
        predicted = {"(always slips)": np.ones_like(truth), "(true forces, nominal cone)": cone}
        return {
            name: slip_metrics(slips[None], truth, objects) for name, slips in predicted.items()
        }


def _cuts(outputs: Outputs) -> list[float]:
    return torch.quantile(outputs[:, 0], torch.linspace(0, 1, _THRESHOLDS)[:-1]).tolist()


def f1_score(predicted: Bool[np.ndarray, " n"], truth: Bool[np.ndarray, " n"]) -> float:
    """Return the F1 score of the class true; 0 where no prediction is right."""
    right = float((predicted & truth).sum())
    return 2 * right / max(float(predicted.sum() + truth.sum()), 1.0)


def slip_metrics(
    predicted: Bool[np.ndarray, "seeds n"], truth: Bool[np.ndarray, " n"], objects: np.ndarray
) -> Metrics:
    """Return the F1 of slip, mean over seeds, with its interval."""
    together = np.vstack([truth, predicted]).T

    def f1(values: np.ndarray) -> float:
        return float(np.mean([f1_score(column, values[:, 0]) for column in values.T[1:]]))

    return {"f1": f1(together), "f1_interval": list(interval(together, objects, f1))}
