"""Tests of a figure from both sides: a `value` just inside it, and one just `beyond`."""

from collections.abc import Callable
from typing import Any

import pytest

from touchgoal.runtime.errors import UserError


def sides(*pairs: tuple[Any, Any]) -> pytest.MarkDecorator:
    cases = [case for pair in pairs for case in zip(pair, (False, True), strict=True)]
    return pytest.mark.parametrize(("value", "beyond"), cases)


def complaint(call: Callable, *arguments: Any) -> str:
    """What it says is wrong; "" if nothing is."""
    try:
        call(*arguments)
    except UserError as error:
        return str(error)
    return ""
