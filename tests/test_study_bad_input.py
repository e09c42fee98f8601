"""What is wrong with a study is told all at once, each with its place and its cure, and nothing is written."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.core.errors import InputError
from cosim.refinement.study import read_study
from cosim.verbs.checks import check as check_files
from cosim.verbs.cli import command_line
from tests.cases import some
from tests.tank import MODEL, tank_log


@pytest.fixture(scope="module")
def tanks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The texts of a model and of two logs, 100 s and 60 s long."""
    folder = tmp_path_factory.mktemp("tanks")
    logs = {
        f"{name}.csv": tank_log(folder / name, seed, lasts) for seed, name, lasts in ((0, "a", 100.0), (1, "b", 60.0))
    }
    return {"tank.py": MODEL, **{name: path.read_text() for name, path in logs.items()}}


def told(folder: Path, files: dict[str, str], study: str) -> list[str]:
    """The faults of a study, as `cosim check`, `cosim refine` and Python all tell them."""
    for name, text in files.items():
        (folder / name).write_text(text)
    path = folder / "study.yaml"
    path.write_text(study)
    with pytest.raises(InputError) as refused:
        read_study(path)
    assert refused.value.exit_code == 2
    with pytest.raises(InputError) as checked:
        check_files(path)
    assert checked.value.faults == refused.value.faults
    done = CliRunner().invoke(command_line(), ["refine", str(path), "--out", str(folder / "out")])
    assert isinstance(done.exception, InputError)
    assert done.exception.faults == refused.value.faults
    assert not (folder / "out").exists()
    return [str(f).removeprefix(f"{folder}/").replace("\u00a0", " ") for f in refused.value.faults]


@pytest.mark.parametrize("value", some(["0", "30", "1e-300", ".nan", ".inf", "true", "ten", "[0.1]"], every=3))
def test_a_tolerance_that_is_absurd_is_told_in_one_line(tmp_path: Path, tanks: dict[str, str], value: str) -> None:
    study = f"model: tank.py:Tank\ntolerance: {value}\nlogs: {{estimation: [a.csv]}}\n"
    (line,) = told(tmp_path, tanks, study)
    assert line.startswith("study.yaml:2:12: tolerance is ")
    assert line.endswith("a tolerance is a share of the parameter, above 0 and at most 2: 0.1 for 10 %")


def test_a_unit_that_cannot_be_converted_is_told_of_every_log(tmp_path: Path, tanks: dict[str, str]) -> None:
    wrong = {name: text.replace("level", "level [kg]", 1) for name, text in tanks.items() if name.endswith(".csv")}
    wrong["b.csv"] = wrong["b.csv"].replace("inflow", "inflow [m/s]", 1)
    study = "model: tank.py:Tank\nlogs: {estimation: [a.csv], validation: [b.csv]}\n"
    faults = told(tmp_path, tanks | wrong, study)
    assert [line.partition(" is no unit")[0] for line in faults] == [
        'a.csv:1:3: "kg"', 'b.csv:1:2: "m/s"', 'b.csv:1:3: "kg"',
    ]  # fmt: skip
    assert " is no unit of level, which is in m; known here: m, mm, cm, km" in faults[0]


def test_logs_that_hold_different_inputs_are_told_which_is_missing_where(tmp_path: Path, tanks: dict[str, str]) -> None:
    without = "\n".join(",".join(line.split(",")[::2]) for line in tanks["b.csv"].splitlines())
    strange = tanks["a.csv"].replace("inflow", "inflw", 1)
    study = "model: tank.py:Tank\nlogs: {estimation: [a.csv, c.csv], validation: [b.csv]}\n"
    assert told(tmp_path, tanks | {"b.csv": without, "c.csv": strange}, study) == [
        'b.csv:1:1: input "inflow" is missing; a log holds every input of the model: inflow; '
        "for a column of another name say --column COLUMN=inflow, or `columns` in a study",
        'c.csv:1:2: "inflw" is no column of the model; did you mean "inflow", which is missing? '
        "A log holds every input of the model: inflow",
    ]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("logs", "line"),
    [
        (
            "{validation: [a.csv, b.csv]}",
            "study.yaml:2:1: every log is sealed, and none is left to learn from; move on",
        ),
        ("{estimation: [], validation: [a.csv]}", "study.yaml:2:20: every log is sealed, and none is left to learn"),
        ("{estimation: []}", "study.yaml:2:20: no log is listed; list one"),
    ],
)
def test_a_study_of_which_every_log_is_sealed_has_nothing_to_learn_from(
    tmp_path: Path, tanks: dict[str, str], logs: str, line: str
) -> None:
    first, second = told(tmp_path, tanks, f"model: tank.py:Tank\nlogs: {logs}\ncandidates: [leek]\n")
    assert first.startswith(line)
    assert second.startswith('study.yaml:3:14: no candidate "leek"')


def test_a_key_that_nobody_knows_and_a_log_that_is_not_there_hide_no_other_fault(
    tmp_path: Path, tanks: dict[str, str]
) -> None:
    study = (
        "model: tank.py:Tank\nlogs: {estimation: [a.csv, none.csv]}\nnois: {level: 1}\n"
        "tolerance: {colour: 0.1}\ncandidates: [leek]\n"
    )
    lines = told(tmp_path, tanks, study)
    assert [line.split(":")[1:3] for line in lines] == [["2", "28"], ["3", "1"], ["4", "13"], ["5", "14"]]
    assert lines[0].endswith("none.csv: no such file beside the study; its logs are named from there")


def test_a_model_without_states_is_refused_at_its_line(tmp_path: Path) -> None:
    model = (
        "from cosim.model import Equations, Model, Quantity\n\n\nclass Valve(Model):\n"
        '    base_states, inputs, outputs = (), (Quantity("u", "1", "u"),), (Quantity("y", "1", "y"),)\n\n'
        "    def equations(self, m):\n        return Equations(lambda t, x, u: (), lambda t, x, u: (u[0],))\n"
    )
    log = "time,u,y\n" + "".join(f"{0.1 * k},{k},{k}\n" for k in range(200))
    files = {"valve.py": model, "a.csv": log}
    (said,) = told(tmp_path, files, "model: valve.py:Valve\nlogs:\n  estimation: [a.csv]\n")
    assert said.startswith("study.yaml:1:")
