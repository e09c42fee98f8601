"""Start values and parameters of a replay, written as NAME=VALUE, in type and unit of the FMU variable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from cosim.core.errors import Fault, refuse
from cosim.core.text import split_assignment
from cosim.files.yaml_file import did_you_mean, short
from cosim.fmi.description import read_description
from cosim.scenario.start_values import NOT_NUMBERS, Misfit, convert_value, settable

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
        variable = variables.get(name)
        if not (name and written):
            value: Any = Misfit("it is NAME=VALUE, as in gain=0.9")
        elif variable is None:
            value = Misfit(f"the FMU has no such variable{did_you_mean(name, variables)}")
        elif not settable(variable):
            value = Misfit("FMI lets nobody set it before a run")
        else:
            read: float | int | bool | str = written
            if variable.type == "Boolean":
                read = SWITCHES.get(written.lower(), written)
            elif variable.type not in NOT_NUMBERS:
                for number in (float, int):  # a whole number is one
                    with suppress(ValueError):
                        read = number(written)
            value = convert_value(description, variable, read)
        if isinstance(value, Misfit):
            message = f'--start "{short(text)}": {value.reason}'
            faults.append(Fault(fmu, 0, 0, message) if fault is None else fault(name, message))
        else:
            values[name] = value
    refuse(faults)
    return values
