"""A model of one's own, or a model.yaml, with something wrong in it: every fault has its line and its cure."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.core.errors import Fault, InputError
from cosim.fmi.building.declared import make_model
from cosim.fmi.building.file import own_model, read_model
from cosim.fmi.building.source import ModelText
from cosim.fmi.description import read_description
from cosim.verbs.checks import check as check_files
from cosim.verbs.cli import command_line
from plant.hovercraft import Hovercraft
from tests.table import TABLE

ROOT = Path(__file__).parent.parent
FORCED = 'forced = ("rate",)'
CATALOGUE = "catalogue = (DryFriction,)"
TOTAL = "total = command[0] - d * rate - k * angle"
SENSOR = """
from cosim.model import SensorError

@dataclass(frozen=True, kw_only=True)
class Bent(SensorError):
    name = "encoder_error"
    equation = "reading s*a + b"
    output = "angle"
    bias: float = parameter(0.0, unit="rad", bounds=(-1, 1), neutral=0.0, typical=0.01, doc="bias b")
    value: float = parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.1, doc="scale s")

    def measure(self, value):
        return value * self.value

@dataclass(frozen=True, kw_only=True)
class Table(Model):"""
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
        assert text.count(old) == 1 or not old, old
        text = text.replace(old, new) if old else text + new
    path = folder / "table.py"
    path.write_text(text, encoding="utf-8")
    return path


def faults_of(folder: Path, *changes: tuple[str, str]) -> tuple[Fault, ...]:
    path = table(folder, *changes)
    with pytest.raises(InputError) as caught:
        own_model("table.py:Table", folder)
    assert {fault.file for fault in caught.value.faults} == {path.resolve()}
    return caught.value.faults


def line_of(folder: Path, words: str) -> int:
    lines = (folder / "table.py").read_text(encoding="utf-8").splitlines()
    return next(k for k, line in enumerate(lines, 1) if words in line)


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
    "forced a text": (FORCED, 'forced = ("rate")', "forced ="),
    "suspect misspelt": (FORCED, FORCED + '; suspect = {"inertio": ("torque",)}', "forced"),
    "input misspelt": (FORCED, FORCED + '; suspect = {"stiffness": ("torqe",)}', "forced"),
    "variance misspelt": ('"rate": 1e-4', '"rte": 1e-4', "sensor_variance ="),
    "excursion of nothing known": (FORCED, f'{FORCED}\n    excursion = {{"torqe": 1.0}}', "excursion ="),
    "valid of nothing known": (
        FORCED,
        f'{FORCED}\n    valid = (__import__("cosim.model.model").model.Validity("M", ("torqe",), -1, 1, "it breaks"),)',
        "valid =",
    ),
    "valid that says nothing": (FORCED, f'{FORCED}\n    valid = ("torque", -1.0, 1.0)', "valid ="),
    "a frame of names alone": (FORCED, f'{FORCED}\n    planar = ("x", "y")', "planar ="),
    "limits the wrong way round": (
        '"motor torque commanded")',
        '"motor torque commanded", bounds=(1.0, -1.0))',
        "inputs =",
    ),
    "a start beyond its limits": (
        '"motor torque commanded")',
        '"motor torque commanded", bounds=(1.0, 2.0))',
        "inputs =",
    ),
    "rival misspelt": (
        FORCED,
        FORCED + '; told_apart_by = {frozenset({"dry_frction", "damping"}): "slow runs"}',
        "told_apart_by",
    ),
    "starts of a stranger": ('name = "dry_friction"', 'starts = ({"levl": 0.1},); name = "dry_friction"', "starts ="),
    "rivals not a set": (FORCED, FORCED + '; told_apart_by = {("a", "b"): "c"}', "told_apart_by"),
    "effect called as a parameter": ('name = "dry_friction"', 'name = "inertia"', 'name = "in'),
    "effect twice": (CATALOGUE, "catalogue = (DryFriction, DryFriction)", 'name = "dry'),
    "input as output": ('Quantity("torque"', 'Quantity("rate"', "class Table("),
    "no inputs": ('    inputs = (Quantity("torque", "N.m", "motor torque commanded"),)\n', "", "class Table("),
    "no equations": ("def equations(", "def equation(", "class Table("),
    "catalogue no tuple": (CATALOGUE, "catalogue = (DryFriction)", "catalogue ="),
    "unit unknown": ('unit="kg.m2"', 'unit="slug.m2"', "inertia: "),
    "if on a symbol": (TOTAL, f"angle = angle if rate > 0 else angle; {TOTAL}", "else angle;"),
    "math on a symbol": ("m.tanh(", "__import__('math').tanh(", "('math')"),
    "a function m lacks": ("m.tanh(", "m.arctan(", "m.arctan"),
    "name unknown": ("return rate, total /", "return rate, totl /", "totl /"),
    "too many values": ("total / inertia\n", "total / inertia, 0.0\n", "def equations"),
    "too few outputs": ("return state\n", "return state[:1]\n", "def equations"),
    "no number": ("return rate, total /", "return None, total /", "def equations"),
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
    assert line_of(tmp_path, where) in [fault.line for fault in faults]
    assert all(fault.column >= 1 for fault in faults)


def test_the_models_of_this_project_have_no_fault() -> None:
    make_model(Hovercraft, ModelText(ROOT / "plant" / "hovercraft.py"))
    own_model("drive.py:Drive", ROOT / "examples" / "drive")


# -- sensor errors and delays ---------------------------------------------------------------------


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


def test_a_sensor_error_has_one_parameter_called_value(tmp_path: Path) -> None:
    two, sensors = (TABLE_CLASS, SENSOR), (FORCED, f"{FORCED}; sensors = (Bent,)")
    (fault,) = faults_of(tmp_path, two, sensors)
    assert 'one parameter, called "value"; encoder_error has bias and value' in fault.message
    bias = next(n for n in SENSOR.splitlines() if n.startswith("    bias:"))
    one = SENSOR.replace(f"{bias}\n", "")
    table(tmp_path, (TABLE_CLASS, one), sensors)
    assert len(own_model("table.py:Table", tmp_path).sensors) == 1
    (fault,) = faults_of(tmp_path, (TABLE_CLASS, one.replace('"angle"', '"angel"')), sensors)
    assert 'encoder_error: no output "angel"; did you mean "angle"?' in fault.message


@pytest.mark.parametrize(
    ("catalogue", "old", "new", "message"),
    [
        ("Late, Play", "", "", None),
        ("Late, Play", 'delay = "time"', 'delay = "tim"', 'late has no parameter "tim"; did you mean "time"?'),
        ("Play, Late", "", "", "put it before play in the catalogue"),
        (
            "Late, Play",
            '    equation = "play of',
            '    delay = "width"\n    equation = "play of',
            "let one of them do it",
        ),
        (
            "Late, Play",
            'memory = (Quantity("torque", "N.m", "torque held back"),)',
            "memory = ()",
            "1 inputs and has 0",
        ),
        (
            "Late",
            "command, memory):\n        return command, memory\n",
            "c, n):\n        return c, n + 1\n",
            "a step with",
        ),
        ("Play", "command[0] - self.width)", "float(command[0]))", "`shape` of play raises: TypeError"),
        ("Play", "return (inside,), (inside,)", "return (inside,), ()", "1 commands and 1 of memory"),
        ("Play", "return (inside,), (inside,)", "return inside, inside", "1 commands and 1 of memory"),
    ],
)
def test_a_delay_comes_first_and_alone(tmp_path: Path, catalogue: str, old: str, new: str, message: str | None) -> None:
    effects = EFFECT.replace(old, new) if old else EFFECT
    changes = [(TABLE_CLASS, f"{effects}\n{TABLE_CLASS}"), (CATALOGUE, f"catalogue = ({catalogue}, DryFriction)")]
    if message is None:
        table(tmp_path, *changes)
        own_model("table.py:Table", tmp_path)
    else:
        assert any(message in fault.message for fault in faults_of(tmp_path, *changes))


# -- what a study, a model.yaml and the command line say ------------------------------------------


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("", "own.py", "own.py: has no model class; a model is a subclass"),
        ("class A(Model): pass\nclass B(A): pass\n", "own.py", "own.py:A or {}/own.py:B"),
        ("class A(Model): pass\n", "own.py:B", 'has no model class "B" (models here: Hovercraft, A)'),
        ("class A(Model): pass\n", "own.py", "own.py:3:1: A has no equations"),
        ("class A(Model): pass\nB = A\n", "own.py", "own.py:3:1: A has no equations"),
        ("class A(Model): pass\n", "own.py:", "own.py:3:1: A has no equations"),
        ("import (\n", "own.py", "own.py:3:8: does not load: SyntaxError"),
        ("", "none.py", "none.py: no such file"),
        ("", "none.py:A", "none.py: no such model file"),
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
        ("model: hovercrft\n", (1, 8)),
        ("model: none.py:Car\n", (1, 8)),
        ("parameters:\n  mass: heavy\n", (2, 9)),
        ("parameters:\n  mass: .inf\n", (2, 9)),
        ("sensors:\n  gyro_bias.value: .nan\n", (2, 20)),
        ("parameters:\n  mass: true\n", (2, 9)),
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
    out = ["--out", str(tmp_path / "out")]
    for call in (["excite", str(study), *out], ["build", "--model", str(study), *out]):
        refused = CliRunner().invoke(command_line(), call).exception
        assert isinstance(refused, InputError)
        (fault,) = refused.faults
        assert (fault.file, refused.exit_code) == (study, 2)


def test_the_fmu_of_a_model_in_volts_and_amperes_defines_its_units(tmp_path: Path) -> None:
    volts = ('Quantity("torque", "N.m"', 'Quantity("torque", "V"')
    table(tmp_path, volts, ('unit="N.m.s/rad"', 'unit="V.A.s2/rad"'), ('unit="kg.m2"', 'unit="kΩ.A.s/rad"'))
    call = ["build", "--model", f"{tmp_path / 'table.py'}:Table", "--out", str(tmp_path)]
    assert CliRunner().invoke(command_line(), call).exit_code == 0
    check_files(tmp_path / "plant.fmu", load=False)  # no fault
    definitions = read_description(tmp_path / "plant.fmu").unitDefinitions
    found = {u.name: (u.baseUnit.kg, u.baseUnit.m, u.baseUnit.s, u.baseUnit.A, u.baseUnit.factor) for u in definitions}
    assert found["V"] == (1, 2, -3, -1, 1.0)
    assert found["V.A.s2/rad"] == (1, 2, -1, 0, 1.0)
    assert found["kΩ.A.s/rad"] == (1, 2, -2, -1, 1000.0)
