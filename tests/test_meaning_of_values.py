"""Units by definition, exact types, clocked bytes, and discrete signals, through every way in and out."""

from __future__ import annotations

import csv
import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import cosim as cosim_package
from cosim.core.errors import InputError
from tests.compiled import library, pack
from tests.known.interfaces import OPPOSITE, TWO_NAMES
from tests.known.kit import Model, tag
from tests.known.sources import DIRECT
from tests.known.table import part, recorded, run
from tests.known.values import CONSUMPTION, METRIC_HP, OWN_HP, TYPED, UNITS, converted, started, through
from tests.warm import cosim

GAIN = Model("input u = 0, parameter gain = 1, y", "", "y = gain * u;", DIRECT)
SWITCHED = Model("parameter at = 1, Boolean on", "", "on = time >= at - 1e-9;")


def changed(path: Path, *pairs: tuple[str, str]) -> Path:
    """Write the FMU of y = gain·u with texts of its description replaced."""
    text = GAIN.description(2, "cs")
    for old, new in (*pairs, ("<ModelVariables>", '<DefaultExperiment stopTime="1" stepSize="0.1"/><ModelVariables>')):
        assert old in text
        text = text.replace(old, new)
    return pack(path, text, GAIN.library())


def ran(folder: Path, *arguments: object) -> dict[str, str]:
    """Return the last row of a command's results."""
    done = cosim(*arguments, "--out", folder / "out", "--no-report", "--force", cwd=folder)
    assert done.returncode == 0, done.stderr
    with (folder / "out" / "results.csv").open(newline="") as stream:
        return [*csv.DictReader(stream)][-1]


# -- units ----------------------------------------------------------------------------------------

PAIRS = (  # unit, definition of the source, of the target, and the value at the target of 100 at the source
    ("hp", METRIC_HP, UNITS["hp"], 100 * OWN_HP),
    ("hp", METRIC_HP, None, 100.0),  # a unit without a definition: equal names are equal
    ("kW", None, UNITS["W"], 100.0),
    ("degZ", UNITS["degC"], {"K": 1, "factor": 0.5, "offset": 200}, (100 + 273.15 - 200) / 0.5),
    ("1/min", {"s": -1, "rad": 1, "factor": 0.1}, {"s": -1, "factor": 0.1}, 100.0),  # rad is written or not
    ("C", {"A": 1, "s": 1}, UNITS["degC"], None),
)


@pytest.mark.parametrize(("unit", "here", "there", "value"), PAIRS)
def test_units_of_one_name_are_converted_and_compared_by_their_definitions(
    tmp_path: Path, unit: str, here: Any, there: Any, value: float | None
) -> None:
    source, target = (through(unit, b) if b else replace(through(unit, {"m": 1}), units="") for b in (here, there))
    for name, model in (("a", target), ("b", source)):
        cosim_package.simulate(model.fmu(), tmp_path / name, set={"u": 100}, stop=1, step=0.1, report=False)
    code, largest = differs(tmp_path, "a", "b")
    if value is None:
        with pytest.raises(InputError):
            converted(100.0, source, target)(tmp_path)
        assert (code, largest["m.y"]) == (5, math.inf)
        return
    assert converted(100.0, source, target)(tmp_path)["m.y"][-1] == pytest.approx(value, rel=1e-12)
    value = 100e3 if unit == "kW" else value  # the kW without a definition is the common one
    assert code == (0 if value == 100 else 5)
    assert largest["m.y"] == pytest.approx(abs(value - 100), rel=1e-9, abs=1e-9)


def test_a_unit_of_a_file_has_the_definition_of_the_fmu(tmp_path: Path) -> None:
    kilo = tag("Unit", tag("BaseUnit", **UNITS["W"], factor=1000), name="kW")
    power = through("hp", METRIC_HP)
    fmu = replace(power, units=kilo + power.units).fmu()
    (tmp_path / "in.csv").write_text("time,u [W],y [kW]\n0,73549.875,73.549875\n1,73549.875,73.549875\n")
    assert float(ran(tmp_path, "simulate", fmu, "--input", "in.csv", "--step", "0.1")["m.y"]) == pytest.approx(100)
    assert float(ran(tmp_path, "replay", "in.csv", "--plant", fmu)["plant.y"]) == pytest.approx(100)
    with (tmp_path / "out" / "residual.csv").open() as stream:
        assert all(abs(float(row["free_run.y"])) < 1e-9 for row in csv.DictReader(stream))


def test_nothing_is_the_value_of_no_miles_per_gallon(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        started(CONSUMPTION, "0 mpg", 3)(tmp_path)


# -- exact types ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "cell", "code"),
    [
        ("Int64", "9223372036854775808", 4),
        ("UInt64", "-1", 4),
        ("Int64", "0.5", 4),
        ("Binary", "xyz", 4),
        ("Int64", "", 2),
    ],
)
def test_a_cell_that_its_type_cannot_hold_is_a_fault(tmp_path: Path, kind: str, cell: str, code: int) -> None:
    (tmp_path / "in.csv").write_text(f"time,i_{kind}\n0,{cell}\n1,{cell}\n")
    assert cosim("simulate", TYPED.fmu(3), "--input", "in.csv", "--step", "0.1", cwd=tmp_path).returncode == code


@pytest.mark.xfail(strict=True, reason="Half the framework: one loop for runs and replays, with exact inputs in both")
def test_a_replayed_log_drives_inputs_whose_values_no_double_holds(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,i_Int64,o_Float64\n0,9007199254740993,1\n1,9007199254740993,1\n")
    assert ran(tmp_path, "replay", "log.csv", "--plant", TYPED.fmu(3))["plant.o_Int64"] == "9007199254740993"


# -- a node of a bus as of LS-BUS: clocked binary data, to be set and read only at ticks ------------

NODE = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="node" instantiationToken="">
  <CoSimulation modelIdentifier="node" canHandleVariableCommunicationStepSize="true" hasEventMode="true"/>
  <DefaultExperiment startTime="0" stepSize="0.1"/>
  <ModelVariables>
    <Binary name="rx" valueReference="1" causality="input" variability="discrete" clocks="3"><Start value=""/></Binary>
    <Binary name="tx" valueReference="2" causality="output" variability="discrete" clocks="4"/>
    <Clock name="rx_clock" valueReference="3" causality="input" intervalVariability="triggered"/>
    <Clock name="tx_clock" valueReference="4" causality="output" intervalVariability="triggered"/>
    <Int32 name="arrived" valueReference="5" causality="output"/>
  </ModelVariables>
  <ModelStructure><Output valueReference="2"/><Output valueReference="4"/><Output valueReference="5"/></ModelStructure>
</fmiModelDescription>
"""


@pytest.mark.parametrize("process", [{}, {"process": "own"}])
def test_clocked_bytes_go_between_nodes_of_a_bus_at_each_tick_and_long_messages_are_counted(
    tmp_path: Path, process: dict[str, Any]
) -> None:
    node = {"fmu": str(pack(tmp_path / "node.fmu", NODE, library(Path(__file__).with_name("node.c"))))} | process
    wires = "x.tx > y.rx, x.tx_clock > y.rx_clock, y.tx > x.rx, y.tx_clock > x.rx_clock"
    done = run({"x": node | {"logging": True}, "y": node}, wires)(tmp_path)
    assert done["x.arrived"][-1] == done["y.arrived"][-1] == 7  # at 0 and each 0.3 s
    assert done.results.exact["y.rx"][-1] == done.results.exact["x.tx"][-1] == b"\xca\xfe"
    said = [line for line in done.warnings if line.startswith("x: ") and " at " in line]
    assert (said[0], said[-1], len(said)) == ("x: 0 at 0", "x: 299 at 1.9", 100)  # the first and the last 50
    assert any("5,900" in line for line in done.warnings)


# -- discrete signals in compare ------------------------------------------------------------------


def differs(folder: Path, a: object, b: object) -> tuple[int, dict[str, float]]:
    """Return 0 or 5 as the command does, and the largest difference of each signal."""
    compared = cosim_package.compare(folder / str(a), folder / str(b), folder / "c", tolerance=0.01, force=True)
    return 0 if compared.same else 5, {d.name: d.largest for d in compared.differences}


def test_a_switch_at_another_time_is_a_difference_in_both_directions(tmp_path: Path) -> None:
    for name, step, at in (("a", 0.1, 1.0), ("b", 0.2, 1.5)):
        cosim_package.simulate(SWITCHED.fmu(), tmp_path / name, set={"at": at}, stop=2, step=step, report=False)
    code, largest = differs(tmp_path, "a", "b")
    assert differs(tmp_path, "b", "a") == (code, largest)
    assert (code, largest["m.on"]) == (5, 1.0)


ONE = "time,y,n,s\n0,0.0,1,x\n0.9,0.0,1,x\n1,1.0,9007199254740992,z\n1.1,1.0,9007199254740992,z\n"
TWO = "time,y,n,s\n0,0.0,1,x\n1,0.0,1,x\n1,1.0,9007199254740992,z\n1.1,1.0,9007199254740992,z\n"
THREE = TWO.replace("1,1.0,9", "1,5.0,9,w\n1,1.0,9", 1).replace("9,w", "9007199254740992,w")
FOUR = TWO.replace("740992", "740993")  # which no double holds


@pytest.mark.parametrize(
    ("a", "b", "code"), [(ONE, TWO, 0), (TWO, TWO, 0), (ONE, THREE, 5), (TWO, THREE, 5), (TWO, FOUR, 5)]
)
def test_two_rows_at_one_time_are_a_jump_on_both_sides_and_integers_differ_by_their_digits(
    tmp_path: Path, a: str, b: str, code: int
) -> None:
    (tmp_path / "a.csv").write_text(a)
    (tmp_path / "b.csv").write_text(b)
    assert [differs(tmp_path, *pair)[0] for pair in (("a.csv", "b.csv"), ("b.csv", "a.csv"))] == [code, code]


# -- small things of descriptions and tables ------------------------------------------------------


def test_an_fmu_without_a_guid_is_refused(tmp_path: Path) -> None:
    fmu = changed(tmp_path / "m.fmu", (' guid="g"', ""))
    for verb in ("info", "simulate"):
        done = cosim(verb, fmu)
        assert done.returncode == 3
        assert "m.fmu" in done.stderr + done.stdout
        assert "NoneType" not in done.stderr + done.stdout


def test_a_name_with_an_equals_sign_is_set(tmp_path: Path) -> None:
    fmu = changed(tmp_path / "m.fmu", ('name="gain"', 'name="gain=k"'))
    assert float(ran(tmp_path, "simulate", fmu, "--set", "gain=k=3", "--set", "u=2")["m.y"]) == 6.0


@pytest.mark.parametrize("words", ["check t.csv", "compare t.csv t.csv", "simulate m.fmu --input t.csv"])
def test_times_whose_differences_no_double_holds_are_a_fault(tmp_path: Path, words: str) -> None:
    (tmp_path / "t.csv").write_text("time,u\n-1e308,1\n1e308,1\n")
    changed(tmp_path / "m.fmu")
    done = cosim(*words.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert "t.csv:" in done.stdout + done.stderr
    assert "RuntimeWarning" not in done.stderr


def test_characters_that_yaml_does_not_take_are_no_fault_of_a_description(tmp_path: Path) -> None:
    odd = "\x9b\x85\u2028"
    pairs = (('modelName="m', f'modelName="a{odd}'), ('name="u"', 'name="u\x9b"'), ('name="gain"', f'name="gain{odd}"'))
    changed(tmp_path / "m.fmu", *pairs)
    (tmp_path / "in.csv").write_text("time,u\x9b\n0,3\n1,3\n", encoding="utf-8")
    row = ran(tmp_path, "simulate", "m.fmu", "--input", "in.csv")
    assert float(row["m.y"]) == float(row["m.u\x9b"]) == 3.0
    assert cosim("init", "m.fmu", "--out", "s.yaml", cwd=tmp_path).returncode == 0
    assert float(ran(tmp_path, "run", "s.yaml")["m.u\x9b"]) == 0.0


@pytest.mark.parametrize(
    ("version", "wires", "events", "fine"),
    [
        (2, "a.v > m.same", [], True),
        (2, "a.v > m.same, a.v > m.u", [], True),
        (2, "a.v > m.same, a.w > m.u", [], False),
        (1, "a.v > m.same, a.v > m.u", [], False),  # one has the opposite sign
        (2, "a.v > m.same", [{"at": 0.5, "set": {"m.u": 1}}], False),
    ],
)
def test_a_variable_of_two_names_has_one_source(
    tmp_path: Path, version: int, wires: str, events: list[Any], fine: bool
) -> None:
    fmu, source = part(OPPOSITE if version == 1 else TWO_NAMES, version), recorded("time,v,w", (0, 1, 2), (1, 1, 2))
    with nullcontext() if fine else pytest.raises(InputError):
        run({"a": source, "m": fmu}, wires, 1, events=events)(tmp_path)
