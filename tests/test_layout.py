"""The repository's layout: every folder is linked, is no package by itself, imports leftwards."""

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = "runtime control sim_envs episodes encoders rewards policies launch"
ORDER: list[str] = [*FOLDERS.split()]
SOURCES = sorted(p for f in ORDER for p in (ROOT / f).rglob("*.py"))
FORBIDDEN = {"rewards": {"policies"}, "policies": {"rewards"}}


def allowed(folder: str) -> set[str]:
    return set(ORDER[: ORDER.index(folder) + 1]) - FORBIDDEN.get(folder, set())


def imported_modules(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
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


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_imports_point_left(path: Path) -> None:
    folder = path.relative_to(ROOT).parts[0]
    modules = imported_modules(path)
    used = {name.split(".")[1] for name in modules if name.startswith("touchgoal.")} & set(ORDER)
    assert used <= allowed(folder), f"{path.name} imports from {used - allowed(folder)}"
    if folder in ("runtime", "control"):
        assert not any(name.split(".")[0] == "torch" for name in modules)


def test_files_stay_small() -> None:
    assert not [str(p) for p in SOURCES if len(p.read_text().splitlines()) > 400]


@pytest.mark.parametrize("path", [p for p in SOURCES if "fastmath" in p.read_text()], ids=str)
def test_fast_math_calls_inlined_functions_alone(path: Path) -> None:
    """Else the process that compiles them rounds otherwise than those that read them from the cache."""
    found = [
        node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)
    ]
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
    """Imports at module level; those inside functions do not count."""
    files = {"touchgoal." + ".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in SOURCES}
    imports = {name: imported_on_load(ast.parse(p.read_text()).body) for name, p in files.items()}
    done: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        assert name not in above, " -> ".join((*above, name))
        if name in done:
            return
        for other in imports[name]:
            for module in {other, other.rpartition(".")[0]} & imports.keys():
                visit(module, (*above, name))
        done.add(name)

    for name in files:
        visit(name, ())


def imported_on_load(body: list[ast.stmt]) -> set[str]:
    """Return the modules and names that statements import, but for types alone."""
    names = set()
    for node in body:
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.If | ast.Try) and "TYPE_CHECKING" not in ast.dump(node):
            names |= imported_on_load([*node.body, *node.orelse])
    return names
