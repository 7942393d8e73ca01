"""Print one table of measured figures and keep its numbers: `python -m benchmarks NAME [options]`."""

import sys
from importlib import import_module
from typing import Any

from benchmarks.records import describe, records_of
from touchgoal.launch.support.command_line import parse
from touchgoal.launch.support.process import run_command, standard_streams
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.image_file import write_image
from touchgoal.runtime.json_file import write_json
from touchgoal.runtime.provenance import hardware, provenance
from touchgoal.runtime.run_folder import check_writable, open_run

PROGRAM = "python -m benchmarks"

BENCHMARKS = {
    "bead-maze": ("papers.bead_maze", "bead maze: success on unseen wires (TacBench T5)"),
    "fragile-carry": (
        "papers.fragile_carry",
        "a rod that slips or breaks: success by what the policy reads",
    ),
    "retrieval": (
        "papers.mmwand.retrieval",
        "touch, pictures and sentences find each other (MMWand IV)",
    ),
    "classification": (
        "papers.mmwand.classification",
        "objects named by touch and sight (MMWand II)",
    ),
    "zero-shot": (
        "papers.mmwand.real.zero_shot",
        "materials of real objects by sentences (MMWand III)",
    ),
    "reward-quality": (
        "papers.reward_quality.benchmark",
        "dense costs against outcomes (MMWand V-E)",
    ),
    "reward-judge": (
        "papers.reward_judge",
        "success told from failure in runs of other hands than the fitted one",
    ),
    "reward-use": ("papers.reward_use", "learning from the demonstrations that a reward accepts"),
    "improve": ("papers.improve", "a policy improved by its own runs, by what accepts them"),
    "improve-carry": (
        "papers.improve_carry",
        "fragile-carry improved by runs that a judge accepts",
    ),
    "grip-search": ("papers.grip_search", "grip force found by trial where a crush is not seen"),
    "shaping": ("papers.shaping", "SAC by a sparse reward, and shaped by the cost"),
    "tacbench": ("papers.tacbench.benchmark", "force, slip, pose, grasp, cloth from frozen touch"),
    "real-touch": ("real_touch.videos", "encoders on labelled videos of real touch"),
    "real-words": ("real_touch.words", "hardness, roughness and bumpiness named by sentences"),
    "real-force": ("real_touch.forces", "force and contact on real grasps with a load cell"),
    "real-slip": ("real_touch.slip", "slip told on real grasps, objects held out"),
    "real-markers": ("real_touch.markers", "gel dots of real images against another tracker"),
    "touch-spectrum": (
        "real_touch.touch_spectrum",
        "sharpness of simulated touch beside real sensors",
    ),
    "tactile-realism": ("real_touch.tactile_realism", "simulated against real presses of a ball"),
    "deploy": ("deployment.deploy", "success through the environment, in process and on the wire"),
    "deploy-judged": (
        "deployment.judged",
        "verdicts of a judge on deployments without a simulator's",
    ),
    "first-look": (
        "deployment.first_look",
        "what pick-and-place finds under changes of camera, table and light",
    ),
    "faults": ("deployment.faults", "what a deployment does under every fault"),
    "policy-delay": ("deployment.policy_delay", "success under delays"),
    "own-task": ("deployment.own_task", "a task known by demonstrations alone: success by sight"),
    "audit": ("deployment.audit", "success with touch removed, shuffled, or of another fingertip"),
    "robustness": ("deployment.robustness", "success under changes that training has not shown"),
    "encoder-speed": ("speed.encoder_speed", "touch embeddings a second"),
    "env-speed": ("speed.env_speed", "steps of the environment a second"),
    "large-sets": (
        "speed.large_sets",
        "opening, joining and going through sets of a million episodes",
    ),
    "loader-speed": ("speed.loader_speed", "training samples a second, beside lerobot's loader"),
    "policy-latency": ("speed.policy_latency", "time of a plan, stage by stage"),
    "scaling": ("speed.scaling", "episodes a second against Ray workers, beside a model"),
    "tactile-speed": ("speed.tactile_speed", "simulated tactile images a second"),
}
"""Module in `benchmarks` and meaning of each benchmark."""


def main(argv: list[str] | None = None) -> None:
    """Run one benchmark, or print what is on record of it with `--recorded`."""
    arguments = sys.argv[1:] if argv is None else argv
    with standard_streams():
        if not arguments or arguments[0] in ("-h", "--help"):
            print(_usage())
        else:
            run_command(PROGRAM, arguments, _run)


def _run(name: str, *options: str) -> None:
    if "--recorded" in options:
        print("\n\n".join(describe(record) for record in records_of(name)))
        return
    benchmark, config = read_options(name, list(options))
    out = open_run(config.out, f"benchmark-{name}", config)
    result = benchmark.run(config)
    print(result.pop("table"))
    for title, image in result.pop("pictures", {}).items():
        write_image(out / f"{title}.png", image)
        print(f"picture: {out / title}.png")
    print(f"hardware: {hardware()}")
    write_json(out / "metrics.json", {**provenance(), "hardware": hardware(), **result})
    print(f"numbers: {out / 'metrics.json'}; the record: {PROGRAM} {name} --recorded")


def read_options(name: str, options: list[str]) -> tuple[Any, Any]:
    """Return a benchmark's module and its checked Config; UserError if there is no such benchmark."""
    if name not in BENCHMARKS:
        raise UserError(f"there is no benchmark {name!r}; choose from: {', '.join(BENCHMARKS)}")
    module: Any = import_module(f"benchmarks.{BENCHMARKS[name][0]}")
    envs = getattr(module, "ENVS", None)
    config = parse(module.Config, options, f"{PROGRAM} {name}", module.__doc__ or "", envs)
    check_writable(config.out)
    return module, config


def _usage() -> str:
    lines = [f"  {name:<17}{meaning}" for name, (_, meaning) in BENCHMARKS.items()]
    return (
        f"usage: {PROGRAM} NAME [options]\n       {PROGRAM} NAME --help\n"
        f"       {PROGRAM} NAME --recorded   (print the table on record)\n\n" + "\n".join(lines)
    )


if __name__ == "__main__":
    main()
