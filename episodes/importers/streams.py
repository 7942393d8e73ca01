"""What a recording of any format holds: quantities over time, each with time stamps of its own."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped


@dataclass(frozen=True, eq=False)
class Stream:
    """Samples of one quantity."""

    times: Float[np.ndarray, " n"]  # s, rising
    shape: tuple[int, ...]  # of a sample; (h, w, 3) of an RGB image
    # returns the samples with these numbers, which rise: (k, *shape)
    read: Callable[[Int[np.ndarray, " k"]], Shaped[np.ndarray, "k ..."]]
    names: tuple[str, ...] = ()  # of the components, where the recording tells

    @property
    def is_image(self) -> bool:
        """Whether the samples are images."""
        return len(self.shape) == 3


@dataclass(frozen=True, eq=False)
class RawEpisode:
    """One episode, as it was recorded."""

    name: str
    streams: dict[str, Stream]
    success: bool | None = None  # None: it does not tell
