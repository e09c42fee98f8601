"""Linear models of an FMU for model exchange in a worker process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, FmuError, InputError, SimulationError, refuse
from cosim.blocks.compiling import permission, with_permission
from cosim.blocks.derivatives import (
    DifferentiableFmu,
    hides_states,
    name_states,
    reals,
    scalars,
    slopes_at,
    states_of,
    units_of,
)
from cosim.blocks.description import ways
from cosim.isolation import worker as here
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch, fmi_calls
from cosim.linearization.kinks import Kink, kinks_at
from cosim.linearization.linear_model import Linear, Point
from cosim.linearization.linear_sources import Source
from cosim.scenario.start_values import Misfit, kind_of, settable, typed
from cosim.storage.yaml_file import did_you_mean

MODULES = ("cosim.linearization.fmu_source", "fmpy.fmi2", "fmpy.logging")
NAME = "fmu"
DIFFERENCE = 1e-5  # difference step relative to each state and input, or to 1
APART = 1e-3  # allowed deviation of an FMU's derivatives from differences, relative to the largest in a row
GIVEN = "directional derivatives of the FMU"
Found = tuple[Array, Array, Array, list[str], list[Kink], bool]

# -- in the worker ----------------------------------------------------------------------------


def state_references(path: Path, description: Any, start: Mapping[str, Any]) -> list[int]:
    """Return the value references of the states of an FMI 1.0 FMU."""
    block = _opened(path, description, start)
    try:
        return block.state_references()
    finally:
        block.close()


def begin(path: Path, description: Any, start: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return the start values of states and inputs."""
    block = _opened(path, description, start)
    try:
        return block.current_point()
    finally:
        block.close()


def about(
    path: Path, description: Any, start: Mapping[str, Any], points: Sequence[Point], step: float, given: bool
) -> list[Found]:
    """Return the linearization of each point with notes and kinks.

    If directional derivatives fail, the FMU is reopened for differences.

    Returns:
        For each point: slopes, rates and outputs, states after events, notes, kinks, and True for directional
        derivatives.
    """
    if not given:
        return _about(path, description, start, points, step, given=False)
    try:
        return _about(path, description, start, points, step, given=True)
    except SimulationError as error:
        if "DirectionalDerivative" not in str(error):
            raise
        told = f"differences of step {step:g} are taken: {error.reason.partition(':')[0]} for its own slopes"
    moved = _about(path, description, start, points, step, given=False)
    return [(slopes, rates, after, [told, *notes], kinks, own) for slopes, rates, after, notes, kinks, own in moved]


def _about(
    path: Path, description: Any, start: Mapping[str, Any], points: Sequence[Point], step: float, *, given: bool
) -> list[Found]:
    block, found = _opened(path, description, start), []
    try:
        for point in points:
            slopes, rates, after = slopes_at(block, point.time, point.states, point.inputs, step, directional=given)
            notes, kinks = _notes(block, point, after)
            if given:
                slopes, more = _believed(block, replace(point, states=after), slopes, step)
                notes += more
            found.append((slopes, rates, after, notes, kinks, given))
    finally:
        block.close()
    return found


def _opened(path: Path, description: Any, start: Mapping[str, Any]) -> DifferentiableFmu:
    here.progress.doing[0] = OTHER
    block = DifferentiableFmu(NAME, path, description, start, frozenset())
    here.share_log(block)
    block.bind_nothing()
    block.open(0.0, 1.0)
    block.start()
    return block


def _notes(block: DifferentiableFmu, point: Point, after: Array) -> tuple[list[str], list[Kink]]:
    """Return notes on states moved by an event, and kinks."""
    n, notes = len(after), []
    names = scalars(states_of(block.description))
    moved = np.abs(after - point.states) > 1e-9 * (1.0 + np.abs(point.states))
    if moved.any():
        told = ", ".join(f"{name} = {v:.6g}" for name, v, m in zip(names, after, moved, strict=True) if m)
        notes.append(f"an event of the FMU at this point has moved its states: {told}")
    fed, shown = (scalars(reals(block.description, causality)) for causality in ("input", "output"))
    z = np.concatenate([after, point.inputs])
    kinks = kinks_at(lambda z: block.rates(z[:n], z[n:]), z, names, fed, shown)
    block.rates(after, point.inputs)
    return notes, kinks


def _believed(block: DifferentiableFmu, point: Point, slopes: Array, step: float) -> tuple[Array, list[str]]:
    """Return the FMU's derivatives, with differences in deviating rows, and notes."""
    differences, _, _ = slopes_at(block, point.time, point.states, point.inputs, step, directional=False)
    size = np.maximum(np.abs(differences).max(axis=1, initial=0.0), np.abs(slopes).max(axis=1, initial=0.0))
    off = np.abs(slopes - differences).max(axis=1, initial=0.0) > APART * np.maximum(size, 1e-9)
    if not off.any():
        return slopes, []
    states, shown = scalars(states_of(block.description)), scalars(reals(block.description, "output"))
    rows = [*(f"the derivative of {n}" for n in states), *shown]
    told = ", ".join(n for n, other in zip(rows, off, strict=True) if other)
    note = f"differences of step {step:g} are taken for {told}: the FMU's own slopes of these are others"
    return np.where(off[:, None], differences, slopes), [note]


# -- in the caller ----------------------------------------------------------------------------


class ExchangeSource(Source):
    """An FMU with access to its derivatives.

    Args:
        step: Step of central differences, which then replace the FMU's directional derivatives.
    """

    def __init__(
        self, worker: Worker, path: Path, description: Any, start: Mapping[str, Any], step: float | None = None
    ) -> None:
        check_differentiable(path, description)
        self._worker, self._path, self._description, self._start = worker, path, description, dict(start)
        if hides_states(description):
            name_states(path, description, self._call(state_references))
        self.title, self.files = description.modelName or path.stem, (path,)
        listed = states_of(description), reals(description, "input"), reals(description, "output")
        self.states, self.inputs, self.outputs = (scalars(group) for group in listed)
        self.units = {name: unit for group in listed for name, unit in units_of(group).items()}
        self._asked = step
        block = DifferentiableFmu(NAME, path, description, self._start, frozenset())
        self._own = step is None and block.gives_slopes
        self.step = self.reach = DIFFERENCE if step is None else step

    def with_values(self, values: Mapping[str, Any], over: Sequence[str]) -> ExchangeSource:
        """Return the source with start values of a scenario's component."""
        known = {v.name for v in self._description.modelVariables}
        start = typed_values(self._path, self._description, {n: v for n, v in values.items() if n in known})
        return ExchangeSource(self._worker, self._path, self._description, {**start, **self._start}, self._asked)

    def start(self) -> Point:
        """Return the start after the FMU's initialization."""
        states, inputs = self._call(begin)
        return Point(0.0, states, inputs)

    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point."""
        n, made, names = len(self.states), [], (self.states, self.inputs, self.outputs)
        found: list[Found] = self._call(about, list(points), self.step, self._own)
        differences = f"central differences of the FMU, step {self.step:g} of each value or of 1"
        for point, (slopes, rates, after, notes, kinks, own) in zip(points, found, strict=True):
            matrices = slopes[:n, :n], slopes[:n, n:], slopes[n:, :n], slopes[n:, n:]
            at, told = replace(point, states=after), (GIVEN if own else differences, tuple(notes), tuple(kinks))
            made.append(Linear(*matrices, *names, at, rates[:n], rates[n:], self.units, *told))
        return made

    def _call(self, function: Any, *more: Any) -> Any:
        watch = Watch([NAME], [fmi_calls(self._description)])
        about = self._path.resolve(), self._description, self._start
        return self._worker.call(with_permission, permission.get(), function, *about, *more, watch=watch)


def check_differentiable(path: Path, description: Any) -> None:
    """Check that the derivatives of an FMU are accessible.

    Raises:
        InputError: They are not; the message names alternatives.
    """
    if "model-exchange" not in ways(description):
        what = "is for co-simulation only, and hides its states and derivatives"
        cure = "give the model's own file (model.yaml, file.py:Class or base), or an FMU for model exchange"
        raise InputError([Fault(path, 0, 0, f"{what}; {cure}; `cosim build --native` makes one of any model here")])
    if len(states_of(description)) != len(description.derivatives):
        raise InputError([Fault(path, 0, 0, "does not say which states its derivatives are of", FmuError.exit_code)])


def typed_values(path: Path, description: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return start values in the type and unit of their variables.

    Raises:
        InputError: Every unsuitable value.
    """
    variables, found, faults = {v.name: v for v in description.modelVariables}, {}, []
    for name, value in given.items():
        variable = variables.get(name)
        if variable is None or not settable(variable):
            known = [n for n, v in variables.items() if settable(v)]
            unknown = f'has no variable "{name}"{did_you_mean(name, known)}'
            faults.append(Fault(path, 0, 0, f"{name} is {kind_of(variable)}" if variable else unknown))
            continue
        fitting = typed(description, variable, value)
        if isinstance(fitting, Misfit):
            faults.append(Fault(path, 0, 0, f"{name} is {value!r}; {fitting.reason}"))
        else:
            found[name] = fitting
    refuse(faults)
    return found
