"""Matching of a dot grid with the spots of the next frame, through jumps of half a spacing.

On a lattice, once the dots move by half a spacing, the nearest spot of each is its neighbour's. So
the dots first move together: an affine map, fitted robustly from several starts, carries the grid,
and what is left is matched dot by dot. The start that leaves fewest dots and spots over wins.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

Dots = Float32[np.ndarray, "rows columns 2"]
Flags = Bool[np.ndarray, "rows columns"]
Spots = Float32[np.ndarray, "n 2"]
Points = Float32[np.ndarray, "dots 2"]

# Lengths are in spacings of the grid.
_REACH = 0.5  # farthest spot from a dot's expected place
_CLEAR = 0.08  # cost (mean distance and motion) below which no other start is tried
_FARTHEST = 1  # longest jump along x or y that is searched
_BINS = 8  # bins of the search per spacing
_JUMPS = 4  # likeliest jumps that are tried
_ROUNDS = 4  # of matching and fitting, at most
_STRAY = 0.1  # distance from the map at which a dot counts half
_FEWEST = 0.3  # share of the dots that a map needs
# weight, in dots, of zero shear and scale: a single row of dots does not determine them
_STIFF = 1e-2
_RIM = 0.1  # width of the frame's rim, where dots are not seen whole
# cost of motion: a column that appears at the rim shall not look like a jump by a spacing
_MOTION_COST = 0.1


class _Match(NamedTuple):
    """Matches of a grid's dots with spots, at their `expected` places (px)."""

    expected: Points
    spot: Int[np.ndarray, " dots"]  # nearest one of each dot
    found: Bool[np.ndarray, " dots"]  # whether the dot is also the spot's nearest, and near
    distance: Float32[np.ndarray, " dots"]  # to the spot, px


def match(
    starts: list[Dots], spots: Spots, spacing: float, size: tuple[int, int]
) -> tuple[Dots, Flags]:
    """Return the dots' positions (px), and which were found; the others are predicted.

    `starts` are guesses of the positions, first those in the last frame. They are tried in order,
    after the first one also its jumps by up to a spacing, until one explains the frame; else the
    best is taken. `spacing` is the grid's, px; a dot outside the frame of `size` (width, height) is
    not missed.
    """
    shape = starts[0].shape
    if not len(spots):
        return starts[0].copy(), np.zeros(shape[:2], bool)
    places = [start.reshape(-1, 2) for start in starts]

    best, least = None, np.inf
    for start in _starts(places, spots, spacing):
        found = _carry(start, spots, spacing)
        left = _left_over(found, len(spots), spacing, np.array(size, np.float32))
        motion = np.linalg.norm((found.expected - places[0]).mean(0))
        left += _MOTION_COST * float(motion)
        if left < least:
            best, least = found, left
        if least < _CLEAR * spacing:
            break
    assert best is not None
    # The rest that the map leaves is smooth, too: predict it from neighbouring dots.
    off = (spots[best.spot] - best.expected).reshape(shape)
    bent = average_neighbours(off, best.found.reshape(shape[:2])).reshape(-1, 2)
    final = _nearest(best.expected + bent, spots, _REACH * spacing)
    positions = np.where(final.found[:, None], spots[final.spot], final.expected)
    return positions.reshape(shape), final.found.reshape(shape[:2])


def _starts(places: list[Points], spots: Spots, spacing: float) -> Iterator[Points]:
    yield places[0]
    for jump in _likely_jumps(places[0], spots, spacing):
        yield places[0] + jump
    yield from places[1:]


def average_neighbours(field: Dots, known: Flags) -> Dots:
    """Average a field over known neighbours, the nearest counting most."""
    weight = known.astype(np.float32)
    total = cv2.GaussianBlur(field * weight[..., None], (0, 0), 1.0, borderType=cv2.BORDER_CONSTANT)
    share = cv2.GaussianBlur(weight, (0, 0), 1.0, borderType=cv2.BORDER_CONSTANT)
    return total / np.maximum(share, 1e-6)[..., None]


def _carry(start: Points, spots: Spots, spacing: float) -> _Match:
    """Carry all dots by the map that fits their matches, and match again, until nothing changes."""
    found = _nearest(start, spots, _REACH * spacing)
    ones = np.ones((len(start), 1), np.float32)
    terms = np.concatenate([ones, (start - start.mean(0)) / spacing], 1)
    for _ in range(_ROUNDS):
        if found.found.mean() < _FEWEST:
            break
        before, known = found, found.found
        moved = spots[found.spot[known]] - start[known]
        expected = start + terms @ _affine(terms[known], moved, _STRAY * spacing)
        found = _nearest(expected, spots, _REACH * spacing)
        if (found.found == known).all() and (found.spot == before.spot)[known].all():
            break
    return found


def _nearest(expected: Points, spots: Spots, reach: float) -> _Match:
    """Match each dot with its nearest spot, if it is that spot's nearest dot and within reach."""
    square = (expected**2).sum(1)[:, None] + (spots**2).sum(1) - 2 * expected @ spots.T
    spot = square.argmin(1)
    distance = np.sqrt(np.maximum(square[np.arange(len(spot)), spot], 0))
    mutual = square.argmin(0)[spot] == np.arange(len(spot))
    return _Match(expected, spot, mutual & (distance < reach), distance)


def _affine(
    terms: Float32[np.ndarray, "n 3"], moved: Spots, stray: float
) -> Float32[np.ndarray, "3 2"]:
    """Fit motions (px) linearly to 1, x and y, dots beyond `stray` (px) counting little."""
    solved = np.zeros((3, 2), np.float32)
    stiff = np.diag(np.array([0, _STIFF, _STIFF], np.float32))
    weight = np.ones(len(terms), np.float32)
    for _ in range(3):
        weighted = terms * weight[:, None]
        solved = np.linalg.solve(terms.T @ weighted + stiff, weighted.T @ moved)
        off = moved - terms @ solved
        weight = 1 / (1 + (off**2).sum(1) / np.float32(stray**2))
    return solved


def _left_over(
    match: _Match, n_spots: int, spacing: float, size: Float32[np.ndarray, "2"]
) -> float:
    """Return the mean distance (px) of dots from spots; unmatched ones count half a spacing."""
    rim = _RIM * spacing
    inside = ((match.expected > rim) & (match.expected < size - 1 - rim)).all(1)
    single = (inside & ~match.found).sum() + n_spots - match.found.sum()
    near = match.distance[match.found].sum()
    return float((near + _REACH * spacing * single) / len(match.found))


def _likely_jumps(before: Points, spots: Spots, spacing: float) -> Float32[np.ndarray, "jumps 2"]:
    """Return the common motions (px) that carry most dots onto spots."""
    step, half = spacing / _BINS, _BINS * _FARTHEST
    apart = np.rint((spots[None] - before[:, None]) / step).astype(int).reshape(-1, 2) + half
    n = 2 * half + 1
    near = apart[((apart >= 0) & (apart < n)).all(1)]
    votes = np.bincount(near[:, 1] * n + near[:, 0], minlength=n * n).reshape(n, n)
    votes = cv2.blur(votes.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
    peak = np.where(votes == cv2.dilate(votes, np.ones((3, 3), np.uint8)), votes, 0)
    y, x = np.unravel_index(np.argsort(-peak, axis=None)[:_JUMPS], peak.shape)
    return ((np.stack([x, y], 1) - half) * step).astype(np.float32)
