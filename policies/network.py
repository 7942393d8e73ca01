"""The policy: from what both fingertips and the arm have felt to the actions of the next ticks."""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.policies.actions import (
    ACTION_DIM,
    Normalizer,
    nearest,
    to_actions,
    to_representation,
)
from touchgoal.policies.config import ActionRepresentation, TouchInput
from touchgoal.policies.heads.diffusion import (
    Diffusion,
    DiffusionConfig,
    Regression,
    RegressionConfig,
)
from touchgoal.policies.perception.end_to_end import EndToEndConfig, EndToEndEncoder
from touchgoal.policies.perception.proprioception import input_widths, is_position, network_input
from touchgoal.runtime.errors import UserError

WRENCH_DIM = ft.FEATURES[ft.TRUTH_PAD_WRENCH].shape[0]
_CLIP = 5.0  # standard deviations beyond which an input is as surprising as it gets


@dataclass(frozen=True)
class PolicyConfig:
    """What a policy sees and does.

    Attributes:
        touch_dim: of the frozen embedding of both fingertips together; 0 for a policy without
            touch.
        touch: names what made the embeddings: encoder, sensor, background.
        touch_input: what of the embeddings reaches the head. "wrench": a small network reads the wrenches on
            both pads out of them, which learns from what the simulator says acted there and from
            nothing else (TacBench's force estimation, T1), and the head sees the 12 numbers.
            "embedding": a projection that learns from the actions alone, for episodes without that truth.
        touch_projection_dim: to which an embedding is projected, with "embedding".
        touch_noise: standard deviation of noise added to the touch while learning, of embeddings
            scaled to variance 1. Without it a network knows each recorded episode again by its
            sensors, and learns its wire by heart.
        position_noise: likewise of the joint and TCP positions, one draw for all ticks seen: where on
            the table a wire ran shall not tell how it goes on. Velocities and the hand's
            orientation stay as they are. "body_twist" sees no positions.
        gripper_widths: m, all that the demonstrations ask for, if those are two: what is predicted in
            between, where the network is not sure, becomes the nearer one, for a hand that is sent a
            width on the way goes there. Empty: any width.
        end_to_end: for fingertips that no frozen encoder reads; None for a policy without.
        proprioception: columns of `features.FEATURES`, the state first. Where it acts, those that
            only a simulator knows come from its state estimator, see `state_estimation.py`. The force on
            the hand is seen less that of the episode's first tick, see `proprioception.tare`.
        observation_horizon: ticks seen, the latest included.
        prediction_horizon: ticks planned. The first is the latest observation's, so that all of
            them can be done; diffusion_policy counts from the oldest observation instead.
        execution_horizon: ticks of a plan that are done before the next one.
        representation: of the actions while learning; "body_twist" also sees along the hand's own axes,
            see `proprioception.py`.
        control_hz: ticks per second.
        head: what draws the plan.
        task: of the episodes learned from, such as "bead-maze"; "" if unknown.
        sensor: of the fingertips in them; "" for a policy without touch.
    """

    touch_dim: int
    touch: str
    touch_input: TouchInput = "wrench"
    touch_projection_dim: int = 64
    touch_noise: float = 0.1
    position_noise: float = 0.3
    gripper_widths: tuple[float, ...] = ()
    end_to_end: EndToEndConfig | None = None
    proprioception: tuple[str, ...] = (ft.STATE, ft.TCP_POSE)
    observation_horizon: int = 2
    prediction_horizon: int = 8
    execution_horizon: int = 2
    representation: ActionRepresentation = "relative"
    control_hz: int = ft.CONTROL_HZ
    head: DiffusionConfig | RegressionConfig = field(default_factory=DiffusionConfig)
    task: str = ""
    sensor: str = ""

    def __post_init__(self) -> None:
        """Raises UserError for what makes no policy."""
        if self.proprioception[:1] != (ft.STATE,) or not set(self.proprioception) <= set(
            ft.FEATURES
        ):
            raise UserError(f"proprioception must be known columns, {ft.STATE} first")
        seen = set(self.proprioception) - {ft.COMMAND}
        if self.representation == "body_twist" and seen != {ft.STATE, ft.TCP_POSE}:
            raise UserError(
                'representation "body_twist" sees the arm alone, neither force nor object: choose "base_twist"'
            )
        if not 1 <= self.execution_horizon <= self.prediction_horizon:
            raise UserError(
                f"execution_horizon {self.execution_horizon} must be between 1 and the "
                f"prediction_horizon {self.prediction_horizon}"
            )
        if isinstance(self.head, DiffusionConfig):
            factor = self.head.unet.tick_multiple
            if self.prediction_horizon % factor:
                raise UserError(
                    f"prediction_horizon {self.prediction_horizon} must be a multiple of {factor} "
                    "for this U-Net"
                )

    @property
    def reads_wrench(self) -> bool:
        """Whether its training needs `truth.pad_wrench`."""
        return self.touch_dim > 0 and self.touch_input == "wrench"

    @property
    def estimated(self) -> tuple[str, ...]:
        """Columns that senses must read where there is no simulator to ask."""
        return tuple(key for key in self.proprioception if not key.startswith("observation."))

    @property
    def state_dim(self) -> int:
        """Width of the proprioception of one tick."""
        return sum(ft.FEATURES[key].shape[0] for key in self.proprioception)

    @property
    def proprioception_dim(self) -> int:
        """Width of the proprioception as the network sees it, see `proprioception.network_input`."""
        return sum(input_widths(self.proprioception, self.representation))


@dataclass(frozen=True, eq=False)
class ObservationBatch:
    """What a policy has seen on the last ticks, oldest first, as it was measured.

    Attributes:
        touch: frozen embeddings of the left and the right fingertip, side by side.
        state: columns of `PolicyConfig.proprioception`, side by side, SI units.
        pictures: of the latest tick, for the end-to-end encoder, see `end_to_end.difference_images`; None without.
    """

    touch: Float[Tensor, "b o e"]
    state: Float[Tensor, "b o s"]
    pictures: UInt8[Tensor, "b k h w 3"] | None = None

    @property
    def joints(self) -> Float[Tensor, "b 7"]:
        """Joint positions measured at the latest tick, rad."""
        return self.state[:, -1, : ft.N_JOINTS]


class PolicyNetwork(nn.Module):
    """Network from an observation batch to actions, with its normalizers inside."""

    def __init__(self, config: PolicyConfig) -> None:
        """Randomly initialised; `fit_normalizers` comes before training."""
        super().__init__()
        self.config = config
        ticks = config.prediction_horizon
        self.touch_normalizer = Normalizer((config.touch_dim,))
        self.wrench_normalizer = Normalizer((WRENCH_DIM,))
        self.state_normalizer = Normalizer((config.proprioception_dim,))
        self.action_normalizer = Normalizer((ticks, ACTION_DIM))
        # narrowed before the U-Net, whose FiLM would multiply the embedding's width
        self.touch_readout, width = None, 0
        if config.reads_wrench:
            width, hidden = WRENCH_DIM, 256
            self.touch_readout = nn.Sequential(
                nn.Linear(config.touch_dim, hidden), nn.Mish(),
                nn.Linear(hidden, hidden), nn.Mish(),
                nn.Linear(hidden, width),
            )  # fmt: skip
        elif config.touch_dim:
            width = config.touch_projection_dim
            self.touch_readout = nn.Linear(config.touch_dim, width)
        condition_dim = config.observation_horizon * (width + config.proprioception_dim)
        self.end_to_end_encoder = None
        if config.end_to_end:
            self.end_to_end_encoder = EndToEndEncoder(config.end_to_end)
            condition_dim += len(ft.TACTILE) * config.end_to_end.width
        self.condition_dim = condition_dim
        if isinstance(config.head, DiffusionConfig):
            self.head = Diffusion(config.head, ticks, ACTION_DIM, condition_dim)
        else:
            self.head = Regression(config.head, ticks, ACTION_DIM, condition_dim)

    def fit_normalizers(
        self,
        touch: Float[Tensor, "n e"],
        state: Float[Tensor, "n s"],
        joints: Float[Tensor, "m 7"],
        actions: Float[Tensor, "m h 8"],
        wrench: Float[Tensor, "n 12"] | None = None,
        action_is_pad: Bool[Tensor, "m h"] | None = None,
    ) -> None:
        """Fits the scales to training data: n ticks, and the chunks of m windows.

        Inputs get variance 1, actions the range -1 to 1, for each tick of the chunk by itself: the
        first of a relative plan moves an eighth of what the last does. Padded actions do not
        count.
        """
        if self.config.touch_dim:
            self.touch_normalizer.fit_mean_std(touch)
        if wrench is not None:
            self.wrench_normalizer.fit_mean_std(wrench)
        columns, kind = self.config.proprioception, self.config.representation
        self.state_normalizer.fit_mean_std(network_input(state, columns, kind))
        valid = None if action_is_pad is None else ~action_is_pad[..., None]
        self.action_normalizer.fit_range(to_representation(actions, joints, kind), valid)

    def loss(
        self,
        batch: ObservationBatch,
        actions: Float[Tensor, "b h 8"],
        noise: BatchNoise,
        wrench: Float[Tensor, "b o 12"] | None = None,
        action_is_pad: Bool[Tensor, "b h"] | None = None,
    ) -> Float[Tensor, ""]:
        """Training loss on windows.

        Args:
            batch: what was seen.
            actions: what was done.
            noise: random numbers of the batch.
            wrench: what acted on both pads, where touch is read as that.
            action_is_pad: the ticks that lie after the episode's end, of which nothing is learned.
        """
        chunk = to_representation(actions, batch.joints, self.config.representation)
        touch = self._encode_touch(batch, noise)
        wrench_loss = torch.zeros((), device=touch.device)
        if self.config.reads_wrench:
            assert wrench is not None, "this policy learns to read wrenches"
            wrench_loss = F.mse_loss(touch, self.wrench_normalizer(wrench))
            touch = touch.detach()
        encoded = self._encode(batch, touch, noise)
        loss = self.head.loss(self.action_normalizer(chunk), encoded, noise, action_is_pad)
        return loss + wrench_loss

    @torch.inference_mode()
    def plan(self, batch: ObservationBatch, generator: torch.Generator) -> Float[Tensor, "b h 8"]:
        """Actions (`features.ACTION`) of the ticks from the latest observation on.

        The same generator state (on the CPU) gives the same plan.
        """
        encoded = self._encode(batch, self._encode_touch(batch))
        chunk = self.action_normalizer.inverse(self.head.sample(encoded, generator))
        actions = to_actions(chunk, batch.joints, self.config.representation)
        if self.config.gripper_widths:
            actions[..., -1] = nearest(actions[..., -1], self.config.gripper_widths)
        return actions

    def _encode_touch(
        self, batch: ObservationBatch, noise: BatchNoise | None = None
    ) -> Float[Tensor, "b o w"]:
        """What touch tells the head, with the training's noise if there is a generator for it."""
        if self.touch_readout is None:
            return batch.state[..., :0]
        touch = self.touch_normalizer(batch.touch).clamp(-_CLIP, _CLIP)
        if noise is not None:
            noise_drawn = noise.randn(touch.shape).to(touch)
            touch = touch + self.config.touch_noise * noise_drawn
        return self.touch_readout(touch)

    def _encode(
        self,
        batch: ObservationBatch,
        touch: Float[Tensor, "b o w"],
        noise: BatchNoise | None = None,
    ) -> Float[Tensor, "b c"]:
        """What the head sees, with the training's noise if there is a generator for it."""
        columns, kind = self.config.proprioception, self.config.representation
        state = network_input(batch.state, columns, kind)
        seen = self.state_normalizer(state).clamp(-_CLIP, _CLIP)
        if noise is not None:
            shift = noise.randn((len(seen), 1, seen.shape[2])).to(seen)
            seen = seen + self.config.position_noise * shift * is_position(columns, kind).to(seen)
        seen = torch.cat([touch, seen], -1)
        if self.end_to_end_encoder is None:
            return seen.flatten(1)
        assert batch.pictures is not None, "this policy looks at pictures"
        return torch.cat([seen.flatten(1), self.end_to_end_encoder(batch.pictures)], 1)
