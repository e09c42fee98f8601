"""The verbs as functions of Python, and the JSON schemas and terminal manners beside them."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.files.yaml_file import YamlFile
from cosim.residuals.replay_signals import Replay
from cosim.simulation.run_signals import Run, Signals
from tests.conftest import ROOT
from tests.logs import write_log
from tests.test_first_steps import told
from tests.typed import typed_fmu

SCHEMAS = ROOT / "docs" / "schemas"
SNIPPETS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(encoding="utf-8"), re.DOTALL)
FILES = [*(ROOT / "scenarios").glob("*.yaml"), *(ROOT / "examples").glob("*/*.yaml")]
FILES += [p for p in (ROOT / "examples/bench/overshoot").glob("*.yaml") if p.stem != "study"]


@pytest.mark.thorough
@pytest.mark.parametrize("snippet", SNIPPETS, ids=range(len(SNIPPETS)))
def test_a_snippet_of_the_page_on_python_runs(project: Path, monkeypatch: pytest.MonkeyPatch, snippet: str) -> None:
    monkeypatch.chdir(project)
    exec(snippet, {})


def test_import_cosim_loads_no_library() -> None:
    code = "import sys, cosim; print([m for m in ('numpy', 'pydantic', 'fmpy', 'typer', 'rich') if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


def turning(folder: Path, **more: object) -> dict[str, object]:
    component = {"fmu": str(typed_fmu(folder)), "start": {"r_in": 2}}
    return {"name": "turning", "duration": 0.5, "step": 0.1, "components": {"a": component}, **more}


def test_a_mapping_runs_and_leaves_nothing_without_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    criteria = {"peak": {"of": "a.r_out", "after": 0.2, "max": 1}}
    made = cosim.run(turning(tmp_path, criteria=criteria), in_process=True, set={"duration": np.float64(0.4)})
    assert (made.time[-1], made.folder) == (pytest.approx(0.4), None)
    assert not [*Path().iterdir()]
    assert len(made.missed) == 1  # no error
    for shown in (repr(made), made._repr_html_()):
        assert "MISSED: peak of a.r_out after 0.2 s is 2, at most 1 allowed" in shown
    assert [line.get_label() for ax in made.plot("a.r_out").axes for line in ax.lines] == ["a.r_out"]
    with pytest.raises(KeyError, match="did you mean"):
        made.plot("a.r_outt")
    if importlib.util.find_spec("pandas") is None:
        with pytest.raises(ImportError, match="to_pandas needs pandas: pip install pandas"):
            made.to_pandas()
        return
    frame = made.to_pandas()
    assert (frame.index.name, frame["a.r_out"].iloc[-1]) == ("time", 2)


def test_faults_of_a_mapping_are_told_without_a_file_that_is_gone(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        cosim.run(turning(tmp_path, sed=1, step=0.3))
    assert len(refused.value.faults) == 2
    assert all(line.startswith("scenario: ") for line in str(refused.value).splitlines())
    with pytest.raises(InputError, match=r"^scenario: "):
        cosim.run({"name": object()})


def test_what_was_left_is_read_as_what_it_is(tmp_path: Path) -> None:
    made = cosim.run(turning(tmp_path), tmp_path / "out", report=False, in_process=True)
    read = cosim.read(tmp_path / "out")
    assert isinstance(read, Run)
    assert read.units == {name: unit for name, unit in made.units.items() if unit}
    np.testing.assert_array_equal(read["a.r_out"], made["a.r_out"])
    (tmp_path / "x.csv").write_text("time,x [m]\n0,0\n1,2\n")
    signals = cosim.read(tmp_path / "x.csv")
    assert isinstance(signals, Signals)
    assert signals.units["x"] == "m"


def test_a_replay_has_its_residual_and_is_read_back(tmp_path: Path) -> None:
    fmu, log, k = typed_fmu(tmp_path), tmp_path / "log.csv", np.arange(300.0)
    columns = {"time": k / 50, "r_in": k % 7, "i_in": 0 * k, "e_in": 0 * k + 1, "b_in": 0 * k, "r_out": k % 7}
    made = cosim.replay(write_log(log, columns), tmp_path / "out", fmu, report=False, in_process=True)
    assert made.residual is not None
    assert "free_run.r_out" in made.residual
    read = cosim.read(tmp_path / "out")
    assert isinstance(read, Replay)
    assert read.sentence == made.sentence
    for wrong, words in ({"nope": "r_out"}, 'has no column "nope"'), (["r_inn=r_in"], 'did you mean "r_in"'):
        with pytest.raises(InputError, match=words):
            cosim.replay(log, fmu=fmu, columns=wrong, in_process=True)
    with pytest.raises(InputError):  # the folder is taken
        cosim.replay(log, tmp_path / "out", fmu, in_process=True)


def test_what_is_set_is_a_mapping_or_texts(tmp_path: Path) -> None:
    for given in (["duration=0.2"], "duration=0.2"):
        assert cosim.run(turning(tmp_path), set=given, in_process=True).time[-1] == pytest.approx(0.2)
    for wrong in (5, [1]):
        with pytest.raises(InputError, match=r"^set: "):
            cosim.run(turning(tmp_path), set=wrong, in_process=True)
    linear = cosim.linearize("base", set={"friction": 0}, at={"phi": 0.01})
    assert linear.first.point.states.tolist().count(0.01) == 1


def test_the_runs_of_a_sweep_are_read_back(tmp_path: Path) -> None:
    parquet, arrow = (pytest.importorskip(name) for name in ("pyarrow.parquet", "pyarrow"))
    (tmp_path / "sweep.json").write_text('{"name": "sizes", "runs": 2}')
    parquet.write_table(arrow.table({"run": [0, 1], "mass": [1.0, 2.0]}), tmp_path / "sweep.parquet")
    read = cosim.read(tmp_path)
    assert repr(read) == f"sizes: 2 runs in {tmp_path}"
    if importlib.util.find_spec("pandas") is not None:
        assert read.to_pandas()["mass"].tolist() == [1, 2]


# -- schemas --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [p.name.partition(".")[0] for p in SCHEMAS.glob("*") if "linear" not in p.name])
def test_the_schema_that_is_shipped_is_the_one_that_is_printed(kind: str) -> None:
    shipped = (SCHEMAS / f"{kind}.schema.json").read_text(encoding="utf-8")
    assert told("schema", kind) == shipped, f"cosim schema {kind} > docs/schemas/{kind}.schema.json"


@pytest.mark.parametrize("path", FILES, ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_a_shipped_file_names_its_schema_and_keeps_it(path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    (named,) = re.findall(r"^# yaml-language-server: \$schema=(\S+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    schema = (path.parent / named).resolve()
    assert schema.parent == SCHEMAS
    validator = jsonschema.Draft202012Validator(json.loads(schema.read_text(encoding="utf-8")))
    content = YamlFile(path).root
    assert [e.message for e in validator.iter_errors(content)] == []
    assert [e.message for e in validator.iter_errors({**content, "nmae": 1})]


# -- manners of the terminal ----------------------------------------------------------------------


def test_files_in_a_setting_are_named_from_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("scenarios", "fmus"):
        (tmp_path / name).mkdir()
    fmu = typed_fmu(tmp_path / "fmus")
    content = {**turning(tmp_path), "components": {"a": {"fmu": "none.fmu"}}}
    (tmp_path / "scenarios" / "s.yaml").write_text(json.dumps(content))
    monkeypatch.chdir(tmp_path)
    for setting in ("components.a.fmu=fmus/typed.fmu", "components.a={fmu: fmus/typed.fmu}"):
        told("run", "--in-process", "scenarios/s.yaml", "--set", setting, "--out", "o", "--force", "--no-report")
        assert json.loads(Path("o/manifest.json").read_text())["fmus"]["a"]["path"] == str(fmu)
