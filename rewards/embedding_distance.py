"""Distance of a trajectory to a goal in embedding space (MMWand, section V-E, with touch).

All distances are cosine distances, 1 - cos, in [0, 2]; touch is averaged over the fingertips.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

from touchgoal.control.features import FRONT, TACTILE, TRUTH_CONTACT
from touchgoal.control.tactile.picture_guard import check_untouched
from touchgoal.control.tactile.sensor_models import SENSORS
from touchgoal.encoders.backbones.touch_backbone import TouchBackbone
from touchgoal.encoders.pretrained import AnyTouchEncoder
from touchgoal.encoders.towers.towers import Towers
from touchgoal.episodes.schema import Episode, is_camera
from touchgoal.episodes.touches import touch_background
from touchgoal.rewards.curves import Contact, Curves, first_contact
from touchgoal.rewards.goals import (
    EpisodeEnd,
    Goal,
    GoalPicture,
    GoalSpec,
    Modality,
    PictureGoal,
    Sentence,
    TouchArrays,
    TouchGoal,
    frame_index,
)
from touchgoal.rewards.metrics import START_FRAMES
from touchgoal.rewards.normalizer import DistanceNormalizer, EmbeddingSource
from touchgoal.runtime.errors import UserError


@dataclass(frozen=True)
class EmbeddedEpisode:
    """One embedded trajectory; its distance to a goal is then a dot product per frame."""

    source: str  # name of the trajectory, for people
    fps: float  # frames per second
    contact: Contact  # first contact
    made_with: EmbeddingSource  # encoders and sensors; embeddings of others cannot be compared
    image: Float32[np.ndarray, "n d"] | None = None  # unit image embeddings; None without a camera
    sides: tuple[str, ...] = ()  # keys of the fingertips that have touch embeddings
    touch: Float32[np.ndarray, "sides n k"] | None = None  # unit embeddings; None without touch
    # unit embeddings of the sentences about its object; None if there are none or they were not
    # requested
    descriptions: Float32[np.ndarray, "m k"] | None = None
    object: str = ""  # catalogue id of the object, "" if unknown
    success: bool | None = None  # whether the episode reached its goal, None if unknown
    words: bool = True  # whether its touch embeddings can be compared with sentences

    def __len__(self) -> int:
        return self.touches().shape[1] if self.image is None else len(self.image)

    @property
    def modalities(self) -> tuple[Modality, ...]:
        """Modalities that can be measured."""
        image: tuple[Modality, ...] = () if self.image is None else ("image",)
        touch: tuple[Modality, ...] = () if self.touch is None else ("tactile",)
        return (*image, *touch, "text") if touch and self.words else (*image, *touch)

    def pictures(self) -> Float32[np.ndarray, "n d"]:
        """Return the image embeddings of a trajectory that has the modality image."""
        assert self.image is not None, f"{self.source} has no pictures"
        return self.image

    def touches(self) -> Float32[np.ndarray, "sides n k"]:
        """Return the touch embeddings of a trajectory that has the modality tactile."""
        assert self.touch is not None, f"{self.source} has no touch"
        return self.touch


@dataclass(frozen=True)
class EmbeddedGoal:
    """A goal as unit embeddings, one per modality that has a goal."""

    forms: Mapping[str, str]  # the goals as a user writes them, by modality
    same_episode: frozenset[str]  # modalities whose goal is the trajectory's own frame
    image: Float32[np.ndarray, " d"] | None = None
    touch: Float32[np.ndarray, "sides k"] | None = None
    text: Float32[np.ndarray, " k"] | None = None


class EpisodeEmbedder:
    """Embeds trajectories and goals with frozen encoders.

    The background of each fingertip is the median of the episode's first 5 frames, which must be
    free of contact.
    """

    def __init__(
        self, towers: Towers, encoder: AnyTouchEncoder | None, camera: str = FRONT
    ) -> None:
        """Take the encoders.

        UserError: the encoder was trained with other towers.

        Args:
            encoder: touch encoder (put into evaluation mode), which takes sentences if it was aligned
                with these towers; None to measure images alone.
            camera: key of the camera whose images are measured; "" for a plain video's.
        """
        self._towers = towers
        self.encoder = encoder
        self._aligned = encoder if encoder is not None and encoder.towers else None
        self.knows_words = self._aligned is not None  # touch can be compared with sentences
        self._camera = camera
        # A CLIP's name ends in "#" and a hash of its weights; the folder before it may differ.
        self._pictures_with = EmbeddingSource(towers.name.rpartition("#")[2], camera)
        self.made_with = self._pictures_with  # of episodes with touch, if there is an encoder
        if encoder is not None:
            if self._aligned is not None:
                self._aligned.check_towers(towers)
            encoder.eval()
            self.made_with = replace(
                self._pictures_with,
                encoder=_weights_hash(encoder),
                sensor=encoder.config.sensor or "",
            )

    def embed_episode(
        self, episode: Episode, fps: float, source: str, descriptions: bool = False
    ) -> EmbeddedEpisode:
        """Embed an episode's camera and fingertips; on request the sentences about it, too.

        UserError: the episode lacks the camera, starts in contact, or has descriptions that are no
        list of sentences.
        """
        sides = tuple(k for k in TACTILE if k in episode.frames) if self.encoder else ()
        success = episode.meta.get("success")
        return EmbeddedEpisode(
            source=source,
            fps=fps,
            contact=first_contact(episode),
            made_with=self.made_with if sides else self._pictures_with,
            image=self._episode_pictures(episode, source, touch_alone=bool(sides)),
            sides=sides,
            touch=self._episode_touch(episode, sides, source) if sides else None,
            descriptions=self._embed_descriptions(episode, source) if descriptions else None,
            object=str(episode.meta.get("object", "")),
            success=None if success is None else bool(success),
            words=self.knows_words,
        )

    def embed_video(
        self, frames: UInt8[np.ndarray, "n h w 3"], fps: float, source: str
    ) -> EmbeddedEpisode:
        """Embed a plain video or folder of images: images alone, of an unknown camera."""
        return EmbeddedEpisode(
            source=source,
            fps=fps,
            contact=Contact(None, "no touch"),
            made_with=replace(self._pictures_with, camera=""),
            image=self.embed_pictures(frames),
        )

    def embed_goal(self, goal: Goal, own: EmbeddedEpisode) -> EmbeddedGoal:
        """Embed a goal for one trajectory; frames of `own` are not embedded again.

        UserError: a frame beyond the trajectory, an unreadable picture or episode, or an episode
        with other fingertips.
        """
        image = None if goal.image is None else self._goal_picture(goal.image, own)
        touch = None if goal.tactile is None else self._goal_touch(goal.tactile, own)
        text = None if goal.text is None else self.embed_sentences([goal.text.text])[0]
        return EmbeddedGoal(goal.as_dict(), goal.same_episode, image, touch, text)

    def embed_pictures(self, frames: UInt8[np.ndarray, "n h w 3"]) -> Float32[np.ndarray, "n d"]:
        """Return unit embeddings of camera images."""
        return _unit(self._towers.embed_images(frames))

    def embed_touch(
        self, frames: UInt8[np.ndarray, "n h w 3"], background: UInt8[np.ndarray, "h w 3"]
    ) -> Float32[np.ndarray, "n k"]:
        """Return embeddings of one fingertip's images, given the same fingertip untouched.

        They are unit vectors, except those of a `PooledEncoder`, which are shorter for a lighter touch
        and so farther from a firm one.
        """
        assert self.encoder is not None  # without it no trajectory has sides
        embedded = self.encoder.embed_frames(frames, background)
        if isinstance(self.encoder, TouchBackbone):
            embedded /= np.linalg.norm(embedded, axis=1, keepdims=True)
        return embedded

    def embed_sentences(self, sentences: Sequence[str]) -> Float32[np.ndarray, "m k"]:
        """Return unit embeddings of sentences on how touch feels, comparable with `embed_touch`."""
        assert self._aligned is not None  # without it no modality takes a sentence
        return self._aligned.embed_text_goal(list(sentences), self._towers)

    def _goal_picture(self, spec: PictureGoal, own: EmbeddedEpisode) -> Float32[np.ndarray, " d"]:
        if isinstance(spec, Sentence):
            assert self._towers.pretrained_together  # or a sentence is no goal for pictures
            return _unit(self._towers.embed_texts([spec.text]))[0]
        if isinstance(spec, GoalPicture):
            return self.embed_pictures(spec.read())[0]
        if isinstance(spec, EpisodeEnd):
            camera = self._camera or FRONT
            return self.embed_pictures(spec.read([camera]).frames[camera][-1:])[0]
        return own.pictures()[frame_index(spec, len(own), own.source)]

    def _goal_touch(self, spec: TouchGoal, own: EmbeddedEpisode) -> Float32[np.ndarray, "sides k"]:
        if isinstance(spec, TouchArrays):
            return np.concatenate(
                [self.embed_touch(spec.pictures[k][None], spec.backgrounds[k]) for k in own.sides]
            )
        if isinstance(spec, EpisodeEnd):
            return self._episode_touch(spec.read(own.sides), own.sides, str(spec))[:, -1]
        return own.touches()[:, frame_index(spec, len(own), own.source)]

    def _episode_pictures(
        self, episode: Episode, source: str, touch_alone: bool
    ) -> Float32[np.ndarray, "n d"] | None:
        if self._camera in episode.frames:
            return self.embed_pictures(episode.frames[self._camera])
        cameras = [key for key in episode.frames if is_camera(key)]
        if cameras or not touch_alone:
            raise UserError(missing_camera(source, self._camera, cameras))
        return None

    def _episode_touch(
        self, episode: Episode, sides: Sequence[str], source: str
    ) -> Float32[np.ndarray, "sides n k"]:
        truth = episode.frames.get(TRUTH_CONTACT)
        if truth is not None and truth[:START_FRAMES].any():
            raise UserError(
                f"{source} starts in contact, so its fingertips have no background; record it "
                f"with {START_FRAMES} frames before the first touch"
            )
        pictures = [episode.frames[side] for side in sides]
        backgrounds = [touch_background(p) for p in pictures]
        if (sensor := SENSORS.get(self.made_with.sensor)) is not None:
            for side, background in zip(sides, backgrounds, strict=True):
                check_untouched(background, sensor, f"{side} of {source}")
        return np.stack(
            [self.embed_touch(p, b) for p, b in zip(pictures, backgrounds, strict=True)]
        )

    def _embed_descriptions(
        self, episode: Episode, source: str
    ) -> Float32[np.ndarray, "m k"] | None:
        sentences = episode.meta.get("descriptions", [])
        if not isinstance(sentences, list):
            raise UserError(f"{source}: meta descriptions must be a list of sentences")
        return self.embed_sentences(sentences) if sentences and self._aligned else None


def check_words(specs: Iterable[GoalSpec], encoder: AnyTouchEncoder | None) -> None:
    """Raise UserError if a goal is a sentence and the touch encoder was not aligned with texts."""
    sentences = [spec for spec in specs if isinstance(spec, Sentence)]
    if sentences and encoder is not None and encoder.towers is None:
        raise UserError(
            f"goal '{sentences[0]}': this touch encoder was not aligned with texts: leave the goal "
            "out, or take an encoder of train-encoder align"
        )


def missing_camera(source: str, camera: str, cameras: Sequence[str]) -> str:
    """Return the message for a source that lacks a camera."""
    there = f"choose --camera {' or '.join(cameras)}" if cameras else "it has no camera"
    return f"{source} has no images of {camera}: {there}"


def compute_distances(
    episode: EmbeddedEpisode, goal: EmbeddedGoal
) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the raw cosine distance per frame, for each modality that has a goal."""
    raw = {}
    if goal.image is not None:
        raw["image"] = image_distances(episode.pictures(), goal.image[None])[:, 0]
    if goal.touch is not None:
        raw["tactile"] = touch_distances(episode.touches(), goal.touch[None])[:, 0]
    if goal.text is not None:
        raw["text"] = text_distances(episode.touches(), goal.text[None])[:, 0]
    return raw


def compute_curves(
    episode: EmbeddedEpisode, goal: EmbeddedGoal, normalizer: DistanceNormalizer | None
) -> Curves:
    """Return the curves of one trajectory to one goal; without a normalizer raw, and none fused.

    UserError: the normalizer lacks a modality or was fitted for something else.
    """
    raw = compute_distances(episode, goal)
    same = goal.same_episode
    normalised = normalizer.normalise(raw, episode.made_with, same) if normalizer else {}
    return Curves(
        episode.source,
        goal.forms,
        episode.fps,
        episode.contact,
        raw,
        normalised,
        same.intersection(raw),
    )


def image_distances(
    image: Float32[np.ndarray, "n d"], goals: Float32[np.ndarray, "g d"]
) -> Float[np.ndarray, "n g"]:
    """Return the cosine distance of each image to each goal."""
    return 1 - image.astype(np.float64) @ goals.astype(np.float64).T


def touch_distances(
    touch: Float32[np.ndarray, "sides n k"], goals: Float32[np.ndarray, "g sides k"]
) -> Float[np.ndarray, "n g"]:
    """Return the distance of each touch to each goal's same fingertip, mean over the fingertips."""
    cosine = np.einsum("snk,gsk->ng", touch, goals, dtype=np.float64)
    return 1 - cosine / len(touch)


def text_distances(
    touch: Float32[np.ndarray, "sides n k"], goals: Float32[np.ndarray, "g k"]
) -> Float[np.ndarray, "n g"]:
    """Return the distance of each touch to each sentence, mean over the fingertips."""
    return 1 - np.mean(touch, axis=0, dtype=np.float64) @ goals.astype(np.float64).T


def _unit(embeddings: torch.Tensor) -> Float32[np.ndarray, "n d"]:
    return torch.nn.functional.normalize(embeddings.float(), dim=1).cpu().numpy()


def _weights_hash(encoder: AnyTouchEncoder) -> str:
    """Return a short hash of weights and preprocessor, whatever folder they were loaded from."""
    digest = hashlib.sha256(encoder.config.preprocessor.encode())
    for name, weight in sorted(encoder.state_dict().items()):
        digest.update(name.encode())
        digest.update(weight.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:12]
