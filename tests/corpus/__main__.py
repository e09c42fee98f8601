"""Run the corpus with a revision and with this tree, and compare: `python -m tests.corpus [--rev REV]`.

Exit code 1: a difference is not intended, or an entry of `intended.yaml` is not used. The last commit of an issue
writes the one before it into `revision` (the line `old` stays) and empties `intended.yaml`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import yaml

from tests.corpus.comparison import Difference, Intended, differences, read_intended, unexplained
from tests.corpus.inputs import make_inputs
from tests.corpus.revisions import PLACE, revision, revision_side, working_side
from tests.corpus.running import Desk, run_desks

HERE = Path(__file__).parent
MOST = 300  # differences that are printed; the file has all


def read_desks(path: Path) -> tuple[dict[str, Desk], Mapping[str, str]]:
    """Return the desks of the list of commands, and what is not run with the reason."""
    content: Mapping[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    desks: dict[str, Desk] = {}
    for name, entry in content["desks"].items():
        desks[name] = Desk(name, tuple(entry["commands"]), entry.get("after", ""), float(entry.get("tolerance", 0)))
        if desks[name].after not in {"", *desks}:
            raise SystemExit(f"{path.name}: desk {name} is before {desks[name].after}, from which it starts")
    return desks, content["not_run"]


def chosen(desks: Mapping[str, Desk], pattern: str) -> dict[str, Desk]:
    """Return the desks whose names match a pattern, and those from which they start."""
    names = {name for name in desks if fnmatchcase(name, pattern)}
    for name in reversed(desks):
        if name in names and desks[name].after:
            names.add(desks[name].after)
    return {name: desk for name, desk in desks.items() if name in names}


def migrated(desks: Mapping[str, Desk], intended: Sequence[Intended]) -> dict[str, Desk]:
    """Return the desks of the new side: some commands have other words there."""
    found = {}
    for desk in desks.values():
        lines = []
        for line in desk.commands:
            name = f"{desk.name}: {line}"
            for entry in intended:
                line = entry.replaced(name, line)
            lines.append(line)
        found[desk.name] = replace(desk, commands=tuple(lines))
    return found


def main() -> int:
    """Run both sides, print differences, and return the exit code."""
    options = argparse.ArgumentParser(prog="python -m tests.corpus", description=__doc__)
    options.add_argument(
        "--rev", default="revision", help="a commit, or a line of tests/corpus/revision: revision (default) or old"
    )
    options.add_argument("--only", default="*", metavar="PATTERN", help="desks to run, such as 'scenarios' or 'fit*'")
    options.add_argument("--jobs", type=int, default=2, help="commands at a time (default: 2)")
    options.add_argument("--fresh", action="store_true", help="run the old side again, too")
    asked = options.parse_args()
    desks, not_run = read_desks(HERE / "commands.yaml")
    desks = chosen(desks, asked.only)
    if not desks:
        raise SystemExit(f"no desk matches {asked.only!r}")
    intended = read_intended(HERE / "intended.yaml")
    old, new = revision_side(revision(asked.rev) if asked.rev in {"revision", "old"} else asked.rev), working_side()
    inputs = make_inputs(PLACE)
    with ThreadPoolExecutor(asked.jobs) as jobs:
        running = [
            run_desks(old, desks, inputs, jobs, reuse=not asked.fresh),
            run_desks(new, migrated(desks, intended), inputs, jobs, reuse=False),
        ]
        olds, news = ({name: future.result() for name, future in side.items()} for side in running)
    told: list[Difference] = []
    for desk in desks.values():
        for line, before, after in zip(desk.commands, olds[desk.name], news[desk.name], strict=True):
            told += differences(f"{desk.name}: {line}", before, after, desk.tolerance, intended)
    found = unexplained(told, intended)
    unused = [] if asked.only != "*" else [entry.commands for entry in intended if not entry.uses]
    count = sum(len(desk.commands) for desk in desks.values())
    print(f"{count} commands of {old.name} and {new.name}; not run: {', '.join(not_run)}")
    lines = [f"{d.command}\n    {d.key}: {d.old} → {d.new}\n" for d in found]
    (PLACE / "differences.txt").write_text("".join(lines), encoding="utf-8")
    print("".join(lines[:MOST]), end="")
    for commands in unused:
        print(f"intended.yaml: the entry for {commands!r} is not used")
    print(f"{len(found)} differences that are not intended, in {len({d.command for d in found})} commands")
    return int(bool(found or unused))


if __name__ == "__main__":
    sys.exit(main())
