"""Options with ranges: frozen dataclasses that are checked when they are made."""

from typing import Annotated, Any, TypeVar, dataclass_transform

import pydantic.dataclasses
from pydantic import AfterValidator, ConfigDict, Field, ValidationError

from touchgoal.runtime.errors import UserError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
"""Between 0 and 1, both included."""


LARGEST = 2**53  # beyond it numpy, torch and tqdm fail, each in its own way
Count = Annotated[int, Field(ge=1, le=LARGEST)]
CountOrNone = Annotated[int, Field(ge=0, le=LARGEST)]  # count that may be 0
Seed = Annotated[int, Field(ge=0, le=LARGEST)]
Port = Annotated[int, Field(ge=0, le=65535)]
Repository = Annotated[str, Field(pattern=r"^\w[\w.-]*/\w[\w.-]*$")]
"""Repository on the Hugging Face Hub, as owner/name."""

Point = tuple[float, float]  # x and y in an image, px; the centre of its first pixel is (0, 0)
Corners = tuple[Point, Point, Point, Point]
"""Corners of a gel in its camera's image: top left, top right, bottom left, bottom right, the order of a
GelSight Wedge's config.csv."""

STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
"""Config of pydantic dataclasses read from a file: no conversion, no unknown key."""

RARE = "rarely needed"  # marks the annotation of an option that only `--help-all` shows
FIXED = "not offered"  # marks that of a field that no command offers: a preset or Python sets it

Number = TypeVar("Number", bound=float)


def _ordered(bounds: tuple[Number, Number]) -> tuple[Number, Number]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"must go from less to more, not {bounds[0]:g} to {bounds[1]:g}")
    return bounds


ORDERED = AfterValidator(_ordered)  # of lower and upper bound; equal bounds fix the value


class OptionError(UserError):
    """Values out of range: each wrong field ("" for several together), and what is wrong."""

    def __init__(self, config: str, problems: list[tuple[str, str]]) -> None:
        lines = dict.fromkeys(f"{name} {what}".strip() for name, what in problems)
        super().__init__(f"{config}: " + "; ".join(lines))
        self.problems = problems


Class = TypeVar("Class", bound=type)


@dataclass_transform(frozen_default=True)
def checked_dataclass(cls: Class) -> Class:
    """Turn a class into a frozen dataclass whose fields pydantic checks against their annotations.

    Making an instance raises OptionError if a value does not fit or `__post_init__` raises ValueError.
    """
    made: Any = pydantic.dataclasses.dataclass(
        frozen=True, config={"extra": "forbid", "use_attribute_docstrings": True}
    )(cls)
    initialise = made.__init__

    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            initialise(self, *args, **kwargs)
        except ValidationError as error:
            problems = dict(reversed([_problem(e) for e in error.errors()]))  # one per field
            raise OptionError(cls.__name__, list(problems.items())) from None

    made.__init__ = checked
    return made


def _problem(error: Any) -> tuple[str, str]:
    field = str(error["loc"][0]) if error["loc"] else ""
    if error["type"] == "value_error":  # raised by one of our checks
        return field, error["msg"].removeprefix("Value error, ")
    return field, f"{error['msg'].replace('Input should be', 'must be')}, not {error['input']}"


def first_problem(error: ValidationError) -> str:
    """Return the key of a record's first problem, and what is wrong."""
    first = error.errors()[0]
    return ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))
