"""Factors of a sweep: values or distributions from the file, with all faults."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.errors import Fault, InputError, refuse
from cosim.base.messages import Message, with_prefix
from cosim.base.units import split_quantity
from cosim.blocks.description import unit_of
from cosim.blocks.fmu import FmuBlock
from cosim.scenario.scenario import Scenario, resolve_defaults
from cosim.scenario.scenario_file import ScenarioFile, keys_of
from cosim.scenario.start_values import Misfit, convert_quantity, convert_value, settable
from cosim.scenario.start_values import kind_of as kind_of_variable
from cosim.storage.yaml_file import YamlFile, did_you_mean, short
from cosim.sweeps.sampling import MOST_RUNS, Factor, are_numbers, distribution, drawn_rows, saltelli_base
from cosim.sweeps.sweep_file import SweepFile, Varied
from cosim.system.system import System, build_system

FIXED = ("duration", "start_time", "criteria", "name", "description", "limits")  # keys common to all runs
FILES = ("fmu", "file")  # last keys of paths to file names
NOT_REAL = ("Boolean", "String", "Enumeration", "Integer")  # types of FMI without distributions
MAX_TESTED_VALUES = 50  # values of a path tested before any run
Location = tuple[str | int, ...]
STANDARD_DEVIATION: Location = ("normal", 1)  # Second number of a normal distribution; the mean is ("normal", 0).


def resolve_file_name(sweep: Path, name: str, value: Any) -> Any:
    """Return a path's value; file names are relative to the sweep."""
    last = name.rpartition(".")[2]
    return str((sweep.parent / value).resolve()) if last in FILES and isinstance(value, str) else value


class Factors:
    """Factors of a sweep file with their faults; too many runs raise InputError."""

    def __init__(
        self, yaml: YamlFile, file: SweepFile, scenario: ScenarioFile, system: System, overrides: tuple[str, ...]
    ) -> None:
        self.yaml, self.file, self.scenario, self.system, self.overrides = yaml, file, scenario, system, overrides
        self.components = {s.component.name: s.component for s in system.stages}
        self.faults: list[Fault] = []
        self.warnings: list[str] = []
        self._check_size()

    def _check_size(self) -> None:
        """Check the number of runs before allocating anything."""
        vary, runs = self.file.vary, self.file.runs
        listed = {name: size for name, v in vary.items() if (size := _size(v)) is not None}
        counted = sum(v.each is not None for v in vary.values())
        sampled = len(vary) - len(listed) - counted
        count = math.prod(listed.values()) * drawn_rows(sampled, counted > 0, runs, self.file.sampling)
        if count > MOST_RUNS:
            largest = max(listed, key=lambda n: listed[n], default="")
            in_list = bool(listed) and (not sampled or listed[largest] > runs)
            where: Location = ("vary", largest) if in_list else ("runs",)
            message = (
                f"{count:.3g} runs are more than the {MOST_RUNS:,} that a sweep may have; give fewer values or runs"
            )
            raise InputError([self.yaml.fault(where, message, key=in_list)])
        if self.file.sampling != "saltelli":
            return
        if listed or not sampled:
            self._note(
                ("sampling",),
                (
                    "saltelli takes only distributions, no listed values; vary by distributions, or choose another "
                    "sampling"
                ),
            )
        elif not saltelli_base(runs, sampled):
            least = sampled + 2
            self._note(
                ("runs",), f"{runs} runs are too few: with {sampled} distributions saltelli needs {least} runs at least"
            )

    def _note(self, where: Location, message: str, *, key: bool = False) -> None:
        self.faults.append(self.yaml.fault(where, message, key=key))

    def factor(self, name: str, varied: Varied) -> Factor | None:
        """Return a factor; note faults and return None if invalid."""
        before = len(self.faults)
        if name == "seed":
            return self._seed(varied)
        if varied.way in {"count", "each"}:
            self._note(
                ("vary", name, varied.way), f"{varied.way} is for `seed` only; give values, a grid or a distribution"
            )
            return None
        is_variable = name.partition(".")[0] in self.scenario.scenario.components
        factor = self._of_variable(name, varied) if is_variable else self._of_path(name, varied)
        return None if len(self.faults) > before else factor

    def _seed(self, varied: Varied) -> Factor | None:
        first, values = self.scenario.scenario.seed, varied.values
        if varied.each is not None:
            return Factor("seed", first=varied.each)
        if varied.count is not None:
            return Factor("seed", values=list(range(first, first + varied.count)))
        if values is None or any(isinstance(v, bool) or not isinstance(v, int) or v < 0 for v in values):
            self._note(
                ("vary", "seed"), "seeds are whole numbers that are not negative: values: [1, 2], count: 20 or each: 1"
            )
            return None
        return Factor("seed", values=values)

    def _settable_variable(self, name: str, block: Any) -> Any:
        """Return the FMU variable of a factor, or a message on why the factor cannot be varied."""
        component, _, variable_name = name.partition(".")
        if not isinstance(block, FmuBlock):
            return (
                f"{component} is no FMU and has no start values; vary a path such as components.{component}.… by values"
            )
        variables = {v.name: v for v in block.description.modelVariables}
        variable = variables.get(variable_name)
        if variable is None:
            hint = did_you_mean(variable_name, [v.name for v in variables.values() if settable(v)])
            return f'{component} has no variable "{short(variable_name)}"{hint}'
        if not settable(variable):
            return f"{name} is {kind_of_variable(variable)}; it takes no start value"
        if variable.shape:
            return "is an array; vary a path of the scenario by values"
        if variable_name in block.connected:
            return "is an input that is connected; vary what feeds it"
        return variable

    def _of_variable(self, name: str, varied: Varied) -> Factor | None:
        block: Any = self.components.get(name.partition(".")[0])
        variable = self._settable_variable(name, block)
        if isinstance(variable, Message):
            self._note(("vary", name), variable, key=True)
            return None

        def value(where: Location, entry: Any) -> Any:
            if where != STANDARD_DEVIATION:
                number = convert_value(block.description, variable, entry)
            elif isinstance(entry, str):  # The bounds and the unit's offset do not apply to a standard deviation.
                number = convert_quantity(block.description, variable, entry, difference=True)
            else:
                number = entry
            if isinstance(number, Misfit):
                message = f"{name} is {entry!r}; {number.reason}"
                self._note(("vary", name, *where), message)
                return None
            return number

        return self._make_factor(name, varied, value, unit_of(variable) or "", is_real=variable.type not in NOT_REAL)

    def _of_path(self, name: str, varied: Varied) -> Factor | None:
        first = name.partition(".")[0]
        keys = [field.alias or name for name, field in Scenario.model_fields.items()]
        if first not in keys:
            hint = did_you_mean(first, [*keys, *self.scenario.scenario.components])
            self._note(("vary", name), f'no component and no key of the scenario is "{short(first)}"{hint}', key=True)
            return None
        if first in FIXED:
            self._note(("vary", name), f"{first} is one for all runs; give it by `set`", key=True)
            return None

        def value(where: Location, entry: Any) -> Any:
            if not isinstance(entry, str):
                return entry
            quantity = split_quantity(entry)
            try:
                number = self._number_at(name, entry)
                if where == STANDARD_DEVIATION and quantity is not None:  # The unit's offset does not apply.
                    number = self._number_at(name, f"{2.0 * quantity[0]!r} {quantity[1]}") - number
            except ValueError as error:
                if where[0] == "values":
                    return resolve_file_name(self.yaml.path, name, entry)
                self._note(("vary", name, *where), str(error))
                return None
            return number

        factor = self._make_factor(name, varied, value)
        if factor is not None:
            self._test_values(factor, varied, name)
        return factor

    def _variant(self, *overrides: str) -> ScenarioFile:
        return ScenarioFile(self.scenario.path, (*self.overrides, *overrides), option="")

    def _number_at(self, name: str, text: str) -> float:
        """Return the number of text such as `4 ms` at a scenario path; raise ValueError if none."""
        try:
            file = self._variant(f"{name}={json.dumps(text)}")
            refuse(f for f in file.faults if f.message.startswith(f"{name} is "))
            number: Any = resolve_defaults(file.scenario)
            for key in keys_of(name):
                number = number[int(key) if isinstance(number, list) else key]
        except InputError as error:
            raise ValueError(error.faults[0].message) from None
        except (KeyError, IndexError, TypeError):
            number = None
        if not are_numbers([number]):
            raise ValueError(f"{name} is {text!r}; it is a number")
        return float(number)

    def _test_values(self, factor: Factor, varied: Varied, *paths: str) -> None:
        """Check the scenario with some values of a factor; note faults, and the first warning."""
        values = factor.values
        if values is None:
            values = factor.drawn(np.array([0.01, 0.5, 0.99])).tolist() if factor.drawn else []
        warnings: list[str] = []
        for k, v in enumerate(values[:MAX_TESTED_VALUES]):
            where: Location = ("vary", factor.name, "values", k) if varied.values is not None else ("vary", factor.name)
            faults, texts = self._test_variant(*(f"{path}={json.dumps(v)}" for path in paths))
            self.faults += [self.yaml.fault(where, f.message, exit_code=f.exit_code) for f in faults]
            warnings += texts
        if new := [t for t in warnings if t not in {*self.scenario.warnings, *self.system.warnings}]:
            line = self.yaml.place(("vary", factor.name), key=True)[0]
            self.warnings.append(with_prefix(f"{self.yaml.path}:{line}: ", new[0]))

    def _test_variant(self, *overrides: str) -> tuple[Sequence[Fault], list[str]]:
        """Return the faults and warnings of a variant of the scenario."""
        try:
            file = self._variant(*overrides)
            system = build_system(file)
        except InputError as error:
            return error.faults, []
        return (), [*file.warnings, *system.warnings]

    def _make_factor(
        self, name: str, varied: Varied, value: Any, unit: str = "", *, is_real: bool = True
    ) -> Factor | None:
        """Return a factor, with values converted by `value`."""
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
            self._note(("vary", name, way), f"{name} is no real number; give its values as a list, values: […]")
        if not are_numbers([*numbers, *within]):
            return None
        try:
            return Factor(name, unit, drawn=distribution(way, list(map(float, numbers)), within))
        except ValueError as error:
            self._note(("vary", name, way), str(error))
            return None

    def signal_faults(self) -> Iterator[Fault]:
        """Yield a fault for each unknown signal."""
        for k, signal in enumerate(self.file.signals):
            if signal not in self.system.columns:
                hint = did_you_mean(signal, self.system.columns)
                yield self.yaml.fault(("signals", k), f'no signal "{short(signal)}"{hint}')

    def drawn_faults(self, factors: Sequence[Factor], columns: Mapping[str, list[Any]]) -> Iterator[Fault]:
        """Yield faults of each factor's extreme drawn values."""
        for name in (f.name for f in factors if f.drawn is not None):
            way = self.file.vary[name].way
            cure = "cut it by within: [low, high]" if way == "normal" else "move its ends"
            for value in (min(columns[name]), max(columns[name])):
                for reason, exit_code in self._faults_of_value(name, value):
                    message = f"{name} would be {value:g}: {reason}; {cure}"
                    yield self.yaml.fault(("vary", name, way), message, exit_code=exit_code)

    def _faults_of_value(self, name: str, value: float) -> list[tuple[str, int]]:
        """Return the reasons against a value of a factor, with exit codes."""
        component, _, variable_name = name.partition(".")
        block = self.components.get(component)
        if not isinstance(block, FmuBlock):
            return [(f.message, f.exit_code) for f in self._test_variant(f"{name}={json.dumps(value)}")[0]]
        variable = next(v for v in block.description.modelVariables if v.name == variable_name)
        number = convert_value(block.description, variable, value)
        return [(number.reason, 2)] if isinstance(number, Misfit) else []


def _size(varied: Varied) -> int | None:
    """Return the number of listed values, or None."""
    if varied.values is not None:
        return len(varied.values)
    return varied.grid.count if varied.grid is not None else varied.count
