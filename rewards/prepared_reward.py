"""A reward for recordings of one kind: encoders, goals and normalizer, chosen and checked."""

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.embedder import EpisodeEmbedder
from touchgoal.rewards.goals import Goals
from touchgoal.rewards.judging.end_state import end_costs
from touchgoal.rewards.judging.judge import FIT_JUDGE, JUDGE, Judge, Judgement
from touchgoal.rewards.value import Value
from touchgoal.runtime.errors import UserError


@dataclass(frozen=True)
class PreparedReward:
    """A reward for recordings of one kind: encoders, goals and normalizer."""

    embedder: EpisodeEmbedder
    goals: Goals  # the goal of each modality
    normalizer: DistanceNormalizer | None  # normalizer of the distances; None for raw ones
    value: Value | None  # value of the task, if one lies beside the normalizer
    note: str  # which normalizer, or why there is none, for people
    plain: bool = False  # plain distances in place of the parts
    folder: Path | None = None  # of the normalizer, in which a judge may lie

    @cached_property
    def judge(self) -> Judge:
        """The judge beside the normalizer; UserError if there is none."""
        if self.folder is None or not (self.folder / JUDGE).is_file():
            raise UserError(f"no judge lies beside the normalizer ({self.note}): {FIT_JUDGE}")
        return Judge.load(self.folder / JUDGE)

    def end_costs(self, episode: EmbeddedEpisode) -> dict[str, float]:
        """Return the cost of each part at the end of an episode that `embedder` embedded."""
        assert self.normalizer is not None  # a judge lies beside one
        goal = self.embedder.embed_goal(self.goals, episode)
        return end_costs(
            episode.features, episode.fps, goal.features, self.normalizer.unit, self.value
        )

    def judge_episode(self, episode: EmbeddedEpisode) -> Judgement:
        """Return the judgement of an episode that `embedder` embedded; UserError without a judge."""
        return self.judge.judge(self.end_costs(episode))

    def curves(self, trajectory: EmbeddedEpisode) -> Curves:
        """Return the curves of a trajectory that `embedder` embedded."""
        goal = self.embedder.embed_goal(self.goals, trajectory)
        curves = compute_curves(trajectory, goal, self.normalizer, self.value, plain=self.plain)
        return replace(curves, note=self.note)

    def provenance(self) -> dict[str, str]:
        """Return what the curves are made with, ready for JSON."""
        return asdict(self.embedder.made_with) | {"normalizer": self.note}
