"""Pose estimator: a network from an episode's first camera images to object and goal poses.

It works in two stages: a coarse map locates the named object and the goal; a crop around each, at full
resolution, gives their poses. Keypoints of the whole image give the camera's pose.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.policies.actions import Normalizer
from touchgoal.policies.config import Box, PoseEstimatorConfig
from touchgoal.policies.heads.mlp import readout
from touchgoal.policies.perception.known_names import KnownNames, embedded_names
from touchgoal.policies.perception.target_words import WORDS_WIDTH

_START = ft.FEATURES[ft.TRUTH_START].shape[0]
_PARTS = (5, 2)  # numbers of `features.TRUTH_START` on the object and on the goal
_TCP = ft.FEATURES[ft.TCP_POSE].shape[0]
_PATCH = 4  # px between two cells of a crop
_CELL = 8  # px between two cells of a finder's map
_MOVES = (-6.0, -3.0, 0.0, 3.0, 6.0)  # px by which crops are moved along each axis
_PEAK = 1.5  # cells around a map's maximum over which the place is averaged
_NEAR, _LEAST_GAIN = 40.0, -1.5  # px; a clearly better place far away still wins
# Centre of the first cell, px: that of the 8 pixels of its patch, which begin at -2.
_FIRST = 1.5
_SHIFT = 0.1  # m, unit of the camera's shift
_BRIGHTNESS, _MOST_GAIN = 110.0, 6.0  # grey levels of 255, the mean of the usual image

Images = dict[str, UInt8[Tensor, "b h w 3"]]
Places = dict[str, Float[Tensor, "b 2 2"]]
"""Row and column (px) of the object and of the goal in each camera image."""


@dataclass(frozen=True, eq=False)
class Look:
    """Estimate from images, with its confidence."""

    start: Float[Tensor, "b 7"]  # `features.TRUTH_START`
    found: Float[Tensor, "b 2"]  # share of the scores near the object and near the goal, in [0, 1]
    # Length of (cos, sin) of twice the yaw: 1 if sure, less where two yaws are as likely.
    turned: Float[Tensor, " b"]
    unmirrored: Float[Tensor, " b"]  # probability that left is left in the image
    places: Places

    @property
    def sureness(self) -> Float[Tensor, "b 4"]:
        """How sure the network is of each image: see `PoseEstimatorConfig.sure`."""
        return torch.cat([self.found, self.turned[:, None], self.unmirrored[:, None]], 1)


class PoseEstimator(nn.Module):
    """Network from the first camera images, and the object in words, to `features.TRUTH_START`."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        """Initialise at random; fit the normalizers before training."""
        super().__init__()
        self.config = config
        self.finders = nn.ModuleList(_Finder(config, box) for _, box in config.crops)
        self.looks = nn.ModuleList(
            nn.ModuleList(_SpatialSoftmax(config) for _ in _PARTS) for _ in config.crops
        )
        half = replace(
            config,
            look=min(config.size) // 2,
            keypoints=config.scene_keypoints,
            dilations=config.dilations[::2],
        )
        self.scenes = nn.ModuleList(_SpatialSoftmax(half) for _ in config.crops)
        seen = (
            _TCP + 3 + config.scene_keypoints * len(config.crops) * (2 + config.keypoint_features)
        )
        width = seen + config.keypoints * len(config.crops) * (2 + config.keypoint_features)
        self.tcp_normalizer, self.start_normalizer = Normalizer((_TCP,)), Normalizer((_START,))
        self.heads = nn.ModuleList(readout(width, config.width, part) for part in _PARTS)
        self.unmirrored = readout(seen, config.width // 4, 1)
        self.known = KnownNames(config.finder_channels)

    def forward(
        self,
        images: Images,
        tcp: Float[Tensor, "b 7"],
        shift: Float[Tensor, "b 3"],
        words: Float[Tensor, "b d"],
    ) -> Float[Tensor, "b 7"]:
        """Return the estimate: m, base frame.

        `shift` is of a calibrated front camera, see `UsualView`, 0 if unknown. `words` are
        `target_words.embed`; zeros without a sentence, where one object is there.
        """
        lit = evenly_lit(images)
        return self.look(lit, words, self.scene(lit, tcp, shift)).start

    def scene(
        self, lit: Images, tcp: Float[Tensor, "b 7"], shift: Float[Tensor, "b 3"]
    ) -> Float[Tensor, "b s"]:
        """Encode the camera's pose from the whole image, the hand's pose and the camera's shift."""
        known = [self.tcp_normalizer(tcp), shift / _SHIFT]
        for (key, _), scene in zip(self.config.crops, self.scenes, strict=True):
            halved = lit[key][:, ::2, ::2]
            middle = torch.tensor(halved.shape[1:3], device=tcp.device) / 2
            known.append(scene(halved, middle.expand(len(halved), -1)))
        return torch.cat(known, 1)

    def look(
        self,
        lit: Images,
        words: Float[Tensor, "b d"],
        scene: Float[Tensor, "b s"],
        before: Places | None = None,
    ) -> Look:
        """Find object and goal in evenly lit images; `scene` may be of the episode's first images.

        Of two objects that the words fit equally, it is the one nearer to where it was `before`.
        """
        scores = self.scores(lit, words)
        if before:
            crops = self.config.crops
            scores = {key: scores[key] + _nearness(before[key], box) for key, box in crops}
        found = {key: _find(scores[key], box) for key, box in self.config.crops}
        places = {key: place for key, (place, _) in found.items()}
        start = self.start_normalizer.inverse(self.scaled(lit, scene, places))
        surest = torch.stack([share for _, share in found.values()]).amax(0)
        turned, unmirrored = start[:, 3:5].norm(dim=1), self.unmirrored(scene)[:, 0].sigmoid()
        return Look(start, surest, turned, unmirrored, places)

    def turned_surely(self, lit: Images, scene: Float[Tensor, "1 s"], look: Look) -> Look:
        """Return a look with the surest yaw of crops around places moved by some px.

        A box that is nearly square looks turned in two ways, between which one crop may not choose: it can be
        grasped in both.
        """
        moves = torch.tensor(list(product(_MOVES, _MOVES)), dtype=torch.float)
        places = {key: place + moves[:, None] for key, place in look.places.items()}
        images = {key: some.expand(len(moves), -1, -1, -1) for key, some in lit.items()}
        scaled = self.scaled(images, scene.expand(len(moves), -1), places)
        yaws = self.start_normalizer.inverse(scaled)[:, 3:5]
        turned, start = yaws.norm(dim=1), look.start.clone()
        start[:, 3:5] = yaws[turned.argmax()]
        return replace(look, start=start, turned=turned.max()[None])

    def likeliest(
        self, lit: Images, words: Float[Tensor, "b d"]
    ) -> tuple[Float[Tensor, "b c"], Float[Tensor, "b c"]]:
        """Return the first camera's query for the words, and the key of the cell that fits them best."""
        asked, maps = self._finder.queries_for(words)[:, 0], self._maps(lit)
        cells = torch.einsum("bc,bcp->bp", asked, maps).argmax(1)
        return asked, maps[torch.arange(len(maps)), :, cells]

    def misfit(
        self, asked: Float[Tensor, "b c"], keys: Float[Tensor, "b c"]
    ) -> Float[Tensor, " b"]:
        """Return by how much words fit what is `likeliest` less than its likeliest name does."""
        best = self.known.marks(self._names(), keys).amax(1)
        return best - self.known.marks(asked, keys).diagonal()

    def seen(self, lit: Images) -> list[str]:
        """Return names of the objects in the first of some evenly lit images, the surest first."""
        centres = _centres(self.config.crops[0][1]).flatten(0, 1)
        return self.known.seen(self._names(), self._maps(lit)[0], centres)

    @property
    def _finder(self) -> "_Finder":
        return cast(_Finder, self.finders[0])

    def _names(self) -> Float[Tensor, "v c"]:
        return self._finder.queries_for(embedded_names())[:, 0]

    def _maps(self, lit: Images) -> Float[Tensor, "b c cells"]:
        return self._finder.maps(lit[self.config.crops[0][0]]).flatten(2)

    def scores(
        self, images: Images, words: Float[Tensor, "b d"]
    ) -> dict[str, Float[Tensor, "b 2 y x"]]:
        """Return logits of where the object and the goal are in each camera image."""
        return {
            key: finder(images[key], words)
            for (key, _), finder in zip(self.config.crops, self.finders, strict=True)
        }

    def place_shares(self, places: Places) -> dict[str, Float[Tensor, "b 2 y x"]]:
        """Return the targets of `scores`: what each cell should hold of a place."""
        shares = {}
        for key, box in self.config.crops:  # by the distance from the place; they sum to 1
            far = (places[key][:, :, None, None] - _centres(box).to(places[key])).square().sum(-1)
            shares[key] = (-far / _CELL**2 / 2).flatten(2).softmax(2).view_as(far)
        return shares

    def scaled(
        self, images: Images, scene: Float[Tensor, "b s"], places: Places
    ) -> Float[Tensor, "b 7"]:
        """Return the estimate from crops around these places, normalised to variance 1."""
        estimate = []
        for part, head in enumerate(self.heads):
            found = [scene]
            for (key, _), looks in zip(self.config.crops, self.looks, strict=True):
                look = cast(nn.ModuleList, looks)[part]
                found.append(look(images[key], places[key][:, part]))
            estimate.append(head(torch.cat(found, 1)))
        return torch.cat(estimate, 1)


def evenly_lit(images: Images) -> Images:
    """Return images of the same mean brightness, by a gain of at most 6."""
    lit = {}
    for key, some in images.items():
        mean = some[:, ::4, ::4].float().mean((1, 2, 3), keepdim=True)
        gain = (_BRIGHTNESS / mean).clamp(0.5, _MOST_GAIN)
        # One at a time, which stays in the processor's cache.
        rows = [(p * g).clamp_(max=255).to(torch.uint8) for p, g in zip(some, gain, strict=True)]
        lit[key] = torch.stack(rows)
    return lit


def _pixels(images: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b 3 h w"]:
    return images.permute(0, 3, 1, 2).float() / 64 - 2


class _Surroundings(nn.Module):
    """Dilated convolution, added to each cell."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.around = nn.Conv2d(width, width, 3, 1, dilation, dilation)
        self.mix = nn.Conv2d(width, width, 1)

    def forward(self, maps: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return maps + self.mix(F.relu(self.around(F.relu(maps))))


class _Finder(nn.Module):
    """Scores of the cells of a camera image: those of the object in words, and of the goal."""

    def __init__(self, config: PoseEstimatorConfig, box: Box) -> None:
        super().__init__()
        self.box, width = box, config.finder_channels
        self.patches = nn.Conv2d(3, width // 2, 8, _PATCH, 2)
        self.cells = nn.Conv2d(width // 2, width, 3, _CELL // _PATCH, 1)
        self.surroundings = nn.Sequential(_Surroundings(width, 1), _Surroundings(width, 2))
        self.keys = nn.Conv2d(width, width, 1)
        self.queries = nn.Parameter(torch.randn(2, width) / width**0.5)  # any object; the goal
        self.words = nn.Linear(WORDS_WIDTH, width, bias=False)

    def forward(
        self, images: UInt8[Tensor, "b h w 3"], words: Float[Tensor, "b d"]
    ) -> Float[Tensor, "b 2 y x"]:
        return torch.einsum("bqc,bcyx->bqyx", self.queries_for(words), self.maps(images))

    def maps(self, images: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b c y x"]:
        """Return the key of each cell."""
        top, bottom, left, right = self.box
        maps = self.patches(_pixels(images[:, top:bottom, left:right]))
        return self.keys(F.relu(self.surroundings(self.cells(F.relu(maps)))))

    def queries_for(self, words: Float[Tensor, "b d"]) -> Float[Tensor, "b 2 c"]:
        """Return the queries of the object in words, and of the goal."""
        queries = self.queries.expand(len(words), -1, -1)
        return queries + torch.stack([self.words(words), torch.zeros_like(queries[:, 1])], 1)


def _centres(box: Box) -> Float[Tensor, "y x 2"]:
    """Return row and column (px) of the centre of each cell of a finder's map."""
    top, bottom, left, right = box
    rows, columns = torch.arange(top, bottom, _CELL), torch.arange(left, right, _CELL)
    return _FIRST + torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1)


def _nearness(places: Float[Tensor, "b 2 2"], box: Box) -> Float[Tensor, "b 2 y x"]:
    """Return what each cell's score gains by its nearness to these places, at most 0."""
    far = (places[:, :, None, None] - _centres(box).to(places)).norm(dim=-1)
    return (-(far / _NEAR).square() / 2).clamp(min=_LEAST_GAIN)


def _find(
    scores: Float[Tensor, "b 2 y x"], box: Box
) -> tuple[Float[Tensor, "b 2 2"], Float[Tensor, "b 2"]]:
    """Return the places (px) around the highest scores, and their share."""
    centres = _centres(box).to(scores).flatten(0, 1)
    scores = scores.flatten(2)
    share = scores.softmax(2)
    near = (centres[share.argmax(2)][:, :, None] - centres).norm(dim=-1) <= _PEAK * _CELL
    place = scores.masked_fill(~near, -torch.inf).softmax(2) @ centres
    return place, share.masked_fill(~near, 0).sum(2)


class _SpatialSoftmax(nn.Module):
    """Keypoints of a crop: the place of each, in [-1, 1] of the whole image, and its features."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        super().__init__()
        width = config.channels
        self.side, self.count = config.look, config.keypoints
        self.patches = nn.Conv2d(3, width, 8, _PATCH, 2)
        self.surroundings = nn.Sequential(*(_Surroundings(width, d) for d in config.dilations))
        self.attention = nn.Conv2d(width, config.keypoints, 1)
        self.features = nn.Conv2d(width, config.keypoint_features, 1)

    def forward(
        self, images: UInt8[Tensor, "b h w 3"], places: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b p"]:
        size = torch.tensor(images.shape[1:3], device=places.device)
        corner = (places - self.side / 2).round().long()
        corner = corner.clamp(min=0).minimum(size - self.side)
        crops = torch.stack(
            [
                image[y : y + self.side, x : x + self.side]
                for image, (y, x) in zip(images, corner.tolist(), strict=True)
            ]
        )
        maps = F.relu(self.surroundings(self.patches(_pixels(crops))))
        attention, features = self.attention(maps), self.features(maps)
        with torch.autocast(images.device.type, enabled=False):  # bfloat16 knows places to 1 px
            found = keypoints(attention.float(), features.float())
        points = found.unflatten(1, (self.count, -1))
        within, features = points.split([2, points.shape[2] - 2], 2)
        reach = (self.side - _PATCH) / 2  # px from the crop's middle to its outermost cells
        px = corner.flip(1)[:, None] + _FIRST + reach * (within + 1)
        return torch.cat([2 * px / size.flip(0) - 1, features], 2).flatten(1)


def keypoints(
    attention: Float[Tensor, "b k y x"], features: Float[Tensor, "b f y x"]
) -> Float[Tensor, "b p"]:
    """Return the place of each keypoint (x, y in [-1, 1]) and the features there, side by side.

    p is k (2 + f): both coordinates and f features of each keypoint. A keypoint is the mean of all
    cells, weighted by the softmax of its map.
    """
    share = attention.flatten(2).softmax(2)
    h, w = attention.shape[2:]
    y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    place = torch.stack([x, y]).flatten(1).expand(len(attention), -1, -1).to(features)
    there = torch.cat([place, features.flatten(2)], 1)
    return (share @ there.mT).flatten(1)
