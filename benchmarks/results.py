"""The record behind every figure of README and docs, and the tables made from it.

    python -m touchgoal.benchmarks.results run bead-maze env-speed   # measure, and keep the record
    python -m touchgoal.benchmarks.results                           # bring README and docs up to date

A record is `benchmarks/results/NAME.json`: the command (of `quoted.py`), when and where it ran, what
it printed and its metrics. In a page, what stands between `<!-- result: NAME -->`, or `<!-- results -->`
for the short table of all, and `<!-- end -->` is written here; tests/test_results.py compares the
two. For a clone: an installed package has no pages.
"""

import json
import re
import shlex
import subprocess
import sys
from datetime import date
from pathlib import Path
from typing import Any

from touchgoal.benchmarks.quoted import QUOTED
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import hardware

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "benchmarks" / "results"
_PROGRESS = re.compile(r"^hardware: |: \d+ x \d+ wires$")
_BLOCK = re.compile(r"(<!-- results?(?:: ([\w-]+))? -->\n).*?(<!-- end -->)", re.DOTALL)


def pages() -> list[Path]:
    """README and every page of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def load(name: str) -> dict[str, Any]:
    """The record of that name.

    Raises:
        UserError: there is none.
    """
    path = FOLDER / f"{name}.json"
    if name not in QUOTED or not path.exists():
        raise UserError(f"no result {name!r}; there are: {', '.join(QUOTED)}")
    return json.loads(path.read_text())


def rendered(text: str) -> str:
    """A page with its blocks made anew from the records."""

    def fill(found: re.Match[str]) -> str:
        name = found[2]
        return f"{found[1]}{_block(load(name)) if name else _short_table()}{found[3]}"

    return _BLOCK.sub(fill, text)


def _block(record: dict[str, Any]) -> str:
    printed = "\n".join(record["printed"])
    where = f"`{record['command']}`, measured {record['measured']}, {record['hardware']}:"
    return f"{where}\n\n```text\n{printed}\n```\n"


def _short_table() -> str:
    rows = ["| what was measured | figure | command |", "|---|---|---|"]
    for name, quoted in QUOTED.items():
        if quoted.claim:
            rows.append(f"| {quoted.claim} | {load(name)['headline']} | `{quoted.command}` |")
    return "\n".join(rows) + "\n"


def measure(name: str) -> None:
    """Run the command of a result and write its record.

    Raises:
        UserError: there is no such result.
        CalledProcessError: the command failed.
    """
    if name not in QUOTED:
        raise UserError(f"no result {name!r}; there are: {', '.join(QUOTED)}")
    quoted, out = QUOTED[name], ROOT / "runs" / "results" / name
    program = [sys.executable, "-m", "touchgoal.launch", *shlex.split(quoted.command)[1:]]
    done = subprocess.run(
        [*program, "--out", str(out)], check=True, text=True, stdout=subprocess.PIPE
    )
    metrics = json.loads((out / "metrics.json").read_text())
    lines = [line.rstrip() for line in done.stdout.splitlines()]
    kept = [line for line in lines if not (str(out) in line or _PROGRESS.search(line))]
    record = {
        "command": quoted.command,
        "measured": f"{date.today()}, commit {_commit()}",
        "hardware": metrics.pop("hardware", hardware()),
        "headline": quoted.headline(metrics),
        "printed": kept,
        "metrics": metrics,
    }
    write(name, record)


def write(name: str, record: dict[str, Any]) -> None:
    """Keep a record; figures in lists stand on one line."""
    FOLDER.mkdir(exist_ok=True)
    metrics = json.dumps(record["metrics"])
    text = json.dumps({**record, "metrics": None}, indent=1)
    text = text.replace('"metrics": null', f'"metrics": {metrics}')
    (FOLDER / f"{name}.json").write_text(text + "\n")


def _commit() -> str:
    asked = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    return subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip()


def main(arguments: list[str]) -> None:
    """`run NAME ...` measures; then, or with nothing, every page is brought up to date."""
    if arguments[:1] == ["run"]:
        for name in arguments[1:]:
            measure(name)
    elif arguments:
        raise UserError("usage: python -m touchgoal.benchmarks.results [run NAME ...]")
    for page in pages():
        page.write_text(rendered(page.read_text()))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        sys.exit(str(error))
