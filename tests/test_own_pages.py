"""The pages on a task, a sensor and a policy of one's own: their programs run as printed."""

import re
import runpy
import shutil
from pathlib import Path

import pytest

from touchgoal.control.tactile.sensor_models import GELSIGHT_MINI, SENSORS
from touchgoal.episodes.store import EpisodeSet

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with what the pages take for granted."""
    shutil.copytree(GELSIGHT_MINI.sensor_file, tmp_path / "runs" / "mini" / "sensor_file")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def run_programs(page: str) -> None:
    programs = re.findall(r"^```python\n(.*?)^```$", (DOCS / page).read_text(), re.M | re.S)
    for i, program in enumerate(programs):
        named = re.match(r"# (\w+\.py)\n", program)
        file = Path(named[1] if named else f"program_{i}.py")
        file.write_text(program)
        if not named:  # a module, which the others import
            runpy.run_path(str(file))


def test_a_task_of_ones_own(desk: Path) -> None:
    run_programs("own_task.md")
    episodes = EpisodeSet(desk / "my_episodes")
    assert len(episodes) == 2
    for i in range(2):
        assert episodes.meta(i)["success"] and episodes.meta(i)["task"] == "lift"


def test_a_sensor_of_ones_own(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("touchgoal.control.tactile.sensor_models.SENSORS", dict(SENSORS))
    run_programs("own_sensor.md")


def test_a_policy_of_ones_own(desk: Path, capsys: pytest.CaptureFixture) -> None:
    run_programs("own_policy.md")
    assert "0/2 [0.00, 0.66]" in capsys.readouterr().out
