"""The layout of the project: names of the public functions, floors, circles, files of the repository."""

from __future__ import annotations

import importlib
import re
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

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
    assert cosim.check(str(plant)) == cosim.check([plant]) == []
    cosim.replay("v1.csv", "replayed", "built/plant.fmu")
    Path("run.yaml").write_text(
        "name: drive\nduration: 1\nstep: 0.01\ncomponents: {drive: {fmu: built/plant.fmu, start: {force: 20}}}\n"
    )
    cosim.run("run.yaml", "ran")
    assert {path.parent.name for path in Path().glob("*/report.html")} == {"replayed", "ran"}


def test_what_the_package_does_not_have_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="levitate"):
        importlib.import_module("cosim").levitate  # noqa: B018


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
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True)
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
