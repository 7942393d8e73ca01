"""The one set-up of encoders, goal and normalizer, for commands, scripts and deployments."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from touchgoal.encoders import pretrained
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import OfflineTowers, Towers, load_towers
from touchgoal.rewards.curves import Curves
from touchgoal.rewards.distance.embedding_distance import compute_curves
from touchgoal.rewards.distance.normalizer import NORMALIZER, REMEDY, DistanceNormalizer
from touchgoal.rewards.features.embedded import EmbeddedEpisode
from touchgoal.rewards.features.embedder import EpisodeEmbedder, check_words
from touchgoal.rewards.goals import Goal, GoalSpec, Inputs, assign_goals, check_goal
from touchgoal.rewards.value.value import REMEDY as VALUE_REMEDY
from touchgoal.rewards.value.value import VALUE_FORMAT, Value
from touchgoal.runtime.errors import UserError

_FIT = "touchgoal fit-normalizer, on successful episodes of your own"


@dataclass(frozen=True)
class RewardModel:
    """Encoders, goal and normalizer: turns an embedded trajectory into cost and reward curves."""

    embedder: EpisodeEmbedder  # the encoders
    goal: Goal  # the goal of each modality
    normalizer: DistanceNormalizer | None  # normalizer of the distances; None for raw ones
    note: str  # which normalizer, or why there is none, for people
    value: Value | None = None  # value of the task, if one lies beside the normalizer

    def curves(self, trajectory: EmbeddedEpisode) -> Curves:
        """Return the curves of a trajectory that this model's embedder embedded."""
        goal = self.embedder.embed_goal(self.goal, trajectory)
        curves = compute_curves(trajectory, goal, self.normalizer, self.value)
        return replace(curves, note=self.note)

    def provenance(self) -> dict[str, str]:
        """Return what the curves are made with, ready for JSON."""
        return asdict(self.embedder.made_with) | {"normalizer": self.note}


def load_reward_model(
    inputs: Inputs,
    goals: Sequence[GoalSpec],
    encoder: str | Path | AnyTouchEncoder | None = None,
    towers: str | Towers | None = None,
    normalizer: str | Path | DistanceNormalizer | None = None,
    device: str = "cpu",
) -> RewardModel:
    """Check the goals, load the encoders, and choose the normalizer.

    `normalizer`: a file of `fit-normalizer`, one already read, "encoder" for the one in the touch
    encoder's folder, "none" for raw distances, or None for the encoder's one if it was fitted on
    trajectories of this scene, else raw distances. A value that lies beside the file is used.
    UserError: whatever would stop the measurement.
    """
    if isinstance(towers, str) or towers is None:
        picture_words = towers not in (None, OfflineTowers.name)
    else:
        picture_words = towers.pretrained_together
    goal = assign_goals(goals, inputs.modalities, picture_words)
    check_goal(goal, inputs)
    name, value_folder = "the given normalizer", None
    if isinstance(normalizer, str | Path) and str(normalizer) not in ("encoder", "none"):
        name, value_folder = normalizer, Path(normalizer).parent
        normalizer = DistanceNormalizer.load(Path(normalizer))
    embedder, folder = load_embedder(inputs, encoder, towers, device)
    check_words(goals, embedder.encoder)
    if isinstance(normalizer, DistanceNormalizer):
        if reason := _mismatch(normalizer, inputs, goal, embedder):
            raise UserError(f"{name} does not apply here: {reason}; {REMEDY}")
        value, reason = _value_in(value_folder, inputs, embedder)
        if reason:
            raise UserError(f"{reason}; {VALUE_REMEDY}")
        note = f"normalizer: {name}" + ("" if value is None else ", with the value beside it")
        return RewardModel(embedder, goal, normalizer, note, value)
    if normalizer == "none":
        embedder.with_parts = False
        return RewardModel(embedder, goal, None, "normalizer: none, raw cosine distances")
    found, reason = _normalizer_of_encoder(folder, inputs, goal, embedder, normalizer is None)
    if found is None and normalizer == "encoder":
        raise UserError(f"the encoder's normalizer does not apply: {reason}; {REMEDY}")
    if found is None:
        embedder.with_parts = False
        return RewardModel(
            embedder, goal, None, f"raw cosine distances, for {reason}; to normalise them: {_FIT}"
        )
    value, why_not = _value_in(folder, inputs, embedder)
    with_value = "" if value is None else ", with the value beside it"
    without = f"; without the value, for {why_not}" if why_not else ""
    return RewardModel(embedder, goal, found, f"normalizer: {reason}{with_value}{without}", value)


def _value_in(
    folder: Path | None, inputs: Inputs, embedder: EpisodeEmbedder
) -> tuple[Value | None, str]:
    """Return the value beside a normalizer, and why it does not hold here; None without one."""
    if folder is None or not VALUE_FORMAT.weights_path(folder).is_file():
        return None, ""
    value = Value.load(folder)
    if reason := value.mismatch(inputs.fitted_task, inputs.cameras, embedder.made_with.towers):
        return None, f"the value in {folder} does not apply here: {reason}"
    return value, ""


def _normalizer_of_encoder(
    folder: Path | None, inputs: Inputs, goal: Goal, embedder: EpisodeEmbedder, same_scene: bool
) -> tuple[DistanceNormalizer | None, str]:
    """Return the normalizer in the encoder's folder and its path, or None and why it is not used."""
    if folder is None:
        return None, "published weights and loaded encoders come without a normalizer"
    path = folder / NORMALIZER
    if not path.is_file():
        return None, f"there is no {path}"
    found = DistanceNormalizer.load(path)
    reason = _mismatch(found, inputs, goal, embedder)
    if same_scene and found.scene != inputs.scene:
        reason = f"it was fitted on {found.scene} episodes and the scene here is {inputs.scene}"
    return (None, f"{path} does not apply: {reason}") if reason else (found, str(path))


def _mismatch(
    normalizer: DistanceNormalizer, inputs: Inputs, goal: Goal, embedder: EpisodeEmbedder
) -> str | None:
    return normalizer.mismatch(embedder.made_with, goal.as_dict(), goal.same_episode)


def load_embedder(
    inputs: Inputs,
    encoder: str | Path | AnyTouchEncoder | None = None,
    towers: str | Towers | None = None,
    device: str = "cpu",
) -> tuple[EpisodeEmbedder, Path | None]:
    """Load the encoders for trajectories; return them, and the folder that may have a normalizer.

    Default: the touch encoder that ships for the sensor, and the towers that it was aligned with,
    else "offline". UserError: no encoder ships for the sensor, it is for another one, or it was
    aligned with other towers.
    """
    _check_device(device)
    touch, folder = _load_touch(inputs, encoder)
    if touch is not None:
        touch.to(device)
    if isinstance(towers, str) or towers is None:
        towers = load_towers(towers or (touch and touch.towers) or OfflineTowers.name, device)
    return EpisodeEmbedder(towers, touch, inputs.camera or ""), folder


def _check_device(device: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"--device {device} cannot be used here ({reason}): give cpu") from error


def _load_touch(
    inputs: Inputs, encoder: str | Path | AnyTouchEncoder | None
) -> tuple[AnyTouchEncoder | None, Path | None]:
    if not inputs.sides:
        if encoder is not None:
            raise UserError(f"{inputs.name} has no touch: leave the encoder out")
        return None, pretrained.DEFAULT_ENCODER  # whose normalizer knows images, too
    if isinstance(encoder, AnyTouchEncoder):
        return encoder, None
    path = _shipped_for(inputs) if encoder is None else pretrained.find_encoder(encoder)
    return pretrained.load_encoder(path, inputs.sensor), path if path.is_dir() else None


def _shipped_for(inputs: Inputs) -> Path:
    images_alone = "or measure the images alone: --towers offline"
    if inputs.sensor is None:
        raise UserError(f"{inputs.name} does not name its sensor: give --encoder, {images_alone}")
    try:
        return pretrained.shipped_encoder_for(inputs.sensor)
    except UserError as error:
        raise UserError(f"{error}; {images_alone}") from None
