"""Fit what makes distances comparable, on successful episodes of your own.

Distances to a goal differ in size between cameras, encoders and scenes. This command finds where
successful episodes usually start and end, for each modality, and how far their ends lie apart, for
each part of the cost. It writes normalizer.json, and goal.npz: the successful ends as a goal. With
--value it also learns to see the task's progress in images (value.json, value.safetensors), which
`reward-curves` uses if it lies beside the normalizer. Any camera works; plain videos work for
images.
"""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from touchgoal.runtime.option_types import RARE, CountOrNone, checked_dataclass


@checked_dataclass
class Config:
    """Options of fit-normalizer."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """A set of episodes; or at least two video files or folders of images, each of one success."""
    modalities: tuple[Literal["image", "tactile", "text"], ...] = ()
    """Modalities to fit: image and tactile by default, as far as the episodes have them; name text, too,
    for goals that are sentences."""
    value: bool = False
    """Also fit a value of the task: a network that reads progress from images, whatever the goal. It
    needs at least 4 successes and a minute or two, and holds for these cameras and towers."""
    success_from: CountOrNone = 0
    """Number of successes, the last ones, that fit nothing else and set the threshold of success
    (success.json): at least 9, for at most 10 % of successes rejected. 0: no threshold."""
    camera: str = "front"
    """Camera of the plain distance of images, such as front, wrist or a LeRobot set's top."""
    keys: Annotated[tuple[str, ...], RARE] = ()
    """Keys of a LeRobot set whose features have other names: STORED=KEY, such as
    observation.images.top=observation.images.front."""
    background: tuple[Path, ...] = ()
    """Clip (or image, which shows no noise) of each fingertip untouched, left before right, for videos
    that do not begin so. Default: their first frames."""
    encoder: str | None = None
    """Touch encoder: a name (touchgoal list encoders), a folder, or a published Sparsh one. Default:
    the one that ships for the episodes' sensor. Sentences need one that is aligned with texts."""
    towers: str | None = None
    """Image and text networks: offline, or a CLIP (Hugging Face id or folder). If given
    without --encoder, only images are measured."""
    assume_success: bool = False
    """Take episodes without a recorded outcome as successes."""
    out: Path | None = None
    """Folder of the run."""


def main(config: Config) -> None:
    """Check, embed, fit, and write normalizer.json."""
    from touchgoal.episodes.keys import parse_keys
    from touchgoal.rewards.distance.fit_normalizer import fit_normalizer
    from touchgoal.rewards.distance.normalizer import NORMALIZER
    from touchgoal.rewards.features.embedding_cache import embed_trajectory
    from touchgoal.rewards.features.successful_ends import GOAL_FILE, SuccessfulEnds
    from touchgoal.rewards.goals import Modality
    from touchgoal.rewards.reward import Reward
    from touchgoal.rewards.sources.open_source import open_successes
    from touchgoal.rewards.success import SUCCESS, check_demonstrations, fit_success, last_costs
    from touchgoal.rewards.value import LEAST_EPISODES, fit_value
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.provenance import provenance
    from touchgoal.runtime.run_folder import open_run

    keys = parse_keys(config.keys)
    with_touch = config.towers is None or config.encoder is not None
    named, success = (config.sources, config.camera), config.assume_success
    sources = open_successes(*named, with_touch, success, keys, config.background)
    inputs = sources[0].inputs
    embedder = Reward(encoder=config.encoder, towers=config.towers).embedder(inputs)
    trajectories = [t for source in sources for t in source.trajectories]
    if config.success_from:
        check_demonstrations(config.success_from)
        least = LEAST_EPISODES if config.value else 2
        if len(trajectories) - config.success_from < least:
            raise UserError(
                f"--success-from {config.success_from} leaves fewer than {least} of "
                f"{len(trajectories)} successes to fit on"
            )
    out = open_run(config.out, "fit-normalizer", config)
    embedded = [
        embedder.describe(embed_trajectory(embedder, t), t.meta)
        for t in track(trajectories, "embedding", "trajectory")
    ]
    calibration = embedded[len(embedded) - config.success_from :]
    embedded = embedded[: len(embedded) - config.success_from]
    own: list[Modality] = [m for m in embedded[0].modalities if m != "text"]
    modalities = config.modalities or own
    normalizer = fit_normalizer(embedded, modalities, inputs.scene)
    value = fit_value(embedded, inputs.fitted_task) if config.value else None
    ends = SuccessfulEnds.of(embedded)
    normalizer.save(out / NORMALIZER)
    ends.save(out / GOAL_FILE)
    if value is not None:
        value.save(out, provenance())
    print(f"{'fitted':<24}{'usual start':>12}{'usual end':>12}{'separated':>12}")
    for name, start in normalizer.start.items():
        end, share = normalizer.goal[name], normalizer.separated[name]
        print(f"{name:<24}{start:>12.4f}{end:>12.4f}{share:>12.0%}")
    print("  usual start    median cosine distance to a goal at the start of an episode")
    print("  usual end      the same at its end")
    print("  separated      share of (episode, goal) pairs whose end is nearer than its start")
    print("  same episode   the goal is the episode's own last frame, else another's or a sentence")
    units = ", ".join(f"{name} {unit:.3g}" for name, unit in normalizer.unit.items())
    print(f"spread of successful ends by part: {units or 'none, for no two hold the same object'}")
    if calibration:
        threshold = fit_success(last_costs(calibration, ends, normalizer, value))
        threshold.save(out / SUCCESS)
        print(threshold)
    goal = f"--goal goal:{out / GOAL_FILE} --normalizer {out / NORMALIZER}"
    print(f"next: touchgoal reward-curves {config.sources[0]} {goal}")
