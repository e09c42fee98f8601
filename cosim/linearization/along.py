"""Linearization points along a run of a scenario, with states from the inputs of the model's component."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, FmuError, InputError, SimulationError
from cosim.base.scratch import temporary_folder
from cosim.base.units import read_quantity
from cosim.linearization.linear_model import Point
from cosim.linearization.linear_sources import EquationSource, Source
from cosim.linearization.point import AT, Moment
from cosim.model.integrate import Stepper
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.packaged import is_ssp
from cosim.simulation.workflow import run
from cosim.storage.results import Results

SLACK = 1e-9  # [s]
AGREE = 1e-6  # share of an output's range within which model and component agree


class Along:
    """Points of a model along a run; an FMU replaces the component in the scenario.

    Args:
        component: Name in the scenario if several components fit.
    """

    def __init__(self, source: Source, moment: Moment, component: str = "") -> None:
        self.notes: list[str] = []
        self._source, self._moment = source, moment
        record = [] if isinstance(source, EquationSource) else list(source.states)
        _check(moment, component)
        with temporary_folder("linearize") as folder:
            self._results, self._manifest = _run(moment.scenario, folder)
            self._name = self._component(component)
            if record:
                patterns = [f"{self._name}.{state}" for state in record]
                record = [*self._recorded(), *patterns]
                flown = f"components.{self._name}.fmu={json.dumps(str(source.files[0].resolve()))}"
                overrides = [f"record={json.dumps(record, ensure_ascii=False)}", flown]
                self._results, self._manifest = _run(moment.scenario, Path(folder), overrides)
        self._rows = self._rows_of(moment.times)

    @property
    def start_values(self) -> dict[str, Any]:
        """Return the scenario's start values and parameters of the component."""
        return dict(self._manifest["scenario"]["components"].get(self._name, {}).get("start") or {})

    def points(self, source: Source) -> list[Point]:
        """Return one point for each time, from a source with the scenario's parameters."""
        self._source = source
        inputs = self._columns(source.inputs)
        if isinstance(source, EquationSource):
            states = self._driven(source, inputs)
        else:
            states = self._columns(self._source.states)
            if names := ", ".join(np.array(self._source.states)[np.isnan(states).all(axis=0)]):
                raise InputError([Fault(AT, 0, 0, f"{self._name} of {self._moment.scenario} records no {names}")])
        return [Point(float(self._results.time[k]), states[k], inputs[k]) for k in self._rows]

    # -- internals ----------------------------------------------------------------------------

    def _component(self, asked: str) -> str:
        """Return the component with the model's inputs and outputs.

        Raises:
            InputError: No component fits, or several do.
        """
        columns, wanted = set(self._results.columns), (*self._source.inputs, *self._source.outputs)
        owners = dict.fromkeys(column.partition(".")[0] for column in self._results.columns)
        missing = {owner: [n for n in wanted if f"{owner}.{n}" not in columns] for owner in owners}
        fitting = [owner for owner, names in missing.items() if not names]
        if asked in fitting:
            return asked
        if fitting and not asked:
            if len(fitting) == 1:
                return fitting[0]
            raise InputError([Fault(AT, 0, 0, f"{' and '.join(fitting)} would do; say which as --component NAME")])
        lacking = missing.get(asked, wanted)
        whom = asked or f"no component of {self._moment.scenario}"
        told = f"{', '.join(lacking[:8])}{', …' if len(lacking) > 8 else ''}"
        message = f"{whom} has not the inputs and outputs of {self._source.title} ({told})"
        raise InputError([Fault(AT, 0, 0, message)])

    def _recorded(self) -> list[str]:
        return list(self._manifest["scenario"].get("record") or ())

    def _columns(self, names: Sequence[str]) -> Array:
        columns = [f"{self._name}.{n}" for n in names]
        none = np.full(len(self._results.time), np.nan)
        found = [self._results[c] if c in self._results.columns else none for c in columns]
        return np.column_stack(found) if found else np.zeros((len(self._results.time), 0))

    def _rows_of(self, times: Array) -> list[int]:
        """Return the communication point at or before each time."""
        have, slack = self._results.time, SLACK
        _check_times(self._moment, float(have[0]), float(have[-1]))
        rows = np.searchsorted(have, times + slack * np.maximum(1.0, np.abs(times)), side="right") - 1
        if (np.abs(have[rows] - times) > 1e-6).any():
            self.notes.append("between communication points the last one before is taken")
        return [int(k) for k in rows]

    def _driven(self, source: EquationSource, inputs: Array) -> Array:
        """Return the states of the equations under the component's inputs."""
        stepper, time = Stepper(source.model), self._results.time
        memories = {f"{e.name}.{q.name}": q.unit for e in source.model.awake for q in e.memory}
        units = {**memories, **{n: source.units[n] for n in source.states}}
        starts = {n.removesuffix("_start"): str(v) for n, v in self.start_values.items() if n.endswith("_start")}
        values = {n: read_quantity(v, units[n]) for n, v in starts.items() if n in units}
        moment = stepper.start(float(time[0]), values)
        states, shown = [np.array(moment.state, float)], [self._outputs(source, moment.state, time[0], inputs[0])]
        for k in range(1, max(self._rows) + 1):
            try:
                moment = stepper.step(moment, tuple(inputs[k - 1].tolist()), float(time[k] - time[k - 1]))
                shown.append(self._outputs(source, moment.state, time[k], inputs[k]))
            except (ArithmeticError, ValueError) as error:
                raise SimulationError(source.name, float(time[k]), f"the equations have no value: {error}") from None
            states.append(np.array(moment.state, float))
        self._compare(source, np.array(shown))
        return np.array(states)

    @staticmethod
    def _outputs(source: EquationSource, state: Any, t: float, inputs: Array) -> Array:
        return np.array(source._equations.output(float(t), state, tuple(inputs.tolist())), float)

    def _compare(self, source: EquationSource, shown: Array) -> None:
        """Note a difference between model and component."""
        there = self._columns(source.outputs)[: len(shown)]
        off = np.abs(there - shown).max(axis=0)
        size = np.maximum(np.ptp(there, axis=0), 1e-3)
        worst = int(np.argmax(off / size))
        if off[worst] > AGREE * size[worst]:
            unit = source.units.get(source.outputs[worst], "")
            self.notes.append(
                f"{self._name} is not this model: driven alike, {source.outputs[worst]} differs by up to "
                f"{off[worst]:.3g} {unit}".rstrip()
            )


def _check(moment: Moment, component: str) -> None:
    """Check times and names against the scenario before its run."""
    if not moment.scenario.is_file():
        raise InputError([Fault(moment.scenario, 0, 0, "no such scenario")])
    if is_ssp(moment.scenario):
        return
    scenario = ScenarioFile(moment.scenario).scenario
    _check_times(moment, scenario.start_time, scenario.start_time + scenario.duration)
    if component and component not in scenario.components:
        message = f'{moment.scenario} has no component "{component}" ({", ".join(scenario.components)})'
        raise InputError([Fault(Path("--component"), 0, 0, message)])


def _check_times(moment: Moment, first: float, last: float) -> None:
    outside = [t for t in moment.times.tolist() if not first - SLACK <= t <= last + SLACK]
    if outside:
        told = f"{outside[0]:g} s is not within {moment.scenario}, which runs from {first:g} to {last:g} s"
        raise InputError([Fault(AT, 0, 0, told)])


def _run(scenario: Path, folder: Path, overrides: Sequence[str] = ()) -> tuple[Results, Mapping[str, Any]]:
    try:
        outcome = run(scenario, folder, list(overrides), report=False)
    except (InputError, FmuError, SimulationError) as error:
        if isinstance(error, SimulationError):
            error.left = None  # the temporary folder is deleted
        raise
    return outcome.results, outcome.manifest
