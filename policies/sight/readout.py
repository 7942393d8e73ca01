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
    to_frame,
)
from touchgoal.policies.sight.frozen_images import ImageInputConfig, ImageReadout

COUNT = 2  # key poses: the next one, and the one after it
_PLACE, _PLACE_GROUPS = 3, 2  # an estimate's numbers that are a position, and their groups
_SMALL = 0.1  # error relative to `SCALES` below which it counts squared
_OPEN = 0.9  # share of the range of widths above which the gripper is open
_LEAST, _MOST = -5.0, 3.0  # bounds of the logarithm of an expected error


class CameraReadout(nn.Module):
    """Network from one camera's maps to key pose estimates in its frame, expected errors and gripper state.

    Position and rotation have separate networks. A camera that cannot see a rotation memorises it for each
    recording; with shared keypoints its positions would be wrong, too.
    """

    def __init__(self, config: ImageInputConfig) -> None:
        super().__init__()
        self.place_images, self.turn_images = ImageReadout(config), ImageReadout(config)
        self.normalizer = Normalizer((_PLACE,))
        width = 2 * config.keypoints + 2
        turns, turn_groups = ESTIMATE_DIM - _PLACE, len(GROUPS) - _PLACE_GROUPS
        self.places = readout(width, 128, COUNT * (_PLACE + _PLACE_GROUPS + 1))
        self.turns = readout(width, 128, COUNT * (turns + turn_groups))

    def fit(self, maps: Float16[Tensor, "n c y x"], places: Float[Tensor, "m 3"]) -> None:
        """Fit the normalizers to training data; `places` are positions in the camera's frame, m."""
        self.place_images.fit(maps)
        self.turn_images.fit(maps)
        self.normalizer.fit_mean_std(places)

    def forward(
        self, maps: Float[Tensor, "b c y x"], state: Float[Tensor, "b 2"]
    ) -> tuple[Float[Tensor, "b 2 10"], Float[Tensor, "b 2 5"], Float[Tensor, "b 2"]]:
        """Return estimates, logarithms of the expected errors, and logits of a closed gripper."""
        points = torch.cat([self.place_images(maps), state], 1)
        found = self.places(points).unflatten(1, (COUNT, -1))
        place, place_error, closed = found.split([_PLACE, _PLACE_GROUPS, 1], 2)
        points = torch.cat([self.turn_images(maps), state], 1)
        found = self.turns(points).unflatten(1, (COUNT, -1))
        turn, turn_error = found.split(ESTIMATE_DIM - _PLACE, 2)
        estimate = torch.cat([self.normalizer.inverse(place), turn], 2)
        expected = torch.cat([place_error, turn_error], 2).clamp(_LEAST, _MOST)
        return estimate, expected, closed[..., 0]


class KeyPoseReadout(nn.Module):
    """Network from the cameras' feature maps to estimates of the next key pose and of the one after it.

    Each camera predicts estimates, their expected errors, and whether the gripper is closed after each. A
    camera on the hand estimates in the hand's frame, any other in a fixed frame. The estimates are averaged,
    weighted by their expected errors.
    """

    def __init__(self, config: ImageInputConfig) -> None:
        super().__init__()
        self.on_hand = config.on_hand
        self.cameras = nn.ModuleList(CameraReadout(config) for _ in config.cameras)
        self.height_normalizer = Normalizer((1,))
        self.open_width = nn.Buffer(torch.zeros(1))  # m; at less the gripper is closed, or closes
        # added to the logarithms of the expected errors
        self.calibration = nn.Buffer(torch.zeros(len(config.cameras), COUNT, len(GROUPS)))

    def fit(
        self,
        maps: Float16[Tensor, "n k c y x"],
        hand: Float[Tensor, "n 8"],
        key: Float[Tensor, "n 2 8"],
    ) -> None:
        """Fit the normalizers to training data; `hand` is TCP pose and gripper width."""
        tcp, width = hand.split([7, 1], 1)
        true = self._true(tcp, key)
        for k, camera in enumerate(self.cameras):
            cast(CameraReadout, camera).fit(maps[:, k], true[:, k, :, :_PLACE].flatten(0, 1))
        self.height_normalizer.fit_mean_std(tcp[:, 2:3])
        self.open_width.copy_(width.amin() + _OPEN * (width.amax() - width.amin()))

    @torch.no_grad()
    def calibrate(
        self,
        maps: Float[Tensor, "b k c y x"],
        hand: Float[Tensor, "b 8"],
        key: Float[Tensor, "b 2 8"],
    ) -> None:
        """Scale the expected errors to the actual ones on validation episodes.

        A network that overfits expects too small errors (Guo et al. 2017).
        """
        estimates, expected, _ = self.estimates(maps, hand)
        made = errors(estimates, self._true(hand[:, :7], key)) * (-expected).exp()
        self.calibration += made.mean(0).clamp(min=1e-3).log()

    def forward(
        self, maps: Float[Tensor, "b k c y x"], hand: Float[Tensor, "b 8"]
    ) -> tuple[Float[Tensor, "b 2 11"], Float[Tensor, "b 2 5"]]:
        """Return the average of the cameras' estimates, in the hand's frame, and the weights of `GROUPS`.

        The last number of an estimate is the probability that the gripper is closed afterwards.
        """
        estimates, expected, closed = self.estimates(maps, hand)
        frames, tcp = self._frames(hand[:, :7]), hand[:, :7].repeat_interleave(COUNT, 0)
        estimated = [
            to_frame(tcp, estimates[:, k].flatten(0, 1), frame.repeat_interleave(COUNT, 0))
            for k, frame in enumerate(frames)
        ]
        weights = (-2 * expected).exp()  # inverse squares of the expected errors
        shares = repeated(weights / weights.sum(1, keepdim=True))
        average = (
            shares * torch.stack(estimated, 1).unflatten(0, (-1, COUNT)).transpose(1, 2)
        ).sum(1)
        return torch.cat([average, closed.mean(1).sigmoid()[..., None]], 2), weights.sum(1)

    def loss(
        self,
        maps: Float[Tensor, "b k c y x"],
        hand: Float[Tensor, "b 8"],
        key: Float[Tensor, "b 2 8"],
    ) -> Float[Tensor, ""]:
        """Return the loss of the estimates and of their expected errors.

        The expected errors do not weight the estimates (Seitzer et al. 2022), so that hard images are learned.
        """
        estimates, expected, closed = self.estimates(maps, hand)
        made = errors(estimates, self._true(hand[:, :7], key))
        robust = torch.where(made < _SMALL, made.square() / 2 / _SMALL, made - _SMALL / 2)
        sureness = made.detach() * (-expected).exp() + expected
        after = F.binary_cross_entropy_with_logits(closed, key[:, None, :, 7].expand_as(closed))
        return robust.mean() + 0.1 * sureness.mean() + 0.1 * after

    def error(
        self,
        maps: Float[Tensor, "b k c y x"],
        hand: Float[Tensor, "b 8"],
        key: Float[Tensor, "b 2 8"],
    ) -> Float[Tensor, "b 2"]:
        """Return the position errors of the estimates, m."""
        off = self(maps, hand)[0][..., :-1] - _estimates_in(hand[:, :7], key)
        return off[..., :_PLACE].norm(dim=-1)

    def estimates(
        self, maps: Float[Tensor, "b k c y x"], hand: Float[Tensor, "b 8"]
    ) -> tuple[Float[Tensor, "b k 2 10"], Float[Tensor, "b k 2 5"], Float[Tensor, "b k 2"]]:
        """Return each camera's estimates in its frame, log expected errors, and logits of a closed gripper."""
        height = self.height_normalizer(hand[:, 2:3])
        is_open = (hand[:, 7:] >= self.open_width).float()
        state = torch.cat([height, is_open], 1)  # the width itself depends on how an object is held
        found = [camera(maps[:, k], state) for k, camera in enumerate(self.cameras)]
        estimates, expected, closed = (torch.stack(x, 1) for x in zip(*found, strict=True))
        return estimates, expected + self.calibration, closed

    def _frames(self, tcp: Float[Tensor, "b 7"]) -> list[Float[Tensor, "b 7"]]:
        """Return the frame of each camera's estimates."""
        fixed = torch.tensor(FIXED).to(tcp).expand_as(tcp)
        return [tcp if on_hand else fixed for on_hand in self.on_hand]

    def _true(
        self, tcp: Float[Tensor, "b 7"], key: Float[Tensor, "b 2 8"]
    ) -> Float[Tensor, "b k 2 10"]:
        """Return the true estimates in each camera's frame."""
        return torch.stack([_estimates_in(frame, key) for frame in self._frames(tcp)], 1)


def _estimates_in(
    frame: Float[Tensor, "b 7"], key: Float[Tensor, "b 2 8"]
) -> Float[Tensor, "b 2 10"]:
    """Express true key poses as estimates in `frame`."""
    return torch.stack([estimate_from(frame, key[:, n, :7]) for n in range(COUNT)], 1)


def errors(
    estimates: Float[Tensor, "b k 2 10"], true: Float[Tensor, "b k 2 10"]
) -> Float[Tensor, "b k 2 5"]:
    """Return the error of each of `GROUPS`, relative to `SCALES`."""
    off = (estimates - true).split(GROUPS, -1)
    return torch.stack([x.norm(dim=-1) / s for x, s in zip(off, SCALES, strict=True)], -1)


def repeated(groups: Float[Tensor, "... 5"]) -> Float[Tensor, "... 10"]:
    """Repeat the number of each of `GROUPS` for all its components."""
    return groups.repeat_interleave(torch.tensor(GROUPS).to(groups.device), -1)
