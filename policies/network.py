"""The policy's network: observations of the last ticks to actions of the next ones."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float16, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.policies.actions import ACTION_DIM, Normalizer, to_actions, to_representation
from touchgoal.policies.config import ActionRepresentation
from touchgoal.policies.heads.diffusion import Diffusion, DiffusionConfig, Regression
from touchgoal.policies.heads.end import EndOutput
from touchgoal.policies.heads.mlp import MLPConfig
from touchgoal.policies.heads.unet import UNetConfig
from touchgoal.policies.perception.end_to_end import EndToEndConfig, EndToEndEncoder
from touchgoal.policies.perception.novelty import NoveltyDetector
from touchgoal.policies.perception.proprioception import (
    input_widths,
    is_motion,
    is_position,
    network_input,
)
from touchgoal.policies.sight import key_pose as kp
from touchgoal.policies.sight.average import KeyPoseAverage
from touchgoal.policies.sight.frozen_images import ImageInputConfig
from touchgoal.policies.sight.readout import KeyPoseReadout
from touchgoal.runtime.errors import UserError

_DRAWS = 8  # noise draws per window with cameras: the camera network costs most of a training step
NOVEL_SECONDS = 1.0  # s for which novelty must last to count
_CLIP = 5.0  # standard deviations


@dataclass(frozen=True)
class PolicyConfig:
    """Inputs and outputs of a policy."""

    touch_dim: int  # of the frozen embedding of both fingertips together; 0 without touch
    touch: str  # names what made the embeddings: encoder, sensor, background
    touch_projection_dim: int = 64  # to which a projection, trained on the actions, narrows it
    watches_novelty: bool = False  # whether it detects touch that is unlike the training's
    says_end: bool = False  # whether it says when the task is done
    # standard deviation of noise on normalised embeddings in training. Without it the network
    # recognises each recorded episode by its sensors
    touch_noise: float = 0.1
    # likewise on joint and TCP positions, the same for all observed ticks, so that the network
    # cannot infer a wire's course from its place on the table. "body_twist" reads no positions
    position_noise: float = 0.3
    # m, the only two widths that the demonstrations command. A predicted width becomes the nearest of
    # them, because the hand would stop at one in between. Empty: any width
    gripper_widths: tuple[float, ...] = ()
    gripper_changes: int = 0  # fewest in a demonstration with cameras; after fewer it is not done
    end_to_end: EndToEndConfig | None = None  # touch encoder that is trained jointly; None without
    images: ImageInputConfig | None = None  # cameras, by a frozen image encoder; None without
    # columns of `features.FEATURES`, the state first. Columns of ground truth come from a state
    # estimator on an arm. The wrench is tared, see `proprioception.tare`
    proprioception: tuple[str, ...] = (ft.STATE, ft.TCP_POSE)
    observation_horizon: int = 2  # ticks observed, the latest included
    # ticks planned, from the latest observation on; diffusion_policy counts from the oldest one
    prediction_horizon: int = 8
    execution_horizon: int = 2  # ticks of a plan that are executed before the next one
    representation: ActionRepresentation = "relative"  # of the actions in training
    # middle share of the training's actions that the head's range of -1 to 1 covers
    action_share: float = 1.0
    control_hz: int = ft.CONTROL_HZ  # ticks per second
    # predicts the plan; an MLPConfig is that of a regression
    head: DiffusionConfig | MLPConfig = field(default_factory=DiffusionConfig)
    task: str = ""  # of the training episodes, such as "bead-maze"; "" if unknown
    sensor: str = ""  # of the fingertips in them; "" without touch

    def __post_init__(self) -> None:
        if self.proprioception[:1] != (ft.STATE,) or not set(self.proprioception) <= set(
            ft.FEATURES
        ):
            raise UserError(f"proprioception must be known columns, {ft.STATE} first")
        columns = set(self.proprioception) - {ft.COMMAND}
        if self.representation == "body_twist" and columns != {ft.STATE, ft.TCP_POSE}:
            raise UserError(
                'representation "body_twist" reads neither force nor object: choose "base_twist"'
            )
        if not 1 <= self.execution_horizon <= self.prediction_horizon:
            raise UserError(
                f"execution_horizon {self.execution_horizon} must be between 1 and the "
                f"prediction_horizon {self.prediction_horizon}"
            )
        if isinstance(self.head, DiffusionConfig) and isinstance(self.head.denoiser, UNetConfig):
            factor = self.head.denoiser.tick_multiple
            if self.prediction_horizon % factor:
                raise UserError(
                    f"prediction_horizon {self.prediction_horizon} must be a multiple of {factor} "
                    "for this U-Net"
                )

    @property
    def estimated(self) -> tuple[str, ...]:
        """Columns that a state estimator supplies on an arm."""
        return tuple(key for key in self.proprioception if not key.startswith("observation."))

    @property
    def proprioception_dim(self) -> int:
        """Width of `proprioception.network_input`."""
        return sum(input_widths(self.proprioception, self.representation))


@dataclass(frozen=True, eq=False)
class ObservationBatch:
    """Observations of the last ticks, oldest first."""

    touch: Float[Tensor, "b o e"]  # frozen embeddings of left and right fingertip, side by side
    state: Float[Tensor, "b o s"]  # `PolicyConfig.proprioception`, side by side, SI units
    # difference images of the latest tick, for the end-to-end encoder; None without
    images: UInt8[Tensor, "b k h w 3"] | None = None
    # feature maps of the latest tick's camera images, see `ImageEmbedder`; None without
    maps: Float16[Tensor, "b k c y x"] | None = None

    @property
    def joints(self) -> Float[Tensor, "b 7"]:
        """Joint positions measured at the latest tick, rad."""
        return self.state[:, -1, : ft.N_JOINTS]

    def to(self, device: torch.device) -> "ObservationBatch":
        """Return the batch on another device; Accelerate looks for this."""
        images, maps = (x if x is None else x.to(device) for x in (self.images, self.maps))
        return ObservationBatch(self.touch.to(device), self.state.to(device), images, maps)


class Plan(NamedTuple):
    """Actions, and whether the task looks done."""

    actions: Float[Tensor, "b h 8"]  # `features.ACTION`, from the tick of the latest observation on
    done: Bool[Tensor, " b"]


class PolicyNetwork(nn.Module):
    """Network from an observation batch to actions, with its normalizers inside."""

    def __init__(self, config: PolicyConfig) -> None:
        """Initialise at random; call `fit_normalizers` before training."""
        super().__init__()
        self.config = config
        ticks = config.prediction_horizon
        self.touch_normalizer = Normalizer((config.touch_dim,))
        self.state_normalizer = Normalizer((config.proprioception_dim,))
        self.action_normalizer = Normalizer((ticks, ACTION_DIM))
        # narrowed before the U-Net, whose FiLM would multiply the embedding's width
        width = config.touch_projection_dim if config.touch_dim else 0
        self.touch_readout = nn.Linear(config.touch_dim, width) if width else None
        condition_dim = config.observation_horizon * (width + config.proprioception_dim)
        self.end_to_end_encoder = None
        if config.end_to_end:
            self.end_to_end_encoder = EndToEndEncoder(config.end_to_end)
            condition_dim += len(ft.TACTILE) * config.end_to_end.width
        self.key_pose = KeyPoseReadout(config.images) if config.images else None
        watches = config.watches_novelty and config.touch_dim > 0
        self.novelty = NoveltyDetector(config.touch_dim) if watches else None
        condition_dim += kp.KEY_POSE_DIM if self.key_pose else 0
        self.condition_dim = condition_dim
        if isinstance(config.head, DiffusionConfig):
            self.head = Diffusion(config.head, ticks, ACTION_DIM, condition_dim)
        else:
            self.head = Regression(config.head, ticks, ACTION_DIM, condition_dim)
        self.end = EndOutput(condition_dim) if config.says_end else None  # drawn last

    def fit_normalizers(
        self,
        touch: Float[Tensor, "n e"],
        state: Float[Tensor, "n s"],
        joints: Float[Tensor, "m 7"],
        actions: Float[Tensor, "m h 8"],
        action_is_pad: Bool[Tensor, "m h"],
        maps: Float16[Tensor, "n k c y x"] | None = None,
        key_pose: Float[Tensor, "n 3 8"] | None = None,
    ) -> None:
        """Fit the normalizers to training data: n ticks, and the chunks of m windows.

        Inputs get variance 1. Actions get the range -1 to 1, each tick of the chunk by itself: the
        last of a relative plan moves eight times as far as the first. Padded actions do not count.
        """
        if self.config.touch_dim:
            self.touch_normalizer.fit_mean_std(touch)
        if self.key_pose:
            assert maps is not None and key_pose is not None, "needs maps and key poses"
            self.key_pose.fit(maps, self._hand(state), key_pose[:, 1:])
        columns, kind = self.config.proprioception, self.config.representation
        self.state_normalizer.fit_mean_std(network_input(state, columns, kind))
        chunks = to_representation(actions, joints, kind)
        valid = ~action_is_pad[..., None]
        self.action_normalizer.fit_range(chunks, valid, self.config.action_share)

    def fit_novelty(self, touch: Float[Tensor, "n e"], lengths: Sequence[int]) -> None:
        """Fit the detector of novelty, where there is one, to the ticks of episodes of these lengths."""
        if self.novelty:
            self.novelty.fit(touch, lengths, round(NOVEL_SECONDS * self.config.control_hz))

    @torch.inference_mode()
    def novelty_of(self, batch: ObservationBatch) -> float:
        """Return the novelty of the first observation's latest touch; above 1 it is unknown."""
        return self.novelty(batch.touch[:1, -1]).item() if self.novelty else 0.0

    def condition(
        self, batch: ObservationBatch, key_pose: Float[Tensor, "b 3 8"] | None = None
    ) -> Float[Tensor, "b c"]:
        """Return what the head reads, with cameras at true key poses."""
        return self._encode(batch, self._true_pose(batch, key_pose))

    def forward(
        self,
        observed: ObservationBatch,
        actions: Float[Tensor, "b h 8"],
        noise: BatchNoise,
        action_is_pad: Bool[Tensor, "b h"],
        key_pose: Float[Tensor, "b 3 8"] | None = None,
    ) -> dict[str, Tensor]:
        """Return the training's "loss" on windows, without ticks after the episode's end.

        With cameras it needs the next key poses.
        """
        pose, key_pose_loss = None, torch.zeros((), device=actions.device)
        if self.key_pose:
            assert key_pose is not None, "needs key poses"
            maps, hand = self.seen(observed)
            key_pose_loss = self.key_pose.loss(maps, hand, key_pose[:, 1:])
            pose = kp.true_pose(hand[:, :7], key_pose)
            draws = 1 if self.end_to_end_encoder else _DRAWS
            seen = observed.touch, observed.state, observed.images
            rows = *seen, pose, actions, action_is_pad
            again: list[Any] = [None if x is None else x.repeat_interleave(draws, 0) for x in rows]
            touch, state, images, pose, actions, action_is_pad = again
            observed = ObservationBatch(touch, state, images)
        chunk = to_representation(actions, observed.joints, self.config.representation)
        if pose is not None and self.config.representation == "body_twist":
            pose, chunk = kp.face_any_way(pose, chunk, noise)
            pose, chunk = kp.set_beside(pose, chunk, noise)
        encoded = self._encode(observed, pose, noise)
        loss = self.head.loss(self.action_normalizer(chunk), encoded, noise, action_is_pad)
        return {"loss": loss + key_pose_loss}

    def seen(
        self, batch: ObservationBatch
    ) -> tuple[Float[Tensor, "b k c y x"], Float[Tensor, "b 8"]]:
        """Return what a `KeyPoseReadout` takes at the latest tick: feature maps, and the hand."""
        assert batch.maps is not None, "needs the cameras' feature maps"
        return batch.maps.float(), self._hand(batch.state[:, -1])

    def _hand(self, state: Float[Tensor, "b s"]) -> Float[Tensor, "b 8"]:
        """Return the TCP's pose and the gripper's width."""
        widths = [ft.FEATURES[key].shape[0] for key in self.config.proprioception]
        columns = dict(zip(self.config.proprioception, state.split(widths, 1), strict=True))
        return torch.cat([columns[ft.TCP_POSE], columns[ft.STATE][:, -1:]], 1)

    @torch.inference_mode()
    def plan(
        self,
        batch: ObservationBatch,
        generator: torch.Generator,
        width: float | None = None,
        average: KeyPoseAverage | None = None,
        key_pose: Float[Tensor, "b 3 8"] | None = None,
    ) -> Plan:
        """Return a plan for each observation.

        The same generator state (on the CPU) gives the same plan. With cameras the gripper keeps `width`
        (m), the last plan's, until the hand is at the next key pose; this needs the `average` of the
        episode's estimates, or the true key poses.
        """
        keeps = average is not None and average.gripper_moves
        pose = self._true_pose(batch, key_pose)
        if self.key_pose and pose is None:
            assert average is not None, "needs the episode's average, or the true key poses"
            maps, hand = self.seen(batch)
            estimate, weight = self.key_pose(maps, hand)
            pose = average.add(estimate, weight, hand[:, :7])
        encoded = self._encode(batch, pose)
        chunk = self.action_normalizer.inverse(self.head.sample(encoded, generator))
        actions = to_actions(chunk, batch.joints, self.config.representation)
        if widths := self.config.gripper_widths:
            levels = torch.tensor(widths).to(actions)
            actions[..., -1] = levels[(actions[..., -1:] - levels).abs().argmin(-1)]
            if pose is not None and width is not None:
                tcp = torch.stack([self._hand(state)[:, :7] for state in batch.state.unbind(1)], 1)
                planned = kp.gripper_plan(pose, tcp, actions[..., -1], width, widths)
                actions[..., -1] = width if keeps else planned
        never = torch.zeros(len(actions), dtype=torch.bool)
        return Plan(actions, never if self.end is None else self.end(encoded) > self.end.limit)

    def _true_pose(
        self, batch: ObservationBatch, key_pose: Float[Tensor, "b 3 8"] | None
    ) -> Float[Tensor, "b 11"] | None:
        if key_pose is None:
            return None
        return kp.true_pose(self._hand(batch.state[:, -1])[:, :7], key_pose)

    def _encode(
        self,
        batch: ObservationBatch,
        pose: Float[Tensor, "b 11"] | None,
        noise: BatchNoise | None = None,
    ) -> Float[Tensor, "b c"]:
        """Return what the head reads, with the training's noise if given."""
        columns, kind = self.config.proprioception, self.config.representation
        touch = batch.state[..., :0]
        if self.touch_readout is not None:
            touch = self.touch_normalizer(batch.touch).clamp(-_CLIP, _CLIP)
            if noise is not None:
                touch = touch + self.config.touch_noise * noise.randn(touch.shape).to(touch)
            touch = self.touch_readout(touch)
        state = network_input(batch.state, columns, kind)
        state = self.state_normalizer(state).clamp(-_CLIP, _CLIP)
        if self.key_pose:  # it would repeat its last motion (de Haan et al. 2019), and come to rest
            state = state * (1 - is_motion(columns, kind)).to(state)
        if noise is not None:
            shift = noise.randn((len(state), 1, state.shape[2])).to(state)
            state = state + self.config.position_noise * shift * is_position(columns, kind).to(
                state
            )
        parts = [torch.cat([touch, state], -1).flatten(1)]
        if self.end_to_end_encoder:
            assert batch.images is not None, "needs tactile images"
            parts.append(self.end_to_end_encoder(batch.images))
        if pose is not None:
            parts.append(kp.features(pose, noise))
        return torch.cat(parts, 1)
