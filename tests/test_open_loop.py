"""Open-loop errors along a demonstration whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_policies import TOY

from touchgoal.control.motion.kinematics import Fr3Kinematics
from touchgoal.policies.evaluation.open_loop import (
    constant_action,
    open_loop_errors,
    repeat_last,
    zero_motion,
)
from touchgoal.policies.network import ObservationBatch
from touchgoal.policies.training.sequence_dataset import Recordings, SequenceDataset

import mujoco  # isort: skip - after touchgoal, which chooses the OpenGL platform

HZ, TICKS = 20, 12
START = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 1.9, 0.785])
CHANGE = np.array([0.01, 0.0, 0.0, 0.02, 0.0, -0.01, 0.0])  # rad a tick


@pytest.fixture(scope="module")
def demonstration() -> SequenceDataset:
    """The joints turn evenly."""
    config = replace(TOY, touch_dim=0, touch="")
    kinematics, rows = Fr3Kinematics(), []
    for k in range(TICKS):
        joints = START + k * CHANGE
        position, R = kinematics.forward(joints)
        mujoco.mju_mat2Quat(quaternion := np.zeros(4), R.ravel())
        rows.append(np.concatenate([joints, CHANGE * HZ, [0.04], position, quaternion]))
    state = torch.from_numpy(np.stack(rows)).float()
    actions = torch.from_numpy(np.append(CHANGE, 0.04)).float().repeat(TICKS, 1)
    return SequenceDataset(
        Recordings(torch.empty(TICKS, 0).half(), state, actions, (TICKS,)), config
    )


def test_who_repeats_an_even_turn_makes_no_error(demonstration: SequenceDataset) -> None:
    for plan in (repeat_last(HZ, 8), constant_action(demonstration.recorded.actions[0], 8)):
        errors = open_loop_errors(plan, demonstration, HZ)
        assert (
            max(errors.chunk.max(), errors.teacher_forced.max(), errors.free_running.max()) < 0.01
        )


def test_who_stands_still_is_off_by_the_way(demonstration: SequenceDataset) -> None:
    errors, kinematics = open_loop_errors(zero_motion(8), demonstration, HZ), Fr3Kinematics()
    at = [kinematics.forward(START + k * CHANGE)[0] for k in range(TICKS + 1)]
    way = [1e3 * np.linalg.norm(position - at[0]) for position in at[1:]]
    np.testing.assert_allclose(errors.teacher_forced, way, atol=0.01)
    np.testing.assert_allclose(errors.free_running, way, atol=0.01)
    assert errors.chunk[7] == pytest.approx(way[7], rel=0.1)
    assert errors.path == pytest.approx(way[-1] - way[0], rel=0.05)


def test_a_free_run_sees_what_it_compounded(demonstration: SequenceDataset) -> None:
    """A planner that aims at a posture ends there, though the recording does not."""
    aim = torch.from_numpy(START - 0.02).float()

    def plan(batch: ObservationBatch) -> torch.Tensor:
        step = 0.5 * (aim - batch.joints)
        return torch.cat([step, step[:, :1] * 0], 1)[:, None].expand(-1, 8, -1)

    errors, kinematics = open_loop_errors(plan, demonstration, HZ), Fr3Kinematics()
    aimed = kinematics.forward(START - 0.02)[0]
    end = kinematics.forward(START + TICKS * CHANGE)[0]
    assert errors.free_running[-1] == pytest.approx(1e3 * np.linalg.norm(end - aimed), abs=0.05)
    assert errors.teacher_forced[-1] > 2 * errors.free_running[-1]
