"""Cost and reward curves of episodes, or of plain videos or folders of images, towards a goal.

A goal is: last (the last frame), frame:K, image:PATH, episode:ROOT#K (the end of another episode),
text:SENTENCE (how the object feels) or force:N (newtons on a fingertip, 3.5 for example). Each
modality (image, touch, text, force) takes the first goal that applies to it. The cost is the distance
to the goal; rewards are -cost, and its fall from frame to frame (Ng et al. 1999). Embeddings of a set
are kept inside it: another goal takes seconds.

What is broken is skipped and listed in skipped.csv; the exit status is 1 only if nothing could be
measured. The same command with the same --out continues an interrupted run.
"""

from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from touchgoal.runtime.option_types import RARE, CountOrNone, Positive, checked_dataclass


@checked_dataclass
class Config:
    """Options of reward-curves."""

    source: Annotated[Path, tyro.conf.Positional]
    """A set of episodes; a video file, with NAME_tactile_left.mp4 and so on beside it; a folder of images;
    or a folder of several of them."""
    goal: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Goal to measure the distance to; may be given several times. Default: last; where failures are
    among the episodes, the nearest end of the other successes with the same object."""
    index: tuple[int, ...] = ()
    """Episodes of the set to measure, counted from 0. Default: all."""
    camera: str = "front"
    """Camera of the episodes, such as front, wrist or a LeRobot set's top; or of videos whose name does
    not say it: front or wrist."""
    keys: Annotated[tuple[str, ...], RARE] = ()
    """Keys of a LeRobot set whose features have other names: STORED=KEY, such as
    observation.images.top=observation.images.front."""
    fps: Positive | None = None
    """Frames per second of folders of images. Default: 20."""
    background: tuple[Path, ...] = ()
    """Clip (or image, which shows no noise) of each fingertip untouched, left before right, for videos
    that do not begin so. Default: their first frames."""
    encoder: str | None = None
    """Touch encoder: a name (touchgoal list encoders), a folder, or a published Sparsh one. Default:
    the one that ships for the episodes' sensor. Sentences need one that is aligned with texts."""
    towers: str | None = None
    """Image and text networks: offline, or a CLIP (Hugging Face id or folder), which also compares
    images with sentences. If given without --encoder, only images are measured."""
    normalizer: str | None = None
    """Normalizer of the distances: a normalizer.json of fit-normalizer; encoder, the one that comes
    with the encoder; or none. Default: the encoder's one for simulated pick-and-place, else none."""
    plain: bool = False
    """Measure plain distances of image, touch and text in place of the parts of the cost."""
    plots: CountOrNone = 100
    """Number of trajectories, from the first, that get a plot of their own."""
    ray: str | None = None
    """Address of a Ray cluster whose cores embed trajectories side by side, in place of this process;
    auto: the one started on this machine."""
    device: str = "cpu"
    """Torch device of the encoders: cpu, cuda or cuda:1."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Config) -> None:
    """Check, measure what is not measured yet, and write the reports."""
    from touchgoal.episodes.keys import parse_keys
    from touchgoal.rewards.goals import EpisodeEnds, OwnFrame, parse_goal
    from touchgoal.rewards.measure import Measurement, embed_here, embed_on_ray, write_skipped
    from touchgoal.rewards.report.frame_table import FRAMES
    from touchgoal.rewards.report.page import PAGE
    from touchgoal.rewards.report.report import report_all
    from touchgoal.rewards.reward import Reward
    from touchgoal.rewards.sources.open_source import open_source
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.interruption import on_interruption
    from touchgoal.runtime.run_folder import open_run

    if config.ray is not None and config.device != "cpu":
        raise UserError("--ray works on the cores of a cluster: leave out --device")
    keys = parse_keys(config.keys)
    reward = Reward(
        [parse_goal(text, keys) for text in config.goal],
        encoder=config.encoder,
        towers=config.towers,
        normalizer=config.normalizer,
        plain=config.plain,
        device=config.device,
    )
    with_touch = config.towers is None or config.encoder is not None
    named = config.source, config.camera, config.index
    source = open_source(*named, with_touch, config.fps, keys, config.background)
    notices = [source.summary] if source.summary else []
    rewards = reward.prepare_source(source)
    specs = [spec for one in rewards.values() for spec in one.goals.values()]
    if not config.goal and any(isinstance(spec, EpisodeEnds) for spec in specs):
        notices.append(
            "failures are among the episodes: the goal is the nearest end of other successes"
        )
    elif OwnFrame() in specs and any(t.meta.get("success") is False for t in source.trajectories):
        notices.append(
            "failures are among the trajectories; with goal last they end at cost 0, too"
        )
    first = rewards[source.trajectories[0].name]
    out = open_run(config.out, "reward-curves", config)
    print("\n".join([*notices, first.note]))
    measurement = Measurement(source.trajectories, rewards, out, config.plots)
    embed = partial(embed_here, embedder=first.embedder)
    if config.ray is not None:
        encoders = source.inputs, config.encoder, config.towers, first.embedder.parts
        embed = partial(embed_on_ray, address=config.ray, encoders=encoders)
    total = len(source.trajectories) + len(source.skipped)
    if done := len(measurement.records):
        print(f"{done:,} of {total:,} trajectories are measured in {out}")
    rest = f"{total} trajectories are measured; the same command with --out {out} continues"
    with on_interruption(lambda: f"{len(measurement.records)} of {rest}"):
        speed = measurement.run(embed)
    skipped = [*source.skipped, *measurement.skipped]
    summary = write_skipped(skipped, total, out)
    if not measurement.records:
        raise UserError(f"nothing could be measured: {skipped[0].reason}")
    unfit = report_all(measurement.records, out, first.provenance())
    print(f"{summary}; {speed}")
    print(unfit or f"next: look at {out / PAGE}; train on {out / FRAMES}")
