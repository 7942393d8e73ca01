"""Open-loop error of a policy along recorded demonstrations, for Table 10 of Sparsh.

The paper compares "the compounded trajectory from predicted delta joint angles" with a
demonstration on an unseen maze, and leaves open how. Three readings, in mm at the TCP:

- chunk: one plan, compounded from the measured joints, after each of its ticks.
- teacher_forced: the first action of each tick's plan, compounded over the demonstration; every
  plan observes the recording.
- free_running: the same, but every plan observes the joints compounded so far (and the recorded
  touch).
"""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from touchgoal.control.safety.limits import FR3
from touchgoal.policies.network import ObservationBatch
from touchgoal.policies.training.sequence_dataset import SequenceDataset

Plan = Callable[[ObservationBatch], Float[Tensor, "b h 8"]]


@dataclass(frozen=True, eq=False)
class OpenLoopErrors:
    """Errors along one demonstration, mm."""

    chunk: Float[np.ndarray, " h"]  # mean over all plans, after each tick of the plan
    teacher_forced: Float[np.ndarray, " t"]  # at each tick
    free_running: Float[np.ndarray, " t"]  # at each tick
    path: float  # length of the TCP's path, mm


def open_loop_errors(plan: Plan, demonstration: SequenceDataset, control_hz: int) -> OpenLoopErrors:
    """Return the errors of a planner along one demonstration.

    Args:
        plan: observation batches to actions, such as `PolicyNetwork.plan` or a baseline.
        demonstration: windows of one episode, whose state is `features.STATE` and TCP pose.
        control_hz: ticks per second, which turns joint changes to velocities for `free_running`.
    """
    count = len(demonstration)
    batch, actions = demonstration.take(torch.arange(count))
    joints = batch.joints.numpy()
    planned, done = plan(batch).numpy()[..., :7], actions.numpy()[..., :7]
    course = joints[0] + np.cumsum(done[:, 0], 0)
    teacher_forced = joints[0] + np.cumsum(planned[:, 0], 0)
    free_running = _free_running(plan, batch, control_hz)
    chunk = _distance(joints[:, None] + planned.cumsum(1), joints[:, None] + done.cumsum(1))
    way = np.linalg.norm(np.diff(_positions(course), axis=0), axis=1).sum()
    return OpenLoopErrors(
        chunk=chunk.mean(0),
        teacher_forced=_distance(teacher_forced, course),
        free_running=_distance(free_running, course),
        path=1e3 * float(way),
    )


def _free_running(plan: Plan, batch: ObservationBatch, control_hz: int) -> Float[np.ndarray, "t 7"]:
    """Return the joints after each tick, where each plan observes the joints compounded so far."""
    kinematics = FR3.kinematics()
    joints = batch.joints[0].numpy().astype(np.float64)
    states, velocity, course = [], batch.state[0, -1, 7:14].numpy(), []
    quaternion = np.zeros(4)
    horizon = batch.state.shape[1]
    rows = zip(batch.touch, batch.state, strict=True)
    for i, (touch, state) in enumerate(rows):
        position, R = kinematics.forward(joints)
        now = state[-1].clone()
        now[:7], now[7:14] = torch.from_numpy(joints), torch.from_numpy(velocity)
        now[15:18] = torch.from_numpy(position)
        mujoco.mju_mat2Quat(quaternion, R.ravel())  # as the environment's observation
        now[18:22] = torch.from_numpy(quaternion)
        states = [*(states or [now] * horizon)[1:], now]
        images = None if batch.images is None else batch.images[i : i + 1]
        maps = None if batch.maps is None else batch.maps[i : i + 1]
        observed = ObservationBatch(touch[None], torch.stack(states)[None], images, maps)
        action = plan(observed)[0, 0, :7].numpy()
        velocity = action * control_hz
        joints = joints + action
        course.append(joints)
    return np.stack(course)


def _distance(
    a: Float[np.ndarray, "... 7"], b: Float[np.ndarray, "... 7"]
) -> Float[np.ndarray, "..."]:
    return 1e3 * np.linalg.norm(_positions(a) - _positions(b), axis=-1)


def _positions(joints: Float[np.ndarray, "... 7"]) -> Float[np.ndarray, "... 3"]:
    positions, _, _ = FR3.kinematics().forward_many(joints.reshape(-1, 7).astype(np.float64))
    return positions.reshape(*joints.shape[:-1], 3)


def zero_motion(horizon: int) -> Plan:
    """Return the baseline that stands still."""
    return lambda batch: torch.zeros(len(batch.state), horizon, 8)


def repeat_last(control_hz: int, horizon: int) -> Plan:
    """Return the baseline that continues at the measured joint velocity."""

    def plan(batch: ObservationBatch) -> Float[Tensor, "b h 8"]:
        change = batch.state[:, -1, 7:14] / control_hz
        return torch.cat([change, change[:, :1] * 0], 1)[:, None].expand(-1, horizon, -1)

    return plan


def constant_action(action: Float[Tensor, "8"], horizon: int) -> Plan:
    """Return the baseline of one action, such as the mean of demonstrations."""
    return lambda batch: action.expand(len(batch.state), horizon, 8)
