"""Start values and parameters that a replay is given as NAME=VALUE, in the type and unit of their FMU variable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError
from cosim.base.units import read_quantity
from cosim.blocks.description import is_difference, read_description, unit_of
from cosim.storage.yaml_file import did_you_mean, short

Given = Mapping[str, float | int | bool | str]
SWITCHES = {"true": True, "on": True, "1": True, "false": False, "off": False, "0": False}


def start_values(fmu: Path, texts: Sequence[str]) -> dict[str, float | int | bool | str]:
    """Values by variable of texts such as `gain=0.9`, `angle=12 deg`; InputError with every fault."""
    if not texts:
        return {}
    variables = {v.name: v for v in read_description(fmu).modelVariables}
    found: dict[str, float | int | bool | str] = {}
    faults = []
    for text in texts:
        try:
            name, value = _given(variables, text)
        except ValueError as error:
            faults.append(Fault(fmu, 0, 0, f'--start "{short(text)}": {error}'))
        else:
            found[name] = value
    if faults:
        raise InputError(faults)
    return found


def _given(variables: Mapping[str, Any], text: str) -> tuple[str, float | int | bool | str]:
    """Name and value; ValueError says what is wrong."""
    name, sign, value = (part.strip() for part in text.rpartition("=") if part is not None)
    if not (name and sign and value):
        raise ValueError("it is NAME=VALUE, as in gain=0.9")
    variable = variables.get(name)
    if variable is None:
        raise ValueError(f"the FMU has no such variable{did_you_mean(name, variables)}")
    if variable.variability == "constant" or not (
        variable.causality == "input" or variable.initial in {"exact", "approx"}
    ):
        raise ValueError("FMI lets nobody set it before a run")
    if variable.type == "String":
        return name, value
    if variable.type == "Boolean":
        if value.lower() not in SWITCHES:
            raise ValueError("it is true or false")
        return name, SWITCHES[value.lower()]
    number = read_quantity(value, unit_of(variable), difference=is_difference(variable))
    low, high = (s * math.inf if v is None else float(v) for v, s in ((variable.min, -1), (variable.max, 1)))
    if not low <= number <= high:
        raise ValueError(f"it lies in [{low:g}, {high:g}] {unit_of(variable)}".removesuffix(" 1").rstrip())
    if variable.type in {"Real", "Float32", "Float64"}:
        return name, number
    if number != math.floor(number):
        raise ValueError("it is a whole number")
    return name, int(number)
