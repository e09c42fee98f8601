"""Python files named in other files are not executed by inspecting commands, and only in a worker by `check` and
`run`."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import pytest

from cosim.authoring.export import export_ssp
from cosim.core.errors import InputError
from cosim.sweeps.workflow import sweep as run_sweep
from cosim.verbs.checks import check as check_files
from cosim.verbs.checks import graph_of
from tests.compiled import rewritten
from tests.conftest import ROOT
from tests.logs import times, write_log

EVIL = """import os
from pathlib import Path
Path(__file__).with_name("executed").write_text(str(os.getpid()))
{deed}
from plant.hovercraft import Hovercraft
class Craft(Hovercraft):
    pass
"""
LOGS = "{estimation: [log.csv]}"
PROTOCOL = (ROOT / "examples" / "bench" / "protocol.yaml").read_text(encoding="utf-8")
FILES = {  # all name evil.py
    "model.yaml": "model: evil.py:Craft\nparameters: {mass: 2.0}\n",
    "indirect.yaml": "model: hovercraft\nparameters_from: model.yaml\nparameters: {}\n",
    "study.yaml": f"model: evil.py:Craft\nlogs: {LOGS}\n",
    "indirect_study.yaml": f"model: model.yaml\nlogs: {LOGS}\n",
    "craft.yaml": "name: craft\nmodel: evil.py:Craft\nrest: {files: [log.csv], window: [0, 1]}\n",
    "protocol.yaml": re.sub(r"^model:.*$", "model: evil.py:Craft", PROTOCOL, flags=re.M),
}


@pytest.fixture
def folder(tmp_path: Path, plant_fmu: Path, controller_fmu: Path) -> Path:
    for fmu in (plant_fmu, controller_fmu):
        shutil.copy(fmu, tmp_path / fmu.name)
    for name, text in {**FILES, "evil.py": EVIL.format(deed="")}.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    time = times(2.0)
    write_log(tmp_path / "log.csv", {"time": time, "duty_right": 0 * time + 45})
    return tmp_path


@pytest.mark.parametrize("name", ["evil.py", "evil.py:Craft", *FILES])
def test_a_check_without_loading_executes_nothing_and_says_so(folder: Path, name: str) -> None:
    assert check_files(folder / name, load=False)
    # the model of a log is a file too
    assert check_files(folder / "log.csv", f"{folder / 'evil.py'}:Craft", load=False)
    assert not (folder / "executed").exists()


@pytest.mark.parametrize("name", ["model.yaml", "study.yaml"])
def test_a_check_executes_in_a_worker_and_tells_its_end(folder: Path, name: str) -> None:
    (folder / "evil.py").write_text(EVIL.format(deed="os._exit(0)"))
    with pytest.raises(InputError, match=r"evil.py: does not load: its Python ended the process, exit code 0"):
        check_files(folder / name)
    assert (folder / "executed").read_text() != str(os.getpid())


def test_faults_are_told_though_the_model_is_not_executed(folder: Path) -> None:
    (folder / "study.yaml").write_text(FILES["study.yaml"] + "nonsense: 1\n")
    with pytest.raises(InputError, match="nonsense"):
        check_files(folder / "study.yaml", load=False)
    (folder / "evil.py").write_text("def (:\n")
    with pytest.raises(InputError, match=r"evil.py:1:\d+: does not load: SyntaxError"):
        check_files(folder / "evil.py", load=False)
    assert not (folder / "executed").exists()


def noting(fmu: Path, target: Path, marker: Path) -> None:
    """Write an FMU whose Python notes its process in a file."""
    note = f"import os\nwith open({str(marker)!r}, 'a') as stream:\n    stream.write(f'{{os.getpid()}}\\n')\n"

    def change(name: str, data: bytes) -> bytes:
        head, future, rest = data.rpartition(b"from __future__ import annotations\n")
        return head + future + note.encode() + rest if name.endswith(".py") else data

    rewritten(fmu, target, change)


def test_an_ssp_executes_nothing_without_loading(folder: Path) -> None:
    """The only Python of an SSP is that in its FMUs."""
    text = (ROOT / "scenarios" / "manoeuvre.yaml").read_text(encoding="utf-8").replace("../build/", "")
    (folder / "scenario.yaml").write_text(text, encoding="utf-8")
    made = export_ssp(folder / "scenario.yaml", folder / "a.ssp").path

    def with_evil(name: str, data: bytes) -> bytes:
        if not name.endswith(".fmu"):
            return data
        (folder / "draft.fmu").write_bytes(data)
        noting(folder / "draft.fmu", folder / "evil.fmu", folder / "executed")
        return (folder / "evil.fmu").read_bytes()

    rewritten(made, folder / "b.ssp", with_evil)
    check_files(folder / "b.ssp", load=False)
    graph_of(folder / "b.ssp")
    assert not (folder / "executed").exists()


@pytest.mark.fresh
def test_a_sweep_executes_the_python_of_an_fmu_in_workers_alone(tmp_path: Path, plant_fmu: Path) -> None:
    noting(plant_fmu, tmp_path / "plant.fmu", tmp_path / "executed")
    scenario = {"name": "one", "duration": 0.2, "step": 0.02, "components": {"plant": {"fmu": "plant.fmu"}}}
    (tmp_path / "scenario.json").write_text(json.dumps(scenario))
    (tmp_path / "sweep.yaml").write_text("scenario: scenario.json\nvary: {plant.mass: {values: [1, 2]}}\n")
    made = run_sweep(tmp_path / "sweep.yaml", tmp_path / "out", workers=1, report=False)
    assert made.record["failed"] == 0
    pids = set((tmp_path / "executed").read_text().split())
    assert pids
    assert str(os.getpid()) not in pids
