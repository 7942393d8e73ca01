"""Touch embeddings with sentences on what was touched, and how several sets of them are joined."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32
from torch import Tensor

from touchgoal.encoders.alignment.heads import PairedEmbeddings
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.ssl.frames import check_sensor
from touchgoal.encoders.towers.towers import Towers
from touchgoal.episodes.format.joined import load_episodes
from touchgoal.episodes.touches import check_touches, descriptions, draw_frames
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_VISIBLE = 0.2  # least length of an embedding of a visible touch


@dataclass(frozen=True, eq=False)
class DescribedTouches:
    """n touches of objects on which there are sentences."""

    touch: Float32[np.ndarray, "n d"]  # embeddings
    object: tuple[str, ...]  # name of the object of each touch
    sentences: dict[str, list[str]]  # on each object
    image: Float[Tensor, "n v i"] | None = None  # image tower's embeddings of views of each

    def visible(self) -> "DescribedTouches":
        """Return the touches that the tactile image shows."""
        rows = np.flatnonzero(np.linalg.norm(self.touch, axis=1) > _VISIBLE)
        return replace(
            self,
            touch=self.touch[rows],
            object=tuple(self.object[i] for i in rows),
            image=None if self.image is None else self.image[rows],
        )


def embed_grasps(encoder: AnyTouchEncoder, root: Path, frames: int, seed: int) -> DescribedTouches:
    """Embed frames with contact of episodes in which objects are grasped.

    UserError: the set has no touch, no descriptions or no contact, or is another sensor's.

    Args:
        root: episode set whose meta has `object` and `descriptions`, such as `collect-demos` records;
            it needs no cameras.
        frames: number of each episode, both fingertips together.
    """
    episodes = load_episodes(root)
    sides = check_touches(episodes)
    rows, objects = [], []
    for i in track(range(len(episodes)), "embedding grasps", "episode"):
        if encoder.config.sensor is not None:
            check_sensor(episodes, i, encoder.config.sensor)
        drawn = draw_frames(episodes, i, frames, 0, seed)
        for side in range(len(sides)):
            own = drawn.frames[drawn.column == side]
            rows.append(encoder.embed_frames(own, drawn.background[side]))
            objects += [str(episodes.meta(i)["object"])] * len(own)
    if not objects:
        raise UserError(f"{root} has no contact: give episodes with contact")
    return DescribedTouches(np.concatenate(rows), tuple(objects), descriptions(episodes))


def pair(sets: Sequence[DescribedTouches], towers: Towers) -> PairedEmbeddings:
    """Join sets for the training of heads, those with views first.

    An object that has the same name in two sets is one object with the sentences of both.
    """
    sets = sorted((own.visible() for own in sets), key=lambda own: own.image is None)
    of: dict[str, set[str]] = {}
    for own in sets:
        for name, sentences in own.sentences.items():
            of.setdefault(name, set()).update(sentences)
    names, texts = sorted(of), sorted(set().union(*of.values()))
    place = {name: k for k, name in enumerate(names)}
    return PairedEmbeddings(
        touch=F.normalize(torch.from_numpy(np.concatenate([own.touch for own in sets])), dim=1),
        label=torch.tensor([place[name] for own in sets for name in own.object]),
        image=torch.cat([own.image for own in sets if own.image is not None]),
        texts=towers.embed_texts(texts),
        describes=torch.tensor([[text in of[name] for text in texts] for name in names]),
    )
