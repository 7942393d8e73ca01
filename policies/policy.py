"""The policy: from what both fingertips and the arm have felt to the actions of the next ticks."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from touchgoal.control import vocabulary as v
from touchgoal.control.errors import UserError
from touchgoal.policies.actions import ACTION_DIM, Representation, Scale, represent, to_actions
from touchgoal.policies.diffusion import Diffusion, DiffusionConfig, Regression, RegressionConfig
from touchgoal.policies.eyes import Eye, EyeConfig

_FAR = 5.0  # standard deviations beyond which an input is as surprising as it gets


@dataclass(frozen=True)
class PolicyConfig:
    """What a policy sees and does.

    Attributes:
        touch_dim: of the frozen embedding of both fingertips together; 0 for a policy without
            touch.
        touch: names what made the embeddings: encoder, sensor, background.
        touch_width: to which an embedding is projected.
        touch_noise: standard deviation of noise added to the touch while learning, of embeddings
            scaled to variance 1. Without it a network knows each recorded episode again by its
            sensors, and learns its wire by heart.
        place_noise: likewise of the joint and TCP positions, one draw for all ticks seen: where on
            the table a wire ran shall not tell how it goes on. Velocities and the hand's
            orientation stay as they are.
        eye: for pictures that no frozen encoder reads; None for a policy without.
        proprioception: columns of `vocabulary.FEATURES`, the state first.
        observation_horizon: ticks seen, the latest included.
        prediction_horizon: ticks planned. The first is the latest observation's, so that all of
            them can be done; diffusion_policy counts from the oldest observation instead.
        execution_horizon: ticks of a plan that are done before the next one.
        representation: of the actions while learning.
        control_hz: ticks per second.
        head: what draws the chunk.
    """

    touch_dim: int
    touch: str
    touch_width: int = 64
    touch_noise: float = 0.5
    place_noise: float = 0.3
    eye: EyeConfig | None = None
    proprioception: tuple[str, ...] = (v.STATE, v.TCP_POSE)
    observation_horizon: int = 2
    prediction_horizon: int = 8
    execution_horizon: int = 4
    representation: Representation = "chunk"
    control_hz: int = v.CONTROL_HZ
    head: DiffusionConfig | RegressionConfig = field(default_factory=DiffusionConfig)

    def __post_init__(self) -> None:
        """Raises UserError for what makes no policy."""
        if self.proprioception[:1] != (v.STATE,) or not set(self.proprioception) <= set(v.FEATURES):
            raise UserError(f"proprioception must be known columns, {v.STATE} first")
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
    def state_dim(self) -> int:
        """Width of the proprioception of one tick."""
        return sum(v.FEATURES[key].shape[0] for key in self.proprioception)

    @property
    def seen_dim(self) -> int:
        """Width of the proprioception as the network sees it, see `unroll`."""
        return self.state_dim + (2 if v.TCP_POSE in self.proprioception else 0)


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
        return self.state[:, -1, : v.N_JOINTS]


class Policy(nn.Module):
    """Condition to actions, with all scales inside."""

    def __init__(self, config: PolicyConfig) -> None:
        """Randomly initialised; `fit_scales` comes before training."""
        super().__init__()
        self.config = config
        ticks = config.prediction_horizon
        self.touch_scale = Scale((config.touch_dim,))
        self.state_scale = Scale((config.seen_dim,))
        self.action_scale = Scale((ticks, ACTION_DIM))
        width = config.touch_width if config.touch_dim else 0
        # projected before the U-Net, whose FiLM would multiply the embedding's width
        self.project = nn.Linear(config.touch_dim, width) if width else None
        condition = config.observation_horizon * (width + config.seen_dim)
        self.eye = None
        if config.eye:
            self.eye = Eye(config.eye)
            condition += len(config.eye.keys) * config.eye.width
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
    ) -> None:
        """Fits the scales to training data: n ticks, and the chunks of m windows.

        Inputs get variance 1, actions the range -1 to 1, for each tick of the chunk by itself: the
        first of a chunk-relative plan moves an eighth of what the last does.
        """
        if self.project is not None:
            self.touch_scale.fit_spread(touch)
        self.state_scale.fit_spread(unroll(state, self.config.proprioception))
        self.action_scale.fit_range(represent(actions, joints, self.config.representation))

    def loss(
        self, condition: Condition, actions: Float[Tensor, "b h 8"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Training loss on windows; the generator is the CPU's."""
        chunk = represent(actions, condition.joints, self.config.representation)
        encoded = self._encode(condition, generator)
        return self.head.loss(self.action_scale(chunk), encoded, generator)

    @torch.inference_mode()
    def plan(self, condition: Condition, generator: torch.Generator) -> Float[Tensor, "b h 8"]:
        """Actions (`vocabulary.ACTION`) of the ticks from the latest observation on.

        The same generator state (on the CPU) gives the same plan.
        """
        chunk = self.action_scale.inverse(self.head.plan(self._encode(condition), generator))
        return to_actions(chunk, condition.joints, self.config.representation)

    def _encode(
        self, condition: Condition, noise: torch.Generator | None = None
    ) -> Float[Tensor, "b c"]:
        """What the head sees, with the training's noise if there is a generator for it."""
        config = self.config
        state = unroll(condition.state, config.proprioception)
        seen = self.state_scale(state).clamp(-_FAR, _FAR)
        if noise is not None:
            shift = torch.randn(len(seen), 1, seen.shape[2], generator=noise).to(seen)
            seen = seen + config.place_noise * shift * self._places.to(seen)
        if self.project is not None:
            touch = self.touch_scale(condition.touch).clamp(-_FAR, _FAR)
            if noise is not None:
                grain = torch.randn(touch.shape, generator=noise).to(touch)
                touch = touch + config.touch_noise * grain
            seen = torch.cat([self.project(touch), seen], -1)
        if self.eye is None:
            return seen.flatten(1)
        assert condition.pictures is not None, "this policy looks at pictures"
        return torch.cat([seen.flatten(1), self.eye(condition.pictures)], 1)

    @property
    def _places(self) -> Float[Tensor, " r"]:
        """1 for joint and TCP positions, 0 for all else that `unroll` gives."""
        marks = []
        for key in self.config.proprioception:
            places = {v.STATE: v.N_JOINTS, v.TCP_POSE: 3}.get(key, 0)
            size = v.FEATURES[key].shape[0] + (2 if key == v.TCP_POSE else 0)
            marks += [1.0] * places + [0.0] * (size - places)
        return torch.tensor(marks)


def unroll(
    state: Float[Tensor, "... s"], proprioception: tuple[str, ...]
) -> Float[Tensor, "... r"]:
    """Proprioception with the TCP's quaternion as the first two columns of its rotation matrix.

    A quaternion and its negative are the same turn, and a measured one jumps between the two as
    the hand turns about the vertical; the matrix does not (Zhou et al. 2019).
    """
    parts, start = [], 0
    for key in proprioception:
        part = state[..., start : (start := start + v.FEATURES[key].shape[0])]
        parts += [part[..., :3], _two_columns(part[..., 3:])] if key == v.TCP_POSE else [part]
    return torch.cat(parts, -1)


def _two_columns(quaternion: Float[Tensor, "... 4"]) -> Float[Tensor, "... 6"]:
    w, x, y, z = quaternion.unbind(-1)
    columns = [
        1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y),
        2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
    ]  # fmt: skip
    return torch.stack(columns, -1)
