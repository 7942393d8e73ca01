"""Distance of a trajectory to a goal in embedding space (MMWand, section V-E, with touch).

All distances are cosine distances, 1 - cos, in [0, 2]:

- image: frozen tower's embedding of the camera picture against that of the goal picture;
- tactile: touch embedding of each fingertip against the goal's same fingertip, mean over sides;
- text: touch embedding of each fingertip against the projected goal sentence, mean over sides.

Raw distances of different modalities are not comparable (a modality gap keeps touch and text far
apart even at the goal), so a `DistanceNormalizer`, fitted once on successful training episodes, maps each to 1
at the usual start and 0 at the usual end. Scaling each episode by its own extremes instead would
turn the noise of an episode that never touches anything into a perfect curve.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

from touchgoal.control.errors import UserError
from touchgoal.control.features import FRONT, TACTILE, TRUTH_CONTACT
from touchgoal.encoders.alignment.touch_encoder import TouchEncoder
from touchgoal.encoders.towers.towers import Towers
from touchgoal.episodes.schema import Episode
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import (
    Contact,
    Curves,
    DistanceNormalizer,
    add_fused_curves,
    first_contact,
    median_name,
)
from touchgoal.rewards.goals import (
    EpisodeEnd,
    FrameNumber,
    Goal,
    LastFrame,
    Modality,
    PictureFile,
)
from touchgoal.rewards.metrics import START_FRAMES

END_FRAMES = 5
"""Frames before the last one that stand for the end of a training episode."""

MIN_SEPARATED = 0.75
"""Least share of (episode, goal) pairs whose end must be nearer the goal than its start; 0.5 is
chance. Below it, one unit of the scale would mostly be noise."""

MIN_GAP = 1e-4
"""Least raw distance between the start and the goal median; float32 resolves about 1e-6."""


@dataclass(frozen=True)
class EmbeddedEpisode:
    """One trajectory, embedded once; measuring it against a goal is then a dot product per frame.

    Attributes:
        source: which trajectory, for people.
        fps: frames per second.
        contact: first contact.
        space: what made the embeddings, by modality; only equal spaces can be compared.
        image: unit picture embeddings.
        sides: the fingertips that have touch embeddings, as vocabulary keys.
        touch: unit touch embeddings; None without touch.
        descriptions: unit embeddings of the sentences about the own object; None without.
        object: catalogue id of the object, "" if unknown.
        success: whether the episode reached its goal, None if unknown.
    """

    source: str
    fps: float
    contact: Contact
    space: Mapping[str, str]
    image: Float32[np.ndarray, "n d"]
    sides: tuple[str, ...] = ()
    touch: Float32[np.ndarray, "sides n k"] | None = None
    descriptions: Float32[np.ndarray, "m k"] | None = None
    object: str = ""
    success: bool | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.image)

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """The modalities this trajectory can be measured in."""
        return ("image",) if self.touch is None else ("image", "tactile", "text")


@dataclass(frozen=True)
class EmbeddedGoal:
    """A goal as unit embeddings, one per modality that has a goal.

    Attributes:
        forms: the user's words, by modality.
        own: modalities whose goal is a frame of the measured trajectory itself.
    """

    forms: Mapping[str, str]
    own: frozenset[str]
    image: Float32[np.ndarray, " d"] | None = None
    touch: Float32[np.ndarray, "sides k"] | None = None
    text: Float32[np.ndarray, " k"] | None = None


class EpisodeEmbedder:
    """Embeds trajectories and goals with frozen encoders.

    The background of each fingertip is the median of the episode's first 5 frames, which must be
    free of contact.
    """

    def __init__(self, towers: Towers, encoder: TouchEncoder | None, camera: str = FRONT) -> None:
        """Keep the encoders and note what they are.

        Args:
            towers: frozen image and text towers.
            encoder: touch encoder trained with these towers (put into evaluation mode), or None
                to measure pictures alone.
            camera: vocabulary key of the camera whose pictures are measured. A plain video is
                taken to come from it.

        Raises:
            UserError: the encoder was trained with other towers.
        """
        self._towers = towers
        self._encoder = encoder
        self._camera = camera
        # A CLIP's name ends in "#" and a hash of its weights; the folder before it may differ.
        self._space = {"image": f"{towers.name.rpartition('#')[2]} {camera}"}
        if encoder is not None:
            encoder.check_towers(towers)
            encoder.eval()
            self._space |= dict.fromkeys(("tactile", "text"), _weights_hash(encoder))

    @property
    def space(self) -> Mapping[str, str]:
        """What makes the embeddings, by modality."""
        return self._space

    def embed_episode(self, episode: Episode, fps: float, source: str) -> EmbeddedEpisode:
        """Embed the camera and every fingertip of an episode.

        Raises:
            UserError: the episode lacks the camera, starts in contact, or has descriptions that are
                no list of sentences.
        """
        if self._camera not in episode.frames:
            raise UserError(f"{source} has no pictures of {self._camera}; choose another camera")
        sides = tuple(k for k in TACTILE if k in episode.frames) if self._encoder else ()
        descriptions = episode.meta.get("descriptions", [])
        if not isinstance(descriptions, list):
            raise UserError(f"{source}: meta descriptions must be a list of sentences")
        success = episode.meta.get("success")
        return EmbeddedEpisode(
            source=source,
            fps=fps,
            contact=first_contact(episode),
            space=self._space,
            image=self._embed_pictures(episode.frames[self._camera]),
            sides=sides,
            touch=self._embed_touch(episode, sides, source) if sides else None,
            descriptions=self._embed_sentences(descriptions) if sides and descriptions else None,
            object=str(episode.meta.get("object", "")),
            success=None if success is None else bool(success),
        )

    def embed_video(
        self, frames: UInt8[np.ndarray, "n h w 3"], fps: float, source: str
    ) -> EmbeddedEpisode:
        """Embed a plain video or folder of frames: pictures alone."""
        return EmbeddedEpisode(
            source=source,
            fps=fps,
            contact=Contact(None, "no touch"),
            space={"image": self._space["image"]},
            image=self._embed_pictures(frames),
        )

    def embed_goal(self, goal: Goal, own: EmbeddedEpisode) -> EmbeddedGoal:
        """Embed a goal for one trajectory; its own frames are not embedded again.

        Raises:
            UserError: a frame beyond the trajectory, an unreadable picture or episode, or an
                episode with other fingertips.
        """
        image = None if goal.image is None else self._goal_picture(goal.image, own)
        touch = None if goal.tactile is None else self._goal_touch(goal.tactile, own)
        text = None if goal.text is None else self._embed_sentences([goal.text.text])[0]
        return EmbeddedGoal(goal.as_dict(), goal.own, image, touch, text)

    def _goal_picture(
        self, spec: LastFrame | FrameNumber | PictureFile | EpisodeEnd, own: EmbeddedEpisode
    ) -> Float32[np.ndarray, " d"]:
        if isinstance(spec, PictureFile):
            return self._embed_pictures(spec.read())[0]
        if isinstance(spec, EpisodeEnd):
            return self._embed_pictures(spec.read([self._camera]).frames[self._camera][-1:])[0]
        return own.image[_frame_index(spec, own)]

    def _goal_touch(
        self, spec: LastFrame | FrameNumber | EpisodeEnd, own: EmbeddedEpisode
    ) -> Float32[np.ndarray, "sides k"]:
        if isinstance(spec, EpisodeEnd):
            return self._embed_touch(spec.read(own.sides), own.sides, str(spec))[:, -1]
        return _touch(own)[:, _frame_index(spec, own)]

    def _embed_pictures(self, frames: UInt8[np.ndarray, "n h w 3"]) -> Float32[np.ndarray, "n d"]:
        embeddings = self._towers.embed_images(frames).float()
        return torch.nn.functional.normalize(embeddings, dim=1).cpu().numpy()

    def _embed_touch(
        self, episode: Episode, sides: Sequence[str], source: str
    ) -> Float32[np.ndarray, "sides n k"]:
        assert self._encoder is not None  # without it no trajectory has sides
        truth = episode.frames.get(TRUTH_CONTACT)
        if truth is not None and truth[:START_FRAMES].any():
            raise UserError(
                f"{source} starts in contact, so its fingertips have no background; record it "
                f"with {START_FRAMES} frames before the first touch"
            )
        pictures = [episode.frames[side] for side in sides]
        return np.stack([self._encoder.embed_frames(p, touch_background(p)) for p in pictures])

    def _embed_sentences(self, sentences: Sequence[str]) -> Float32[np.ndarray, "m k"]:
        assert self._encoder is not None  # without it no modality takes a sentence
        return self._encoder.embed_text_goal(list(sentences), self._towers)


def distances(episode: EmbeddedEpisode, goal: EmbeddedGoal) -> dict[str, Float[np.ndarray, " n"]]:
    """Raw cosine distance per frame, for each modality that has a goal."""
    raw = {}
    if goal.image is not None:
        raw["image"] = _image_distances(episode.image, goal.image[None])[:, 0]
    if goal.touch is not None and episode.touch is not None:
        raw["tactile"] = _touch_distances(episode.touch, goal.touch[None])[:, 0]
    if goal.text is not None and episode.touch is not None:
        raw["text"] = _text_distances(episode.touch, goal.text[None])[:, 0]
    return raw


def compute_curves(
    episode: EmbeddedEpisode, goal: EmbeddedGoal, scale: DistanceNormalizer | None
) -> Curves:
    """Curves of one trajectory to one goal; without a scale raw ones alone, and none fused.

    Raises:
        UserError: the scale lacks a modality or was fitted for other encoders.
    """
    raw = distances(episode, goal)
    normalised = (
        {} if scale is None else add_fused_curves(scale.normalise(raw, episode.space, goal.own))
    )
    return Curves(episode.source, goal.forms, episode.fps, episode.contact, raw, normalised)


def fit_normalizer(
    episodes: Sequence[EmbeddedEpisode], modalities: Sequence[Modality]
) -> DistanceNormalizer:
    """Fit the scale on successful training episodes.

    Each episode is measured against two kinds of goal, because its own end is much nearer than
    anybody else's: its own last frame; and for image the last frame of every other episode, for
    tactile that of every other episode with the same object, for text every sentence about its
    object. The last frame is never measured itself, or an episode's own goal would count as
    distance 0: the 5 frames before it stand for the end, the first 5 for the start.

    Raises:
        UserError: no episode, a failed or too short one, one of another space, or a modality that
            is missing or does not separate start from end.
    """
    _check_training(episodes, modalities)
    start, goal, separated = {}, {}, {}
    for modality in modalities:
        for own in (False, True) if modality != "text" else (False,):
            starts, ends = _training_distances(episodes, modality, own)
            name = median_name(modality, own)
            separated[name] = _check_separation(name, starts, ends)
            start[name], goal[name] = float(np.median(starts)), float(np.median(ends))
    space = {m: episodes[0].space[m] for m in modalities}
    return DistanceNormalizer(start, goal, separated, space, len(episodes))


def _check_separation(
    name: str, starts: Float[np.ndarray, " pairs"], ends: Float[np.ndarray, " pairs"]
) -> float:
    """Share of pairs whose end is nearer than its start; UserError if too few to scale by."""
    if not len(starts):
        raise UserError(f"no two training episodes share an object, so '{name}' has no scale")
    share = float(np.mean(ends < starts))
    start, end = float(np.median(starts)), float(np.median(ends))
    if share < MIN_SEPARATED or start - end < MIN_GAP:
        raise UserError(
            f"the training episodes do not separate start from end in '{name}': the end is nearer "
            f"the goal in {share:.0%} of {len(starts)} pairs (needed {MIN_SEPARATED:.0%}), median "
            f"distance {start:.4f} at the start and {end:.4f} at the end; leave '{name}' out, or "
            f"take episodes that end in the goal state and an encoder trained for them"
        )
    return share


def _check_training(episodes: Sequence[EmbeddedEpisode], modalities: Sequence[Modality]) -> None:
    if not episodes:
        raise UserError("a scale needs at least one successful training episode, got none")
    for e in episodes:
        missing = [m for m in modalities if m not in e.modalities]
        if "text" in modalities and e.descriptions is None:
            missing.append("text")
        if missing:
            raise UserError(f"{e.source} has nothing for {' and '.join(missing)}; leave that out")
        if e.success is False:
            raise UserError(f"{e.source} failed; fit a scale on successful episodes alone")
        if len(e) < START_FRAMES + END_FRAMES + 1:
            raise UserError(
                f"{e.source} has {len(e)} frames; a training episode needs at least "
                f"{START_FRAMES + END_FRAMES + 1}"
            )
        if e.space != episodes[0].space or e.sides != episodes[0].sides:
            raise UserError(
                f"{e.source} was embedded by other encoders or fingertips than "
                f"{episodes[0].source}; embed all training episodes alike"
            )


def _training_distances(
    episodes: Sequence[EmbeddedEpisode], modality: Modality, own: bool
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Raw distance of the start and of the end of each training episode to each of its goals."""
    starts, ends = [], []
    for e in episodes:
        goals = [o for o in episodes if (o is e) == own]
        if modality == "tactile":
            goals = [o for o in goals if o.object == e.object]
        if not goals and modality != "text":
            continue
        if modality == "image":
            d = _image_distances(e.image, np.stack([o.image[-1] for o in goals]))
        elif modality == "tactile":
            d = _touch_distances(_touch(e), np.stack([_touch(o)[:, -1] for o in goals]))
        else:
            assert e.descriptions is not None  # checked with the training episodes
            d = _text_distances(_touch(e), e.descriptions)
        starts.append(np.median(d[:START_FRAMES], axis=0))
        ends.append(np.median(d[-1 - END_FRAMES : -1], axis=0))
    return np.concatenate([[], *starts]), np.concatenate([[], *ends])


def _touch(episode: EmbeddedEpisode) -> Float32[np.ndarray, "sides n k"]:
    assert episode.touch is not None  # the caller has checked that the modality is there
    return episode.touch


def _image_distances(
    image: Float32[np.ndarray, "n d"], goals: Float32[np.ndarray, "g d"]
) -> Float[np.ndarray, "n g"]:
    return 1 - image.astype(np.float64) @ goals.astype(np.float64).T


def _touch_distances(
    touch: Float32[np.ndarray, "sides n k"], goals: Float32[np.ndarray, "g sides k"]
) -> Float[np.ndarray, "n g"]:
    cosine = np.einsum("snk,gsk->ng", touch, goals, dtype=np.float64)
    return 1 - cosine / len(touch)


def _text_distances(
    touch: Float32[np.ndarray, "sides n k"], goals: Float32[np.ndarray, "g k"]
) -> Float[np.ndarray, "n g"]:
    return 1 - np.mean(touch, axis=0, dtype=np.float64) @ goals.astype(np.float64).T


def _frame_index(spec: LastFrame | FrameNumber, own: EmbeddedEpisode) -> int:
    if isinstance(spec, LastFrame):
        return len(own) - 1
    if spec.index >= len(own):
        raise UserError(
            f"goal '{spec}' lies beyond {own.source}, whose frames are 0 to {len(own) - 1}"
        )
    return spec.index


def _weights_hash(encoder: TouchEncoder) -> str:
    """Short hash of weights and preprocessor, the same wherever the encoder was loaded from.

    Saving rounds the weights, so a scale is fitted with an encoder loaded from disk.
    """
    digest = hashlib.sha256(encoder.config.preprocessor.encode())
    for name, weight in sorted(encoder.state_dict().items()):
        digest.update(name.encode())
        digest.update(weight.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:12]
