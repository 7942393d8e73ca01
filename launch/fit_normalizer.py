"""Fit the normalizer that makes distances comparable, on successful episodes of your own.

Distances to a goal differ in size between cameras, encoders and scenes. From episodes that reached
their goal this finds where they usually start and end, for each modality, and writes normalizer.json: with
`reward-curves --normalizer` a cost of 1 is then the usual start and 0 the usual end. Any camera will do;
plain videos will do for the pictures.
"""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from touchgoal.runtime.option_types import checked_dataclass


@checked_dataclass
class Config:
    """Options of fit-normalizer."""

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """A set of episodes; or at least two video files or folders of pictures, each of one success."""
    modalities: tuple[Literal["image", "tactile", "text"], ...] = ()
    """What to fit. Default: all that the episodes have."""
    camera: str = "front"
    """Camera of the episodes whose pictures are measured: front or wrist."""
    encoder: str | None = None
    """Touch encoder of any kind: a name (touchgoal list encoders), a folder, or a published Sparsh one.
    Default: the one that ships for the episodes' sensor. Sentences need one that is aligned with texts."""
    towers: str | None = None
    """Image and text networks: offline, or a CLIP (Hugging Face id or folder). Without --encoder,
    pictures alone are measured with them."""
    assume_success: bool = False
    """Take episodes whose outcome nobody recorded for successes."""
    out: Path | None = None
    """Folder of the run; the normalizer goes to its normalizer.json."""


def main(config: Config) -> None:
    """Check, embed, fit."""
    from touchgoal.rewards.fit_normalizer import fit_normalizer
    from touchgoal.rewards.normalizer import NORMALIZER
    from touchgoal.rewards.setup import embedder_for, load_touch
    from touchgoal.rewards.sources import open_successes
    from touchgoal.runtime.progress import track
    from touchgoal.runtime.run_folder import open_run

    with_touch = config.towers is None or config.encoder is not None
    sources = open_successes(config.sources, config.camera, with_touch, config.assume_success)
    touch, _ = load_touch(sources[0], config.encoder)
    embedder = embedder_for(sources[0], touch, config.towers)
    out = open_run(config.out, "fit-normalizer", config)
    total = sum(len(source.names) for source in sources)
    trajectories = (one for source in sources for one in source.embed(embedder, descriptions=True))
    embedded = list(track(trajectories, "embedding", "trajectory", total=total))
    has_words = all(one.descriptions is not None for one in embedded)
    modalities = config.modalities or tuple(
        m for m in embedded[0].modalities if m != "text" or has_words
    )
    normalizer = fit_normalizer(embedded, modalities, sources[0].scene)
    normalizer.save(out / NORMALIZER)
    print(f"{'fitted':<15}{'usual start':>15}{'usual end':>15}{'told apart':>15}")
    for name, start in normalizer.start.items():
        end, told = normalizer.goal[name], normalizer.separated[name]
        print(f"{name:<15}{start:>15.4f}{end:>15.4f}{told:>15.0%}")
    print("  usual start    median cosine distance to a goal at the start of an episode")
    print("  usual end      the same at its end")
    print("  told apart     share of (episode, goal) pairs whose end is nearer than its start")
    print("  own            goals from the episode itself; the others from other episodes or words")
    print(f"use it: touchgoal reward-curves {config.sources[0]} --normalizer {out / NORMALIZER}")
