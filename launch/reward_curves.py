"""Cost and reward curves of episodes, or of a plain video or folder of images, towards a goal.

A goal is: last (the last frame), frame:K, image:PATH, episode:ROOT#K (the end of another episode)
or text:SENTENCE (how the object feels). Each modality (image, touch, text) takes the first goal that
applies to it. The cost is the distance to the goal; rewards are -cost, and gamma * Phi' - Phi with
Phi = -cost (Ng et al. 1999).
"""

from pathlib import Path
from typing import Annotated

import tyro
from pydantic import Field

from touchgoal.runtime.option_types import Positive, checked_dataclass


@checked_dataclass
class Config:
    """Options of reward-curves."""

    source: Annotated[Path, tyro.conf.Positional]
    """A set of episodes, a video file, or a folder of images."""
    goal: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Goal to measure the distance to; may be given several times. Default: last."""
    index: tuple[int, ...] = ()
    """Episodes of the set to measure, counted from 0. Default: all."""
    camera: str = "front"
    """Camera of the episodes: front or wrist."""
    fps: Positive | None = None
    """Frames per second of a folder of images. Default: 20."""
    encoder: str | None = None
    """Touch encoder: a name (touchgoal list encoders), a folder, or a published Sparsh one. Default:
    the one that ships for the episodes' sensor. Sentences need one that is aligned with texts."""
    towers: str | None = None
    """Image and text networks: offline, or a CLIP (Hugging Face id or folder), which also compares
    images with sentences. Without --encoder, only images are measured with them."""
    normalizer: str | None = None
    """What normalises the distances: a normalizer.json of fit-normalizer; encoder, the one that comes
    with the encoder; or none. Default: the encoder's one for simulated pick-and-place, else none."""
    gamma: Annotated[float, Field(gt=0, le=1)] = 0.99
    """Discount factor of the potential-based reward gamma * Phi' - Phi, in (0, 1]. Set it to the
    discount factor of the RL algorithm that uses the reward."""
    device: str = "cpu"
    """Torch device of the encoders: cpu, cuda or cuda:1."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Config) -> None:
    """Check, embed, measure, and write a plot, a CSV and a JSON for each trajectory."""
    from touchgoal.rewards.goals import parse_goal
    from touchgoal.rewards.report.report import report_all, write_report
    from touchgoal.rewards.reward_model import load_reward_model
    from touchgoal.rewards.sources import VideoSource, open_source
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.run_folder import open_run

    with_touch = config.towers is None or config.encoder is not None
    source = open_source(config.source, config.camera, config.index, with_touch, config.fps)
    if isinstance(source, VideoSource):
        print(source.summary)
    elif source.path != config.source:
        print(f"{config.source} is not a set of episodes; measuring the set {source.path}")
    goals = [parse_goal(text) for text in config.goal or ("last",)]
    model = load_reward_model(
        source.inputs, goals, config.encoder, config.towers, config.normalizer, config.device
    )
    print(model.note)
    out = open_run(config.out, "reward-curves", config)
    measured = []
    total = len(source.names)
    trajectories = track(source.embed(model.embedder), "measuring", "trajectory", total=total)
    try:
        for name, trajectory in zip(source.names, trajectories, strict=True):
            curves = model.curves(trajectory)
            write_report(curves, out, name, model.provenance(), config.gamma)
            measured.append(curves)
    except KeyboardInterrupt as interruption:
        interruption.add_note(f"{len(measured)} of {total} trajectories are measured, in {out}")
        if measured:
            report_all(measured, out)
        raise
    report_all(measured, out)
    print(f"next: plots are in {out}/*.png; train on the reward_ columns of {out}/*.csv")
