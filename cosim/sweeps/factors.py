"""Factors of a sweep: values or distributions from the file, with all faults."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.errors import Fault, InputError
from cosim.base.units import split_quantity
from cosim.blocks.description import unit_of
from cosim.blocks.fmu import FmuBlock
from cosim.scenario.controller_design import designed_values
from cosim.scenario.scenario import Scenario, resolved
from cosim.scenario.scenario_file import ScenarioFile, keys_of
from cosim.scenario.start_values import Misfit, converted, settable, typed
from cosim.scenario.start_values import kind_of as kind_of_variable
from cosim.storage.yaml_file import YamlFile, did_you_mean, short
from cosim.sweeps.sampling import MOST_RUNS, Factor, distribution, drawn_rows, saltelli_base
from cosim.sweeps.sweep_file import SweepFile, Varied
from cosim.system.system import System, build_system

FIXED = ("duration", "start_time", "criteria", "name", "description", "limits")  # keys common to all runs
FILES = ("fmu", "file", "model")  # last keys of paths to file names
MOST_TRIED = 50  # values of a path tested before any run
Location = tuple[str | int, ...]
STANDARD_DEVIATION: Location = ("normal", 1)  # Second number of a normal distribution; the mean is ("normal", 0).


def beside(sweep: Path, name: str, value: Any) -> Any:
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
        self.counts: dict[str, int] = {}
        self._check_size()

    def _check_size(self) -> None:
        """Check the number of runs before allocating anything."""
        vary = self.file.vary
        listed = {name: size for name, v in vary.items() if (size := _size(v)) is not None}
        counted = sum(v.each is not None for v in vary.values())
        sampled = len(vary) - len(listed) - counted
        count = math.prod(listed.values()) * drawn_rows(sampled, counted > 0, self.file.runs, self.file.sampling)
        if count > MOST_RUNS:
            largest = max(listed, key=lambda n: listed[n], default="")
            in_list = bool(listed) and (not sampled or listed[largest] > self.file.runs)
            where: Location = ("vary", largest) if in_list else ("runs",)
            message = f"{count:.3g} runs are more than the {MOST_RUNS:,} that a sweep may have"
            raise InputError([self.yaml.fault(where, f"{message}; give fewer values or runs", key=in_list)])
        if self.file.sampling != "saltelli":
            return
        if listed or not sampled:
            cure = "vary by distributions, or take another sampling"
            self._note(("sampling",), f"saltelli needs distributions, and nothing listed; {cure}")
        elif not saltelli_base(self.file.runs, sampled):
            self._note(("runs",), f"saltelli needs {sampled + 2} runs at least")

    def _note(self, where: Location, message: str, *, key: bool = False) -> None:
        self.faults.append(self.yaml.fault(where, message, key=key))

    def factor(self, name: str, varied: Varied) -> Factor | None:
        """Return a factor; note faults and return None if invalid."""
        before = len(self.faults)
        component, _, variable = name.partition(".")
        if name == "seed":
            return self._seed(varied)
        if varied.way in {"count", "each"}:
            self._note(("vary", name, varied.way), f"{varied.way} is for `seed`; give values, a grid or a distribution")
            return None
        if component in self.scenario.scenario.components:
            found = self._of_variable(name, component, variable, varied)
        else:
            found = self._of_path(name, varied)
        return None if len(self.faults) > before else found

    def _seed(self, varied: Varied) -> Factor | None:
        first = self.scenario.scenario.seed
        if varied.each is not None:
            return Factor("seed", first=varied.each)
        if varied.count is not None:
            return Factor("seed", values=list(range(first, first + varied.count)))
        values = varied.values
        if values is None or any(isinstance(v, bool) or not isinstance(v, int) or v < 0 for v in values):
            self._note(("vary", "seed"), "seeds are whole numbers: values: [1, 2], count: 20 or each: 1")
            return None
        return Factor("seed", values=values)

    def _settable_variable(self, name: str, block: Any) -> Any:
        """Return an FMU's settable variable, or the objection as text."""
        component, _, variable_name = name.partition(".")
        if not isinstance(block, FmuBlock):
            cure = f"vary a path such as components.{component}.… by values"
            return f"{component} is no FMU and has no start values; {cure}"
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

    def _of_variable(self, name: str, component: str, variable_name: str, varied: Varied) -> Factor | None:
        block: Any = self.components.get(component)
        variable = self._settable_variable(name, block)
        if isinstance(variable, str):
            self._note(("vary", name), variable, key=True)
            return None

        def value(where: Location, given: Any) -> Any:
            if where == STANDARD_DEVIATION:  # The bounds and the unit's offset do not apply.
                found = given
                if isinstance(given, str):
                    found = converted(block.description, variable, given, difference=True)
            else:
                found = typed(block.description, variable, given)
            if isinstance(found, Misfit):
                self._note(("vary", name, *where), f"{name} is {given!r}; {found.reason}")
                return None
            return found

        factor = self._make_factor(name, varied, value, unit_of(variable) or "")
        design = self.scenario.scenario.design
        if factor is not None and design is not None and design.component == component:
            # The value may contradict the design.
            also = [f"components.{component}.start.{variable_name}"]
            if isinstance(getattr(design, variable_name, None), str):  # a name, by which the design is judged
                also.append(f"design.{variable_name}")
            self._try_some(factor, varied, *also)
        return factor

    def _of_path(self, name: str, varied: Varied) -> Factor | None:
        first = name.partition(".")[0]
        known = [*Scenario.model_fields, *self.scenario.scenario.components]
        if first not in Scenario.model_fields:
            message = f'no component and no key of the scenario is "{short(first)}"{did_you_mean(first, known)}'
            self._note(("vary", name), message, key=True)
            return None
        if first in FIXED:
            self._note(("vary", name), f"{first} is one for all runs; give it by `set`", key=True)
            return None

        def value(where: Location, given: Any) -> Any:
            if not isinstance(given, str):
                return given
            found = split_quantity(given)
            try:
                number = self._number_at(name, given)
                if where == STANDARD_DEVIATION and found is not None:  # The unit's offset does not apply.
                    number = self._number_at(name, f"{2.0 * found[0]!r} {found[1]}") - number
            except ValueError as error:
                if where[0] == "values":
                    return beside(self.yaml.path, name, given)
                self._note(("vary", name, *where), str(error))
                return None
            return number

        factor = self._make_factor(name, varied, value, "")
        if factor is not None:
            self._try_some(factor, varied, name)
        return factor

    def _number_at(self, name: str, given: str) -> float:
        """Return the number of text such as `4 ms` at a scenario path; raise ValueError if none."""
        text = f"{name}={json.dumps(given)}"
        try:
            file = ScenarioFile(self.scenario.path, (*self.overrides, text), option="")
            faults: Sequence[Fault] = [f for f in file.faults if f.message.startswith(f"{name} is ")]
            found: Any = None if faults else resolved(file.scenario)
            for key in () if faults else keys_of(name):
                found = found[int(key) if isinstance(found, list) else key]
        except InputError as error:
            faults, found = error.faults, None
        except (KeyError, IndexError, TypeError):
            faults, found = (), None
        if _is_number(found):
            return float(found)
        raise ValueError(faults[0].message if faults else f"{name} is {given!r}; it is a number")

    def _try_some(self, factor: Factor, varied: Varied, *paths: str) -> None:
        """Test some values of a factor; note faults and the first warning."""
        tried = factor.values
        if tried is None:
            tried = factor.drawn(np.array([0.01, 0.5, 0.99])).tolist() if factor.drawn else []
        told: list[str] = []
        for k, v in enumerate(tried[:MOST_TRIED]):
            where: Location = ("vary", factor.name, "values", k) if varied.values is not None else ("vary", factor.name)
            told += self._try(where, *(f"{path}={json.dumps(v)}" for path in paths))
        if new := [t for t in told if t not in {*self.scenario.warnings, *self.system.warnings}]:
            self.warnings.append(f"{self.yaml.path}:{self.yaml.place(('vary', factor.name), key=True)[0]}: {new[0]}")

    def _try(self, where: Location, *overrides: str) -> list[str]:
        """Note the faults of a scenario variant; return its warnings."""
        try:
            file = ScenarioFile(self.scenario.path, (*self.overrides, *overrides), option="")
            system = build_system(file, designed_values(file))
        except InputError as error:
            self.faults += [self.yaml.fault(where, f.message, exit_code=f.exit_code) for f in error.faults]
            return []
        return [*file.warnings, *system.warnings]

    def _make_factor(self, name: str, varied: Varied, value: Any, unit: str) -> Factor | None:
        """Return a factor, with values converted by `value`."""
        way = varied.way
        given: Any = getattr(varied, way)
        if way == "values":
            return Factor(name, unit, [value((way, k), v) for k, v in enumerate(given)])
        if way == "grid":
            ends = [value((way, "from"), given.begin), value((way, "to"), given.end)]
            if not all(map(_is_number, ends)):
                self._not_numbers(name, way, ends)
                return None
            return Factor(name, unit, np.linspace(ends[0], ends[1], given.count).tolist())
        numbers = [value((way, k), v) for k, v in enumerate(given)]
        within = [value(("within", k), v) for k, v in enumerate(varied.within or ())]
        if not all(isinstance(v, float) for v in (*numbers, *within)):
            self._not_numbers(name, way, [*numbers, *within])
        if not all(map(_is_number, (*numbers, *within))):
            return None
        try:
            return Factor(name, unit, drawn=distribution(way, list(map(float, numbers)), within))
        except ValueError as error:
            self._note(("vary", name, way), str(error))
            return None

    def _not_numbers(self, name: str, way: str, given: Sequence[Any]) -> None:
        component, _, variable_name = name.partition(".")
        block = self.components.get(component)
        whole = isinstance(block, FmuBlock) and any(
            v.name == variable_name and v.type in {"Boolean", "String", "Enumeration", "Integer"}
            for v in block.description.modelVariables
        )
        if whole or any(isinstance(g, (bool, str)) for g in given):
            self._note(("vary", name, way), f"{name} is no real number; give its values as a list, values: […]")

    def signal_faults(self) -> Iterator[Fault]:
        """Yield a fault for each unknown signal."""
        for k, signal in enumerate(self.file.signals):
            if signal not in self.system.columns:
                hint = did_you_mean(signal, self.system.columns)
                yield self.yaml.fault(("signals", k), f'no signal "{short(signal)}"{hint}')

    def drawn_faults(self, factors: Sequence[Factor], columns: Mapping[str, list[Any]]) -> Iterator[Fault]:
        """Yield faults of the extreme drawn values of each factor."""
        for factor in factors:
            component, _, name = factor.name.partition(".")
            block = self.components.get(component)
            if factor.drawn is None:
                continue
            if not isinstance(block, FmuBlock):
                yield from self._of_drawn_path(factor, columns[factor.name])
                continue
            variable = next(v for v in block.description.modelVariables if v.name == name)
            for drawn in (min(columns[factor.name]), max(columns[factor.name])):
                found = typed(block.description, variable, drawn)
                if isinstance(found, Misfit):
                    way = self.file.vary[factor.name].way
                    told = f"{factor.name} would be {drawn:g}; {found.reason}; {_cure(way)}"
                    yield self.yaml.fault(("vary", factor.name, way), told)

    def _of_drawn_path(self, factor: Factor, column: list[Any]) -> Iterator[Fault]:
        way = self.file.vary[factor.name].way
        for drawn in (min(column), max(column)):
            try:
                file = ScenarioFile(
                    self.scenario.path, (*self.overrides, f"{factor.name}={json.dumps(drawn)}"), option=""
                )
                build_system(file, designed_values(file))
            except InputError as error:
                for f in error.faults:
                    told = f"{factor.name} would be {drawn:g}: {f.message}; {_cure(way)}"
                    yield self.yaml.fault(("vary", factor.name, way), told, exit_code=f.exit_code)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cure(way: str) -> str:
    """Return the remedy for draws that are too extreme."""
    return "cut it by within: [low, high]" if way == "normal" else "move its ends"


def _size(varied: Varied) -> int | None:
    """Return the number of listed values; None if not listed."""
    if varied.values is not None:
        return len(varied.values)
    return varied.grid.count if varied.grid is not None else varied.count
