"""Option `--set`: parameters of a model with units."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, refuse
from cosim.base.units import read_quantity
from cosim.model.model import Model
from cosim.storage.yaml_file import did_you_mean, short

SWITCH: dict[str, Any] = {"true": True, "false": False}


def with_parameters(model: Model, texts: Sequence[str]) -> Model:
    """Return the model with parameters from `--set NAME=VALUE`.

    Raises:
        InputError: Every fault.
    """
    faults, values = [], dict[str, Any]()
    for text in texts:
        name, sign, value = (part.strip() for part in text.partition("="))
        declared = model.declared.get(name)
        if not sign or not name:
            faults.append(f"{short(text)} is not NAME=VALUE; for example mass=2")
        elif declared is None:
            cure = did_you_mean(name, model.declared)
            faults.append(f'{model.title} has no parameter "{name}"{cure}')
        else:
            try:
                is_switch = isinstance(declared.default, bool)
                values[name] = SWITCH.get(value, short(value)) if is_switch else read_quantity(value, declared.unit)
            except ValueError as error:
                faults.append(f"{name}={short(value)}: {error}")
                continue
            if fault := declared.fault(values[name]):
                effect, dot, _ = name.rpartition(".")
                faults.append(f"{effect + dot}{fault}; correct this value")
    refuse(Fault(Path("--set"), 0, 0, fault) for fault in faults)
    return model.with_values(values)
