"""Option `--set`: parameters of a model with units."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError
from cosim.base.units import read_quantity
from cosim.model.model import Model
from cosim.storage.yaml_file import did_you_mean, short

SET = Path("--set")


def with_parameters(model: Model, given: Sequence[str]) -> Model:
    """Return the model with parameters from `--set NAME=VALUE`.

    Raises:
        InputError: Every fault.
    """
    faults, values = [], dict[str, Any]()
    for text in given:
        name, sign, value = (part.strip() for part in text.partition("="))
        declared = model.declared.get(name)
        if not sign or not name:
            faults.append(f"{short(text)} is not NAME=VALUE; for example mass=2")
        elif declared is None:
            faults.append(f'{model.title} has no parameter "{name}"{did_you_mean(name, model.declared)}')
        elif isinstance(declared.default, bool):
            if value not in ("true", "false"):
                faults.append(f"{name} is {short(value)}; it is true or false")
            values[name] = value == "true"
        else:
            try:
                values[name] = read_quantity(value, declared.unit)
            except ValueError as error:
                faults.append(f"{name}={short(value)}: {error}")
                continue
            if fault := declared.fault(values[name]):
                faults.append(f"{name.rpartition('.')[0]}.{fault}".lstrip("."))
    if faults:
        raise InputError([Fault(SET, 0, 0, fault) for fault in faults])
    return model.with_values(values)
