"""Dense cost curves of episodes, or of a plain video or folder of frames, towards a goal.

A goal is: last (the last frame), frame:K, image:PATH, episode:ROOT#K (the end of another episode)
or text:SENTENCE (how the object feels). Each modality takes the first goal that speaks for it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from touchgoal.control.errors import UserError
from touchgoal.control.features import CONTROL_HZ, FRONT
from touchgoal.encoders import pretrained
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.media import read_frames
from touchgoal.episodes.metadata import INFO
from touchgoal.episodes.store import EpisodeSet
from touchgoal.launch.run_folder import open_run, write_json
from touchgoal.rewards.curves import Curves, DistanceNormalizer
from touchgoal.rewards.embedding_distance import EmbeddedEpisode, EpisodeEmbedder, compute_curves
from touchgoal.rewards.goals import assign_goals, parse_goal
from touchgoal.rewards.report.report import write_report
from touchgoal.rewards.report.summary import metrics_table


@dataclass(frozen=True)
class Config:
    """Options of reward-curves."""

    source: Annotated[Path, tyro.conf.Positional]
    """A set of episodes, a video file, or a folder of frames."""
    goal: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """What to be near; may be given several times. Default: last."""
    episodes: tuple[int, ...] = ()
    """Which episodes of the set; default: all."""
    encoder: Path | None = None
    """Folder of the touch encoder; default: the one that ships for the episodes' sensor."""
    camera: str = FRONT
    """Which camera's pictures are measured."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Config) -> None:
    """Embed, measure, and write a plot, a CSV and a JSON for each episode."""
    specs = [parse_goal(text) for text in config.goal or ("last",)]
    sources = _open(config)
    directory = config.encoder or pretrained.shipped_encoder_for(sources.sensor)
    encoder = pretrained.load_aligned(directory, sensor=sources.sensor)
    scale = DistanceNormalizer.load(directory / "scale.json")
    embedder = EpisodeEmbedder(load_towers(encoder.config.towers), encoder, config.camera)
    out, curves = None, []
    for name, index in tqdm(sources.items, desc="curves", unit="episode"):
        embedded = sources.embed(embedder, index)
        goal = embedder.embed_goal(assign_goals(specs, embedded.modalities), embedded)
        measured = compute_curves(embedded, goal, scale)
        out = out or open_run(config.out, "reward-curves", config)
        write_report(measured, out, name, {"encoder": str(directory), **embedder.space})
        curves.append(measured)
    assert out is not None  # a source has at least one item
    report_all(curves, out)


def report_all(curves: list[Curves], out: Path) -> None:
    """Print the table of all curves and write it to metrics.json."""
    write_json(
        out / "metrics.json",
        [{"source": c.source, **{k: m.as_dict() for k, m in c.metrics().items()}} for c in curves],
    )
    print(metrics_table(curves))
    print(f"plots, CSV and JSON of each: {out}")


@dataclass(frozen=True)
class Sources:
    """What to measure.

    Attributes:
        items: name of the report and index of each episode; a plain video is one item.
        sensor: of the episodes' fingertips, None if unknown.
    """

    config: Config
    items: list[tuple[str, int]]
    sensor: str | None
    episodes: EpisodeSet | None

    def embed(self, embedder: EpisodeEmbedder, index: int) -> EmbeddedEpisode:
        """Embed one item."""
        source = self.config.source
        if self.episodes is None:
            frames, fps = read_frames(source)
            return embedder.embed_video(frames, fps or CONTROL_HZ, source.name)
        episode = self.episodes.read(index)
        return embedder.embed_episode(episode, self.episodes.fps, f"{source.name}#{index}")


def _open(config: Config) -> Sources:
    source = config.source
    if not source.exists():
        raise UserError(f"{source} does not exist; give a set of episodes, a video or a folder")
    if source.is_file() or not (source / INFO).exists():
        if config.episodes:
            raise UserError(f"{source} is no set of episodes; leave --episodes out")
        return Sources(config, [(source.stem or "video", 0)], None, None)
    episodes = EpisodeSet(source)
    for i in config.episodes:
        if not 0 <= i < len(episodes):
            raise UserError(f"{source} has no episode {i}; it has 0 to {len(episodes) - 1}")
    chosen = list(config.episodes or range(len(episodes)))
    if not chosen:
        raise UserError(f"{source} has no episodes")
    for i in chosen:  # a damaged file is found now, before the work, not after half of it
        episodes.read(i, [next(iter(episodes.features))], [0])
    sensors = {str(episodes.meta(i)["sensor"]) for i in chosen if "sensor" in episodes.meta(i)}
    if len(sensors) > 1:
        raise UserError(
            f"{source} mixes the sensors {', '.join(sorted(sensors))}; choose --episodes"
        )
    items = [(f"episode_{i:03d}", i) for i in chosen]
    return Sources(config, items, next(iter(sensors), None), episodes)
