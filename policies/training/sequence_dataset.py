"""Training windows over episodes: observations of the last ticks, actions of the next ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int, UInt8
from torch import Tensor

from touchgoal.control import features as ft
from touchgoal.encoders.training.batch_noise import BatchNoise
from touchgoal.episodes.schema import CORRECTED
from touchgoal.episodes.store import EpisodeSet
from touchgoal.episodes.touches import check_fingertips
from touchgoal.policies.heads.end import END_SECONDS, LEAVING_SECONDS
from touchgoal.policies.network import ObservationBatch, PolicyConfig
from touchgoal.policies.perception.end_to_end import difference_images
from touchgoal.policies.perception.frozen_touch import TouchEmbedder
from touchgoal.policies.perception.proprioception import tare
from touchgoal.policies.sight.frozen_images import ImageEmbedder
from touchgoal.policies.sight.key_pose import HOLD_SECONDS, gripper_changes, key_poses
from touchgoal.policies.training.action_meaning import ActionMeaning, joint_changes
from touchgoal.policies.training.embedding_cache import embed_episodes
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.parallel.parallel_map import Workers
from touchgoal.runtime.progress import track


@dataclass(frozen=True, eq=False)
class Recordings:
    """n ticks of several episodes, one after the other."""

    touch: Float16[Tensor, "n e"]  # embeddings of both fingertips
    state: Float32[Tensor, "n s"]  # proprioception
    actions: Float32[Tensor, "n 8"]  # `features.ACTION`
    lengths: tuple[int, ...]  # ticks of each episode
    done: Bool[Tensor, " n"]  # whether the task is done: the end of a successful episode
    succeeded: Bool[Tensor, " n"]  # whether there is or was success, as a simulator knows
    images: UInt8[Tensor, "n k h w 3"] | None = None  # for the end-to-end encoder
    maps: Float16[Tensor, "n k c y x"] | None = None  # camera feature maps, see `ImageEmbedder`
    key_pose: Float32[Tensor, "n 3 8"] | None = None  # the last and the next two, beside `maps`


def load_recordings(
    episodes: EpisodeSet,
    chosen: Sequence[int],
    config: PolicyConfig,
    embedder: TouchEmbedder | None,
    workers: Workers = 1,
    skip: Sequence[int] | None = None,
    meaning: ActionMeaning = "change",
    judged: bool = False,
) -> Recordings:
    """Read episodes, and embed those that have no embedding yet; a kill loses those in progress.

    At the start of each chosen episode `skip` ticks are left out; images and forces stay relative
    to its very first tick. Of `judged` ones a simulator's success is not read. UserError: nothing
    chosen, a missing column, another rate or embedder than the config's, or other embeddings.
    """
    _check(episodes, chosen, config, embedder)
    embedded = embed_episodes(episodes, chosen, embedder, workers) if embedder else None
    images = ImageEmbedder(config.images) if config.images else None
    maps = embed_episodes(episodes, chosen, images, workers) if images else []
    keys = [*config.proprioception, ft.STATE, ft.ACTION]
    keys += [ft.TRUTH_SUCCESS] * (ft.TRUTH_SUCCESS in episodes.features and not judged)
    touch, state, actions, succeeded, differences, tcp = [], [], [], [], [], []
    for n, i in enumerate(track(chosen, "reading", "episode")):
        frames = episodes.read(i, keys).frames
        if ft.WRENCH in frames:
            frames[ft.WRENCH] = tare(frames[ft.WRENCH], frames[ft.WRENCH][0])
        start = skip[n] if skip else 0
        state.append(np.concatenate([frames[key][start:] for key in config.proprioception], 1))
        actions.append(joint_changes(frames[ft.ACTION], frames[ft.STATE], meaning)[start:])
        success = frames.get(ft.TRUTH_SUCCESS, np.zeros((len(frames[ft.STATE]), 1)))[start:, 0]
        succeeded.append(np.maximum.accumulate(success) > 0)
        if images:
            tcp.append(frames[ft.TCP_POSE][start:])
            maps[n] = maps[n][start:]
        no_touch = np.empty((len(actions[-1]), 0), np.float16)
        touch.append(embedded[n][start:] if embedded else no_touch)
        if config.end_to_end:
            touched, size = episodes.read(i, ft.TACTILE).frames, config.end_to_end.size
            sides = [difference_images(touched[k], touched[k][0], size) for k in ft.TACTILE]
            differences.append(np.stack(sides, 1)[start:])
    parts = [torch.from_numpy(np.concatenate(rows)) for rows in (touch, state, actions)]
    lengths = tuple(len(rows) for rows in actions)
    key_pose, hold = None, round(HOLD_SECONDS * config.control_hz)
    if images:
        widths = parts[2][:, -1].numpy()
        key_pose = torch.from_numpy(key_poses(np.concatenate(tcp), widths, lengths, hold))
    return Recordings(
        *parts,
        lengths=lengths,
        done=_done(episodes, chosen, actions, config),
        succeeded=torch.from_numpy(np.concatenate(succeeded)),
        images=torch.from_numpy(np.concatenate(differences)) if config.end_to_end else None,
        maps=torch.from_numpy(np.concatenate(maps)) if images else None,
        key_pose=key_pose,
    )


def _done(
    episodes: EpisodeSet, chosen: Sequence[int], actions: list[np.ndarray], config: PolicyConfig
) -> Bool[Tensor, " n"]:
    """Return the last `END_SECONDS` of each episode but those corrected ones that failed.

    With cameras `LEAVING_SECONDS` since the gripper last moved, if that is longer.
    """
    ends, leaving = (round(s * config.control_hz) for s in (END_SECONDS, LEAVING_SECONDS))
    marks = []
    for i, action in zip(chosen, actions, strict=True):
        meta, n = episodes.meta(i), len(action)
        last = max(gripper_changes(action[:, -1]), default=-1) if config.images else n
        ticks = max(ends, min(leaving, n - 1 - last))
        good = meta.get("outcome") != CORRECTED or bool(meta.get("success"))
        marks.append((torch.arange(n) >= n - ticks) & good)
    return torch.cat(marks)


def _check(
    episodes: EpisodeSet,
    chosen: Sequence[int],
    config: PolicyConfig,
    embedder: TouchEmbedder | None,
) -> None:
    if not chosen:
        raise UserError(f"no episode of {episodes.root} to train on: record successful ones")
    if episodes.fps != config.control_hz:
        raise UserError(
            f"{episodes.root} runs at {episodes.fps} Hz, the policy at {config.control_hz}: set "
            "control_hz to the episodes' rate"
        )
    check_arm(episodes)
    reads = {*config.proprioception, *(config.images.cameras if config.images else ())}
    if missing := reads - set(episodes.features):
        raise UserError(f"{episodes.root} has no {sorted(missing)[0]}, which the policy reads")
    made = (embedder.name, embedder.dim) if embedder else ("", 0)
    if made != (config.touch, config.touch_dim):
        raise UserError(
            f"the policy needs touch {config.touch!r} of width {config.touch_dim}, this is "
            f"{made[0]!r} of width {made[1]}: make its config for this embedder"
        )
    if embedder or config.end_to_end:
        check_fingertips(episodes, chosen)


def check_arm(episodes: EpisodeSet) -> None:
    """Raise UserError unless state and action of a set are an FR3's."""
    for key in (ft.STATE, ft.ACTION):
        shape = episodes.features.get(key, {"shape": [0]})["shape"]
        if tuple(shape) != ft.FEATURES[key].shape:
            raise UserError(
                f"{episodes.root} is of another arm: its {key} is {shape[0]} wide; policies read and "
                f"command an FR3 ({key}: {ft.FEATURES[key].meaning})"
            )


class SequenceDataset:
    """One window for every recorded tick.

    Before an episode's start its first observation is repeated, as in diffusion_policy. Ticks after
    its end are padding (`action_is_pad`), which does not count in training. So is the last tick:
    its observation is the result of the last action, and the action recorded beside it was never
    executed. Ticks after success, as in the maze when the bead is led on to its post, teach the end alone.
    """

    def __init__(
        self,
        recorded: Recordings,
        config: PolicyConfig,
        weights: Float32[np.ndarray, " n"] | None = None,
    ) -> None:
        """Cut the windows; `weights` say how often each is drawn, relative to the others."""
        self.recorded = recorded
        self.weights = None if weights is None else torch.from_numpy(weights)
        ends = np.cumsum(recorded.lengths)
        first = np.repeat(ends - recorded.lengths, recorded.lengths)[:, None]
        last = np.repeat(ends - 1, recorded.lengths)[:, None]
        tick = np.arange(ends[-1])[:, None]
        observed = tick + np.arange(1 - config.observation_horizon, 1)
        planned = tick + np.arange(config.prediction_horizon)
        self._observed = torch.from_numpy(np.maximum(observed, first))
        self._planned = torch.from_numpy(np.minimum(planned, last))
        self.action_is_pad = torch.from_numpy(planned >= last) | recorded.succeeded[self._planned]

    def __len__(self) -> int:
        return len(self._observed)

    @property
    def joints(self) -> Float[Tensor, "n 7"]:
        """Joint positions at the latest tick of every window, rad."""
        return self.recorded.state[:, : ft.N_JOINTS]

    @property
    def actions(self) -> Float[Tensor, "n h 8"]:
        """Actions of every window; after the end of an episode the last recorded one."""
        return self.recorded.actions[self._planned]

    def draw(self, rows: Int[Tensor, " b"], noise: BatchNoise) -> Int[Tensor, " b"]:
        """Return these windows or, if windows have weights, as many drawn by them."""
        if self.weights is None:
            return rows
        shares = self.weights.double().cumsum(0)
        return torch.searchsorted(shares, noise.rand((len(rows),)) * shares[-1], right=True)

    def take(self, rows: Int[Tensor, " b"]) -> tuple[ObservationBatch, Float[Tensor, "b h 8"]]:
        """Return observations and actions of some windows."""
        observed, recorded = self._observed[rows], self.recorded
        images = None if recorded.images is None else recorded.images[rows]
        maps = None if recorded.maps is None else recorded.maps[rows]
        batch = ObservationBatch(
            recorded.touch[observed].float(), recorded.state[observed], images, maps
        )
        return batch, recorded.actions[self._planned[rows]]

    def key_pose(self, rows: Int[Tensor, " b"]) -> Float[Tensor, "b 3 8"] | None:
        """Return the key poses at the latest tick of some windows, with cameras."""
        return None if self.recorded.key_pose is None else self.recorded.key_pose[rows]
