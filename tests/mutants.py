"""Random faults in the code, each tried against the tests that call it: `python -m tests.mutants`, `make mutants`.

A mutant of the list, tests/mutants_frozen.jsonl, is known by its function and the text of its line. What has no code
any more is replaced by a mutant of the same operator and room, drawn from the `redraw_seed` that stands in the list;
`--redraw` writes it down. A line without an outcome gets that of the next run; later runs compare theirs with it. A run
goes on where it ended.

The operators are those of cosmic-ray, and one more: a float by half as much again. A mutant is written into a copy of
the tree, so that the workers that a test starts or forks run it too. A process that has imported code and tests forks
for each mutant, gives the mutated function its code, or imports anew where more than functions changed, and runs tests
until one fails: those of the whole suite that call the function of the mutant, in whatever process, the quickest first.
A run of each test file without a mutant shows which they are, once for the same code. `tests/mutants.yaml` lists
mutants that no test can notice, and says why.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import fcntl
import gc
import hashlib
import inspect
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from functools import cache
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NoReturn

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "build" / "mutants"
FROZEN = ROOT / "tests" / "mutants_frozen.jsonl"
ROOMS = {  # rooms of the frozen list → files, the first that matches; elsewhere a room is a folder
    "units": ("cosim/core/units.py",),
    "sources": ("cosim/blocks/sources.py", "cosim/blocks/profile.py"),
    "blocks": ("cosim/blocks/*.py",),
    "master": ("cosim/master/*.py",),
    "system": ("cosim/system/*.py",),
}
REDRAWN = 1000  # from a redraw_seed to the next
PACKAGES = ("tests", "cosim", "plant", "controller", "fmus")
LONGEST = 30.0  # [s] of tests for one mutant, by their times without it, the quickest of those that call its function
FIRST = 8  # files of tests that are tried before the others
PATIENCE = 4.0  # times as long a mutant may take, and
STARTING = 120.0  # [s] more
SKIPPED = "not thorough and not hosts"

UNUSED = ("NoOp", "RemoveDecorator", "VariableReplacer", "VariableInserter", "NumberReplacer")
KINDS = (
    "Add Sub Mul Div", "FloorDiv Mod Mul", "Pow Mul", "BitAnd BitOr BitXor", "Eq NotEq Lt LtE Gt GtE", "Is IsNot",
    "In NotIn", "USub UAdd Nothing", "Not Nothing",
)  # fmt: skip

# a module for a copy of the tree in which each function of `cosim` tells that it is called, in whatever process
NOTE = '''"""Notes which functions a test calls."""
import os
seen, process = set(), [0]
def note(name):
    if process[0] != os.getpid():
        process[0] = os.getpid()
        seen.clear()
    if name not in seen:
        seen.add(name)
        try:
            with open(f"{folder}/test.txt") as test, open(f"{folder}/calls.txt", "a") as calls:
                calls.write(f"{test.read()}\\t{name}\\n")
        except Exception:
            pass
'''


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
        return room_of(self.file)


@dataclass(frozen=True)
class Trace:
    """The seconds that a test takes without a mutant, and the functions of `cosim` that it calls: `file:name`."""

    seconds: float
    calls: frozenset[str]


def room_of(file: str) -> str:
    """Return the room of a file."""
    return next((r for r, patterns in ROOMS.items() if any(fnmatch(file, p) for p in patterns)), file.split("/")[1])


def files_of(patterns: Iterable[str]) -> list[str]:
    """Return the files of patterns."""
    paths = [path for pattern in patterns for path in sorted(ROOT.glob(pattern))]
    return [path.relative_to(ROOT).as_posix() for path in paths if path.name != "__init__.py"]


# -- mutants ----------------------------------------------------------------------------------------


@cache
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


def _is_fault(text: str, before: str) -> bool:
    """Return whether a mutant is valid Python and not just `*` before arguments made `/`: calls by name fit both."""
    try:
        tree = ast.parse(text)
    except SyntaxError:  # `not` without the brackets of `:=`
        return False
    return _positional_only(tree) == _positional_only(ast.parse(before))


def _positional_only(tree: ast.Module) -> int:
    return sum(len(node.posonlyargs) for node in ast.walk(tree) if isinstance(node, ast.arguments))


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
        self.sound: dict[str, bool] = {}  # test → whether it passes by itself without a mutant
        shutil.rmtree(folder, ignore_errors=True)
        listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        for name in subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0"):
            if name and (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)

    def note_calls(self) -> None:
        """Let the functions of `cosim` note that they are called."""
        (self.folder / "mutants_note.py").write_text(f"folder = {str(self.folder.parent)!r}\n{NOTE}")
        for path in self.folder.glob("cosim/**/*.py"):
            file = path.relative_to(self.folder).as_posix()
            lines, marks = path.read_text(encoding="utf-8").splitlines(), list(_bodies(_tree_of(file), ""))
            for line, column, name in sorted(marks, reverse=True):
                if not lines[line - 1][:column].strip():  # not behind the colon
                    lines.insert(line - 1, f'{" " * column}__import__("mutants_note").note("{file}:{name}")')
            path.write_text("\n".join([*lines, ""]), encoding="utf-8")

    def write(self, file: str, text: str) -> None:
        """Write a file, and let Python compile it anew: within a second its time and size may be the same."""
        path = self.folder / file
        path.write_text(text, encoding="utf-8")
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()

    def test(
        self, tests: list[str], timeout: float, change: Change | None = None, **environment: str
    ) -> tuple[int | None, str]:
        """Run tests in a fork; return pytest's exit code, None for one that took too long, and what it printed."""
        work = self.folder.parent / "tmp"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        output = self.folder.parent / "output.txt"
        environment |= {"PYTHONPATH": str(self.folder), "TMPDIR": str(work), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        pid = os.fork()
        if pid == 0:
            if "MUTANTS_LOG" in environment:
                self.load()
            _run(output, tests, environment, change)
        deadline = threading.Timer(timeout, os.killpg, (pid, signal.SIGKILL))
        deadline.start()
        try:
            _, status = os.waitpid(pid, 0)
        except KeyboardInterrupt:
            os.killpg(pid, signal.SIGKILL)
            raise
        finally:
            took_too_long = not deadline.is_alive()
            deadline.cancel()
        return None if took_too_long else os.waitstatus_to_exitcode(status), output.read_text(errors="replace")

    def load(self, *tests: str) -> None:
        """Import test files of the copy, and with them what they test: while no mutant is in it."""
        if os.getcwd() != str(self.folder):
            os.chdir(self.folder)
            sys.path[:] = [str(self.folder), *(place for place in sys.path if place not in ("", str(ROOT)))]
            _forget()
        for file in tests:
            with suppress(pytest.skip.Exception):
                import_module(file.removesuffix(".py").replace("/", "."))

    def passes(self, test: str) -> bool:
        """Return whether a test passes without a mutant, by itself and in this copy."""
        if test not in self.sound:
            self.sound[test] = self.chosen([test], 600.0, None)[0] == 0
        return self.sound[test]

    def chosen(self, names: list[str], timeout: float, change: Change | None) -> tuple[int | None, str]:
        """Run some tests, in this order, until one fails; nothing where there are none."""
        if not names:
            return 0, ""
        order = self.folder.parent / "order.json"
        order.write_text(json.dumps(names))
        files = list(dict.fromkeys(name.partition("::")[0] for name in names))
        return self.test(files, timeout, change, MUTANTS_ORDER=str(order))


@dataclass(frozen=True)
class Change:
    """The text of a file of the copy before and after."""

    path: Path
    before: str
    after: str

    def apply(self) -> bool:
        """Give functions that live in this process their new code; return False where more than functions changed."""
        if not any(getattr(module, "__file__", None) == str(self.path) for module in list(sys.modules.values())):
            return True  # it is imported later, from the copy
        (bodies, old), (other_bodies, new) = (_parts(compile(t, self.path, "exec")) for t in (self.before, self.after))
        if bodies != other_bodies or old.keys() != new.keys():
            return False
        changed = {place: new[place] for place in old if old[place] != new[place]}
        if any(_makes_functions(old[place]) for place in changed):
            return False  # functions that it has made keep their code
        met = set()
        for function in gc.get_objects():
            if isinstance(function, FunctionType) and function.__code__.co_filename == str(self.path):
                place = function.__code__.co_qualname, function.__code__.co_firstlineno
                if place in changed:
                    function.__code__ = changed[place]
                    met.add(place)
        return met == changed.keys()


def _parts(module: CodeType) -> tuple[list[tuple[Any, ...]], dict[tuple[str, int], CodeType]]:
    """Return what is executed at import, and the functions by name and line."""
    bodies, functions, pending = [], {}, [module]
    while pending:
        code = pending.pop()
        constants = []
        for constant in code.co_consts:
            if not isinstance(constant, CodeType):
                constants.append((type(constant), constant))
            elif not constant.co_flags & inspect.CO_OPTIMIZED:  # a class
                pending.append(constant)
            elif constant.co_name.startswith("<"):
                bodies.append((constant,))
            else:
                functions[constant.co_qualname, constant.co_firstlineno] = constant
        bodies.append((code.co_code, constants, code.co_names))
    return bodies, functions


def _makes_functions(code: CodeType) -> bool:
    """Return whether a function defines others."""
    return any(isinstance(c, CodeType) and not c.co_name.startswith("<") for c in code.co_consts)


def _forget() -> None:
    """Let code and tests be imported anew."""
    for name in [name for name in sys.modules if name.partition(".")[0] in PACKAGES]:
        del sys.modules[name]


def _run(output: Path, tests: list[str], environment: dict[str, str], change: Change | None) -> NoReturn:
    """Be pytest in a process group of its own."""
    code = 1
    try:
        os.setsid()
        with output.open("wb") as stream, open(os.devnull, "rb") as nothing:
            os.dup2(nothing.fileno(), 0)
            os.dup2(stream.fileno(), 1)
            os.dup2(stream.fileno(), 2)
        os.environ.update(environment)
        if change is not None and not change.apply():
            _forget()
        stops = [] if "MUTANTS_LOG" in environment else ["-x"]
        arguments = ["-p", "no:cacheprovider", "-m", SKIPPED, "-q", *stops, *tests]
        code = pytest.main(arguments, plugins=[sys.modules[__name__]])
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(int(code))


def traced(tree: Tree, tests: list[str]) -> dict[str, Trace]:
    """Return the trace of each test of the files, from an earlier run of the same code."""
    noting: Tree | None = None
    traces: dict[str, Trace] = {}
    for file in tests:
        store = WORK / f"{Path(file).stem}-{_digest(file, _code(of_tests=False))}.json"
        with store.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # two processes need the same traces
            if not store.is_file():
                if noting is None:
                    noting = Tree(tree.folder.parent / "notes" / "tree")
                    noting.note_calls()
                begun = time.perf_counter()
                code, output = noting.test(
                    [file], 1800.0, MUTANTS_LOG=str(store), MUTANTS_NOTES=str(noting.folder.parent)
                )
                if not store.is_file():
                    store.write_text("{}")
                told = output.strip().splitlines()[-1:] if code else ""
                print(f"traced     {file}  [{time.perf_counter() - begun:.0f} s] {told or ''}", flush=True)
        found = json.loads(store.read_text())
        traces |= {name: Trace(seconds, frozenset(calls)) for name, (seconds, calls) in found.items()}
    return traces


@cache
def _code(*, of_tests: bool) -> str:
    """Return a digest of the code and of what tests share, or of the tests, too."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "cosim", "plant", "tests"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0")
    code = (name for name in names if name.endswith((".py", ".c")) and not name.startswith("tests/mutants"))
    return _digest(*(name for name in code if of_tests or not name.startswith("tests/test_")))


def _digest(*files: str) -> str:
    """Return a digest of files, or of what is not the name of one."""
    digest = hashlib.sha256(b"names")
    for file in files:
        digest.update((ROOT / file).read_bytes() if (ROOT / file).is_file() else file.encode())
    return digest.hexdigest()[:16]


def function_of(file: str, line: int) -> str:
    """Return the name of the outermost function that a line is in, with its classes; nothing for a line in none."""

    def within(node: ast.AST, name: str) -> str:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef):
                if child.body[0].lineno <= line <= (child.end_lineno or line):
                    return f"{name}{child.name}"
            elif found := within(child, f"{name}{child.name}." if isinstance(child, ast.ClassDef) else name):
                return found
        return ""

    return within(_tree_of(file), "")


def _bodies(node: ast.AST, name: str) -> Iterator[tuple[int, int, str]]:
    """Yield line and column of the first statement of each outermost function, after its docstring, and its name."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef):
            yield from _bodies(child, f"{name}{child.name}." if isinstance(child, ast.ClassDef) else name)
        elif rest := child.body[1 if ast.get_docstring(child) is not None else 0 :]:
            line = min([rest[0].lineno, *(d.lineno for d in getattr(rest[0], "decorator_list", []))])
            yield line, rest[0].col_offset, f"{name}{child.name}"


@cache
def _tree_of(file: str) -> ast.Module:
    return ast.parse((ROOT / file).read_text(encoding="utf-8"))


def order_of(mutant: Mutant, tests: dict[str, Trace]) -> list[str]:
    """Return the tests that a mutant is tried against, file by file: the quickest that call its function."""
    function = function_of(mutant.file, mutant.line)
    place = f"{mutant.file}:{function}"
    called = [
        name for name, trace in tests.items()
        if place in trace.calls or (not function and any(call.startswith(place) for call in trace.calls))
    ]  # fmt: skip
    files: dict[str, list[str]] = defaultdict(list)
    total, costs = 0.0, dict[str, float]()
    for name in sorted(called, key=lambda name: (tests[name].seconds, name)):
        total += tests[name].seconds
        if total > LONGEST and files:
            break
        file = name.partition("::")[0]
        files[file].append(name)
        costs[file] = costs.get(file, 0.0) + tests[name].seconds
    return [name for file in sorted(files, key=lambda file: (costs[file], file)) for name in files[file]]


def tried(tree: Tree, mutant: Mutant, text: str, traces: dict[str, Trace]) -> tuple[str, str, str]:
    """Return the outcome of a mutant, the file and the test that failed."""
    original = (ROOT / mutant.file).read_text(encoding="utf-8")
    names = order_of(mutant, traces)
    files = list(dict.fromkeys(name.partition("::")[0] for name in names))
    tree.load(*files)
    for part in (files[:FIRST], files[FIRST:]):
        some = [name for name in names if name.partition("::")[0] in part]
        tree.write(mutant.file, text)
        try:
            patience = PATIENCE * sum(traces[name].seconds for name in some) + STARTING
            code, output = tree.chosen(some, patience, Change(tree.folder / mutant.file, original, text))
        finally:
            tree.write(mutant.file, original)
        if code != 0:
            failed = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
            told = failed[0] if failed else output[-200:]
            by = max((name for name in some if told.partition(" ")[2].startswith(name)), key=len, default="")
            if by and code is not None and not tree.passes(by):
                return tried(tree, mutant, text, {name: trace for name, trace in traces.items() if name != by})
            return ("timeout" if code is None else "killed"), by.partition("::")[0], told
    return "survived", "", f"{len(names)} tests"


# -- within pytest ----------------------------------------------------------------------------------


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the tests that a mutant is tried against, in their order."""
    if order := os.environ.get("MUTANTS_ORDER"):
        place = {name: number for number, name in enumerate(json.loads(Path(order).read_text()))}
        items[:] = sorted((item for item in items if item.nodeid in place), key=lambda item: place[item.nodeid])


_SECONDS: dict[str, float] = {}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Tell which test is running."""
    if "MUTANTS_LOG" not in os.environ:
        return (yield)
    (Path(os.environ["MUTANTS_NOTES"]) / "test.txt").write_text(item.nodeid)
    if noting := sys.modules.get("mutants_note"):
        noting.seen.clear()
    return (yield)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note how long a test takes."""
    if report.when == "call" and report.passed:
        _SECONDS[report.nodeid] = report.duration


def pytest_sessionfinish() -> None:
    """Write the traces of the tests."""
    if log := os.environ.get("MUTANTS_LOG"):
        calls: dict[str, set[str]] = defaultdict(set)
        notes = Path(os.environ["MUTANTS_NOTES"]) / "calls.txt"
        for line in notes.read_text().splitlines() if notes.exists() else []:
            test, _, name = line.partition("\t")
            calls[test].add(name)
        notes.unlink(missing_ok=True)
        Path(log).write_text(json.dumps({test: (_SECONDS[test], sorted(calls[test])) for test in _SECONDS}))


# -- the frozen list --------------------------------------------------------------------------------


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


def read_frozen() -> list[Frozen]:
    """Return the frozen list."""
    if not FROZEN.exists():
        raise SystemExit(f"{FROZEN.name} is not there: --freeze 200 --seed SEED draws it")
    return [Frozen(**json.loads(line)) for line in FROZEN.read_text(encoding="utf-8").splitlines()]


def write_frozen(entries: Iterable[Frozen]) -> None:
    """Write the frozen list."""
    lines = [json.dumps(asdict(entry), ensure_ascii=False) + "\n" for entry in entries]
    FROZEN.write_text("".join(lines), encoding="utf-8")


@cache
def alike(file: str, function: str, operator: str, line: str, mutant: str) -> list[Mutant]:
    """Return the mutants of a file that make the same change of the same line in a function."""
    tools = operators()
    text = (ROOT / file).read_text(encoding="utf-8").splitlines()
    places = mutants_of(file, {operator: tools[operator]}) if operator in tools else []
    return [
        m for place in places for m in place
        if text[m.line - 1].strip() in line and function_of(file, m.line) == function
        and changed(m, mutated(m, tools)) == (line, mutant)
    ]  # fmt: skip


def located(entry: Frozen) -> Mutant | None:
    """Return the mutant of an entry, in its file or where its function has gone in its room; None without its code."""
    for file in dict.fromkeys((entry.file, *files_of(ROOMS[entry.room]))):
        if (ROOT / file).is_file() and room_of(file) == entry.room:
            found = alike(file, entry.function, entry.operator, entry.line, entry.mutant)
            if len(found) > entry.nth:
                return found[entry.nth]
    return None


def entry_of(mutant: Mutant, seed: int, redraw_seed: int) -> Frozen:
    """Return the entry of a mutant in the list."""
    where = mutant.file, function_of(mutant.file, mutant.line), mutant.operator
    change = changed(mutant, mutated(mutant, operators()))
    return Frozen(mutant.room, *where, *change, alike(*where, *change).index(mutant), seed, redraw_seed)


def redrawn(entry: Frozen, taken: set[tuple[str | int, ...]]) -> Frozen | None:
    """Return a mutant of the same operator and room from the seed in the entry; None if there is none."""
    tools, same = operators(), equivalents()
    files = [file for file in files_of(ROOMS[entry.room]) if room_of(file) == entry.room]
    places = [place for file in files for place in mutants_of(file, {entry.operator: tools[entry.operator]})]
    rng = random.Random(f"{entry.redraw_seed} {entry.room} {entry.operator}")
    for place in rng.sample(places, len(places)):
        mutant = rng.choice(place)
        other = entry_of(mutant, entry.redraw_seed, entry.redraw_seed + REDRAWN)
        is_fault = _is_fault(mutated(mutant, tools), (ROOT / mutant.file).read_text(encoding="utf-8"))
        if is_fault and other.key not in taken and (other.file, other.line, other.mutant) not in same:
            return other
    return None


def present(entries: Iterable[Frozen]) -> list[tuple[Frozen, Frozen, Mutant | None]]:
    """Return for each entry itself or what replaces it, and its mutant; None where nothing can replace it."""
    entries = list(entries)
    same, taken, found = equivalents(), {entry.key for entry in entries}, []
    for entry in entries:
        now, mutant = entry, None if (entry.file, entry.line, entry.mutant) in same else located(entry)
        if mutant is None and (other := redrawn(entry, taken)) is not None:
            now, mutant = other, located(other)
            taken.add(other.key)
        elif mutant is not None and mutant.file != entry.file:
            now = replace(entry, file=mutant.file)
        found.append((entry, now, mutant))
    return found


def run_frozen(work: list[tuple[Frozen, Mutant]], tests: list[str], results: Path, jobs: int) -> None:
    """Try mutants, some processes at a time: every second one from the end, so that each meets other tests."""
    context = multiprocessing.get_context("fork")
    begun, ended = context.Value("i", 0), context.Value("i", 0)

    def one(number: int) -> None:
        tree, tools = Tree(WORK / str(os.getpid()) / "tree"), operators()
        try:
            traced(tree, tests[:: -1 if number % 2 else 1])
            traces = traced(tree, tests)
            while True:
                with begun.get_lock():
                    if begun.value + ended.value == len(work):
                        return
                    mine = begun if number % 2 == 0 else ended
                    mine.value += 1
                    entry, mutant = work[begun.value - 1 if mine is begun else -ended.value]
                begin = time.perf_counter()
                outcome, by, told = tried(tree, mutant, mutated(mutant, tools), traces)
                seconds = round(time.perf_counter() - begin)
                with results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"key": entry.key, "outcome": outcome, "by": by, "seconds": seconds}) + "\n")
                print(f"{outcome:10} {mutant.file}:{mutant.line}  [{seconds} s] {told[:110]}", flush=True)
        except KeyboardInterrupt:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        finally:
            shutil.rmtree(tree.folder.parent, ignore_errors=True)

    workers = [context.Process(target=one, args=(number,)) for number in range(min(jobs, len(work)))]
    for worker in workers:
        worker.start()
    try:
        for worker in workers:
            worker.join()
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for worker in workers:
            os.kill(worker.pid or 0, signal.SIGINT)
            worker.join()
        raise SystemExit(130) from None
    if any(worker.exitcode for worker in workers):
        raise SystemExit(1)


def frozen(jobs: int, tests: list[str], *, redraw: bool, only: int | None) -> int:
    """Try the frozen list and compare it with the outcomes in it; return 1 if a mutant survives that was killed."""
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.default_int_handler)
    found = present(read_frozen())
    for before, now, mutant in found:
        if now.key != before.key or mutant is None:
            drawn_anew = f"drawn anew: {now.file}: {now.line}" if mutant else "and no other of its operator in its room"
            print(f"no code any more: {before.file}: {before.line}\n    {drawn_anew}")
    if redraw:
        write_frozen(now for _, now, _ in found)
    results = WORK / f"frozen-{_digest(_code(of_tests=True), *tests)}.jsonl"
    have = _results(results)
    work = [(now, mutant) for _, now, mutant in found if mutant is not None and now.key not in have]
    print(f"{len(work)} of {len(found)} to try; results in {results}", flush=True)
    try:
        run_frozen(work[:only], tests, results, jobs)
    finally:
        have = _results(results)
        keep = [now if redraw else before for before, now, _ in found]
        write_frozen(
            replace(e, outcome=have[e.key]["outcome"], by=have[e.key]["by"]) if not e.outcome and e.key in have else e
            for e in keep
        )
    lost = 0
    rooms: dict[str, Counter[str]] = {room: Counter() for room in ROOMS}
    for _, now, mutant in found:
        outcome = have[now.key]["outcome"] if now.key in have else "not tried" if mutant else "gone"
        rooms[now.room][outcome] += 1
        if outcome == "survived" and now.outcome in ("killed", "timeout"):
            lost += 1
            print(f"survives, was killed by {now.by}: {now.file}, {now.function}\n    - {now.line}\n    + {now.mutant}")
    print(json.dumps({room: dict(count) for room, count in rooms.items()} | {"lost": lost}))
    return int(lost > 0)


def _results(path: Path) -> dict[tuple[str | int, ...], dict[str, Any]]:
    """Return the results of an earlier run by the keys of their mutants."""
    texts = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {tuple(line["key"]): line for line in map(json.loads, texts)}


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
    """Try the frozen list; print the outcomes of each room."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, help="mutants to try, by default all")
    parser.add_argument("--redraw", action="store_true", help="write into the list what replaces lost code")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="mutants at a time")
    options = parser.parse_args()
    WORK.mkdir(parents=True, exist_ok=True)
    tests = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("tests/test_*.py"))
    sys.exit(frozen(options.jobs, tests, redraw=options.redraw, only=options.n))


if __name__ == "__main__":
    main()
