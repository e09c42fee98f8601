"""The build: the same sources give the same bytes, and any other source another FMU."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from cosim.fmi.fmu_build import build
from fmus.recipes import controller_recipe, plant_recipe
from tests.cases import some
from tests.hosts_fmpy import Instance, description_of
from tests.sources import copied_sources

ROOT = Path(__file__).resolve().parent.parent
RECIPES = {"plant_fmu": plant_recipe, "controller_fmu": controller_recipe}
BOTH = pytest.mark.parametrize("which", list(RECIPES))


@pytest.fixture
def fmu(which: str, request: pytest.FixtureRequest) -> Path:
    path: Path = request.getfixturevalue(which)
    return path


def guid(path: Path) -> str:
    text: str = description_of(path).guid
    return text


@BOTH
def test_two_builds_are_the_same_bytes(which: str, fmu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert build(RECIPES[which](), Path("sub") / "again.fmu").read_bytes() == fmu.read_bytes()
    assert [p.name for p in (tmp_path / "sub").iterdir()] == ["again.fmu"]  # no draft is left behind


LATER = """
import sys, time
from pathlib import Path
import pythonfmu.fmi2slave as packer

class Later(packer.datetime.datetime):
    @classmethod
    def now(cls, tz=None):
        return cls(2040, 2, 29, 12, tzinfo=tz)

packer.datetime = type("datetime", (), {"datetime": Later, "timezone": packer.datetime.timezone})
then = time.gmtime(2.2e9)
time.localtime, time.time = (lambda *_: then), (lambda: 2.2e9)
from cosim.fmi.fmu_build import build
from fmus.recipes import controller_recipe, plant_recipe
build(plant_recipe(), Path(sys.argv[1]))
build(controller_recipe(), Path(sys.argv[2]))
"""


@pytest.mark.thorough
def test_another_process_in_another_year_builds_the_same_bytes(
    plant_fmu: Path, controller_fmu: Path, tmp_path: Path
) -> None:
    plant, controller = tmp_path / "plant.fmu", tmp_path / "controller.fmu"
    environment = {"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "12345", "TZ": "Pacific/Auckland", "PATH": ""}
    command = [sys.executable, "-c", LATER, str(plant), str(controller)]
    subprocess.run(command, check=True, cwd=tmp_path, env=environment)
    assert plant.read_bytes() == plant_fmu.read_bytes()
    assert controller.read_bytes() == controller_fmu.read_bytes()


@BOTH
def test_the_fmu_carries_sources_and_no_byte_code(fmu: Path) -> None:
    with zipfile.ZipFile(fmu) as archive:
        names = archive.namelist()
    assert not [n for n in names if "__pycache__" in n or n.endswith((".pyc", ".pyo"))]
    assert names == sorted(names)
    module = zipfile.ZipFile(fmu).read("resources/slavemodule.txt").decode().strip()
    assert f"resources/{module}.py" in names


# -- identity -----------------------------------------------------------------------------------


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the sources that the next builds are made of."""
    return copied_sources(tmp_path / "tree", monkeypatch)


def test_the_place_of_the_sources_does_not_matter(tree: Path, plant_fmu: Path, tmp_path: Path) -> None:
    assert build(plant_recipe(), tmp_path / "plant.fmu").read_bytes() == plant_fmu.read_bytes()


@pytest.mark.parametrize(
    ("which", "source"),
    some(
        [
            ("plant_fmu", "plant/effects.py"),
            ("plant_fmu", "plant/powertrain.py"),
            ("plant_fmu", "cosim/fmi/slave.py"),
            ("controller_fmu", "controller/loop.py"),
            ("controller_fmu", "fmus/controller_fmu.py"),
        ],
        every=2,
    ),
)
def test_one_byte_of_a_source_makes_another_fmu(which: str, source: str, tree: Path, fmu: Path, tmp_path: Path) -> None:
    with (tree / source).open("a") as stream:
        stream.write("#")
    other = build(RECIPES[which](), tmp_path / "other.fmu")
    assert guid(other) != guid(fmu)
    assert not packages(other) & packages(fmu)  # and its modules have names of their own


def packages(fmu: Path) -> set[str]:
    """Names the FMU's own modules begin with."""
    with zipfile.ZipFile(fmu) as archive:
        return {n.split("/")[1] for n in archive.namelist() if re.match(r"resources/hovercraft_\w+/", n)}


@pytest.mark.parametrize(
    "values",
    [{"coulomb_friction.force": 0.05}, {"mass": 0.7050000000000001}, {"roll_ground_effect": False}],
    ids=["effect", "last bit", "flag"],
)
def test_another_default_makes_another_fmu_that_starts_with_it(
    values: dict[str, Any], plant_fmu: Path, tmp_path: Path
) -> None:
    other = build(plant_recipe(values), tmp_path / "other.fmu")
    assert guid(other) != guid(plant_fmu)
    assert not packages(other) & packages(plant_fmu)
    start = {"vx_start": 0.3, "phi_start": 0.05}
    with Instance(other) as built, Instance(plant_fmu) as told:
        assert built.get(values) == list(values.values())
        assert built.initialize(start).outputs() == told.initialize({**start, **values}).outputs()
        inputs = {"tilt_right": 0.1, "duty_left": 6.5}
        for k in range(10):
            assert built.step(0.02 * k, 0.02, inputs) == told.step(0.02 * k, 0.02, inputs)
    declared = {v.name: v.start for v in description_of(other).modelVariables}
    assert [declared[n] for n in values] == [str(v).lower() for v in values.values()]


@pytest.mark.parametrize(
    ("values", "kind"),
    [({"mass": -1.0}, ValueError), ({"coulomb_friction.forze": 0.1}, KeyError), ({"wind.speed": 1.0}, KeyError)],
)
def test_a_default_that_cannot_be_is_refused_before_anything_is_built(
    values: dict[str, Any], kind: type[Exception]
) -> None:
    with pytest.raises(kind):
        plant_recipe(values)


def test_a_build_that_fails_leaves_the_old_fmu_in_place(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out" / "plant.fmu"
    target.parent.mkdir()
    target.write_bytes(b"old")
    (tree / "plant" / "powertrain.py").write_text("this is no Python\n")
    with pytest.raises(SyntaxError):
        build(plant_recipe(), target)
    assert [(p.name, p.read_bytes()) for p in target.parent.iterdir()] == [("plant.fmu", b"old")]
