"""Parsing of a command line into a command's `Config` with tyro; a bad value is one line."""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types
import tyro
from pydantic.fields import FieldInfo
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from touchgoal.runtime.errors import UserError
from touchgoal.runtime.option_types import FIXED, LARGEST, RARE, OptionError
from touchgoal.sim_envs.config import EnvConfig

# Words that no option has, and those from which tyro guesses the option that is meant.
_MEANT = {"--help-all": "--help", "--steps": "--epochs", "--learning-rate": "--lr"}
SHOWN = 20  # options that --help shows; --help-all shows all of them


def parse(
    config_type: Any,
    arguments: Sequence[str],
    prog: str,
    description: str,
    envs: Mapping[str, EnvConfig] | None = None,
) -> Any:
    """Parse the arguments after a command's name into its Config, or that of a subcommand.

    If a Config has an option `--preset`, its `PRESETS` hold the defaults for each value. A
    command with `--task` has each task's default environment options; `--env.*` are those of the
    typed task. UserError: a value is out of range. SystemExit: help was asked for (0), or an
    argument was not understood (2).
    """
    _refuse_empty_values(arguments)
    description = re.sub(r"(?<=\S)\n(?=\S)", " ", description)  # tyro does so before letters alone
    short = not {"--help", "-h"}.isdisjoint(arguments)  # tyro does not accept what it hides
    typed = [_MEANT.get(a, a) for a in arguments]
    env = None
    if envs:  # of the typed task, else the first; tyro refuses an unknown one
        tasks = [value for value in _values(typed, "--task") if value in envs]
        env = envs[tasks[-1] if tasks else next(iter(envs))]
    hidden_of = {name: _hidden(kind, env) for name, kind in members(config_type)}
    hidden = set().union(*hidden_of.values()) if short else set()
    registry = ConstructorRegistry()
    preset = next(reversed(list(_values(typed, "--preset"))), "")
    registry.struct_rule(partial(_as_options, env=env, hidden=hidden, preset=preset))
    try:
        return tyro.cli(
            config_type, prog=prog, args=typed, description=description, registry=registry
        )
    except _OutOfRange as wrong:
        raise UserError(_one_line(wrong.error, typed)) from None
    except SystemExit as stop:
        name = next((a for a in typed if a in hidden_of), "")
        if stop.code == 0 and hidden & hidden_of.get(name, set()):
            command = f"{prog} {name}".strip()
            more = len(hidden_of[name])
            what = f"{more} more option{'s' * (more > 1)}, rarely needed"
            print(f"{what}: {command} --help-all")
        if stop.code == 2 and env is not None and envs is not None:
            _point_to_other_task(typed, env, envs)
        raise


class _OutOfRange(Exception):
    """Carries an OptionError past tyro, which formats a ValueError in its own way."""

    def __init__(self, error: UserError) -> None:
        self.error = error


def _as_options(
    info: StructTypeInfo, env: EnvConfig | None, hidden: set[tuple[type, str]], preset: str = ""
) -> StructConstructorSpec | None:
    """Return tyro's description of a dataclass, with our help texts and without hidden options."""
    if not dataclasses.is_dataclass(info.type) or info.type.__module__.startswith("tyro"):
        return None
    fields = []
    defaults = getattr(info.type, "PRESETS", {}).get(preset, {})
    for field, annotation, text in _options(info.type):
        offered: Any = annotation
        default = defaults.get(field.name, _default(field, info.default))
        if field.name == "env" and get_origin(annotation) in (Union, UnionType):
            default = env or default
            offered = type(default)  # options of the other task are refused
        if (info.type, field.name) in hidden:
            offered = Annotated[offered, tyro.conf.Suppress]
        kinds = [get_origin(kind) for kind in (_bare(annotation), *get_args(_bare(annotation)))]
        if tyro.conf.Positional in getattr(annotation, "__metadata__", ()) and Literal not in kinds:
            offered = Annotated[offered, tyro.conf.arg(metavar=field.name.upper())]
        hint = None
        if default is None or default in ((), ""):  # the help text says what it then is
            is_run = field.name == "out" and "default" not in text
            hint = "(default: runs/<date>_<command>)" if is_run else ""
        elif default is tyro.MISSING:
            hint = "(required)"
        if hint is not None:
            offered = Annotated[offered, tyro.conf.arg(help_behavior_hint=hint)]
        fields.append(StructFieldSpec(field.name, offered, default, text))
    offered_names = {field.name for field in fields}
    kept = {  # of a preset
        f.name: _default(f, info.default)
        for f in dataclasses.fields(info.type)
        if f.name not in offered_names
    }
    return StructConstructorSpec(partial(_make, info.type, **kept), tuple(fields))


def _make(config_type: type, **values: Any) -> Any:
    try:
        return config_type(**values)
    except UserError as error:
        raise _OutOfRange(error) from None


def _default(field: dataclasses.Field, parent: Any) -> Any:
    if dataclasses.is_dataclass(parent):
        return getattr(parent, field.name)
    if field.default is not dataclasses.MISSING:
        return field.default
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING


def _options(config_type: type) -> list[tuple[dataclasses.Field, Any, str]]:
    """Return the fields of a dataclass that are options, annotated, with help texts and ranges."""
    hints, texts = get_type_hints(config_type, include_extras=True), docstrings(config_type)
    return [
        (f, hints[f.name], _with_range(texts.get(f.name, ""), hints[f.name]))
        for f in dataclasses.fields(config_type)
        if FIXED not in getattr(hints[f.name], "__metadata__", ())
    ]


def docstrings(config_type: type) -> dict[str, str]:
    """Return the string below each field of a dataclass and of its bases."""
    return {
        name: " ".join(field.description.split())
        for cls in reversed(config_type.__mro__)
        for name, field in getattr(cls, "__pydantic_fields__", {}).items()
        if field.description
    }


def _with_range(text: str, annotation: Any) -> str:
    bounds = list(_bounds(annotation))
    return f"{text.removesuffix('.')} ({', '.join(dict.fromkeys(bounds))})." if bounds else text


def _bounds(annotation: Any) -> Iterator[str]:
    """Yield the bounds of an annotation in words."""
    for extra in getattr(annotation, "__metadata__", ()):
        for rule in extra.metadata if isinstance(extra, FieldInfo) else (extra,):
            match rule:
                case annotated_types.Gt(gt=bound):
                    yield f"above {bound}"
                case annotated_types.Ge(ge=bound):
                    yield f"at least {bound}"
                case annotated_types.Lt(lt=bound):
                    yield f"below {bound}"
                case annotated_types.Le(le=bound) if bound != LARGEST:
                    yield f"at most {bound}"
    for part in get_args(annotation):
        yield from _bounds(part)


def _hidden(config_type: type, env: EnvConfig | None) -> set[tuple[type, str]]:
    """Return the options that --help hides: those marked RARE, and those after the first SHOWN."""
    options = list(all_options(config_type, env))
    common = [key for key, _, is_rare in options if not is_rare]
    return {key for key, _, is_rare in options if is_rare} | set(common[SHOWN:])


def all_options(
    config_type: type, env: EnvConfig | None, prefix: str = "--", rare: bool = False
) -> Iterator[tuple[tuple[type, str], str, bool]]:
    """Yield every option as class and field, as typed, and whether it is RARE; groups come last.

    A positional argument is typed without dashes.
    """
    groups = []
    for field, annotation, _ in _options(config_type):
        marks = getattr(annotation, "__metadata__", ())
        typed = prefix + field.name.replace("_", "-")
        is_rare = rare or RARE in marks
        of_task = field.name == "env" and env is not None
        inner = type(env) if of_task else _bare(annotation)
        if dataclasses.is_dataclass(inner):
            groups.append((inner, f"{typed}.", is_rare))
        else:
            if tyro.conf.Positional in marks:
                typed = field.name
            yield (config_type, field.name), typed, is_rare
    for inner, start, is_rare in groups:
        assert isinstance(inner, type)
        yield from all_options(inner, env, start, is_rare)


def members(config_type: Any) -> Iterator[tuple[str, type]]:
    """Yield names and dataclasses of subcommands; a single dataclass has the name ""."""
    if get_origin(config_type) in (Union, UnionType):
        for member in get_args(config_type):
            yield member.__metadata__[0].name, _bare(member)
    else:
        yield "", config_type


def _bare(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _values(arguments: Sequence[str], option: str) -> Iterator[str]:
    for i, argument in enumerate(arguments):
        if argument == option and i + 1 < len(arguments):
            yield arguments[i + 1]
        elif argument.startswith(f"{option}="):
            yield argument.removeprefix(f"{option}=")


def _refuse_empty_values(arguments: Sequence[str]) -> None:
    """Raise UserError for `--out ""`, which would mean the working directory."""
    for option, value in pairwise(["", *arguments]):
        if (option.startswith("--") and not value) or re.fullmatch(r"--[\w.-]+=", value):
            name = value.removesuffix("=") or option
            raise UserError(f"{name} is empty: give a value or leave the option out")


def _one_line(error: UserError, arguments: Sequence[str]) -> str:
    """Return the message with the options as typed in place of the fields."""
    if not isinstance(error, OptionError):
        return str(error)
    return "; ".join(f"{_typed(field, arguments)} {what}".strip() for field, what in error.problems)


def _typed(field: str, arguments: Sequence[str]) -> str:
    if not field:
        return ""
    name = field.replace("_", "-")
    pattern = re.compile(rf"--(?:no-)?(?:[\w.-]+\.)?{re.escape(name)}(?:=.*)?")
    typed = [a.split("=")[0] for a in arguments if pattern.fullmatch(a.replace("_", "-"))]
    return typed[0] if typed else f"--{name}"


def _point_to_other_task(
    arguments: Sequence[str], env: EnvConfig, envs: Mapping[str, EnvConfig]
) -> None:
    """Raise UserError for an option of another task."""
    for argument in arguments:
        field = argument.removeprefix("--env.").split("=")[0].replace("-", "_")
        owners = [task for task, other in envs.items() if hasattr(other, field)]
        if argument.startswith("--env.") and owners and not hasattr(env, field):
            raise UserError(f"{argument} is an option of the task {owners[0]}: --task {owners[0]}")
