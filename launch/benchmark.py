"""Print one table of measured figures and keep its numbers."""

import platform
from typing import Annotated, Any

import cv2
import tyro

from touchgoal.benchmarks import (
    bead_maze,
    env_speed,
    faults,
    motion,
    policy_latency,
    reward_quality,
    tactile_realism,
    tactile_speed,
)
from touchgoal.launch.run_folder import open_run, write_json

BENCHMARKS: dict[type, Any] = {
    module.Config: module
    for module in (
        bead_maze,
        env_speed,
        faults,
        motion,
        policy_latency,
        reward_quality,
        tactile_realism,
        tactile_speed,
    )
}
Config = (
    Annotated[bead_maze.Config, tyro.conf.subcommand("bead-maze")]
    | Annotated[env_speed.Config, tyro.conf.subcommand("env-speed")]
    | Annotated[faults.Config, tyro.conf.subcommand("faults")]
    | Annotated[motion.Config, tyro.conf.subcommand("motion")]
    | Annotated[policy_latency.Config, tyro.conf.subcommand("policy-latency")]
    | Annotated[reward_quality.Config, tyro.conf.subcommand("reward-quality")]
    | Annotated[tactile_realism.Config, tyro.conf.subcommand("tactile-realism")]
    | Annotated[tactile_speed.Config, tyro.conf.subcommand("tactile-speed")]
)


def main(config: Any) -> None:
    """Run the chosen benchmark."""
    benchmark = BENCHMARKS[type(config)]
    name = benchmark.__name__.rsplit(".", 1)[-1].replace("_", "-")
    out = open_run(config.out, f"benchmark-{name}", config)
    result = benchmark.run(config)
    print(result.pop("table"))
    if "picture" in result:
        cv2.imwrite(str(out / "picture.png"), result.pop("picture")[..., ::-1])
        print(f"picture: {out / 'picture.png'}")
    print(f"hardware: {hardware()}")
    write_json(out / "metrics.json", {**result, "hardware": hardware()})
    print(f"numbers: {out / 'metrics.json'}")


def hardware() -> str:
    """Processor of this machine."""
    model = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            names = [
                line.split(":", 1)[1].strip() for line in file if line.startswith("model name")
            ]
    except FileNotFoundError:
        return model
    return f"{len(names)} cores, {names[0]}" if names else model
