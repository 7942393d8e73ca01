"""The policy: from what both fingertips and the arm have felt to the actions of the next ticks."""

from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from touchgoal.control import features as ft
from touchgoal.control.errors import UserError
from touchgoal.policies.actions import ACTION_DIM, Representation, Scale, represent, to_actions
from touchgoal.policies.heads.diffusion import (
    Diffusion,
    DiffusionConfig,
    Regression,
    RegressionConfig,
)
from touchgoal.policies.perception.end_to_end import Eye, EyeConfig
from touchgoal.policies.perception.proprioception import places, unroll, widths

TouchReading = Literal["wrench", "free"]
WRENCH_DIM = ft.FEATURES[ft.TRUTH_PAD_WRENCH].shape[0]
_FAR = 5.0  # standard deviations beyond which an input is as surprising as it gets


@dataclass(frozen=True)
class PolicyConfig:
    """What a policy sees and does.

    Attributes:
        touch_dim: of the frozen embedding of both fingertips together; 0 for a policy without
            touch.
        touch: names what made the embeddings: encoder, sensor, background.
        touch_reading: how embeddings reach the head. "wrench": a small network reads the wrenches on
            both pads out of them, which learns from what the simulator says acted there and from
            nothing else (TacBench's force estimation, T1), and the head sees the 12 numbers.
            "free": a projection that learns from the actions alone, for episodes without that truth.
        touch_width: to which an embedding is projected, if freely.
        touch_noise: standard deviation of noise added to the touch while learning, of embeddings
            scaled to variance 1. Without it a network knows each recorded episode again by its
            sensors, and learns its wire by heart.
        place_noise: likewise of the joint and TCP positions, one draw for all ticks seen: where on
            the table a wire ran shall not tell how it goes on. Velocities and the hand's
            orientation stay as they are. "tool" sees no positions.
        eye: for fingertips that no frozen encoder reads; None for a policy without.
        proprioception: columns of `vocabulary.FEATURES`, the state first. Where it acts, those that
            only a simulator knows come from its senses, see `senses.py`.
        observation_horizon: ticks seen, the latest included.
        prediction_horizon: ticks planned. The first is the latest observation's, so that all of
            them can be done; diffusion_policy counts from the oldest observation instead.
        execution_horizon: ticks of a plan that are done before the next one.
        representation: of the actions while learning; "tool" also sees along the hand's own axes,
            see `proprioception.py`.
        control_hz: ticks per second.
        head: what draws the chunk.
    """

    touch_dim: int
    touch: str
    touch_reading: TouchReading = "wrench"
    touch_width: int = 64
    touch_noise: float = 0.1
    place_noise: float = 0.3
    eye: EyeConfig | None = None
    proprioception: tuple[str, ...] = (ft.STATE, ft.TCP_POSE)
    observation_horizon: int = 2
    prediction_horizon: int = 8
    execution_horizon: int = 2
    representation: Representation = "chunk"
    control_hz: int = ft.CONTROL_HZ
    head: DiffusionConfig | RegressionConfig = field(default_factory=DiffusionConfig)

    def __post_init__(self) -> None:
        """Raises UserError for what makes no policy."""
        if self.proprioception[:1] != (ft.STATE,) or not set(self.proprioception) <= set(
            ft.FEATURES
        ):
            raise UserError(f"proprioception must be known columns, {ft.STATE} first")
        if self.representation == "tool" and self.proprioception != (ft.STATE, ft.TCP_POSE):
            raise UserError(
                f'representation "tool" sees {ft.STATE} and {ft.TCP_POSE} alone: choose "hand"'
            )
        if not 1 <= self.execution_horizon <= self.prediction_horizon:
            raise UserError(
                f"execution_horizon {self.execution_horizon} must be between 1 and the "
                f"prediction_horizon {self.prediction_horizon}"
            )
        if isinstance(self.head, DiffusionConfig):
            factor = self.head.unet.factor
            if self.prediction_horizon % factor:
                raise UserError(
                    f"prediction_horizon {self.prediction_horizon} must be a multiple of {factor} "
                    "for this U-Net"
                )

    @property
    def reads_wrench(self) -> bool:
        """Whether its training needs `truth.pad_wrench`."""
        return self.touch_dim > 0 and self.touch_reading == "wrench"

    @property
    def perceived(self) -> tuple[str, ...]:
        """Columns that senses must read where there is no simulator to ask."""
        return tuple(key for key in self.proprioception if not key.startswith("observation."))

    @property
    def state_dim(self) -> int:
        """Width of the proprioception of one tick."""
        return sum(ft.FEATURES[key].shape[0] for key in self.proprioception)

    @property
    def seen_dim(self) -> int:
        """Width of the proprioception as the network sees it, see `proprioception.unroll`."""
        return sum(widths(self.proprioception, self.representation))


@dataclass(frozen=True, eq=False)
class Condition:
    """What a policy has seen on the last ticks, oldest first, as it was measured.

    Attributes:
        touch: frozen embeddings of the left and the right fingertip, side by side.
        state: columns of `PolicyConfig.proprioception`, side by side, SI units.
        pictures: of the latest tick, for the policy's eye, see `eyes.shrink`; None without.
    """

    touch: Float[Tensor, "b o e"]
    state: Float[Tensor, "b o s"]
    pictures: UInt8[Tensor, "b k h w 3"] | None = None

    @property
    def joints(self) -> Float[Tensor, "b 7"]:
        """Joint positions at the latest tick, rad."""
        return self.state[:, -1, : ft.N_JOINTS]


class Policy(nn.Module):
    """Condition to actions, with all scales inside."""

    def __init__(self, config: PolicyConfig) -> None:
        """Randomly initialised; `fit_scales` comes before training."""
        super().__init__()
        self.config = config
        ticks = config.prediction_horizon
        self.touch_scale = Scale((config.touch_dim,))
        self.wrench_scale = Scale((WRENCH_DIM,))
        self.state_scale = Scale((config.seen_dim,))
        self.action_scale = Scale((ticks, ACTION_DIM))
        # narrowed before the U-Net, whose FiLM would multiply the embedding's width
        self.read, width = None, 0
        if config.reads_wrench:
            width, hidden = WRENCH_DIM, 256
            self.read = nn.Sequential(
                nn.Linear(config.touch_dim, hidden), nn.Mish(),
                nn.Linear(hidden, hidden), nn.Mish(),
                nn.Linear(hidden, width),
            )  # fmt: skip
        elif config.touch_dim:
            width = config.touch_width
            self.read = nn.Linear(config.touch_dim, width)
        condition = config.observation_horizon * (width + config.seen_dim)
        self.eye = None
        if config.eye:
            self.eye = Eye(config.eye)
            condition += len(ft.TACTILE) * config.eye.width
        self.condition_dim = condition
        if isinstance(config.head, DiffusionConfig):
            self.head = Diffusion(config.head, ticks, ACTION_DIM, condition)
        else:
            self.head = Regression(config.head, ticks, ACTION_DIM, condition)

    def fit_scales(
        self,
        touch: Float[Tensor, "n e"],
        state: Float[Tensor, "n s"],
        joints: Float[Tensor, "m 7"],
        actions: Float[Tensor, "m h 8"],
        wrench: Float[Tensor, "n 12"] | None = None,
    ) -> None:
        """Fits the scales to training data: n ticks, and the chunks of m windows.

        Inputs get variance 1, actions the range -1 to 1, for each tick of the chunk by itself: the
        first of a chunk-relative plan moves an eighth of what the last does.
        """
        if self.config.touch_dim:
            self.touch_scale.fit_spread(touch)
        if wrench is not None:
            self.wrench_scale.fit_spread(wrench)
        columns, kind = self.config.proprioception, self.config.representation
        self.state_scale.fit_spread(unroll(state, columns, kind))
        self.action_scale.fit_range(represent(actions, joints, kind))

    def loss(
        self,
        condition: Condition,
        actions: Float[Tensor, "b h 8"],
        generator: torch.Generator,
        wrench: Float[Tensor, "b o 12"] | None = None,
    ) -> Float[Tensor, ""]:
        """Training loss on windows.

        Args:
            condition: what was seen.
            actions: what was done.
            generator: the CPU's.
            wrench: what acted on both pads, where touch is read as that.
        """
        chunk = represent(actions, condition.joints, self.config.representation)
        felt = self._feel(condition, generator)
        learnt = torch.zeros((), device=felt.device)
        if self.config.reads_wrench:
            assert wrench is not None, "this policy learns to read wrenches"
            learnt = F.mse_loss(felt, self.wrench_scale(wrench))
            felt = felt.detach()
        encoded = self._encode(condition, felt, generator)
        return self.head.loss(self.action_scale(chunk), encoded, generator) + learnt

    @torch.inference_mode()
    def plan(self, condition: Condition, generator: torch.Generator) -> Float[Tensor, "b h 8"]:
        """Actions (`vocabulary.ACTION`) of the ticks from the latest observation on.

        The same generator state (on the CPU) gives the same plan.
        """
        encoded = self._encode(condition, self._feel(condition))
        chunk = self.action_scale.inverse(self.head.plan(encoded, generator))
        return to_actions(chunk, condition.joints, self.config.representation)

    def _feel(
        self, condition: Condition, noise: torch.Generator | None = None
    ) -> Float[Tensor, "b o w"]:
        """What touch tells the head, with the training's noise if there is a generator for it."""
        if self.read is None:
            return condition.state[..., :0]
        touch = self.touch_scale(condition.touch).clamp(-_FAR, _FAR)
        if noise is not None:
            grain = torch.randn(touch.shape, generator=noise).to(touch)
            touch = touch + self.config.touch_noise * grain
        return self.read(touch)

    def _encode(
        self,
        condition: Condition,
        felt: Float[Tensor, "b o w"],
        noise: torch.Generator | None = None,
    ) -> Float[Tensor, "b c"]:
        """What the head sees, with the training's noise if there is a generator for it."""
        columns, kind = self.config.proprioception, self.config.representation
        state = unroll(condition.state, columns, kind)
        seen = self.state_scale(state).clamp(-_FAR, _FAR)
        if noise is not None:
            shift = torch.randn(len(seen), 1, seen.shape[2], generator=noise).to(seen)
            seen = seen + self.config.place_noise * shift * places(columns, kind).to(seen)
        seen = torch.cat([felt, seen], -1)
        if self.eye is None:
            return seen.flatten(1)
        assert condition.pictures is not None, "this policy looks at pictures"
        return torch.cat([seen.flatten(1), self.eye(condition.pictures)], 1)
