"""Options of `touchgoal benchmark tacbench`."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from touchgoal.benchmarks.options import CORES, BenchmarkOptions
from touchgoal.runtime.option_types import RARE, Count, Positive, Seed, checked_dataclass
from touchgoal.sim_envs.config import RigConfig

TacbenchTask = Literal["force", "field", "slip", "pose", "grasp", "textile"]
Share = Annotated[float, Field(gt=0, le=1)]


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark tacbench."""

    tasks: Annotated[tuple[TacbenchTask, ...], Field(min_length=1)] = (
        "force",
        "field",
        "slip",
        "pose",
        "grasp",
        "textile",
    )
    """T1, the force on the pad; T1A, the field of forces over it; T2, whether it slips; T3, how the pose of a held
    object changes; T4, whether a grasp will hold; T6, which cloth it is."""
    encoders: Annotated[tuple[str, ...], Field(min_length=1)] = (
        "gelsight_mini_markers_mae",
        "gelsight_mini_markers",
        "random:gelsight_mini_markers_mae",
        "end-to-end:compact",
    )
    """Touch encoders with a ViT, frozen, by name or folder, or published Sparsh ones by file or id
    (facebook/sparsh-dino-base); `random:NAME` for the same network untrained, `end-to-end:NAME` for the same one
    trained with the probe, from random weights; `end-to-end:PRESET` for a ViT of `train-encoder`'s presets."""
    shares: Annotated[tuple[Share, ...], Field(min_length=1)] = (1.0, 0.33, 0.1, 0.01)
    """Shares of the training labels."""
    rig: RigConfig = RigConfig()
    """The simulated bench's sensor and loads."""
    strokes: Annotated[int, Field(ge=15)] = 180
    """Presses and slides simulated, for T1 and T2; of every five of a probe three are for training, one for
    validation, one for the test."""
    slides: Annotated[int, Field(ge=10)] = 60
    """Slides of held objects simulated, for T3; used as the strokes are, and so are the others."""
    grasps: Annotated[int, Field(ge=10)] = 400
    """Grasp attempts simulated, of the catalogue's 20 objects in turn, for T4."""
    cloths: Annotated[int, Field(ge=10)] = 600
    """Presses of 20 cloths in turn simulated, for T6."""
    data: Path | None = None
    """Folder of the recordings: made there if it is new, gone on with if some are missing. Default:
    runs/tacbench_<sensor>_<seed>. Or a folder of published files: TacBench's force estimation (--tasks force
    slip) or pose estimation (pose), or Feeling of Success (grasp); about as many recordings are read
    as would be simulated."""
    seeds: Count = 3
    """Training seeds of each row: of labels drawn, initial weights and order."""
    seed: Seed = 0
    """The first of them."""
    steps: Annotated[Count, RARE] = 400
    """Updates of a probe on a frozen encoder."""
    end_to_end_steps: Annotated[Count, RARE] = 100
    """Updates of an encoder with its probe."""
    batch_size: Annotated[Count, RARE] = 32
    """Pairs of frames in each update of a probe."""
    end_to_end_batch_size: Annotated[Count, RARE] = 16
    """Pairs of frames in each update of an encoder with its probe."""
    lr: Annotated[Positive, RARE] = 1e-3
    """Highest learning rate of a probe."""
    end_to_end_lr: Annotated[Positive, RARE] = 5e-4
    """Highest learning rate of an encoder with its probe."""
    workers: Count = CORES
    """Processes that simulate and train."""
