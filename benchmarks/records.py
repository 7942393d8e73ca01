"""Records of measured figures: the command, what it printed, and its metrics.

    python -m benchmarks.records measure NAME ...   # run the command of a record, write it
    python -m benchmarks.records                    # rewrite the tables of README and docs

A record is `benchmarks/results/NAME.json`.
"""

import json
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from benchmarks import figures
from touchgoal.runtime.errors import UserError
from touchgoal.runtime.provenance import hardware

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "benchmarks" / "results"


@dataclass(frozen=True)
class Quoted:
    """One entry of records.toml."""

    topic: str  # heading in docs/results.md
    claim: str  # what is measured
    command: str
    figure: str  # function of `figures` that gives the headline
    of: dict[str, str] = field(default_factory=dict)  # its further arguments
    in_readme: bool = False


QUOTED = {
    name: Quoted(**entry)
    for name, entry in tomllib.loads((FOLDER / "records.toml").read_text()).items()
}
_BLOCK = re.compile(r"(<!-- (headlines|results) -->\n).*?(<!-- end -->)", re.DOTALL)


def load_record(name: str) -> dict[str, Any]:
    """Return a record: `command`, `measured` (date and commit), `hardware`, `printed`, `metrics`."""
    return json.loads((FOLDER / f"{name}.json").read_text())


def records_of(benchmark: str) -> list[str]:
    """Return the names of a benchmark's records, or a record's own name; UserError if none."""
    start = f"python -m benchmarks {benchmark} "
    names = [name for name, quoted in QUOTED.items() if f"{quoted.command} ".startswith(start)]
    if benchmark in QUOTED and benchmark not in names:
        names.insert(0, benchmark)
    if not names:
        raise UserError(f"nothing is on record for {benchmark!r}; choose from: {', '.join(QUOTED)}")
    return names


def describe(name: str) -> str:
    """Return a record as printed text: command, date, hardware, table."""
    record = load_record(name)
    head = f"{name}: {record['command']}\n{record['measured']}, {record['hardware']}"
    return "\n".join([head, *record["printed"]])


def headline(name: str) -> str:
    """Return the figure of a record in one line."""
    quoted = QUOTED[name]
    return getattr(figures, quoted.figure)(load_record(name)["metrics"], **quoted.of)


def render(page: str) -> str:
    """Return a page with its tables rewritten from the records."""
    tables = {"headlines": _headlines, "results": _results}
    return _BLOCK.sub(lambda found: f"{found[1]}{tables[found[2]]()}{found[3]}", page)


def pages() -> list[Path]:
    """Return README and every page of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def measure(name: str) -> None:
    """Run the command of a record and write the record; UserError if there is no such record."""
    if name not in QUOTED:
        raise UserError(f"there is no record {name!r}; choose from: {', '.join(QUOTED)}")
    command, out = QUOTED[name].command, ROOT / "runs" / "results" / name
    words = shlex.split(command.removeprefix("python -m "))
    module = {"touchgoal": "touchgoal.launch"}.get(words[0], words[0])
    program = [sys.executable, "-m", module, *words[1:]]
    printed = subprocess.check_output([*program, "--out", str(out)], text=True)
    lines = [line.rstrip() for line in printed.splitlines()]
    table = [x for x in lines if not (str(out) in x or x.startswith("hardware: "))]
    write_record(name, command, table, json.loads((out / "metrics.json").read_text()))


def write_record(name: str, command: str, printed: list[str], metrics: dict[str, Any]) -> None:
    """Write a record; its metrics stand on one line."""
    metrics.pop("command", None)  # it contains folders of this machine
    asked = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    commit = subprocess.check_output(asked, text=True).strip()
    record = {
        "command": command,
        "measured": f"{date.today()}, commit {commit}",
        "hardware": metrics.pop("hardware", hardware()),
        "printed": printed,
        "metrics": None,
    }
    numbers = f'"metrics": {json.dumps(metrics)}'
    text = json.dumps(record, indent=1).replace('"metrics": null', numbers)
    (FOLDER / f"{name}.json").write_text(text + "\n")


def _headlines() -> str:
    return _table([name for name, quoted in QUOTED.items() if quoted.in_readme])


def _results() -> str:
    topics = dict.fromkeys(quoted.topic for quoted in QUOTED.values())
    of = {topic: [n for n, quoted in QUOTED.items() if quoted.topic == topic] for topic in topics}
    return "\n".join(f"**{topic}**\n\n{_table(names)}" for topic, names in of.items())


def _table(names: list[str]) -> str:
    rows = [f"| {QUOTED[name].claim} | {headline(name)} | `{name}` |" for name in names]
    return "\n".join(["| measured | figure | record |", "|---|---|---|", *rows]) + "\n"


def main(arguments: list[str]) -> None:
    """Measure the named records, then rewrite every page."""
    if arguments and arguments[0] != "measure":
        raise UserError("usage: python -m benchmarks.records [measure NAME ...]")
    for name in arguments[1:]:
        measure(name)
    for page in pages():
        page.write_text(render(page.read_text()))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        sys.exit(str(error))
