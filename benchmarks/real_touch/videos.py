"""Touch encoders on labelled videos of real touch: objects, properties, light and contact.

The protocol is PhysiCLeAR's: the five frames of a video that differ most from its untouched start
(the median of its first five frames) are embedded and averaged.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from touchgoal.benchmarks.options import BenchmarkOptions
from touchgoal.benchmarks.real_touch.embedders import Embedder, find_embedder
from touchgoal.control.tactile.contact import contact_strength, threshold_for
from touchgoal.encoders.probes.property_probe import (
    adapted_nearest_is_same,
    cross_validated,
    interval,
    most_of_three,
    nearest_is_same,
    pair_accuracy,
    read_properties,
    sentences_right,
)
from touchgoal.encoders.text_head import EmbedTexts
from touchgoal.encoders.towers.towers import load_towers
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
    """Touch encoders: a name, a folder, a published Sparsh file or id (facebook/sparsh-dino-base),
    `random:NAME` (the same network untrained), `pixels`, `efficientnet` (ImageNet), or the id or
    folder of a Hugging Face vision model."""
    every: Annotated[Count, RARE] = 1
    """Use every n-th video."""
    seed: Seed = 0
    """Random seed of untrained weights."""


BRIGHTER = 1.1
"""Light of the drift test."""


@dataclass(frozen=True, eq=False)
class VideoTouch:
    """What is known of a video.

    Attributes:
        video: its labels.
        chosen: rows of the frames of the largest change.
        rest: row of an untouched one.
        background: the sensor untouched.
        untouched, peak: contact strength of the first three frames, and the largest, counts.
        threshold: counts, from the first frames' noise.
    """

    video: LabelledVideo
    chosen: Int[np.ndarray, " k"]
    rest: int
    background: UInt8[np.ndarray, "h w 3"]
    untouched: float
    peak: float
    threshold: float


@dataclass(frozen=True, eq=False)
class VideoEmbedding:
    """One encoder's view of a video.

    Attributes:
        touch: mean over the chosen frames.
        rest, brighter: of an untouched frame alone, and of the same in more light.
    """

    touch: Float[np.ndarray, " d"]
    rest: Float[np.ndarray, " d"]
    brighter: Float[np.ndarray, " d"]


def run(config: Config) -> dict[str, Any]:
    """Read every video once and embed it by every encoder, then judge them."""
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
    rows = [
        {"encoder": name, **judge(touches, seen, embed_texts)} for name, seen in embedded.items()
    ]
    return {"table": "\n".join([_table(rows), "", _contact_line(touches)]), "rows": rows}


def read_touch(video: LabelledVideo, frames: UInt8[np.ndarray, "n h w 3"]) -> VideoTouch:
    """The frames of one video that count."""
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
    """One encoder's view; the frames before the chosen ones are there to look back to."""
    chosen = embed(frames, touch.background, touch.chosen).mean(0)
    rest = frames[touch.rest][None]
    lit = np.rint(np.clip(rest * BRIGHTER, 0, 255)).astype(np.uint8)
    alone = (embed(picture, touch.background)[0] for picture in (rest, lit))
    return VideoEmbedding(chosen, *alone)


def judge(
    touches: list[VideoTouch], embedded: list[VideoEmbedding], embed_texts: EmbedTexts
) -> dict[str, Any]:
    """One encoder's figures, with 95 % intervals over things."""
    every = np.stack([seen.touch for seen in embedded]).astype(np.float64)
    ranked = np.array([touch.video.ranks is not None for touch in touches])
    things = np.array([touch.video.object for touch in touches])[ranked]
    split = np.array([touch.video.split for touch in touches])[ranked]
    ranks = np.array([touch.video.ranks for touch in touches if touch.video.ranks is not None])
    embeddings = every[ranked]
    same = nearest_is_same(embeddings, things)
    adapted = adapted_nearest_is_same(embeddings, things)
    sentences = sentences_right(embeddings, ranks, things, embed_texts)
    frequent = [np.bincount(column).max() / len(column) for column in ranks.T]
    result: dict[str, Any] = {
        "videos": len(things),
        "things": len(set(things)),
        "nearest": float(same.mean()),
        "nearest_interval": interval(same, things),
        "adapted": float(adapted.mean()),
        "adapted_interval": interval(adapted, things),
        "sentences": dict(zip(PROPERTIES, sentences.mean(0).tolist(), strict=True)),
        "sentences_intervals": {
            name: interval(column, things)
            for name, column in zip(PROPERTIES, sentences.T, strict=True)
        },
        "most_frequent": dict(zip(PROPERTIES, map(float, frequent), strict=True)),
        "light": light_shift(touches, embedded),
    }
    cross = cross_validated(embeddings, ranks, things)
    result["cross_validated"] = _figures(cross.right, things)
    train, val = split == "train", split == "val"
    if train.any() and val.any():
        reading = read_properties(embeddings, ranks, train, val)
        result["val"] = _figures(reading.right, things[val])
        rng = np.random.default_rng(0)
        columns = list(zip(reading.scores.T, ranks[val].T, strict=True))
        result["val"]["pc"] = [pair_accuracy(s, r, things[val]) for s, r in columns]
        result["val"]["pss"] = [most_of_three(s, r, things[val], rng) for s, r in columns]
    return result


def light_shift(touches: list[VideoTouch], embedded: list[VideoEmbedding]) -> dict[str, float]:
    """How far 10 % more light moves an untouched frame, beside how far touches do.

    The lightest touch is the twentieth part's: a few clips are touched from their first frame on.
    """
    moved, touched = [], []
    for touch, seen in zip(touches, embedded, strict=True):
        moved.append(np.linalg.norm(seen.brighter - seen.rest))
        if touch.peak > touch.threshold and touch.video.ranks is not None:
            touched.append(np.linalg.norm(seen.touch - seen.rest))
    light, lightest, usual = np.median(moved), np.quantile(touched, 0.05), np.median(touched)
    return {"light": float(light), "lightest": float(lightest), "usual": float(usual)}


def _figures(right: np.ndarray, things: np.ndarray) -> dict[str, Any]:
    everything = np.asarray(right.all(1))
    return {
        "videos": len(right),
        "things": len(set(things)),
        **{name: float(column.mean()) for name, column in zip(PROPERTIES, right.T, strict=True)},
        "all": float(everything.mean()),
        "all_interval": interval(everything, things),
    }


def _table(rows: list[dict[str, Any]]) -> str:
    first, names = rows[0], max(len(row["encoder"]) for row in rows) + 2
    frequent = " ".join(f"{first['most_frequent'][name]:.2f}" for name in PROPERTIES)
    lines = [
        f"{first['videos']} videos of {first['things']} things; in brackets 95 % over things.",
        "nearest: the nearest other video is of the same thing; adapted: centred and whitened by the",
        "videos of other things, in ten folds. Properties by a ridge: all three right of things never",
        "seen, by ten folds, and on the published validation things (there hardness, roughness,",
        "bumpiness / all three / PC / PSS); its strength is the best on these very things. light: shift of an",
        "untouched frame by 10 % more light, as a share of the lightest touch's (of the usual touch's).",
        f"{'encoder':<{names}}{'nearest':<20}{'adapted':<20}{'all 3, folds':<20}{'validation things':<52}light",
    ]
    for row in rows:
        fold, light = row["cross_validated"], row["light"]
        val = row.get("val")
        lines.append(
            f"{row['encoder']:<{names}}{_with(row['nearest'], row['nearest_interval']):<20}"
            f"{_with(row['adapted'], row['adapted_interval']):<20}"
            f"{_with(fold['all'], fold['all_interval']):<20}{_validation(val):<52}"
            f"{light['light'] / max(light['lightest'], 1e-12):.2f} "
            f"({light['light'] / max(light['usual'], 1e-12):.2f})"
        )
    lines += [
        "",
        'sentences: of "a soft object", "a slightly hard object", "a hard object" and so on the nearest is true,',
        f"of things never seen, adapted as above; the most frequent answer alone: {frequent}",
        f"{'encoder':<{names}}" + "".join(f"{name:<20}" for name in PROPERTIES),
    ]
    for row in rows:
        cells = (_with(row["sentences"][n], row["sentences_intervals"][n]) for n in PROPERTIES)
        lines.append(
            f"{row['encoder']:<{names}}" + "".join(f"{cell:<20}" for cell in cells).rstrip()
        )
    return "\n".join(lines)


def _with(value: float, bounds: tuple[float, float]) -> str:
    return f"{value:.2f} ({bounds[0]:.2f}-{bounds[1]:.2f})"


def _validation(val: dict[str, Any] | None) -> str:
    if val is None:
        return "-"
    single = " ".join(f"{val[name]:.2f}" for name in PROPERTIES)
    pc, pss = (float(np.nanmean(val[name])) for name in ("pc", "pss"))
    return f"{single} / {_with(val['all'], val['all_interval'])} / {pc:.2f} / {pss:.2f}"


def _contact_line(touches: list[VideoTouch]) -> str:
    judged = [touch for touch in touches if len(touch.chosen) == FIRMEST]
    false = [t.video.path.stem for t in judged if t.untouched > t.threshold]
    missed = [t.video.path.stem for t in judged if t.peak <= t.threshold]
    return (
        f"contact in {len(judged)} clips: {len(false)} alarms within the first three frames"
        f"{': ' + ', '.join(false[:6]) if false else ''}; {len(missed)} missed"
        f"{': ' + ', '.join(missed[:6]) if missed else ''}"
    )
