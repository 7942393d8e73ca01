"""Policies on disk, checked against the task, the sensor and the rate that they act at.

From Python::

    policy = load_policy("pick-place")
    env = make_env(policy.env_config())
    observation, info = env.reset(seed=0)
    policy.reset()
    action = policy.act(observation)
"""

from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from jaxtyping import Float32

from touchgoal.control import features as ft
from touchgoal.control.features import Observation
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.policies.acting import Planner, PolicyActor
from touchgoal.policies.config import SamplerConfig
from touchgoal.policies.heads.diffusion import DiffusionConfig, RegressionConfig
from touchgoal.policies.heads.unet import UNetConfig
from touchgoal.policies.perception.end_to_end import EndToEndConfig
from touchgoal.policies.perception.frozen_touch import TouchEmbedder, load_touch_of
from touchgoal.policies.perception.state_estimation import StateEstimator, load_estimator
from touchgoal.policies.policy import Policy, PolicyConfig
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.cell.environment import FrankaTactileEnv
from touchgoal.sim_envs.config import TASKS, EnvConfig, TaskConfig, TaskName
from touchgoal.sim_envs.tasks import task_name

TOUCH, ESTIMATOR = "touch", "estimator"  # folders beside a policy's weights
_WEIGHTS = Path(__file__).parent / "weights"
SHIPPED_POLICIES = {"pick-place": _WEIGHTS / "pick_place", "bead-maze": _WEIGHTS / "bead_maze"}
"""The shipped policies: each is named after its task."""
Task = TypeVar("Task", bound=EnvConfig)
POLICY_FORMAT = WeightsFormat("policy", "policy", "train one with: touchgoal train-policy")


def save(policy: Policy, directory: Path, provenance: dict[str, Any]) -> None:
    """Writes a policy; an older one in the directory is replaced.

    Weights are stored as float16, scales as float32: rounding a joint position to float16 would
    move the hand by a millimetre.

    Args:
        policy: what to keep.
        directory: made if needed.
        provenance: JSON-able: data, command, seed, metrics of the training.
    """
    weights = {name: tensor.detach().cpu() for name, tensor in policy.state_dict().items()}
    for name, _ in policy.named_parameters():
        weights[name] = weights[name].half()
    POLICY_FORMAT.save(directory, weights, asdict(policy.config), provenance)


def load(directory: Path, control_hz: int | None = None) -> Policy:
    """Reads a policy for acting, as float32 on the CPU.

    Args:
        directory: what `save` wrote.
        control_hz: ticks per second it will act at, if that matters here.

    Raises:
        UserError: nothing there, damaged, or made for another rate.
    """
    config = POLICY_FORMAT.read_config(directory, _config)
    if control_hz is not None and control_hz != config.control_hz:
        raise UserError(
            f"the policy in {directory} acts at {config.control_hz} Hz, not {control_hz}: run it "
            f"at its own rate, or {POLICY_FORMAT.remedy}"
        )
    policy = Policy(config)
    POLICY_FORMAT.load_weights(policy, directory)
    return policy


@dataclass(frozen=True)
class SavedPolicy:
    """Makes actors of a policy on disk, in any process.

    Attributes:
        directory: of the policy, with its touch encoder in `touch/`, its state estimator in
            `estimator/`.
        plan_ticks: see `PolicyActor`.
    """

    directory: Path
    plan_ticks: int = 0

    def __call__(self, env: FrankaTactileEnv | None = None) -> PolicyActor:
        """An actor for one episode, on one core; its plans come as late as the environment says."""
        torch.set_num_threads(1)  # two lose badly when the other core is taken
        return PolicyActor(self.planner(), max(self.plan_ticks, env.plan_ticks if env else 0))

    def planner(self) -> Planner:
        """What makes its plans in one episode."""
        policy = load(self.directory)
        return Planner(policy, self.touch(policy.config), self._estimator(policy.config))

    def check_task(self, task: EnvConfig) -> "SavedPolicy":
        """Itself; UserError if the policy cannot act in the task: before anything is simulated."""
        self.planner_for(task)
        return self

    def planner_for(self, task: Task) -> tuple[Planner, Task]:
        """A planner, and the task's config as `env_config` gives it; everything is loaded once.

        Raises:
            UserError: the policy cannot act in the task.
        """
        policy = load(self.directory, control_hz=task.control_hz)
        config, name = policy.config, task_name(task)
        if config.task and config.task != name:
            raise UserError(
                f"the policy in {self.directory} was trained for {config.task}, not for {name}: add "
                f"--task {config.task}, or choose another policy"
            )
        touch, estimator = self.touch(config), self._estimator(config)
        sensor = find_sensor(task.sensor).name
        trained = {config.sensor, touch and touch.sensor, estimator and estimator.touch.sensor}
        for other in trained - {"", None, sensor}:
            raise UserError(
                f"the policy in {self.directory} was trained with the sensor {other}, the task has "
                f"{sensor}: choose {other} (--env.sensor {other}), or another policy"
            )
        planner = Planner(policy, touch, estimator)
        latest = max(task.resolved_deployment().plan_ticks or (0,))
        PolicyActor(planner, max(self.plan_ticks, latest))  # refuses plans that are too short
        return planner, _observed(task, config, estimator)

    def env_config(self, task: Task) -> Task:
        """The task's config with the pictures that the policy looks at, and no others."""
        config = load(self.directory).config
        return _observed(task, config, self._estimator(config))

    def touch(self, config: PolicyConfig) -> TouchEmbedder | None:
        """What it feels with; None if it does not feel."""
        return load_touch_of(self.directory / TOUCH, config.touch) if config.touch_dim else None

    def _estimator(self, config: PolicyConfig) -> StateEstimator | None:
        return load_estimator(self.directory / ESTIMATOR) if config.estimated else None


def _observed(task: Task, config: PolicyConfig, estimator: StateEstimator | None) -> Task:
    """The task's config with the pictures that a policy looks at, and no others."""
    keys = estimator.cameras if estimator else ()
    needs_touch = config.touch_dim > 0 or config.end_to_end is not None or estimator is not None
    cameras = tuple(key.removeprefix(ft.IMAGE_PREFIX) for key in keys)
    task = replace(task, tactile=needs_touch, cameras=cameras)
    return replace(task, camera_size=estimator.camera_size) if estimator else task


class LoadedPolicy:
    """A policy that acts, one episode after the other; `load_policy` makes it.

    Attributes:
        saved: the policy on disk.
        config: what it sees and does.
    """

    def __init__(self, saved: SavedPolicy) -> None:
        """Ready for an episode."""
        self.saved = saved
        self._planner = saved.planner()
        self.config = self._planner.config
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Begin an episode: the next observation is its first one, with nothing touched yet.

        Args:
            seed: of the plans' noise.
        """
        self._planner.reset(seed)
        self._actor = PolicyActor(self._planner, self.saved.plan_ticks)

    def act(self, observation: Observation) -> Float32[np.ndarray, "8"]:
        """The action (`features.ACTION`) for the next tick."""
        return self._actor.act(observation)

    def env_config(self, config: TaskConfig | None = None) -> TaskConfig:
        """Options of an environment that shows the policy what it looks at.

        Args:
            config: the options otherwise; default: those of its task, with its sensor.

        Raises:
            UserError: the policy cannot act there.
        """
        if config is None:
            if not self.config.task:
                raise UserError(f"{self.saved.directory} does not say its task: give a config")
            config = TASKS[cast(TaskName, self.config.task)](control_hz=self.config.control_hz)
            if self.config.sensor:
                config = replace(config, sensor=self.config.sensor)
        return self.saved.check_task(config).env_config(config)


def load_policy(name_or_path: str | Path, plan_ticks: int = 0) -> LoadedPolicy:
    """A policy to act with.

    Args:
        name_or_path: name of a shipped policy ("pick-place", "bead-maze"), or a folder that
            train-policy made.
        plan_ticks: ticks that its plans come late, see `PolicyActor`.

    Raises:
        UserError: no such policy, or it is damaged.
    """
    return LoadedPolicy(SavedPolicy(find_policy(name_or_path), plan_ticks))


def find_policy(name_or_path: str | Path) -> Path:
    """Folder of a shipped policy, by its name, or of one on disk; UserError if there is none."""
    if str(name_or_path) in SHIPPED_POLICIES:
        return SHIPPED_POLICIES[str(name_or_path)]
    for folder in (Path(name_or_path), Path(name_or_path) / "policy"):  # train-policy's --out, too
        if POLICY_FORMAT.weights_path(folder).is_file():
            return folder
    raise UserError(f"there is no policy {str(name_or_path)!r}: {suggestion(str(name_or_path))}")


def suggestion(name: str, names: tuple[str, ...] = tuple(SHIPPED_POLICIES)) -> str:
    """The end of a message about an unknown policy: what was meant perhaps, and what there is."""
    close = get_close_matches(name, names, 1)
    guess = f"did you mean {close[0]}? " if close else ""
    return f"{guess}choose from {', '.join(names)}, or name a folder that train-policy made"


def _config(fields: dict[str, Any]) -> PolicyConfig:
    if fields.get("representation") == "chunk":  # in older policies
        fields["representation"] = "relative"
    if older := fields.pop("touch_reading", None):
        fields["touch_input"] = "embedding" if older == "free" else older
    head = fields.pop("head")
    if end_to_end := fields.pop("end_to_end", None):
        fields["end_to_end"] = EndToEndConfig(**end_to_end | {"size": tuple(end_to_end["size"])})
    for key in ("proprioception", "gripper_widths"):
        fields[key] = tuple(fields.get(key, ()))
    return PolicyConfig(**fields, head=_read_head(head))


def _read_head(fields: dict[str, Any]) -> DiffusionConfig | RegressionConfig:
    if "unet" not in fields:
        return RegressionConfig(**fields)
    unet = fields["unet"] | {"channels": tuple(fields["unet"]["channels"])}
    return DiffusionConfig(UNetConfig(**unet), SamplerConfig(**fields["sampler"]))
