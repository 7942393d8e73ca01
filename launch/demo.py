"""The MMWand paper's robot experiment in simulation, on the shipped weights.

A Franka FR3 with a GelSight Mini on each finger picks an object up and places it. Until it lets go, the
distance to the goal is drawn: in the camera's image, in touch, to a sentence, and of all parts fused. The
judge that ships says whether it ended in success.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from touchgoal.control.features import ACTION, CAMERAS, FRONT, TACTILE, TRUTH_CONTACT
from touchgoal.episodes.schema import Episode
from touchgoal.runtime import seeds
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import FIXED, Seed, checked_dataclass
from touchgoal.sim_envs.config import PickPlaceConfig

FILMED = ("fused", "front", "object", "words")  # of the curves that the plot shows


@checked_dataclass
class Config:
    """Options of demo."""

    out: Path | None = None
    """Folder of the run."""
    words: str = "a hard smooth round object"
    """Sentence that says how the object feels: the goal in words."""
    seed: Seed = seeds.DEMO.start
    """Random seed of the episode."""
    env: Annotated[PickPlaceConfig, FIXED] = PickPlaceConfig(objects=("glass_ball",), release=True)

    def __post_init__(self) -> None:
        """Refuse a sentence that says nothing."""
        if not self.words.strip():
            raise UserError("--words is empty: say how the object feels")


def main(config: Config) -> None:
    """Load the encoders, record and film an episode, and draw its distance to the goal."""
    from touchgoal.control.tactile.sensor_models import find_sensor
    from touchgoal.episodes.film import write_film
    from touchgoal.episodes.recording import EpisodeSpec, record_with_film
    from touchgoal.episodes.store import EpisodeWriter
    from touchgoal.rewards.goals import Inputs
    from touchgoal.rewards.judging.judge import SHIPPED_JUDGE
    from touchgoal.rewards.report.plot import curve_colors
    from touchgoal.rewards.report.report import write_report
    from touchgoal.rewards.report.tables import metrics_table
    from touchgoal.rewards.reward import Reward
    from touchgoal.runtime.json_file import write_json
    from touchgoal.runtime.run_folder import open_run
    from touchgoal.sim_envs.pick_place import PickPlace

    sensor = find_sensor(config.env.sensor).name
    inputs = Inputs(
        "the demo's episode", FRONT, TACTILE, sensor, "simulated pick-place", cameras=CAMERAS
    )
    reward = Reward(["last", f"text:{config.words}"]).prepare(inputs)
    out = open_run(config.out, "demo", config)

    env, hz = PickPlace(config.env), config.env.control_hz
    chosen = {"object": config.env.objects[0]}
    episode, images = record_with_film(env, EpisodeSpec(config.seed, options=chosen))
    env.close()
    held = until_release(episode)
    EpisodeWriter(out / "episodes", hz).append(held)
    embedded = reward.embedder.embed_chunks([held], hz, str(held.meta["object"]))
    curves = reward.curves(embedded)
    judged = Reward.of_judge(SHIPPED_JUDGE).prepare(inputs).judge_episode(embedded)
    write_report(curves, out, "curves")
    shown = {name: curves.costs[name] for name in FILMED}
    film = out / "episode.mp4"
    write_film(film, images, episode, hz, shown, "distance to goal", curve_colors(FILMED))
    print(f"\n{episode.task}: {episode.meta['outcome']} in {len(episode) - 1} ticks")
    print(f"the judge, which sees and feels alone, says: {judged}")
    write_json(out / "metrics.json", curves.metrics())
    print(metrics_table([curves]))
    print(f"film: {film}\ncurves: {out / 'curves.png'}\n\n{what_next(out)}")


def until_release(episode: Episode) -> Episode:
    """Return the episode up to the tick at which the hand opens: placed, and still touched."""
    width = episode.frames[ACTION][:, -1]
    touched = episode.frames[TRUTH_CONTACT].max(axis=1)
    opens = [t for t in range(1, len(episode)) if width[t] > width[t - 1] and touched[t]]
    end = opens[0] + 1 if opens else len(episode)
    return replace(episode, frames={key: values[:end] for key, values in episode.frames.items()})


def what_next(out: Path) -> str:
    """Return commands to try after the demo."""
    return f"""next:
  touchgoal reward-curves {out / "episodes"} --goal "text:a soft woven ball"
      the same episode, distance to another sentence
  touchgoal run-policy --episodes 4
      the learned policy: success rate and films
  touchgoal collect-demos --episodes 4 --out data
      episodes of your own to learn from"""
