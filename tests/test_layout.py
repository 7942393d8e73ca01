"""The repository's layout: every folder is linked, is no package by itself, imports leftwards."""

import ast
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import pytest
from command_options import options_by_command

from touchgoal.launch.__main__ import COMMANDS

# Ceilings fall with every change that removes, and rise only by the budget that an issue names,
# in a change that says so.
WHEEL_LINES = 50_714  # of Python
REPOSITORY_LINES = 64_684  # of Python, with benchmarks, plugins and docs
TEST_LINES = 20_327  # of Python
PAGE_WORDS = 12_000  # README, CHANGELOG and docs/*.md
COMMANDS_IN_ALL = 35  # sub-commands included
OPTIONS_IN_ALL = 413  # of all commands, each with its own

ROOT = Path(__file__).parents[1]
_PAGE = (ROOT / "CONTRIBUTING.md").read_text()
ORDER = re.findall(r"\w+", next(line for line in _PAGE.splitlines() if " -> " in line))
SOURCES = sorted(p for f in ORDER for p in (ROOT / f).rglob("*.py"))
PACKAGE = ROOT / "src" / "touchgoal" / "__init__.py"
FORBIDDEN = {"rewards": {"policies"}, "policies": {"rewards"}}


def allowed(folder: str) -> set[str]:
    return set(ORDER[: ORDER.index(folder) + 1]) - FORBIDDEN.get(folder, set())


@cache
def syntax(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imported_modules(path: Path) -> set[str]:
    """Return the modules and names that a file imports, inside functions and for types, too."""
    names = set()
    for node in ast.walk(syntax(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("folder", ORDER)
def test_folder_is_linked_and_bare(folder: str) -> None:
    link = ROOT / "src" / "touchgoal" / folder
    assert link.is_symlink() and link.resolve() == ROOT / folder
    assert not (ROOT / folder / "__init__.py").exists(), "would shadow python-control and ROS"


def test_imports_point_left() -> None:
    wrong = []
    for path in SOURCES:
        folder, modules = path.relative_to(ROOT).parts[0], imported_modules(path)
        used = {name.split(".")[1] for name in modules if name.startswith("touchgoal.")}
        wrong += [f"{path}: {name}" for name in used & set(ORDER) - allowed(folder)]
        barred = {"benchmarks", "tests"} | (
            {"torch"} if folder in ("runtime", "control") else set()
        )
        wrong += [f"{path}: {name}" for name in modules if name.split(".")[0] in barred]
    assert not wrong


def test_files_stay_small() -> None:
    assert not [str(p) for p in SOURCES if len(p.read_text().splitlines()) > 400]


@pytest.mark.parametrize("path", [p for p in SOURCES if "fastmath" in p.read_text()], ids=str)
def test_fast_math_calls_inlined_functions_alone(path: Path) -> None:
    """Else the process that compiles them rounds otherwise than those that read them from the cache."""
    found = [node for node in ast.walk(syntax(path)) if isinstance(node, ast.FunctionDef)]
    fast = {f for f in found if "fastmath" in "".join(map(ast.unparse, f.decorator_list))}
    apart = {f.name for f in fast if "inline" not in "".join(map(ast.unparse, f.decorator_list))}
    called = {node.func.id for f in fast for node in ast.walk(f)
              if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}  # fmt: skip
    assert apart and not called & apart


def test_every_data_file_is_packaged() -> None:
    """Weights, sensor files and cell files are in the wheel."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packaged = {
        path.relative_to(ROOT)
        for package, patterns in pyproject["tool"]["setuptools"]["package-data"].items()
        for pattern in patterns
        for path in (ROOT / "/".join(package.split(".")[1:])).glob(pattern)
    }
    there = {p.relative_to(ROOT) for f in ORDER for p in (ROOT / f).rglob("*") if p.is_file()}
    kept = {p for p in there if p.suffix != ".py" and "__pycache__" not in p.parts}
    assert kept <= packaged


def test_the_robots_pc_needs_neither_torch_nor_mujoco() -> None:
    """With both blocked, the scripted plan and a user's policy run on a cell."""
    program = Path(__file__).parent / "without_torch_and_mujoco.py"
    subprocess.run([sys.executable, program], check=True, timeout=120)


def test_code_cites_published_sources() -> None:
    """Notes that only the authors have are no source for a limit or a constant."""
    assert not [str(p) for p in SOURCES if "shared/" in p.read_text()]


def test_no_folder_holds_more_than_twelve_files() -> None:
    folders = {path.parent for path in SOURCES}
    counts = {str(f.relative_to(ROOT)): len(list(f.glob("*.py"))) for f in folders}
    assert not {f: n for f, n in counts.items() if n > (99 if f == "launch" else 12)}


def test_no_modules_import_each_other_in_a_circle() -> None:
    files = {"touchgoal." + ".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in SOURCES}
    files["touchgoal"] = PACKAGE
    done: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        assert name not in above, " -> ".join((*above, name))
        if name in done:
            return
        for other in imported_modules(files[name]):
            if module := next((m for m in (other, other.rpartition(".")[0]) if m in files), ""):
                visit(module, (*above, name))
        done.add(name)

    for name in files:
        visit(name, ())


@pytest.mark.parametrize("folder", ORDER)
def test_a_name_means_one_thing_in_a_folder(folder: str) -> None:
    """No two files define public classes or functions of one name; every command has a Config."""
    found = defaultdict(set)
    for path in SOURCES:
        for node in syntax(path).body if path.is_relative_to(ROOT / folder) else ():
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                found[node.name].add(str(path))
    for name in ("Config", "main", "run"):
        found.pop(name, None)
    assert not {name: files for name, files in found.items() if len(files) > 1}


def test_lines_and_words_stay_under_their_ceilings() -> None:
    def count(paths: Iterable[Path], unit: Callable[[str], list[str]] = str.splitlines) -> int:
        return sum(len(unit(path.read_text())) for path in paths)

    beside = [path for f in ("benchmarks", "plugins", "docs") for path in (ROOT / f).rglob("*.py")]
    pages = [ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")]
    assert count([*SOURCES, PACKAGE]) <= WHEEL_LINES
    assert count([*SOURCES, PACKAGE, *beside]) <= REPOSITORY_LINES
    assert count((ROOT / "tests").rglob("*.py")) <= TEST_LINES
    assert count(pages, str.split) <= PAGE_WORDS


def test_commands_and_options_stay_under_their_ceilings() -> None:
    found = options_by_command()  # of sub-commands; the command that has them counts, too
    assert len({*found, *COMMANDS}) <= COMMANDS_IN_ALL
    assert sum(map(len, found.values())) <= OPTIONS_IN_ALL
