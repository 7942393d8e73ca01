"""The paper's robot experiment in simulation, on the shipped weights.

A Franka FR3 with a GelSight Mini on each finger picks an object up and places it; the episode
becomes dense cost curves against its goal in image, touch, image+touch, and words.
"""

from dataclasses import dataclass, field
from pathlib import Path

from touchgoal.control.tactile.sensor_models import find_sensor
from touchgoal.encoders import pretrained
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.episodes.media import write_video
from touchgoal.episodes.recording import EpisodeSpec, record_with_film
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.launch.reward_curves import report_all
from touchgoal.launch.run_folder import open_run
from touchgoal.rewards.curves import DistanceNormalizer
from touchgoal.rewards.embedding_distance import EpisodeEmbedder, compute_curves
from touchgoal.rewards.goals import assign_goals, parse_goal
from touchgoal.rewards.report.report import write_report
from touchgoal.sim_envs.config import PickPlaceConfig
from touchgoal.sim_envs.pick_place import PickPlace
from touchgoal.sim_envs.scene.objects import find


@dataclass(frozen=True)
class Config:
    """Options of demo."""

    out: Path | None = None
    """Folder of the run."""
    object: str = "glass_ball"
    """What to pick up: a name of the catalogue."""
    words: str = "a hard smooth round object"
    """How the goal feels."""
    seed: int = 2_000_000
    """Of the episode."""
    env: PickPlaceConfig = field(default_factory=PickPlaceConfig)
    """Options of the task."""


def main(config: Config) -> None:
    """Load the weights first, so that a missing one costs no simulation; then record and judge."""
    find(config.object)
    sensor = find_sensor(config.env.sensor).name
    directory = pretrained.shipped_encoder_for(sensor)
    encoder = pretrained.load_aligned(directory, sensor=sensor)
    scale = DistanceNormalizer.load(directory / "scale.json")
    embedder = EpisodeEmbedder(load_towers(encoder.config.towers), encoder)
    out = open_run(config.out, "demo", config)

    env = PickPlace(config.env)
    demonstration = EpisodeSpec(config.seed, options={"object": config.object})
    episode, frames = record_with_film(env, demonstration)
    env.close()
    write_video(out / "episode.mp4", frames, config.env.control_hz)
    EpisodeWriter(out / "episodes", config.env.control_hz).append(episode)

    embedded = embedder.embed_episode(episode, config.env.control_hz, config.object)
    specs = [parse_goal("last"), parse_goal(f"text:{config.words}")]
    goal = embedder.embed_goal(assign_goals(specs, embedded.modalities), embedded)
    curves = compute_curves(embedded, goal, scale)
    write_report(curves, out, "curves", {"encoder": directory.name, **embedder.space})
    print(f"\n{episode.task}: {episode.meta['outcome']} in {len(episode) - 1} ticks")
    report_all([curves], out)
    print(f"video: {out / 'episode.mp4'}\ncurves: {out / 'curves.png'}")
