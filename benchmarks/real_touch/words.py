"""Hardness, roughness and bumpiness of real objects named by sentences, without their labels.

The objects are judged in ten folds. The encoder is centred by the other folds' videos, whose ranks
nobody reads, as `train-encoder adapt` does. Hardness is not in an embedding: thirds of the other
videos by depth give it. A video is its five firmest frames.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Shaped

from benchmarks.options import BenchmarkOptions
from benchmarks.real_touch.property_probe import N_RANKS, folds, interval
from touchgoal.control.tactile.depth import DepthEstimator
from touchgoal.control.tactile.sensor_calibration import load
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.encoders.backbones.pooled_encoder import PooledEncoder
from touchgoal.encoders.pretrained import load_pooled_encoder
from touchgoal.encoders.towers.towers import Towers, load_towers
from touchgoal.encoders.whitening.adapt import centre, direction, pool_firmest
from touchgoal.encoders.whitening.text_head import RANK_WORDS, rank_sentences
from touchgoal.episodes.importers.labelled_videos import (
    PROPERTIES,
    LabelledVideo,
    firmest_frames,
    read_labelled_videos,
)
from touchgoal.rewards.distance.parts import cosine_distances
from touchgoal.rewards.report.tables import aligned
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import Seed, checked_dataclass
from touchgoal.runtime.progress import track

_FEWEST = 5  # objects to judge by
_OWN = (
    (1, False),
    (3, False),
    (10, False),
    (30, False),
    (10, True),
)  # own objects, and whether ranked
_DRAWS = 20  # of them
_CELL = 8  # px, of the depth map
_THIRDS = np.array([1 / 3, 2 / 3])
_SURFACES = {"rough": 1, "smooth": 1, "bumpy": 2, "flat": 2}  # word of goals, and its property


@checked_dataclass
class Config(BenchmarkOptions):
    """Options of benchmark real-words."""

    data: Path = field(kw_only=True)
    """Folder with labels.csv and videos/, laid out as PhysiCLeAR's."""
    encoder: str = "gelsight_mini"
    """Touch encoder with words: a name, or its folder."""
    seed: Seed = 0
    """Random seed of the objects drawn as one's own."""


@dataclass(frozen=True, eq=False)
class Videos:
    """n videos of ranked objects."""

    objects: Shaped[np.ndarray, " n"]
    ranks: Int[np.ndarray, "n 3"]  # `PROPERTIES`
    pooled: list[Float[torch.Tensor, "k d"]]  # features of each one's firmest frames
    touch: Float32[np.ndarray, "n d"]  # embeddings as shipped, mean of these frames
    depth: Float[np.ndarray, " n"]  # m, see `pressed_depth`

    def chosen(self, rows: Bool[np.ndarray, " n"]) -> list[Float[torch.Tensor, "k d"]]:
        """Return the features of some videos."""
        return [self.pooled[i] for i in np.flatnonzero(rows)]


def run(config: Config) -> dict[str, Any]:
    """Name the properties of every video, as shipped and centred by videos of one's own."""
    encoder = load_pooled_encoder(config.encoder)
    if encoder.towers is None:
        raise UserError(f"{config.encoder} has no words: choose an encoder that `words` made")
    towers = load_towers(encoder.towers)
    ranked = [video for video in read_labelled_videos(config.data) if video.ranks is not None]
    if len({video.object for video in ranked}) < _FEWEST:
        raise UserError(
            f"{config.data} has fewer than {_FEWEST} ranked objects: nothing to judge by"
        )
    videos = read_videos(encoder, ranked)
    named = {"as shipped": name_ranks(encoder, towers, videos.pooled)}
    named["centred by other objects"] = _by_folds(encoder, towers, videos, by_depth=False)
    named["the same, hardness by depth"] = _by_folds(encoder, towers, videos, by_depth=True)
    rows = [{"row": name, **_judge(answers, videos)} for name, answers in named.items()]
    rng = np.random.default_rng(config.seed)
    kinds = [kind for kind in _OWN if kind[0] < len(set(videos.objects))]
    few = [_with_few(encoder, towers, videos, *kind, rng) for kind in kinds]
    frequent = [float(np.bincount(column).max() / len(column)) for column in videos.ranks.T]
    result = {"rows": rows, "few": few, "most_frequent": frequent}
    result["nearer"] = {word: _nearer(encoder, towers, videos, word) for word in _SURFACES}
    return {"table": _table(videos, result), **result}


def read_videos(encoder: PooledEncoder, videos: list[LabelledVideo]) -> Videos:
    """Read the firmest frames of ranked videos."""
    calibration = load(SENSORS[LabelledVideo.sensor].sensor_file)
    size = calibration.background.shape[1::-1]
    estimator, pooled, touch, depth = DepthEstimator(calibration, _CELL), [], [], []
    for video in track(videos, "reading", "video"):
        frames, background = video.open()
        rows = firmest_frames(frames, background)
        pooled.append(pool_firmest(encoder, frames, background))
        touch.append(encoder.embed_frames(frames, background, rows).mean(0))
        sized = [cv2.resize(image, size) for image in (background, *frames[rows])]
        maps = [estimator.estimate(image, sized[0].astype(np.float32)) for image in sized[1:]]
        depth.append(pressed_depth(np.stack(maps)))
    objects, ranks = ([getattr(v, name) for v in videos] for name in ("object", "ranks"))
    return Videos(np.array(objects), np.array(ranks), pooled, np.stack(touch), np.array(depth))


def pressed_depth(maps: Float[np.ndarray, "k h w"]) -> float:
    """Return the depth (m) that a twentieth of the gel exceeds, mean over the frames.

    Pressed alike, a hard object goes deep over the whole contact; a soft one spreads.
    """
    return float(np.percentile(maps, 95, axis=(1, 2)).mean())


def name_ranks(
    encoder: PooledEncoder, towers: Towers, pooled: list[Float[torch.Tensor, "k d"]]
) -> Int[np.ndarray, "n 3"]:
    """Return the rank whose sentence is nearest to each video, for each property."""
    touches = torch.stack([direction(encoder, own) for own in pooled]).numpy()
    goals = [encoder.embed_text_goal(rank_sentences(k), towers) for k in range(len(PROPERTIES))]
    return np.stack([(touches @ own.T).argmax(1) for own in goals], 1)


def _by_folds(
    encoder: PooledEncoder, towers: Towers, videos: Videos, by_depth: bool
) -> Int[np.ndarray, "n 3"]:
    answers = np.zeros_like(videos.ranks)
    for test in folds(videos.objects):
        own = centre(encoder, videos.chosen(~test), videos.objects[~test])
        answers[test] = name_ranks(own, towers, videos.chosen(test))
        if by_depth:
            answers[test, 0] = _hardness(videos, test, ~test, _THIRDS)
    return answers


def _with_few(
    encoder: PooledEncoder,
    towers: Towers,
    videos: Videos,
    number: int,
    labelled: bool,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Judge with few objects of one's own on all others, hardness by depth; mean over draws.

    Ranks of one's own objects give the share of each rank of hardness; else there are thirds.
    """
    right, every = [], np.ones(len(videos.objects), bool)
    for _ in range(_DRAWS):
        own = np.isin(videos.objects, rng.choice(np.unique(videos.objects), number, replace=False))
        centred = centre(encoder, videos.chosen(own), videos.objects[own])
        answers, shares = name_ranks(centred, towers, videos.pooled), _THIRDS
        if labelled:
            shares = np.cumsum(np.bincount(videos.ranks[own, 0], minlength=N_RANKS))[:2] / own.sum()
        answers[:, 0] = _hardness(videos, every, own, shares)
        hits = (answers == videos.ranks)[~own]
        right.append([*hits.mean(0), hits.all(1).mean()])
    return {"objects": number, "labelled": labelled, "right": np.mean(right, 0).tolist()}


def _hardness(
    videos: Videos,
    test: Bool[np.ndarray, " n"],
    known: Bool[np.ndarray, " n"],
    shares: Float[np.ndarray, " 2"],
) -> Int[np.ndarray, " m"]:
    """Return ranks by depth; `shares` of the known videos lie below ranks 1 and 2."""
    return np.searchsorted(np.quantile(videos.depth[known], shares), videos.depth[test])


def _nearer(encoder: PooledEncoder, towers: Towers, videos: Videos, word: str) -> float:
    """Return how often the right one of two videos, with most and least of a property, costs less."""
    goal = encoder.embed_text_goal([f"a {word} surface"], towers)
    distance, k = cosine_distances(videos.touch, goal)[:, 0], _SURFACES[word]
    true = RANK_WORDS[k].index(word)
    right, wrong = (distance[videos.ranks[:, k] == rank] for rank in (true, N_RANKS - 1 - true))
    pairs = right[:, None] < wrong
    return float(pairs.mean()) if pairs.size else float("nan")


def _judge(answers: Int[np.ndarray, "n 3"], videos: Videos) -> dict[str, Any]:
    right = answers == videos.ranks
    columns = {**dict(zip(PROPERTIES, right.T, strict=True)), "all three": right.all(1)}
    return {
        "right": {name: float(column.mean()) for name, column in columns.items()},
        "intervals": {name: interval(column, videos.objects) for name, column in columns.items()},
        "answers": [np.bincount(column, minlength=N_RANKS).tolist() for column in answers.T],
    }


def _table(videos: Videos, result: dict[str, Any]) -> str:
    lines = [["", *PROPERTIES, "all three"]]
    lines.append(
        ["most frequent answer", *(f"{value:.2f}" for value in result["most_frequent"]), ""]
    )
    for row in result["rows"]:
        cells = [
            "{:.2f} [{:.2f}, {:.2f}]".format(value, *row["intervals"][name])
            for name, value in row["right"].items()
        ]
        lines.append([row["row"], *cells])
        lines.append(["  answered", *(" ".join(map(str, own)) for own in row["answers"]), ""])
    truth = [np.bincount(column, minlength=N_RANKS) for column in videos.ranks.T]
    lines.append(["true", *(" ".join(map(str, own)) for own in truth), ""])
    few = [["", *PROPERTIES, "all three"]]
    for row in result["few"]:
        name = f"{row['objects']} objects" + (" with ranks" if row["labelled"] else "")
        few.append([name, *(f"{value:.2f}" for value in row["right"])])
    number = len(videos.objects)
    return "\n".join(
        [
            f"{number} videos of {len(set(videos.objects))} objects: right rank [95 % over objects]; in ten",
            "folds over objects; answered: how often each rank, least first",
            *aligned(lines),
            "",
            f"centred by few objects' videos, judged on all others; hardness by depth; mean of {_DRAWS} draws",
            *aligned(few),
            "",
            'nearer to "a rough surface" and so on, of a video with most of it and one with least, as shipped:',
            ", ".join(f"{word} {value:.2f}" for word, value in result["nearer"].items()),
        ]
    )
