# ruff: noqa: E402
"""Loads the shipped policies and deploys one of one's own without MuJoCo and Gymnasium."""

import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from blocked_packages import SIMULATOR, Blocker

Blocker(*SIMULATOR)

import numpy as np
from fake_cell import FakeCell, write_cell_file
from toy_policies import toy_network

from touchgoal.control import features as ft
from touchgoal.control.safety.limits import FR3
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.deploy import NOT_DONE, Config, main
from touchgoal.launch.support import cell_run
from touchgoal.policies import checkpoint
from touchgoal.policies.perception.state_estimation import StateEstimator, load_pose_estimator
from touchgoal.runtime.errors import RefusedError

blank = {key: np.zeros(kind.shape, kind.dtype) for key, kind in ft.FEATURES.items()}
blank[ft.STATE][:7] = blank[ft.COMMAND][:7] = FR3.arm.home
trained = load_pose_estimator(checkpoint.SHIPPED_POLICIES["pick-place"] / checkpoint.ESTIMATOR)
blank[ft.TCP_POSE] = trained.tcp_normalizer.offset.numpy()
for name in ("bead-maze", "pick-place"):
    policy = checkpoint.load_policy(name)
    rows, columns = policy.env_config().camera_size
    seen = blank | {ft.FRONT: np.zeros((rows, columns, 3), np.uint8)}
    seen |= dict.fromkeys(ft.TACTILE, np.full((240, 320, 3), 120, np.uint8))
    # nothing is seen in a black image: refused, until no trust is asked for
    if name == "pick-place":
        with suppress(RefusedError):
            sys.exit(f"acts on a black image: {policy.act(seen)}")
        policy.reset()
        estimator = getattr(policy, "_estimator", None)
        assert isinstance(estimator, StateEstimator)
        eyes, estimator._least = estimator.pose_estimator, (0.0, 0.0, 0.0, 0.0)
        eyes.config = replace(eyes.config, misfit=None)
    assert policy.act(seen).shape == (8,)

CELL = """
arm = "sim"
gripper = { kind = "franka_hand" }
task = { name = "pick-place", policy = "POLICY", seconds = 0.5 }
"""
folder, fake = Path(sys.argv[1]), FakeCell()
network = toy_network(touch_dim=0, touch="", task="pick-place")
checkpoint.save(network, folder / "own", {})
cell = write_cell_file(folder, CELL.replace("POLICY", str(folder / "own")))
for execute in (False, True):
    with patch.object(cell_run, "connect", lambda cell: fake.connection()):
        try:
            main(Config(cell, execute=execute, yes=True, out=folder / "run"))
        except SystemExit as end:
            assert end.code == NOT_DONE and execute  # time was up
assert EpisodeSet(folder / "run/episodes").lengths[0] > 9
assert not set(SIMULATOR) & set(sys.modules)
