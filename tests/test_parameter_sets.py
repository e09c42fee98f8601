"""Start values of a component from parameter sets (SSV), and `--set` by the name of a variable."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import cosim
from cosim.core.errors import InputError

SSV = """<?xml version="1.0" encoding="UTF-8"?>
<ssv:ParameterSet xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" version="1.0" name="set">
  <ssv:Parameters>{parameters}</ssv:Parameters>
</ssv:ParameterSet>
"""
REAL = '<ssv:Parameter name="{name}"><ssv:Real value="{value}"{unit}/></ssv:Parameter>'


def _write(path: Path, **values: tuple[float, str]) -> str:
    entries = (REAL.format(name=n, value=v, unit=f' unit="{u}"' if u else "") for n, (v, u) in values.items())
    path.write_text(SSV.format(parameters="".join(entries)), encoding="utf-8")
    return str(path)


def _start(plant: Path, component: dict[str, Any], settings: dict[str, Any] | None = None) -> dict[str, Any]:
    content = {"name": "s", "duration": 0.04, "step": 0.02, "components": {"plant": {"fmu": str(plant), **component}}}
    made = cosim.run(content, set=settings)
    start: dict[str, Any] = made.manifest["scenario"]["components"]["plant"]["start"]
    return start


def test_a_parameter_set_gives_start_values_and_start_wins(plant_fmu: Path, tmp_path: Path) -> None:
    first = _write(tmp_path / "first.ssv", mass=(800.0, "g"), izz=(0.02, ""), friction=(0.5, ""))
    second = _write(tmp_path / "second.ssv", izz=(0.03, "kg.m2"))
    content = {"parameters": [first, second], "start": {"friction": 0.25, "vx_start": 1.0}}
    values = _start(plant_fmu, content)
    assert values["friction"] == 0.25
    ways = ({"mass": "800 g", "izz": 0.03, "friction": 0.25, "vx_start": 1.0}, values)
    runs = [
        cosim.run(
            {"name": "s", "duration": 0.2, "step": 0.02, "components": {"plant": {"fmu": str(plant_fmu), "start": v}}}
        )
        for v in ways
    ]
    assert (runs[0].results.values == runs[1].results.values).all()


@pytest.mark.parametrize("name", ["plant.mass", "components.plant.start.mass"])
def test_a_variable_is_set_by_its_name_or_its_path(plant_fmu: Path, name: str) -> None:
    assert _start(plant_fmu, {}, {name: 0.9}) == {"mass": 0.9}


@pytest.mark.parametrize(
    "values", [{"mas": (1.0, "")}, {"mass": (1.0, "m")}, None], ids=["unknown variable", "other unit", "no file"]
)
def test_faults_of_a_parameter_set_are_at_its_name(
    plant_fmu: Path, tmp_path: Path, values: dict[str, tuple[float, str]] | None
) -> None:
    if values is not None:
        _write(tmp_path / "set.ssv", **values)
    text = f"name: s\nduration: 1\nstep: 0.02\ncomponents:\n  plant:\n    fmu: {plant_fmu}\n    parameters: set.ssv\n"
    (tmp_path / "s.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        cosim.run(tmp_path / "s.yaml")
    assert error.value.exit_code == 2
    assert [fault.line for fault in error.value.faults] == [7]


def test_a_file_that_is_no_parameter_set_is_a_fault_at_its_own_place(plant_fmu: Path, tmp_path: Path) -> None:
    (tmp_path / "set.ssv").write_text("<ssd:System xmlns:ssd='x'/>", encoding="utf-8")
    with pytest.raises(InputError) as error:
        _start(plant_fmu, {"parameters": str(tmp_path / "set.ssv")})
    assert [fault.file.name for fault in error.value.faults] == ["set.ssv"]
