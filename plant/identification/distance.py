"""Parameter from the distance covered, §5.5: c of eq 5.31 that matches model and tape measure over 1.5 m.

The thesis matches its observer; an observer with measured accelerations follows these more than the model, and counts
their errors as friction. Here the model alone follows the recorded commands; both results are given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, refuse
from cosim.loading.file import LoadedModel
from cosim.logs.log import Log
from cosim.model import Model, Stepper
from plant.identification.estimates import Figure, Result, make_estimates

TRIES = 6  # values on either side of the model's own, to bracket the distance
NEAREST, WIDEST = 0.01, 1e3  # first of them as a share of the way to a bound; range of an unbounded parameter
IMU = ("psi", "psi_dot", "ax")
Covered = Callable[[float], float]  # distance as a function of the parameter


def distance(runs: Sequence[Log], loaded: LoadedModel, parameter: str, output: str, covered: Sequence[float]) -> Result:
    """Return the parameter that gives every run its distance.

    The value is the mean over the runs, its interval comes from their scatter.
    """
    model, declared = loaded.model, loaded.model.declared[parameter]
    near = float(loaded.parameters.get(parameter, declared.default))
    faults, values, observed = [], list[float](), list[float]()
    for run, wanted in zip(runs, covered, strict=True):
        try:
            values.append(matched(_by_model(run, model, parameter, output), wanted, declared.bounds, near))
        except ValueError as error:
            faults.append(Fault(run.path, 0, 0, f"{wanted:g} is covered with no {parameter}: {error}"))
        observer = _by_observer(run, model, parameter, output)
        if observer is not None:
            try:
                observed.append(matched(observer, wanted, declared.bounds, near))
            except ValueError:
                observed.append(float("nan"))
    refuse(faults)
    thesis = float(np.mean(observed)) if observed else float("nan")
    named = [(parameter, declared.unit, thesis, float("nan"))]
    (estimate,) = make_estimates(named, np.array(values)[:, None], np.zeros((0, 1)), "distance covered (§5.5)")
    value = estimate.value
    found = model.with_values({**loaded.parameters, parameter: float(np.clip(value, *declared.bounds))})
    unit, figures = next(q.unit for q in model.outputs if q.name == output), []
    for run, wanted in zip(runs, covered, strict=True):
        path = (f"model, {parameter} = {value:.3g}", run.time, _path(run, found, output), "true")
        end = ("covered", run.time[-1:], np.array([wanted]), "dots")
        figures.append(Figure(f"{run.path.name}: {output}", "time [s]", unit, [path, end]))
    notes = []
    if observed and np.isnan(thesis):
        notes.append(f"the observer of App. F reaches the distance of some run with no {parameter}")
    return Result("distance", [estimate], notes, figures, {"each": values, "each_by_observer": observed})


def matched(covered: Covered, wanted: float, bounds: tuple[float, float], near: float) -> float:
    """Return the closest value with the wanted distance.

    Raises:
        ValueError: No value gives the distance.
    """
    from scipy.optimize import brentq

    known: dict[float, float] = {}

    def gap(value: float) -> float:
        if value not in known:
            known[value] = covered(value) - wanted
        return known[value]

    low, high = (
        b if np.isfinite(b) else near + s * WIDEST * (abs(near) or 1.0) for b, s in zip(bounds, (-1, 1), strict=True)
    )
    shares = np.geomspace(NEAREST, 1.0, TRIES)
    outwards = [(near + share * (high - near), near - share * (near - low)) for share in shares.tolist()]
    above = below = near
    for up, down in outwards:
        for inner, outer in ((above, up), (below, down)):
            ends = gap(inner), gap(outer)
            if np.isfinite(ends).all() and ends[0] * ends[1] <= 0.0:
                return float(brentq(gap, min(inner, outer), max(inner, outer), xtol=1e-9, rtol=1e-9))
        above, below = up, down
    reached = [g + wanted for g in known.values() if np.isfinite(g)]
    told = f"from {min(reached):.4g} to {max(reached):.4g} are" if reached else "nothing is"
    raise ValueError(f"{told} within its bounds {low:g} … {high:g}; is the distance or the sign of a command wrong?")


def matching_faults(model: Model, runs: Sequence[Log]) -> Iterator[Fault]:
    """Yield faults of runs without commands."""
    for run in runs:
        if all(np.ptp(v) == 0.0 for v in run.inputs.values()):
            yield Fault(run.path, 0, 0, "no command changes in it: nothing moves, and nothing can be matched")


def _by_model(run: Log, model: Model, parameter: str, output: str) -> Covered:
    return lambda value: float(_path(run, model.with_values({parameter: value}), output)[-1])


def _path(run: Log, model: Model, output: str) -> Array:
    """Return an output of the model under the recorded commands, from its start."""
    stepper, row = Stepper(model), [q.name for q in model.outputs].index(output)
    commands = np.column_stack([run.inputs[q.name] for q in model.inputs]).tolist()
    moment = stepper.start(float(run.time[0]))
    found = [stepper.output(moment.t, moment.state, tuple(commands[0]))[row]]
    for k, h in enumerate(np.diff(run.time).tolist()):
        moment = stepper.step(moment, tuple(commands[k]), h)
        found.append(stepper.output(moment.t, moment.state, tuple(commands[k + 1]))[row])
    path: Array = np.array(found, dtype=np.float64)
    return np.asarray(path - path[0])


def _by_observer(run: Log, model: Model, parameter: str, output: str) -> Covered | None:
    """Return the distance of the craft's observer (App. F), None for other models or missing sensors."""
    from controller.gains import Settings
    from controller.kalman import kalman_filter
    from controller.synthesis import numbers_of
    from plant.hovercraft import Hovercraft

    known = {f.name for f in fields(Settings)}
    measured = all(name in run.outputs and np.isfinite(run.outputs[name]).all() for name in IMU)
    if not (isinstance(model, Hovercraft) and measured and output == "x" and parameter in known):
        return None
    numbers: dict[str, Any] = {n: v for n, v in numbers_of(model).items() if n in known}
    base = replace(Settings(), **numbers, sample_time=run.step)
    tilts = np.column_stack([run.inputs["tilt_right"], run.inputs["tilt_left"]])
    seen = np.column_stack([run.outputs[name] for name in IMU])

    def covered(value: float) -> float:
        given: dict[str, Any] = {parameter: value}
        kf = kalman_filter(replace(base, **given), np.array([0.0, 0.0, *seen[0, :2], 0.0]))
        for k in range(1, len(seen)):
            kf.predict(u=tilts[k - 1])
            kf.update(seen[k])
        return float(kf.x[0])

    return covered
