"""FMUs in one process: no build sees another's modules, the host's, or leaves its own behind."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from cosim.fmi.fmu_build import build
from fmus.recipes import plant_recipe
from tests.hosts_fmpy import Instance
from tests.misbehaving import misbehaving_fmu
from tests.sources import copied_sources

ROOT = Path(__file__).resolve().parent.parent
STEP = 0.02  # [s]
MOVING = {"vx_start": 0.3, "psi_dot_start": 0.5}
INPUTS = {"tilt_right": 0.1, "tilt_left": -0.05, "duty_right": 6.5}


def run(fmu: Path, values: dict[str, Any] | None = None, steps: int = 20) -> list[dict[str, float]]:
    with Instance(fmu) as plant:
        plant.initialize({**MOVING, **(values or {})})
        return [plant.step(STEP * k, STEP, INPUTS) for k in range(steps)]


def alternately(*fmus: Path, steps: int = 20) -> list[list[dict[str, float]]]:
    """The FMUs at once, step by step in turn."""
    instances = [Instance(fmu) for fmu in fmus]
    try:
        for instance in instances:
            instance.initialize(MOVING)
        turns = [[i.step(STEP * k, STEP, INPUTS) for i in instances] for k in range(steps)]
    finally:
        for instance in instances:
            instance.fmu.freeInstance()
    return [list(column) for column in zip(*turns, strict=True)]


def in_a_process_of_its_own(code: str, *arguments: object) -> Any:
    """What a fresh Python prints as JSON."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, (done.returncode, done.stderr)
    return json.loads(done.stdout)


def test_two_builds_of_other_sources_keep_their_own(
    plant_fmu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = copied_sources(tmp_path, monkeypatch) / "plant" / "powertrain.py"
    text = source.read_text(encoding="utf-8")
    changed = text.replace("return thrust * m.sin(alpha)", "return 2.0 * thrust * m.sin(alpha)")
    assert changed != text
    source.write_text(changed, encoding="utf-8")
    strong_fmu = build(plant_recipe(), tmp_path / "strong.fmu")
    for order in ((plant_fmu, strong_fmu), (strong_fmu, plant_fmu)):
        rows = dict(zip(order, alternately(*order), strict=True))
        assert rows[plant_fmu] == run(plant_fmu)
        weak, strong = (rows[fmu][-1] for fmu in (plant_fmu, strong_fmu))
        # a_x + (c/m)·vx is F_x/m alone, which the other source doubles; the tilts are the same in both
        pull = [row["ax"] + 0.25 / 0.705 * row["vx"] for row in (weak, strong)]
        assert strong["tilt_right_actual"] == weak["tilt_right_actual"]
        # thrust differs with roll only, a hundredth or less over 0.4 s
        assert pull[1] == pytest.approx(2 * pull[0], rel=0.02)


POISONED = """
import json, sys, types
from pathlib import Path
from tests.hosts_fmpy import Instance

class Poison(types.ModuleType):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        raise RuntimeError(f"{self.__name__}.{name} was touched")

names = ("plant", "plant.hovercraft", "controller.loop", "fmus", "cosim", "cosim.model", "cosim.fmi.slave")
poison = {n: Poison(n) for n in names}
sys.modules.update(poison)
rows = []
with Instance(Path(sys.argv[1])) as plant, Instance(Path(sys.argv[2])) as controller:
    plant.initialize({"vx_start": 0.3, "psi_dot_start": 0.5})
    controller.initialize({"x_ref": 0.1})
    for k in range(20):
        rows.append(plant.step(0.02 * k, 0.02, {"tilt_right": 0.1, "tilt_left": -0.05, "duty_right": 6.5}))
        controller.step(0.02 * k, 0.02, {"ax": 0.1})
assert all(sys.modules[n] is m for n, m in poison.items())
assert not [n for n in sys.modules if n.startswith(("plant.", "controller.", "fmus.")) and n not in poison]
print(json.dumps(rows))
"""


@pytest.mark.thorough
def test_a_hosts_own_modules_of_our_names_neither_harm_nor_are_harmed(plant_fmu: Path, controller_fmu: Path) -> None:
    assert in_a_process_of_its_own(POISONED, plant_fmu, controller_fmu) == run(plant_fmu)


def test_a_host_that_changes_its_copy_of_our_physics_changes_no_fmu(
    plant_fmu: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import plant.hovercraft

    before = run(plant_fmu)
    monkeypatch.setattr(plant.hovercraft, "thrust_vector", lambda m, thrust, alpha: (0.0, 0.0))
    monkeypatch.setattr(plant.hovercraft.Hovercraft, "substep", 0.02)
    assert run(plant_fmu) == before


CYCLES = """
import gc, json, sys
from pathlib import Path
from tests.hosts_fmpy import Instance
seen = set()
for k in range(300):
    for path in sys.argv[1:]:
        with Instance(Path(path)) as instance:
            instance.initialize()
            seen.add(repr(instance.step(0.0, 0.02)))
    if k % 50 == 0:
        gc.collect()
gc.collect()
print(json.dumps(len(seen)))
"""


@pytest.mark.thorough
def test_three_hundred_instances_come_and_go(plant_fmu: Path, controller_fmu: Path) -> None:
    # pythonfmu 0.7.0 gives back a reference it does not own at every instantiation; unbalanced, the host crashes
    assert in_a_process_of_its_own(CYCLES, plant_fmu, controller_fmu) == 2  # each FMU does the same every time


FOREIGN = """
import atexit, ctypes, json, sys
from pathlib import Path
from cosim.core.scratch import process_folder
from cosim.fmi.description import read_description
from cosim.blocks.fmu import FmuBlock
at_exit, register = [], atexit.register
atexit.register = lambda function: at_exit.append(register(function))
path = Path(sys.argv[1])
for _ in range(2):
    block = FmuBlock("foreign", path, read_description(path), {}, frozenset())
    block.bind((ctypes.c_double * 3)(), 0)
    block.open(0.0, 1.0)
    block.close()
names = [f.__name__ for f in at_exit if getattr(f, "__name__", "") == "finalizePythonInterpreter"]
print(json.dumps([names, [path.name for path in process_folder().glob("fmu-*")]]))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the library of Linux alone has this fault")
def test_cosim_keeps_it_in_balance_for_an_fmu_that_does_not(tmp_path: Path) -> None:
    fmu = misbehaving_fmu(tmp_path, "Behaves")
    let_go, folders = in_a_process_of_its_own(FOREIGN, fmu)
    assert let_go == ["finalizePythonInterpreter"] * 2  # a library an extraction
    assert folders == []
