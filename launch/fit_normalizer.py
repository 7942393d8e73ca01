"""Fit what makes distances comparable, on successful episodes of your own.

Distances to a goal differ in size between cameras, encoders and scenes. This command finds where
successful episodes usually start and end, for each modality, and how far their ends lie apart, for
each part of the cost. It writes normalizer.json, and goal.npz: the successful ends as a goal. With
--value it also learns to see the task's progress in images (value.json, value.safetensors), which
`reward-curves` uses if it lies beside the normalizer. With --judge it also fits a judge (judge.json),
by which `touchgoal judge` tells success from failure. Any camera works; plain videos work for images.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from touchgoal.runtime.option_types import RARE, checked_dataclass


@checked_dataclass
class Config:
    """Options of fit-normalizer."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Sets of episodes; or at least two video files or folders of images, each of one success."""
    modalities: tuple[Literal["image", "tactile", "text"], ...] = ()
    """Modalities to fit: by default image and tactile, as far as they tell an episode's start from its end;
    name text, too, for goals that are sentences."""
    value: bool = False
    """Also fit a value of the task: a network that reads progress from images, whatever the goal. It
    needs at least 4 successes and a minute or two, and holds for these cameras and towers."""
    judge: bool = False
    """Also fit a judge of success: to at least 9 successes that share their objects, and better to 20
    failures, too, made on purpose. It fits four more values, if it has one."""
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
    from collections import Counter
    from dataclasses import replace

    from touchgoal.episodes.keys import parse_keys
    from touchgoal.rewards.distance.fit_normalizer import fit_normalizer, separating
    from touchgoal.rewards.distance.normalizer import NORMALIZER
    from touchgoal.rewards.features.embedding_cache import embed_end, embed_trajectory
    from touchgoal.rewards.features.successful_ends import GOAL_FILE, SuccessfulEnds
    from touchgoal.rewards.goals import Modality
    from touchgoal.rewards.judging.judge import JUDGE, LEAST_SUCCESSES, fit_judge
    from touchgoal.rewards.reward import Reward
    from touchgoal.rewards.sources.open_source import open_successes
    from touchgoal.rewards.value import fit_value
    from touchgoal.runtime.errors import UserError
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.provenance import provenance
    from touchgoal.runtime.run_folder import open_run

    keys = parse_keys(config.keys)
    with_touch = config.towers is None or config.encoder is not None
    named, success = (config.sources, config.camera), config.assume_success
    options = with_touch, success, keys, config.background
    inputs, trajectories, failures = open_successes(*named, *options)
    embedder = Reward(encoder=config.encoder, towers=config.towers).embedder(inputs)
    of_object = Counter(str(t.meta.get("object", "")) for t in trajectories)
    if config.judge and (n := sum(k for k in of_object.values() if k > 1)) < LEAST_SUCCESSES:
        raise UserError(
            f"--judge needs at least {LEAST_SUCCESSES} successes, each of an object with another "
            f"one; there are {n}"
        )
    out = open_run(config.out, "fit-normalizer", config)
    embedded = [
        embedder.describe(embed_trajectory(embedder, t), t.meta)
        for t in track(trajectories, "embedding", "trajectory")
    ]
    modalities: Sequence[Modality] = config.modalities
    if not modalities:
        modalities, left_out = separating(embedded)
        for why in left_out:
            print(f"left out: {why.partition(';')[0]}")
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
    if config.judge:
        failed = [embed_end(embedder, t) for t in track(failures, "embedding failures", "episode")]
        judge = replace(fit_judge(embedded, failed, value), towers=embedder.towers.name)
        judge.save(out / JUDGE)
        print(f"{judge}\nnext: touchgoal judge SET --judge {out}")
        return
    goal = f"--goal goal:{out / GOAL_FILE} --normalizer {out / NORMALIZER}"
    print(f"next: touchgoal reward-curves {config.sources[0]} {goal}")
