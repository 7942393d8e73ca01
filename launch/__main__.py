"""The `touchgoal` command: `touchgoal COMMAND --help`."""

import importlib
import os
import sys
from difflib import get_close_matches
from typing import Any

from touchgoal.launch.support.process import run_command, standard_streams
from touchgoal.runtime.run_folder import check_writable
from touchgoal.runtime.version import __version__

COMMANDS = {
    "demo": "pick an object up and place it in simulation, and draw its distance to the goal",
    "doctor": "what this machine can do, and how to install what is missing",
    "list": "objects, sensors, tasks, policies and encoders by name",
    "collect-demos": "record an expert's episodes of a task, or failures on purpose",
    "collect-touches": "record touches of objects: the MMWand data set, or slides to learn from without labels",
    "record-demos": "lead an arm or the twin by SpaceMouse or keys, and record demonstrations",
    "import-demos": "make a set of episodes of HDF5, ROS bags, or videos with a table",
    "annotate": "find and caption the objects that VisGel's recordings touch",
    "train-encoder": "train a touch encoder",
    "train-pose-estimator": "train the network that finds object and goal in a camera image",
    "train-policy": "train a policy on recorded episodes",
    "improve": "a policy runs, a judge labels, it learns from what was accepted, round after round",
    "run-policy": "run a policy in a task: success rate, video",
    "reward-curves": "costs and rewards along episodes or plain videos",
    "fit-normalizer": "fit the normalizer of reward-curves on successful episodes of your own",
    "judge": "tell success from failure by a judge of fit-normalizer, and correct it",
    "record-presses": "record presses of a ball all over a sensor's gel, and calibrate from them",
    "check-sensor": "try a sensor on your own frames: noise, drift, contact, depth, force, markers",
    "calibrate": "fit a sensor's light and gel to presses of a ball",
    "calibrate-camera": "measure where a camera is, by a printed board",
    "deploy": "run a policy on an arm or on the twin, with safety and recording",
    "arm": "move an arm home, open or close its hand, recover it after a fault",
    "twin": "serve the simulated cell over the wire protocols of real ones",
    "push": "upload an encoder or a policy to the Hugging Face Hub",
    "pull": "download one from the Hugging Face Hub and check it",
    "report": "pack what a bug report needs of a run into one file",
    "repair": "check a set of episodes and mend what an interruption left",
}


def usage() -> str:
    """Return the text of `touchgoal --help`."""
    lines = [f"  {name:<22}{meaning}" for name, meaning in COMMANDS.items()]
    return (
        "usage: touchgoal COMMAND [options]\n       touchgoal COMMAND --help\n"
        "       touchgoal COMMAND [options] --traceback    the whole traceback of a mistake\n"
        "       touchgoal --version\n\ncommands:\n" + "\n".join(lines)
    )


def main(argv: list[str] | None = None) -> None:
    """Run one command.

    Exit status: see `run_command`; 141 where the reader of stdout has gone (`touchgoal list | head -1`).
    """
    if argv is None:  # this process is the command: OpenCV reads the variable when it is imported
        # s until a silent V4L2 camera is given up; the default, 10, delays its reopening.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
    with standard_streams():
        _main(sys.argv[1:] if argv is None else argv)


def _main(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage())
    elif arguments[0] in ("-V", "--version", "version"):
        print(f"touchgoal {__version__}")
    elif arguments[0] not in COMMANDS:
        sys.exit(_unknown(arguments[0]))
    else:
        run_command("touchgoal", arguments, _run)


def _run(name: str, *options: str) -> None:
    module, config = read_options(name, list(options))
    module.main(config)


def read_options(name: str, options: list[str]) -> tuple[Any, Any]:
    """Return a command's module and its checked Config."""
    from touchgoal.launch.support.command_line import parse

    module = importlib.import_module(f"touchgoal.launch.{name.replace('-', '_')}")
    envs = getattr(module, "ENVS", None)
    config = parse(module.Config, options, f"touchgoal {name}", module.__doc__ or "", envs)
    if hasattr(config, "out"):
        check_writable(config.out)
    return module, config


def _unknown(name: str) -> str:
    families = {command.split("-")[0] for command in COMMANDS}  # such as train, of train-policy
    close = get_close_matches(name, [*COMMANDS, *families], 1, cutoff=0.7)
    meant = [command for command in COMMANDS if close and command.startswith(close[0])]
    if meant:
        return f"touchgoal: there is no command {name!r}; did you mean {' or '.join(meant)}?"
    return f"touchgoal: there is no command {name!r}\n\n{usage()}"


if __name__ == "__main__":
    main()
