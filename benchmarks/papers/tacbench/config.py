"""Options of `python -m benchmarks tacbench`."""

from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field

from benchmarks.options import CORES, BenchmarkOptions
from benchmarks.papers.tacbench_rig.config import RigConfig
from benchmarks.papers.tacbench_rig.recording import Recording
from touchgoal.runtime.option_types import RARE, Count, Positive, Seed, checked_dataclass

TacbenchTask = Literal["force", "field", "slip", "pose", "grasp", "textile"]
RECORDED_AS: dict[str, Recording] = {
    "force": "strokes",
    "field": "strokes",
    "slip": "strokes",
    "pose": "slides",
    "grasp": "grasps",
    "textile": "cloths",
}
Share = Annotated[float, Field(gt=0, le=1)]


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark tacbench."""

    tasks: Annotated[tuple[TacbenchTask, ...], Field(min_length=1)] = get_args(TacbenchTask)
    """Tasks: force (T1), field (T1A, forces over the pad), slip (T2), pose (T3, change of a held
    object's pose), grasp (T4, success of a grasp), textile (T6)."""
    encoders: Annotated[tuple[str, ...], Field(min_length=1)] = (
        "gelsight_mini_markers_mae",
        "gelsight_mini_markers",
        "random:gelsight_mini_markers_mae",
        "end-to-end:compact",
    )
    """Touch encoders with a ViT, frozen: a name, a folder, or a published Sparsh file or id. `random:NAME`
    has random weights; `end-to-end:NAME`, or a preset's name there, is trained with the probe."""
    shares: Annotated[tuple[Share, ...], Field(min_length=1)] = (1.0, 0.33, 0.1, 0.01)
    """Shares of the training labels."""
    rig: RigConfig = RigConfig()
    """Sensor and loads of the simulated bench."""
    strokes: Annotated[int, Field(ge=15)] = 180
    """Presses and slides to simulate for T1 and T2: of five, three train, one validates, one tests."""
    slides: Annotated[int, Field(ge=10)] = 60
    """Slides of held objects to simulate for T3."""
    grasps: Annotated[int, Field(ge=10)] = 400
    """Grasps to simulate for T4, of 20 objects in turn."""
    cloths: Annotated[int, Field(ge=10)] = 600
    """Presses of 20 cloths in turn to simulate for T6."""
    data: Path | None = None
    """Folder of the recordings; missing ones are made. Default: runs/tacbench_<sensor>_<seed>."""
    seeds: Count = 3
    """Training seeds of each row: labels drawn, initial weights, order."""
    seed: Seed = 0
    """First training seed."""
    steps: Annotated[Count, RARE] = 400
    """Updates of a probe on a frozen encoder."""
    end_to_end_steps: Annotated[Count, RARE] = 100
    """Updates of an encoder trained with its probe."""
    batch_size: Annotated[Count, RARE] = 32
    """Pairs of frames in an update of a probe."""
    end_to_end_batch_size: Annotated[Count, RARE] = 16
    """Pairs of frames in an update of an encoder trained with its probe."""
    lr: Annotated[Positive, RARE] = 1e-3
    """Peak learning rate of a probe."""
    end_to_end_lr: Annotated[Positive, RARE] = 5e-4
    """Peak learning rate of an encoder trained with its probe."""
    workers: Count = CORES
    """Processes that simulate and train."""
