"""Start values and parameters of a replay, written as NAME=VALUE, in type and unit of the FMU variable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from cosim.core.errors import Fault, refuse
from cosim.core.text import split_assignment
from cosim.files.yaml_file import short
from cosim.fmi.description import read_description
from cosim.scenario.start_values import NOT_NUMBERS, start_value

SWITCHES = {"true": True, "on": True, "1": True, "false": False, "off": False, "0": False}


def start_values(
    fmu: Path, texts: Sequence[str], fault: Callable[[str, str], Fault] | None = None
) -> dict[str, float | int | bool | str]:
    """Return values for texts such as `angle=12 deg`.

    Args:
        fault: Function of (name, message) that adds the place; by default the FMU.

    Raises:
        InputError: Every invalid text.
    """
    if not texts:
        return {}
    description = read_description(fmu)
    variables = {v.name: v for v in description.modelVariables}
    values: dict[str, float | int | bool | str] = {}
    faults = []
    for text in texts:
        name, _, written = split_assignment(text, variables)
        kind = getattr(variables.get(name), "type", "")
        read: float | int | bool | str = written
        if kind == "Boolean":
            read = SWITCHES.get(written.lower(), written)
        elif kind not in NOT_NUMBERS:
            for number in (float, int):  # a whole number is one
                with suppress(ValueError):
                    read = number(written)
        try:
            if not (name and written):
                raise ValueError("it is NAME=VALUE, as in gain=0.9")
            values[name] = start_value(description, variables, name, read)
        except ValueError as error:
            message = f'--start "{short(text)}": {error}'
            faults.append(Fault(fmu, 0, 0, message) if fault is None else fault(name, message))
    refuse(faults)
    return values
