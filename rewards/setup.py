"""Everything that a measurement needs: checked first, and the encoders loaded last."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from touchgoal.encoders import pretrained
from touchgoal.encoders.pretrained import AnyTouchEncoder, load_encoder
from touchgoal.encoders.towers.towers import OfflineTowers, load_towers
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.embedding_distance import EpisodeEmbedder, check_words, compute_curves
from touchgoal.rewards.goals import Goal, parse_goal
from touchgoal.rewards.normalizer import NORMALIZER, REMEDY, DistanceNormalizer
from touchgoal.rewards.sources import EpisodeSource, VideoSource
from touchgoal.runtime.errors import UserError

Source = EpisodeSource | VideoSource


@dataclass(frozen=True)
class Setup:
    """What to measure, with what, against what.

    Attributes:
        source: what to measure.
        goal: what to be near.
        embedder: the encoders.
        normalizer: what normalises the distances; None for raw ones.
        note: for people: which normalizer, or why there is none.
    """

    source: Source
    goal: Goal
    embedder: EpisodeEmbedder
    normalizer: DistanceNormalizer | None
    note: str

    def measure(self) -> Iterator[tuple[str, Curves]]:
        """Name and curves of each trajectory."""
        for name, one in zip(self.source.names, self.source.embed(self.embedder), strict=True):
            goal = self.embedder.embed_goal(self.goal, one)
            yield name, compute_curves(one, goal, self.normalizer)


def prepare(
    source: Source,
    goals: Sequence[str],
    encoder: str | None,
    towers: str | None,
    normalizer: str | None,
) -> Setup:
    """Check goals and normalizer, then load the encoders.

    Args:
        source: what to measure.
        goals: in the forms of rewards/goals.py.
        encoder: see `load_touch`.
        towers: see `embedder_for`.
        normalizer: a file of `fit-normalizer`, "none", or None for the one beside the encoder where it
            applies.

    Raises:
        UserError: whatever would stop the measurement.
    """
    picture_words = towers not in (None, OfflineTowers.name)
    specs = [parse_goal(text) for text in goals]
    goal = source.check_goals(specs, picture_words)
    given = DistanceNormalizer.load(Path(normalizer)) if normalizer not in (None, "none") else None
    touch, folder = load_touch(source, encoder)
    check_words(specs, touch)
    embedder = embedder_for(source, touch, towers)
    made_with = source.made_with(embedder)
    if given is not None:
        reason = given.mismatch(made_with, goal.as_dict(), goal.own)
        if reason:
            raise UserError(f"{normalizer} does not apply here: {reason}; {REMEDY}")
        return Setup(source, goal, embedder, given, f"normalizer: {normalizer}")
    if normalizer == "none":
        return Setup(source, goal, embedder, None, "normalizer: none, raw cosine distances")
    if touch is not None and folder is None:
        note = (
            f"raw cosine distances, for published weights bring no normalizer; to normalise: {_FIT}"
        )
        return Setup(source, goal, embedder, None, note)
    path = (folder or pretrained.DEFAULT_ENCODER) / NORMALIZER
    if not path.is_file() and (older := path.with_name("scale.json")).is_file():
        raise UserError(f"{older} is called {NORMALIZER} now: mv {older} {path}")
    if not path.is_file():
        note = f"raw cosine distances, for there is no {path}; to normalise them: {_FIT}"
        return Setup(source, goal, embedder, None, note)
    beside = DistanceNormalizer.load(path)
    reason = beside.mismatch(made_with, goal.as_dict(), goal.own)
    if beside.scene != source.scene:
        reason = f"it was fitted on episodes ({beside.scene}), not on such ({source.scene})"
    if reason:
        note = f"raw cosine distances, for {path} does not apply: {reason}; to normalise: {_FIT}"
        return Setup(source, goal, embedder, None, note)
    return Setup(source, goal, embedder, beside, f"normalizer: {path}")


_FIT = "touchgoal fit-normalizer, on successful episodes of your own"


def load_touch(source: Source, encoder: str | None) -> tuple[AnyTouchEncoder | None, Path | None]:
    """The touch encoder for a source and its folder; None without touch, and no folder of published weights.

    Args:
        source: what to embed.
        encoder: name or folder of a touch encoder of any kind; None for the one that ships for the sensor.

    Raises:
        UserError: nothing ships for the sensor, or the encoder is for another one.
    """
    path = _find_encoder(source, encoder)
    touch = None if path is None else load_encoder(path, source.sensor)
    return touch, path if path is not None and path.is_dir() else None


def embedder_for(
    source: Source, touch: AnyTouchEncoder | None, towers: str | None
) -> EpisodeEmbedder:
    """The encoders for a source.

    Args:
        source: what to embed.
        touch: its touch encoder.
        towers: "offline" or a CLIP; None for those that the touch encoder was aligned with, else "offline".

    Raises:
        UserError: the encoder was aligned with other towers.
    """
    return EpisodeEmbedder(load_towers(towers or own_towers(touch)), touch, source.camera)


def own_towers(touch: AnyTouchEncoder | None) -> str:
    """Those that a touch encoder was aligned with; the offline ones of any other, and without touch."""
    return (touch and touch.towers) or OfflineTowers.name


def _find_encoder(source: Source, encoder: str | None) -> Path | None:
    if not source.sides:
        if encoder is not None:
            raise UserError(f"{source.path} has no touch: leave --encoder out")
        return None
    if encoder is not None:
        return pretrained.find_encoder(encoder)
    pictures_alone = "or measure the pictures alone: --towers offline"
    if source.sensor is None:
        raise UserError(
            f"the episodes in {source.path} do not name their sensor: give --encoder, "
            + pictures_alone
        )
    try:
        return pretrained.shipped_encoder_for(source.sensor)
    except UserError as error:
        raise UserError(f"{error}; {pictures_alone}") from None
