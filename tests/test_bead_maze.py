"""Wires that differ, a bead that obeys friction, and a maze that takes touch to solve."""

from dataclasses import replace

import numpy as np
import pytest

from touchgoal.control import features as ft
from touchgoal.control.deployment.follower import WireFollower
from touchgoal.control.interfaces import Actor
from touchgoal.control.safety.limits import TASK_FORCES
from touchgoal.episodes.recording import run
from touchgoal.sim_envs.bead_maze import BeadMaze, add_bead_on_wire, add_wire
from touchgoal.sim_envs.config import BeadMazeConfig
from touchgoal.sim_envs.experts.bead_maze import BeadMazeExpert
from touchgoal.sim_envs.scene import wires
from touchgoal.sim_envs.scene.wires import FAMILIES, LENGTH, MIN_RADIUS, Wire, choose, find_wire

BLIND = BeadMazeConfig(tactile=False)
STILL = np.zeros(8)


@pytest.fixture(scope="module")
def maze():
    env = BeadMaze(BLIND)
    yield env
    env.close()


def lead(env, actor_of, wire, seed=0):
    """Run an actor along a wire; all ticks."""
    observation, info = env.reset(seed=seed, options={"wire": wire.name})
    return list(run(env, actor_of(env), observation, info))


def follower(env):
    return WireFollower(env.config.control_hz)


class FeelsSomethingElse(Actor):
    """The follower, with the forces of another run, or none."""

    def __init__(self, forces):
        self.follower, self.forces = WireFollower(), iter(forces)

    def act(self, observation):
        return self.follower.act({**observation, ft.WRENCH: next(self.forces, np.zeros(6))})


@pytest.mark.parametrize("family", FAMILIES)
def test_wires_are_sound_and_differ(family) -> None:
    drawn = [*choose("test", 30, (family,)), *choose("validation", 20, (family,))]
    drawn += choose("training", 30, (family,))
    assert len({wire.name for wire in drawn}) == 80
    shapes = np.stack([wires.shape(wire) for wire in drawn])
    for i, wire in enumerate(drawn):
        assert wires.distance(shapes[i], np.delete(shapes, i, axis=0)) > wires.APART
        lengths = np.linalg.norm(np.diff(wire.points, axis=0), axis=1)
        np.testing.assert_allclose(lengths, wires.STEP, rtol=1e-3)
        assert wire.min_radius > MIN_RADIUS and np.abs(wire.tangents[:, 2]).max() < 0.57
        np.testing.assert_array_equal(find_wire(wire.name).points, wire.points)
    turned = drawn[0].moved(np.array([0.4, 0.1, 0.2]), 0.7)  # counts as the same wire
    assert wires.distance(wires.shape(turned), shapes[:1]) < 1e-6


@pytest.mark.parametrize(("degrees", "slides"), [(9.5, False), (14.0, True)])
def test_bead_slides_as_coulomb_says(degrees: float, slides: bool) -> None:
    """Friction 0.2 holds on slopes up to 11.3 degrees."""
    import mujoco  # after touchgoal, which chooses the OpenGL platform

    slope = np.radians(degrees)
    line = np.arange(0.0, LENGTH + 1e-9, wires.STEP)[:, None]
    straight = Wire("arc", 0, line * [0, np.cos(slope), -np.sin(slope)] + [0, 0, 0.3])
    spec = mujoco.MjSpec()
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 1000
    spec.option.timestep = 1e-3
    bead = spec.worldbody.add_body(name="object")
    bead.add_freejoint()
    bead.add_geom(name="object", size=[0.01, 0, 0], mass=0.01, contype=0, conaffinity=0)
    add_wire(spec, straight, friction=0.2)
    add_bead_on_wire(spec, straight, friction=0.2)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=500)
    moved = straight.project(data.qpos[:3], 0.03) - 0.03
    off = np.linalg.norm(data.qpos[:3] - straight.at(0.03 + moved)[0])
    assert off < 0.8e-3  # m: the clearance and what the contact gives
    expected = 0.5 * 9.81 * 0.5**2 * (np.sin(slope) - 0.2 * np.cos(slope))
    assert moved == pytest.approx(expected, rel=0.25) if slides else moved < 1e-3


@pytest.mark.parametrize("family", FAMILIES)
def test_expert_leads_the_bead_to_its_post_and_says_so(family) -> None:
    env = BeadMaze(replace(BLIND, ends_by_success=False))
    ticks = lead(env, BeadMazeExpert, choose("validation", 3, (family,))[2])
    there = [bool(tick[ft.TRUTH_SUCCESS]) for tick in ticks].index(True)
    force = np.stack([tick[ft.WRENCH][:3] for tick in ticks])
    assert ticks[-1][ft.TRUTH_SUCCESS] and ticks[there][ft.TRUTH_PROGRESS] == 1
    assert np.linalg.norm(force[:there], axis=1).max() < 3 and there < 330
    assert not any(tick[ft.TRUTH_FAILURE].any() for tick in ticks)
    assert 40 < len(ticks) - there < 80  # 36 mm on, pressed for .7 s, and 1 s of rest
    met = LENGTH - 0.008 - 0.0026  # m: half the bead, and the post's radius
    assert env.arc_length == pytest.approx(met, abs=2.5e-3)
    back = force[-30:] @ env.wire.at(LENGTH)[1]
    assert -15 < back.min() and back.max() < -2


@pytest.mark.parametrize("bead", ["sphere", "cylinder"])
def test_expert_comes_back_when_led_astray(bead) -> None:
    env = BeadMaze(replace(BLIND, disturbance=0.004, bead=bead))
    ticks = lead(env, BeadMazeExpert, find_wire("roller-3"))
    force = np.linalg.norm([tick[ft.WRENCH][:3] for tick in ticks], axis=1)
    assert ticks[-1][ft.TRUTH_SUCCESS] and 5 < force.max() < TASK_FORCES[env.task].force_ceiling


def test_it_takes_touch(maze: BeadMaze) -> None:
    """The follower finishes, of the held-out family too; blind or misled, it does not."""
    other = lead(maze, follower, find_wire("helix-6"), seed=1)
    wrenches = [tick[ft.WRENCH] for tick in other]
    for name in ("fourier-3", "serpentine-5"):
        assert lead(maze, follower, find_wire(name))[-1][ft.TRUTH_SUCCESS]
    for forces in ([], wrenches):
        other_forces = FeelsSomethingElse(forces)
        ticks = lead(maze, lambda _, actor=other_forces: actor, find_wire("serpentine-5"))
        assert ticks[-1][ft.TRUTH_FAILURE].any()
        assert max(tick[ft.TRUTH_PROGRESS] for tick in ticks) < 0.6


def test_drop_and_jam(maze: BeadMaze) -> None:
    maze.reset(seed=0)
    terminated, info = False, {}
    while not terminated:
        *_, terminated, _, info = maze.step(np.append(np.zeros(7), 0.08))
    assert info[ft.TRUTH_FAILURE].tolist() == [True, False, False] and not info[ft.TRUTH_SUCCESS]
    env = BeadMaze(replace(BLIND, stall_seconds=0.5))
    env.reset(seed=0)
    *_, info = [env.step(STILL) for _ in range(22)][-1]
    assert info[ft.TRUTH_FAILURE].tolist() == [False, True, False]


def test_bead_stays_on_the_wire_whatever_the_hand_does(maze: BeadMaze) -> None:
    maze.reset(seed=0)
    maze.action_space.seed(0)
    pressed = False
    for _ in range(40):
        action = maze.action_space.sample()
        action[7] = 0.0
        *_, info = maze.step(action)
        pressed |= info[ft.TRUTH_FAILURE][2]
        point, _ = maze.wire.at(maze.wire.project(maze.object_pose()[:3], maze.arc_length))
        assert np.linalg.norm(maze.object_pose()[:3] - point) < 2e-3
    assert pressed
