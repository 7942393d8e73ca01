"""`touchgoal arm`: home, open, close and recover, on the twin over the wire."""

import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from running_twin import RunningTwin

from touchgoal.control.arms.client_libraries import FRANKY
from touchgoal.control.safety.limits import FR3
from touchgoal.launch.__main__ import main

START = FR3.arm.home + 0.1 * np.eye(7)[0]  # rad: elsewhere than where the twin begins


@pytest.mark.slow
def test_arm_commands_on_the_twin(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("franky", reason=FRANKY.install)
    cell = ["--lock-step", "--env.objects", "wooden_block", "--env.no-tactile", "--env.cameras"]
    with closing(RunningTwin(cell, tmp_path, 5)) as twin:
        table = json.loads(twin.cell_file.read_text())
        table["task"]["start"] = START.tolist()
        cell_file = tmp_path / "own.json"
        cell_file.write_text(json.dumps(table))

        def arm(action: str) -> dict:
            main(["arm", action, str(cell_file), "--yes"])
            return twin.at_rest()

        np.testing.assert_allclose(arm("home")["q"], START, atol=2e-3)
        closed = arm("close")
        assert closed["width"] < 0.002 and np.allclose(closed["q"], START, atol=2e-3)
        assert arm("open")["width"] > 0.07
        twin.ask("error cartesian_reflex")
        with pytest.raises(SystemExit) as stopped:
            arm("home")
        assert stopped.value.code == 4 and "reflex" in capsys.readouterr().err
        arm("recover")
        assert "recovered: the arm takes commands" in capsys.readouterr().out
        np.testing.assert_allclose(arm("home")["q"], START, atol=2e-3)
        assert twin.ask("truth")["worst"]["excess"] == 0
        twin.ask("stop-button on")
        with pytest.raises(SystemExit, match="not recovered: user stop: release"):
            arm("recover")
        twin.ask("stop-button off")


def test_a_simulated_arm_and_an_empty_chair_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="a simulated arm ends with its command"):
        main(["arm", "home", "sim"])
    with pytest.raises(SystemExit, match="nobody is there to confirm"):
        main(["arm", "open", "ur5e"])
