"""Units known only from headers: of columns, times and replay results; models without declared units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.blocks.component import Signal
from cosim.blocks.sources import playback
from cosim.core.errors import InputError
from cosim.core.units import SYMBOLS, coherent, parse
from cosim.files.results import read_results
from cosim.files.table import read_columns
from cosim.logs.gate import gate
from cosim.logs.log import Finding, Log, read_log
from tests.typed import typed_fmu

NO_UNIT = [Signal("inflow")], [Signal("level")]  # a tank, as PythonFMU describes one
ROWS = "".join(f"{500 * k},{60 + k % 7},{1000 + k * k % 11}\n" for k in range(60))


def tank_log(path: Path, header: str) -> Log:
    path.write_text(f"{header}\n{ROWS}", encoding="utf-8")
    return read_log(path, *NO_UNIT)


def of_units(log: Log) -> list[Finding]:
    return [f for f in gate(log) if f.kind == "undeclared"]


# -- columns of signals without a unit --------------------------------------------------------------


@pytest.mark.parametrize("written", [*SYMBOLS, "l/min", "V/rpm", "rev/min", "mm2/h", "1/min", "N.mm", "kg·mm²"])
def test_the_coherent_unit_is_of_the_same_dimension_and_has_no_factor(written: str) -> None:
    unit, there = parse(written), parse(coherent(written))
    assert unit is not None
    assert there is not None
    assert there.factor == 1.0
    assert there.exponents == unit.exponents


def test_a_column_with_a_unit_is_converted_to_si_where_the_model_declares_none(tmp_path: Path) -> None:
    log = tank_log(tmp_path / "a.csv", "time [ms],inflow [l/min],level [mm]")
    np.testing.assert_allclose(log.inputs["inflow"][:2], [1e-3, 61 / 60e3], rtol=1e-12)
    assert (log.outputs["level"][0], log.time[1]) == (1.0, 0.5)
    assert log.units == {"inflow": "m3/s", "level": "m"}
    assert [f.severity for f in of_units(log)] == ["warning", "warning"]
    rows = "".join(f"{k},0,{(100 * k) % 360}\n" for k in range(20))
    (tmp_path / "b.csv").write_text(f"time,u,turned [deg]\n{rows}")
    turned = read_log(tmp_path / "b.csv", [Signal("u")], [Signal("turned")]).outputs["turned"]
    np.testing.assert_allclose(turned, np.radians(100.0) * np.arange(20), rtol=1e-12)  # unwrapped


@pytest.mark.parametrize("unit", ["foo", "g"])
def test_a_unit_that_says_nothing_changes_nothing_and_is_told(tmp_path: Path, unit: str) -> None:
    log = tank_log(tmp_path / "a.csv", f"time,inflow [{unit}],level")
    assert log.inputs["inflow"][0] == 60.0
    assert len(of_units(log)) == 1


# -- of recordings and references in a scenario -----------------------------------------------------


@pytest.mark.parametrize(
    ("column", "connection", "last", "said"),
    [
        ("u [mV]", "", 0.8, "assumed V, converted from mV"),
        ("u [foo]", "", 800.0, 'a.r_in has no unit in its FMU, and "foo"'),
        ("u [mV]", ", factor: 1.0", 800.0, ""),
        ("u [V]", "", 800.0, ""),
    ],
)
def test_a_recorded_unit_counts_where_the_input_declares_none(
    tmp_path: Path, column: str, connection: str, last: float, said: str
) -> None:
    (tmp_path / "in.csv").write_text(f"time [ms],{column},mode\n0,500,RUN\n1000,800,STOP\n")
    typed_fmu(tmp_path)
    (tmp_path / "s.yaml").write_text(
        "name: s\nduration: 2\nstep: 0.5\ncomponents: {a: {fmu: typed.fmu}, log: {block: playback, file: in.csv}}\n"
        f"connections: [{{from: log.u, to: a.r_in{connection}}}]\n"
    )
    made = cosim.run(tmp_path / "s.yaml", in_process=True)
    assert made["a.r_in"].tolist() == pytest.approx([last * 5 / 8, last * 5 / 8, last, last, last], rel=1e-15)
    told = [w for w in made.warnings if "has no unit" in w]
    assert len(told) == bool(said)
    assert all(said in w for w in told)


def test_a_recorded_column_that_nobody_needs_may_hold_text(tmp_path: Path) -> None:
    path = tmp_path / "in.csv"
    path.write_text("time,u,mode,late\n0,1,RUN,\n1,2,STOP,3\n")
    assert [s.name for s in playback("log", path, ["u"]).outputs] == ["u"]
    with pytest.raises(InputError, match=r'in.csv:2:3: "RUN" in column mode is not a number'):
        read_columns(path, ["u", "mode"])


# -- times ------------------------------------------------------------------------------------------


def test_a_unit_that_is_none_of_time_is_a_fault_everywhere(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time [m],x\n0,0\n1,2\n")
    for read in (read_results, read_columns):
        with pytest.raises(InputError, match=r'a.csv:1:1: "m" is not a unit of time; known units: s, ms'):
            read(tmp_path / "a.csv")


def test_the_first_column_may_be_called_the_time(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"stamp [ms],inflow,level\n{ROWS}")
    assert read_log(tmp_path / "a.csv", *NO_UNIT, columns={"stamp": "time"}).time[-1] == 29.5
    (tmp_path / "b.csv").write_text(f"time,inflow,level\n{ROWS}")
    with pytest.raises(InputError) as refused:
        read_log(tmp_path / "b.csv", *NO_UNIT, columns={"clock": "time"})
    assert len(refused.value.faults) == 1
