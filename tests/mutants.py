"""Random faults in the code, each tried against the tests that call it: `python -m tests.mutants`, `make mutants`.

A mutant of the list, tests/mutants_frozen.jsonl, is known by its function and the text of its line. What has no code
any more is replaced by a mutant of the same operator and room, drawn from the `redraw_seed` that stands in the list;
`--redraw` writes it down. A line without an outcome gets that of the next run; later runs compare theirs with it. A run
goes on where it ended.

The operators are those of cosmic-ray, and one more: a float by half as much again. A mutant is written into a copy of
the tree, so that the workers that a test starts or forks run it too. A process runs tests until one fails: those of the
whole suite that call the function of the mutant, in whatever process, the quickest first. A run of each test file
without a mutant shows which they are, once for the same code. `tests/mutants.yaml` lists mutants that no test can
notice, and says why.
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
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "mutants"
FROZEN = ROOT / "tests" / "mutants_frozen.jsonl"
ROOMS = {  # rooms of the frozen list → files, the first that matches
    "units": ("cosim/core/units.py",),
    "sources": ("cosim/blocks/sources.py", "cosim/blocks/profile.py"),
    "blocks": ("cosim/blocks/*.py",),
    "master": ("cosim/master/*.py",),
    "system": ("cosim/system/*.py",),
}
REDRAWN = 1000  # from a redraw_seed to the next
LONGEST = 30.0  # [s] of tests for one mutant, by their times without it, the quickest of those that call its function
PATIENCE = 4.0  # times as long a mutant may take, and
STARTING = 120.0  # [s] more
KILLED = -signal.SIGKILL  # exit code of `timeout`
SKIPPED = "not thorough and not hosts"

# a plugin of pytest for a copy of the tree in which each function of `cosim` tells that it is called, in any process
NOTE = """
import contextlib, os
seen = set()
def tell(line):
    with contextlib.suppress(Exception), open(folder + "/test") as test, open(folder + "/notes", "a") as notes:
        notes.write(f"{test.read()}\\t{line}\\n")
def pytest_runtest_logstart(nodeid):
    seen.clear()
    with open(folder + "/test", "w") as file:
        file.write(nodeid)
def pytest_runtest_logreport(report):
    if report.when == "call" and report.passed:
        tell(report.duration)
def note(name):
    if (os.getpid(), name) not in seen:
        seen.add((os.getpid(), name))
        tell(name)
"""
Traces = dict[str, tuple[float, set[str]]]  # test → seconds without a mutant, functions of `cosim` that it calls


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    file: str
    operator: str
    occurrence: int  # among the places of the operator in the file
    line: int


@dataclass(frozen=True)
class Frozen:
    """A mutant of the frozen list: number `nth` among equal changes of equal lines in a function."""

    room: str
    file: str
    function: str
    operator: str
    line: str
    mutant: str
    nth: int
    seed: int
    redraw_seed: int
    outcome: str = ""  # killed, timeout, survived
    by: str = ""  # the test file that failed

    @property
    def key(self) -> tuple[str | int, ...]:
        """What tells it from others."""
        return self.room, self.function, self.operator, self.line, self.mutant, self.nth


def files_of(room: str) -> list[str]:
    """Return the files of a room."""
    paths = [path for pattern in ROOMS[room] for path in sorted(ROOT.glob(pattern)) if path.name != "__init__.py"]
    files = [path.relative_to(ROOT).as_posix() for path in paths]
    earlier = [pattern for name in list(ROOMS)[: list(ROOMS).index(room)] for pattern in ROOMS[name]]
    return [file for file in files if not any(fnmatch(file, pattern) for pattern in earlier)]


def text_of(file: str) -> str:
    return (ROOT / file).read_text(encoding="utf-8")


def functions_of(node: ast.AST, name: str = "") -> Iterator[tuple[ast.FunctionDef, str]]:
    """Yield the outermost functions and their names, with their classes."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            yield child, f"{name}{child.name}"
        else:
            yield from functions_of(child, f"{name}{child.name}." if isinstance(child, ast.ClassDef) else name)


def function_of(mutant: Mutant) -> str:
    """Return the name of the outermost function that a mutant is in; nothing for a line in none."""
    for function, name in functions_of(ast.parse(text_of(mutant.file))):
        if function.body[0].lineno <= mutant.line <= (function.end_lineno or mutant.line):
            return name
    return ""


# -- mutants ----------------------------------------------------------------------------------------


@cache
def operator_of(name: str) -> Any:
    """Return an operator: one of cosmic-ray, or one of numbers."""
    from cosmic_ray.operators.number_replacer import NumberReplacer
    from cosmic_ray.plugins import get_operator
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

    return ({"integer": Integer, "float": Float}.get(name) or get_operator(name))()


def _is_integer(text: str) -> bool:
    try:
        int(text, 0)
    except ValueError:
        return text[-1] in "jJ"  # left alone
    return True


def mutants_of(file: str, operator: str) -> list[list[Mutant]]:
    """Return the mutants of each place of an operator in a file: not of annotations and decorators."""
    from cosmic_ray.ast import ast_nodes, get_ast

    if not (ROOT / file).is_file():
        return []
    omitted = []  # where annotations and decorators begin and end
    for node in ast.walk(ast.parse(text_of(file))):
        parts = (
            getattr(node, "annotation", None),
            getattr(node, "returns", None),
            *getattr(node, "decorator_list", []),
        )
        omitted += [((p.lineno, p.col_offset), (p.end_lineno, p.end_col_offset)) for p in parts if p is not None]
    places: dict[tuple[int, int], list[Mutant]] = defaultdict(list)
    starts = [start for node in ast_nodes(get_ast(text_of(file)))
              for start, _ in operator_of(operator).mutation_positions(node)]  # fmt: skip
    for occurrence, start in enumerate(starts):
        if not any(first <= start < last for first, last in omitted):
            places[start].append(Mutant(file, operator, occurrence, start[0]))
    return [places[place] for place in sorted(places)]


@cache
def mutated(mutant: Mutant) -> str:
    """Return the text of a mutant's file."""
    from cosmic_ray.mutating import mutate_code

    text = mutate_code(text_of(mutant.file), operator_of(mutant.operator), mutant.occurrence)
    assert isinstance(text, str), mutant
    return text


def changed(mutant: Mutant) -> tuple[str, str]:
    """Return the lines that a mutant changes, before and after."""
    lines = list(difflib.ndiff(text_of(mutant.file).splitlines(), mutated(mutant).splitlines()))
    before, after = (" ".join(line[2:].strip() for line in lines if line[:2] == sign) for sign in ("- ", "+ "))
    return before, after


def is_fault(mutant: Mutant) -> bool:
    """Return whether a mutant is valid Python and not just `*` before arguments made `/`: calls by name fit both."""

    def positional_only(text: str) -> int:
        return sum(len(n.posonlyargs) for n in ast.walk(ast.parse(text)) if isinstance(n, ast.arguments))

    with suppress(SyntaxError):  # `not` without the brackets of `:=`
        return positional_only(mutated(mutant)) == positional_only(text_of(mutant.file))
    return False


# -- the frozen list --------------------------------------------------------------------------------


@cache
def equivalents() -> set[tuple[str, str, str]]:
    """Return the mutants that no test can notice: file, line, line of the mutant."""
    pairs = yaml.safe_load(text_of("tests/mutants.yaml"))
    return {(file, pair["line"], pair["mutant"]) for file in pairs for pair in pairs[file]}


@cache
def alike(file: str, function: str, operator: str, line: str, mutant: str) -> list[Mutant]:
    """Return the mutants of a file that make the same change of the same line in a function."""
    text = text_of(file).splitlines()
    return [
        m for place in mutants_of(file, operator) for m in place
        if text[m.line - 1].strip() in line and function_of(m) == function and changed(m) == (line, mutant)
    ]  # fmt: skip


def located(entry: Frozen) -> Mutant | None:
    """Return the mutant of an entry, in its file or where its function has gone in its room; None without its code."""
    for file in dict.fromkeys((entry.file, *files_of(entry.room))):
        found = alike(file, entry.function, entry.operator, entry.line, entry.mutant)
        if len(found) > entry.nth:
            return found[entry.nth]
    return None


def redrawn(entry: Frozen, taken: set[tuple[str | int, ...]]) -> tuple[Frozen, Mutant] | None:
    """Return a mutant of the same operator and room from the seed in the entry; None if there is none."""
    places = [place for file in files_of(entry.room) for place in mutants_of(file, entry.operator)]
    rng = random.Random(f"{entry.redraw_seed} {entry.room} {entry.operator}")
    for place in rng.sample(places, len(places)):
        mutant = rng.choice(place)
        where, change = (mutant.file, function_of(mutant), mutant.operator), changed(mutant)
        nth, seed = alike(*where, *change).index(mutant), entry.redraw_seed
        other = Frozen(entry.room, *where, *change, nth, seed, seed + REDRAWN)
        if is_fault(mutant) and other.key not in taken and (other.file, other.line, other.mutant) not in equivalents():
            return other, mutant
    return None


def present(entries: list[Frozen]) -> Iterator[tuple[Frozen, Frozen, Mutant | None]]:
    """Yield each entry, itself or what replaces it, and its mutant; None where nothing can replace it."""
    same, taken = equivalents(), {entry.key for entry in entries}
    for entry in entries:
        mutant = None if (entry.file, entry.line, entry.mutant) in same else located(entry)
        if mutant is not None:
            yield entry, replace(entry, file=mutant.file), mutant
            continue
        other = redrawn(entry, taken)
        print(f"no code any more: {entry.file}: {entry.line}")
        if other:
            taken.add(other[0].key)
            print(f"    drawn anew: {other[0].file}: {other[0].line}")
        yield entry, *(other or (entry, None))


# -- trials -----------------------------------------------------------------------------------------


@cache
def listed() -> list[str]:
    """Return the files of the project."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0")
    return [name for name in names if name and (ROOT / name).is_file()]


def digest(files: Iterable[str]) -> str:
    """Return a digest of files."""
    return hashlib.sha256(b"".join(file.encode() + (ROOT / file).read_bytes() for file in files)).hexdigest()[:16]


def sources() -> list[str]:
    """Return the files of code and of what tests share."""
    files = [name for name in listed() if name.endswith((".py", ".c")) and not name.startswith("tests/mutants")]
    return [name for name in files if name.startswith(("cosim/", "plant/", "tests/")) and "/test_" not in name]


class Tree:
    """A copy of the project that mutants are written into."""

    def __init__(self, folder: Path) -> None:
        self.around, self.folder = folder, folder / "tree"
        self.sound: dict[str, bool] = {}  # test → whether it passes by itself without a mutant
        for name in listed():
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, self.folder / name)

    def note_calls(self) -> None:
        """Let the functions of `cosim` note that they are called."""
        (self.folder / "mutants_note.py").write_text(f"folder = {str(self.around)!r}\n{NOTE}")
        for file in [name for name in listed() if name.startswith("cosim/") and name.endswith(".py")]:
            tree = ast.parse(text_of(file))
            for function, name in functions_of(tree):
                call = f"__import__('mutants_note').note({file + ':' + name!r})"
                function.body.insert(ast.get_docstring(function) is not None, ast.parse(call).body[0])
            (self.folder / file).write_text(ast.unparse(tree), encoding="utf-8")

    def test(self, tests: Iterable[str], timeout: float, *words: str) -> tuple[int, str]:
        """Run tests; return pytest's exit code or `KILLED`, and what it printed."""
        place, output = self.around / "tmp", self.around / "output.txt"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        command = ["timeout", "-s", "KILL", str(timeout), sys.executable, "-m", "pytest", "-q", "-m", SKIPPED, *words]
        more = {"PYTHONPATH": str(self.folder), "TMPDIR": str(place), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        with output.open("wb") as stream:
            ended = subprocess.run(
                [*command, "-p", "no:cacheprovider", *tests], cwd=self.folder, env=os.environ | more,
                stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, start_new_session=True, check=False,
            )  # fmt: skip
        return ended.returncode, output.read_text(errors="replace")

    def passes(self, test: str) -> bool:
        """Return whether a test passes without a mutant, by itself and in this copy."""
        if test not in self.sound:
            self.sound[test] = self.test([test], 600.0)[0] == 0
        return self.sound[test]


def spread(jobs: int, items: list[Any], do: Callable[[Tree, Any], None]) -> None:
    """Do something with each item, some at a time, each in a copy of the tree."""
    pending = items[::-1]

    def one(_: int) -> None:
        with tempfile.TemporaryDirectory(dir=WORK, ignore_cleanup_errors=True) as folder:
            tree = Tree(Path(folder))
            while pending:
                do(tree, pending.pop())

    with ThreadPoolExecutor(jobs) as pool:
        try:
            list(pool.map(one, range(min(jobs, len(pending)))))
        finally:  # an interrupted run waits for the tests that run
            pending.clear()


def trace(tree: Tree, work: tuple[str, Path]) -> None:
    """Note how long each test of a file takes that passes without a mutant, and which functions it calls."""
    file, store = work
    if not (tree.folder / "mutants_note.py").exists():
        tree.note_calls()
    notes = tree.around / "notes"
    notes.write_text("")
    code, output = tree.test([file], 1800.0, "-p", "mutants_note")
    shutil.move(notes, store)
    print(f"traced     {file}  {output.strip().splitlines()[-1:] if code else ''}", flush=True)


def traced(tests: list[str], jobs: int) -> Traces:
    """Return the traces of test files, from an earlier run of the same code if there is one."""
    shared = digest(sources())
    stores = {file: WORK / f"{Path(file).stem}-{shared}-{digest([file])}.txt" for file in tests}
    spread(jobs, [(file, store) for file, store in stores.items() if not store.exists()], trace)
    calls: dict[str, set[str]] = defaultdict(set)
    seconds = {}
    for line in (line for store in stores.values() for line in store.read_text().splitlines()):
        test, told = line.split("\t")
        if ":" in told:
            calls[test].add(told)
        else:
            seconds[test] = float(told)
    return {test: (time, calls[test]) for test, time in seconds.items()}


def file_of(test: str) -> str:
    return test.partition("::")[0]


def order_of(mutant: Mutant, traces: Traces) -> list[str]:
    """Return the tests that a mutant is tried against, file by file: the quickest that call its function."""
    function = function_of(mutant)
    place = f"{mutant.file}:{function}"
    chosen: list[str] = []
    total = 0.0
    for test, (seconds, calls) in sorted(traces.items(), key=lambda found: found[1][0]):
        if place in calls or (not function and any(call.startswith(place) for call in calls)):
            total += seconds
            if total > LONGEST and chosen:
                break
            chosen.append(test)
    files = list(dict.fromkeys(map(file_of, chosen)))
    return sorted(chosen, key=lambda test: files.index(file_of(test)))


def tried(tree: Tree, mutant: Mutant, traces: Traces) -> tuple[str, str, str]:
    """Return the outcome of a mutant, the file and the test that failed."""
    names = order_of(mutant, traces)
    if not names:
        return "survived", "", "no test"
    path = tree.folder / mutant.file
    path.write_text(mutated(mutant), encoding="utf-8")  # a test lasts more than the second that a .pyc is told by
    try:
        code, output = tree.test(names, PATIENCE * sum(traces[name][0] for name in names) + STARTING, "-x")
    finally:
        path.write_text(text_of(mutant.file), encoding="utf-8")
    if code == 0:
        return "survived", "", f"{len(names)} tests"
    told = next((line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))), output[-200:])
    by = max((name for name in names if name in told), key=len, default="")
    if by and code != KILLED and not tree.passes(by):
        return tried(tree, mutant, {name: found for name, found in traces.items() if name != by})
    return ("timeout" if code == KILLED else "killed"), file_of(by), told


def frozen(tests: list[str], jobs: int, *, redraw: bool, only: int | None) -> int:
    """Try the frozen list and compare it with the outcomes in it; return 1 if a mutant survives that was killed."""
    found = list(present([Frozen(**json.loads(line)) for line in FROZEN.read_text(encoding="utf-8").splitlines()]))
    results = WORK / f"frozen-{digest([*sources(), *tests])}.jsonl"
    lines = results.read_text().splitlines() if results.exists() else []
    have = {tuple(key): (outcome, by) for key, outcome, by in map(json.loads, lines)}
    work = [(now, mutant) for _, now, mutant in found if mutant is not None and now.key not in have][:only]
    print(f"{len(work)} of {len(found)} to try; results in {results}", flush=True)
    traces = traced(tests, jobs) if work else {}

    def one(tree: Tree, item: tuple[Frozen, Mutant]) -> None:
        entry, mutant = item
        outcome, by, told = tried(tree, mutant, traces)
        have[entry.key] = outcome, by
        with results.open("a", encoding="utf-8") as file:
            file.write(json.dumps([entry.key, outcome, by]) + "\n")
        print(f"{outcome:10} {mutant.file}:{mutant.line}  {told[:110]}", flush=True)

    try:
        spread(jobs, work, one)
    finally:
        text = ""
        for before, now, _ in found:
            entry = now if redraw else before
            if entry.key in have and not entry.outcome:
                entry = replace(entry, outcome=have[entry.key][0], by=have[entry.key][1])
            text += json.dumps(asdict(entry), ensure_ascii=False) + "\n"
        FROZEN.write_text(text, encoding="utf-8")
    rooms: dict[str, Counter[str]] = {room: Counter() for room in ROOMS}
    lost = 0
    for _, now, mutant in found:
        outcome, _ = have.get(now.key, ("not tried" if mutant else "gone", ""))
        rooms[now.room][outcome] += 1
        if outcome == "survived" and now.outcome in ("killed", "timeout"):
            lost += 1
            print(f"survives, was killed by {now.by}: {now.file}, {now.function}\n    - {now.line}\n    + {now.mutant}")
    print(json.dumps({**rooms, "lost": lost}))
    return int(lost > 0)


def main() -> None:
    """Try the frozen list; print the outcomes of each room."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", help="files of tests, by default all")
    parser.add_argument("-n", type=int, help="mutants to try, by default all")
    parser.add_argument("--redraw", action="store_true", help="write into the list what replaces lost code")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="mutants at a time")
    options = parser.parse_args()
    WORK.mkdir(parents=True, exist_ok=True)
    tests = options.tests or sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("tests/test_*.py"))
    sys.exit(frozen(tests, options.jobs, redraw=options.redraw, only=options.n))


if __name__ == "__main__":
    main()
