"""Parameters and start values to estimate: what an FMU offers, and what `--vary` says about them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, refuse
from cosim.base.text import split_assignment
from cosim.base.units import split_quantity
from cosim.blocks.description import unit_of
from cosim.logs.channel_noise import NORMAL_95
from cosim.probing.log_runs import limits_of
from cosim.scenario.start_values import Misfit, convert_value, kind_of, settable
from cosim.storage.yaml_file import did_you_mean, short

NOT_VARIED = '--vary "{text}" is none of NAME, NAME=20% and NAME=LOW..HIGH, as in mass=0.3..2'

OPTION = Path("--vary")
REALS = {"Real", "Float64", "Float32"}
FREE = {"", "free", "null"}  # values of NAME=… that mean NAME alone
MOST_NAMES = 8  # names in a message


@dataclass(frozen=True)
class Parameter:
    """A parameter or start value to estimate.

    Attributes:
        start: Value before the estimate.
        low, high: Bounds, infinite without any.
        tolerance: Half-width of the 95 % interval of a normal prior about `start`; None without a prior.
        per_log: True for the start value of a state, which is estimated for each log.
    """

    name: str
    unit: str
    start: float
    low: float = -math.inf
    high: float = math.inf
    tolerance: float | None = None
    per_log: bool = False

    @property
    def scale(self) -> float:
        """Return a typical size: the value, or a tenth of the range if it is zero."""
        width = 0.1 * (self.high - self.low)
        return abs(self.start) or (width if math.isfinite(width) else 1.0)

    @property
    def sigma(self) -> float:
        """Return the prior's standard deviation, infinite without one."""
        return math.inf if self.tolerance is None else self.tolerance / NORMAL_95


def candidates(description: Any, given: Mapping[str, Any]) -> dict[str, Parameter]:
    """Return every variable that can be estimated; parameters first, in the order of the FMU.

    Args:
        given: Values that replace start values of the FMU.
    """
    names = {v.name for v in description.modelVariables}
    found = {}
    for variable in description.modelVariables:
        if _is_estimable(variable):
            low, high = limits_of(variable)
            value = given.get(variable.name, variable.start)
            start, unit = float(value), unit_of(variable)
            per_log = not _is_parameter(variable) or variable.name.removesuffix("_start") in names - {variable.name}
            found[variable.name] = Parameter(variable.name, unit, start, low, high, None, per_log)
    return dict(sorted(found.items(), key=lambda item: item[1].per_log))


def _is_parameter(variable: Any) -> bool:
    return "parameter" in (variable.causality, variable.variability)  # the latter in FMI 1.0


def _is_estimable(variable: Any) -> bool:
    """Return whether a variable is a scalar real parameter or state with a start value that may be set."""
    if variable.type not in REALS or variable.shape or variable.start is None or not settable(variable):
        return False
    return _is_parameter(variable) or variable.causality in {"local", "internal", "output", None}


def _option_fault(name: str, message: str) -> Fault:
    return Fault(OPTION, 0, 0, message)


def read_vary(
    description: Any,
    offered: Mapping[str, Parameter],
    texts: Sequence[str],
    fault: Callable[[str, str], Fault] = _option_fault,
) -> list[Parameter]:
    """Return the parameters named by texts such as `mass`, `mass=20%`, `mass=0.3..2 kg`.

    Args:
        fault: Function of (name, message) that adds the place.

    Raises:
        InputError: Every fault.
    """
    variables = {v.name: v for v in description.modelVariables}
    chosen: dict[str, Parameter] = {}
    faults: list[Fault] = []
    for text in texts:
        name, _, value = split_assignment(text, variables)
        with suppress(ValueError):
            value = _plain(json.loads(value))
        try:
            if not name:
                raise ValueError(NOT_VARIED.format(text=short(text)))
            if name not in offered:
                raise ValueError(_not_offered(name, variables, offered))
            if name in chosen:
                raise ValueError(f"{name} is named twice; name it once")
            parameter = _bounded(description, variables[name], offered[name], str(value))
            if not parameter.low <= parameter.start <= parameter.high:
                ends = {"low": parameter.low, "high": parameter.high}
                raise ValueError(
                    (
                        "{name} starts at {value:g}, outside {low:g} to {high:g}; give another value as --start "
                        "{name}=VALUE"
                    ).format(name=name, value=parameter.start, **ends)
                )
            chosen[name] = parameter
        except ValueError as error:
            faults.append(fault(name, error.args[0]))
    refuse(faults)
    return list(chosen.values())


def _plain(value: Any) -> str:
    """Return a value of Python as text: a pair is a range, None is no bound."""
    if isinstance(value, list) and len(value) == 2:
        return f"{value[0]}..{value[1]}"
    return "" if value is None else str(value)


def _not_offered(name: str, variables: Mapping[str, Any], offered: Mapping[str, Parameter]) -> str:
    if name not in variables:
        return f'the FMU has no variable "{name}"{did_you_mean(name, variables)}'
    variable = variables[name]
    kind = "an input" if variable.causality == "input" else kind_of(variable)
    if variable.type not in REALS:
        kind = f"of type {variable.type}"
    elif variable.shape:
        kind = "an array"
    names = [n for n, p in offered.items() if not p.per_log][:MOST_NAMES]
    return (
        f"{name} is {kind}, which has no value to estimate; name a parameter, or the start value of a state "
        f"({', '.join(names) or 'the FMU has none'})"
    )


def _bounded(description: Any, variable: Any, parameter: Parameter, text: str) -> Parameter:
    """Return the parameter with bounds or prior."""
    if text in FREE:
        return parameter
    if text.endswith("%"):
        share = _percentage(parameter.name, text)
        if parameter.start == 0.0:
            raise ValueError(f"{parameter.name} starts at 0, of which {text} is nothing; give a range LOW..HIGH")
        return replace(parameter, tolerance=share * abs(parameter.start))
    first, dots, second = (part.strip() for part in text.partition(".."))
    if not (dots and first and second):
        raise ValueError(NOT_VARIED.format(text=short(f"{parameter.name}={text}")))
    unit = (split_quantity(second) or (0.0, ""))[1]
    ends = [f"{first} {unit}" if unit and _is_number(first) else first, second]
    low, high = (_converted(description, variable, end) for end in ends)
    if not low < high:
        raise ValueError(f"{parameter.name}: {low:g} is not below {high:g}; give LOW..HIGH with LOW below HIGH")
    return replace(parameter, low=max(low, parameter.low), high=min(high, parameter.high))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _percentage(name: str, text: str) -> float:
    with suppress(ValueError):
        share = float(text.removesuffix("%")) / 100.0
        if 0.0 < share < math.inf:
            return share
    raise ValueError(f"{name}: {short(text)} is no tolerance; give a percentage above 0, such as 20%")


def _converted(description: Any, variable: Any, text: str) -> float:
    value = convert_value(description, variable, float(text) if _is_number(text) else text)
    if isinstance(value, Misfit):
        raise ValueError(f"{variable.name}: {short(text)} is not allowed: {value.reason}")
    return float(value)
