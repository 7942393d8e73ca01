"""Options of every benchmark; light to import, for `touchgoal benchmark --help` shows them all."""

import os
from dataclasses import field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from touchgoal.control import features as ft
from touchgoal.runtime import seeds
from touchgoal.runtime.option_types import (
    RARE,
    Corners,
    Count,
    CountOrNone,
    NotNegative,
    Positive,
    Seed,
    checked_dataclass,
)
from touchgoal.sim_envs.config import BeadMazeConfig, RigConfig, TaskName

CORES = os.cpu_count() or 1
SparshShape = Literal["mae-tiny", "mae-small", "mae-base", "dino-base", "ijepa-base", "vjepa-base"]
Share = Annotated[float, Field(gt=0, le=1)]


@checked_dataclass
class BenchmarkOptions:
    """Options of every benchmark."""

    out: Path | None = None
    """Folder of the run; default: runs/<date>_benchmark-<name>."""
    save_result: bool = False
    """Also write the numbers to benchmarks/results/<name>.json of this checkout, to be committed."""


@checked_dataclass
class BeadMazeOptions(BenchmarkOptions):
    """Does touch lead a bead along a wire never seen (TacBench T5, Sparsh Table 10)?"""

    policies: tuple[Path, ...] = ()
    """Folders of policies that train-policy made; those of one recipe count as training seeds of it.
    Default: the shipped one."""
    wires: Count = 100
    """Number of test wires, of the families trained on."""
    held_out: CountOrNone = 20
    """Number of test wires of the family held out; 0 leaves it out."""
    demonstrations: Annotated[int, Field(ge=2)] = 20
    """Number of test wires on which open-loop errors are measured."""
    plan_ticks: tuple[CountOrNone, ...] = (1, 2)
    """Control ticks by which plans come late, tried besides 0 on the first policy."""
    shuffled: bool = True
    """Try every policy with frozen touch also with what was felt on another wire."""
    env: BeadMazeConfig = BeadMazeConfig(split="test")
    """Options of the maze, e.g. a disturbance; demonstrations are recorded with the same."""
    workers: Count = CORES
    """Processes that simulate."""


@checked_dataclass
class DeployOptions(BenchmarkOptions):
    """How often does what is deployed succeed, through the arm and in the environment?"""

    tasks: tuple[TaskName, ...] = ("pick-place", "bead-maze")
    """Which tasks."""
    policies: tuple[str, ...] = ("scripted", "shipped")
    """Which policies, named as for deploy; scripted: of each task its own, the expert or the follower."""
    arms: tuple[Literal["environment", "in-process", "lock-step", "real-time"], ...] = (
        "environment",
        "in-process",
        "lock-step",
        "real-time",
    )
    """Through what: the task's environment; an arm in this program, from an example cell file; a fresh
    twin over libfranka by the cell file that it writes, whose time waits for the client, or does not."""
    episodes: Count = 10
    """Number of episodes of each row."""
    in_a_row: CountOrNone = 0
    """In place of all that: so many deployments on one twin of each task, in turn."""
    seconds: Positive = 40.0
    """After which a deployment ends."""
    seed: Seed = seeds.DEPLOY_TEST.start
    """Random seed of the first episode; each further one adds one."""
    workers: Count = CORES
    """Deployments side by side, in process and in lock-step."""


@checked_dataclass
class EncoderSpeedOptions(BenchmarkOptions):
    """How fast do encoders embed on one core (Sparsh, Table 3), and how fast is one trained?"""

    encoders: tuple[str, ...] = ("gelsight_mini", "gelsight_mini_surfaces")
    """Touch encoders by name or folder, or published Sparsh ones by file or id."""
    shapes: tuple[SparshShape, ...] = (
        "mae-tiny",
        "mae-small",
        "mae-base",
        "dino-base",
        "ijepa-base",
        "vjepa-base",
    )
    """Sparsh's networks with random weights, base as published, tiny and small narrower."""
    precisions: Annotated[tuple[Literal["fp32", "bf16"], ...], Field(min_length=1)] = (
        "fp32",
        "bf16",
    )
    """Numbers in which networks compute."""
    batch_size: Count = 8
    """Frames in a batch."""
    repeats: Count = 5
    """Measurements of each figure; the median is printed."""
    ticks: Annotated[Count, RARE] = 5
    """Single frames in each of them."""
    mae_vit: Annotated[Literal["tiny", "compact", "small"], RARE] = "small"
    """Size of the MAE whose training step is timed."""
    mae_batch_size: Annotated[Count, RARE] = 64
    """Touches in a training step."""
    mae_steps: Annotated[Count, RARE] = 4
    """Training steps in each measurement."""


@checked_dataclass
class EnvSpeedOptions(BenchmarkOptions):
    """How fast does the simulated cell run on one core?"""

    repeats: Count = 7
    """Measurements of each figure; the median is printed."""
    physics_steps: Count = 5000
    """Steps of the physics in one measurement."""
    env_steps: Count = 40
    """Control ticks of the environment in one measurement."""


@checked_dataclass
class FaultsOptions(BenchmarkOptions):
    """Does a deployment survive every fault, on the twin through the makers' client libraries?"""

    faults: tuple[str, ...] = ()
    """Names of faults to try, as the table has them; default: all."""
    lock_step: bool = True
    """Simulated time waits for the client: for a machine that is busy."""


@checked_dataclass
class MotionOptions(BenchmarkOptions):
    """How often is inverse kinematics solved, and how long do moves take beside ruckig's?"""

    poses: Count = 2000
    """Poses for each arm's inverse kinematics."""
    moves: Count = 200
    """Moves of each arm between random postures."""
    seed: Seed = 0
    """Random seed of poses and moves."""


@checked_dataclass
class ReplayOptions(BenchmarkOptions):
    """The same actions in the environment as deployed and over the wire: how far do the arms part?"""

    episodes: Count = 3
    """Waves in free air, and presses onto the table."""
    seed: Seed = seeds.REPLAY.start
    """Random seed of the first."""


@checked_dataclass
class SentStreamOptions(BenchmarkOptions):
    """Does what is sent to the arm stay inside the box and every limit, whatever a policy says?"""

    seconds: Positive = 3600.0
    """Simulated seconds of motion, over both arms, 20, 50 and 125 Hz; an hour takes about 8 minutes."""
    seed: Seed = 0
    """Random seed of what the policy wants."""


@checked_dataclass
class PolicyDelayOptions(BenchmarkOptions):
    """How often does a policy succeed when everything comes late?"""

    task: TaskName = "pick-place"
    """In which task; of the maze, on validation wires."""
    policy: str = "shipped"
    """Which policy, named as for run-policy."""
    causes: bool = False
    """Instead of the delays, an ablation: each effect of a deployment alone, then all but it."""
    delay: tuple[NotNegative, ...] = (0.0, 50.0, 100.0, 150.0)
    """Total delay from sensing to command, ms, half of it before the policy and half after; planning adds
    a tick."""
    jitter: tuple[NotNegative, ...] = (0.0, 50.0)
    """By how much each half may be longer, drawn tick by tick, ms."""
    rates: tuple[Positive, ...] = (30.0, 15.0)
    """Pictures a second, Hz."""
    episodes: Count = 20
    """Number of episodes of each row."""
    seed: Seed = seeds.POLICY_TEST.start
    """Random seed of the first episode; each further one adds one."""
    workers: Count = CORES
    """Processes that simulate."""


@checked_dataclass
class PolicyLatencyOptions(BenchmarkOptions):
    """How long does a plan take on one core, stage by stage?"""

    policy: Path | None = None
    """Folder of a policy that train-policy made; default: the shipped one of bead-maze."""
    repeats: Count = 200
    """Plans timed."""
    large_repeats: CountOrNone = 5
    """Runs of each network of a published size; 0 leaves them out."""
    control_hz: Count = ft.CONTROL_HZ
    """Control ticks per second; a plan should fit into one."""


@checked_dataclass
class RealTouchOptions(BenchmarkOptions):
    """What do encoders know of real touches: which thing, how hard, rough and bumpy?"""

    data: Path = field(kw_only=True)
    """Folder of labelled videos (labels.csv and videos/, as PhysiCLeAR's), of grasps with forces (grasps.csv and
    TRIAL.avi, TRIAL.csv, as EstimateModulus'), or of pictures of a gel with dots and where another tracker saw
    them (SERIES_NUMBER.png and .json, as gelsight-material-classifier's), which need no encoder."""
    encoders: tuple[str, ...] = ("gelsight_mini", "random:gelsight_mini", "pixels", "efficientnet")
    """Touch encoders by name or folder, or published Sparsh ones by file or id (facebook/sparsh-dino-base);
    `random:NAME` for the same network untrained, `pixels`, `efficientnet` (ImageNet), or a vision model of
    Hugging Face by its id or folder."""
    corners: Corners | None = None
    """Of grasps, corners of the gel in the pictures, x and y in px (top left, top right, bottom left, bottom
    right), where the camera sees it at an angle; not given: whole pictures."""
    every: Annotated[Count, RARE] = 1
    """Take every so many videos."""
    seed: Seed = 0
    """Random seed of untrained weights."""


@checked_dataclass
class RewardQualityOptions(BenchmarkOptions):
    """Do the MMWand paper's claims about dense costs hold (section V-E, Figures 8 and 9)?"""

    encoder: str = "gelsight_mini"
    """Touch encoder, by name or folder; the simulated sensor is the one that it was trained on."""
    episodes: Count = 20
    """Number of held-out episodes of each outcome."""
    workers: Count = CORES
    """Processes that simulate."""


TacbenchTask = Literal["force", "field", "slip", "pose", "grasp", "textile"]


@checked_dataclass
class TacbenchOptions(BenchmarkOptions):
    """What do encoders know of force, slip, pose, grasps and cloth (TacBench, Sparsh Tables 5 to 9 and 11), simulated?"""

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


@checked_dataclass
class TaskCeilingsOptions(BenchmarkOptions):
    """How hard do demonstrations press, and which force and touch ceilings follow?"""

    data: Path = field(kw_only=True)
    """Folder of episodes, of the expert or of a person who leads the arm; with fingertips' pictures for
    the ceiling of touch."""


@checked_dataclass
class TactileRealismOptions(BenchmarkOptions):
    """How close do simulated presses come to real ones that the fit has not seen?"""

    splits: Count = 5
    """Ways to part the presses into fitted and held-out ones; the median over them is printed."""
    sensors: tuple[Literal["gelsight", "gelsight_mini"], ...] = ("gelsight", "gelsight_mini")
    """Sensors whose presses are taken."""
    save_presses: Path | None = None
    """Also write the real presses into this folder, as `touchgoal calibrate` reads them."""


@checked_dataclass
class TactileSpeedOptions(BenchmarkOptions):
    """How fast does a simulated pad make its pictures on one core?"""

    repeats: Count = 7
    """Measurements of each figure; the median is printed."""
    frames: Count = 100
    """Frames in one measurement."""


@checked_dataclass
class TouchProbesOptions(BenchmarkOptions):
    """What do frozen features tell of force, place, shape and slip, on one sensor and across sensors?"""

    encoder: str = "gelsight_mini_surfaces"
    """Encoder whose network is probed: one of `train-encoder surfaces`, or one with a ViT, by name or folder; or a
    published Sparsh one by file or id."""
    sensors: tuple[str, ...] = ("gelsight_mini", "digit", "gelsight")
    """Sensors that are simulated, by name or folder of a sensor file."""
    presses: Annotated[int, Field(ge=24)] = 600
    """Presses simulated on each."""
    real_balls: tuple[Path, ...] = ()
    """Folders of real presses of a ball, with background.png, to be read as well: one for the first of --sensors, one
    for the second and so on."""
    seed: Seed = 0
    """Random seed of units and presses."""
