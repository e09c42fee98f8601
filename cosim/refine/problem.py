"""From logs to a fitting problem: the kernel for what they hold, and where each starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cosim.refine.candidates import neutral_values
from cosim.refine.fit import Problem
from cosim.refine.generate import generate
from cosim.refine.kernel import Array, CompiledKernel, Data
from cosim.refine.log import Log
from plant.integrate import substeps
from plant.model import Model

# Standard deviation with which a state that no sensor reads is known at the start, by unit.
UNKNOWN = {"m": 1e-3, "rad": 1e-3, "m/s": 0.2, "rad/s": 0.1}


_KERNELS: dict[Any, CompiledKernel] = {}


def build_problem(
    model: Model,
    logs: Sequence[Log],
    unnamed: bool = False,
    noise: Mapping[str, float] | None = None,
    sensors: Mapping[str, float] | None = None,
) -> Problem:
    """Kernel and data; outputs that some log lacks are left out.

    `noise`: standard deviations of outputs where they are not the model's own; `sensors`: errors known already.
    """
    measured = tuple(q.name for q in model.outputs if all(q.name in log.outputs for log in logs))
    kernel = _kernel(model, measured, unnamed)
    generated = kernel.generated
    data = [as_data(model, log, measured) for log in logs]
    variance = {q.name: model.sensor_variance.get(q.name, 1.0) for q in model.outputs}
    variance |= {name: sigma * sigma for name, sigma in (noise or {}).items()}
    states = {s.name: s for s in model.states}
    P0 = [
        10 * variance[name] if name in measured else UNKNOWN.get(states[name].unit, 1.0) ** 2
        for name in (generated.states[k] for k in generated.stochastic)
    ]
    x0 = [start_state(model, d, measured, generated.states) for d in data]
    values = {**dict.fromkeys(generated.parameters, 0.0), **neutral_values(model), **(sensors or {})}
    return Problem(kernel, data, x0, np.diag(P0), np.array([variance[n] for n in measured]), values)


def _kernel(model: Model, measured: tuple[str, ...], unnamed: bool) -> CompiledKernel:
    """The kernel of a model, made once: it takes all numbers as arguments, only flags are built in."""
    flags = tuple(getattr(model, p.name) for p in model.parameters if isinstance(p.default, bool))
    key = (type(model), flags, measured, unnamed)
    if key not in _KERNELS:
        _KERNELS[key] = CompiledKernel(generate(model, measured, unnamed))
    return _KERNELS[key]


def as_data(model: Model, log: Log, measured: Sequence[str]) -> Data:
    """A log as the filter sees it."""
    u = np.column_stack([log.inputs[q.name] for q in model.inputs])
    y = np.column_stack([log.outputs[name] for name in measured])
    return Data(log.step, float(log.time[0]), u, y, substeps(log.step, model.substep))


def start_state(model: Model, data: Data, measured: Sequence[str], states: Sequence[str]) -> Array:
    """The model's own start, with what is measured first in its place (a state and an output of one name and unit)."""
    start = dict(zip((s.name for s in model.states), model.start(), strict=True))
    units = {s.name: s.unit for s in model.base_states}
    same = {q.name for q in model.outputs if units.get(q.name) == q.unit}
    for j, name in enumerate(measured):
        column = data.y[:, j][~np.isnan(data.y[:, j])]
        if name in same and name in start and len(column) and name in _kinematic(model):
            start[name] = float(column[0])
    return np.array([start.get(name, 0.0) for name in states])


def _kinematic(model: Model) -> set[str]:
    """States that outputs show as they are: not a thrust, which is shown with ground effect."""
    return {q.name for q in model.base_states} - {q.name for q in model.base_states if q.unit == "N"}


def varied_inputs(model: Model, logs: Sequence[Log]) -> list[str]:
    """Inputs that are not constant in some log."""
    return [q.name for q in model.inputs if any(np.ptp(log.inputs[q.name]) > 1e-9 for log in logs)]
