"""`record: {every, signals}`: a part of signals and rows, in every loop and format, with criteria and resumed runs."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.errors import InputError
from cosim.simulation.workflow import run
from tests.test_resume import check_equal, stopped
from tests.typed import typed_fmu
from tests.walker import walker_scenario

PART = 'record={every: 50 ms, signals: ["saving.*", "other.*"]}'
CHECKPOINT = shutil.ignore_patterns("checkpoint")
REFERENCES = """name: s
duration: 1
step: {step}
record: {record}
components:
  ref:
    block: reference
    signals: {{x: {{start: 0, unit: m, changes: [{{at: 0.33, to: 5}}, {{at: 0.37, to: 1}}]}}, y: {{start: 2}}}}
  more: {{block: reference, signals: {{x: {{start: 3}}}}}}
criteria: {{peak: {{of: {of}, max: 4}}}}
"""


def _file(
    folder: Path, record: str = "{every: 0.1 s, signals: [ref.x]}", of: str = "ref.x", step: str = "0.01"
) -> Path:
    path = folder / "s.yaml"
    path.write_text(REFERENCES.format(record=record, of=of, step=step), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, Any]:
    """A scenario with its run in all rows and in a part of them."""
    folder = tmp_path_factory.mktemp("walk")
    scenario = walker_scenario(folder, pause=1000.0, checkpoint="20 s")
    whole = run(scenario, folder / "whole", ['record=["*"]', "checkpoint=null"], report=False)
    part = run(scenario, folder / "part", [PART], report=False)
    assert part.results.loop == whole.results.loop == "C"
    return scenario, whole, part


def test_a_part_has_the_values_of_all_rows_and_nothing_else(walk: tuple[Path, Any, Any]) -> None:
    _, whole, part = walk
    assert part.results.time.tolist() == whole.results.time[::5].tolist()
    assert {*part.results.columns} < {*whole.results.columns}
    assert "saving.kicks" in part.results.columns  # a local variable
    assert not any(name.startswith(("three", "reference", "recording")) for name in part.results.columns)
    for name in part.results.columns:
        assert np.array_equal(part.results[name], whole.results[name][::5], equal_nan=True)
    assert {name: list(v) for name, v in part.results.exact.items()} == {
        name: list(v)[::5] for name, v in whole.results.exact.items() if name in part.results.exact
    }
    read: Any = cosim.read(part.folder)
    assert read.results.columns == part.results.columns
    assert {*part.manifest["units"]} <= {*part.results.columns, *part.results.exact}


def test_a_stopped_run_goes_on_to_the_same_bytes(walk: tuple[Path, Any, Any], tmp_path: Path) -> None:
    scenario, _, part = walk
    again = stopped(scenario, tmp_path / "again", [PART])
    assert (again / "checkpoint" / "rows").is_file()
    plain = shutil.copytree(again, tmp_path / "plain", ignore=CHECKPOINT)  # as without the key
    for folder, note in ((again, "continues from"), (plain, "the run is repeated from t = 0 s")):
        said: list[str] = []
        run(folder, resume=True, report=False, tell=said.append)
        assert note in said[0]
        check_equal(folder, part.folder)
        with pytest.raises(InputError, match="its run is finished"):
            run(folder, resume=True)


def test_a_finished_run_is_extended_with_and_without_all_rows(tmp_path: Path) -> None:
    scenario = walker_scenario(tmp_path, checkpoint="20 s")
    run(scenario, tmp_path / "longer", [PART, "duration=0.8"], report=False)
    run(scenario, tmp_path / "short", [PART, "duration=0.7"], report=False)
    shutil.copytree(tmp_path / "short", tmp_path / "plain", ignore=CHECKPOINT)
    for name in ("short", "plain"):
        run(tmp_path / name, until=0.8, report=False)
        assert (tmp_path / name / "results.csv").read_bytes() == (tmp_path / "longer" / "results.csv").read_bytes()


@pytest.mark.parametrize(
    ("format_", "in_process"), [("csv", False), ("csv", True), ("parquet", False), ("mat", False), ("hdf5", False)]
)
def test_every_format_has_the_part(tmp_path: Path, format_: str, in_process: bool) -> None:
    pytest.importorskip({"parquet": "pyarrow", "hdf5": "h5py"}.get(format_, "scipy"))
    ran = cosim.run(_file(tmp_path), tmp_path / "out", format=format_, report=False, in_process=in_process)
    read: Any = cosim.read(tmp_path / "out")
    assert read.results.columns == ("ref.x",)
    assert read.time == pytest.approx(np.linspace(0, 1, 11))
    assert read.results.values.tobytes() == ran.results.values.tobytes()


@pytest.mark.parametrize(("step", "loop"), [("0.01", "C"), ("{max: 0.01, min: 0.001}", "Python: steps are controlled")])
def test_criteria_are_judged_by_all_rows(tmp_path: Path, step: str, loop: str) -> None:
    """The peak of 5 m lies between two recorded rows."""
    ran = cosim.run(_file(tmp_path, step=step), tmp_path / "out")
    assert ran.manifest["loop"] == loop
    assert ran.results["ref.x"].max() == 1.0
    assert (ran.criteria[0]["value"], ran.criteria[0]["met"]) == (5.0, False)
    compared = cosim.compare(cosim.run(_file(tmp_path, "[]")), ran)
    assert compared.comparisons[0].only_a == ("ref.y", "more.x")


def test_the_last_row_is_recorded_also_between_two_multiples(tmp_path: Path) -> None:
    ran = cosim.run(_file(tmp_path, "{every: 0.3}"), report=False)
    assert ran.time == pytest.approx([0, 0.3, 0.6, 0.9, 1.0])
    assert ran.names == ("ref.x", "ref.y", "more.x")


@pytest.mark.parametrize(
    ("record", "of", "message"),
    [
        ("{every: 0.025}", "ref.x", ":4:17: 0.025 s"),
        ("{every: 20}", "ref.x", ":4:17: 20 s"),
        ("{every: -1}", "ref.x", ":4:17"),
        ("{signals: [ref.x, ref.z]}", "ref.x", ':4:27: no signal matches "ref.z"; did you mean "ref.y"?'),
        ("{signals: [rex.*]}", "more.x", 'no component "rex"; did you mean "ref"?'),
        ("{signals: []}", "ref.x", "record.signals is a list"),
        ("ref.x", "ref.x", ":4:9: record is 'ref.x'"),
        ("{signals: [more.x]}", "ref.x", "ref.x is not recorded"),
    ],
)
def test_a_fault_of_record_has_its_place_and_cure(tmp_path: Path, record: str, of: str, message: str) -> None:
    with pytest.raises(InputError) as refused:
        cosim.check(_file(tmp_path, record, of), load=False)
    assert message in str(refused.value)


def test_the_name_of_an_array_means_its_elements(tmp_path: Path) -> None:
    typed_fmu(tmp_path, 3)
    record = "record: {signals: [a.twice, 'a.a[2,1]']}"
    text = f"name: s\nduration: 1\nstep: 1\ncomponents: {{a: {{fmu: typed.fmu}}}}\n{record}\n"
    (tmp_path / "s.yaml").write_text(text)
    columns = cosim.run(tmp_path / "s.yaml", in_process=True).results.columns
    assert {*columns} == {"a.a[2,1]", *(f"a.twice[{k}]" for k in ("1,1", "1,2", "2,1", "2,2"))}
