"""One probe's predictions of test frames, drawn as in the paper."""

from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from touchgoal.benchmarks.papers.tacbench.data import RigFrames, Rows
from touchgoal.benchmarks.papers.tacbench.field import FieldTask
from touchgoal.benchmarks.papers.tacbench.force import ForceTask
from touchgoal.benchmarks.papers.tacbench.labels import LabelTask
from touchgoal.benchmarks.papers.tacbench.pose import CLASSES, SHIFT_BINS, TURN_BINS, PoseTask
from touchgoal.benchmarks.papers.tacbench.slip import SlipTask
from touchgoal.benchmarks.papers.tacbench.task import Task
from touchgoal.sim_envs.indenter_rig import FRICTION

_AXES = "xyz"
_WORST = 0.1  # share of the largest normal force at the end of the error's colours


@dataclass(frozen=True)
class Read:
    """The first seed's outputs of test frames: `outputs` of the frames `rows`."""

    name: str
    task: Task
    frames: RigFrames
    encoder: str
    share: float
    test: str
    rows: Rows
    outputs: torch.Tensor


def draw_force(axes: np.ndarray, one: Read) -> None:
    """Draw the friction cone coloured by error (Figures 7 and 8), and predicted against true."""
    assert isinstance(one.task, ForceTask)
    truth, predicted = one.frames.force[one.rows].numpy(), one.task.read(one.outputs).numpy()
    error = 1e3 * np.abs(predicted - truth)
    worst = 1e3 * _WORST * truth[:, 2].max()
    for k, axis in enumerate(axes[:3]):
        most = truth[:, 2].max()
        for side in (-1, 1):
            axis.plot([0, side * FRICTION * most], [0, most], color="0.6", linewidth=1)
        points = axis.scatter(
            truth[:, 0], truth[:, 2], s=5, c=error[:, k], cmap="turbo", vmin=0, vmax=worst
        )
        axis.figure.colorbar(points, ax=axis, label="error (mN)")
        axis.set(xlabel="shear x (N)", ylabel="normal force (N)")
        axis.set_title(f"{one.encoder}: error in {_AXES[k]}", fontsize=9)
    ends = [min(truth.min(), predicted.min()), max(truth.max(), predicted.max())]
    axes[3].plot(ends, ends, color="0.6", linewidth=1)
    for k in range(3):
        axes[3].scatter(truth[:, k], predicted[:, k], s=4, alpha=0.4, label=_AXES[k])
    axes[3].legend(fontsize=8, markerscale=3)
    axes[3].set(xlabel="true force (N)", ylabel="predicted (N)")


def draw_slip(axes: np.ndarray, one: Read) -> None:
    """Draw four test strokes with slip over time (Figure 11)."""
    assert isinstance(one.task, SlipTask)
    stroke, truth = one.frames.stroke[one.rows.numpy()], one.task.truth(one.rows)
    likely = torch.sigmoid(one.outputs[:, 0]).numpy()
    slipping = [s for s in np.unique(stroke) if 0 < truth[stroke == s].mean() < 1]
    for axis, number in zip(axes, slipping, strict=False):
        own = stroke == number
        force = one.frames.force[one.rows][torch.from_numpy(own)].numpy()
        ratio = np.hypot(force[:, 0], force[:, 1]) / np.maximum(force[:, 2], 1e-9)
        frames = np.arange(own.sum())
        axis.fill_between(frames, truth[own].astype(float), step="mid", alpha=0.25, label="slips")
        axis.plot(frames, likely[own], color="C3", label="the probe's probability")
        axis.plot(frames, ratio, color="0.4", linewidth=1, label="shear / normal force")
        axis.axhline(FRICTION, color="0.4", linewidth=0.7, linestyle=":", label="nominal cone")
        axis.set(xlabel="frames since touch", ylim=(-0.05, 1.05))
        axis.set_title(f"{one.encoder}, stroke {number}", fontsize=9)
    if slipping:
        axes[0].legend(fontsize=7, loc="upper left")
    for axis in axes[len(slipping) :]:
        axis.axis("off")


def draw_pose(axes: np.ndarray, one: Read) -> None:
    """Draw confusion matrices (Figure 13) and a test slide over time (Figure 14)."""
    assert isinstance(one.task, PoseTask)
    truth, predicted = one.task.classes[one.rows].numpy(), one.task.read(one.outputs).numpy()
    names = ("x", "y", "turn")
    for k, axis in enumerate(axes[:3]):
        units, bins = ("mm", SHIFT_BINS) if k < 2 else ("degrees", TURN_BINS)
        bounds = [*(-b for b in reversed(bins)), *bins]
        _draw_confusion(axis, truth[:, k], predicted[:, k], CLASSES)
        axis.set_xticks(np.arange(CLASSES - 1) + 0.5, [f"{b:g}" for b in bounds], rotation=90)
        axis.set_yticks(np.arange(CLASSES - 1) + 0.5, [f"{b:g}" for b in bounds])
        axis.set(xlabel=f"predicted ({units})", ylabel=f"true ({units})")
        right = (truth[:, k] == predicted[:, k]).mean()
        axis.set_title(f"{one.encoder}: {names[k]}, {right:.2f} right", fontsize=9)
    stroke = one.frames.stroke[one.rows.numpy()]
    own = stroke == stroke[0]
    frames = np.arange(own.sum())
    shade = ScalarMappable(Normalize(0, CLASSES - 1), "inferno")
    for k, name in enumerate(names):
        off = np.abs(truth[own, k] - predicted[own, k])
        axes[3].step(frames, truth[own, k] + 12 * k, color="0.7", linewidth=1, where="mid")
        axes[3].scatter(frames, truth[own, k] + 12 * k, c=shade.to_rgba(off), s=10)
        axes[3].text(0, 12 * k + 10.2, name, fontsize=8)
    axes[3].set(xlabel="frames since touch", ylabel="true class", yticks=[])
    axes[3].set_title(f"slide {stroke[0]}", fontsize=9)
    axes[3].figure.colorbar(shade, ax=axes[3], label="classes off")


def draw_labels(axes: np.ndarray, one: Read) -> None:
    """Draw the confusion matrix (Figure 15) and, with few labels, where errors lie."""
    assert isinstance(one.task, LabelTask)
    truth, predicted, names = one.task.truth(one.rows), one.task.read(one.outputs), one.task.names
    _draw_confusion(axes[0], truth, predicted, len(names), numbers=len(names) < 5)
    for ticks in (axes[0].set_xticks, axes[0].set_yticks):
        ticks(range(len(names)), names, fontsize=8)
    axes[0].tick_params(axis="x", rotation=90 if len(names) > 4 else 0)
    axes[0].set(xlabel="predicted", ylabel="true")
    axes[0].set_title(f"{one.encoder}: {(truth == predicted).mean():.2f} right", fontsize=9)
    if len(axes) > 1:
        force = one.frames.force[one.rows].numpy()
        shear, normal = np.hypot(force[:, 0], force[:, 1]), force[:, 2]
        for k, name in enumerate(names):
            for right, marker in ((True, "o"), (False, "x")):
                own = (truth == k) & ((predicted == truth) == right)
                label = f"{name}, {'right' if right else 'wrong'}"
                axes[1].scatter(
                    normal[own], shear[own], s=18, marker=marker, color=f"C{k}", label=label
                )
        axes[1].set(xlabel="normal force (N)", ylabel="shear (N)")
        axes[1].legend(fontsize=7)


def draw_field(axes: np.ndarray, one: Read) -> None:
    """Draw the true field above and the predicted one below (Figure 9): pressure as colour,
    shear as arrows."""
    assert isinstance(one.task, FieldTask)
    truth, predicted = one.task.truth(one.rows).numpy(), one.task.read(one.outputs).numpy()
    stroke = one.frames.stroke[one.rows.numpy()]
    shear = np.hypot(truth[:, 0], truth[:, 1]).sum((1, 2))
    ends = [np.flatnonzero(stroke == s)[shear[stroke == s].argmax()] for s in np.unique(stroke)]
    chosen = ends[:: max(len(ends) // axes.shape[1], 1)][: axes.shape[1]]
    size = one.frames.touch.shape[2], one.frames.touch.shape[3]
    for axis, i in zip(axes[0], chosen, strict=False):
        _draw_arrows(axis, truth[i], truth[i], size)
        axis.set_title(f"true, stroke {stroke[i]}", fontsize=9)
    for axis, i in zip(axes[1], chosen, strict=False):
        _draw_arrows(axis, predicted[i], truth[i], size)
        axis.set_title(one.encoder, fontsize=9)
    for axis in axes[:, len(chosen) :].flat:
        axis.axis("off")


def _draw_arrows(axis: Axes, field: np.ndarray, like: np.ndarray, picture: tuple[int, int]) -> None:
    """Draw a field over an image, on the scale of another field."""
    h, w = picture
    rows, columns = field.shape[1:]
    image = axis.imshow(
        field[2], cmap="magma", vmin=0, vmax=like[2].max(), extent=(0.0, w, h, 0.0), aspect="equal"
    )
    axis.figure.colorbar(image, ax=axis, shrink=0.8, label="kPa")
    y, x = (np.mgrid[:rows, :columns] + 0.5) * np.reshape([h / rows, w / columns], (2, 1, 1))
    size = max(float(np.hypot(like[0], like[1]).max()), 1e-6)
    seen = np.hypot(field[0], field[1]) > 0.05 * size
    axis.quiver(
        x[seen], y[seen], field[0][seen], field[1][seen],
        color="cyan", angles="xy", scale_units="xy", scale=size / (3 * w / columns), width=0.006,
    )  # fmt: skip
    axis.set(xticks=[], yticks=[])


def _draw_confusion(
    axis: Axes, truth: np.ndarray, predicted: np.ndarray, classes: int, numbers: bool = False
) -> None:
    counts = np.zeros((classes, classes))
    np.add.at(counts, (truth, predicted), 1)
    shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    image = axis.imshow(shares, vmin=0, vmax=1, cmap="Blues")
    axis.figure.colorbar(image, ax=axis, shrink=0.8)
    if numbers:
        for i, j in np.ndindex(classes, classes):
            text = f"{shares[i, j]:.2f}\n({counts[i, j]:.0f})"
            colour = "w" if shares[i, j] > 0.6 else "k"
            axis.text(j, i, text, ha="center", va="center", color=colour, fontsize=9)
