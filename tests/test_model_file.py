"""Faulty user models and model.yaml files: every fault has its line and its cure."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

from cosim.core.errors import Fault, InputError
from cosim.experiment.rigs import inputs_to_limit
from cosim.fmi.building.file import own_model, read_model
from cosim.verbs.checks import check as check_files
from tests.table import TABLE
from tests.test_first_steps import invoked

FORCED = 'forced = ("rate",)'
CATALOGUE = "catalogue = (DryFriction,)"
TOTAL = "total = command[0] - d * rate - k * angle"
TABLE_CLASS = "\n@dataclass(frozen=True, kw_only=True)\nclass Table(Model):"
EFFECT = """
@dataclass(frozen=True, kw_only=True)
class Late(TableEffect):
    name = "late"
    equation = "u(t - T)"
    memory = (Quantity("torque", "N.m", "torque held back"),)
    delay = "time"
    time: float = parameter(0.0, unit="s", bounds=(0, 0.5), neutral=0.0, typical=0.02, doc="delay T")

    def remember(self, t, start):
        return ((t - 0.5, start),)

    def shape(self, m, t, h, command, memory):
        return command, memory

@dataclass(frozen=True, kw_only=True)
class Play(TableEffect):
    name = "play"
    equation = "play of width w"
    memory = (Quantity("inside", "N.m", "torque after the play"),)
    width: float = parameter(0.0, unit="N.m", bounds=(0, 0.5), neutral=0.0, typical=0.05, doc="width w")

    def shape(self, m, t, h, command, memory):
        inside = m.minimum(m.maximum(memory[0], command[0] - self.width), command[0] + self.width)
        return (inside,), (inside,)
"""


def table(folder: Path, *changes: tuple[str, str]) -> Path:
    """The table of docs/own_model.md with other words in places."""
    text = TABLE
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "table.py"
    path.write_text(text, encoding="utf-8")
    return path


def faults_of(folder: Path, *changes: tuple[str, str]) -> tuple[Fault, ...]:
    path = table(folder, *changes)
    with pytest.raises(InputError) as caught:
        own_model("table.py:Table", folder)
    assert {fault.file for fault in caught.value.faults} == {path.resolve()}
    return caught.value.faults


# change of the table of the documentation → where the fault stands
ONE_CHANGE = {
    "default out of bounds": ("parameter(0.02,", "parameter(2.02,", "inertia: float"),
    "typical out of bounds": ("typical=0.05", "typical=5.0", "level: float"),
    "bounds reversed": ("bounds=(0, 50)", "bounds=(50, 0)", "stiffness: float"),
    "awake by default": ("parameter(0.0,", "parameter(0.1,", "level: float"),
    "never awake": (" neutral=0.0,", "", "class DryFriction"),
    "not decorated": ("\n@dataclass(frozen=True, kw_only=True)\nclass Dry", "\nclass Dry", "level: "),
    "no forced": (FORCED, "", "class Table("),
    "forced misspelt": (FORCED, 'forced = ("rat",)', "forced ="),
    "suspect misspelt": (FORCED, FORCED + '; suspect = {"inertio": ("torque",)}', "forced"),
    "variance misspelt": ('"rate": 1e-4', '"rte": 1e-4', "sensor_variance ="),
    "excursion of nothing known": (FORCED, f'{FORCED}\n    excursion = {{"torqe": 1.0}}', "excursion ="),
    "valid of nothing known": (
        FORCED,
        f'{FORCED}\n    valid = (__import__("cosim.model.model").model.Validity("M", ("torqe",), -1, 1, "it breaks"),)',
        "valid =",
    ),
    "limits the wrong way round": (
        '"motor torque commanded")',
        '"motor torque commanded", bounds=(1.0, -1.0))',
        "inputs =",
    ),
    "rival misspelt": (
        FORCED,
        FORCED + '; told_apart_by = {frozenset({"dry_frction", "damping"}): "slow runs"}',
        "told_apart_by",
    ),
    "starts of a stranger": ('name = "dry_friction"', 'starts = ({"levl": 0.1},); name = "dry_friction"', "starts ="),
    "effect twice": (CATALOGUE, "catalogue = (DryFriction, DryFriction)", 'name = "dry'),
    "input as output": ('Quantity("torque"', 'Quantity("rate"', "class Table("),
    "no inputs": ('    inputs = (Quantity("torque", "N.m", "motor torque commanded"),)\n', "", "class Table("),
    "no equations": ("def equations(", "def equation(", "class Table("),
    "unit unknown": ('unit="kg.m2"', 'unit="slug.m2"', "inertia: "),
    "if on a symbol": (TOTAL, f"angle = angle if rate > 0 else angle; {TOTAL}", "else angle;"),
    "a function m lacks": ("m.tanh(", "m.arctan(", "m.arctan"),
    "name unknown": ("return rate, total /", "return rate, totl /", "totl /"),
    "too many values": ("total / inertia\n", "total / inertia, 0.0\n", "def equations"),
    "division by zero": ("return rate, total /", "return rate / angle, total /", "rate / angle"),
    "nothing returned": ("return Equations(derivative, output)", "pass", "def equations"),
    "start of a stranger": (
        "    def equations(",
        '    def start_state(self, m=None):\n        return {"angel": 0.1}\n\n    def equations(',
        "def start_state",
    ),
    "leaves": (FORCED, FORCED + "; raise SystemExit(3)", "SystemExit"),
    "syntax": ("return rate, total /", "return rate,, total /", "rate,,"),
}


@pytest.mark.parametrize("change", ONE_CHANGE.values(), ids=ONE_CHANGE.keys())
def test_a_fault_of_a_model_has_its_line(tmp_path: Path, change: tuple[str, str, str]) -> None:
    old, new, where = change
    faults = faults_of(tmp_path, (old, new))
    lines = (tmp_path / "table.py").read_text(encoding="utf-8").splitlines()
    assert next(k for k, line in enumerate(lines, 1) if where in line) in [fault.line for fault in faults]
    assert all(fault.column >= 1 for fault in faults)


def test_a_model_file_is_read_as_it_is_however_soon_after_a_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    titles = []
    for title in ("Rotary table", "Rotary tools"):
        path = table(tmp_path, ("Rotary table", title))
        os.utime(path, (1e9, 1e9))
        titles.append(own_model("table.py:Table", tmp_path).title)
    assert titles == ["Rotary table", "Rotary tools"]
    assert not (tmp_path / "__pycache__").exists()


@pytest.mark.parametrize(
    ("catalogue", "old", "new", "message"),
    [
        ("Late, Play", 'delay = "time"', 'delay = "tim"', 'no parameter "tim"; did you mean "time"?'),
        ("Late, Play", "def shape(self, m, t, h, command", "def form(self, m, t, h, command", "no method `shape`"),
        ("Late", "def shape(self, m, t, h, command", "def form(self, m, t, h, command", "no method `shape`"),
        ("Play, Late", "", "", "put it before play in the catalogue"),
        ("Late, Play", 'equation = "play of', 'delay = "width"; equation = "play of', "play and late both"),
        ("Late", 'memory = (Quantity("torque", "N.m", "torque held back"),)', "memory = ()", "1 inputs and has 0"),
        ("Late", "return command, memory", "return command, memory + 1", "a step with"),
        ("Play", "return (inside,), (inside,)", "return (inside,), ()", "1 commands, 1 of memory"),
    ],
)
def test_a_delay_comes_first_and_alone(tmp_path: Path, catalogue: str, old: str, new: str, message: str) -> None:
    def changes(effects: str, names: str) -> list[tuple[str, str]]:
        return [(TABLE_CLASS, f"{effects}\n{TABLE_CLASS}"), (CATALOGUE, f"catalogue = ({names}, DryFriction)")]

    assert old in EFFECT
    faults = faults_of(tmp_path, *changes(EFFECT.replace(old, new), catalogue))
    assert any(message in fault.message for fault in faults)
    table(tmp_path, *changes(EFFECT, "Late, Play"))
    assert len(own_model("table.py:Table", tmp_path).catalogue) == 3


# -- what a study, a model.yaml and the command line say ------------------------------------------


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("", "own.py", "own.py: has no model class"),
        ("class A(Model): pass\nclass B(A): pass\n", "own.py", "own.py:A or {}/own.py:B"),
        ("class A(Model): pass\n", "own.py:B", 'has no model class "B" (models here: Hovercraft, A)'),
        ("class A(Model): pass\nB = A\n", "own.py", "own.py:3:1: A has no equations"),
        ("import (\n", "own.py", "own.py:3:8: does not load: SyntaxError"),
        ("", "none.py:A", "none.py: no model"),
    ],
)
def test_check_of_a_file_without_its_one_model(tmp_path: Path, text: str, name: str, message: str) -> None:
    header = "from plant.hovercraft import Hovercraft\nfrom cosim.model.model import Model\n"
    (tmp_path / "own.py").write_text(header + text)
    with pytest.raises(InputError, match=re.escape(message.format(tmp_path))):
        check_files([tmp_path / name])


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("model: car\n", (1, 8)),
        ("model: none.py:Car\n", (1, 8)),
        ("parameters:\n  mass: .inf\n", (2, 9)),
        ("sensors:\n  gyro_bias.value: .nan\n", (2, 20)),
    ],
)
def test_a_model_yaml_with_something_wrong(tmp_path: Path, text: str, place: tuple[int, int]) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_model(path)
    (fault,) = caught.value.faults
    assert (fault.line, fault.column) == place


def test_a_study_in_place_of_a_model_is_refused_by_its_kind(tmp_path: Path) -> None:
    (study := tmp_path / "study.yaml").write_text("logs: {estimation: [a.csv]}\n")
    for call in (["excite", study], ["build", "--model", study]):
        refused = invoked(*call, "--out", tmp_path / "out").exception
        assert isinstance(refused, InputError)
        (fault,) = refused.faults
        assert (fault.file, refused.exit_code) == (study, 2)


def test_a_model_yaml_moves_with_the_file_it_is_of(tmp_path: Path) -> None:
    bench = tmp_path / "bench"
    (bench / "out").mkdir(parents=True)
    table(bench)
    (bench / "out" / "model.yaml").write_text("model: ../table.py:Table\n")
    assert check_files([bench / "out" / "model.yaml"]) == []
    moved = bench.rename(tmp_path / "moved")
    loaded = read_model(moved / "out" / "model.yaml")
    assert loaded.source == f"{moved.resolve() / 'table.py'}:Table"
    assert inputs_to_limit(loaded.model) == ("torque",)
