"""Parameters and start values to estimate: what an FMU offers, and what `--vary` says about them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from cosim.core.errors import Fault, refuse
from cosim.core.text import did_you_mean, split_assignment
from cosim.core.units import split_quantity
from cosim.files.yaml_file import short
from cosim.fmi.description import unit_of
from cosim.logs.channel_noise import NORMAL_95
from cosim.probing.log_runs import limits_of
from cosim.residuals.residual_statistics import finite
from cosim.scenario.start_values import convert_value, kind_of, settable

NOT_VARIED = '--vary "{text}" is none of NAME, NAME=20% and NAME=LOW..HIGH, as in mass=0.3..2'

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
        log: Index of the log of a start value; None for a parameter of all logs.
        spread: Size of a start value that an output shows; 0 for values that were named.
    """

    name: str
    unit: str
    start: float
    low: float = -math.inf
    high: float = math.inf
    tolerance: float | None = None
    per_log: bool = False
    log: int | None = None
    spread: float = 0.0

    def entry(self) -> dict[str, float | None]:
        """Return start, bounds and prior for fit.json."""
        return {
            "start": self.start,
            "low": finite(self.low),
            "high": finite(self.high),
            "tolerance": self.tolerance,
        }

    @property
    def scale(self) -> float:
        """Return a typical size: the value, or a tenth of the range if it is zero."""
        width = 0.1 * (self.high - self.low)
        return self.spread or abs(self.start) or (width if math.isfinite(width) else 1.0)

    @property
    def sigma(self) -> float:
        """Return the prior's standard deviation, infinite without one."""
        return math.inf if self.tolerance is None else self.tolerance / NORMAL_95


def candidates(description: Any, given: Mapping[str, Any]) -> dict[str, Parameter]:
    """Return every variable that can be estimated; parameters first, in the order of the FMU.

    These are scalar real parameters and states with a start value that may be set.

    Args:
        given: Values that replace start values of the FMU.
    """
    names = {v.name for v in description.modelVariables}
    found = {}
    for v in description.modelVariables:
        is_parameter = "parameter" in (v.causality, v.variability)  # the latter in FMI 1.0
        is_state = v.causality in {"local", "internal", "output", None}
        if v.type in REALS and not v.shape and v.start is not None and settable(v) and (is_parameter or is_state):
            low, high = limits_of(v)
            per_log = not is_parameter or v.name.removesuffix("_start") in names - {v.name}
            found[v.name] = Parameter(v.name, unit_of(v), float(given.get(v.name, v.start)), low, high, None, per_log)
    return dict(sorted(found.items(), key=lambda item: item[1].per_log))


def read_vary(
    description: Any, offered: Mapping[str, Parameter], texts: Sequence[str], fault: Callable[[str, str], Fault]
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
        with suppress(ValueError):  # a value of Python: a pair is a range, None is no bound
            read = json.loads(value)
            is_pair = isinstance(read, list) and len(read) == 2
            value = f"{read[0]}..{read[1]}" if is_pair else "" if read is None else str(read)
        try:
            if not name:
                raise ValueError(NOT_VARIED.format(text=short(text)))
            if name not in offered:
                raise ValueError(_not_offered(name, variables, offered))
            if name in chosen:
                raise ValueError(f"{name} is named twice; name it once")
            parameter = _bounded(description, variables[name], offered[name], value)
            if not parameter.low <= parameter.start <= parameter.high:
                raise ValueError(
                    f"{name} starts at {parameter.start:g}, outside {parameter.low:g} to {parameter.high:g}; give "
                    f"another value as --start {name}=VALUE"
                )
            chosen[name] = parameter
        except ValueError as error:
            faults.append(fault(name, error.args[0]))
    refuse(faults)
    return list(chosen.values())


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
    name = parameter.name
    if text in FREE:
        return parameter
    if text.endswith("%"):
        share = _number(text.removesuffix("%"))
        if share is None or not 0.0 < share < math.inf:
            raise ValueError(f"{name}: {short(text)} is no tolerance; give a percentage above 0, such as 20%")
        if parameter.start == 0.0:
            raise ValueError(f"{name} starts at 0, of which {text} is nothing; give a range LOW..HIGH")
        return replace(parameter, tolerance=share / 100.0 * abs(parameter.start))
    first, dots, second = (part.strip() for part in text.partition(".."))
    if not (dots and first and second):
        raise ValueError(NOT_VARIED.format(text=short(f"{name}={text}")))
    unit = (split_quantity(second) or (0.0, ""))[1]
    ends = []
    for end in (f"{first} {unit}" if unit and _number(first) is not None else first, second):
        number = _number(end)
        try:
            ends.append(float(convert_value(description, variable, end if number is None else number)))
        except ValueError as error:
            raise ValueError(f"{variable.name}: {short(end)} is not allowed: {error}") from None
    low, high = ends
    if not low < high:
        raise ValueError(f"{name}: {low:g} is not below {high:g}; give LOW..HIGH with LOW below HIGH")
    return replace(parameter, low=max(low, parameter.low), high=min(high, parameter.high))


def _number(text: str) -> float | None:
    with suppress(ValueError):
        return float(text)
    return None
