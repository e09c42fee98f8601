"""Random faults in the code, each tried against the tests of its subject: `python -m tests.mutants`, `make mutants`.

The operators are those of cosmic-ray, and one more: a float by half as much again. A mutant is written into a copy of
the tree, so that the workers that a test starts or forks run it too. The tests of its subject follow, the quickest
first, until one fails. `tests/mutants.yaml` lists mutants that no test can notice, and says why.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "mutants"
ROOMS = ("blocks", "simulation", "isolation", "logs", "residuals", "comparison")
FILES = [f"cosim/{room}/*.py" for room in ROOMS]  # not their reports, which are tested as pages
LONGEST = 20.0  # [s] of tests for one mutant, by their times without a mutant; those that take longest are omitted
PATIENCE = 4.0  # times as long a mutant may take, and
STARTING = 120.0  # [s] more
SKIPPED = "not thorough and not hosts"

UNUSED = ("NoOp", "RemoveDecorator", "VariableReplacer", "VariableInserter", "NumberReplacer")
KINDS = (
    "Add Sub Mul Div", "FloorDiv Mod Mul", "Pow Mul", "BitAnd BitOr BitXor", "Eq NotEq Lt LtE Gt GtE", "Is IsNot",
    "In NotIn", "USub UAdd Nothing", "Not Nothing",
)  # fmt: skip

# the tests of a subject, by the first pattern that a file matches, those that are quick among them first
SUBJECTS: list[tuple[str, str]] = [
    ("cosim/blocks/fixes.py", "schedule fixes"),
    ("cosim/blocks/derivatives.py", "solving linearize"),
    ("cosim/blocks/model_exchange.py", "solving exchange native_exchange"),
    ("cosim/blocks/solvers.py", "solving exchange"),
    ("cosim/blocks/description.py", "solving first_steps types"),
    ("cosim/blocks/summary.py", "planning first_steps types"),
    ("cosim/blocks/guard.py", "planning hostile first_steps"),
    ("cosim/blocks/*", "statuses schedule blame solving stepping exchange types"),
    ("cosim/isolation/process.py", "worker blame fmu_isolation misbehaving"),
    ("cosim/isolation/worker.py", "worker blame fmu_isolation misbehaving"),
    ("cosim/isolation/*", "blame worker misbehaving"),
    ("cosim/logs/static_table.py", "log_edges static"),
    ("cosim/logs/log.py", "log_edges log undeclared_units static"),
    ("cosim/logs/*", "log_edges gate log spikes"),
    ("cosim/residuals/replay_settings.py", "windows undeclared_units replay"),
    ("cosim/residuals/against.py", "windows gate undeclared_units"),
    ("cosim/residuals/*", "windows residual replay hidden_state"),
    ("cosim/comparison/*", "compare_edges compare"),
    ("cosim/authoring/matching.py", "planning first_steps"),
    ("cosim/authoring/parts.py", "planning first_steps"),
    ("cosim/simulation/draft*.py", "planning first_steps"),
    ("cosim/authoring/graph.py", "planning graph"),
    ("cosim/authoring/export.py", "ssp"),
    ("cosim/simulation/packaged.py", "ssp"),
    ("cosim/scenario/controller_design.py", "design design_options"),
    ("cosim/simulation/manifest.py", "planning repeat run"),
    ("cosim/simulation/workflow.py", "planning run scenario"),
    ("cosim/master/remote.py", "schedule apart misbehaving"),
    ("cosim/master/own_process.py", "schedule fmu_isolation misbehaving"),
    ("cosim/simulation/*", "schedule blame planning scenario master stepping"),
]


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    file: str
    operator: str
    occurrence: int  # among the places of the operator in the file
    line: int

    @property
    def room(self) -> str:
        """The room of its file."""
        return self.file.split("/")[1]


@dataclass(frozen=True)
class Verdict:
    """The answer of the tests to a mutant."""

    mutant: Mutant
    outcome: str  # killed, timeout, survived, equivalent
    by: str  # the test that failed
    before: str
    after: str


# -- mutants ----------------------------------------------------------------------------------------


def operators() -> dict[str, Any]:
    """Return the operators by name: those of cosmic-ray that change a value or a condition."""
    from cosmic_ray.operators.number_replacer import NumberReplacer
    from cosmic_ray.plugins import get_operator, operator_names
    from parso.python.tree import Number

    class Integer(NumberReplacer):
        """Integers by one more and one less."""

        def mutation_positions(self, node: Any) -> Iterator[Any]:
            """Yield the places of integers."""
            if isinstance(node, Number) and _is_integer(node.value):
                yield from super().mutation_positions(node)

    class Float(Integer):
        """Floats by half as much again."""

        def mutation_positions(self, node: Any) -> Iterator[Any]:
            """Yield the places of floats other than zero."""
            if isinstance(node, Number) and not _is_integer(node.value) and float(node.value):
                yield node.start_pos, node.end_pos

        def mutate(self, node: Any, index: int) -> Any:
            """Return the number times 1.5."""
            return Number(repr(1.5 * float(node.value)), node.start_pos, prefix=node.prefix)

    names = [name for name in operator_names() if not name.endswith(UNUSED) and _is_alike(name)]
    return {name: get_operator(name)() for name in sorted(names)} | {"integer": Integer(), "float": Float()}


def _is_alike(name: str) -> bool:
    """Return whether an operator replaces another of its kind: `<<` for `+` fails at once and shows nothing."""
    parts = name.split("_")
    return len(parts) != 3 or any({*parts[1:]} <= {*kind.split()} for kind in KINDS)


def _is_integer(text: str) -> bool:
    try:
        int(text, 0)
    except ValueError:
        return text[-1] in "jJ"  # left alone
    return True


def mutants_of(file: str, tried: dict[str, Any]) -> list[list[Mutant]]:
    """Return the mutants of each place in a file: not of annotations and decorators."""
    from cosmic_ray.ast import ast_nodes, get_ast

    source = (ROOT / file).read_text(encoding="utf-8")
    omitted = list(_omitted(source))
    places: dict[tuple[tuple[int, int], str], list[Mutant]] = defaultdict(list)
    nodes = list(ast_nodes(get_ast(source)))
    for name, operator in tried.items():
        occurrence = 0
        for node in nodes:
            for start, _ in operator.mutation_positions(node):
                if not any(first <= start < last for first, last in omitted):
                    places[start, name.split("_")[0]].append(Mutant(file, name, occurrence, start[0]))
                occurrence += 1
    return [places[place] for place in sorted(places)]


def _omitted(source: str) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield where annotations and decorators begin and end."""
    for node in ast.walk(ast.parse(source)):
        parts = [
            getattr(node, "annotation", None),
            getattr(node, "returns", None),
            *getattr(node, "decorator_list", []),
        ]
        for part in parts:
            if part is not None:
                yield (part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)


def drawn(files: list[str], count: int, seed: int) -> list[Mutant]:
    """Return a sample, as many mutants of each room: a file by its size, a place in it, a mutant of that place."""
    tried, rooms = operators(), defaultdict(list)
    for file in files:
        rooms[file.split("/")[1]].append(file)
    sample = []
    for number, room in enumerate(sorted(rooms)):
        rng = random.Random(f"{seed} {room}")
        sizes = [(ROOT / file).stat().st_size for file in rooms[room]]
        share = count // len(rooms) + (number < count % len(rooms))
        for file, wanted in sorted(Counter(rng.choices(rooms[room], sizes, k=share)).items()):
            places = mutants_of(file, tried)
            sample += [rng.choice(place) for place in rng.sample(places, min(wanted, len(places)))]
    return sample


def mutated(mutant: Mutant, tried: dict[str, Any]) -> str:
    """Return the text of a mutant's file."""
    from cosmic_ray.mutating import mutate_code

    text = mutate_code((ROOT / mutant.file).read_text(encoding="utf-8"), tried[mutant.operator], mutant.occurrence)
    assert isinstance(text, str), mutant
    return text


# -- trials -----------------------------------------------------------------------------------------


class Tree:
    """A copy of the project that mutants are written into."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        for name in subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0"):
            if name and (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)

    def write(self, file: str, text: str) -> None:
        """Write a file, and let Python compile it anew: within a second its time and size may be the same."""
        path = self.folder / file
        path.write_text(text, encoding="utf-8")
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()

    def test(self, tests: list[str], timeout: float, *options: str) -> tuple[int | None, str]:
        """Run tests; return pytest's exit code, None for one that took too long, and what it printed."""
        command = [sys.executable, "-m", "pytest", "-p", "tests.mutants", "-p", "no:cacheprovider", *options, *tests]
        work = self.folder.parent / "tmp"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        environment = {**os.environ, "PYTHONPATH": str(self.folder), "TMPDIR": str(work)}
        process = subprocess.Popen(
            command, cwd=self.folder, env=environment, start_new_session=True, text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            output, _ = process.communicate(timeout=timeout)
            return process.returncode, output
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return None, process.communicate()[0]

    def chosen(self, files: list[str], names: list[str], timeout: float) -> tuple[int | None, str]:
        """Run some tests of these files, in this order, until one fails; nothing where there are none."""
        if not names:
            return 0, ""
        order = self.folder.parent / "order.json"
        order.write_text(json.dumps(names))
        os.environ["MUTANTS_ORDER"] = str(order)
        try:
            return self.test(files, timeout, "-x", "-q")
        finally:
            del os.environ["MUTANTS_ORDER"]


def subject(file: str) -> list[str]:
    """Return the test files of a subject."""
    names = next(tests for pattern, tests in SUBJECTS if fnmatch(file, pattern)).split()
    return [f"tests/test_{name}.py" for name in names]


def timed(tree: Tree, files: set[str]) -> dict[str, float]:
    """Return the time of each test in some files without a mutant, from an earlier run where the file is the same."""
    times: dict[str, float] = {}
    for file in sorted(files):
        digest = hashlib.sha256((ROOT / file).read_bytes()).hexdigest()
        store = WORK / f"{Path(file).stem}-{digest[:16]}.json"
        if not store.is_file():
            os.environ["MUTANTS_LOG"] = str(store)
            code, output = tree.test([file], 1800.0, "-m", SKIPPED, "-q")
            del os.environ["MUTANTS_LOG"]
            if code != 0:
                store.unlink(missing_ok=True)
                raise SystemExit(f"{file} fails without a mutant:\n{output[-3000:]}")
        times |= json.loads(store.read_text())
    return times


def tried(tree: Tree, mutant: Mutant, text: str, times: dict[str, float]) -> tuple[str, str]:
    """Return the outcome of a mutant, and the test that failed first."""
    tests: dict[str, list[str]] = defaultdict(list)  # of each file, those of few seconds first
    total = 0.0
    for name in sorted((name for name in times if name.split("::")[0] in subject(mutant.file)), key=times.__getitem__):
        if (total := total + times[name]) > LONGEST:
            break
        tests[name.split("::")[0]].append(name)
    files = sorted(tests, key=lambda file: sum(times[name] for name in tests[file]))
    original = (ROOT / mutant.file).read_text(encoding="utf-8")
    tree.write(mutant.file, text)
    try:
        for chosen in (files[:1], files[1:]):  # most are killed by the first, so that no other is imported
            names = sorted((name for file in chosen for name in tests[file]), key=times.__getitem__)
            code, output = tree.chosen(chosen, names, PATIENCE * sum(times[name] for name in names) + STARTING)
            if code != 0:
                failed = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
                return ("timeout" if code is None else "killed"), (failed[0] if failed else output[-200:])
    finally:
        tree.write(mutant.file, original)
    return "survived", ""


# -- within pytest ----------------------------------------------------------------------------------


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the tests that a mutant is tried against, in their order."""
    if order := os.environ.get("MUTANTS_ORDER"):
        place = {name: number for number, name in enumerate(json.loads(Path(order).read_text()))}
        items[:] = sorted((item for item in items if item.nodeid in place), key=lambda item: place[item.nodeid])


_TIMES: dict[str, float] = {}


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note how long a test takes."""
    if report.when == "call" and report.passed:
        _TIMES[report.nodeid] = report.duration


def pytest_sessionfinish() -> None:
    """Write how long the tests took."""
    if log := os.environ.get("MUTANTS_LOG"):
        Path(log).write_text(json.dumps(_TIMES))


# -- the command ------------------------------------------------------------------------------------


def equivalents() -> set[tuple[str, str, str]]:
    """Return the mutants that no test can notice: file, line, line of the mutant."""
    listed = yaml.safe_load((ROOT / "tests/mutants.yaml").read_text(encoding="utf-8"))
    return {(file, pair["line"], pair["mutant"]) for file, pairs in listed.items() for pair in pairs}


def changed(mutant: Mutant, text: str) -> tuple[str, str]:
    """Return the lines that a mutant changes, before and after."""
    original = (ROOT / mutant.file).read_text(encoding="utf-8")
    lines = list(difflib.ndiff(original.splitlines(), text.splitlines()))
    before, after = (" ".join(line[2:].strip() for line in lines if line[:2] == sign) for sign in ("- ", "+ "))
    return before, after


def main() -> None:
    """Try a sample of mutants; list the survivors, then the score of each room."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="*", help="files or patterns, such as cosim/logs/*.py")
    parser.add_argument("-n", type=int, default=60, help="mutants in all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="print the sample, try nothing")
    options = parser.parse_args()
    paths = [path for pattern in options.files or FILES for path in sorted(ROOT.glob(pattern))]
    files = [path.relative_to(ROOT).as_posix() for path in paths if path.name != "__init__.py"]
    WORK.mkdir(parents=True, exist_ok=True)
    sample, tools, same = drawn(files, options.n, options.seed), operators(), equivalents()
    tree = None if options.list else Tree(WORK / str(os.getpid()) / "tree")
    times = {} if tree is None else timed(tree, {test for mutant in sample for test in subject(mutant.file)})
    verdicts = []
    for mutant in sample:
        text, begun = mutated(mutant, tools), time.perf_counter()
        before, after = changed(mutant, text)
        if (mutant.file, before, after) in same:
            outcome, by = "equivalent", ""
        elif tree is None:
            outcome, by = "listed", ""
        else:
            outcome, by = tried(tree, mutant, text, times)
        verdicts.append(Verdict(mutant, outcome, by, before, after))
        print(f"{outcome:10} {mutant.file}:{mutant.line}  [{time.perf_counter() - begun:.0f} s] {by[:110]}", flush=True)
        if outcome != "killed":
            print(f"    - {before}\n    + {after}", flush=True)
    print(json.dumps(summary(verdicts)))
    if tree is not None:
        shutil.rmtree(tree.folder.parent)


def summary(verdicts: list[Verdict]) -> dict[str, Any]:
    """Return the score of each room and of all: killed of those that are not equivalent."""
    rooms: dict[str, Any] = {}
    for room in [*dict.fromkeys(verdict.mutant.room for verdict in verdicts), "all"]:
        count = Counter(verdict.outcome for verdict in verdicts if room in (verdict.mutant.room, "all"))
        tried = count.total() - count["equivalent"]
        rooms[room] = {**count, "score": round((count["killed"] + count["timeout"]) / tried, 3) if tried else None}
    return rooms


if __name__ == "__main__":
    main()
