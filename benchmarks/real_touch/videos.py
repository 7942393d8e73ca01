"""Touch encoders on labelled videos of real touch: objects, properties, light and contact.

The protocol is PhysiCLeAR's: the five frames of a video that differ most from its untouched start
(the median of its first five frames) are embedded and averaged.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from benchmarks.options import BenchmarkOptions
from benchmarks.real_touch import property_probe as probe
from benchmarks.real_touch.embedders import Embedder, find_embedder
from touchgoal.control.tactile.contact import contact_strength, threshold_for
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.encoders.whitening.text_head import EmbedTexts
from touchgoal.episodes.importers.labelled_videos import (
    FIRMEST,
    PROPERTIES,
    LabelledVideo,
    firmest_frames,
    read_labelled_videos,
)
from touchgoal.episodes.touches import touch_background
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import RARE, Count, Seed, checked_dataclass
from touchgoal.runtime.progress import track


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark real-touch."""

    data: Path = field(kw_only=True)
    """Folder with labels.csv and videos/, laid out as PhysiCLeAR's."""
    encoders: tuple[str, ...] = ("gelsight_mini", "random:gelsight_mini", "pixels", "efficientnet")
    """Touch encoders: a name, a folder, a published Sparsh file or id, `random:NAME` (untrained), `pixels`,
    `efficientnet` (ImageNet), or the id or folder of a Hugging Face vision model."""
    every: Annotated[Count, RARE] = 1
    """Use every n-th video."""
    seed: Seed = 0
    """Random seed of untrained weights."""


BRIGHTER = 1.1  # factor of the light test


@dataclass(frozen=True, eq=False)
class VideoTouch:
    """One video; strengths of contact in counts."""

    video: LabelledVideo
    chosen: Int[np.ndarray, " k"]  # rows of the frames with the largest change
    rest: int  # row of an untouched frame
    background: UInt8[np.ndarray, "h w 3"]
    untouched: float  # strength in the first three frames
    peak: float  # largest strength
    threshold: float  # from the first frames' noise


@dataclass(frozen=True, eq=False)
class VideoEmbedding:
    """One encoder's embeddings of a video."""

    touch: Float[np.ndarray, " d"]  # mean over the chosen frames
    rest: Float[np.ndarray, " d"]  # untouched frame
    brighter: Float[np.ndarray, " d"]  # the same frame in more light


def run(config: Config) -> dict[str, Any]:
    """Embed every video with every encoder and judge them."""
    embedders = {name: find_embedder(name, config.seed) for name in config.encoders}
    videos = read_labelled_videos(config.data)[:: config.every]
    if sum(video.ranks is not None for video in videos) < 10:
        raise UserError(f"{config.data} has fewer than 10 ranked videos: nothing to judge by")
    touches: list[VideoTouch] = []
    embedded: dict[str, list[VideoEmbedding]] = {name: [] for name in embedders}
    for video in track(videos, "embedding", "video"):
        frames = video.frames()
        touches.append(read_touch(video, frames))
        for name, embed in embedders.items():
            embedded[name].append(embed_touch(touches[-1], frames, embed))
    embed_texts = load_towers("offline").embed_texts
    rows = [{"encoder": name, **judge(touches, own, embed_texts)} for name, own in embedded.items()]
    return {"table": "\n".join([_table(rows), "", _contact_line(touches)]), "rows": rows}


def read_touch(video: LabelledVideo, frames: UInt8[np.ndarray, "n h w 3"]) -> VideoTouch:
    """Choose the frames of one video."""
    background = touch_background(frames)
    chosen = firmest_frames(frames, background)
    strength = contact_strength(frames[chosen], background)
    first = contact_strength(frames[:FIRMEST], background)
    threshold = threshold_for(frames[:FIRMEST], background)
    peak, untouched = float(max(strength.max(), first.max())), float(first[:3].max())
    rest = int(first[:3].argmin())
    return VideoTouch(video, chosen, rest, background, untouched, peak, threshold)


def embed_touch(
    touch: VideoTouch, frames: UInt8[np.ndarray, "n h w 3"], embed: Embedder
) -> VideoEmbedding:
    """Embed the chosen frames; earlier frames are there for encoders that look back."""
    chosen = embed(frames, touch.background, touch.chosen).mean(0)
    rest = frames[touch.rest][None]
    lit = np.rint(np.clip(rest * BRIGHTER, 0, 255)).astype(np.uint8)
    alone = (embed(image, touch.background)[0] for image in (rest, lit))
    return VideoEmbedding(chosen, *alone)


def judge(
    touches: list[VideoTouch], embedded: list[VideoEmbedding], embed_texts: EmbedTexts
) -> dict[str, Any]:
    """Return one encoder's figures, with 95 % intervals over objects."""
    every = np.stack([own.touch for own in embedded]).astype(np.float64)
    ranked = np.array([touch.video.ranks is not None for touch in touches])
    objects = np.array([touch.video.object for touch in touches])[ranked]
    ranks = np.array([touch.video.ranks for touch in touches if touch.video.ranks is not None])
    embeddings = every[ranked]
    sentences = probe.sentences_right(embeddings, ranks, objects, embed_texts)
    predicted = probe.predict_properties(embeddings, ranks, objects)
    right = predicted.ranks == ranks
    rng = np.random.default_rng(0)
    frequent = [np.bincount(column).max() / len(column) for column in ranks.T]
    return {
        "videos": len(objects),
        "objects": len(set(objects)),
        **_with_interval("nearest", probe.nearest_is_same(embeddings, objects), objects),
        **_with_interval("adapted", probe.adapted_nearest_is_same(embeddings, objects), objects),
        **_with_interval("all_right", np.asarray(right.all(1)), objects),
        "properties": _by_property(right.mean(0)),
        "pc": _by_property(
            probe.pair_accuracy(*own, objects)
            for own in zip(predicted.ranks.T, ranks.T, strict=True)
        ),
        "pss": _by_property(
            probe.most_of_three(*own, objects, rng)
            for own in zip(predicted.scores.T, ranks.T, strict=True)
        ),
        "sentences": _by_property(sentences.mean(0)),
        "sentences_intervals": {
            name: probe.interval(column, objects)
            for name, column in zip(PROPERTIES, sentences.T, strict=True)
        },
        "most_frequent": _by_property(frequent),
        "light": light_shift(touches, embedded),
    }


def _with_interval(name: str, right: np.ndarray, objects: np.ndarray) -> dict[str, Any]:
    return {name: float(right.mean()), f"{name}_interval": probe.interval(right, objects)}


def _by_property(values: Iterable[float]) -> dict[str, float]:
    return {name: float(value) for name, value in zip(PROPERTIES, values, strict=True)}


def light_shift(touches: list[VideoTouch], embedded: list[VideoEmbedding]) -> dict[str, float]:
    """Return shifts of the embedding under 10 % more light and under touch.

    The lightest touch is the 5 % quantile, because a few clips have no untouched frame.
    """
    moved, touched = [], []
    for touch, own in zip(touches, embedded, strict=True):
        moved.append(np.linalg.norm(own.brighter - own.rest))
        if touch.peak > touch.threshold and touch.video.ranks is not None:
            touched.append(np.linalg.norm(own.touch - own.rest))
    light, lightest, usual = np.median(moved), np.quantile(touched, 0.05), np.median(touched)
    return {"light": float(light), "lightest": float(lightest), "usual": float(usual)}


def _table(rows: list[dict[str, Any]]) -> str:
    first, width = rows[0], max(len(row["encoder"]) for row in rows) + 2
    lines = [
        f"{first['videos']} videos of {first['objects']} objects; [95 % over objects]",
        "nearest: the nearest other video shows the same object; adapted: after centring and whitening",
        "with other objects' videos. all 3: hardness, roughness and bumpiness of an unseen object all",
        "right; PC, PSS: as in Octopi, means over the properties. All in ten folds over objects.",
        "light: shift of an untouched frame under 10 % more light, over that of the lightest touch",
        f"{'encoder':<{width}}{'nearest':<19}{'adapted':<19}{'all 3':<19}{'PC':<6}{'PSS':<6}light",
    ]
    for row in rows:
        pc, pss = (np.nanmean(list(row[name].values())) for name in ("pc", "pss"))
        light = row["light"]["light"] / max(row["light"]["lightest"], 1e-12)
        cells = (_with(row[n], row[f"{n}_interval"]) for n in ("nearest", "adapted", "all_right"))
        lines.append(
            f"{row['encoder']:<{width}}{''.join(f'{cell:<19}' for cell in cells)}"
            f"{pc:<6.2f}{pss:<6.2f}{light:.2f}"
        )
    frequent = ", ".join(f"{name} {first['most_frequent'][name]:.2f}" for name in PROPERTIES)
    lines += [
        "",
        'sentences: the nearest of "a soft object", "a slightly hard object", "a hard object" (and so',
        f"on) is true of an unseen object; the most frequent answer alone: {frequent}",
        f"{'encoder':<{width}}" + "".join(f"{name:<19}" for name in PROPERTIES),
    ]
    for row in rows:
        cells = (_with(row["sentences"][n], row["sentences_intervals"][n]) for n in PROPERTIES)
        lines.append(f"{row['encoder']:<{width}}" + "".join(f"{c:<19}" for c in cells).rstrip())
    return "\n".join(lines)


def _with(value: float, bounds: tuple[float, float]) -> str:
    return f"{value:.2f} [{bounds[0]:.2f}, {bounds[1]:.2f}]"


def _contact_line(touches: list[VideoTouch]) -> str:
    judged = [touch for touch in touches if len(touch.chosen) == FIRMEST]
    false = [t.video.path.stem for t in judged if t.untouched > t.threshold]
    missed = [t.video.path.stem for t in judged if t.peak <= t.threshold]
    return (
        f"contact in {len(judged)} clips: {len(false)} alarms within the first three frames"
        f"{': ' + ', '.join(false[:6]) if false else ''}; {len(missed)} missed"
        f"{': ' + ', '.join(missed[:6]) if missed else ''}"
    )
