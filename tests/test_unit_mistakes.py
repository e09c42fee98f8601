"""Columns in another unit than that of the model, found by start values, bounds and predictions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.files.csv_source import write_table
from cosim.fmi.building.file import load_model
from cosim.logs.log import Log, read_log
from cosim.logs.log_check import log_findings
from cosim.logs.model_comparison import input_unit_findings
from plant.hovercraft import INPUTS, OUTPUTS
from tests.logs import RECORDED

HOVERCRAFT = Path(__file__).parent.parent / "examples" / "hovercraft"


def warnings_of(path: Path) -> list[str]:
    lines = log_findings(path, load_model("base", Path()))
    return [line.replace("\xa0", " ") for line in lines if line.startswith("warning")]


@pytest.mark.parametrize("file", [RECORDED, *sorted(HOVERCRAFT.glob("*.csv"))])
def test_a_genuine_log_has_the_units_of_the_model(file: Path) -> None:
    assert warnings_of(file) == []


@pytest.mark.parametrize(
    ("column", "factor", "unit"),
    [("duty_right", 0.01, "1"), ("ax", 1000.0, "mm/s2"), ("ax", 1.0 / 9.80665, "g")],
)
def test_check_names_the_unit_of_a_column(tmp_path: Path, column: str, factor: float, unit: str) -> None:
    header, *rows = (line.split(",") for line in RECORDED.read_text().splitlines())
    table = np.array(rows, dtype=float)
    table[:, header.index(column)] *= factor
    write_table(tmp_path / "log.csv", header, table.tolist())
    (found,) = warnings_of(tmp_path / "log.csv")
    assert f'"{column} [{unit}]"' in found


@pytest.fixture
def log() -> Log:
    return read_log(RECORDED, INPUTS, OUTPUTS)


def test_an_input_far_beyond_its_bound_is_a_fault_if_a_unit_explains_it(log: Log) -> None:
    log = replace(log, inputs={"u": np.linspace(0.0, 11_000.0, log.rows)})
    for unit, bounds, words in (
        ("V", (-12.0, 12.0), '"u [mV]"'),
        ("%", (0.0, 100.0), "scaled"),
        ("V", (-12_000.0, 12_000.0), ""),
    ):
        found = [*input_unit_findings(replace(log, units={**log.units, "u": unit}), {}, {"u": bounds})]
        assert [(f.severity, f.channel, words in f.sentence) for f in found] == [("fault", "u", True)] * bool(words)


WRONG_COLUMNS = {
    "sign": "ax moves opposite to the model",
    "swapped": "columns may be swapped",
    "delay": "trails the model by",
    "positions in cm": '"x_world [cm]"',
    "half a log mirrored": "psi does not follow the integral of psi_dot",
}


def spoil(kind: str, header: list[str], table: np.ndarray) -> None:
    """Make the columns of a log wrong in one way."""
    ax, psi_dot, psi, x = (header.index(name) for name in ("ax", "psi_dot", "psi", "x_world"))
    if kind == "sign":  # with so much noise that the correlation alone is no proof
        table[:, ax] *= -1.0
        table[:, ax] += 0.7 * np.std(table[:, ax]) * np.random.default_rng(3).standard_normal(len(table))
    elif kind == "swapped":
        table[:, [ax, psi_dot]] = table[:, [psi_dot, ax]]
    elif kind == "delay":
        outputs = [header.index(q.name) for q in OUTPUTS if q.name in header]
        table[10:, outputs] = table[:-10, outputs]
    elif kind == "positions in cm":
        table[:, x] *= 100.0
    else:
        table[len(table) // 2 :, psi] *= -1.0


@pytest.mark.parametrize("kind", WRONG_COLUMNS)
def test_check_names_wrong_columns(kind: str, tmp_path: Path) -> None:
    right = HOVERCRAFT / "e1.csv" if kind in {"positions in cm", "half a log mirrored"} else RECORDED
    header, *rows = (line.split(",") for line in right.read_text().splitlines())
    table = np.array(rows, dtype=float)
    spoil(kind, header, table)
    write_table(tmp_path / "wrong.csv", header, table.tolist())
    sentences = log_findings(tmp_path / "wrong.csv", load_model("base", tmp_path))
    assert any(WRONG_COLUMNS[kind] in line.replace("\xa0", " ") for line in sentences), sentences
    assert not any(WRONG_COLUMNS[kind] in line for line in log_findings(right, load_model("base", tmp_path)))
