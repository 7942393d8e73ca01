"""What every command shares: help, options, one line for a mistake, the run's folder, Ctrl-C."""

import json
import os
import re
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_options import options_by_command
from torch.distributed.elastic.multiprocessing.errors import ProcessFailure

from touchgoal import __version__
from touchgoal.launch.__main__ import COMMANDS, main
from touchgoal.launch.list import KINDS
from touchgoal.launch.support.command_line import SHOWN, docstrings, parse
from touchgoal.runtime.atomic_write import atomic_write
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.interruption import terminable
from touchgoal.runtime.option_types import checked_dataclass
from touchgoal.runtime.run_folder import check_writable, open_run
from touchgoal.sim_envs.config import BeadMazeConfig, PickPlaceConfig, TaskConfig, TaskName

ENVS = {"pick-place": PickPlaceConfig(), "bead-maze": BeadMazeConfig(split="validation")}


@checked_dataclass
class Toy:
    out: Path | None = None
    task: TaskName = "pick-place"
    env: TaskConfig = PickPlaceConfig()


def options(*arguments: str) -> Any:
    return parse(Toy, arguments, "touchgoal toy", "A toy.", ENVS)


def test_env_options_are_those_of_the_task(capsys: pytest.CaptureFixture) -> None:
    maze = options("--task", "bead-maze", "--env.bead", "cylinder")
    assert maze.env == BeadMazeConfig(split="validation", bead="cylinder")
    assert options("--env.mass", "0.1", "0.2").env.mass == (0.1, 0.2)
    with pytest.raises(UserError, match="--env.bead is an option of the task bead-maze: --task be"):
        options("--env.bead", "cylinder")
    capsys.readouterr()
    with pytest.raises(SystemExit):
        options("--task", "bead-maze", "--help")
    assert "--env.bead" in capsys.readouterr().out


def test_help_shows_the_first_options_and_help_all_shows_all(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        options("--help")
    short = capsys.readouterr().out
    assert "--env.control-hz" not in short and "more options, rarely needed" in short
    assert short.count(" --") <= SHOWN + 10  # a switch is named twice, and texts name options
    with pytest.raises(SystemExit):
        options("--help-all")
    assert "--env.control-hz" in capsys.readouterr().out


def test_a_bad_value_is_named_as_typed_and_a_mistyped_name_guessed(
    capsys: pytest.CaptureFixture,
) -> None:
    with pytest.raises(UserError, match="^--env.control-hz must be greater than or equal to 1, no"):
        options("--env.control-hz", "0")
    with pytest.raises(SystemExit):
        options("--env.mas", "1", "2")
    assert "Perhaps you meant" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["train-policy", "--data", "a", "--validation", "b", "--steps", "3"])
    assert re.search(r"you meant:\W+--train.epochs", capsys.readouterr().err)
    with pytest.raises(SystemExit, match=r"no command 'run-polcy'; did you mean run-policy\?$"):
        main(["run-polcy"])


def test_a_mistake_is_one_line_and_with_traceback_all_of_it() -> None:
    huge = ["run-policy", "--episodes", "9" * 20]
    with pytest.raises(
        SystemExit, match="--episodes must be less than or equal to [0-9]*, not 9999"
    ):
        main(huge)
    with pytest.raises(UserError, match="less than"):
        main([*huge, "--traceback"])


def test_torchrun_ends_with_the_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its agent prints what a failed rank leaves in this file as the last line of its report."""
    monkeypatch.setenv("TORCHELASTIC_ERROR_FILE", str(tmp_path / "error.json"))
    with pytest.raises(SystemExit) as ended:
        main(["demo", "--out", "/proc/run"])
    failure = ProcessFailure(0, 1, 1, str(tmp_path / "error.json"))
    assert failure.message == str(ended.value) and "cannot write in /proc" in failure.message


def test_version_and_lists(capsys: pytest.CaptureFixture) -> None:
    main(["--version"])
    assert capsys.readouterr().out == f"touchgoal {__version__}\n"
    main(["list"])
    assert all(kind in capsys.readouterr().out.split() for kind in ("objects",))
    for kind, (entries, _) in KINDS.items():
        main(["list", kind])
        printed = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in printed] == list(entries()) != []


def test_out_is_probed_before_any_work(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(SystemExit, match="--out: .*file is a file"):
        main(["demo", "--out", str(file)])
    with pytest.raises(UserError, match="cannot write in /proc"):
        check_writable(Path("/proc/run"))
    check_writable(tmp_path / "new" / "run")
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_keeps_the_record_of_every_run(tmp_path: Path) -> None:
    one, other = Toy(out=tmp_path), Toy(out=tmp_path, task="bead-maze")
    assert open_run(tmp_path, "toy", one) == tmp_path
    record = json.loads((tmp_path / "config.json").read_text())
    assert record["config"]["task"] == "pick-place" and record["touchgoal"] == __version__
    assert {"command", "commit", "dirty", "date", "versions", "hardware"} <= record.keys()
    open_run(tmp_path, "toy", other)  # nothing came of the first one
    (tmp_path / "metrics.json").touch()
    open_run(tmp_path, "toy", other, adds=True)
    assert (tmp_path / "config_2.json").exists() and (tmp_path / "config_3.json").exists()
    with pytest.raises(UserError, match="holds the results of .*; choose another --out"):
        open_run(tmp_path, "toy", one)
    for _ in range(2):  # the same run again
        open_run(tmp_path / "again", "toy", one)
        (tmp_path / "again" / "metrics.json").touch()
    with pytest.raises(UserError, match="holds the results"):
        open_run(tmp_path / "again", "another", one)


INTERRUPTED = """
import os, signal, sys, time
from touchgoal.launch import list as command
from touchgoal.launch.__main__ import main
from touchgoal.runtime.interruption import on_interruption

number = int(sys.argv[1])

def work(_):
    with on_interruption(lambda: "saved 1 of 2"):
        os.kill(os.getpid(), number)
        time.sleep(5)

command.main = work
main(["list"])
"""


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["Ctrl-C", "SIGTERM"]
)
def test_an_interrupted_command_says_what_was_kept(number: int, code: int) -> None:
    """In a process of its own: libraries that other tests load handle signals, too."""
    command = [sys.executable, "-c", INTERRUPTED, str(int(number))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == code
    assert done.stderr == "\ntouchgoal list: stopped; saved 1 of 2\n"


@pytest.mark.parametrize("buffered", [True, False])
def test_a_reader_who_has_read_enough_is_no_mistake(buffered: bool) -> None:
    """`touchgoal run-policy --help | head -1`: no traceback, and the exit code of a closed pipe."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, *["-u"] * (not buffered), "-m", "touchgoal.launch"]
    env = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    with os.fdopen(writer, "wb") as stdout:
        done = subprocess.run(
            [*command, "run-policy", "--help"], stdout=stdout, stderr=subprocess.PIPE, env=env
        )
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")


def test_sigterm_is_taken_in_the_main_thread_alone() -> None:
    with ThreadPoolExecutor(1) as other:
        other.submit(terminable().__enter__).result()


def test_help_imports_nothing_heavy() -> None:
    modules = [f"touchgoal.launch.{name.replace('-', '_')}" for name in COMMANDS]
    program = f"""
import sys, touchgoal.launch.__main__, touchgoal.launch.support.command_line, {", ".join(modules)}
heavy = {{"torch", "mujoco", "casadi", "numba", "matplotlib", "scipy"}} & set(sys.modules)
assert not heavy, heavy"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_every_option_is_described_and_set_by_a_test_a_page_or_a_recipe() -> None:
    root = Path(__file__).parents[1]
    patterns = ("Makefile", "*.md", "docs/*.md", "tests/**/*.py", "benchmarks/*.sh", "plugins/*.py")
    text = "\n".join(path.read_text() for p in patterns for path in sorted(root.glob(p)))
    typed = {o.replace(".no-", ".") for o in re.findall(r"--(?:no-)?([a-z][\w.-]*\w)", text)}
    fields = set(re.findall(r"\b(\w+)=", text))  # of a Config made in Python
    for command, options in options_by_command().items():
        for option, (owner, field) in options.items():
            assert docstrings(owner).get(field), f"{owner.__name__}.{field} is not described"
            met = option[2:] in typed or field in fields or not option.startswith("--")
            assert met, f"{command} {option}: nobody sets it"


@pytest.mark.parametrize(
    ("shell", "message"),
    [
        ('{python} twin --out ""', "--out is empty: give a value or leave the option out"),
        ("{python} twin --out " + 300 * "x", "--out: cannot write in .*: File name too long"),
        ("ln -s a b; ln -s b a; {python} twin --out a/run", "--out: a is a link that leads now"),
        ("mkdir gone; cd gone; rmdir ../gone; {python} twin", "the working directory is gone"),
        ("{python} repair Käfer <&- >&-", r"K(ä|\\xe4)fer is not a set of episodes"),
    ],
)
def test_an_unfit_surrounding_is_one_line(tmp_path: Path, shell: str, message: str) -> None:
    line = shell.format(python=f"{sys.executable} -m touchgoal.launch")
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(
        ["bash", "-c", line], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 1 and re.search(message, done.stderr), done.stderr
    assert len(done.stderr.splitlines()) == 1 and done.stderr.startswith("touchgoal ")


def test_a_full_disk_names_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from touchgoal.launch import list as command

    def save(_: object) -> None:
        with atomic_write(tmp_path / "weights") as unfinished:
            unfinished.write_bytes(b"half")
            raise RuntimeError("PytorchStreamWriter failed writing file")

    monkeypatch.setattr(command, "main", save)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=0))
    with pytest.raises(SystemExit, match="weights: No space left on device: free some space"):
        main(["list"])
    assert list(tmp_path.iterdir()) == []


def test_two_processes_may_write_one_file_at_once(tmp_path: Path) -> None:
    """Two trainings on the same demonstrations write the same cached embeddings."""
    path = tmp_path / "embedding"
    other = f"""from pathlib import Path; from touchgoal.runtime.atomic_write import write_file
write_file(Path({str(path)!r}), b"theirs")"""
    with atomic_write(path) as unfinished:
        unfinished.write_bytes(b"ours")
        subprocess.run([sys.executable, "-c", other], check=True)
        assert path.read_bytes() == b"theirs"
    assert path.read_bytes() == b"ours" and list(tmp_path.iterdir()) == [path]


def test_one_process_at_a_time_writes_into_a_folder(tmp_path: Path) -> None:
    open_run(tmp_path, "toy", Toy(out=tmp_path))
    line = [sys.executable, "-m", "touchgoal.launch", "twin", "--out", str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    assert f"another command is writing into {tmp_path}: wait for it" in done.stderr
