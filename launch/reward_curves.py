"""Cost and reward curves of episodes, or of a plain video or folder of frames, towards a goal.

A goal is: last (the last frame), frame:K, image:PATH, episode:ROOT#K (the end of another episode)
or text:SENTENCE (how the object feels). Each modality (image, touch, text) takes the first goal that
speaks for it. The cost is the distance to the goal; rewards are -cost, and gamma * Phi' - Phi with
Phi = -cost (Ng et al. 1999).
"""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from pydantic import Field

from touchgoal.runtime.option_types import checked_dataclass

if TYPE_CHECKING:
    from touchgoal.rewards.curves import Curves


@checked_dataclass
class Config:
    """Options of reward-curves."""

    source: Annotated[Path, tyro.conf.Positional]
    """A set of episodes, a video file, or a folder of pictures."""
    goal: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What to be near; may be given several times. Default: last."""
    index: tuple[int, ...] = ()
    """Which episodes of the set, counted from 0. Default: all."""
    camera: str = "front"
    """Camera of the episodes whose pictures are measured: front or wrist."""
    encoder: str | None = None
    """Touch encoder of any kind: a name (touchgoal list encoders), a folder, or a published Sparsh one.
    Default: the one that ships for the episodes' sensor. Sentences need one that is aligned with texts."""
    towers: str | None = None
    """Image and text networks: offline, or a CLIP (Hugging Face id or folder), which also takes
    sentences as goals of plain videos. Without --encoder, pictures alone are measured with them."""
    normalizer: str | None = None
    """What normalises distances: a normalizer.json of fit-normalizer, or none. Default: the one of the
    encoder's own training episodes, if these are such episodes, else none."""
    gamma: Annotated[float, Field(gt=0, le=1)] = 0.99
    """Discount of the potential-based reward, above 0, at most 1."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Config) -> None:
    """Check, embed, measure, and write a plot, a CSV and a JSON for each trajectory."""
    from touchgoal.rewards.report.report import write_report
    from touchgoal.rewards.setup import prepare
    from touchgoal.rewards.sources import VideoSource, open_source
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.run_folder import open_run

    with_touch = config.towers is None or config.encoder is not None
    source = open_source(config.source, config.camera, config.index, with_touch)
    if isinstance(source, VideoSource):
        print(source.goals_it_takes)
    elif source.path != config.source:
        print(f"{config.source} is no set of episodes; {source.path} is: it is measured")
    goals = config.goal or ("last",)
    setup = prepare(source, goals, config.encoder, config.towers, config.normalizer)
    print(setup.note)
    out = open_run(config.out, "reward-curves", config)
    provenance = asdict(setup.embedder.made_with) | {"normalizer": setup.note}
    measured: list[Curves] = []
    total = len(source.names)
    try:
        for name, curves in track(setup.measure(), "drawing curves of", "trajectory", total=total):
            write_report(curves, out, name, provenance, config.gamma)
            measured.append(curves)
    except KeyboardInterrupt as interruption:
        interruption.add_note(f"{len(measured)} of {total} trajectories are measured, in {out}")
        if measured:
            report_all(measured, out)
        raise
    report_all(measured, out)


def report_all(curves: list["Curves"], out: Path) -> None:
    """Print the table of all curves and write it to metrics.json."""
    from touchgoal.rewards.report.summary import metrics_table
    from touchgoal.runtime.run_folder import write_json

    write_json(
        out / "metrics.json",
        [{"source": c.source, **{k: m.as_dict() for k, m in c.metrics().items()}} for c in curves],
    )
    print(metrics_table(curves))
    print(f"plots, CSV and JSON of each, with costs and rewards: {out}")
