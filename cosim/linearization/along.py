"""Linearization points along a run of a scenario, with states from the inputs of the model's component."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError, SimulationError
from cosim.base.messages import Note
from cosim.base.scratch import temporary_folder
from cosim.base.text import as_yaml
from cosim.base.times import rounding, roundings
from cosim.base.units import read_quantity
from cosim.linearization.linear_model import Point
from cosim.linearization.linear_sources import EquationSource, LinearizableSystem
from cosim.linearization.point import AT, LinearizationTimes
from cosim.model.integrate import Stepper
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.packaged import is_ssp
from cosim.simulation.workflow import run
from cosim.storage.results import Results

MAX_OUTPUT_DIFFERENCE = 1e-6  # between model and component, relative to the output's range
MAX_NAMES = 8  # missing signals in a message


class Along:
    """Operating points of a model along a run of a scenario.

    The model stands for a component of the scenario.

    Args:
        component: Name in the scenario if several components have the model's inputs and outputs.
    """

    def __init__(self, source: LinearizableSystem, moment: LinearizationTimes, component: str = "") -> None:
        self.notes: list[str] = []
        self._moment = moment
        _check(moment, component)
        with temporary_folder("linearize") as folder:
            self._results, self._manifest = _run(moment.scenario, folder)
            self._name = self._component(source, component)
            if source.states and not isinstance(source, EquationSource):
                states = [f"{self._name}.{state}" for state in source.states]
                record = as_yaml([*(self._manifest["scenario"].get("record") or ()), *states])
                fmu = json.dumps(str(source.files[0].resolve()))
                overrides = [f"record={record}", f"components.{self._name}.fmu={fmu}"]
                self._results, self._manifest = _run(moment.scenario, folder, overrides)
        self._rows = self._rows_at(moment.times)

    @property
    def start_values(self) -> dict[str, Any]:
        """Return the start values and parameters that the scenario sets for the component."""
        return dict(self._manifest["scenario"]["components"].get(self._name, {}).get("start") or {})

    def points(self, source: LinearizableSystem) -> list[Point]:
        """Return one point for each time, from a source with the scenario's parameters."""
        inputs = self._columns(source.inputs)
        if isinstance(source, EquationSource):
            states = self._simulated_states(source, inputs)
        else:
            states = self._columns(source.states)
            if names := ", ".join(np.array(source.states)[np.isnan(states).all(axis=0)]):
                message = f"{self._name} of {self._moment.scenario} records no {names}"
                raise InputError.at(AT, message)
        return [Point(float(self._results.time[k]), states[k], inputs[k]) for k in self._rows]

    # -- internals ----------------------------------------------------------------------------

    def _component(self, source: LinearizableSystem, name: str) -> str:
        """Return the name of the scenario component that has the model's inputs and outputs.

        Raises:
            InputError: No component fits, or several do.
        """
        columns, signals = set(self._results.columns), (*source.inputs, *source.outputs)
        owners = dict.fromkeys(column.partition(".")[0] for column in self._results.columns)
        missing = {owner: [n for n in signals if f"{owner}.{n}" not in columns] for owner in owners}
        fitting = [owner for owner, names in missing.items() if not names]
        if name in fitting:
            return name
        if not name and len(fitting) == 1:
            return fitting[0]
        if not name and fitting:
            raise InputError.at(
                AT, f"several components fit the model: {', '.join(fitting)}; choose one as --component NAME"
            )
        absent = missing.get(name, signals)
        names = f"{', '.join(absent[:MAX_NAMES])}{', …' if len(absent) > MAX_NAMES else ''}"
        fields = {"model": source.title, "missing": names}
        if name:
            raise InputError.at(
                AT,
                "{component} lacks inputs and outputs of {model} ({missing}); name another component".format(
                    component=name, **fields
                ),
            )
        raise InputError.at(
            AT,
            (
                "no component of {scenario} has the inputs and outputs of {model} ({missing}); name another scenario"
            ).format(scenario=self._moment.scenario, **fields),
        )

    def _columns(self, names: Sequence[str]) -> Array:
        """Return signals of the component as columns, NaN for a signal without a record."""
        columns = np.full((len(self._results.time), len(names)), np.nan)
        for k, name in enumerate(f"{self._name}.{n}" for n in names):
            if name in self._results:
                columns[:, k] = self._results[name]
        return columns

    def _rows_at(self, times: Array) -> list[int]:
        """Return the communication point at or before each time."""
        points = self._results.time
        _check_times(self._moment, float(points[0]), float(points[-1]))
        step = float(np.min(np.diff(points), initial=1.0))
        rows = np.searchsorted(points, times + roundings(times, step), side="right") - 1
        if (np.abs(points[rows] - times) > roundings(times, 1e3 * step)).any():
            self.notes.append(Note("a time between two communication points is moved to the earlier of the two"))
        return [int(k) for k in rows]

    def _simulated_states(self, source: EquationSource, inputs: Array) -> Array:
        """Return the states of the model, simulated with the recorded inputs of the component."""
        stepper, time = Stepper(source.model), self._results.time
        memories = {f"{e.name}.{q.name}": q.unit for e in source.model.awake for q in e.memory}
        units = {**memories, **{n: source.units[n] for n in source.states}}
        starts = {n.removesuffix("_start"): str(v) for n, v in self.start_values.items() if n.endswith("_start")}
        values = {n: read_quantity(v, units[n]) for n, v in starts.items() if n in units}
        moment = stepper.start(float(time[0]), values)
        states, outputs = [], []
        for k in range(max(self._rows) + 1):
            try:
                if k:
                    moment = stepper.step(moment, tuple(inputs[k - 1].tolist()), float(time[k] - time[k - 1]))
                states.append(np.array(moment.state, float))
                outputs.append(source.evaluate(float(time[k]), states[k], inputs[k])[1])
            except (ArithmeticError, ValueError) as error:
                message = f"the equations have no value there: {error}"
                raise SimulationError(source.name, float(time[k]), message) from None
        self._compare(source, np.array(outputs))
        return np.array(states)

    def _compare(self, source: EquationSource, outputs: Array) -> None:
        """Note a difference between model and component."""
        recorded = self._columns(source.outputs)[: len(outputs)]
        difference = np.abs(recorded - outputs).max(axis=0)
        span = np.maximum(np.ptp(recorded, axis=0), 1e-3)
        worst = int(np.argmax(difference / span))
        if difference[worst] > MAX_OUTPUT_DIFFERENCE * span[worst]:
            output = source.outputs[worst]
            size = f"{difference[worst]:.3g} {source.units.get(output, '')}".rstrip()
            self.notes.append(f"{self._name} is not this model: driven alike, {output} differs by up to {size}")


def _check(moment: LinearizationTimes, component: str) -> None:
    """Check the requested times and the component's name against the scenario, before the scenario is run."""
    if not moment.scenario.is_file():
        raise InputError.at(moment.scenario, "no such scenario; check its path")
    if is_ssp(moment.scenario):
        return
    scenario = ScenarioFile(moment.scenario).scenario
    _check_times(moment, scenario.start_time, scenario.start_time + scenario.duration)
    if component and component not in scenario.components:
        names = ", ".join(scenario.components)
        message = f'{moment.scenario} has no component "{component}" ({names})'
        raise InputError.at(Path("--component"), message)


def _check_times(moment: LinearizationTimes, first: float, last: float) -> None:
    for time in moment.times.tolist():
        if not first - rounding(first) <= time <= last + rounding(last):
            message = f"{time:g} s is not within {moment.scenario}, which runs from {first:g} to {last:g} s"
            raise InputError.at(AT, message)


def _run(scenario: Path, folder: Path, overrides: Sequence[str] = ()) -> tuple[Results, Mapping[str, Any]]:
    try:
        outcome = run(scenario, folder, overrides, report=False)
    except SimulationError as error:
        error.left = None  # the temporary folder is deleted
        raise
    return outcome.results, outcome.manifest
