"""Grasped objects named by sentences about them, by an encoder with words, on unseen episodes.

A touch gets the object whose sentences are nearest on average. Among fewer candidates than all, the
share of hits is the expected one over all choices of the others.
"""

from collections.abc import Sequence
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int

from benchmarks.papers.mmwand.intervals import cell, mean_over_objects
from touchgoal.encoders.alignment.described_touches import embed_grasps
from touchgoal.encoders.pretrained import load_encoder
from touchgoal.encoders.towers.towers import load_towers
from touchgoal.rewards.report.tables import aligned
from touchgoal.runtime.errors import UserError

_FEWER = 10  # candidates
_FRAMES = 16  # of each episode, both fingertips together


def run_grasped_objects(root: Path, encoders: Sequence[str], seed: int) -> dict[str, Any]:
    """Judge encoders on frames with contact of an episode set.

    UserError: an encoder without words or of another sensor, or a set without contact.

    Args:
        root: episode set of `collect-demos`, whose seeds no encoder was trained on.
        encoders: names or folders of encoders with words.
    """
    rows, objects, touches = [], 0, 0
    for name in encoders:
        encoder = load_encoder(name).eval()
        if encoder.towers is None:
            raise UserError(f"{name} has no words: choose an encoder that `align` or `words` made")
        grasps = embed_grasps(encoder, root, _FRAMES, seed)
        names = sorted(grasps.sentences)
        touches, objects = len(grasps.touch), len(names)
        towers = load_towers(encoder.towers)
        texts = torch.stack(
            [
                F.normalize(
                    torch.from_numpy(encoder.embed_text_goal(grasps.sentences[k], towers)).mean(0),
                    dim=0,
                )
                for k in names
            ]
        ).numpy()
        label = np.array([names.index(own) for own in grasps.object])
        nearer = _nearer(grasps.touch @ texts.T, label)
        rows.append(
            {
                "encoder": name,
                **{
                    str(k): mean_over_objects(label, _hits(nearer, objects, k))
                    for k in sorted({min(_FEWER, objects), objects})
                },
            }
        )
    return {"table": _table(rows, touches, objects), "rows": rows}


def _nearer(
    similarity: Float[np.ndarray, "n k"], label: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Return how many other objects are at least as near as the right one."""
    own = similarity[np.arange(len(label)), label]
    return (similarity >= own[:, None]).sum(1) - 1


def _hits(nearer: Int[np.ndarray, " n"], objects: int, candidates: int) -> Float[np.ndarray, " n"]:
    """Return the chance that none of the nearer objects is among `candidates - 1` others."""
    others, drawn = objects - 1, candidates - 1
    chance = [comb(others - k, drawn) / comb(others, drawn) for k in range(objects)]
    return np.array(chance)[nearer]


def _table(rows: list[dict[str, Any]], touches: int, objects: int) -> str:
    columns = [key for key in rows[0] if key != "encoder"]
    what = "right object by its sentences, % [95 % over objects]"
    lines = [["", *(f"of {k}" for k in columns)]]
    lines += [[row["encoder"], *(cell(row[k]) for k in columns)] for row in rows]
    lines.append(["chance", *(f"{100 / int(k):.1f}" for k in columns)])
    return "\n".join([f"{what}: {touches} touches of {objects} objects", *aligned(lines)])
