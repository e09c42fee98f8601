"""Logs of a craft: sensor noise at rest (5.44-5.46), and a parameter from the distance covered (§5.5).

name: The craft at rest, and over 1.5 m
model: base                       # or a model.yaml, or file.py:Class
rest: {files: [rest.csv]}
distance: {parameter: friction, output: x, covered: 1.5, files: [a.csv, b.csv, c.csv]}

Noise: the thesis uses the variance about the mean. The variance about a straight line is given too, so that drift does
not count as noise; its interval accounts for correlated rows.

Distance: the thesis matches its observer, c of eq 5.31, to a tape measure over 1.5 m. An observer with measured
accelerations follows the measurements more than the model, and counts their errors as friction. Here the model is
simulated with the recorded commands alone; both results are reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from scipy import optimize, stats

from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.registry import BASE
from cosim.core.text import did_you_mean
from cosim.core.units import square_unit
from cosim.files.kinds import check_given
from cosim.files.yaml_file import Number, Part, YamlFile
from cosim.fmi.building.file import LoadedModel, load_model
from cosim.fmi.building.own_run import predicted_outputs
from cosim.logs.log import Log, read_log
from cosim.model import Model, parameters_of
from plant.identification import PROTOCOL
from plant.identification.estimates import Estimate, Figure, Result, make_estimates
from plant.identification.protocol import Files, Window

MIN_DISTANCE_RUNS = 3  # runs over the distance: the interval comes from the scatter between them
MIN_REST_ROWS = 50  # number of rows below which the 95 % interval of a variance exceeds 0.7 to 1.55 of it
DRIFT_RATIO = 1.1  # ratio to the variance about a line, above which the variance about the mean contains a drift
# difference between the halves of a log at rest, in standard deviations, above which it was not at rest
MOVING_RATIO = 5.0
SHARES = (0.0, *np.geomspace(0.01, 1.0, 6).tolist())  # fractions of the way to a bound, tried to bracket the distance
WIDE_RANGE = 1e3  # range of an unbounded parameter as a multiple of the model's own value
IMU = ("psi", "psi_dot", "ax")


class RestFile(Part):
    """Logs of the craft at rest; `window` [s] selects rows of each log, by default all."""

    files: Annotated[Files, Field(min_length=1)]
    window: Window | None = None


class DistanceFile(Part):
    """Runs over a measured distance `covered`, common to all runs or one per run, in the unit of `output`."""

    files: Annotated[Files, Field(min_length=MIN_DISTANCE_RUNS)]
    parameter: str
    output: str
    covered: Number | list[Number]

    @property
    def lengths(self) -> list[float]:
        """Return the distance of each run."""
        return self.covered if isinstance(self.covered, list) else [self.covered] * len(self.files)


class CraftFile(Part):
    """A file for identification from logs of a craft: model, logs at rest, logs over a known distance."""

    schema_version: Literal[1] = 1
    name: str
    model: str = BASE
    rest: RestFile | None = None
    distance: DistanceFile | None = None


@dataclass(frozen=True)
class CraftUnderTest:
    """A file for identification from logs of a craft, with its model and logs."""

    file: CraftFile
    loaded: LoadedModel
    rest: Sequence[Log]
    runs: Sequence[Log]

    def results(self) -> list[Result]:
        """Return the variance of every output measured at rest, and the parameter that explains the distance.

        Raises:
            InputError: Logs are too short or not at rest, or no value of the parameter explains the distance.
        """
        noise = [] if self.file.rest is None else [_noise(self.rest, self.loaded.model, self.file.rest.window)]
        return noise if self.file.distance is None else [*noise, _distance(self.runs, self.loaded, self.file.distance)]


def read_craft(path: Path) -> CraftUnderTest | None:
    """Read a file for craft identification and its logs; return None for a protocol of a bench.

    Raises:
        InputError: The file or its logs have faults; the error names all of them.
    """
    check_given(path, PROTOCOL)
    yaml = YamlFile(path)
    if not {"rest", "distance"} & set(yaml.root) or {"cells", "tests"} & set(yaml.root):
        return None
    content = yaml.validate(CraftFile)
    loaded = load_model(content.model, path.parent, yaml)
    model, distance, faults = loaded.model, content.distance, list[Fault]()
    if distance is not None:
        names = [n for n, p in model.declared.items() if not isinstance(p.default, bool)]
        outputs = [q.name for q in model.outputs]
        for kind, name, known in (("parameter", distance.parameter, names), ("output", distance.output, outputs)):
            if name not in known:
                text = f'{model.title} has no {kind} "{name}"{did_you_mean(name, known)}'
                faults.append(yaml.fault(("distance", kind), text))
        if len(distance.lengths) != (count := len(distance.files)):
            text = f"{len(distance.lengths)} distances for {count} files; give one distance per file, or one for all"
            faults.append(yaml.fault(("distance", "covered"), text))
    logs: dict[str, list[Log]] = {"rest": [], "distance": []}
    for part, inputs in (("rest", ()), ("distance", model.inputs)):
        asked: RestFile | DistanceFile | None = getattr(content, part)
        for name in asked.files if asked else ():
            try:
                logs[part].append(read_log(path.parent / name, inputs, model.outputs))
            except InputError as error:
                faults += error.faults
    refuse(faults)
    return CraftUnderTest(content, loaded, logs["rest"], logs["distance"])


# -- noise at rest --------------------------------------------------------------------------


def _noise(logs: Sequence[Log], model: Model, window: Window | None) -> Result:
    """Return the pooled variance S² (eq 5.44) of each output, and its variance about a line with a 95 % χ² interval."""
    result, faults, (low, high) = Result("rest", []), list[Fault](), window or (-np.inf, np.inf)
    for q in model.outputs:
        parts = list[tuple[Array, Array]]()
        for log in logs:
            if q.name in log.outputs:
                t, v = log.time, log.outputs[q.name]
                inside = (t >= low - 1e-9) & (t <= high + 1e-9) & np.isfinite(v)
                parts.append((t[inside], v[inside]))
                if fault := _motion(q.name, v[inside]):
                    faults.append(Fault(log.path, 0, 0, fault))
        if not parts or faults:
            continue
        rows = sum(v.size for _, v in parts)
        about_mean = sum(float(np.sum((v - v.mean()) ** 2)) for _, v in parts) / (rows - len(parts))
        rests = [v - np.polyval(np.polyfit(t - t.mean(), v, 1), t - t.mean()) for t, v in parts]
        squares, freedom = sum(float(r @ r) for r in rests), rows - 2 * len(parts)
        about_line = squares / freedom
        # correlated rows count as fewer: for squares, 1 + 2·Σρ² (Bartlett)
        correlations = (sum(float(r[lag:] @ r[:-lag]) for r in rests) / max(squares, 1e-300) for lag in range(1, 6))
        free = max(2.0, freedom / (1.0 + 2.0 * sum(rho**2 for rho in correlations)))
        least, most = (free * about_line / float(stats.chi2.ppf(p, free)) for p in (0.975, 0.025))
        error, origin = about_line * float(np.sqrt(2.0 / free)), f"variance of {rows} rows at rest (5.44)"
        values = (about_mean, about_line, least, most, error, 0.0, len(parts), origin)
        result.estimates.append(Estimate(q.name, square_unit(q.unit) or "1", *values))
        if about_mean > DRIFT_RATIO * about_line:
            ratio = f"its variance about the mean is {about_mean / about_line:.3g} times that about a straight line"
            result.warnings.append(f"{q.name} drifts: {ratio}")
        result.figures.append(Figure(f"{q.name} at rest", "time [s]", q.unit, [("measured", *parts[0], "true")]))
    refuse(faults)
    return result


def _motion(name: str, values: Array) -> str:
    """Return why readings are too few or not those of a craft at rest; "" if they are."""
    if values.size < MIN_REST_ROWS:
        return f"{values.size} rows of {name} at rest; log at least {MIN_REST_ROWS} (the thesis took 20 s)"
    if np.ptp(values) == 0.0:
        return f"{name} is {values[0]:g} in every row: a dead channel; choose a window, or remove the log"
    first, last = np.array_split(values, 2)
    change, noise = float(last.mean() - first.mean()), float(np.std(np.diff(values))) / np.sqrt(2.0)
    text = f"{name} changes by {change:.3g} from the first half to the second: not at rest"
    return f"{text}; choose a window, or remove the log" if abs(change) > MOVING_RATIO * noise > 0.0 else ""


# -- distance covered -----------------------------------------------------------------------


def _distance(runs: Sequence[Log], loaded: LoadedModel, asked: DistanceFile) -> Result:
    """Return the parameter value with which the model covers the measured distances of the runs.

    The value is the mean over the runs, its interval comes from their scatter.
    """
    model, parameter, output = loaded.model, asked.parameter, asked.output
    declared = model.declared[parameter]
    near = float(loaded.parameters.get(parameter, declared.default))
    faults, values, observed = [], list[float](), list[float]()
    for run, length in zip(runs, asked.lengths, strict=True):

        def by_model(value: float, run: Log = run) -> float:
            return float(_path(run, model.with_values({parameter: value}), output)[-1])

        values.append(_match(by_model, length, declared.bounds, near))
        if np.isnan(values[-1]):
            text = f"no value of {parameter} makes the model cover the distance {length:g}"
            faults.append(Fault(run.path, 0, 0, f"{text}; check the distance, and that the inputs move the craft"))
        if observer := _observer_distance(run, model, parameter, output):
            observed.append(_match(observer, length, declared.bounds, near))
    refuse(faults)
    thesis = float(np.mean(observed)) if observed else np.nan
    numbers = [(parameter, declared.unit, thesis, np.nan)]
    result = Result("distance", make_estimates(numbers, np.array(values)[:, None], "distance covered (§5.5)"))
    value = result.estimates[0].value
    fitted = model.with_values({**loaded.parameters, parameter: float(np.clip(value, *declared.bounds))})
    unit = next(q.unit for q in model.outputs if q.name == output)
    for run, length in zip(runs, asked.lengths, strict=True):
        path = (f"model, {parameter} = {value:.3g}", run.time, _path(run, fitted, output), "true")
        end = ("covered", run.time[-1:], np.array([length]), "dots")
        result.figures.append(Figure(f"{run.path.name}: {output}", "time [s]", unit, [path, end]))
    result.details = {"each": values, "each_by_observer": observed}
    return result


def _match(distance_of: Callable[[float], float], length: float, bounds: tuple[float, float], near: float) -> float:
    """Return the parameter value nearest to `near` with which the distance is `length`; NaN without one."""

    def gap(value: float) -> float:
        return distance_of(value) - length

    wide = WIDE_RANGE * (abs(near) or 1.0)
    low, high = (b if np.isfinite(b) else near + sign * wide for b, sign in zip(bounds, (-1, 1), strict=True))
    for shares in pairwise(SHARES):
        for end in (high, low):
            bracket = sorted(near + share * (end - near) for share in shares)
            pair = [*map(gap, bracket)]
            if np.isfinite(pair).all() and pair[0] * pair[1] <= 0.0:
                return float(optimize.brentq(gap, *bracket, xtol=1e-9, rtol=1e-9))
    return float("nan")


def _path(run: Log, model: Model, output: str) -> Array:
    """Return the change of a model output under the recorded commands, NaN after divergence."""
    shown = predicted_outputs(model, replace(run, outputs={}), {})[output]
    return np.asarray(shown - shown[0])


def _observer_distance(run: Log, model: Model, parameter: str, output: str) -> Callable[[float], float] | None:
    """Return parameter → distance by the observer (App. F); None for other models or missing sensors."""
    from controller.observers import LinearFilter
    from controller.settings import FilterSettings
    from controller.synthesis import numbers_of
    from plant.hovercraft import Hovercraft

    measured = all(name in run.outputs and np.isfinite(run.outputs[name]).all() for name in IMU)
    declared = {p.name for p in parameters_of(FilterSettings)}
    if not (isinstance(model, Hovercraft) and measured and output == "x" and parameter in declared):
        return None
    numbers: dict[str, Any] = {n: v for n, v in numbers_of(model).items() if n in declared}
    commands = np.column_stack([run.inputs[q.name] for q in model.inputs])
    readings = np.column_stack([run.outputs[name] for name in IMU])

    def distance_of(value: float) -> float:
        settings = FilterSettings(**numbers | {"sample_time": run.step, parameter: value})
        observer = LinearFilter(settings, (0.0, 0.0, *readings[0, :2], 0.0))
        for command, reading in zip(commands[:-1], readings[1:], strict=True):
            observer.step(reading, command)
        return observer.estimate[0]

    return distance_of
