"""TacBench's tasks by name, each with its kind of recordings."""

from collections.abc import Callable
from typing import Literal

from touchgoal.benchmarks.papers.tacbench.data import RigFrames
from touchgoal.benchmarks.papers.tacbench.field import FieldTask
from touchgoal.benchmarks.papers.tacbench.force import ForceTask
from touchgoal.benchmarks.papers.tacbench.labels import grasp_task, textile_task
from touchgoal.benchmarks.papers.tacbench.pose import PoseTask
from touchgoal.benchmarks.papers.tacbench.slip import SlipTask
from touchgoal.benchmarks.papers.tacbench.task import Task

Recording = Literal["strokes", "slides", "grasps", "cloths"]

TASKS: dict[str, Callable[[RigFrames], Task]] = {
    "force": ForceTask,
    "field": FieldTask,
    "slip": SlipTask,
    "pose": PoseTask,
    "grasp": grasp_task,
    "textile": textile_task,
}
RECORDED_AS: dict[str, Recording] = {
    "force": "strokes",
    "field": "strokes",
    "slip": "strokes",
    "pose": "slides",
    "grasp": "grasps",
    "textile": "cloths",
}
