"""touchgoal's reward in lerobot: `--reward_model.type=touchgoal`. It feels, and lerobot does not train it.

    python -m lerobot_reward_touchgoal --repo-id owner/set --root FOLDER

writes `touchgoal_progress.parquet` into the set, which lerobot's RA-BC reads.
"""

import argparse
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from huggingface_hub import snapshot_download
from lerobot.configs import NormalizationMode
from lerobot.configs.rewards import RewardModelConfig
from lerobot.datasets import LeRobotDataset
from lerobot.rewards.factory import make_reward_model
from lerobot.rewards.pretrained import PreTrainedRewardModel
from lerobot.utils.constants import OBS_PREFIX
from lerobot_policy_touchgoal import as_recorded, make_touchgoal_pre_post_processors
from torch import Tensor

from touchgoal.control.features import CONTROL_HZ
from touchgoal.episodes.schema import Episode
from touchgoal.rewards.curves import FUSED
from touchgoal.rewards.distance.normalizer import NORMALIZER, DistanceNormalizer
from touchgoal.rewards.goals import Inputs
from touchgoal.rewards.judging.judge import SHIPPED_JUDGE, find_judge
from touchgoal.rewards.online import CostMeter
from touchgoal.rewards.prepared_reward import PreparedReward
from touchgoal.rewards.reward import Reward

__all__ = ["TouchgoalConfig", "TouchgoalRewardModel", "make_touchgoal_pre_post_processors"]
_FILES = "judge.json", "goal.npz", NORMALIZER, "value.json", "value.safetensors"
_CARD = """---
library_name: lerobot
pipeline_tag: robotics
license: {license}
tags: [robotics, lerobot, reward-model, touchgoal, tactile]
---

A reward that sees and feels: the distance of a run from where successes end, in both cameras, both fingertips and
the forces, by [touchgoal](https://pypi.org/project/touchgoal). `pip install ./plugins` in a clone of it, then
`--reward_model.type=touchgoal --reward_model.pretrained_path=THIS`.
"""
PROGRESS, COLUMN = "touchgoal_progress.parquet", "progress_sparse"


@RewardModelConfig.register_subclass("touchgoal")
@dataclass
class TouchgoalConfig(RewardModelConfig):
    """Options of the reward."""

    judge: str = SHIPPED_JUDGE
    """Folder of `touchgoal fit-normalizer --judge`, or the name of an encoder that ships with one."""
    sensor: str = "gelsight_mini"
    """Fingertip sensor."""
    task: str = ""
    """Task in words, as in the episodes that the judge was fitted on; simulated ones need none."""
    object: str = ""
    """Object of the runs, which chooses among the goals; "" if unknown."""
    fps: float = CONTROL_HZ
    """Frames per second of what is measured."""
    device: str | None = "cpu"
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=dict)


class TouchgoalRewardModel(PreTrainedRewardModel):
    """Progress of runs, 1 - cost, from cameras, fingertips and forces."""

    config_class, name = TouchgoalConfig, "touchgoal"

    def __init__(self, config: TouchgoalConfig, **_: Any) -> None:
        super().__init__(config)
        self._folder = find_judge(config.judge)
        self._reward = Reward.of_judge(self._folder)
        self._prepared: PreparedReward | None = None
        self._runs: list[CostMeter] = []

    def reset(self) -> None:
        """Begin a run in every environment."""
        self._runs = []

    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Any]) -> Tensor:
        """Return the progress (b,) of each run at its newest frame, at most 1.

        Values (b, t, ...) hold whole runs, which start free of contact; values (b, ...) are the next
        tick of the runs that began with `reset`.
        """
        observed = {
            key: value
            for key, value in batch.items()
            if key.startswith(OBS_PREFIX) and isinstance(value, Tensor)
        }
        rows = [
            {key: as_recorded(key, value[i]) for key, value in observed.items()}
            for i in range(len(next(iter(observed.values()))))
        ]
        if any(value.ndim == 4 for value in rows[0].values()):
            return torch.tensor([self.progress(row)[-1] for row in rows])
        reward = self._prepare(rows[0])
        about = self.config.object, self.config.fps
        self._runs += [CostMeter(reward, *about) for _ in rows[len(self._runs) :]]
        found = []
        for run, tick in zip(self._runs, rows, strict=True):
            run.add(tick)
            reading = run.measure()
            assert reading is not None  # a tick was added
            found.append(1 - reading.cost)
        return torch.tensor(found)

    def progress(self, frames: dict[str, np.ndarray]) -> np.ndarray:
        """Return the progress (t,) along a run, whose frames are as touchgoal records them."""
        reward = self._prepare(frames)
        facts = {"object": self.config.object} if self.config.object else {}
        run = Episode(frames, self.config.task, facts)
        embedded = reward.embedder.embed_chunks([run], self.config.fps, "a run")
        return 1 - reward.curves(embedded).costs[FUSED]

    def _prepare(self, frames: dict[str, np.ndarray]) -> PreparedReward:
        if self._prepared is None:
            config = cast(TouchgoalConfig, self.config)
            scene = DistanceNormalizer.load(self._folder / NORMALIZER).scene
            about = {"sensor": config.sensor, "scene": scene, "task": config.task}
            self._prepared = self._reward.prepare(Inputs.of("the batch", frames, **about))
        return self._prepared

    def _save_pretrained(self, save_directory: Path) -> None:
        """Write the judge's files beside lerobot's config, and a card."""
        config = replace(cast(TouchgoalConfig, self.config), judge=".")
        config._save_pretrained(save_directory)
        for name in _FILES:
            if (self._folder / name).is_file():
                shutil.copy(self._folder / name, save_directory / name)
        (save_directory / "README.md").write_text(
            _CARD.format(license=config.license or "apache-2.0")
        )

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: Any = None, **kwargs: Any
    ) -> "TouchgoalRewardModel":
        """Read what `save_pretrained` or `push_to_hub` wrote, from a folder or a repository."""
        revision, folder = kwargs.pop("revision", None), Path(pretrained_name_or_path)
        if not folder.is_dir():
            folder = Path(snapshot_download(str(pretrained_name_or_path), revision=revision))
        config = config or RewardModelConfig.from_pretrained(folder)
        return cls(replace(config, judge=str(folder)))


def label(model: TouchgoalRewardModel, dataset: LeRobotDataset) -> Path:
    """Write the progress of every frame of a set beside it, as lerobot's RA-BC reads it."""
    columns: dict[str, list[Any]] = {
        "index": [],
        "episode_index": [],
        "frame_index": [],
        COLUMN: [],
    }
    for row in dataset.meta.episodes:
        first, last = int(row["dataset_from_index"]), int(row["dataset_to_index"])
        frames = [dataset[i] for i in range(first, last)]
        keys = [
            k for k, v in frames[0].items() if k.startswith(OBS_PREFIX) and isinstance(v, Tensor)
        ]
        run = {key: np.stack([as_recorded(key, frame[key]) for frame in frames]) for key in keys}
        columns["index"] += range(first, last)
        columns["episode_index"] += [int(row["episode_index"])] * (last - first)
        columns["frame_index"] += range(last - first)
        columns[COLUMN] += model.progress(run).tolist()
    out = Path(dataset.root) / PROGRESS
    pq.write_table(pa.table(columns), out)
    return out


def main() -> None:
    """Label a set."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repo-id", required=True, help="Name of a set on the Hugging Face Hub.")
    parser.add_argument("--root", type=Path, help="Folder of the set on this machine.")
    parser.add_argument("--judge", default=SHIPPED_JUDGE, help="See TouchgoalConfig.judge.")
    options = parser.parse_args()
    dataset = LeRobotDataset(options.repo_id, root=options.root)
    about = {"task": dataset[0]["task"], "fps": dataset.fps}
    model = make_reward_model(TouchgoalConfig(judge=options.judge, **about))
    print(label(model, dataset))


if __name__ == "__main__":
    main()
