"""Training data of the alignment: preprocessed touches and cached embeddings of the towers."""

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float16, Int
from torch import Tensor

from touchgoal.encoders.alignment.config import Augmentation
from touchgoal.encoders.preprocess import preprocessor_for
from touchgoal.encoders.towers.towers import BATCH, Towers
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.episodes.touches import Touches
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

NO_CONTACT = ""


@dataclass(frozen=True, eq=False)
class TouchData:
    """n touches of the objects in `names`, with their images and sentences."""

    touch: Float16[Tensor, "n 3 h w"]  # preprocessed frames in half precision, to save memory
    label: Int[Tensor, " n"]  # row of `names` of each touch
    contact: Bool[Tensor, " n"]  # False: it has sentences but no image
    view_index: Int[Tensor, " n"]  # row of `images` of each touch
    images: Float[Tensor, "e i"]  # image tower's embedding of each view, not normalised
    texts: Float[Tensor, "m t"]  # text tower's embedding of each sentence, not normalised
    describes: Bool[Tensor, "k m"]  # whether sentence j describes name i
    names: tuple[str, ...]  # catalogue ids, sorted; "" stands for no contact and comes first

    def __len__(self) -> int:
        return len(self.label)

    def take(self, rows: Int[Tensor, " b"] | Bool[Tensor, " n"]) -> "TouchData":
        """Return some of the touches, with all images and sentences."""
        names = "touch", "label", "contact", "view_index"
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def draw_sentences(self, rows: Int[Tensor, " b"], noise: BatchNoise) -> Int[Tensor, " b"]:
        """Draw one sentence (row of `texts`) for each of these touches."""
        describes = self.describes[self.label[rows]]
        order = (noise.rand((len(rows),)) * describes.sum(1)).long()
        return (describes.cumsum(1) > order[:, None]).int().argmax(1)


def prepare_touch_data(
    touches: Touches, towers: Towers, sensor: str, no_contact_texts: tuple[str, ...]
) -> TouchData:
    """Run the preprocessor and the towers once over all data.

    Without `no_contact_texts` touches without contact are left out. UserError: frames of another
    sensor, an object without descriptions, or no contact.
    """
    objects = np.asarray(touches.object)
    used = np.flatnonzero((objects != NO_CONTACT) | bool(no_contact_texts))
    objects = objects[used]
    if not (objects != NO_CONTACT).any():
        raise UserError("no touch is in contact: record episodes that touch something")
    names = tuple(sorted(set(objects.tolist())))
    sentences, describes = _sentences(
        names, touches.descriptions | {NO_CONTACT: list(no_contact_texts)}
    )
    starts = track(range(0, len(touches.view), BATCH), "embed views", "batch")
    return TouchData(
        touch=_preprocess(touches, used, sensor),
        label=torch.from_numpy(np.searchsorted(names, objects)),
        contact=torch.from_numpy(objects != NO_CONTACT),
        view_index=torch.from_numpy(touches.view_index[used].astype(np.int64)),
        images=torch.cat([towers.embed_images(touches.view[i : i + BATCH]) for i in starts]),
        texts=towers.embed_texts(sentences),
        describes=describes,
        names=names,
    )


def split_by_episode(data: TouchData, seed: int) -> tuple[TouchData, TouchData]:
    """Split the episodes with contact into halves, balanced over objects; each has one view."""
    episodes = data.view_index[data.contact].unique()
    label = torch.zeros(len(data.images), dtype=torch.long)
    label[data.view_index[data.contact]] = data.label[data.contact]
    shuffled = episodes[
        torch.randperm(len(episodes), generator=torch.Generator().manual_seed(seed))
    ]
    by_object = shuffled[label[shuffled].argsort(stable=True)]
    one, other = (data.take(torch.isin(data.view_index, by_object[i::2])) for i in (0, 1))
    return one, other


def _sentences(
    names: tuple[str, ...], descriptions: dict[str, list[str]]
) -> tuple[list[str], Bool[Tensor, "k m"]]:
    for name in names:
        if not descriptions.get(name):
            raise UserError(
                f"the object '{name}' has no descriptions: add sentences about its feel"
            )
    sentences = sorted({sentence for name in names for sentence in descriptions[name]})
    describes = torch.tensor([[s in descriptions[name] for s in sentences] for name in names])
    return sentences, describes


def _preprocess(touches: Touches, rows: np.ndarray, sensor: str) -> Float16[Tensor, "n 3 h w"]:
    preprocess = preprocessor_for(sensor)
    out = torch.empty(len(rows), 3, *preprocess.size, dtype=torch.float16)
    for i, row in enumerate(track(rows, "preprocess", "touch", len(rows))):
        background = touches.background[touches.background_index[row]]
        out[i] = torch.from_numpy(preprocess(touches.frames[row : row + 1], background)[0])
    return out


def augment(
    touch: Float[Tensor, "b 3 h w"], by: Augmentation, noise: BatchNoise
) -> Float[Tensor, "b 3 h w"]:
    """Return randomly changed copies of preprocessed touches."""
    touch = _shifted(touch, by.shift, noise) if by.shift else touch
    gain, offset = (2 * noise.rand((len(touch), 3, 1, 1)) - 1 for _ in range(2))
    touch = touch * (1 + by.gain * gain) + by.offset * offset
    if by.noise:
        touch = touch + by.noise * noise.randn(touch.shape)
    return touch


def _shifted(touch: Tensor, most: int, noise: BatchNoise) -> Tensor:
    height, width = touch.shape[2:]
    moves = noise.randint(2 * most + 1, (len(touch), 2)).tolist()
    padded = F.pad(touch, (most,) * 4)
    return torch.stack(
        [
            image[:, y : y + height, x : x + width]
            for image, (y, x) in zip(padded, moves, strict=True)
        ]
    )
