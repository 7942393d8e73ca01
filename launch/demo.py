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
from touchgoal.episodes.recording import Demonstration, demonstrate_on_film
from touchgoal.episodes.store import EpisodeWriter
from touchgoal.launch.reward_curves import summarise
from touchgoal.launch.run_folder import open_run
from touchgoal.rewards.curves import Scale
from touchgoal.rewards.embedding_distance import EpisodeEmbedder, measure
from touchgoal.rewards.goals import choose_goal, parse_goal
from touchgoal.rewards.report.report import write_report
from touchgoal.sim_envs.pick_place import PickPlace, PickPlaceConfig
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
    sensor = find_sensor(config.env.scene.sensor).name
    directory = pretrained.shipped_for(sensor)
    encoder = pretrained.load(directory, sensor=sensor)
    scale = Scale.load(directory / "scale.json")
    embedder = EpisodeEmbedder(load_towers(encoder.config.towers), encoder)
    out = open_run(config.out, "demo", config)

    env = PickPlace(config.env)
    demonstration = Demonstration(config.seed, options={"object": config.object})
    episode, frames = demonstrate_on_film(env, demonstration)
    env.close()
    write_video(out / "episode.mp4", frames, config.env.control_hz)
    EpisodeWriter(out / "episodes", config.env.control_hz).append(episode)

    embedded = embedder.embed_episode(episode, config.env.control_hz, config.object)
    specs = [parse_goal("last"), parse_goal(f"text:{config.words}")]
    goal = embedder.embed_goal(choose_goal(specs, embedded.modalities), embedded)
    curves = measure(embedded, goal, scale)
    write_report(curves, out, "curves", {"encoder": directory.name, **embedder.space})
    print(f"\n{episode.task}: {episode.meta['outcome']} in {len(episode) - 1} ticks")
    summarise([curves], out)
    print(f"video: {out / 'episode.mp4'}\ncurves: {out / 'curves.png'}")
