"""Network from the cameras' feature maps to the next key pose, and the one after it."""

from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float16
from torch import Tensor, nn

from touchgoal.policies.actions import Normalizer
from touchgoal.policies.heads.mlp import readout
from touchgoal.policies.sight.estimates import (
    ESTIMATE_DIM,
    FIXED,
    GROUPS,
    SCALES,
    estimate_from,
    seen_from,
)
from touchgoal.policies.sight.frozen_images import ImageInputConfig, ImageReadout

SEEN = 2  # key poses: the next one, and the one that follows
_PLACE, _PLACE_GROUPS = 3, 2  # of an estimate: its first numbers, and their groups
_SMALL = 0.1  # of `SCALES`, below which an error counts squared
_OPEN = 0.9  # of the range of widths, from the least
_LEAST, _MOST = -5.0, 3.0  # logarithm of a camera's expected error


class CameraReadout(nn.Module):
    """Estimates by one camera, seen from its frame, the errors that it expects, and what the gripper does.

    Place and turn have separate networks. A camera that cannot see a turn memorises it for each recording;
    with shared keypoints that would make places wrong, too.
    """

    def __init__(self, config: ImageInputConfig) -> None:
        super().__init__()
        self.place_images, self.turn_images = ImageReadout(config), ImageReadout(config)
        self.normalizer = Normalizer((_PLACE,))
        width = ImageReadout.width(config) + 2
        turns, turn_groups = ESTIMATE_DIM - _PLACE, len(GROUPS) - _PLACE_GROUPS
        self.places = readout(width, 128, SEEN * (_PLACE + _PLACE_GROUPS + 1))
        self.turns = readout(width, 128, SEEN * (turns + turn_groups))

    def fit(self, maps: Float16[Tensor, "n c y x"], places: Float[Tensor, "m 3"]) -> None:
        """Fit the normalizers to training data: places seen from the camera's frame, m."""
        self.place_images.fit(maps)
        self.turn_images.fit(maps)
        self.normalizer.fit_mean_std(places)

    def forward(
        self, maps: Float[Tensor, "b c y x"], state: Float[Tensor, "b 2"]
    ) -> tuple[Float[Tensor, "b 2 10"], Float[Tensor, "b 2 5"], Float[Tensor, "b 2"]]:
        """Return estimates, logarithms of the errors expected, and logits of the gripper's being closed."""
        seen = torch.cat([self.place_images(maps), state], 1)
        found = self.places(seen).unflatten(1, (SEEN, -1))
        place, place_error, closed = found.split([_PLACE, _PLACE_GROUPS, 1], 2)
        seen = torch.cat([self.turn_images(maps), state], 1)
        found = self.turns(seen).unflatten(1, (SEEN, -1))
        turn, turn_error = found.split(ESTIMATE_DIM - _PLACE, 2)
        estimate = torch.cat([self.normalizer.inverse(place), turn], 2)
        expected = torch.cat([place_error, turn_error], 2).clamp(_LEAST, _MOST)
        return estimate, expected, closed[..., 0]


class KeyPoseReadout(nn.Module):
    """Network from the cameras' feature maps to estimates of the next key pose and of the one after it.

    Each camera gives estimates and the errors that it expects: one on the hand seen from the hand, another
    from a fixed frame; and whether the gripper is closed after each. The estimates are averaged, the surer
    ones with more weight.
    """

    def __init__(self, config: ImageInputConfig) -> None:
        super().__init__()
        self.on_hand = config.on_hand
        self.cameras = nn.ModuleList(CameraReadout(config) for _ in config.cameras)
        self.height_normalizer = Normalizer((1,))
        self.open_width = nn.Buffer(torch.zeros(1))  # m; at less the gripper is closed, or closes
        # added to the logarithms of the expected errors
        self.calibration = nn.Buffer(torch.zeros(len(config.cameras), SEEN, len(GROUPS)))

    def fit(
        self,
        maps: Float16[Tensor, "n k c y x"],
        tcp: Float[Tensor, "n 7"],
        width: Float[Tensor, "n 1"],
        key: Float[Tensor, "n 2 8"],
    ) -> None:
        """Fit the normalizers to training data."""
        true = self._true(tcp, key)
        for k, camera in enumerate(self.cameras):
            cast(CameraReadout, camera).fit(maps[:, k], true[:, k, :, :_PLACE].flatten(0, 1))
        self.height_normalizer.fit_mean_std(tcp[:, 2:3])
        self.open_width.copy_(width.amin() + _OPEN * (width.amax() - width.amin()))

    @torch.no_grad()
    def calibrate(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
        key: Float[Tensor, "b 2 8"],
    ) -> None:
        """Scale the expected errors to those made on episodes that were not trained on.

        A network expects errors as small as those on what it has learned by heart (Guo et al. 2017).
        """
        estimates, expected, _ = self.estimates(maps, tcp, width)
        made = errors(estimates, self._true(tcp, key)) * (-expected).exp()
        self.calibration += made.mean(0).clamp(min=1e-3).log()

    def forward(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
    ) -> tuple[Float[Tensor, "b 2 11"], Float[Tensor, "b 2 5"]]:
        """Return the average of the cameras' estimates, seen from the hand.

        Then the probability that the gripper is closed after it; and how much each of `GROUPS` weighs beside
        other estimates.
        """
        estimates, expected, closed = self.estimates(maps, tcp, width)
        frames = self._frames(tcp)
        hand = tcp.repeat_interleave(SEEN, 0)
        seen = [
            seen_from(hand, estimates[:, k].flatten(0, 1), frame.repeat_interleave(SEEN, 0))
            for k, frame in enumerate(frames)
        ]
        weights = (-2 * expected).exp()  # inverse squares of the expected errors
        shares = repeated(weights / weights.sum(1, keepdim=True))
        average = (shares * torch.stack(seen, 1).unflatten(0, (-1, SEEN)).transpose(1, 2)).sum(1)
        return torch.cat([average, closed.mean(1).sigmoid()[..., None]], 2), weights.sum(1)

    def loss(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
        key: Float[Tensor, "b 2 8"],
    ) -> Float[Tensor, ""]:
        """Return the loss of the estimates and of the errors that the cameras expect.

        The expected errors do not weigh the estimates (Seitzer et al. 2022): hard images are learned, too.
        """
        estimates, expected, closed = self.estimates(maps, tcp, width)
        made = errors(estimates, self._true(tcp, key))
        robust = torch.where(made < _SMALL, made.square() / 2 / _SMALL, made - _SMALL / 2)
        sureness = made.detach() * (-expected).exp() + expected
        after = F.binary_cross_entropy_with_logits(closed, key[:, None, :, 7].expand_as(closed))
        return robust.mean() + 0.1 * sureness.mean() + 0.1 * after

    def error(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
        key: Float[Tensor, "b 2 8"],
    ) -> Float[Tensor, "b 2"]:
        """Return how far the estimates are off, m."""
        off = self(maps, tcp, width)[0][..., :-1] - _seen(tcp, key)
        return off[..., :_PLACE].norm(dim=-1)

    def estimates(
        self,
        maps: Float[Tensor, "b k c y x"],
        tcp: Float[Tensor, "b 7"],
        width: Float[Tensor, "b 1"],
    ) -> tuple[Float[Tensor, "b k 2 10"], Float[Tensor, "b k 2 5"], Float[Tensor, "b k 2"]]:
        """Return each camera's estimates, seen from its frame, and the logarithms of its expected errors.

        And the logits of the gripper's being closed after them.
        """
        height, is_open = self.height_normalizer(tcp[:, 2:3]), (width >= self.open_width).float()
        state = torch.cat([height, is_open], 1)  # the width itself depends on how an object is held
        found = [camera(maps[:, k], state) for k, camera in enumerate(self.cameras)]
        estimates, expected, closed = (torch.stack(x, 1) for x in zip(*found, strict=True))
        return estimates, expected + self.calibration, closed

    def _frames(self, tcp: Float[Tensor, "b 7"]) -> list[Float[Tensor, "b 7"]]:
        """Return the frame that each camera's estimates are seen from."""
        fixed = torch.tensor(FIXED).to(tcp).expand_as(tcp)
        return [tcp if on_hand else fixed for on_hand in self.on_hand]

    def _true(
        self, tcp: Float[Tensor, "b 7"], key: Float[Tensor, "b 2 8"]
    ) -> Float[Tensor, "b k 2 10"]:
        """Return what each camera should estimate."""
        return torch.stack([_seen(frame, key) for frame in self._frames(tcp)], 1)


def _seen(frame: Float[Tensor, "b 7"], key: Float[Tensor, "b 2 8"]) -> Float[Tensor, "b 2 10"]:
    """Return the estimates that true key poses are, seen from `frame`."""
    return torch.stack([estimate_from(frame, key[:, n, :7]) for n in range(SEEN)], 1)


def errors(
    estimates: Float[Tensor, "b k 2 10"], true: Float[Tensor, "b k 2 10"]
) -> Float[Tensor, "b k 2 5"]:
    """Return how far each of `GROUPS` is off, relative to `SCALES`."""
    off = (estimates - true).split(GROUPS, -1)
    return torch.stack([x.norm(dim=-1) / s for x, s in zip(off, SCALES, strict=True)], -1)


def repeated(groups: Float[Tensor, "... 5"]) -> Float[Tensor, "... 10"]:
    """Return a number of each of `GROUPS` for each of its numbers."""
    return groups.repeat_interleave(torch.tensor(GROUPS).to(groups.device), -1)
