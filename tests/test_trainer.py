"""The one training loop: what decays, what is written, precision, and several processes."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate import tracking
from torch import nn

from touchgoal.encoders.ssl.train import train_unlabelled
from touchgoal.encoders.training import trainer
from touchgoal.encoders.training.options import TrainerOptions
from touchgoal.encoders.training.trackers import Trackers
from touchgoal.encoders.training.trainer import OptimizerConfig, Training, fit
from touchgoal.launch import train_encoder
from touchgoal.policies.config import TrainConfig
from touchgoal.policies.heads.mlp import MLPConfig
from touchgoal.policies.training.train import train
from touchgoal.runtime.errors import UserError

FRESH = TrainerOptions()
OPTIMIZER = OptimizerConfig(epochs=2, batch_size=4, lr=1e-2, weight_decay=0.0)


class Line(nn.Module):
    """Fits a line."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(3, 1)

    def forward(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"loss": (self.linear(x)[:, 0] - x.sum(1)).square().mean()}


def line() -> Training:
    torch.manual_seed(0)
    data = torch.randn(8, 3)
    return Training(Line(), 8, lambda rows, _: {"x": data[rows]}, OPTIMIZER, {"data": "line"})


def test_tensorboard_lies_beside_the_metrics_and_resuming_is_recorded(tmp_path: Path) -> None:
    fit(line(), tmp_path, TrainerOptions(), {"command": "train"})
    assert (tmp_path / "metrics.jsonl").read_text().count("\n") == 2
    (events,) = tmp_path.glob("events.out.tfevents.*")
    assert b"loss" in events.read_bytes()
    go_on = TrainerOptions(resume=True)
    fit(line(), tmp_path, go_on, {"command": "go on"})
    history, provenance = fit(line(), tmp_path, go_on, {"command": "go on"})
    assert len(history) == 2 and provenance["command"] == "train"
    assert [resumed["command"] for resumed in provenance["resumed"]] == ["go on"]


def test_a_tracker_that_is_not_there_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match="did you mean tensorboard"):
        Trackers(["tensorbord"], tmp_path, {}, "cpu")
    monkeypatch.setattr(tracking, "get_available_trackers", list)
    with pytest.raises(UserError, match="pip install wandb"):
        fit(line(), tmp_path / "run", TrainerOptions(log_with=("wandb",)), {})


def test_bfloat16_computes_in_it_and_keeps_float32(tmp_path: Path) -> None:
    training, seen = line(), []
    assert isinstance(training.loss, Line)
    training.loss.linear.register_forward_hook(lambda *args: seen.append(args[2].dtype))
    fit(training, tmp_path, TrainerOptions(precision="bf16"), {})
    assert set(seen) == {torch.bfloat16}
    assert {p.dtype for p in training.loss.parameters()} == {torch.float32}
    with pytest.raises(UserError, match="precision was bf16, is no"):
        fit(line(), tmp_path, TrainerOptions(resume=True), {})


WORKER = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import test_trainer
test_trainer.train_everything(Path(sys.argv[1]), sys.argv[2])
"""


def trainings(
    options: TrainerOptions = FRESH, seed: int = 0
) -> dict[str, Callable[[Path], object]]:
    """Every trainer at toy size, two epochs of a few steps each, given a folder."""
    import test_align
    import test_self_supervision
    import test_state_estimation
    import toy_policies
    from toy_touches import moving_blobs

    short = {"epochs": 2, "lr": 0.1, "batch_size": 8}
    unlabelled = {
        "mae": (test_self_supervision.blobs(16, seed), test_self_supervision.MAE),
        "dino": (moving_blobs(16, seed), replace(test_self_supervision.DINO, batch_norm=True)),
        "ijepa": (moving_blobs(16, seed), test_self_supervision.IJEPA),
        "vjepa": (moving_blobs(16, seed, frames=4), test_self_supervision.VJEPA),
    }

    def without_labels(name: str, out: Path) -> None:
        touch, config = unlabelled[name]
        train_unlabelled(touch, touch, replace(config, **short), out, options, {})

    def policy(head: Any, out: Path) -> None:
        config = replace(toy_policies.TOY, head=head)
        windows = toy_policies.toy_dataset(config, seed=seed)
        train(config, windows, windows, TrainConfig(epochs=2, batch_size=8), out, options, {})

    align = replace(test_align.CONFIG, epochs=2, lr=0.1)
    touches = test_align.make_touches(12, seed), test_align.VAL
    return {
        **{name: partial(without_labels, name) for name in unlabelled},
        "align": lambda out: test_align.run_align(*touches, align, out, options),
        "diffusion": partial(policy, toy_policies.DIFFUSION),
        "flow": partial(policy, toy_policies.FLOW),
        "regression": partial(policy, MLPConfig(width=16)),
        "pose": lambda out: test_state_estimation.train_pose(64 + seed, 2, out, options),
    }


def test_fits_in_closed_form_refuse_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(UserError, match="surfaces runs in one process"):
        train_encoder.main(train_encoder.Surfaces())


TRAINERS = "mae dino ijepa vjepa align diffusion flow regression pose".split()


@pytest.mark.parametrize("name", TRAINERS)
def test_a_killed_training_ends_with_the_same_weights(name: str, tmp_path: Path) -> None:
    train_epoch: Callable = trainer._train_epoch

    def killed(*arguments: Any) -> object:
        if arguments[-1] == 1:
            raise KeyboardInterrupt
        return train_epoch(*arguments)

    trainings()[name](tmp_path / "whole")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(trainer, "_train_epoch", killed)
        trainings()[name](tmp_path / "killed")
    go_on = TrainerOptions(resume=True)
    with pytest.raises(UserError, match=r"of another data set.*\(data"):
        trainings(go_on, seed=1)[name](tmp_path / "killed")
    trainings(go_on)[name](tmp_path / "killed")
    folders = [tmp_path / "whole", tmp_path / "killed"]
    whole, resumed = (torch.load(f / "checkpoint.pt", weights_only=True)["model"] for f in folders)
    assert all(torch.equal(weight, resumed[key]) for key, weight in whole.items())
    lines = [(folder / "metrics.jsonl").read_text() for folder in folders]
    assert lines[0] == lines[1]


def train_everything(out: Path, device: str = "cpu") -> None:
    """Train by plain SGD: Adam would hide gradients that are twice too large."""

    def build(self: OptimizerConfig, module: nn.Module) -> torch.optim.Optimizer:
        return torch.optim.SGD(module.parameters(), self.lr)

    torch.backends.cudnn.allow_tf32 = False  # on a GPU: no coarser than a CPU
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OptimizerConfig, "build", build)
        for name, run in trainings(TrainerOptions(device=device)).items():
            torch.manual_seed(0)
            run(out / name)


def train_apart(folder: Path, launcher: str, device: str) -> Path:
    """Return the folder of runs of every trainer in a process of their own, or in several."""
    script, tests = folder / "worker.py", Path(__file__).parent
    script.write_text(WORKER.format(tests=str(tests)))
    done = subprocess.run(
        [sys.executable, *launcher.split(), str(script), str(folder / "runs"), device],
        env={
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "PYTHONFAULTHANDLER": "1",
            "PYTHONWARNINGS": "error::FutureWarning",
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert done.returncode == 0, done.stdout.decode()[-9000:]
    return folder / "runs"


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("one")
    train_everything(folder)
    return folder


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torchrun = "-W error::FutureWarning -m torch.distributed.run --standalone --nproc-per-node=2"
    return train_apart(tmp_path_factory.mktemp("two"), torchrun, "cpu")


@pytest.fixture(scope="module")
def gpu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_apart(tmp_path_factory.mktemp("gpu"), "-W error::FutureWarning", "cuda")


def same_training(name: str, one: Path, other: Path, tolerance: float) -> None:
    a, b = (
        torch.load(run / name / "checkpoint.pt", map_location="cpu", weights_only=True)
        for run in (one, other)
    )
    for left, right in zip(a["history"], b["history"], strict=True):
        assert left["loss"] == pytest.approx(right["loss"], rel=tolerance)
    for key, weight in a["model"].items():
        torch.testing.assert_close(
            b["model"][key], weight, rtol=10 * tolerance, atol=tolerance, msg=f"{key}: {{}}".format
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINERS)
def test_two_processes_train_as_one(name: str, one_process: Path, two_processes: Path) -> None:
    same_training(name, one_process, two_processes, tolerance=1e-5)


@pytest.mark.gpu
@pytest.mark.parametrize("name", TRAINERS)
def test_a_gpu_trains_as_the_cpu(name: str, one_process: Path, gpu: Path) -> None:
    same_training(name, one_process, gpu, tolerance=1e-4)
