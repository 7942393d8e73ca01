"""Policies on disk."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from touchgoal.encoders.towers.goal_sentence import check_goal_sentence
from touchgoal.encoders.training.weights import WeightsFormat
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.policies.config import POLICIES
from touchgoal.policies.network import PolicyConfig, PolicyNetwork
from touchgoal.policies.perception.frozen_touch import TouchEmbedder, load_touch_of
from touchgoal.policies.perception.pose_estimator import PoseEstimator
from touchgoal.policies.perception.state_estimation import StateEstimator, load_pose_estimator
from touchgoal.runtime.errors import UserError, unknown_name
from touchgoal.sim_envs.config import CameraPlacement

TOUCH, ESTIMATOR = "touch", "estimator"  # folders beside a policy's weights
EPISODE_OBJECT = "{object}"  # in a target: the object that the simulated episode asks for
_WEIGHTS = Path(__file__).parent / "weights"
SHIPPED_POLICIES = {
    "pick-place": _WEIGHTS / "pick_place",
    "bead-maze": _WEIGHTS / "bead_maze",
    "fragile-carry": _WEIGHTS / "fragile_carry",
}
"""The shipped policies: each is named after its task."""
POLICY_FORMAT = WeightsFormat("policy", "policy", "train one with: touchgoal train-policy")


def save(policy: PolicyNetwork, directory: Path, provenance: dict[str, Any]) -> None:
    """Write a network; an older one in the directory is replaced.

    Weights are stored as float16, normalizers as float32: rounding a joint position to float16
    would move the hand by a millimetre.

    Args:
        directory: made if needed.
        provenance: JSON-able: data, command, seed, metrics of the training.
    """
    POLICY_FORMAT.save_half(policy, directory, policy.config, provenance)


def load(directory: Path) -> PolicyNetwork:
    """Read a network for inference on the CPU; UserError if there is none or it is damaged."""
    with torch.random.fork_rng(devices=[]):  # its initialisation draws from the global generator
        network = PolicyNetwork(POLICY_FORMAT.read_config(directory, PolicyConfig))
    POLICY_FORMAT.load_weights(network, directory)
    return network


@dataclass(frozen=True)
class SavedPolicy:
    """Policy on disk; called with an environment, it returns the policy for one episode of it.

    Attributes:
        directory: of the policy, with its touch encoder in `touch/`, its pose estimator in
            `estimator/`.
        plan_ticks: control ticks by which its plans come late, see `LearnedPolicy`.
        front_camera: where a calibrated camera stands, see `StateEstimator`; in simulation the
            environment says it.
        target: the object to pick up, in words, with `EPISODE_OBJECT` for the name of that which the
            simulated episode asks for; "" if it is the only one.
    """

    directory: Path
    plan_ticks: int = 0
    target: str = ""
    front_camera: CameraPlacement | None = None

    def __call__(self, env: Any = None, network: PolicyNetwork | None = None) -> LearnedPolicy:
        """Return the policy, or another network in its place, at an episode's beginning.

        Its plans come as late as `env` says.
        """
        own, touch, pose_estimator = _load_parts(self.directory, _stamp(self.directory))
        target = self.target
        if env and EPISODE_OBJECT in target:
            target = target.replace(EPISODE_OBJECT, env.asked_name)
        camera = self.front_camera if env is None else env.calibrated_camera()
        estimator = StateEstimator(pose_estimator, target, camera) if pose_estimator else None
        plan_ticks = max(self.plan_ticks, env.plan_ticks if env else 0)
        return LearnedPolicy(network or own, touch, estimator, plan_ticks, self.directory)

    @property
    def is_estimated(self) -> bool:
        """Whether a pose estimator finds the object to pick up, which words may name."""
        return bool(self.network().config.estimated)

    def with_target(self, target: str | None) -> "SavedPolicy":
        """Return the policy with a target; UserError: it is empty or negated, or the policy takes none."""
        if target is None:
            return self
        if not target.strip():
            raise UserError(
                'the target is empty: name the object in words, such as "the red block"'
            )
        if not self.is_estimated:
            raise UserError(f"the policy in {self.directory} takes no target: leave it out")
        check_goal_sentence(target)
        return replace(self, target=target)

    def network(self) -> PolicyNetwork:
        """Return the network alone."""
        return _load_network(self.directory, _stamp(self.directory))


_Stamp = tuple[tuple[str, int, int], ...]


def _stamp(directory: Path) -> _Stamp:
    """Name, time and size of a policy's files, by which a cached policy is known to be current."""
    paths = sorted(directory.rglob("*.safetensors"))
    return tuple((str(p), p.stat().st_mtime_ns, p.stat().st_size) for p in paths)


@lru_cache(maxsize=4)
def _load_network(directory: Path, stamp: _Stamp) -> PolicyNetwork:
    return load(directory)


@lru_cache(maxsize=4)
def _load_parts(
    directory: Path, stamp: _Stamp
) -> tuple[PolicyNetwork, TouchEmbedder | None, PoseEstimator | None]:
    network = _load_network(directory, stamp)
    config = network.config
    with torch.random.fork_rng(devices=[]):
        touch = load_touch_of(directory / TOUCH, config.touch) if config.touch_dim else None
        pose_estimator = load_pose_estimator(directory / ESTIMATOR) if config.estimated else None
    return network, touch, pose_estimator


def load_policy(name_or_path: str | Path, target: str | None = None) -> LearnedPolicy:
    """Load a policy to act with.

    Args:
        name_or_path: name of a shipped policy, such as "bead-maze", or a folder that train-policy
            made.
        target: the object to pick up where several lie on the table, in words.

    Raises:
        UserError: no such policy, or it is damaged, or it takes no target.
    """
    return SavedPolicy(find_policy(name_or_path)).with_target(target)()


def find_policy(name_or_path: str | Path, task: str = "") -> Path:
    """Return the folder of a shipped policy or of one on disk; UserError if there is none.

    A command names its `task`: then "shipped" is that task's, and the message lists what else
    `--policy` takes.
    """
    name, folders = str(name_or_path), SHIPPED_POLICIES
    if name == "shipped" and task:
        if task not in SHIPPED_POLICIES:
            raise UserError(f"no policy ships for {task}: train one, or take the expert")
        return SHIPPED_POLICIES[task]
    # train-policy's --out holds the folder `policy`
    for folder in (folders.get(name), Path(name), Path(name) / "policy"):
        if folder and POLICY_FORMAT.weights_path(folder).is_file():
            return folder
    if Path(name).is_dir():
        raise UserError(f"no policy in {name}: train one with touchgoal train-policy")
    names = POLICIES if task else folders
    others = ", a class of your own as module:Class or file.py:Class, or a server as ws://host:port"
    raise UserError(
        f"{unknown_name('policy', name, names)}, or name a folder that train-policy or pull made"
        f"{others if task else ''}"
    )
