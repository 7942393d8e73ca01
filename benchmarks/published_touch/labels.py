"""Checks of the labels in published pickles: arrays of the expected shape and range, or a UserError."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from touchgoal.runtime.errors import UserError


def entry(value: Any, key: str, name: str) -> Any:
    """Return the value of a key; UserError if `value` is no dictionary or lacks the key."""
    if not isinstance(value, dict) or key not in value:
        raise UserError(f"{name} has no '{key}': get it again, as published")
    return value[key]


def numbers(
    value: Any, shape: tuple[int | None, ...], most: float, name: str
) -> Float64[np.ndarray, "..."]:
    """Return an array of finite numbers.

    Args:
        value: Array, or list of numbers or of arrays.
        shape: Expected shape, None for any length.
        most: Largest magnitude.
    """
    array = np.asarray(_array(value, name), np.float64)
    fits = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise UserError(f"{name} are of shape {array.shape}, not {shape}".replace("None", "n"))
    if not (np.abs(array) <= most).all():  # False for NaN
        raise UserError(f"{name} are not all between -{most:g} and {most:g}")
    return array


def whole_numbers(value: Any, most: int, name: str) -> Int64[np.ndarray, " n"]:
    """Return a row of whole numbers from 0 to `most`."""
    array = numbers(value, (None,), 2.0**53, name)
    if (array != np.floor(array)).any() or (array < 0).any() or (array > most).any():
        raise UserError(f"{name} are not all whole numbers from 0 to {most}")
    return array.astype(np.int64)


def booleans(value: Any, name: str) -> Bool[np.ndarray, " n"]:
    """Return a row of booleans, also from zeros and ones."""
    return whole_numbers(value, 1, name).astype(bool)


def _array(value: Any, name: str) -> np.ndarray:
    if isinstance(value, np.ndarray):
        array = value
    elif isinstance(value, list) and all(_is_number_or_row(item) for item in value):
        try:
            array = np.array(value) if value else np.empty(0)
        except (ValueError, OverflowError):  # rows of different lengths, numbers of any length
            array = np.empty(0, "S1")
    else:
        array = np.empty(0, "S1")
    if array.dtype.kind not in "biuf":
        raise UserError(f"{name} are no plain numbers: get the file again, as published")
    return array.view(np.uint8) if array.dtype.kind == "b" else array


def _is_number_or_row(item: Any) -> bool:
    """Return whether an item is a number or a flat row of numbers."""
    if isinstance(item, np.ndarray):
        return item.dtype.kind in "biuf"
    row: Iterable[Any] = item if isinstance(item, list | tuple) else [item]
    return all(isinstance(part, bool | int | float | np.number | np.bool_) for part in row)
