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
from plant.identification import messages
from plant.identification.estimates import Figure, Result, make_estimates

TRIES = 6  # values on either side of the model's own, to bracket the distance
FIRST_SHARE = 0.01  # first of them as a share of the way to a bound
WIDE_RANGE = 1e3  # range of an unbounded parameter as a multiple of the model's own value
IMU = ("psi", "psi_dot", "ax")
Distance = Callable[[float], float]  # distance as a function of the parameter


def distance(runs: Sequence[Log], loaded: LoadedModel, parameter: str, output: str, lengths: Sequence[float]) -> Result:
    """Return the parameter value with which the model covers the measured distances (`lengths`) of the runs.

    The value is the mean over the runs, its interval comes from their scatter.
    """
    model, declared = loaded.model, loaded.model.declared[parameter]
    near = float(loaded.parameters.get(parameter, declared.default))
    faults, values, observed = [], list[float](), list[float]()
    for run, length in zip(runs, lengths, strict=True):
        try:
            values.append(match(_model_distance(run, model, parameter, output), length, declared.bounds, near))
        except ValueError as error:
            message = messages.NO_VALUE_OF_DISTANCE(distance=length, parameter=parameter, reason=str(error))
            faults.append(Fault(run.path, 0, 0, message))
        observer = _observer_distance(run, model, parameter, output)
        if observer is not None:
            try:
                observed.append(match(observer, length, declared.bounds, near))
            except ValueError:
                observed.append(float("nan"))
    refuse(faults)
    thesis = float(np.mean(observed)) if observed else float("nan")
    named = [(parameter, declared.unit, thesis, float("nan"))]
    (estimate,) = make_estimates(named, np.array(values)[:, None], np.zeros((0, 1)), "distance covered (§5.5)")
    value = estimate.value
    fitted = model.with_values({**loaded.parameters, parameter: float(np.clip(value, *declared.bounds))})
    unit, figures = next(q.unit for q in model.outputs if q.name == output), []
    for run, length in zip(runs, lengths, strict=True):
        path = (f"model, {parameter} = {value:.3g}", run.time, _path(run, fitted, output), "true")
        end = ("covered", run.time[-1:], np.array([length]), "dots")
        figures.append(Figure(f"{run.path.name}: {output}", "time [s]", unit, [path, end]))
    notes = []
    if observed and np.isnan(thesis):
        notes.append(messages.NO_VALUE_BY_OBSERVER(parameter=parameter))
    return Result("distance", [estimate], notes, figures, {"each": values, "each_by_observer": observed})


def match(distance_of: Distance, length: float, bounds: tuple[float, float], near: float) -> float:
    """Return the value nearest `near` covering the distance `length`.

    Args:
        distance_of: Function from a parameter value to the distance covered.
        bounds: Limits of the parameter.

    Raises:
        ValueError: No value within the bounds gives the distance.
    """
    from scipy.optimize import brentq

    gaps: dict[float, float] = {}

    def gap(value: float) -> float:
        if value not in gaps:
            gaps[value] = distance_of(value) - length
        return gaps[value]

    wide = WIDE_RANGE * (abs(near) or 1.0)
    low, high = (b if np.isfinite(b) else near + s * wide for b, s in zip(bounds, (-1, 1), strict=True))
    shares = np.geomspace(FIRST_SHARE, 1.0, TRIES)
    outwards = [(near + share * (high - near), near - share * (near - low)) for share in shares.tolist()]
    above = below = near
    for up, down in outwards:
        for inner, outer in ((above, up), (below, down)):
            ends = gap(inner), gap(outer)
            if np.isfinite(ends).all() and ends[0] * ends[1] <= 0.0:
                return float(brentq(gap, min(inner, outer), max(inner, outer), xtol=1e-9, rtol=1e-9))
        above, below = up, down
    reached = [g + length for g in gaps.values() if np.isfinite(g)]
    span = f"from {min(reached):.4g} to {max(reached):.4g} are" if reached else "nothing is"
    raise ValueError(f"{span} within its bounds {low:g} … {high:g}; is the distance or the sign of a command wrong?")


def matching_faults(model: Model, runs: Sequence[Log]) -> Iterator[Fault]:
    """Yield faults of runs without commands."""
    for run in runs:
        if all(np.ptp(v) == 0.0 for v in run.inputs.values()):
            yield Fault(run.path, 0, 0, messages.NO_COMMAND())


def _model_distance(run: Log, model: Model, parameter: str, output: str) -> Distance:
    return lambda value: float(_path(run, model.with_values({parameter: value}), output)[-1])


def _path(run: Log, model: Model, output: str) -> Array:
    """Return a model output under the recorded commands."""
    stepper, row = Stepper(model), [q.name for q in model.outputs].index(output)
    commands = np.column_stack([run.inputs[q.name] for q in model.inputs]).tolist()
    moment = stepper.start(float(run.time[0]))
    values = [stepper.output(moment.t, moment.state, tuple(commands[0]))[row]]
    for k, h in enumerate(np.diff(run.time).tolist()):
        moment = stepper.step(moment, tuple(commands[k]), h)
        values.append(stepper.output(moment.t, moment.state, tuple(commands[k + 1]))[row])
    return np.asarray(np.array(values) - values[0], dtype=np.float64)


def _observer_distance(run: Log, model: Model, parameter: str, output: str) -> Distance | None:
    """Return the distance of the craft's observer (App. F), None for other models or missing sensors."""
    from controller.gains import Settings
    from controller.kalman import kalman_filter
    from controller.synthesis import numbers_of
    from plant.hovercraft import Hovercraft

    names = {f.name for f in fields(Settings)}
    measured = all(name in run.outputs and np.isfinite(run.outputs[name]).all() for name in IMU)
    if not (isinstance(model, Hovercraft) and measured and output == "x" and parameter in names):
        return None
    numbers: dict[str, Any] = {n: v for n, v in numbers_of(model).items() if n in names}
    base = replace(Settings(), **numbers, sample_time=run.step)
    tilts = np.column_stack([run.inputs["tilt_right"], run.inputs["tilt_left"]])
    readings = np.column_stack([run.outputs[name] for name in IMU])

    def distance_of(value: float) -> float:
        change: dict[str, Any] = {parameter: value}
        kf = kalman_filter(replace(base, **change), np.array([0.0, 0.0, *readings[0, :2], 0.0]))
        for k in range(1, len(readings)):
            kf.predict(u=tilts[k - 1])
            kf.update(readings[k])
        return float(kf.x[0])

    return distance_of
