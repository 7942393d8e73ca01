"""Cell files: the examples, what they mean for the limits, and every mistake in one line."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from fake_cell import SIM, write_cell_file

from touchgoal.control.cell.cell_file import (
    CELLS,
    EXAMPLES,
    cell_table,
    find_cell_file,
    read_cell_file,
)
from touchgoal.control.cell.limits import cell_limits
from touchgoal.control.safety.action_filter import ActionFilter
from touchgoal.control.safety.limits import FR3
from touchgoal.control.tactile.indentation import require_readable
from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.launch.deploy import load_policy
from touchgoal.policies.acting import LearnedPolicy
from touchgoal.runtime.errors import UserError
from touchgoal.sim_envs.config import BeadMazeConfig
from touchgoal.sim_envs.twin.cell_task import env_config_of

REAL = (EXAMPLES / "fr3_two_minis.toml").read_text()


@pytest.mark.parametrize("path", CELLS.values(), ids=lambda p: p.stem)
def test_example_cell_files_are_read(path: Path) -> None:
    maze = path.stem == "sim_maze"
    cell = read_cell_file(path)
    assert cell.task.name == ("bead-maze" if maze else "pick-place")
    if maze:  # as it was trained: what ships feels with printed dots, and fingers that hardly press
        low, high = BeadMazeConfig().grasp_force
        assert low <= cell.gripper.force <= high
        assert load_policy(cell)[0] is not None


def test_a_target_reaches_the_policy_or_is_refused() -> None:
    with pytest.raises(UserError, match="name the object itself"):
        load_policy(read_cell_file(EXAMPLES / "sim.toml", "shipped", target="the {object}"))
    policy, _ = load_policy(read_cell_file(EXAMPLES / "sim.toml", "shipped", target="a red block"))
    assert cast(LearnedPolicy, policy).target == "a red block"


def test_an_example_is_found_by_its_name(here: Path) -> None:
    for name in ("sim", "sim.toml", "control/cell/examples/sim.toml"):
        assert find_cell_file(Path(name)) == EXAMPLES / "sim.toml"
    with pytest.raises(UserError, match="no cell file mine.toml.*fr3_two_minis, sim, sim_maze"):
        find_cell_file(Path("mine.toml"))
    (here / "sim.toml").write_text(SIM)
    assert find_cell_file(Path("sim.toml")) == Path("sim.toml")


def test_the_cells_tool_is_the_one_that_is_watched(tmp_path: Path) -> None:
    """Longer fingers: the TCP and the corners are theirs."""
    cell = read_cell_file(EXAMPLES / "ur5e.toml")
    assert cell.tool is not None
    corners = tuple((x, y, 0.32) for x, y, _ in cell.tool.finger_corners)
    longer = replace(cell.tool, tcp=0.3, finger_corners=corners)
    limits = cell_limits(replace(cell, tool=longer))
    assert limits.tool.tcp_offset == 0.3 and limits.tool.mass == cell.tool.mass
    before, after = (
        ActionFilter(each, 20).monitored_points(limits.arm.home[None])[0, 1:, 2].min()
        for each in (cell_limits(cell), limits)
    )
    assert before - after > 0.1


def test_a_touch_ceiling_that_no_image_can_show_is_refused() -> None:
    require_readable(find_sensor("digit"), 1.5e-3)
    require_readable(find_sensor("gelsight_mini"), FR3.indentation)
    with pytest.raises(UserError, match="deeper than the sensor file of the gelsight_mini"):
        require_readable(find_sensor("gelsight_mini"), 5e-3)


def test_a_byte_order_mark_is_read_over(tmp_path: Path) -> None:
    assert read_cell_file(write_cell_file(tmp_path, "\ufeff" + SIM)).arm == "sim"


def test_a_twins_cell_file_has_the_keys_of_a_labs(tmp_path: Path) -> None:
    """Keys added by hand count or are refused."""
    cell = read_cell_file(write_cell_file(tmp_path, SIM))
    path, table = tmp_path / "cell.json", cell_table(cell)
    path.write_text(json.dumps(table))
    assert read_cell_file(path) == cell
    path.write_text(json.dumps(table | {"safety": {"force": 25, "fingertips_lower": [0, 0, 0.1]}}))
    limits = cell_limits(read_cell_file(path))
    assert limits.force == 25 and limits.fingertips.lower[2] == 0.1
    path.write_text(json.dumps(table | {"safty": {"force": 25}}))
    with pytest.raises(UserError, match="cell.json: unknown key 'safty': did you mean safety?"):
        read_cell_file(path)


def test_a_misspelt_object_is_named_by_its_key(tmp_path: Path) -> None:
    wrong = SIM.replace("wooden", "wodden")
    with pytest.raises(
        UserError, match="^task.objects: unknown object 'wodden_block': did you mean"
    ):
        env_config_of(read_cell_file(write_cell_file(tmp_path, wrong)))


TIPS = 'fingertips = { sensor = "digit", left = "simulated", right = "*" }'
real, sim, tips = REAL.replace, SIM.replace, TIPS.replace


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (sim('arm = "sim"', ""), "arm is missing"),
        (
            sim('"sim"', '"fr3"\naddress = "a"').replace('_hand"', '_hand", address = "a"'),
            "tool is missing: measure tcp, mass, centre_of_mass and finger_corners",
        ),
        (sim("cameras.front", "cameras.back"), "cameras.back must be 'front' or 'wrist'"),
        (sim("policy =", "polcy ="), "unknown key in task 'polcy': did you mean policy?"),
        (sim("seed = 3", "start = [0.0]"), "task.start must be 7 joint positions"),
        (SIM + "safety = { force = nan }", "safety.force must be a finite number, not nan: Ext"),
        (
            SIM + 'fingertips = { sensor = "digt", left = "a", right = "b" }',
            "unknown sensor or folde",
        ),
        (SIM + tips("*", "simulatd"), "fingertips.right is 'simulatd': did you mean 'simul"),
        (SIM + tips("*", ""), "fingertips.right is empty: give a value or leave it out"),
        (sim("seed = 3", 'instruction = ""'), "task.instruction is empty: give a value or"),
        (sim("seed = 3", 'normalizer = "no"'), "task.normalizer does nothing without task.re"),
        (real("172.16.0.2", "172.16.0.300"), "address '172.16.0.300' does not appear to be"),
        (
            real("[640, 480]", "[480, 640]"),
            "front.size must be width, then height: did you mean [640,",
        ),
        (real("force = 30.0", "force = 29.9"), "gripper.force must lie between 30 and 70 N"),
        ("arm =", "is no TOML"),
        (sim("pick-place", "plug"), "task.policy: expert is for pick-place and bead-maze"),
        (sim("seed = 3", r'instruction = "\u001b"'), "task.instruction has control char"),
        (sim("seed = 3", "grasp = [0.5, 0, -0.2, 0]"), "task.grasp [0.5, 0.0, -0.2] is ou"),
        (re.sub(r"0\.1(539|209)", "0.0", REAL), "tool.finger_corners span [29.0, 140.0, 0.0] mm"),
        (real("tcp = 0.1374", "tcp = 0.4"), "tool.finger_corners leave out the TCP"),
        (real("2BNKH4TQ", "2BNK9P3X"), "fingertips.left and fingertips.right are both"),
    ],
)
def test_a_bad_cell_file_is_one_line(wrong: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as error:
        read_cell_file(write_cell_file(tmp_path, wrong))
    assert "cell.toml" in str(error.value) and message in str(error.value)
    assert "\n" not in str(error.value)
