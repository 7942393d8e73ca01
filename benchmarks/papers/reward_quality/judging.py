"""Curves of embedded episodes to the ends of other successes with the same object."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from benchmarks.papers.reward_quality.embedding import EmbeddedFiles, load_embedder
from benchmarks.papers.reward_quality.measures import Judged
from benchmarks.papers.reward_quality.recording import Recorded
from benchmarks.papers.reward_quality.sentences import SENTENCES
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.cost import compute_curves
from touchgoal.rewards.distance.fit_normalizer import fit_normalizer
from touchgoal.rewards.distance.normalizer import DistanceNormalizer
from touchgoal.rewards.features.embedded import (
    IMAGE,
    TEXT,
    EmbeddedEpisode,
    EmbeddedGoal,
    last_rows,
)
from touchgoal.rewards.features.successful_ends import SuccessfulEnds
from touchgoal.rewards.goals import OwnFrame, Sentence
from touchgoal.rewards.judging.end_state import end_cost, end_costs
from touchgoal.rewards.value import Value, fit_value
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.progress import track

_SCENE = "simulated pick-place"  # of the normalizer, and the task of the value


@dataclass(frozen=True)
class Judge:
    """Units, value and goals of one scene, fitted on the training objects."""

    files: EmbeddedFiles
    normalizer: DistanceNormalizer
    value: Value
    goals: dict[str, EmbeddedGoal]  # by object
    sentences: dict[str, EmbeddedGoal]  # the same with a sentence for touch; empty without words
    ends: SuccessfulEnds  # the goals of all objects

    def curves(self, episode: EmbeddedEpisode, goal: EmbeddedGoal) -> Curves:
        """Return the curves of an episode to a goal."""
        return compute_curves(episode, goal, self.normalizer, self.value)

    def plain_curves(self, episode: EmbeddedEpisode, goal: EmbeddedGoal) -> Curves:
        """Return the plain distances of an episode to a goal, as the paper has them."""
        return compute_curves(episode, goal, self.normalizer, plain=True)

    def costs(self, episode: EmbeddedEpisode, name: str) -> dict[str, Float[np.ndarray, " n"]]:
        """Return costs and plain distances to the goal of an object, and to its sentence."""
        curves = self.curves(episode, self.goals[name])
        costs = {**curves.costs, **curves.plain}
        if name in self.sentences:
            words = self.plain_curves(episode, self.sentences[name]).costs
            costs |= {curve: words[curve] for curve in ("text", "image+text")}
        return costs

    def end_cost(self, recorded: Recorded) -> float:
        """Return the cost of an episode's end, as a judge reads it."""
        e = replace(self.files.load(recorded), object=recorded.object)
        goal = self.ends.for_trajectory(e, "ends of successes")
        return end_cost(end_costs(e.features, e.fps, goal, self.normalizer.unit, self.value))

    def judge(self, recorded: Sequence[Recorded]) -> list[Judged]:
        """Measure episodes against the goals of the object that was asked for."""
        judged = []
        for r in track(recorded, "measuring", "episode"):
            episode = self.files.load(r)
            costs = self.costs(episode, r.object)
            judged.append(Judged(r.outcome, r.object, len(episode) / episode.fps, costs))
        return judged

    def to_every_goal(self, recorded: Sequence[Recorded]) -> list[dict[str, dict[str, float]]]:
        """Return the last costs of episodes to the goals of each other's objects: [episode][goal]."""
        episodes = [self.files.load(r) for r in recorded]
        return [
            {
                r.object: {n: float(c[-1]) for n, c in self.costs(e, r.object).items()}
                for r in recorded
            }
            for e in episodes
        ]

    def to_own_end(self, recorded: Sequence[Recorded]) -> list[tuple[Curves, Curves | None]]:
        """Return the curves of episodes to their own last frame; with a sentence for touch, too."""
        embedder, found = load_embedder(self.files.encoder), []
        for r in track(recorded, "measuring own ends", "episode"):
            episode, words = self.files.load(r), None
            own = embedder.embed_goal({"image": OwnFrame(), "tactile": OwnFrame()}, episode)
            if embedder.knows_words:
                sentence = Sentence(SENTENCES[r.object])
                goal = embedder.embed_goal({"image": OwnFrame(), "text": sentence}, episode)
                words = self.plain_curves(episode, goal)
            found.append((self.plain_curves(episode, own), words))
        return found


def fit_judge(files: EmbeddedFiles, recorded: Sequence[Recorded]) -> Judge:
    """Fit units and value on the training episodes of a scene, and take its goals."""
    training = [files.load(r) for r in recorded if r.purpose == "training"]
    normalizer = fit_normalizer(training, training[0].modalities, _SCENE)
    ends: dict[str, list[EmbeddedEpisode]] = {}
    for r in recorded:
        if r.purpose == "goal":
            episode = files.load(r)
            ends.setdefault(r.object, []).append(episode)
    goals = {name: EmbeddedGoal(last_rows(found)) for name, found in ends.items()}
    for r in recorded:
        if r.object not in goals and r.purpose == "test":
            raise UserError(f"no goal for {r.object}: its expert always failed; see {r.root}")
    return Judge(
        files,
        normalizer,
        fit_value(training, _SCENE),
        goals,
        _sentences(files.encoder, goals),
        SuccessfulEnds.of([e for found in ends.values() for e in found]),
    )


def _sentences(encoder: str, goals: dict[str, EmbeddedGoal]) -> dict[str, EmbeddedGoal]:
    """Return the goals of images with a sentence for touch; none if touch knows no words."""
    embedder = load_embedder(encoder)
    if not embedder.knows_words:
        return {}
    return {
        name: EmbeddedGoal(
            {IMAGE: goal.features[IMAGE], TEXT: embedder.embed_sentences([SENTENCES[name]])}
        )
        for name, goal in goals.items()
    }
