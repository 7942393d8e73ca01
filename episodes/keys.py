"""Features of any LeRobot set under touchgoal's keys: a map that the user gives, or a guess."""

import re
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from touchgoal.control.features import FEATURES, IMAGE_PREFIX, TACTILE_LEFT, TACTILE_RIGHT
from touchgoal.episodes.schema import INDEX_DTYPES, is_image
from touchgoal.runtime.errors import UserError

Features = dict[str, dict[str, Any]]
_IMAGES = ("image", "video")
_SENSOR_NAMES = ("tactile", "gelsight", "digit", "touch")
_SIDES = {"left": TACTILE_LEFT, "right": TACTILE_RIGHT}


def parse_keys(pairs: Sequence[str]) -> dict[str, str]:
    """Return the new keys by stored names of an option `--keys STORED=KEY ...`.

    UserError: a pair of another form.
    """
    keys = {}
    for pair in pairs:
        stored, equals, key = pair.partition("=")
        if not (stored and equals and key):
            raise UserError(
                f"--keys {pair}: give STORED=KEY, such as observation.images.top={IMAGE_PREFIX}front"
            )
        keys[stored] = key
    return keys


def readable_features(features: Features) -> Features:
    """Return the features that touchgoal reads, in the order they are stored.

    These are numbers, in the dtype of `FEATURES` where it names the key, and RGB images, in the
    order (height, width, 3). Index columns, texts and depth images are left out.
    """
    readable: Features = {}
    for key, feature in features.items():
        shape = list(feature["shape"]) or [1]
        info = feature.get("info") or {}
        depth = info.get("is_depth_map") or info.get("video.is_depth_map")
        if feature["dtype"] in _IMAGES:
            if str((feature.get("names") or [""])[0]).startswith("channel"):
                shape = [*shape[1:], shape[0]]
            if len(shape) == 3 and shape[2] == 3 and not depth:
                readable[key] = {**feature, "shape": shape}
        elif key not in INDEX_DTYPES and not is_image(key) and _is_number(feature["dtype"]):
            dtype = FEATURES[key].dtype if key in FEATURES else feature["dtype"]
            readable[key] = {**feature, "shape": shape, "dtype": dtype}
    return readable


def _is_number(dtype: str) -> bool:
    try:
        return np.dtype(dtype).kind in "biuf"
    except TypeError:
        return False


def guess_keys(features: Features) -> dict[str, str]:
    """Return touchgoal's keys of tactile images under other names, and of images without the prefix.

    Of tactile images one of each side is taken, or a single one as the left.
    """
    images = [key for key, feature in features.items() if feature["dtype"] in _IMAGES]
    guessed = {
        key: IMAGE_PREFIX + re.sub(r"^observation\.(images?\.)?", "", key).replace(".", "_")
        for key in images
        if not is_image(key)
    }
    sides = guess_sides(images)
    return guessed | {stored: key for key, stored in sides.items() if key not in features}


def guess_sides(images: Sequence[str]) -> dict[str, str]:
    """Return the name of the images of each fingertip by its key; a single fingertip is the left."""
    touch = [name for name in images if any(sensor in name.lower() for sensor in _SENSOR_NAMES)]
    if len(touch) == 1 and not any(side in touch[0].lower() for side in _SIDES):
        return {TACTILE_LEFT: touch[0]}
    found = {key: [name for name in touch if side in name.lower()] for side, key in _SIDES.items()}
    return {key: names[0] for key, names in found.items() if len(names) == 1}


def stored_names(root: Path, features: Features, keys: Mapping[str, str]) -> dict[str, str]:
    """Return the stored name of each feature by its new key; `keys` maps stored names to new ones.

    UserError: the set has no such feature, or two get one key.
    """
    if unknown := [stored for stored in keys if stored not in features]:
        raise UserError(f"--keys: {root} has no {unknown[0]}; it has {', '.join(features)}")
    names: dict[str, str] = {}
    for stored in features:
        key = keys.get(stored, stored)
        if key in names:
            raise UserError(
                f"{root}: {names[key]} and {stored} are both {key}; give one of them another key: "
                f"--keys {names[key]}=OTHER"
            )
        if (features[stored]["dtype"] in _IMAGES) != is_image(key):
            raise UserError(
                f"--keys {stored}={key}: keys of images, and only these, begin with {IMAGE_PREFIX}"
            )
        names[key] = stored
    return names


@cache
def note_guess(root: Path, keys: tuple[tuple[str, str], ...]) -> None:
    """Say once on stderr which keys were guessed, as the option that changes them."""
    pairs = " ".join(f"{stored}={key}" for stored, key in keys)
    print(f"{root}: taken as --keys {pairs}", file=sys.stderr)
