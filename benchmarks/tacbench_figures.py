"""TacBench as a table beside the paper's numbers, and as a picture."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from touchgoal.benchmarks.config import TacbenchOptions
from touchgoal.benchmarks.tacbench_data import RigFrames, Rows
from touchgoal.benchmarks.tacbench_tasks import CLASSES, ForceTask, PoseTask, SlipTask, Task
from touchgoal.sim_envs.indenter_rig import FRICTION

_SHARES = (1.0, 1 / 3, 0.1, 0.01)
_AXES = "xyz"
# Tables 5 to 8 of Sparsh (real sensors), by share of the labels. What it calls RMSE of the force is
# computed as a mean absolute error over the axes (its code); its tables of slip and pose are a DIGIT's.
PAPER = {
    "force": {
        "gelsight_mini": {
            "E2E": (57.21, 59.09, 57.43, 82.42),
            "Sparsh (MAE)": (22.72, 23.28, 33.56, 78.98),
            "Sparsh (DINO)": (20.25, 23.79, 32.17, 53.43),
            "Sparsh (IJEPA)": (27.91, 35.20, 44.93, 91.81),
            "Sparsh (VJEPA)": (33.26, 34.07, 42.35, 80.36),
        },
        "digit": {
            "E2E": (39.34, 61.42, 98.22, 187.51),
            "Sparsh (MAE)": (36.61, 45.96, 58.55, 115.39),
            "Sparsh (DINO)": (36.09, 44.03, 51.89, 97.95),
            "Sparsh (IJEPA)": (40.27, 60.04, 86.57, 130.37),
            "Sparsh (VJEPA)": (39.38, 56.34, 76.11, 130.83),
        },
    },
    "slip": {
        "digit": {
            "E2E": (0.767, 0.238, 0.299, 0.214),
            "Sparsh (MAE)": (0.783, 0.818, 0.691, 0.269),
            "Sparsh (DINO)": (0.685, 0.561, 0.548, 0.489),
            "Sparsh (IJEPA)": (0.776, 0.791, 0.775, 0.726),
            "Sparsh (VJEPA)": (0.820, 0.828, 0.800, 0.760),
        },
    },
    "pose": {
        "digit": {
            "E2E": (0.812, 0.245, 0.162, 0.162),
            "Sparsh (MAE)": (0.896, 0.719, 0.417, 0.223),
            "Sparsh (DINO)": (0.913, 0.834, 0.460, 0.242),
            "Sparsh (IJEPA)": (0.851, 0.601, 0.323, 0.212),
            "Sparsh (VJEPA)": (0.856, 0.648, 0.368, 0.228),
        },
    },
}
_MEASURES = {"force": "MAE, there called RMSE", "slip": "F1", "pose": "accuracy"}


@dataclass(frozen=True)
class Read:
    """What the first seed's probe put out for test frames: `outputs` of the frames `rows`."""

    task: Task
    frames: RigFrames
    encoder: str
    share: float
    test: str
    rows: Rows
    outputs: torch.Tensor


def table(rows: list[dict[str, Any]], sensor: str, config: TacbenchOptions) -> str:
    """As people read it."""
    lines = [
        f"TacBench, simulated: {sensor}, {config.strokes} strokes of {', '.join(config.rig.indenters)}, "
        f"{config.seeds} training seed{'s' * (config.seeds > 1)}; [95 % over test strokes]"
    ]
    if force := [row for row in rows if row["task"] == "force"]:
        lines += ["", *_force_lines(force), *_paper("force", sensor.removesuffix("_markers"), 0)]
    if slip := [row for row in rows if row["task"] == "slip"]:
        lines += ["", *_slip_lines(slip), *_paper("slip", "digit", 3)]
    if pose := [row for row in rows if row["task"] == "pose"]:
        lines += ["", *_pose_lines(pose), *_paper("pose", "digit", 3)]
    return "\n".join(lines)


def _force_lines(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "T1, force on the pad, mN: root mean square error by axis and of all, mean absolute error",
        f"{'encoder':<36}{'tested on':<20}{'labels':>7}{'x':>6}{'y':>6}{'z':>6}{'RMSE':>7}{'':>14}"
        f"{'MAE':>7}",
    ]
    for row in rows:
        x, y, z = row["rmse_mn_by_axis"]
        low, high = row["rmse_mn_interval"]
        least, most = row["mae_mn_interval"]
        lines.append(
            f"{row['encoder']:<36}{row['test']:<20}{row['samples']:>7}{x:>6.0f}{y:>6.0f}{z:>6.0f}"
            f"{row['rmse_mn']:>7.0f}{f'[{low:.0f}, {high:.0f}]':>14}"
            f"{row['mae_mn']:>7.0f} [{least:.0f}, {most:.0f}]"
        )
    return lines


def _slip_lines(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "T2, whether the sphere slips: F1; mean absolute error of the change of force, mN",
        f"{'encoder':<36}{'labels':>7}{'F1':>7}{'':>15}{'change':>8}",
    ]
    for row in rows:
        low, high = row["f1_interval"]
        change = f"{row['change_mae_mn']:.0f}" if "change_mae_mn" in row else ""
        lines.append(
            f"{row['encoder']:<36}{row['samples']:>7}{row['f1']:>7.3f}"
            f"{f'[{low:.2f}, {high:.2f}]':>15}{change:>8}"
        )
    return lines


def _pose_lines(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        f"T3, change of the pose of a bar and a can in {CLASSES} classes: accuracy; within one class",
        f"{'encoder':<36}{'labels':>7}{'x':>7}{'y':>7}{'turn':>7}{'all':>7}{'':>15}{'within':>8}",
    ]
    for row in rows:
        low, high = row["accuracy_interval"]
        x, y, turn = row["accuracy_by_axis"]
        lines.append(
            f"{row['encoder']:<36}{row['samples']:>7}{x:>7.3f}{y:>7.3f}{turn:>7.3f}"
            f"{row['accuracy']:>7.3f}{f'[{low:.2f}, {high:.2f}]':>15}{row['within_one_class']:>8.3f}"
        )
    return lines


def _paper(task: str, sensor: str, digits: int) -> list[str]:
    """The published rows, measured on a real sensor."""
    published = PAPER[task].get(sensor)
    if published is None:
        return []
    shares = "".join(f"{f'{share:.2g}':>8}" for share in _SHARES)
    name = f"paper, real {sensor}, share of labels"
    return [f"{f'{name} ({_MEASURES[task]})':<66}{shares}"] + [
        f"{f'  {encoder}':<66}{''.join(f'{value:>8.{digits}f}' for value in values)}"
        for encoder, values in published.items()
    ]


def draw(reads: list[Read]) -> UInt8[np.ndarray, "h w 3"]:
    """Of the first encoder and share: force against truth, friction cone, slip over time, confusion."""
    chosen = {
        type(r.task): r
        for r in reversed(reads)
        if (r.encoder, r.share) == (reads[0].encoder, reads[0].share)
    }
    figure = Figure(figsize=(16, 3.6 * len(chosen)), dpi=90, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(len(chosen), 4, squeeze=False)
    for line, one in zip(axes, reversed(chosen.values()), strict=True):
        if isinstance(one.task, ForceTask):
            _draw_force(line, one, one.task)
        elif isinstance(one.task, SlipTask):
            _draw_slip(line, one, one.task)
        elif isinstance(one.task, PoseTask):
            _draw_pose(line, one, one.task)
    figure.suptitle(f"{reads[0].encoder}, {reads[0].share:.2g} of the labels")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_force(axes: np.ndarray, one: Read, task: ForceTask) -> None:
    truth, said = one.frames.force[one.rows].numpy(), task.read(one.outputs).numpy()
    for k, axis in enumerate(axes[:3]):
        ends = [min(truth[:, k].min(), said[:, k].min()), max(truth[:, k].max(), said[:, k].max())]
        axis.plot(ends, ends, color="0.6", linewidth=1)
        axis.scatter(truth[:, k], said[:, k], s=3, alpha=0.4)
        axis.set(xlabel=f"true force {_AXES[k]} (N)", ylabel="predicted (N)", title=one.test)
    _draw_cone(axes[3], truth, np.linalg.norm(said - truth, axis=1))


def _draw_cone(axis: Axes, truth: np.ndarray, error: np.ndarray) -> None:
    """Shear over normal force of every test frame, coloured by the error, as Sparsh's Figures 7 and 8."""
    most = truth[:, 2].max()
    for side in (-1, 1):
        axis.plot([0, side * FRICTION * most], [0, most], color="0.6", linewidth=1)
    points = axis.scatter(truth[:, 0], truth[:, 2], s=3, c=1e3 * error, cmap="viridis")
    axis.figure.colorbar(points, ax=axis, label="error (mN)")
    axis.set(xlabel="shear x (N)", ylabel="normal force (N)", title="nominal friction cone")


def _draw_slip(axes: np.ndarray, one: Read, task: SlipTask) -> None:
    """Four test strokes with slip, as Sparsh's Figure 11."""
    stroke, truth = one.frames.stroke[one.rows.numpy()], task.truth(one.rows)
    likely = torch.sigmoid(one.outputs[:, 0]).numpy()
    slipping = [s for s in np.unique(stroke) if truth[stroke == s].any()]
    for axis, number in zip(axes, slipping, strict=False):
        own = stroke == number
        force = one.frames.force[one.rows][torch.from_numpy(own)].numpy()
        axis.fill_between(
            np.arange(own.sum()), truth[own].astype(float), step="mid", alpha=0.25, label="slips"
        )
        axis.plot(likely[own], label="probe says")
        ratio = np.hypot(force[:, 0], force[:, 1]) / np.maximum(force[:, 2], 1e-9)
        axis.plot(ratio, color="0.5", label="shear over normal force")
        axis.axhline(FRICTION, color="0.5", linewidth=0.7, linestyle=":")
        axis.set(xlabel="frames since touch", ylim=(-0.05, 1.05), title=f"test stroke {number}")
    if slipping:
        axes[0].legend(fontsize=7)


def _draw_pose(axes: np.ndarray, one: Read, task: PoseTask) -> None:
    """Confusion matrices, as Sparsh's Figure 13."""
    truth, said = task.classes[one.rows].numpy(), task.read(one.outputs).numpy()
    for k, (axis, name) in enumerate(zip(axes, ("x", "y", "turn"), strict=False)):
        counts = np.zeros((CLASSES, CLASSES))
        np.add.at(counts, (truth[:, k], said[:, k]), 1)
        shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
        image = axis.imshow(shares, vmin=0, vmax=1, cmap="viridis")
        axis.set(xlabel="predicted class", ylabel="true class", title=f"change of {name}")
        axis.figure.colorbar(image, ax=axis)
    axes[3].axis("off")
