# ruff: noqa: E402
"""Runs the scripted expert's plan and a user's policy without torch, MuJoCo and Gymnasium."""

import importlib
import sys
import tempfile
from pathlib import Path

from blocked_packages import SIMULATOR, Blocker

Blocker(*(BLOCKED := ("torch", *SIMULATOR)))

from fake_cell import FakeCell, KeptTicks, write_cell_file

from touchgoal.control.cell.cell_file import read_cell_file
from touchgoal.control.deployment.actors import make_actor
from touchgoal.control.deployment.control_loop import ControlLoop
from touchgoal.control.deployment.session import Result, Session
from touchgoal.control.interfaces import Actor
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.launch import deploy
from touchgoal.launch.support.command_line import parse

CELL = """
arm = "sim"
gripper = { kind = "franka_hand" }
[task]
name = "pick-place"
policy = "POLICY"
seconds = 40.0
grasp = [0.45, 0.0, 0.02, 0.0]
goal = [0.5, 0.1]
"""
USER_POLICY = """
import numpy as np

class Turns:
    def reset(self): ...
    def act(self, observation): return np.array([0.004, *np.zeros(6), 0.08])
    def env_config(self, config): return config
"""


def run(folder: Path, policy: str, seconds: float) -> tuple[Result, FakeCell]:
    text = CELL.replace("POLICY", policy).replace("40.0", str(seconds))
    cell, fake = read_cell_file(write_cell_file(folder, text)), FakeCell()
    fake.gripper.follows = True
    safety = ActionFilter(FR3, 20)
    loaded, _ = deploy.load_policy(cell)

    def actor(loop: ControlLoop) -> Actor:
        return make_actor(cell, loaded, safety, None, loop.commanded)

    no_operator = {"operator_request": lambda: "", "on_tick": lambda _: None}
    session = Session(cell, fake.connection(), safety, KeptTicks(), True, actor, **no_operator)
    return session.run(), fake


for path in (root := Path(__file__).parents[1]).glob("control/**/*.py"):
    importlib.import_module(".".join(("touchgoal", *path.relative_to(root).with_suffix("").parts)))
assert not set(BLOCKED) & set(sys.modules)
assert parse(deploy.Config, ["sim"], prog="deploy", description="", envs=None).cell == Path("sim")
with tempfile.TemporaryDirectory() as name:
    result, _ = run(Path(name), "expert", 40.0)
    assert result.ending.reason == "the policy is done", result.ending
    (Path(name) / "own.py").write_text(USER_POLICY)
    result, fake = run(Path(name), f"{name}/own.py:Turns", 1.0)
    assert result.ending.reason.startswith("time is up"), result.ending
    turned = fake.arm.reading.q[0] - FR3.arm.home[0]
    assert 0.04 < turned < 0.1, turned
