"""Linear models of an FMU for model exchange in a worker process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, FmuError, InputError, SimulationError, refuse
from cosim.base.messages import Note
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
from cosim.linearization.linear_sources import LinearizableSystem
from cosim.scenario.start_values import Misfit, convert_value, kind_of, settable
from cosim.storage.yaml_file import did_you_mean

MODULES = ("cosim.linearization.fmu_source", "fmpy.fmi2", "fmpy.logging")
NAME = "fmu"
DIFFERENCE_STEP = 1e-5  # relative to each state and input, or to 1
MAX_SLOPE_DEVIATION = 1e-3  # of an FMU's derivatives from differences, relative to the largest in a row
DIRECTIONAL = "directional derivatives of the FMU"


class Derivatives(NamedTuple):
    """Linearization of a point in the worker.

    Attributes:
        slopes: Rows are derivatives and outputs, columns states and inputs.
        rates: Derivatives and outputs.
        states: States after events.
        directional: True for directional derivatives, False for differences.
    """

    slopes: Array
    rates: Array
    states: Array
    notes: list[str]
    kinks: list[Kink]
    directional: bool


# -- in the worker ----------------------------------------------------------------------------


def read(path: Path, description: Any, start: Mapping[str, Any], method: str) -> Any:
    """Return the result of a method of the FMU after its initialization."""
    with closing(_open(path, description, start)) as block:
        return getattr(block, method)()


def differentiate(
    path: Path, description: Any, start: Mapping[str, Any], points: Sequence[Point], step: float, directional: bool
) -> list[Derivatives]:
    """Return the linearization of each point.

    If directional derivatives fail, the FMU is reopened for differences.
    """
    try:
        with closing(_open(path, description, start)) as block:
            return [_differentiate(block, point, step, directional) for point in points]
    except SimulationError as error:
        if not directional or "DirectionalDerivative" not in str(error):
            raise
        note = (
            f"finite differences of step {step:g} replace the FMU's own derivatives: {error.reason.partition(':')[0]}"
        )
    repeated = differentiate(path, description, start, points, step, False)
    return [each._replace(notes=[note, *each.notes]) for each in repeated]


def _differentiate(block: DifferentiableFmu, point: Point, step: float, directional: bool) -> Derivatives:
    slopes, rates, after = slopes_at(block, point.time, point.states, point.inputs, step, directional=directional)
    names, outputs = scalars(states_of(block.description)), scalars(reals(block.description, "output"))
    n, notes = len(after), list[str]()
    moved = np.abs(after - point.states) > 1e-9 * (1.0 + np.abs(point.states))
    if moved.any():
        states = ", ".join(f"{name} = {v:.6g}" for name, v, m in zip(names, after, moved, strict=True) if m)
        notes.append(Note(f"an event of the FMU at this point has moved its states: {states}"))
    z, inputs = np.concatenate([after, point.inputs]), scalars(reals(block.description, "input"))
    kinks = kinks_at(lambda z: block.rates(z[:n], z[n:]), z, names, inputs, outputs)
    block.rates(after, point.inputs)
    if directional:
        rows = [*(f"the derivative of {name}" for name in names), *outputs]
        slopes, more = _check_slopes(block, replace(point, states=after), slopes, step, rows)
        notes += more
    return Derivatives(slopes, rates, after, notes, kinks, directional)


def _open(path: Path, description: Any, start: Mapping[str, Any]) -> DifferentiableFmu:
    here.progress.doing[0] = OTHER
    block = DifferentiableFmu(NAME, path, description, start, frozenset())
    here.share_log(block)
    block.bind_nothing()
    block.open(0.0, 1.0)
    block.start()
    return block


def _check_slopes(
    block: DifferentiableFmu, point: Point, slopes: Array, step: float, rows: Sequence[str]
) -> tuple[Array, list[str]]:
    """Return the FMU's derivatives, with differences in deviating rows, and notes."""
    differences, _, _ = slopes_at(block, point.time, point.states, point.inputs, step, directional=False)
    size = np.maximum(np.abs(differences).max(axis=1, initial=0.0), np.abs(slopes).max(axis=1, initial=0.0))
    deviates = np.abs(slopes - differences).max(axis=1, initial=0.0) > MAX_SLOPE_DEVIATION * np.maximum(size, 1e-9)
    if not deviates.any():
        return slopes, []
    note = (
        f"differences of step {step:g} are taken for {', '.join(compress(rows, deviates))}: the FMU's own "
        "slopes of these differ"
    )
    return np.where(deviates[:, None], differences, slopes), [note]


# -- in the caller ----------------------------------------------------------------------------


class ExchangeSource(LinearizableSystem):
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
            name_states(path, description, self._call(read, "state_references"))
        self.title, self.files = description.modelName or path.stem, (path,)
        listed = states_of(description), reals(description, "input"), reals(description, "output")
        self.states, self.inputs, self.outputs = (scalars(group) for group in listed)
        self.units = {name: unit for group in listed for name, unit in units_of(group).items()}
        self._step = step
        block = DifferentiableFmu(NAME, path, description, self._start, frozenset())
        self._directional = step is None and block.gives_slopes
        self.reach = DIFFERENCE_STEP if step is None else step

    def with_values(self, values: Mapping[str, Any], over: Sequence[str]) -> ExchangeSource:
        """Return the source with the start values of a scenario's component; own start values take precedence."""
        names = {v.name for v in self._description.modelVariables}
        start = typed_values(self._path, self._description, {n: v for n, v in values.items() if n in names})
        return ExchangeSource(self._worker, self._path, self._description, {**start, **self._start}, self._step)

    def start(self) -> Point:
        """Return the start after the FMU's initialization."""
        states, inputs = self._call(read, "current_point")
        return Point(0.0, states, inputs)

    def linear(self, points: Sequence[Point]) -> list[Linear]:
        """Return the linear model at each point."""
        n, names = len(self.states), (self.states, self.inputs, self.outputs)
        models = []
        differences = f"central differences of the FMU, step {self.reach:g} of each value or of 1"
        at_points: list[Derivatives] = self._call(differentiate, list(points), self.reach, self._directional)
        for point, (slopes, rates, states, notes, kinks, directional) in zip(points, at_points, strict=True):
            matrices = slopes[:n, :n], slopes[:n, n:], slopes[n:, :n], slopes[n:, n:]
            origin = DIRECTIONAL if directional else differences, tuple(notes), tuple(kinks)
            at = replace(point, states=states)
            models.append(Linear(*matrices, *names, at, rates[:n], rates[n:], self.units, *origin))
        return models

    def _call(self, function: Any, *more: Any) -> Any:
        watch = Watch([NAME], [fmi_calls(self._description)])
        fmu = self._path.resolve(), self._description, self._start
        return self._worker.call(with_permission, permission.get(), function, *fmu, *more, watch=watch)


def check_differentiable(path: Path, description: Any) -> None:
    """Check that the derivatives of an FMU are accessible.

    Raises:
        InputError: They are not; the message names alternatives.
    """
    if "model-exchange" not in ways(description):
        raise InputError.at(
            path,
            (
                "is for co-simulation only, and hides its states and derivatives; give the model's own file "
                "(model.yaml, file.py:Class or base), or an FMU for model exchange; `cosim build --native` makes "
                "one of any model here"
            ),
        )
    if len(states_of(description)) != len(description.derivatives):
        raise InputError.at(
            path,
            ("declares derivatives without their states; its modelDescription.xml needs the attribute `derivative`"),
            FmuError.exit_code,
        )


def typed_values(path: Path, description: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return start values in the type and unit of their variables.

    Raises:
        InputError: Every unsuitable value.
    """
    variables = {v.name: v for v in description.modelVariables}
    converted, faults = dict[str, Any](), []
    for name, value in values.items():
        variable = variables.get(name)
        if variable is None:
            cure = did_you_mean(name, [n for n, v in variables.items() if settable(v)])
            faults.append(f'has no variable "{name}"{cure}')
        elif not settable(variable):
            faults.append(
                f"{name} is {kind_of(variable)} without a start value, so it cannot be set; name a parameter, a "
                "state or an input"
            )
        elif isinstance(fitting := convert_value(description, variable, value), Misfit):
            faults.append(f"{name} is {value!r}; {fitting.reason}")
        else:
            converted[name] = fitting
    refuse(Fault(path, 0, 0, fault) for fault in faults)
    return converted
