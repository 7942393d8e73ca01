"""The `touchgoal` command: `touchgoal COMMAND --help`."""

import importlib
import sys

import tyro

from touchgoal.control.errors import UserError

COMMANDS = {
    "demo": "the main job, end to end, on the shipped weights",
    "doctor": "what this machine can do, and how to mend what is missing",
    "collect-demos": "record expert episodes of a task, or failures to order",
    "teleop": "lead the bead along a wire with keys, and record it",
    "train-encoder": "train a touch encoder",
    "train-estimators": "train what reads contact in touch and a scene in pictures",
    "train-policy": "train a policy on recorded episodes",
    "train-policy-paper": "the same with the published network, sampler and actions",
    "run-policy": "run a policy in a task: success rate, video",
    "reward-curves": "dense cost and reward curves for episodes or plain videos",
    "calibrate": "fit a sensor's light and gel to ball presses",
    "deploy": "run a policy on an arm or on the twin, with safety and recording",
    "twin": "serve the simulated cell over the wire protocols of real ones",
    "repair": "check a set of episodes and mend what an interruption left",
    "benchmark": "print one table of measured figures",
}


def usage() -> str:
    """What `touchgoal --help` prints."""
    lines = [f"  {name:<20}{meaning}" for name, meaning in COMMANDS.items()]
    return "usage: touchgoal COMMAND [options]\n\ncommands:\n" + "\n".join(lines)


def main(argv: list[str] | None = None) -> None:
    """Run one command; a user's mistake is one line on stderr and exit code 1."""
    arguments = sys.argv[1:] if argv is None else argv
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return
    name, *rest = arguments
    if name not in COMMANDS:
        sys.exit(f"touchgoal: there is no command {name!r}\n\n{usage()}")
    try:
        module = importlib.import_module(f"touchgoal.launch.{name.replace('-', '_')}")
        config = tyro.cli(
            module.Config, args=rest, prog=f"touchgoal {name}", description=module.__doc__
        )
        module.main(config)
    except UserError as error:
        sys.exit(f"touchgoal {name}: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
