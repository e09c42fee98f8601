"""Factors of a sweep: values or distributions from the file, with all their faults."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.text import did_you_mean
from cosim.core.units import split_quantity
from cosim.files.yaml_file import YamlFile, short
from cosim.fmi.description import unit_of
from cosim.scenario.scenario import Scenario, resolve_defaults
from cosim.scenario.scenario_file import ScenarioFile, keys_of
from cosim.scenario.start_values import convert_quantity, convert_value, settable
from cosim.sweeps.sampling import MAX_SWEEP_RUNS, Factor, are_numbers, distribution, drawn_rows, saltelli_base
from cosim.sweeps.sweep_file import DISTRIBUTIONS, SweepFile, Varied
from cosim.system.system import System, build_system

FIXED_KEYS = ("duration", "start_time", "criteria", "name", "description", "limits")  # keys common to all runs
FACTOR_FILE_KEYS = ("fmu", "file")  # last keys of paths to file names
NOT_REAL = ("Boolean", "String", "Enumeration", "Integer")  # types of FMI without distributions
MAX_TESTED_VALUES = 50  # values of a path tested before any run
Location = tuple[str | int, ...]
STANDARD_DEVIATION: Location = ("normal", 1)  # second number of `normal`; the first is the mean


def resolve_file_name(sweep: Path, name: str, value: Any) -> Any:
    """Return a value for a path of the scenario; a file name, relative to the sweep file, becomes absolute."""
    last = name.rpartition(".")[2]
    return str((sweep.parent / value).resolve()) if last in FACTOR_FILE_KEYS and isinstance(value, str) else value


class Factors:
    """Factors of a sweep file with their faults and warnings; too many runs raise InputError."""

    def __init__(
        self, yaml: YamlFile, file: SweepFile, scenario: ScenarioFile, system: System, overrides: tuple[str, ...]
    ) -> None:
        self.yaml, self.file, self.scenario, self.system, self.overrides = yaml, file, scenario, system, overrides
        self.blocks = {s.component.name: s.component for s in system.stages if isinstance(s.component, FmuBlock)}
        self.faults: list[Fault] = []
        self.warnings: list[str] = []
        listed: dict[str, int] = {}
        for name, v in file.vary.items():
            size = len(v.values) if v.values is not None else v.grid.count if v.grid is not None else v.count
            if size is not None:
                listed[name] = size
        sampled = sum(v.way in DISTRIBUTIONS for v in file.vary.values())
        rows = drawn_rows(sampled, any(v.each is not None for v in file.vary.values()), file.runs, file.sampling)
        count = math.prod(listed.values()) * rows
        if count > MAX_SWEEP_RUNS:  # before anything is allocated
            largest = max(listed, key=lambda n: listed[n], default="")
            in_list = bool(listed) and (not sampled or listed[largest] > file.runs)
            where: Location = ("vary", largest) if in_list else ("runs",)
            text = f"{count:.3g} runs exceed the {MAX_SWEEP_RUNS:,} that a sweep may have; give fewer values or runs"
            raise InputError([yaml.fault(where, text, key=in_list)])
        if file.sampling == "saltelli" and (listed or not sampled):
            text = "saltelli needs distributions, not listed values"
            self._note(("sampling",), f"{text}; replace the lists, or choose another sampling")
        elif file.sampling == "saltelli" and not saltelli_base(file.runs, sampled):
            least = f"with {sampled} distributions, saltelli needs at least {sampled + 2}"
            self._note(("runs",), f"{file.runs} runs are too few: {least}")
        read = (self._factor(name, varied) for name, varied in file.vary.items())
        self.factors = [factor for factor in read if factor is not None]
        for k, signal in enumerate(file.signals):
            if signal not in system.columns:
                self._note(("signals", k), f'no signal "{short(signal)}"{did_you_mean(signal, system.columns)}')
        paths: dict[tuple[str, ...], str] = {}
        for section, names in (("set", file.set), ("vary", file.vary)):
            for name in names:
                component, _, variable = name.partition(".")
                is_variable = component in scenario.scenario.components
                path = ("components", component, "start", variable) if is_variable else tuple(keys_of(name.strip()))
                goes_on = name == "seed" and file.vary[name].count  # from the seed in `set`
                if path in paths and not goes_on:
                    text = f'{name} and "{paths[path]}" give the same value; remove one of them'
                    self._note((section, name), text, key=True)
                paths[path] = name

    def _note(self, where: Location, text: str, *, key: bool = False, exit_code: int = 2) -> None:
        self.faults.append(self.yaml.fault(where, text, key=key, exit_code=exit_code))

    def _factor(self, name: str, varied: Varied) -> Factor | None:
        """Return a factor; if it is invalid, record faults and return None."""
        before, where = len(self.faults), ("vary", name)
        first, _, variable = name.partition(".")
        if name == "seed":
            start, values = self.scenario.scenario.seed, varied.values
            if varied.each is not None:
                return Factor(name, first=varied.each)
            if varied.count is not None:
                return Factor(name, values=list(range(start, start + varied.count)))
            if values is not None and all(type(v) is int and v >= 0 for v in values):
                return Factor(name, values=values)
            text = "a seed is a whole number of at least 0; give for example values: [1, 2], count: 20 or each: 1"
            self._note(where, text)
            return None
        if varied.way in {"count", "each"}:
            text = f"{varied.way} is for `seed` only; give values, a grid or a distribution"
            self._note((*where, varied.way), text)
            return None
        if first in self.scenario.scenario.components:
            factor = self._of_variable(name, varied, first, variable)
        else:
            factor = self._of_path(name, varied)
        return None if len(self.faults) > before else factor

    def _of_variable(self, name: str, varied: Varied, component: str, variable_name: str) -> Factor | None:
        block = self.blocks.get(component)
        variables = {} if block is None else {v.name: v for v in block.description.modelVariables}
        variable = variables.get(variable_name)
        fault = ""
        if block is None:
            fault = f"{component} is not an FMU; give a path of the scenario, such as components.{name}"
        elif variable is None:
            fault = f'{component} has no variable "{short(variable_name)}"{did_you_mean(variable_name, variables)}'
        elif variable.shape or not settable(variable):
            reason = "is an array" if variable.shape else f"cannot be set (causality {variable.causality})"
            fault = f"{name} {reason}; vary a parameter or a start value"
        elif variable_name in block.connected:
            fault = "is a connected input; vary its source"
        if fault or block is None or variable is None:
            self._note(("vary", name), fault, key=True)
            return None

        def convert(where: Location, entry: Any) -> Any:
            if where != STANDARD_DEVIATION:
                return convert_value(block.description, variable, entry)
            # Bounds and the unit's offset do not apply to a standard deviation.
            is_text = isinstance(entry, str)
            return convert_quantity(block.description, variable, entry, difference=True) if is_text else entry

        return self._make_factor(name, varied, convert, unit_of(variable) or "", is_real=variable.type not in NOT_REAL)

    def _of_path(self, name: str, varied: Varied) -> Factor | None:
        first = name.partition(".")[0]
        keys = [field.alias or key for key, field in Scenario.model_fields.items()]
        if first not in keys:
            hint = did_you_mean(first, [*keys, *self.scenario.scenario.components])
            text = f'no component and no key of the scenario is "{short(first)}"{hint}'
            self._note(("vary", name), text, key=True)
            return None
        if first in FIXED_KEYS:
            self._note(("vary", name), f"{first} is one for all runs; give it by `set`", key=True)
            return None

        def convert(where: Location, entry: Any) -> Any:
            if not isinstance(entry, str):
                return entry
            try:
                number = self._number_at(name, entry)
                if (
                    where == STANDARD_DEVIATION and (quantity := split_quantity(entry)) is not None
                ):  # converted without the unit's offset
                    number = self._number_at(name, f"{2.0 * quantity[0]!r} {quantity[1]}") - number
            except ValueError:
                if where[0] != "values":
                    raise
                return resolve_file_name(self.yaml.path, name, entry)
            return number

        return self._make_factor(name, varied, convert)

    def _number_at(self, name: str, text: str) -> float:
        """Return the number of text such as `4 ms` at a scenario path; raise ValueError for other text."""
        try:
            varied = f"{name}={json.dumps(text)}"
            file = ScenarioFile(self.scenario.path, (*self.overrides, varied), option="")
            refuse(f for f in file.faults if f.message.startswith(f"{name} is "))
            number: Any = resolve_defaults(file.scenario)
            for key in keys_of(name):
                number = number[int(key) if isinstance(number, list) else key]
        except InputError as error:
            raise ValueError(error.faults[0].message) from None
        except (KeyError, IndexError, TypeError):
            number = None
        if not are_numbers([number]):
            raise ValueError(f"{name} is {text!r}; use a number")
        return float(number)

    def _test_variant(self, *overrides: str) -> tuple[Sequence[Fault], list[str]]:
        """Return the faults and warnings of a variant of the scenario."""
        try:
            file = ScenarioFile(self.scenario.path, (*self.overrides, *overrides), option="")
            system = build_system(file)
        except InputError as error:
            return error.faults, []
        return (), [*file.warnings, *system.warnings]

    def _make_factor(
        self, name: str, varied: Varied, convert: Any, unit: str = "", *, is_real: bool = True
    ) -> Factor | None:
        """Return a factor, whose values `convert`, a function of (place, entry), converts; it may raise ValueError."""

        def value(where: Location, entry: Any) -> Any:
            try:
                return convert(where, entry)
            except ValueError as error:
                text = str(error)
                text = text if text.startswith(name) else f"{name} is {entry!r}; {text}"
                self._note(("vary", name, *where), text)
                return None

        way = varied.way
        entries: Any = getattr(varied, way)
        if way == "values":
            return Factor(name, unit, [value((way, k), v) for k, v in enumerate(entries)])
        if way == "grid":
            numbers = [value((way, "from"), entries.begin), value((way, "to"), entries.end)]
            if are_numbers(numbers):
                return Factor(name, unit, np.linspace(numbers[0], numbers[1], entries.count).tolist())
        else:
            numbers = [value((way, k), v) for k, v in enumerate(entries)]
        within = [value(("within", k), v) for k, v in enumerate(varied.within or ())]
        if not is_real or any(isinstance(v, (bool, str)) for v in (*numbers, *within)):
            self._note(("vary", name, way), f"{name} is not a real number; give its values as a list, values: […]")
        if not are_numbers([*numbers, *within]):
            return None
        try:
            return Factor(name, unit, drawn=distribution(way, list(map(float, numbers)), within))
        except ValueError as error:
            self._note(("vary", name, way), str(error))
            return None

    def check_values(self, columns: Mapping[str, list[Any]]) -> None:
        """Test the listed values of each path, and the extreme drawn values; record faults and warnings."""
        for factor in self.factors:
            name, way = factor.name, self.file.vary[factor.name].way
            component, _, variable = name.partition(".")
            is_variable, is_drawn = component in self.blocks, factor.drawn is not None
            if name == "seed" or (is_variable and not is_drawn):
                continue
            path = f"components.{component}.start.{variable}" if is_variable else name
            values = factor.values or ()
            if is_drawn and columns[name]:
                values = [min(columns[name]), max(columns[name])]
            for k, value in enumerate(values[:MAX_TESTED_VALUES]):
                faults, warnings = self._test_variant(f"{path}={json.dumps(value)}")
                for fault in faults:
                    where: Location = ("vary", name, way) if is_drawn else ("vary", name)
                    cure = "limit it by within: [low, high]" if way == "normal" else "change its limits"
                    text = f"{name} would be {value:g}: {fault.message}; {cure}" if is_drawn else fault.message
                    self._note((*where, way, k) if way == "values" else where, text, exit_code=fault.exit_code)
                known = {*self.scenario.warnings, *self.system.warnings, *self.warnings}
                self.warnings += [text for text in warnings if text not in known and not is_variable]
