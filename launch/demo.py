"""The MMWand paper's robot experiment in simulation, on the shipped weights.

A Franka FR3 with a GelSight Mini on each finger picks an object up and places it. The distance to the
goal is drawn along the episode: in the camera's image, in touch, in both, and towards a sentence.
"""

from dataclasses import asdict
from pathlib import Path

from touchgoal.control.features import FRONT, IMAGE_PREFIX
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Seed, checked_dataclass
from touchgoal.sim_envs.config import PickPlaceConfig


@checked_dataclass
class Config:
    """Options of demo."""

    out: Path | None = None
    """Folder of the run; default: runs/<date>_demo."""
    words: str = "a hard smooth round object"
    """Sentence that says how the object feels: the goal in words."""
    seed: Seed = seeds.DEMO.start
    """Random seed of the episode."""
    env: PickPlaceConfig = PickPlaceConfig(objects=("glass_ball",))
    """Options of the task; --env.objects names what to pick up."""

    def __post_init__(self) -> None:
        """Refuse what leaves nothing to measure."""
        if not self.env.tactile or FRONT.removeprefix(IMAGE_PREFIX) not in self.env.cameras:
            raise UserError("the demo measures touch and the front camera: leave both on")


def main(config: Config) -> None:
    """Load the weights first, so that a missing one costs no simulation; then record and judge."""
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.encoders import pretrained
    from touchgoal.encoders.towers.towers import load_towers
    from touchgoal.episodes.media import write_video
    from touchgoal.episodes.recording import EpisodeSpec, record_with_film
    from touchgoal.episodes.store import EpisodeWriter
    from touchgoal.launch.reward_curves import report_all
    from touchgoal.rewards.embedding_distance import EpisodeEmbedder, compute_curves
    from touchgoal.rewards.goals import assign_goals, parse_goal
    from touchgoal.rewards.normalizer import NORMALIZER, DistanceNormalizer
    from touchgoal.rewards.report.report import write_report
    from touchgoal.runtime.run_folder import open_run
    from touchgoal.sim_envs.pick_place import PickPlace

    sensor = find_sensor(config.env.sensor).name
    directory = pretrained.shipped_encoder_for(sensor)
    encoder = pretrained.load_encoder(directory, sensor)
    normalizer = DistanceNormalizer.load(directory / NORMALIZER)
    embedder = EpisodeEmbedder(load_towers(encoder.towers or "offline"), encoder)
    out = open_run(config.out, "demo", config)

    env = PickPlace(config.env)
    chosen = {"object": config.env.objects[0]} if len(config.env.objects) == 1 else {}
    episode, frames = record_with_film(env, EpisodeSpec(config.seed, options=chosen))
    env.close()
    write_video(out / "episode.mp4", frames, config.env.control_hz)
    EpisodeWriter(out / "episodes", config.env.control_hz).append(episode)

    embedded = embedder.embed_episode(episode, config.env.control_hz, str(episode.meta["object"]))
    specs = [parse_goal("last"), parse_goal(f"text:{config.words}")]
    goal = embedder.embed_goal(assign_goals(specs, embedded.modalities), embedded)
    curves = compute_curves(embedded, goal, normalizer)
    write_report(curves, out, "curves", {"encoder": directory.name, **asdict(embedder.made_with)})
    print(f"\n{episode.task}: {episode.meta['outcome']} in {len(episode) - 1} ticks")
    report_all([curves], out)
    print(f"video: {out / 'episode.mp4'}\ncurves: {out / 'curves.png'}\n\n{what_next(out)}")


def what_next(out: Path) -> str:
    """Commands to try after the demo."""
    commands = {
        f'touchgoal reward-curves {out / "episodes"} --goal "text:a soft woven ball"': (
            "the same episode towards another sentence"
        ),
        "touchgoal run-policy --episodes 4": "the learned policy: success rate and video",
        "touchgoal collect-demos --episodes 4 --out data": "episodes of your own to learn from",
    }
    lines = [f"  {command}\n      {meaning}" for command, meaning in commands.items()]
    return "\n".join(["next:", *lines])
