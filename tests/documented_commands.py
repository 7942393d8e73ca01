"""What README, docs/ and CONTRIBUTING tell a person to type, and how the tests type it smaller."""

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

from in_process import in_process_workers

from benchmarks import __main__ as benchmarks
from benchmarks.records import records_of
from touchgoal.launch import __main__ as launch

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "docs" / "first_steps.ipynb"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

# What a command is given, or given instead, so that it ends within seconds. The first line whose
# words begin the command counts. An option that is there gets the new value, another one is added.
TOY = {
    "run-policy": "--episodes 1 --workers 1 --no-video --env.max-seconds 1",
    "collect-demos --task bead-maze --policy": "--episodes 1 --workers 1 --env.max-seconds 1",
    "collect-demos --task bead-maze": "--episodes 1 --workers 1 --env.cameras --env.disturbance 0",
    "collect-demos --feedback": "--episodes 1 --workers 1 --env.max-seconds 1",
    "collect-demos --episodes 240": "--episodes 2 --workers 2 --env.objects glass_ball --env.control-hz 5",
    "collect-demos --episodes 80": "--episodes 2 --workers 2 --env.objects glass_ball --env.control-hz 5",
    "collect-demos": "--episodes 4 --workers 2 --env.objects glass_ball --env.cameras front --env.control-hz 5",
    "collect-touches": "--episodes 2 --workers 2",
    "reward-curves data/episodes": "--index 0",
    "train-encoder align": "--align.backbone vit-tiny --align.epochs 1 --align.batch-size 8 --normalizer-episodes 2",
    "train-encoder mae": "--frames 8 --mae.vit tiny --mae.epochs 1 --mae.batch-size 8",
    "train-encoder dino": "--frames 8 --dino.vit tiny --dino.epochs 1 --dino.batch-size 8",
    "train-encoder words": "--surfaces 4 --heads.epochs 1 --encoder gelsight_mini",
    "train-encoder surfaces": "--surfaces 16 --presses-per-surface 2",
    "train-policy": "--head tiny --train.epochs 1 --trials 0 --workers 1",
    "record-demos": "--episodes 1 --hand.speed 0.25 --hand.turn-speed 1.5",
    "fit-normalizer": "--no-value --no-judge",  # test_commands.py and test_judge_command.py fit them
    "twin": "--port 0 --lock-step",
}
# What is not run here, and where it is, or why not.
NOT_RUN = {
    "record-presses": "needs a sensor and a person: test_own_sensor.py",
    "check-sensor": "needs a sensor and a person: test_own_sensor.py",
    "calibrate": "needs presses of a real sensor: test_calibration.py",
    "calibrate-camera": "needs a board: test_hand_eye.py",
    "arm": "needs an arm: test_deploy.py",
    "push": "needs a hub: test_hub.py",
    "pull": "needs a hub: test_hub.py",
    "judge": "needs a judge: test_judge_command.py",
    "demo": "test_commands.py",
}


STARTS = ("touchgoal ", "python -m benchmarks ", "launch/deploy.sh", "make ")


@dataclass(frozen=True)
class Command:
    """One line to type."""

    page: str  # where it is printed
    line: str  # as it is printed, without its comment
    whole: bool  # stands in a block, to be typed as it is; else in the text, perhaps in part

    @property
    def words(self) -> list[str]:
        return shlex.split(self.line.removeprefix("python -m "))

    @property
    def small(self) -> list[str]:
        """Return the words after `touchgoal`, with options that make it small."""
        words = self.words[1:]
        name = next((n for n in TOY if words[: len(n.split())] == n.split()), None)
        for option in re.findall(r"--\S+(?: [^-]\S*)*", TOY[name]) if name else []:
            option, *values = option.split()
            if option in words:
                start = words.index(option) + 1
                given = list(takewhile(lambda word: not word.startswith("--"), words[start:]))
                words[start : start + len(given)] = values
            else:
                words += [option, *values]
        return words


def commands() -> Iterator[Command]:
    """Yield each printed command once, in the order of the pages."""
    met = set()
    for page in PAGES:
        text = page.read_text()
        for line, whole in _lines(text):
            if line not in met and line.startswith(STARTS):
                met.add(line)
                yield Command(page.name, line, whole)


def exit_status(words: list[str]) -> int:
    """Run a command in this process and return its exit status."""
    print("touchgoal", shlex.join(words), flush=True)
    try:
        with in_process_workers():
            launch.main(words)
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
            return 1
        return end.code or 0
    return 0


def _lines(text: str) -> Iterator[tuple[str, bool]]:
    for block in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        if block[1] in ("", "sh", "bash"):
            for line in block[2].replace("\\\n", " ").splitlines():
                if command := re.sub(r"\s+#.*", "", line).strip():
                    yield command, True
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    for line in re.findall(r"^    ((?:touchgoal|python -m) .*?)(?:\s+#.*)?$", prose, re.MULTILINE):
        yield line, False
    for span in re.finditer(r"`([^`]+)`", prose):
        line = " ".join(span[1].split())
        if line.startswith(STARTS) and not line.startswith("touchgoal --"):
            yield line, False


def snippets(page: Path) -> list[str]:
    """The Python blocks of a page, in order; all of a notebook is one."""
    if page.suffix == ".ipynb":
        cells = [cell for cell in json.loads(page.read_text())["cells"] if "outputs" in cell]
        return ["\n".join("".join(cell["source"]) for cell in cells)]
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


def recipes(target: str) -> list[list[str]]:
    """Words of the commands that a target of the Makefile runs, in the first round of its loops."""
    asked = ["make", "-n", "-s", "-C", str(ROOT), target]
    output = subprocess.run(asked, check=True, capture_output=True, text=True).stdout
    output = re.sub(r"\$\(\(.*?\)\)", "1", output.replace("\\\n", " "))
    output = re.sub(r"\$\{?round\}?", "1", output)
    found = re.findall(r"\.venv/bin/(?:touchgoal|python -m (?=benchmarks)) ?([^;&|\n]*)", output)
    return [shlex.split(line) for line in found]


def read_options(words: list[str]) -> None:
    """Parse the words of a command: after `touchgoal`, or from `benchmarks` on."""
    if words[0] != "benchmarks":
        launch.read_options(words[0], words[1:])
    elif "--recorded" in words:
        assert records_of(words[1])
    else:
        benchmarks.read_options(words[1], words[2:])
