"""The layout of the project: how large its rooms are, what may be called what, and which names stand where."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.english import PACKAGES as ENGLISH
from tests.english import measure
from tests.messages import bare_calls
from tests.test_drive import EXAMPLE, simulated

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("plant", "controller", "fmus", "cosim")
CODE = {".py", ".c", ".j2", ".css", ".js"}
VERBS = ("run", "simulate", "replay", "refine", "check", "build", "read")
EXAMPLE_ROOMS = ("plant/", "controller/", "fmus/")  # the worked example: everything else is general
NAMES = re.compile(r"duty_|tilt|\bpsi|_psi|x_world|Hovercraft")


def sources() -> Iterator[Path]:
    """Code and templates of the packages, as paths from the root."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix in CODE and "__pycache__" not in path.parts:
                yield path.relative_to(ROOT)


def room(path: Path) -> str:
    """A package directly under cosim with all beneath it, or plant, controller, fmus."""
    return "/".join(path.parts[:2]) if path.parts[0] == "cosim" and len(path.parts) > 2 else path.parts[0]


def test_no_room_holds_more_than_a_quarter_of_the_house() -> None:
    lines: dict[str, int] = {}
    for path in sources():
        lines[room(path)] = lines.get(room(path), 0) + len((ROOT / path).read_text(encoding="utf-8").splitlines())
    largest = max(lines, key=lambda name: lines[name])
    assert lines[largest] <= 0.25 * sum(lines.values()), (largest, lines[largest] / sum(lines.values()))


def test_no_room_bears_the_name_of_a_verb() -> None:
    taken = {
        path.stem for path in (ROOT / "cosim").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert not taken & set(VERBS)


@pytest.mark.parametrize("verb", ["build", "check", "excite", "refine", "replay", "run"])
def test_the_verbs_are_functions_of_the_package(verb: str) -> None:
    assert callable(getattr(importlib.import_module("cosim"), verb))


@pytest.mark.thorough
def test_the_verbs_take_paths_as_they_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cosim = importlib.import_module("cosim")
    assert {"build", "check", "excite", "refine", "replay", "run"} <= {*dir(cosim)}
    monkeypatch.chdir(tmp_path)
    simulated(Path("v1.csv"), 1)
    (plant,) = cosim.build("built", f"{EXAMPLE / 'drive.py'}:Drive")
    (carried,) = cosim.check(str(plant))
    assert cosim.check([plant]) == [carried]
    assert 'experiment "smoke test"' in carried
    cosim.replay("v1.csv", "replayed", "built/plant.fmu")
    Path("run.yaml").write_text(
        "name: drive\nduration: 1\nstep: 0.01\ncomponents: {drive: {fmu: built/plant.fmu, start: {force: 20}}}\n"
    )
    cosim.run("run.yaml", "ran")
    assert {path.parent.name for path in Path().glob("*/report.html")} == {"replayed", "ran"}


def test_what_the_package_does_not_have_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="levitate"):
        importlib.import_module("cosim").levitate  # noqa: B018


SHARED_NAMES = {"__init__.py", "__main__.py", "workflow.py", "report.py", "write.py", "artefacts.py", "messages.py"}


def test_a_file_name_means_one_file() -> None:
    names: dict[str, list[str]] = {}
    for path in sources():
        if path.suffix == ".py" and path.name not in SHARED_NAMES:
            names.setdefault(path.name, []).append(path.as_posix())
    assert {name: paths for name, paths in names.items() if len(paths) > 1} == {}


def test_no_single_modules_at_the_top_of_the_framework() -> None:
    files = {path.name for path in (ROOT / "cosim").iterdir() if path.is_file()}
    assert files == {"__init__.py", "__main__.py", "py.typed"}


MOST_BRANCHES = 14  # cyclomatic complexity of a function


def branches(function: ast.AST) -> int:
    """Return the cyclomatic complexity of a function, those within it apart, counted as radon does."""
    count, nodes = 1, [*ast.iter_child_nodes(function)]
    for node in nodes:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        nodes += ast.iter_child_nodes(node)
        if isinstance(node, ast.BoolOp):
            count += len(node.values) - 1
        elif isinstance(node, ast.comprehension):
            count += 1 + len(node.ifs)
        elif isinstance(node, (ast.For, ast.AsyncFor, ast.While)):
            count += 1 + bool(node.orelse)
        elif isinstance(node, ast.Try):
            count += len(node.handlers) + bool(node.orelse)
        elif isinstance(node, (ast.If, ast.IfExp, ast.Assert, ast.match_case)):
            count += 1
    return count


def test_branches_are_counted_as_by_radon() -> None:
    text = """
def function(a, b):
    for x in a:
        if x and b or x > 1:
            return [y if y else 0 for y in b if y]
    else:
        def inner():
            assert a
        try:
            inner()
        except (ValueError, TypeError):
            return lambda: 0
    """
    assert branches(ast.parse(text).body[0]) == 10


@dataclass
class Read:
    """What the modules contain, each of them parsed once: docstrings of functions by package, and findings."""

    docstrings: dict[str, list[str]] = field(default_factory=lambda: {package: [] for package in ENGLISH})
    compressed: list[str] = field(default_factory=list)
    texts_of_example: list[str] = field(default_factory=list)
    without_code: list[str] = field(default_factory=list)
    formatted_by_hand: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def read() -> Read:
    module_path = re.compile(r"(?:plant|controller|fmus)(?:\.\w+)+(?::\w+)?|(?:plant|controller|fmus):\w+")
    found = Read()
    for path in sorted(path.relative_to(ROOT) for package in ENGLISH for path in (ROOT / package).rglob("*.py")):
        text, package = (ROOT / path).read_text(encoding="utf-8"), path.parts[0]
        tree = ast.parse(text)
        nodes = [*ast.walk(tree)]
        functions = [node for node in nodes if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
        found.docstrings[package] += filter(None, map(ast.get_docstring, functions))
        if package not in PACKAGES:
            continue
        found.compressed += [
            f"{path}:{node.lineno}: {node.name} has {count} branches; a table, a class or a longer body has fewer"
            for node in functions
            if (count := branches(node)) > MOST_BRANCHES
        ]
        found.formatted_by_hand += [
            f"{path}:{number}: {line.strip()}"
            for number, line in enumerate(text.splitlines(), 1)
            if re.search(r"# fmt: (skip|off)", line)
        ]
        found.without_code += [f"{path}:{line}: {name}" for line, name in bare_calls(tree)]
        if package == "cosim":
            found.texts_of_example += [
                f"{path}:{node.lineno}: {node.value}"
                for node in nodes
                if isinstance(node, ast.Constant) and isinstance(node.value, str) and module_path.fullmatch(node.value)
                if not node.value.endswith((".fmu", ".ssp", ".yaml", ".py"))
            ]
    return found


def test_no_function_is_compressed(read: Read) -> None:
    assert read.compressed == []
    assert read.formatted_by_hand == []


def test_the_framework_names_no_module_of_the_example_in_a_text(read: Read) -> None:
    assert read.texts_of_example == []


def test_no_text_without_a_code_becomes_a_message(read: Read) -> None:
    assert read.without_code == []


@pytest.mark.parametrize("package", ENGLISH)
def test_docstrings_begin_with_a_short_complete_sentence(package: str, read: Read) -> None:
    fragments, pronouns, median = measure(read.docstrings[package])
    assert fragments <= 0.02
    assert pronouns <= 0.03
    assert median <= 9


def test_the_names_of_the_craft_stand_in_its_own_rooms_alone() -> None:
    found = [
        f"{path}:{number}: {line.strip()}"
        for path in sources()
        if not path.as_posix().startswith(EXAMPLE_ROOMS)
        for number, line in enumerate((ROOT / path).read_text(encoding="utf-8").splitlines(), 1)
        if NAMES.search(line)
    ]
    assert found == []


def test_the_page_of_the_architecture_shows_the_floors_that_are_enforced() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (layers,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    enforced = [{room.strip() for room in layer.split("|")} for layer in layers if layer != "__main__"]
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (`[^|]*) \|", page, re.MULTILINE)
    assert [set(re.findall(r"`(\w+)`", rooms)) for _, rooms in rows] == enforced
    assert [int(floor) for floor, _ in rows] == list(range(len(rows), 0, -1))


def test_every_path_that_the_page_of_the_house_names_is_there() -> None:
    for document in ("docs/architecture.md", "CONTRIBUTING.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        for path in re.findall(r"`((?:plant|controller|fmus|cosim|tests|docs|scenarios|examples)/[\w/.]*)`", text):
            assert (ROOT / path).exists(), f"{document}: {path}"


def test_no_module_imports_in_a_circle() -> None:
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph(*PACKAGES)
    seen: dict[str, int] = {}

    def circle(module: str, path: tuple[str, ...]) -> tuple[str, ...]:
        if seen.get(module) == 1:
            return (*path[path.index(module) :], module)
        if module in seen:
            return ()
        seen[module] = 1
        for imported in sorted(graph.find_modules_directly_imported_by(module)):
            if found := circle(imported, (*path, module)):
                return found
        seen[module] = 2
        return ()

    for module in sorted(graph.modules):
        assert circle(module, ()) == ()


def test_files_that_are_made_are_not_committed() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    assert not [name for name in listed if name.endswith((".fmu", ".so", ".pyc", ".parquet"))]
