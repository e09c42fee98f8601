"""What a file names as Python is executed by nobody who only looks, and in a worker by `check` and `run`."""

from __future__ import annotations

import json
import os
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.fmi.building.file import load_model, without_execution
from cosim.sweeps.workflow import sweep as run_sweep
from cosim.verbs.checks import check as check_files
from cosim.verbs.checks import graph_of
from tests.conftest import ROOT
from tests.logs import write_log

EVIL = """import os
from pathlib import Path
Path(__file__).with_name("executed").write_text(str(os.getpid()))
{deed}
from plant.hovercraft import Hovercraft
class Craft(Hovercraft):
    pass
"""
Named = Callable[[Path], "Path | str"]  # makes a file that names evil.py, in a folder


def model_file(folder: Path, parameters: str = "{}") -> Path:
    (folder / "model.yaml").write_text(f"model: evil.py:Craft\nparameters: {parameters}\n")
    return folder / "model.yaml"


def indirect_model(folder: Path) -> Path:
    model_file(folder, "{mass: 2.0}")
    (folder / "indirect.yaml").write_text("model: hovercraft\nparameters_from: model.yaml\nparameters: {}\n")
    return folder / "indirect.yaml"


def study(folder: Path) -> Path:
    time = 0.02 * np.arange(100)
    write_log(folder / "log.csv", {"time": time, "duty_right": 0 * time + 45})
    (folder / "study.yaml").write_text("model: evil.py:Craft\nlogs: {estimation: [log.csv]}\n")
    return folder / "study.yaml"


def study_of_a_model_file(folder: Path) -> Path:
    path = study(folder)
    model_file(folder)
    path.write_text(path.read_text().replace("evil.py:Craft", "model.yaml"))
    return path


def craft_logs(folder: Path) -> Path:
    study(folder)
    (folder / "craft.yaml").write_text("name: craft\nmodel: evil.py:Craft\nrest: {files: [log.csv], window: [0, 1]}\n")
    return folder / "craft.yaml"


def protocol(folder: Path) -> Path:
    text = (ROOT / "examples" / "bench" / "protocol.yaml").read_text(encoding="utf-8")
    changed = re.sub(r"^model:.*$", "model: evil.py:Craft", text, flags=re.M)
    assert changed != text
    (folder / "protocol.yaml").write_text(changed, encoding="utf-8")
    return folder / "protocol.yaml"


NAMED: dict[str, Named] = {
    "python": lambda folder: folder / "evil.py",
    "class": lambda folder: folder / "evil.py:Craft",
    "model": model_file, "parameters_from": indirect_model,
    "study": study, "study of a model file": study_of_a_model_file, "logs of a craft": craft_logs,
    "protocol": protocol,
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, plant_fmu: Path, controller_fmu: Path) -> Path:
    for fmu in (plant_fmu, controller_fmu):
        shutil.copy(fmu, tmp_path / fmu.name)
    (tmp_path / "evil.py").write_text(EVIL.format(deed=""))
    return tmp_path


@pytest.mark.parametrize("name", NAMED)
def test_a_check_without_loading_executes_nothing_and_says_so(folder: Path, name: str) -> None:
    path = Path(NAMED[name](folder))
    assert check_files(path, load=False)
    assert not (folder / "executed").exists()


@pytest.mark.parametrize("name", ["model", "study"])
def test_a_check_executes_in_a_worker_and_tells_its_end(folder: Path, name: str) -> None:
    path = Path(NAMED[name](folder))
    (folder / "evil.py").write_text(EVIL.format(deed="os._exit(0)"))
    with pytest.raises(InputError, match=r"evil.py: does not load: its Python ended the process, exit code 0") as told:
        check_files(path)
    assert told.value.exit_code == 2
    assert (folder / "executed").read_text() != str(os.getpid())


def test_the_model_of_a_log_is_a_file_too(folder: Path) -> None:
    study(folder)
    assert check_files(folder / "log.csv", f"{folder / 'evil.py'}:Craft", load=False)
    assert not (folder / "executed").exists()


@pytest.mark.thorough
def test_a_check_that_executes_says_what_it_did_before(folder: Path) -> None:
    """The faults of a study are those of the command's own process; a sound model is no fault."""
    assert check_files(model_file(folder)) == []
    assert (folder / "executed").read_text() != str(os.getpid())
    with pytest.raises(InputError, match='has no parameter "masss"'):
        check_files(model_file(folder, "{masss: 1}"))


def test_faults_are_told_though_the_model_is_not_executed(folder: Path) -> None:
    path = study(folder)
    path.write_text(path.read_text() + "nonsense: 1\n")
    with pytest.raises(InputError, match="nonsense"):
        check_files(path, load=False)
    (folder / "evil.py").write_text("def (:\n")
    with pytest.raises(InputError, match=r"evil.py:1:\d+: does not load: SyntaxError"):
        check_files(folder / "evil.py", load=False)
    assert not (folder / "executed").exists()


def test_an_ssp_executes_nothing_without_loading(folder: Path, plant_fmu: Path) -> None:
    """The only Python of an SSP is that in its FMUs."""
    from cosim.authoring.export import export_ssp

    text = (ROOT / "scenarios" / "manoeuvre.yaml").read_text(encoding="utf-8").replace("../build/", "")
    (folder / "scenario.yaml").write_text(text, encoding="utf-8")
    made = export_ssp(folder / "scenario.yaml", folder / "a.ssp").path
    marker = folder / "executed"
    with zipfile.ZipFile(made) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for name in [n for n in members if n.endswith(".fmu")]:
        members[name] = _with_evil(members[name], folder, marker)
    with zipfile.ZipFile(folder / "b.ssp", "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    check_files(folder / "b.ssp", load=False)
    graph_of(folder / "b.ssp")
    assert not marker.exists()


def _with_evil(fmu: bytes, folder: Path, marker: Path) -> bytes:
    draft = folder / "draft.fmu"
    draft.write_bytes(fmu)
    with zipfile.ZipFile(draft) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    text = f"open({json.dumps(str(marker))}, 'w')\n".encode()
    members = {n: text if n.endswith(".py") else data for n, data in members.items()}
    with zipfile.ZipFile(draft, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return draft.read_bytes()


def test_nothing_is_executed_within_the_guard(folder: Path) -> None:
    with without_execution(), pytest.raises(Exception, match=r"evil.py is Python, which is not executed here"):
        load_model(str(model_file(folder)), Path())
    assert not (folder / "executed").exists()
    load_model(str(model_file(folder)), Path())
    assert (folder / "executed").exists()


@pytest.mark.fresh
def test_a_sweep_executes_the_python_of_an_fmu_in_workers_alone(tmp_path: Path, plant_fmu: Path) -> None:
    marker = tmp_path / "executed"
    with zipfile.ZipFile(plant_fmu) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    script = f"resources/{members['resources/slavemodule.txt'].decode().strip()}.py"
    head, future, rest = members[script].decode().rpartition("from __future__ import annotations\n")
    note = f"import os\nwith open({str(marker)!r}, 'a') as stream:\n    stream.write(f'{{os.getpid()}}\\n')\n"
    members[script] = f"{head}{future}{note}{rest}".encode()
    with zipfile.ZipFile(tmp_path / "plant.fmu", "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    scenario = {"name": "one", "duration": 0.2, "step": 0.02, "components": {"plant": {"fmu": "plant.fmu"}}}
    (tmp_path / "scenario.json").write_text(json.dumps(scenario))
    (tmp_path / "sweep.yaml").write_text("scenario: scenario.json\nvary: {plant.mass: {values: [1, 2]}}\n")
    made = run_sweep(tmp_path / "sweep.yaml", tmp_path / "out", workers=1, report=False)
    assert made.record["failed"] == 0
    pids = set(marker.read_text().split())
    assert pids
    assert str(os.getpid()) not in pids
