"""Faults of a study are reported all at once, each with its place; a log may occur only once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cosim.core.errors import InputError
from cosim.files.yaml_file import REMOVED_KEYS
from cosim.refinement.study import read_study
from cosim.verbs.checks import check as check_files
from tests.tank import MODEL, tank_log
from tests.test_first_steps import invoked


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
    done = invoked("refine", path, "--out", folder / "out")
    assert isinstance(done.exception, InputError)
    assert done.exception.faults == checked.value.faults == refused.value.faults
    assert not (folder / "out").exists()
    return [str(f).removeprefix(f"{folder}/").replace("\u00a0", " ") for f in refused.value.faults]


@pytest.mark.parametrize("value", ["0", ".nan", "ten"])
def test_a_tolerance_that_is_absurd_is_told_in_one_line(tmp_path: Path, tanks: dict[str, str], value: str) -> None:
    study = f"model: tank.py:Tank\ntolerance: {value}\nlogs: {{estimation: [a.csv]}}\n"
    (line,) = told(tmp_path, tanks, study)
    assert line.startswith("study.yaml:2:12: tolerance is ")


def test_a_unit_that_cannot_be_converted_is_told_of_every_log(tmp_path: Path, tanks: dict[str, str]) -> None:
    wrong = {name: text.replace("level", "level [kg]", 1) for name, text in tanks.items() if name.endswith(".csv")}
    wrong["b.csv"] = wrong["b.csv"].replace("inflow", "inflow [m/s]", 1)
    study = "model: tank.py:Tank\nlogs: {estimation: [a.csv], validation: [b.csv]}\n"
    assert [(line.split(": ")[0], line.split('"')[1]) for line in told(tmp_path, tanks | wrong, study)] == [
        ("a.csv:1:3", "kg"), ("b.csv:1:2", "m/s"), ("b.csv:1:3", "kg"),
    ]  # fmt: skip


def test_logs_that_hold_different_inputs_are_told_which_is_missing_where(tmp_path: Path, tanks: dict[str, str]) -> None:
    without = "\n".join(",".join(line.split(",")[::2]) for line in tanks["b.csv"].splitlines())
    strange = tanks["a.csv"].replace("inflow", "inflw", 1)
    study = "model: tank.py:Tank\nlogs: {estimation: [a.csv, c.csv], validation: [b.csv]}\n"
    first, second = told(tmp_path, tanks | {"b.csv": without, "c.csv": strange}, study)
    assert first.startswith('b.csv:1:1: input "inflow" is missing')
    assert second.startswith('c.csv:1:2: "inflw" is not a signal of the model; did you mean "inflow"')


def test_a_study_of_which_every_log_is_sealed_has_nothing_to_learn_from(tmp_path: Path, tanks: dict[str, str]) -> None:
    study = "model: tank.py:Tank\nlogs: {validation: [a.csv, b.csv]}\ncandidates: [leek]\n"
    assert [line.split(":")[1:3] for line in told(tmp_path, tanks, study)] == [["2", "1"], ["3", "14"]]


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


# -- a log stands in a study once


def study(folder: Path, estimation: str = "[e.csv]", validation: str = "[v.csv]") -> Path:
    (folder / "tank.py").write_text(MODEL)
    path = folder / "study.yaml"
    path.write_text(f"model: tank.py:Tank\nlogs:\n  estimation: {estimation}\n  validation: {validation}\n")
    return path


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as refused:
        read_study(path)
    return [str(f).removeprefix(str(path)) for f in refused.value.faults]


def test_a_removed_key_is_a_fault_at_its_line_with_what_to_use_instead(tmp_path: Path) -> None:
    path = study(tmp_path)
    path.write_text(f"{path.read_text()}carry_logs: true\n")
    (fault,) = (text for text in faults_of(path) if text.startswith(":5:1: "))
    assert REMOVED_KEYS["carry_logs"] in fault


@pytest.mark.parametrize(
    "rewrite",
    [
        lambda text: text,
        lambda text: b"\xef\xbb\xbf\n" + text.rstrip(b"\n").replace(b"\n", b"\r\n"),
        lambda text: text.replace(b"time", b"time [s]", 1),
        lambda text: b"\n".join(b",".join([r[0], *r[:0:-1]]) for r in (line.split(b",") for line in text.splitlines())),
    ],
    ids=["copy", "line ends", "unit", "columns"],
)
def test_a_copy_of_a_log_is_that_log(tmp_path: Path, tanks: dict[str, str], rewrite: Callable[[bytes], bytes]) -> None:
    (tmp_path / "e.csv").write_text(tanks["a.csv"])
    (tmp_path / "v.csv").write_bytes(rewrite(tanks["a.csv"].encode()))
    (fault,) = faults_of(study(tmp_path))
    assert fault.startswith(":4:16: v.csv has the same content as e.csv under estimation")


def test_another_run_is_another_log(tmp_path: Path, tanks: dict[str, str]) -> None:
    (tmp_path / "e.csv").write_text(tanks["a.csv"])
    header, _, *rows = tanks["a.csv"].encode().splitlines(keepends=True)
    (tmp_path / "v.csv").write_bytes(b"".join([header, *rows]))
    read: Any = read_study(study(tmp_path), "total: 10 min")
    assert (len(read.logs), read.content.limits.total) == (1, 600.0)
    with pytest.raises(InputError, match="--limits: totl: no such limit"):
        read_study(study(tmp_path), "totl: 10 min")


def test_one_file_under_two_names_is_told_at_each_place(tmp_path: Path, tanks: dict[str, str]) -> None:
    (tmp_path / "e.csv").write_text(tanks["a.csv"])
    (tmp_path / "v.csv").symlink_to("e.csv")
    assert [t[:7] for t in faults_of(study(tmp_path, "[e.csv, ./e.csv]"))] == [":3:23: ", ":4:16: "]
