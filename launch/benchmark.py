"""Print one table of measured figures and keep its numbers."""

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from touchgoal.benchmarks import config as options
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import hardware, provenance
from touchgoal.runtime.run_folder import open_run, write_json

BENCHMARKS: dict[str, type[options.BenchmarkOptions]] = {
    "bead-maze": options.BeadMazeOptions,
    "deploy": options.DeployOptions,
    "encoder-speed": options.EncoderSpeedOptions,
    "env-speed": options.EnvSpeedOptions,
    "faults": options.FaultsOptions,
    "motion": options.MotionOptions,
    "policy-delay": options.PolicyDelayOptions,
    "policy-latency": options.PolicyLatencyOptions,
    "real-touch": options.RealTouchOptions,
    "replay": options.ReplayOptions,
    "reward-quality": options.RewardQualityOptions,
    "sent-stream": options.SentStreamOptions,
    "tacbench": options.TacbenchOptions,
    "tactile-realism": options.TactileRealismOptions,
    "tactile-speed": options.TactileSpeedOptions,
    "task-ceilings": options.TaskCeilingsOptions,
    "touch-probes": options.TouchProbesOptions,
}
IN_FOLDERS = {"tacbench": "tacbench.benchmark"}
RESULTS = Path(__file__).resolve().parents[1] / "benchmarks" / "results"

Config = (
    Annotated[options.BeadMazeOptions, tyro.conf.subcommand("bead-maze")]
    | Annotated[options.DeployOptions, tyro.conf.subcommand("deploy")]
    | Annotated[options.EncoderSpeedOptions, tyro.conf.subcommand("encoder-speed")]
    | Annotated[options.EnvSpeedOptions, tyro.conf.subcommand("env-speed")]
    | Annotated[options.FaultsOptions, tyro.conf.subcommand("faults")]
    | Annotated[options.MotionOptions, tyro.conf.subcommand("motion")]
    | Annotated[options.PolicyDelayOptions, tyro.conf.subcommand("policy-delay")]
    | Annotated[options.PolicyLatencyOptions, tyro.conf.subcommand("policy-latency")]
    | Annotated[options.RealTouchOptions, tyro.conf.subcommand("real-touch")]
    | Annotated[options.ReplayOptions, tyro.conf.subcommand("replay")]
    | Annotated[options.RewardQualityOptions, tyro.conf.subcommand("reward-quality")]
    | Annotated[options.SentStreamOptions, tyro.conf.subcommand("sent-stream")]
    | Annotated[options.TacbenchOptions, tyro.conf.subcommand("tacbench")]
    | Annotated[options.TactileRealismOptions, tyro.conf.subcommand("tactile-realism")]
    | Annotated[options.TactileSpeedOptions, tyro.conf.subcommand("tactile-speed")]
    | Annotated[options.TaskCeilingsOptions, tyro.conf.subcommand("task-ceilings")]
    | Annotated[options.TouchProbesOptions, tyro.conf.subcommand("touch-probes")]
)


def main(config: options.BenchmarkOptions) -> None:
    """Run the chosen benchmark."""
    name = next(name for name, kind in BENCHMARKS.items() if type(config) is kind)
    if config.save_result and not (RESULTS.parents[1] / "pyproject.toml").exists():
        raise UserError("--save-result writes into a checkout, and this is an installed package")
    module = IN_FOLDERS.get(name, name.replace("-", "_"))
    benchmark = importlib.import_module(f"touchgoal.benchmarks.{module}")
    out = open_run(config.out, f"benchmark-{name}", config)
    result = benchmark.run(replace(config, out=out))
    print(result.pop("table"))
    pictures = result.pop("pictures", {})
    if "picture" in result:
        pictures["picture"] = result.pop("picture")
    for title, picture in pictures.items():
        _draw(picture, out / f"{title}.png")
    print(f"hardware: {hardware()}")
    result = {**provenance(), "hardware": hardware(), **result}
    write_json(out / "metrics.json", result)
    print(f"numbers: {out / 'metrics.json'}")
    if config.save_result:
        RESULTS.mkdir(exist_ok=True)
        write_json(RESULTS / f"{name}.json", result)
        print(f"to be committed: {RESULTS / f'{name}.json'}")


def _draw(picture: Any, path: Path) -> None:
    import cv2

    cv2.imwrite(str(path), picture[..., ::-1])
    print(f"picture: {path}")
