"""Annotate VisGel's recordings: which object is touched, and a caption for every object in view."""

from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.encoders.annotation.config import AnnotationSettings
from touchgoal.runtime.option_types import checked_dataclass


@checked_dataclass
class _Source:
    """Recordings to annotate, and networks to use."""

    source: Annotated[Path, tyro.conf.Positional]
    """List of VisGel, such as data_lst/train_touch2vision.txt."""
    root: Path | None = None
    """Folder that the list's paths are relative to. Default: the one that holds the list's folder."""
    detector: str = "IDEA-Research/grounding-dino-tiny"
    """Grounding DINO, as Hugging Face id or local folder."""
    captioner: str = "Salesforce/blip2-opt-2.7b"
    """BLIP-2, as Hugging Face id or local folder."""
    device: str = "cpu"
    """Torch device of both: cpu, cuda or cuda:1."""
    out: Path | None = None
    """Folder of the run, with annotations.jsonl and left_out.jsonl. Recordings listed there are skipped,
    so the same command continues an interrupted run."""


@checked_dataclass
class Config(AnnotationSettings, _Source):
    """Options of annotate."""


def main(config: Config) -> None:
    """Annotate the missing recordings, and print what could not be annotated and why."""
    from touchgoal.encoders.annotation.annotate import ANNOTATIONS, annotate_all
    from touchgoal.encoders.annotation.models import PretrainedModels
    from touchgoal.encoders.training.trainer import check_device
    from touchgoal.episodes.importers.visgel import find_root, read_visgel_list
    from touchgoal.runtime.interruption import on_interruption
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.run_folder import open_run

    check_device(config.device)
    recordings = read_visgel_list(config.source)
    root = find_root(config.source, config.root, recordings[0])
    models = PretrainedModels(config.detector, config.captioner, config.device)
    out = open_run(config.out, "annotate", config, adds=True)
    with on_interruption(
        lambda: f"finished recordings are in {out}; the same command with --out {out} continues"
    ):
        metrics = annotate_all(recordings, root, models, config, out)
    write_json(out / "metrics.json", metrics)
    print(f"{metrics['annotated']} of {metrics['recordings']} recordings annotated, ", end="")
    print(f"{metrics['instances']} objects with captions")
    for title in ("left_out", "dropped"):
        for reason, count in metrics[title].items():
            print(f"  {title.replace('_', ' ')} {count:>6}  {reason}")
    if metrics["annotated"]:
        lines = out / ANNOTATIONS
        print(f"next: touchgoal train-encoder align --data {lines} --validation OTHER.jsonl")
